"""What the supervisor demands and decides."""

import numpy as np
import pytest

from drake_oa.geometry.solids import SolidScene
from drake_oa.safety.maneuvers import GuardDecision
from drake_oa.safety.supervision import (
    RECOVERY_TIME,
    Demand,
    Supervision,
    supervise,
    watch_guard,
    watch_observation,
    watch_path,
    watch_torque,
)

STEP = 0.008


# Watches.


@pytest.mark.parametrize(
    ("action", "scale", "reason"),
    [
        ("follow", 1.0, ""),
        ("slow", 0.3, "near obstacle 4, contact in 0.50 s"),
        ("wait", 0.0, "waits for obstacle 4, contact in 0.50 s"),
        ("evade", 0.0, "evades obstacle 4, contact in 0.50 s"),
    ],
)
def test_the_phase_runs_as_the_guard_decides(action: str, scale: float, reason: str) -> None:
    decision = GuardDecision(action, scale, contact=1.5, obstacle="obstacle 4")
    demand = watch_guard(decision, 1.0, late=False, moves=True)
    assert (demand.scale, demand.reason, demand.lasting) == (scale, reason, False)
    assert watch_guard(decision, 1.0, late=True, moves=True).scale == 0.0


@pytest.mark.parametrize(("distance", "scale"), [(0.0, 1.0), (0.02, 1.0), (0.06, 0.5), (0.2, 0.0)])
def test_the_distance_from_the_path_slows(distance: float, scale: float) -> None:
    assert watch_path(distance).scale == pytest.approx(scale)


@pytest.mark.parametrize(
    ("age", "scale"),
    [(0.0, 1.0), (2.4 / 15.0, 1.0), ((2.5 / 15.0 + 0.5) / 2.0, 0.5), (0.5, 0.1), (0.51, 0.0)],
)
def test_an_old_observation_slows(age: float, scale: float) -> None:
    demand = watch_observation(SolidScene(1.0), 1.0 + age, 2.5 / 15.0, 0.5)
    assert demand.scale == pytest.approx(scale, abs=1e-9)
    assert not demand.lasting


def test_nothing_moves_before_the_first_observation() -> None:
    assert watch_observation(SolidScene(), 0.0, 0.1, 0.5).scale == 0.0


def test_lasting_saturation_slows_and_is_forgiven() -> None:
    state, scales = Supervision(), []
    for step in range(60):
        time = step * STEP
        state, demand = watch_torque(state, step < 40, time, STEP)
        scales.append(demand.scale)
    assert scales[12] == 1.0
    assert scales[14] == pytest.approx(0.7)
    assert min(scales) == pytest.approx(0.7**3)
    assert scales[-1] == pytest.approx(0.7**3 + 20 * STEP / RECOVERY_TIME)
    for step in range(1000):
        state, demand = watch_torque(state, True, step * STEP, STEP)
    assert demand.scale == pytest.approx(0.1)


# Decisions.


def run(demands: list[Demand], count: int, state: Supervision, begin: float = 0.0) -> list:
    found = []
    for step in range(count):
        state = supervise(state, demands, begin + step * STEP, STEP)
        found.append(state)
    return found


def test_speed_falls_at_once_and_rises_slowly() -> None:
    (held,) = run([Demand(0.0, "why", "why, 3 m")], 1, Supervision())
    assert held.action == "hold"
    assert (held.speed_scale, held.reason) == (0.0, "why, 3 m")
    back = run([Demand()], 200, held, 1.0)
    scales = [state.speed_scale for state in back]
    np.testing.assert_allclose(np.diff(scales[:30]), STEP / RECOVERY_TIME)
    actions = [state.action for state in back]
    assert actions == sorted(actions, reverse=True)
    assert set(actions) == {"slow", "run"}
    assert all(s.reason == "why, 3 m" for s in back if s.action == "slow")
    assert back[-1].reason == ""


def test_a_hold_ends_only_well_above_where_it_began() -> None:
    (held,) = run([Demand(0.04, "why", "why")], 1, Supervision())
    assert run([Demand(0.2, "why", "why")], 5, held)[-1].action == "hold"
    assert run([Demand(0.4, "why", "why")], 5, held)[-1].action == "slow"
    # A motion that was not held goes on at that speed.
    assert run([Demand(0.2, "why", "why")], 1, Supervision())[0].action == "slow"


def test_a_demand_that_flickers_is_told_once() -> None:
    state, told = Supervision(), []
    for step in range(125):
        demand = Demand(0.9, "near", "near") if step % 2 else Demand()
        after = supervise(state, [demand], step * STEP, STEP)
        if (after.action, after.cause) != (state.action, state.cause):
            told.append(after.action)
        state = after
    assert told == ["slow"]


def test_another_cause_is_told_after_a_while() -> None:
    (first,) = run([Demand(0.5, "one", "one")], 1, Supervision())
    later = run([Demand(0.4, "two", "two")], 100, first, STEP)
    assert [state.cause for state in later[:60]] == ["one"] * 60
    assert later[-1].cause == "two"


@pytest.mark.parametrize(("lasting", "action"), [(True, "stop"), (False, "hold")])
def test_patience_ends_for_what_stays(lasting: bool, action: str) -> None:
    held = run([Demand(0.0, "why", "why", lasting=lasting)], 400, Supervision())
    assert held[-1].action == action
    if lasting:
        after = run([Demand()], 300, held[-1], 10.0)
        assert after[0].action == "slow"
        assert after[-1].action == "run"


def test_what_cannot_be_watched_is_stopped_for_good() -> None:
    stop = Supervision().broken("the robot state is not finite", 1.0)
    (after,) = run([Demand()], 1, stop, 10.0)
    assert after is stop
    assert (stop.action, stop.speed_scale) == ("stop", 0.0)


def test_patience_is_not_lost_while_the_policy_waits() -> None:
    state = Supervision()
    for step in range(400):
        state = supervise(
            state,
            [Demand(0.0, "why", "why", lasting=True)],
            step * STEP,
            STEP,
            waits=True,
        )
    assert state.action == "hold"
