"""What the supervisor demands and decides."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.common.messages import Evasion
from drake_oa.geometry.solids import SolidScene, solids_of, sphere
from drake_oa.robot.arm import Chain, Spheres
from drake_oa.safety.config import SupervisorSettings
from drake_oa.safety.guarded_arm import GuardedArm
from drake_oa.safety.monitors import (
    watch_evasion,
    watch_joints,
    watch_observation,
    watch_solids,
    watch_torque,
    watch_tracking,
)
from drake_oa.safety.supervision import (
    NO_DEMAND,
    Demand,
    SupervisorState,
    broken,
    decide,
)

PARAMETERS = SupervisorSettings()
STEP, ARM = 0.008, 1e3


@cache
def ball() -> GuardedArm:
    """A ball of 0.1 m on an arm of a kilometre, that turns about the world's z: it goes along x."""
    X_PJ = np.tile(np.eye(4), (2, 1, 1))
    X_PJ[0, 1, 3] = ARM
    chain = Chain(X_PJ, np.full(1, -3.0), np.full(1, 3.0), np.full(1, 9.0), np.full(1, ARM))
    one, zero, none = np.array([0, 1]), np.zeros(1, dtype=np.int64), np.zeros((0, 2), np.int64)
    at, bound = np.array([[0.0, -ARM, 0.0]]), np.array([[0.0, -ARM, 0.0, 0.1]])
    tool = np.ones(1, dtype=bool)
    spheres = Spheres(
        zero, at, np.full(1, 0.1), tool, one, zero, bound, one, one, bound, none, np.zeros(0)
    )
    return GuardedArm(chain, spheres, ("ball",), ("joint",), zero, 1, np.zeros(1))


def seen(v_WO: list[float] | None = None, stamp: float = 0.0) -> SolidScene:
    """A point at the origin."""
    v = np.zeros(3) if v_WO is None else np.array(v_WO)
    point = replace(sphere(1e-9), v_WO=v, stamp=stamp, name=7, label="obstacle 7")
    return SolidScene(stamp, solids_of([point]), ("obstacle 7",))


def clearance(
    x: float,
    speed: float,
    *,
    scene: SolidScene | None = None,
    time: float = 0.0,
    parameters: SupervisorSettings = PARAMETERS,
) -> Demand:
    """Of a sphere of 0.1 m at (x, 0, 0) that moves along x, near a point at the origin."""
    q, v = np.array([x / ARM]), np.array([speed / ARM])
    scene = seen() if scene is None else scene
    return watch_solids(ball(), q, v, scene, time, parameters, kept=None, passing=False)


# Watches.


def test_an_approach_is_slowed_by_what_is_left() -> None:
    assert clearance(-1.0, 0.5).scale == 1.0
    near = clearance(-0.2, 0.5)
    left = 0.2 - 0.1 - PARAMETERS.stop_distance
    assert near.scale == pytest.approx(left / PARAMETERS.reaction_time / 0.5, rel=1e-2)
    assert (near.link, near.obstacle, near.lasting) == ("ball", 7, True)
    assert near.reason == "ball within 0.100 m of obstacle 7"
    assert clearance(-0.12, 0.5).scale == 0.0


def test_leaving_is_free_and_slow_only_when_too_near() -> None:
    assert clearance(-0.2, -0.5).scale == 1.0
    assert clearance(-0.12, -0.5).scale == PARAMETERS.leave_scale
    # In contact, too; and what does not move is not limited.
    assert clearance(-0.05, -0.5).scale == PARAMETERS.leave_scale
    assert clearance(-0.05, 0.0).scale == 1.0


def test_an_approaching_obstacle_counts_with_its_speed_and_the_age_of_the_frame() -> None:
    resting = clearance(-0.22, 0.5)
    coming = clearance(-0.22, 0.5, scene=seen([-0.3, 0.0, 0.0]))
    assert coming.scale < resting.scale
    assert not coming.lasting
    # What recedes counts as resting but for the padding; after a while it is gone.
    gone = seen([0.3, 0.0, 0.0])
    less = PARAMETERS.padding / PARAMETERS.reaction_time / 0.5
    assert clearance(-0.22, 0.5, scene=gone).scale == pytest.approx(resting.scale - less, rel=1e-2)
    assert clearance(-0.22, 0.5, scene=gone, time=0.4).scale > resting.scale


def test_what_moves_does_not_last_and_may_be_left_at_full_speed() -> None:
    for v, lasting in (([0.0, 0.3, 0.0], False), ([0.0, 0.0, 0.0], True)):
        assert clearance(0.15, -0.4, scene=seen(v)).lasting == lasting
    assert clearance(0.11, 0.4, scene=seen([0.2, 0.0, 0.0])) is NO_DEMAND
    assert clearance(0.11, 0.4).scale == PARAMETERS.leave_scale


def test_what_moves_is_left_to_who_has_looked_ahead() -> None:
    q, v = np.array([-0.12 / ARM]), np.array([0.5 / ARM])
    for scene, demand in ((seen([0.1, 0.0, 0.0]), 1.0), (seen(), 0.0)):
        found = watch_solids(ball(), q, v, scene, 0.0, PARAMETERS, kept=None, passing=True)
        assert found.scale == demand


def test_no_motion_is_said_to_keep_so_little_that_shapes_touch() -> None:
    q, v = np.array([-0.099 / ARM]), np.array([0.5 / ARM])
    kept = np.full((1, 1), -1.0)
    found = watch_solids(ball(), q, v, seen(), 0.0, PARAMETERS, kept=kept, passing=False)
    assert found.scale == 0.0


@pytest.mark.parametrize(
    ("action", "scale", "said"),
    [
        ("", 1.0, ""),
        ("going on", 1.0, ""),
        ("waiting", 0.0, "waits for obstacle 4"),
        ("evading", 0.0, "evades obstacle 4"),
        ("caught", 0.0, "evades obstacle 4"),
    ],
)
def test_a_motion_is_held_while_it_waits_or_evades(action: str, scale: float, said: str) -> None:
    demand = watch_evasion(Evasion(action, obstacle=4))
    assert (demand.scale, demand.reason, demand.lasting) == (scale, said, False)


@pytest.mark.parametrize(
    ("age", "scale"),
    [(0.0, 1.0), (2.4 / 15.0, 1.0), ((2.5 / 15.0 + 0.5) / 2.0, 0.5), (0.5, 0.1), (0.51, 0.0)],
)
def test_an_old_observation_slows(age: float, scale: float) -> None:
    demand = watch_observation(SolidScene(1.0), 1.0 + age, PARAMETERS)
    assert demand.scale == pytest.approx(scale, abs=1e-9)
    assert not demand.lasting


def test_nothing_moves_before_the_first_observation() -> None:
    assert watch_observation(SolidScene(), 0.0, PARAMETERS).scale == 0.0


ONES = np.ones(2)
RANGE = ("a", "b"), Chain(np.zeros((3, 4, 4)), -ONES, ONES, 2.0 * ONES, ONES)


def test_a_joint_is_slowed_toward_its_limit_only() -> None:
    q, still = np.array([0.96, 0.0]), np.zeros(2)
    toward = watch_joints(*RANGE, q, still, np.array([0.5, 0.5]), 1.0, PARAMETERS)
    assert toward.scale == pytest.approx(0.02 / 0.3 / 0.5)
    assert toward.reason == "a 0.040 rad from its position limit"
    assert watch_joints(*RANGE, q, still, np.array([-0.5, 0.5]), 1.0, PARAMETERS).scale == 1.0


def test_a_fast_joint_is_slowed_but_not_held() -> None:
    q, still = np.zeros(2), np.zeros(2)
    assert watch_joints(*RANGE, q, still, np.array([0.0, 4.0]), 1.0, PARAMETERS).scale == 0.5
    # Measured, at half speed, where the prediction does not say so.
    now = watch_joints(*RANGE, q, np.array([3.0, 0.0]), still, 0.5, PARAMETERS)
    assert now.scale == pytest.approx(0.5 * 2.0 / 3.0)
    assert watch_joints(*RANGE, q, still, np.array([0.0, 1e3]), 1.0, PARAMETERS).scale == 0.1


@pytest.mark.parametrize(("error", "scale"), [(0.0, 1.0), (0.02, 1.0), (0.035, 0.5), (0.05, 0.0)])
def test_the_tracking_error_slows(error: float, scale: float) -> None:
    assert watch_tracking(error, PARAMETERS).scale == pytest.approx(scale)


def test_lasting_saturation_slows_and_is_forgiven() -> None:
    state, scales = SupervisorState(), []
    for step in range(60):
        time = step * STEP
        state, demand = watch_torque(state, step < 40, time, STEP, PARAMETERS)
        scales.append(demand.scale)
    assert scales[12] == 1.0
    assert scales[14] == pytest.approx(0.7)
    assert min(scales) == pytest.approx(0.7**3)
    assert scales[-1] == pytest.approx(0.7**3 + 20 * STEP)
    for step in range(1000):
        state, demand = watch_torque(state, True, step * STEP, STEP, PARAMETERS)
    assert demand.scale == pytest.approx(0.1)


# Decisions.


def run(demands: list[Demand], count: int, state: SupervisorState, begin: float = 0.0) -> list:
    found = []
    for step in range(count):
        state = decide(state, demands, begin + step * STEP, STEP, PARAMETERS)
        found.append(state)
    return found


def test_speed_falls_at_once_and_rises_slowly() -> None:
    (held,) = run([Demand(0.0, "why", "why, 3 m")], 1, SupervisorState())
    assert held.supervision.action == "hold"
    assert (held.supervision.speed_scale, held.supervision.reason) == (0.0, "why, 3 m")
    back = run([Demand()], 200, held, 1.0)
    scales = [state.supervision.speed_scale for state in back]
    np.testing.assert_allclose(np.diff(scales[:100]), STEP / PARAMETERS.recovery_time)
    actions = [state.supervision.action for state in back]
    assert actions == sorted(actions, reverse=True)
    assert set(actions) == {"slow", "run"}
    assert all(s.supervision.reason == "why, 3 m" for s in back if s.supervision.action == "slow")
    assert back[-1].supervision.reason == ""


def test_a_hold_ends_only_well_above_where_it_began() -> None:
    (held,) = run([Demand(0.04, "why", "why")], 1, SupervisorState())
    assert run([Demand(0.2, "why", "why")], 5, held)[-1].supervision.action == "hold"
    assert run([Demand(0.4, "why", "why")], 5, held)[-1].supervision.action == "slow"
    # A motion that was not held goes on at that speed.
    assert run([Demand(0.2, "why", "why")], 1, SupervisorState())[0].supervision.action == "slow"


def test_a_demand_that_flickers_is_told_once() -> None:
    state, told = SupervisorState(), []
    for step in range(125):
        demand = Demand(0.9, "near", "near") if step % 2 else Demand()
        after = decide(state, [demand], step * STEP, STEP, PARAMETERS)
        if (after.supervision.action, after.cause) != (state.supervision.action, state.cause):
            told.append(after.supervision.action)
        state = after
    assert told == ["slow"]


def test_another_cause_is_told_after_a_while() -> None:
    (first,) = run([Demand(0.5, "one", "one")], 1, SupervisorState())
    later = run([Demand(0.4, "two", "two")], 100, first, STEP)
    assert [state.cause for state in later[:60]] == ["one"] * 60
    assert later[-1].cause == "two"


@pytest.mark.parametrize(("lasting", "action"), [(True, "stop"), (False, "hold")])
def test_patience_ends_for_what_stays(lasting: bool, action: str) -> None:
    held = run([Demand(0.0, "why", "why", lasting=lasting)], 400, SupervisorState())
    assert held[-1].supervision.action == action
    if lasting:
        after = run([Demand()], 300, held[-1], 10.0)
        assert after[0].supervision.action == "slow"
        assert after[-1].supervision.action == "run"


def test_what_cannot_be_watched_is_stopped_for_good() -> None:
    stop = broken(SupervisorState(), "the robot state is not finite", 1.0)
    (after,) = run([Demand()], 1, stop, 10.0)
    assert after is stop
    assert (stop.supervision.action, stop.supervision.speed_scale) == ("stop", 0.0)


def test_patience_is_not_lost_while_the_policy_waits() -> None:
    state = SupervisorState()
    for step in range(400):
        state = decide(
            state,
            [Demand(0.0, "why", "why", lasting=True)],
            step * STEP,
            STEP,
            PARAMETERS,
            waits=True,
        )
    assert state.supervision.action == "hold"


@given(speed=st.floats(0.3, 1.5), begin=st.floats(0.13, 0.6), hold_time=st.floats(0.05, 0.5))
@settings(max_examples=6)
def test_a_resting_obstacle_is_never_touched(speed: float, begin: float, hold_time: float) -> None:
    parameters = SupervisorSettings(reaction_time=hold_time + 0.05)
    state, x, scale = SupervisorState(), -begin, 0.0
    for step in range(500):
        demand = clearance(x, speed, parameters=parameters)
        state = decide(state, [demand], step * STEP, STEP, parameters)
        # The policy's ramp.
        most = STEP / hold_time
        scale += min(max(state.supervision.speed_scale - scale, -most), most)
        x += scale * speed * STEP
    rest = -x - 0.1
    assert rest > parameters.stop_distance - 1e-3
    assert rest < parameters.stop_distance + 0.1 * parameters.reaction_time * speed + 1e-2
    assert state.supervision.action in ("hold", "stop")
