"""The obstacles that faults bring: a ball over the goal, a plate at the tool."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_oa.robot.plant import make_robot_plant
from drake_oa.scenario.faults import GoalBlocked
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.obstacles import check_waypoints, offset_at
from drake_oa.scenario.task_joints import start_positions
from drake_oa.world.fault_obstacles import PARKED_BEYOND, goal_ball
from drake_oa.world.station import make_station
from drake_oa.world.world_model import all_obstacles

GROUND_TRUTH = "perception=!GroundTruth {}"


@pytest.mark.parametrize("start", [0.0, 0.2, 2.0])
def test_the_ball_is_over_the_goal_for_the_time_asked(start: float) -> None:
    goal, away = np.array([0.4, 0.3, 0.2]), [0.0, PARKED_BEYOND, 0.0]
    fault = GoalBlocked(start=start, duration=1.5, radius=0.07)
    ball = goal_ball(fault, np.array([0.4, -0.2, 0.5]), goal, "ball")
    course = np.array(ball.waypoints)
    check_waypoints(ball.waypoints, "waypoints")
    assert ball.translation == goal.tolist()
    for t in (start, start + 0.7, start + 1.5):
        np.testing.assert_array_equal(offset_at(course, t), 0.0)
    np.testing.assert_array_equal(offset_at(course, start + 10.0), away)
    if start >= 0.4:
        np.testing.assert_array_equal(offset_at(course, 0.0), away)


def test_fault_obstacles_follow_those_of_the_scenario() -> None:
    scenario = load_scenario(
        "tabletop_box",
        [
            GROUND_TRUTH,
            "obstacles=[{name: mine, shapes: [!Sphere {}]}]",
            "faults=[!ModelError {}, !GoalBlocked {}, !StartInContact {}]",
        ],
    )
    assert [item.name for item in all_obstacles(scenario)] == ["mine", "fault1", "fault2"]


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["task.start=[0.3, 0.3, 0.4]", "task.goal=[0.5, -0.3, 0.3]"],
        ["task.goal=[0.45, -0.45, 0.5]"],
    ],
)
def test_the_plate_touches_the_tool_at_the_start_and_nothing_else(overrides: list[str]) -> None:
    scenario = load_scenario(
        "tabletop_box", [GROUND_TRUTH, "faults=[!StartInContact {depth: 0.001}]", *overrides]
    )
    assert scenario.robot is not None
    builder = DiagramBuilder()
    station = make_station(builder, scenario, render=False)
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    plant_context = station.plant.GetMyMutableContextFromRoot(root)
    q = start_positions(make_robot_plant(scenario.robot), scenario)
    station.plant.SetPositions(plant_context, station.robot, q)
    query = station.scene_graph.get_query_output_port().Eval(
        station.scene_graph.GetMyContextFromRoot(root)
    )
    hits = query.ComputePointPairPenetration()
    touched = {
        frozenset(
            station.plant.GetBodyFromFrameId(
                station.scene_graph.model_inspector().GetFrameId(geometry)
            ).name()
            for geometry in (hit.id_A, hit.id_B)
        )
        for hit in hits
    }
    assert touched == {frozenset({"panda_hand", "body"})}
    assert max(hit.depth for hit in hits) == pytest.approx(0.001, abs=2e-5)
