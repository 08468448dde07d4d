"""Tests of the whole diagram in a world that changes during the motion."""

import numpy as np
import pytest

from drake_oa.diagrams.motion import make_dmp
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import AT_GOAL, MAX_HOLD_TIME, simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.task import goal_at
from tests.builders import ball_scene

GROUND_TRUTH = "perception=!GroundTruth {}"
FRAME = 1.0 / 30.0


def test_appearing_box_is_perceived_at_once_and_avoided() -> None:
    scenario = load_scenario("sudden_obstacle", [GROUND_TRUTH])
    log = simulate(scenario)
    (box,) = scenario.obstacles
    begin = box.present[0]
    row = int(np.searchsorted(log.t, begin - 1e-9))
    assert log.q_world[row - 1, -1] > 10.0
    assert np.abs(log.q_world[row, -3:]).max() < 1e-6
    # 0.3 m ahead of the tool point, in the middle of a fast motion.
    near_face = box.translation[1] - 0.5 * box.shapes[0].size[1]
    assert near_face - log.p_WE[row, 1] == pytest.approx(0.3, abs=0.02)
    assert np.linalg.norm(log.desired_velocity[row]) > 0.3
    report = motion_report(scenario, log)
    assert report["stop_reason"] == "goal"
    assert report["contacts"] == []
    seen = np.isfinite(log.p_WO).all(axis=2).any(axis=1)
    first = log.observation_time[np.argmax(seen)]
    turning = np.linalg.norm(log.desired_acceleration, axis=1) > 1.0
    turn_time = log.t[np.argmax(turning & (log.t > begin))]
    # Ground truth and decisions have 15 frames a second.
    assert begin <= first <= begin + 2.0 * FRAME + 0.01
    assert first <= turn_time <= first + 2.0 * FRAME + 0.02
    assert not log.v_WO[seen].any()


def test_motion_follows_a_moving_goal() -> None:
    moves = ["task.goal_moves=[[2.5, 1.0, 0.2, 0.0]]", "perception=!GivenEllipsoids {}"]
    scenario = load_scenario("free_space", moves)
    log = simulate(scenario, avoid_obstacles=False)
    assert log.stop_reason == "goal"
    for row, goal in enumerate(log.goal):
        np.testing.assert_array_equal(goal, goal_at(scenario.task, log.t[row]))
    # The velocity is continuous; the spring answers d by a = alpha beta d / (tau T)^2.
    dmp = make_dmp(scenario)
    max_acceleration = 1.2 * dmp.alpha_x * dmp.beta_x * 0.2 / dmp.duration**2
    assert np.linalg.norm(log.desired_acceleration, axis=1).max() < max_acceleration
    jump = np.linalg.norm(np.diff(log.desired_velocity, axis=0), axis=1)
    assert jump.max() < max_acceleration * 0.0041


def test_hard_push_holds_the_motion_and_is_logged() -> None:
    push = "faults=[!Push {start: 0.2, force: [0.0, 0.0, 120.0]}]"
    log = simulate(load_scenario("pushed_robot", [GROUND_TRUTH, push]), duration=4.0)
    assert log.supervision_action[0] == "hold"
    assert log.supervision_action[-1] == "run"
    assert log.tracking_error[-1] < 1e-3


@pytest.mark.slow
def test_obstacle_that_arrives_at_the_goal_later_ends_the_success() -> None:
    waypoints = [[8.0, 0.0, 0.0, 0.0], [8.8, 0.0, -0.75, 0.0]]
    scenario = ball_scene([0.45, 1.2, 0.3], radius=0.08, waypoints=waypoints)
    log = simulate(scenario)
    assert log.motion_end < 8.0
    assert log.simulated_time >= 8.8 + MAX_HOLD_TIME
    # The arm has to leave the goal, as the ball stays there.
    assert log.stop_reason.startswith("goal left by")
    assert motion_report(scenario, log)["goal_error"] > AT_GOAL
