"""A world that changes while the motion is under way, in the whole diagram."""

import logging
from typing import Any

import numpy as np
import pytest

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import DECIDING
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.diagrams.policy import make_dmp
from drake_oa.runs.metrics import path_length, robot_metrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import goal_at

GROUND_TRUTH = "perception=!GroundTruth {}"
QUICK = "regulation=!Paper {}"  # Nothing is searched for.
FRAME = 1.0 / 30.0
STAYS = (
    "obstacles=[{name: box, shapes: [!Box {size: [0.12, 0.1, 0.31]}], "
    "translation: [0.46, 0.0, 0.155]}]"
)
CHANGING = ("sudden_obstacle", "vanishing_obstacle", "moving_goal", "pushed_robot")


def present_box(*present: float) -> str:
    """The box of `vanishing_obstacle`, there at other times."""
    return STAYS[:-2] + f", present: {list(present)}}}]"


def ended_well(report: dict[str, Any]) -> None:
    assert report["contacts"] == []
    assert report["stop_reason"] == "goal"
    assert [event["note"] for event in report["events"]] == [DECIDING, ""]
    assert report["goal_error"] <= 1e-3


# What appears, and what vanishes.


@pytest.fixture(scope="module")
def sudden() -> tuple[Scenario, MotionLog]:
    scenario = load_scenario("sudden_obstacle", [GROUND_TRUTH])
    return scenario, simulate(scenario)


def ahead_when_it_appears(scenario: Scenario, log: MotionLog) -> tuple[float, float]:
    """Distance of the tool point to the box's near face along the motion, and its speed."""
    (box,) = scenario.obstacles
    row = int(np.searchsorted(log.t, box.present[0] - 1e-9))
    assert log.q_world[row - 1, -1] > 10.0
    assert np.abs(log.q_world[row, -3:]).max() < 1e-6
    heading = log.desired_velocity[row] / np.linalg.norm(log.desired_velocity[row])
    np.testing.assert_allclose(heading, [0.0, 1.0, 0.0], atol=1e-6)
    (shape,) = box.shapes
    near_face = box.translation[1] - 0.5 * shape.size[1]
    return near_face - log.p_WE[row, 1], float(np.linalg.norm(log.desired_velocity[row]))


def test_the_box_appears_right_ahead_and_is_gone_round(
    sudden: tuple[Scenario, MotionLog],
) -> None:
    scenario, log = sudden
    distance, speed = ahead_when_it_appears(scenario, log)
    # 0.3 m from the tool point, in the middle of the motion.
    assert distance == pytest.approx(0.3, abs=0.02)
    assert speed > 0.3
    (appears,) = scenario.obstacles[0].present
    assert 0.3 < (log.p_WE[np.searchsorted(log.t, appears), 1] + 0.45) / 0.9 < 0.7
    report = motion_report(scenario, log)
    ended_well(report)
    assert report["supervision"] == []
    assert report["tool_clearance_min"] >= 0.05


def test_it_is_seen_and_gone_round_at_once(sudden: tuple[Scenario, MotionLog]) -> None:
    scenario, log = sudden
    begin = scenario.obstacles[0].present[0]
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
    scenario = load_scenario("vanishing_obstacle", [QUICK, present_box(0.2, 0.5)])
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
        for more in ([], [STAYS])
    )
    assert gone.stop_reason == stays.stop_reason == "goal"
    row = int(np.searchsorted(gone.t, 2.4 - 1e-9))
    np.testing.assert_array_equal(gone.desired_position[:row], stays.desired_position[:row])
    assert gone.duration < stays.duration
    assert path_length(gone.p_WE) < path_length(stays.p_WE)
    scenario = load_scenario("vanishing_obstacle", [GROUND_TRUTH])
    # From when it is gone on, there is nothing to be near to.
    found = robot_metrics(scenario, gone.q[::20], gone.q_world[::20])
    assert found.contacts == ()
    assert np.isinf(found.tool_clearance[gone.t[::20] > 2.4]).all()


# A goal that moves.


@pytest.mark.parametrize("modulated", [False, True])
def test_a_motion_goes_on_to_where_the_goal_is_moved(modulated: bool) -> None:
    moves = ["task.goal_moves=[[2.5, 1.0, 0.2, 0.0]]", "perception=!GivenEllipsoids {}"]
    scenario = load_scenario("free_space", moves)
    log = simulate(scenario, modulated=modulated)
    assert log.stop_reason == "goal"
    for row, goal in enumerate(log.goal):
        np.testing.assert_array_equal(goal, goal_at(scenario.task, log.t[row]))
    assert motion_report(scenario, log)["goal_error"] <= 1e-3
    if not modulated:
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


def test_a_goal_that_is_moved_out_of_reach_is_refused() -> None:
    scenario = load_scenario("moving_goal", [GROUND_TRUTH, "task.goal_moves=[[2, 1.5, 0, 0.3]]"])
    with pytest.raises(ScenarioError, match=r"task\.goal_moves\[0\]: "):
        build_avoidance(scenario)


# A push.


def test_a_push_is_recovered_from() -> None:
    push = "faults=[!Push {start: 0.2, force: [0.0, 0.0, -20.0]}]"
    scenario = load_scenario("pushed_robot", [GROUND_TRUTH, QUICK, push])
    log = simulate(scenario, duration=1.4)
    before, after = log.tracking_error[log.t < 0.2], log.tracking_error[log.t > 1.2]
    assert 0.003 < log.tracking_error.max() < 0.015
    assert 0.2 < log.t[log.tracking_error.argmax()] < 0.5
    assert before.max() < 1e-3
    assert after.max() < 1e-3
    assert log.supervision_action == ()
    # It gives way downwards.
    row = log.tracking_error.argmax()
    assert (log.p_WE - log.desired_position)[row, 2] < -0.003


def test_a_hard_push_slows_the_motion_and_is_said() -> None:
    push = "faults=[!Push {start: 0.2, force: [0.0, 0.0, 120.0]}]"
    log = simulate(load_scenario("pushed_robot", [GROUND_TRUTH, QUICK, push]), duration=2.4)
    assert log.supervision_action[0] in ("slow", "hold")
    assert "tracking error" in log.supervision_reason[0]
    assert log.supervision_action[-1] == "run"
    assert log.tracking_error[-1] < 1e-3


def test_a_push_of_a_link_that_is_not_there_is_refused() -> None:
    scenario = load_scenario("pushed_robot", [GROUND_TRUTH, "faults=[!Push {body: tail}]"])
    with pytest.raises(ScenarioError, match=r"faults\[0\]\.body: the robot has no link 'tail'"):
        build_avoidance(scenario)


# All of them, from depth.


@pytest.mark.slow
@pytest.mark.parametrize("name", CHANGING)
def test_each_change_is_coped_with_from_depth(name: str) -> None:
    scenario = load_scenario(name)
    log = simulate(scenario)
    report = motion_report(scenario, log)
    ended_well(report)
    assert report["supervision"] == []
    if name == "sudden_obstacle":
        distance, _ = ahead_when_it_appears(scenario, log)
        assert distance == pytest.approx(0.3, abs=0.02)
        assert report["tool_clearance_min"] >= 0.05
    elif name != "vanishing_obstacle":
        assert report["tool_clearance_min"] >= scenario.task.clearance


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "overrides"),
    [
        ("[0.45, 0.45, 0.3]", []),
        ("[0.45, 0.35, 0.5]", ["task.goal_moves=[[2.0, 0.45, 0.35, 0.5]]"]),
    ],
)
def test_an_obstacle_that_stands_at_the_goal_is_waited_for_from_depth(
    place: str, overrides: list[str]
) -> None:
    """A goal inside an obstacle that later leaves, and one that is moved into an obstacle."""
    ball = f"{{name: ball, shapes: [!Sphere {{radius: 0.06}}], translation: {place}"
    scenario = load_scenario(
        "vanishing_obstacle", [f"obstacles=[{ball}, present: [0.0, 4.0]}}]", *overrides]
    )
    log = simulate(scenario)
    report = motion_report(scenario, log)
    assert report["contacts"] == []
    assert report["stop_reason"] == "goal"
    assert report["goal_error"] <= 1e-3
    assert any("would touch obstacle" in note for note in log.event)
    assert log.event[-1] == ""
    waited = [row for row, note in enumerate(log.event) if "would touch obstacle" in note]
    assert 4.0 < log.event_time[waited[-1] + 1] < 4.5
