"""World that changes during the motion, in the whole diagram."""

import logging

import numpy as np
import pytest

from drake_oa.diagrams.motion import make_dmp
from drake_oa.geometry.shapes import Sphere
from drake_oa.runs.metrics import path_length, robot_metrics
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import AT_GOAL, REST_TIME, simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.task import goal_at
from drake_oa.studies.panda.evaluation import run_and_judge
from drake_oa.studies.panda.scenes import draw_panda_scene

GROUND_TRUTH = "perception=!GroundTruth {}"
QUICK = "regulation=!Paper {}"  # Nothing is searched for.
FRAME = 1.0 / 30.0
BOX = "name: box, shapes: [!Box {size: [0.12, 0.1, 0.31]}], translation: [0.46, 0.0, 0.155]"


# What appears, and what vanishes.


def test_a_box_that_appears_is_seen_at_once_and_avoided() -> None:
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
    bent = log.t[np.argmax(turning & (log.t > begin))]
    # Ground truth and decisions have 15 frames a second.
    assert begin <= first <= begin + 2.0 * FRAME + 0.01
    assert first <= bent <= first + 2.0 * FRAME + 0.02
    assert not log.v_WO[seen].any()


def test_what_appears_is_seen_at_rest_and_forgotten_when_it_is_gone() -> None:
    """From depth, 0.03 s late, while the arm stands beside it."""
    scenario = load_scenario(
        "vanishing_obstacle", [QUICK, f"obstacles=[{{{BOX}, present: [0.2, 0.5]}}]"]
    )
    log = simulate(scenario, duration=0.75)
    seen = np.isfinite(log.p_WO).all(axis=2)
    there = seen.any(axis=1)
    stamps = log.observation_stamp[there]
    assert 0.2 - 1e-9 <= stamps.min() <= 0.2 + 2.0 * FRAME
    assert stamps.max() <= 0.5 + 2.0 * FRAME
    assert log.observation_time[there].min() <= 0.2 + 3.0 * FRAME + 0.03
    assert log.observation_time[~there & (log.observation_stamp > 0.4)].min() <= 0.6 + FRAME
    assert (seen.sum(axis=1) <= 1).all()
    assert len(np.unique(log.obstacle_id[seen])) == 1
    assert not log.v_WO[seen].any()


@pytest.mark.slow
def test_the_motion_relaxes_when_the_obstacle_is_gone() -> None:
    gone, stays = (
        simulate(load_scenario("vanishing_obstacle", [GROUND_TRUTH, *more]))
        for more in ([], [f"obstacles=[{{{BOX}}}]"])
    )
    row = int(np.searchsorted(gone.t, 2.4 - 1e-9))
    np.testing.assert_array_equal(gone.desired_position[:row], stays.desired_position[:row])
    assert gone.duration < stays.duration
    assert path_length(gone.p_WE) < path_length(stays.p_WE)


# A goal that moves.


def test_a_motion_continues_to_where_the_goal_is_moved() -> None:
    moves = ["task.goal_moves=[[2.5, 1.0, 0.2, 0.0]]", "perception=!GivenEllipsoids {}"]
    scenario = load_scenario("free_space", moves)
    log = simulate(scenario, modulated=False)
    assert log.stop_reason == "goal"
    for row, goal in enumerate(log.goal):
        np.testing.assert_array_equal(goal, goal_at(scenario.task, log.t[row]))
    # The velocity is continuous; the spring answers d by a = alpha beta d / (tau T)^2.
    dmp = make_dmp(scenario)
    most = 1.2 * dmp.alpha_x * dmp.beta_x * 0.2 / dmp.duration**2
    assert np.linalg.norm(log.desired_acceleration, axis=1).max() < most
    jump = np.linalg.norm(np.diff(log.desired_velocity, axis=0), axis=1)
    assert jump.max() < most * 0.0041


def test_a_motion_that_has_arrived_waits_for_the_last_move() -> None:
    moves = "[[8.0, 1.0, 0.2, 0.0], [20.0, 1.0, 0.0, 0.0]]"
    log = simulate(load_scenario("free_space", [f"task.goal_moves={moves}"]))
    assert log.stop_reason == "goal"
    assert log.duration > 20.5
    for time, goal in ((7.9, [1.0, 0.0, 0.0]), (19.9, [1.0, 0.2, 0.0]), (99.0, [1.0, 0.0, 0.0])):
        row = min(int(np.searchsorted(log.t, time)), len(log.t) - 1)
        np.testing.assert_allclose(log.p_WE[row], goal, atol=1e-3)


def test_a_goal_moved_into_an_obstacle_is_waited_for(caplog: pytest.LogCaptureFixture) -> None:
    ellipsoid = load_scenario("free_space").perception.ellipsoids[0]  # type: ignore[union-attr]
    inside = ", ".join(map(str, ellipsoid.center))
    moves = f"[[0.5, {inside}], [3.0, 1.0, 0.0, 0.2]]"
    with caplog.at_level(logging.WARNING, logger="drake_oa"):
        log = simulate(load_scenario("free_space", [f"task.goal_moves={moves}"]))
    assert log.stop_reason == "goal"
    said = list(zip(log.event_time.round(1).tolist(), log.event, strict=True))
    assert [when for when, _ in said] == [0.5, 3.0]
    assert said[0][1].startswith("goal inside obstacle")
    assert said[1][1] == ""
    held = (log.t > 0.9) & (log.t < 2.95)
    assert np.linalg.norm(log.desired_velocity[held], axis=1).max() < 1e-9
    np.testing.assert_allclose(log.p_WE[-1], [1.0, 0.0, 0.2], atol=1e-3)
    assert sum("goal inside obstacle" in record.message for record in caplog.records) == 1


# A push.


def test_a_hard_push_slows_the_motion_and_is_said() -> None:
    push = "faults=[!Push {start: 0.2, force: [0.0, 0.0, 120.0]}]"
    log = simulate(load_scenario("pushed_robot", [GROUND_TRUTH, push]), duration=4.0)
    assert log.supervision_action[0] == "hold"
    assert log.supervision_action[-1] == "run"
    assert log.tracking_error[-1] < 1e-3


# Moving obstacles.


@pytest.mark.slow
def test_what_is_faster_than_the_arm_is_told_and_its_contacts_count(
    caplog: pytest.LogCaptureFixture,
) -> None:
    scenario = load_scenario("moving_obstacle", [GROUND_TRUTH])
    # At the shoulder, which cannot leave.
    ahead = np.array([1.2, 0.3, 0.45])
    way = np.array([0.0, 0.0, 0.45]) - ahead
    time = float(np.linalg.norm(way)) / 2.5
    scenario.obstacles = [
        Obstacle(
            name="fast",
            shapes=[Sphere(radius=0.05)],
            translation=ahead.tolist(),
            waypoints=[[1.0, 0.0, 0.0, 0.0], [1.0 + time, *way.tolist()]],
        )
    ]
    log = simulate(scenario)
    assert "supervisor holds: evades obstacle 0" in caplog.text
    assert "contact: panda_joint" in caplog.text
    # The run goes on past the prediction, until the ball has arrived and all is at rest.
    assert log.simulated_time > 1.0 + time + REST_TIME
    found = robot_metrics(scenario, log.q, log.q_world)
    assert any(contact.startswith("panda_link2 - ") for contact in found.contacts)
    assert found.robot_clearance.min() < 0.0


@pytest.mark.slow
def test_what_comes_to_the_goal_after_the_arm_counts() -> None:
    scenario = load_scenario("tabletop_box", [GROUND_TRUTH])
    scenario.obstacles = [
        Obstacle(
            name="late",
            shapes=[Sphere(radius=0.08)],
            translation=[0.45, 1.2, 0.3],
            waypoints=[[8.0, 0.0, 0.0, 0.0], [8.8, 0.0, -0.75, 0.0]],
        )
    ]
    log = simulate(scenario)
    assert log.motion_end < 8.0
    assert log.simulated_time >= 8.8 + REST_TIME
    # It has to leave, and the ball stays.
    assert log.stop_reason.startswith("goal left by")
    assert motion_report(scenario, log)["goal_error"] > AT_GOAL


@pytest.mark.slow
@pytest.mark.parametrize("number", [38, 67])
def test_a_moving_ball_is_evaded_by_the_whole_arm(number: int) -> None:
    # 38: no displacement of the tool alone keeps link 4 off it. 67: link 5 is held beside it
    # where it came to rest, and no motion from there lets the arm by.
    result = run_and_judge(draw_panda_scene(0, number, kind="moving"), "verified", "depth").result
    assert result["outcome"] == "success"
    assert result["contacts"] == []
