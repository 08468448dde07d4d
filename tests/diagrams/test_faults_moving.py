"""Tests of faults among moving obstacles: no link moves into an obstacle."""

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
    delayed_observations,
    nan_clouds,
    nan_geometries,
    raised_table,
)

GROUND_TRUTH = "perception=!GroundTruth {}"
AT_REST = 0.05
"""Maximum joint speed of an arm at rest [rad/s]."""
APPROACH = 0.02
"""Maximum speed of a link toward an obstacle at a contact [m/s]."""
SAFE = (MotionEnd.STOPPED, MotionEnd.HELD)
"""Ends of a motion that a fault prevents from reaching the goal."""


@dataclass(frozen=True)
class Case:
    """Fault by overrides or an inserted system, accepted ends, and expected part of the log."""

    overrides: tuple[str, ...] = (GROUND_TRUTH,)
    customize: Customize | None = None
    ends: tuple[MotionEnd, ...] = (MotionEnd.GOAL,)
    logs: str = "evades obstacle"


def dropouts(*starts: float, duration: float) -> str:
    """Returns an override with camera dropouts at start times [s]."""
    faults = ", ".join(f"!CameraDropout {{start: {t}, duration: {duration}}}" for t in starts)
    return f"faults=[{faults}]"


UNSEEN = "obstacles not seen"
CASES = {
    "dropped frames": Case(
        (dropouts(*np.arange(0.4, 8.0, 0.4).round(1), duration=0.2),), logs="no new image"
    ),
    "a camera stops for good": Case((dropouts(1.0, duration=1000.0),), None, SAFE, UNSEEN),
    "delayed observations": Case(customize=delayed_observations(0.2), logs=UNSEEN),
    "a raised table": Case(customize=raised_table(1.5, 0.3), ends=SAFE, logs="contact with table"),
    "collision scene with NaN": Case(
        customize=nan_geometries(1.0, 2.0), logs="the collision scene is not finite"
    ),
    "obstacle data with NaN": Case((), nan_clouds(1.0, 2.0), logs="obstacles_W is not finite"),
}


def approach_at_contacts(scenario: Scenario, log: MotionLog) -> list[float]:
    """Computes the robot's speeds toward obstacles at the beginning of contacts [m/s].

    A speed is the decrease of the minimum distance in the logged interval before the contact, due
    to the robot's motion alone: with the obstacles at their previous positions.
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
    assert case.logs in "; ".join((*log.supervision_reason, *log.event, caplog.text))
    assert report["ended"] in case.ends, report["stop_reason"]
    if report["ended"] == MotionEnd.GOAL:
        assert report["goal_error"] <= 1e-3
    assert np.abs(log.v[-1]).max() <= AT_REST
