"""Contacts and clearances of logged motions."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.messages import EllipsoidSet, FloatArray
from drake_oa.robot.arm import solve_tool_pose
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.runs.metrics import free_point_metrics, robot_metrics
from drake_oa.runs.report import achievable_clearance_of
from drake_oa.scenario.loading import load_scenario
from tests.builders import ball_scene, balls


@pytest.mark.parametrize(
    ("x", "is_initial", "is_new"),
    [
        ([0.0, 0.3, 0.5], False, True),
        ([0.5, 0.0, 0.5], True, True),
        ([0.5], True, False),
        ([], False, False),
    ],
)
def test_initial_contacts_are_separate_from_new_contacts(
    x: list[float], is_initial: bool, is_new: bool
) -> None:
    path = np.column_stack([x, np.zeros((len(x), 2))])
    found = free_point_metrics(path, balls((0.5, 0.0, 0.0), ids=[10]))
    name = ("tool point - ellipsoid 10",)
    assert found.initial_contacts == (name if is_initial else ())
    assert found.new_contacts == (name if is_new else ())
    assert found.contacts == (name if is_initial or is_new else ())


@pytest.fixture(scope="module")
def poses() -> dict[str, FloatArray]:
    """Positions of the robot with the tool beside the box, in the box, and in the table."""
    robot = Robot()
    arm, seed, down = make_robot_plant(robot), home_positions(robot), RollPitchYaw(robot.rpy_WE)
    places = {"start": [-0.45, 0.3], "inside": [0.0, 0.15], "table": [-0.45, -0.02]}
    return {
        name: solve_tool_pose(arm.plant, arm.tool_frame.name(), RigidTransform(down, p_WE), seed)
        for name, p_WE in ((name, [0.45, *yz]) for name, yz in places.items())
    }


def test_scene_graph_measures_clearances_and_contacts(poses: dict[str, FloatArray]) -> None:
    scenario = load_scenario("tabletop_box", ["perception=!GroundTruth {}"])
    found = robot_metrics(scenario, np.stack([poses["start"], poses["inside"], poses["table"]]))
    np.testing.assert_allclose(found.p_WE[0], [0.45, -0.45, 0.3], atol=1e-6)
    assert found.tool_clearance[0] > 0.2
    assert found.tool_clearance[1] < 0.0
    assert found.tool_clearance[2] > 0.0
    assert (found.robot_clearance <= found.tool_clearance).all()
    assert any(name.endswith("obstacle_box") for name in found.contacts)
    assert any("table" in name for name in found.new_contacts)


def test_self_contacts_are_separate_from_contacts(poses: dict[str, FloatArray]) -> None:
    folded = np.r_[0.0, 0.0, 0.0, -1.6, 0.0, -0.0175, 0.785, 0.02, 0.02]
    found = robot_metrics(load_scenario("tabletop_box"), np.stack([poses["start"], folded]))
    assert found.self_contacts == ("panda_hand - panda_link5",)
    assert found.contacts == ()


def test_resting_clearance_excludes_moving_obstacles(poses: dict[str, FloatArray]) -> None:
    alone = robot_metrics(load_scenario("tabletop_box"), poses["start"][None])
    assert alone.resting_clearance[0] == alone.tool_clearance[0]
    scenario = ball_scene([0.45, -0.65, 0.3], radius=0.02, waypoints=[[1.0, 0.0, 0.0, 0.0]])
    both = robot_metrics(scenario, poses["start"][None])
    assert both.resting_clearance[0] == alone.tool_clearance[0]
    assert both.tool_clearance[0] < alone.tool_clearance[0]
    # The achievable clearance depends on resting obstacles only.
    assert achievable_clearance_of(scenario) == pytest.approx(scenario.task.clearance)
    scenario.task.clearance = 1.0
    assert achievable_clearance_of(scenario) <= both.resting_clearance[0]


def test_clearance_is_infinite_without_obstacles(poses: dict[str, FloatArray]) -> None:
    scenario = load_scenario(
        "tabletop_box", ["directives=[]", "perception=!GroundTruth {}", "cameras=[]"]
    )
    found = robot_metrics(scenario, poses["start"][None])
    assert np.isinf(found.robot_clearance).all()
    assert np.isinf(free_point_metrics(np.zeros((3, 3)), EllipsoidSet()).tool_clearance).all()
    assert robot_metrics(scenario, np.zeros((0, 9))).p_WE.shape == (0, 3)


def test_metrics_use_the_world_positions_of_the_log(poses: dict[str, FloatArray]) -> None:
    scenario = load_scenario("tabletop_box", ["perception=!GroundTruth {}"])
    q = poses["start"][None]
    alone = robot_metrics(scenario, q)
    # Only the robot moves in this world: its positions are those of the world.
    for q_world in (np.zeros((1, 0)), q):
        same = robot_metrics(scenario, q, q_world)
        np.testing.assert_array_equal(same.robot_clearance, alone.robot_clearance)
    with pytest.raises(ValueError, match=r"q_world: shape \(1, 3\) must be \(1, 9\)"):
        robot_metrics(scenario, q, np.zeros((1, 3)))
