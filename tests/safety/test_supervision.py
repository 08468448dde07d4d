"""Tests of the monitors' speed limits, and of the supervisor's action and speed scale."""

import numpy as np
import pytest

from drake_oa.geometry.collision_scene import CollisionScene
from drake_oa.safety.maneuvers import GuardDecision
from drake_oa.safety.supervision import (
    RECOVERY_TIME,
    SpeedLimit,
    Supervision,
    monitor_guard,
    monitor_observation,
    monitor_path,
    monitor_torque,
    supervise,
)

STEP = 0.008


def test_guard_path_and_old_observations_limit_the_speed() -> None:
    for action, scale, reason in (("follow", 1.0, ""), ("slow", 0.3, "near 4, contact in 0.50 s")):
        decision = GuardDecision(action, scale, contact=1.5, obstacle="4")
        limit = monitor_guard(decision, 1.0, is_late=False, has_moving=True)
        assert (limit.scale, limit.reason, limit.is_lasting) == (scale, reason, False)
        assert monitor_guard(decision, 1.0, is_late=True, has_moving=True).scale == 0.0
    assert [monitor_path(d).scale for d in (0.0, 0.02, 0.06, 0.2)] == pytest.approx([1, 1, 0.5, 0])
    scene = CollisionScene(1.0)
    scales = [monitor_observation(scene, 1.0 + x, 0.1, 0.5).scale for x in (0.1, 0.3, 0.5, 0.51)]
    assert scales == pytest.approx([1.0, 0.5, 0.1, 0.0])
    assert monitor_observation(CollisionScene(), 0.0, 0.1, 0.5).scale == 0.0


def test_the_speed_recovers_after_torque_saturation() -> None:
    state, scales = Supervision(), []
    for step in range(60):
        state, limit = monitor_torque(state, step < 40, step * STEP, STEP)
        scales.append(limit.scale)
    assert (scales[12], min(scales)) == (1.0, pytest.approx(0.7**3))
    assert scales[-1] == pytest.approx(0.7**3 + 20 * STEP / RECOVERY_TIME)


def run(
    limit: SpeedLimit, count: int, state: Supervision, begin: float = 0.0, **waiting: bool
) -> list[Supervision]:
    states = [state]
    for step in range(count):
        states.append(supervise(states[-1], [limit], begin + step * STEP, STEP, **waiting))
    return states[1:]


def test_speed_falls_at_once_and_rises_slowly() -> None:
    (hold,) = run(SpeedLimit(0.0, "why", "why, 3 m"), 1, Supervision())
    assert (hold.action, hold.speed_scale, hold.reason) == ("hold", 0.0, "why, 3 m")
    recovery = run(SpeedLimit(), 200, hold, 1.0)
    scales = [state.speed_scale for state in recovery]
    np.testing.assert_allclose(np.diff(scales[:30]), STEP / RECOVERY_TIME)
    slow = [state.action == "slow" for state in recovery]
    assert slow == sorted(slow, reverse=True)
    assert [state.reason for state in recovery] == [is_slow * "why, 3 m" for is_slow in slow]
    # By hysteresis, a hold ends at a higher limit than it started.
    assert run(SpeedLimit(0.2, "why", "why"), 5, hold)[-1].action == "hold"
    assert run(SpeedLimit(0.4, "why", "why"), 5, hold)[-1].action == "slow"


def test_flickering_limits_and_new_causes_are_debounced() -> None:
    state, events = Supervision(), []
    for step in range(250):
        flickering = SpeedLimit(0.9, "near", "near") if step % 2 else SpeedLimit()
        limit = flickering if step < 125 else SpeedLimit(0.4, "two", "two")
        after = supervise(state, [limit], step * STEP, STEP)
        if (after.action, after.cause) != (state.action, state.cause):
            events.append((after.action, after.cause))
        state = after
    assert events == [("slow", "near"), ("slow", "two")]


@pytest.mark.parametrize(
    ("is_lasting", "is_waiting", "action"),
    [(True, False, "stop"), (False, False, "hold"), (True, True, "hold")],
)
def test_a_lasting_hold_becomes_a_stop(is_lasting: bool, is_waiting: bool, action: str) -> None:
    limit = SpeedLimit(0.0, "why", "why", is_lasting)
    hold = run(limit, 400, Supervision(), is_waiting=is_waiting)
    assert hold[-1].action == action
    after = run(SpeedLimit(), 300, hold[-1], 10.0)
    assert (after[0].action, after[-1].action) == ("slow", "run")
