"""Tests of faults: the motion continues, or is held or stopped with a reason in the log.

Scripted observations come from a small source system; all other systems are those of the product.
"""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from drake_oa.common.messages import EllipsoidSet
from drake_oa.diagrams.avoidance import Layers
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from tests.builders import TimeFunctionSource, balls

FRAME = 1.0 / 15.0
AGE, HOLD = 0.5, 0.25
POLICY_STEP = 0.008

PLATE = (
    "obstacles=[{name: plate, shapes: [!Box {size: [0.05, 0.006, 0.03]}], stiffness: 1000, "
    "translation: [0.45, -0.4845, 0.37015]}]"
)
"""Override with a thin soft plate that penetrates the hand at the start by 0.5 mm."""


def blocked_goal(start: float) -> str:
    """Returns an override with a ball that moves to the goal, stays for 2 s and leaves."""
    offsets = [(-0.4, 1.2), (0.0, 0.0), (2.0, 0.0), (2.4, 1.2)]
    waypoints = [[start + t, 0.0, y, 0.0] for t, y in offsets]
    return (
        "obstacles=[{name: ball, shapes: [!Sphere {radius: 0.06}], "
        f"translation: [0.45, 0.45, 0.3], waypoints: {waypoints}}}]"
    )


CASES = {
    "camera stops": ("faults=[!CameraDropout {start: 1, duration: 1}]", "obstacles not seen"),
    "goal blocked": (blocked_goal(1.0), "at its goal the arm would touch"),
    "goal blocked, near it": (blocked_goal(3.5), "at its goal the arm would touch"),
    "start in contact": (PLATE, ""),
}
"""Name of a fault -> override, and expected part of the log."""


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_motion_with_a_fault_reaches_the_goal_without_contact(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    override, logs = CASES[name]
    scenario = load_scenario("tabletop_box", [override])
    log = simulate(scenario)
    report = motion_report(scenario, log)
    assert report["new_contacts"] == []
    assert report["ended"] == MotionEnd.GOAL, report["stop_reason"]
    assert report["goal_error"] <= 1e-3
    if override != PLATE:
        assert report["contacts"] == []
    assert logs in "; ".join((*log.supervision_reason, *log.event, caplog.text))


def free_motion(script: Callable[[float], EllipsoidSet]) -> MotionLog:
    """Simulates `free_space` (x = 0 to 1 m in 5 s) with ellipsoids as a function of frame times."""

    def at(time: float) -> EllipsoidSet:
        return script(FRAME * np.floor(time / FRAME + 1e-9))

    source = TimeFunctionSource(at, "ellipsoids_W")
    layers = replace(Layers(), perception=lambda signals, *_: signals.add("perception", source))
    return simulate(load_scenario("free_space"), layers=layers)


def assert_sound(log: MotionLog) -> None:
    """Checks that all values are finite and the desired motion has no jump."""
    for name in ("q", "v", "torque", "desired_position", "desired_velocity"):
        assert np.isfinite(getattr(log, name)).all(), name
    step = np.linalg.norm(np.diff(log.desired_position, axis=0), axis=1)
    assert step.max(initial=0.0) < 0.02


def test_stale_observation_holds_the_motion_and_a_fresh_one_resumes_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    def stops_for_two_seconds(time: float) -> EllipsoidSet:
        stamp = 22 * FRAME if 1.5 < time < 3.5 else time
        return balls((0.5, 0.02, 0.0), radius=0.12, stamp=stamp)

    with caplog.at_level(logging.WARNING, "drake_oa"):
        log = free_motion(stops_for_two_seconds)
    assert_sound(log)
    held = (log.t > 1.5 + AGE + HOLD + 0.02) & (log.t < 3.5)
    assert not log.desired_velocity[held].any()
    assert np.ptp(log.desired_position[held], axis=0).max() == 0.0
    assert log.event == ("obstacles not seen since t = 1.47 s", "")
    assert "held: obstacles not seen since" in caplog.text
    assert "motion resumed" in caplog.text
    assert log.stop_reason == "goal"
    np.testing.assert_allclose(log.desired_position[-1], [1.0, 0.0, 0.0], atol=1e-3)
    assert np.linalg.norm(log.desired_position - [0.5, 0.02, 0.0], axis=1).min() >= 0.12 + 0.148


@pytest.mark.parametrize(
    ("seen", "why"),
    [
        (EllipsoidSet(note="no valid pixel"), "no observation yet (no valid pixel)"),
        (balls((0.95, 0.0, 0.0), radius=0.12), "goal inside obstacle 0"),
    ],
)
def test_motion_is_held_at_the_start_if_none_is_possible(
    seen: EllipsoidSet, why: str, caplog: pytest.LogCaptureFixture
) -> None:
    def script(time: float) -> EllipsoidSet:
        return replace(seen, stamp=time) if len(seen) else seen

    with caplog.at_level(logging.WARNING, "drake_oa"):
        log = free_motion(script)
    assert log.stop_reason == f"held for 5 s: {why}"
    assert f"held: {why}" in caplog.text
    assert_sound(log)
    # The desired motion comes to rest at the next step of the policy.
    assert not log.desired_velocity[log.t >= HOLD + POLICY_STEP - 1e-9].any()
    assert np.linalg.norm(log.desired_position[-1]) < 0.01
