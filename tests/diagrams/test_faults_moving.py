"""Faults among moving obstacles: no link moves into one, and the arm arrives or rests."""

from dataclasses import dataclass

import numpy as np
import pytest

from drake_oa.runs.metrics import clearance_evaluator
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from tests.diagrams.fault_systems import (
    Customize,
    late_observations,
    nan_clouds,
    nan_solids,
    raised_table,
)

GROUND_TRUTH = "perception=!GroundTruth {}"
AT_REST, APPROACH = 0.05, 0.02
"""Joint speed of an arm at rest [rad/s], and speed at which a link moves into an obstacle [m/s]."""
SAFE = (MotionEnd.STOPPED, MotionEnd.HELD)


@dataclass(frozen=True)
class Case:
    """A fault by overrides or a system, how its motion may end, and part of the log."""

    overrides: tuple[str, ...] = (GROUND_TRUTH,)
    customize: Customize | None = None
    ends: tuple[MotionEnd, ...] = (MotionEnd.GOAL,)
    told: str = "evades obstacle"


def dropouts(*starts: float, duration: float) -> str:
    faults = ", ".join(f"!CameraDropout {{start: {t}, duration: {duration}}}" for t in starts)
    return f"faults=[{faults}]"


UNSEEN = "obstacles not seen"
CASES = {
    "dropped frames": Case(
        (dropouts(*np.arange(0.4, 8.0, 0.4).round(1), duration=0.2),), told="no new image"
    ),
    "a camera that dies": Case((dropouts(1.0, duration=1000.0),), None, SAFE, UNSEEN),
    "late images": Case(customize=late_observations(0.2), told=UNSEEN),
    "a step in the table's height": Case(
        customize=raised_table(1.5, 0.3), ends=SAFE, told="brakes for an obstacle"
    ),
    "solids with NaN": Case(customize=nan_solids(1.0, 2.0), told="the solids are not finite"),
    "obstacle data with NaN": Case((), nan_clouds(1.0, 2.0), told="obstacles_W holds what is not"),
}


def approach_at_contacts(scenario: Scenario, log: MotionLog) -> list[float]:
    """Returns the speeds [m/s] at which the robot moves towards what comes to touch it.

    They are the decrease of the least distance by the robot's own motion, the obstacles being
    where they were, in the log's interval before each contact.
    """
    evaluator = clearance_evaluator(scenario)
    distance = evaluator.metrics(log.q, log.q_world).robot_clearance
    rows = np.flatnonzero((distance[1:] <= 0.0) & (distance[:-1] > 0.0))
    moved = evaluator.metrics(log.q[rows + 1], log.q_world[rows]).robot_clearance
    return ((distance[rows] - moved) / (log.t[rows + 1] - log.t[rows])).tolist()


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_no_link_moves_into_a_moving_obstacle(name: str, caplog: pytest.LogCaptureFixture) -> None:
    case = CASES[name]
    scenario = load_scenario("moving_obstacle", list(case.overrides))
    log = simulate(scenario, customize=case.customize)
    report = motion_report(scenario, log)
    for key in ("q", "v", "torque", "desired_position", "desired_velocity"):
        assert np.isfinite(getattr(log, key)).all(), key
    assert max(approach_at_contacts(scenario, log), default=0.0) <= APPROACH
    assert case.told in "; ".join((*log.supervision_reason, *log.event, caplog.text))
    assert report["ended"] in case.ends, report["stop_reason"]
    if report["ended"] == MotionEnd.GOAL:
        assert report["goal_error"] <= 1e-3
    assert np.abs(log.v[-1]).max() <= AT_REST
