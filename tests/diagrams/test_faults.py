"""Faults: a motion that goes on, or is brought to rest and says why; bad input: a clear error.

Observations are switched by small source systems and frames by those of `fault_systems`;
everything behind them is real.
"""

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.framework import Context, LeafSystem, State

from drake_oa.common.messages import (
    EllipsoidSet,
    TablePlane,
)
from drake_oa.diagrams.avoidance import Layers
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from tests.builders import balls
from tests.diagrams.fault_systems import nan_frames

GROUND_TRUTH = "perception=!GroundTruth {}"
QUICK = "inference=!Paper {}"  # Nothing is searched for.
FRAME = 1.0 / 15.0
AGE, HOLD = 0.5, 0.25
POLICY_STEP = 0.008

# Whole runs of `tabletop_box`, each with one fault.

UNSEEN = "obstacles not seen"
PLATE = (
    "obstacles=[{name: plate, shapes: [!Box {size: [0.05, 0.006, 0.03]}], stiffness: 1000, "
    "translation: [0.45, -0.4845, 0.37015]}]"
)
"""A thin soft plate that touches the hand, where it starts, from behind by 0.5 mm."""


def blocked_goal(start: float) -> str:
    """A ball that comes from beyond the goal, stays over it for 2 s and leaves again."""
    course = [(-0.4, 1.2), (0.0, 0.0), (2.0, 0.0), (2.4, 1.2)]
    waypoints = [[start + t, 0.0, y, 0.0] for t, y in course]
    return (
        "obstacles=[{name: ball, shapes: [!Sphere {radius: 0.06}], "
        f"translation: [0.45, 0.45, 0.3], waypoints: {waypoints}}}]"
    )


CASES = {
    "camera stops": ("faults=[!CameraDropout {start: 1, duration: 1}]", None, UNSEEN),
    "frames of NaN": ("seed=0", nan_frames(1.0, 2.0), UNSEEN),
    "goal blocked": (blocked_goal(1.0), None, "at its goal the arm would touch"),
    "goal blocked, near it": (blocked_goal(3.5), None, "at its goal the arm would touch"),
    "start in contact": (PLATE, None, ""),
}
"""Override, system, and part of the log."""


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_each_fault_ends_as_it_should_without_a_contact(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    override, customize, told = CASES[name]
    scenario = load_scenario("tabletop_box", [override])
    if customize is not None:
        # Only of frames that come as they are taken is the time known at which they change.
        scenario.cameras[0].output_delay = 0.0
    log = simulate(scenario, customize=customize)
    report = motion_report(scenario, log)
    assert report["new_contacts"] == []
    assert report["ended"] == MotionEnd.GOAL, report["stop_reason"]
    assert report["goal_error"] <= 1e-3
    if override != PLATE:
        assert report["contacts"] == []
    assert told in "; ".join((*log.supervision_reason, *log.event, caplog.text))


# Observations that a source system switches.


class Scripted(LeafSystem):
    """One abstract output `name` that is a function of time, as a source that looks every frame."""

    def __init__(self, name: str, script: Callable[[float], object], model: object) -> None:
        super().__init__()
        self._script = script
        self._seen = self.DeclareAbstractState(Value(model))
        self.DeclareStateOutputPort(name, self._seen)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._look)
        self.DeclarePeriodicUnrestrictedUpdateEvent(FRAME, 0.0, self._look)

    def _look(self, context: Context, state: State) -> None:
        seen = self._script(context.get_time())
        state.get_mutable_abstract_state(self._seen).set_value(seen)


def seen_by(source: LeafSystem) -> Layers:
    """The layers, with a perception source of one's own."""
    return replace(Layers(), perception=lambda signals, *_: signals.add("perception", source))


@pytest.fixture
def free_motion() -> Callable[..., MotionLog]:
    """Runs `free_space` (from x = 0 to x = 1 m in 5 s) on scripted ellipsoids."""

    def run(script: Callable[[float], EllipsoidSet], *overrides: str, **options: object) -> object:
        source = Scripted("ellipsoids_W", script, EllipsoidSet())
        scenario = load_scenario("free_space", list(overrides))
        return simulate(scenario, layers=seen_by(source), **options)

    return run


def assert_sound(log: MotionLog) -> None:
    """No number that is not finite, and no jump of the desired motion."""
    for name in ("q", "v", "torque", "desired_position", "desired_velocity"):
        assert np.isfinite(getattr(log, name)).all(), name
    step = np.linalg.norm(np.diff(log.desired_position, axis=0), axis=1)
    assert step.max(initial=0.0) < 0.02


def test_a_stale_observation_holds_the_motion_on_its_path_and_a_fresh_one_resumes_it(
    free_motion: Callable[..., MotionLog], caplog: pytest.LogCaptureFixture
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
    ("seen", "overrides", "why"),
    [
        (EllipsoidSet(note="no valid pixel"), [], "no observation yet (no valid pixel)"),
        (balls((0.05, 0.0, 0.0), radius=0.12), [], "tool inside obstacle 0"),
        (balls((0.95, 0.0, 0.0), radius=0.12), [], "goal inside obstacle 0"),
        # An obstacle so big that any way past it is far outside the table's height.
        (
            balls((0.5, 0.0, 0.0), radius=0.12, table=TablePlane(offset=5.0)),
            [QUICK],
            "every side of obstacle 0 is forbidden",
        ),
    ],
)
def test_where_no_motion_is_possible_the_start_is_held(
    seen: EllipsoidSet,
    overrides: list[str],
    why: str,
    free_motion: Callable[..., MotionLog],
    caplog: pytest.LogCaptureFixture,
) -> None:
    def script(time: float) -> EllipsoidSet:
        return replace(seen, stamp=time) if len(seen) else seen

    with caplog.at_level(logging.WARNING, "drake_oa"):
        log = free_motion(script, *overrides)
    assert log.stop_reason == f"held for 5 s: {why}"
    assert f"held: {why}" in caplog.text
    assert_sound(log)
    # The desired motion comes to rest at the policy's first step after.
    assert not log.desired_velocity[log.t >= HOLD + POLICY_STEP - 1e-9].any()
    assert np.linalg.norm(log.desired_position[-1]) < 0.01
