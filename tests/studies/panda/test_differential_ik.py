"""The peer: differential inverse kinematics with collision constraints on the Panda."""

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.end_poses import follow_joints, start_positions
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.differential_ik import (
    METHOD,
    TOOL_DISTANCE,
    CommandedJoints,
    make_collision_checker,
    simulate_differential_ik,
)

_BARE = ["directives=[]", "cameras=[]", "perception=!GroundTruth {}"]
_ACROSS = ["task.duration=2.0", "task.start=[0.45,-0.2,0.3]", "task.goal=[0.45,0.2,0.3]"]


def scene(*overrides: str) -> Scenario:
    return load_scenario("tabletop_box", [*_BARE, *overrides])


def box(name: str, size: list[float], at: list[float]) -> str:
    return f"{{name: {name}, shapes: [!Box {{size: {size}}}], translation: {at}}}"


def test_follows_the_planned_motion_where_nothing_stands_and_the_same_twice() -> None:
    scenario = scene(
        "task.duration=1.5", "task.start=[0.45,-0.15,0.3]", "task.goal=[0.45,0.15,0.3]"
    )
    log, again = simulate_differential_ik(scenario), simulate_differential_ik(scenario)
    assert log.stop_reason == "goal"
    assert log.regulation == METHOD
    assert log.duration == pytest.approx(1.5, abs=0.1)
    assert np.linalg.norm(log.p_WE - log.desired_position, axis=1).max() < 1e-3
    assert np.linalg.norm(log.p_WE[-1] - scenario.task.goal) < 6e-4
    assert log.event == ()
    assert not log.saturated.any()
    np.testing.assert_array_equal(log.q, again.q)
    np.testing.assert_array_equal(log.torque, again.torque)


@pytest.mark.parametrize(
    "course",
    [
        "translation: [0.62, 0.0, 0.3]",
        "translation: [0.62, 0.3, 0.3], waypoints: [[0, 0, 0, 0], [0.5, 0, -0.3, 0]]",
    ],
)
def test_goes_round_a_ball_beside_the_line(course: str) -> None:
    ball = f"{{name: ball, shapes: [!Sphere {{radius: 0.05}}], {course}}}"
    scenario = scene(*_ACROSS, f"obstacles=[{ball}]")
    log = simulate_differential_ik(scenario)
    assert robot_metrics(scenario, log.q[::10], log.q_world[::10]).contacts == ()
    assert np.linalg.norm(log.p_WE - log.desired_position, axis=1).max() > 0.01
    assert log.stop_reason == "goal"


def test_moves_away_from_an_obstacle_nearer_than_the_tool_keeps() -> None:
    wall = box("wall", [0.3, 0.02, 0.1], [0.45, -0.515, 0.3])
    scenario = scene("task.goal=[0.45,-0.45,0.35]", f"obstacles=[{wall}]")
    log = simulate_differential_ik(scenario, duration=0.3)
    assert log.stop_reason == "time limit of 0.3 s"
    clearance = robot_metrics(scenario, log.q[[0, -1]]).tool_clearance
    assert 0.0 < clearance[0] < TOOL_DISTANCE
    assert clearance[1] > clearance[0] + 1e-3


def test_the_inputs_are_a_pose_ahead_and_the_positions_of_the_world() -> None:
    ball = "{name: ball, shapes: [!Sphere {radius: 0.1}], waypoints: [[0, 0, 0, 0]]}"
    scenario = scene(f"obstacles=[{ball}]")
    checker = make_collision_checker(scenario, tool=0.0, links=0.0, world=0.0, own=0.0)
    plant, q_start = checker.plant(), start_positions(scenario)
    system = CommandedJoints(scenario, plant, q_start)
    context = system.CreateDefaultContext()
    commanded = np.append(q_start + 0.1, np.arange(len(q_start)))
    context.SetDiscreteState(commanded)
    state = np.arange(plant.num_multibody_states(), dtype=float)
    for name, value in (
        ("desired_position", [1.0, 2.0, 3.0]),
        ("desired_velocity", [0.0, -1.0, 2.0]),
        ("desired_orientation", [1.0, 0.0, 0.0, 0.0]),
        ("desired_angular_velocity", [0.0, 0.0, 2.0]),
        ("plant_state", state),
    ):
        system.GetInputPort(name).FixValue(context, value)
    poses = system.GetOutputPort("desired_cartesian_poses").Eval(context)
    X_WE = poses.Find(plant.GetFrameByName("tool_point").scoped_name().get_full())
    ahead = 4.5 * scenario.policy.period
    np.testing.assert_allclose(X_WE.translation(), [1.0, 2.0 - ahead, 3.0 + 2.0 * ahead])
    turned = RollPitchYaw(0.0, 0.0, 2.0 * ahead).ToRotationMatrix()
    np.testing.assert_allclose(X_WE.rotation().matrix(), turned.matrix(), atol=1e-12)
    robot = plant.GetFrameByName("tool_point").model_instance()
    position = system.GetOutputPort("position").Eval(context)
    np.testing.assert_array_equal(plant.GetPositionsFromArray(robot, position), q_start + 0.1)
    assert set(position) - set(q_start + 0.1) <= set(state)
    joints = system.GetOutputPort("desired_joint_state").Eval(context)
    np.testing.assert_array_equal(joints, commanded[[*range(7), *range(9, 16)]])
    posture = system.GetOutputPort("nominal_posture").Eval(context)
    np.testing.assert_array_equal(plant.GetPositionsFromArray(robot, posture), q_start)


def test_turns_the_tool_and_leads_the_posture_to_the_joints_of_the_goal() -> None:
    given = scene(
        "task.duration=1.5",
        "task.q_start=[0.0,-0.785,0.0,-2.356,0.0,1.571,0.785]",
        "task.q_goal=[0.3,-0.6,0.2,-2.2,0.1,1.8,1.2]",
    )
    follow_joints(given)
    log = simulate_differential_ik(given)
    assert log.stop_reason == "goal"
    assert np.linalg.norm(log.orientation_error, axis=1).max() < 0.04
    assert np.linalg.norm(log.orientation_error[-1]) < 2e-3
    assert given.task.q_goal is not None
    np.testing.assert_allclose(log.q[-1, :7], given.task.q_goal, atol=0.1)
