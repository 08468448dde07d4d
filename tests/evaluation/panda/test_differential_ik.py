"""Tests of the baseline of differential inverse kinematics with collision constraints."""

import numpy as np
import pytest

from drake_oa.evaluation.panda.differential_ik import METHOD, simulate_differential_ik
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.end_poses import follow_joints
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from tests.builders import ball_scene

_BARE = ["directives=[]", "cameras=[]", "perception=!GroundTruth {}"]
_ACROSS = [
    "task.clearance=0.03",
    "task.duration=2.0",
    "task.start=[0.45,-0.2,0.3]",
    "task.goal=[0.45,0.2,0.3]",
]


def scene(*overrides: str) -> Scenario:
    """Returns a scenario with the robot, and nothing else unless overrides add it."""
    return load_scenario("tabletop_box", [*_BARE, *overrides])


def test_follows_the_nominal_motion_without_obstacles_and_repeats_exactly() -> None:
    ends = "task.start=[0.45,-0.15,0.3]", "task.goal=[0.45,0.15,0.3]"
    scenario = scene("task.duration=1.5", *ends)
    log, repeated = simulate_differential_ik(scenario), simulate_differential_ik(scenario)
    assert log.stop_reason == "goal"
    assert log.inference == METHOD
    assert log.duration == pytest.approx(1.5, abs=0.1)
    assert np.linalg.norm(log.p_WE - log.desired_position, axis=1).max() < 1e-3
    assert np.linalg.norm(log.p_WE[-1] - scenario.task.goal) < 6e-4
    assert log.event == ()
    assert not log.saturated.any()
    np.testing.assert_array_equal(log.q, repeated.q)
    np.testing.assert_array_equal(log.torque, repeated.torque)


@pytest.mark.parametrize(("y", "waypoints"), [(0.0, []), (0.3, [[0, 0, 0, 0], [0.5, 0, -0.3, 0]])])
def test_avoids_a_ball_beside_the_line(y: float, waypoints: list[list[float]]) -> None:
    scenario = ball_scene([0.62, y, 0.3], *_BARE, *_ACROSS, radius=0.05, waypoints=waypoints)
    log = simulate_differential_ik(scenario)
    assert robot_metrics(scenario, log.q[::10], log.q_world[::10]).contacts == ()
    assert np.linalg.norm(log.p_WE - log.desired_position, axis=1).max() > 0.01
    assert log.stop_reason == "goal"


def test_tracks_orientation_and_posture_to_the_goal_joints() -> None:
    scenario = scene(
        "task.duration=1.5",
        "task.q_start=[0.0,-0.785,0.0,-2.356,0.0,1.571,0.785]",
        "task.q_goal=[0.3,-0.6,0.2,-2.2,0.1,1.8,1.2]",
    )
    follow_joints(scenario)
    log = simulate_differential_ik(scenario)
    assert log.stop_reason == "goal"
    assert np.linalg.norm(log.orientation_error, axis=1).max() < 0.04
    assert np.linalg.norm(log.orientation_error[-1]) < 2e-3
    assert scenario.task.q_goal is not None
    np.testing.assert_allclose(log.q[-1, :7], scenario.task.q_goal, atol=0.1)
