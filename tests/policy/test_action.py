"""The action level: one step against the readable form, holds, scaling, and what motions keep."""

import math
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    HoldReason,
    PolicyState,
    Route,
)
from drake_oa.policy.action import CouplingInputs, Segment, restarted, resting, take_step
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import HEADING, triple
from drake_oa.policy.dmp import Dmp, imitate, local_frame, minimum_jerk
from drake_oa.policy.guidance import guide
from tests.builders import balls
from tests.reference.coupling import turning
from tests.reference.dmp import step as dmp_step

START, GOAL = np.zeros(3), np.array([1.0, 0.0, 0.0])
DMP = imitate(*minimum_jerk(START, GOAL, duration=2.0))
STEP = 0.005
POLICY = Policy()
STEPPED = partial(take_step, dmp=DMP, config=POLICY)
seeds = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=15)

Scene = tuple[FloatArray, FloatArray, EllipsoidSet, CouplingParameters, Route]
"""Start, goal, obstacles, their parameters and the sides to pass."""


def seen(stamp: float = math.inf, x: float = 0.5) -> EllipsoidSet:
    return balls((x, 0.02, 0.0), radius=0.03, stamp=stamp, ids=[7])


COUPLED = CouplingParameters(*np.array([[300.0], [0.7], [5.0]]), np.ones(1, dtype=bool))


def begun(start: FloatArray, goal: FloatArray, speed: float = 0.5, **more: float) -> Segment:
    """Rest at the start of a motion."""
    R_WL = local_frame(start, goal)
    return resting(PolicyState(p_WE=start, p_WS=start, p_WG=goal, R_WL=R_WL, speed=speed, **more))


def run(around: CouplingInputs, count: int = 480, **inputs: ArrayLike) -> list[Segment]:
    """Steps from rest at the start, with a row of each input a step."""
    found = [begun(START, GOAL)]
    for row in range(count):
        given_ = {name: rows[row] for name, rows in inputs.items()}
        found.append(STEPPED(found[-1], GOAL, around, row * STEP, STEP, **given_))
    return found[1:]


def path(segments: list[Segment]) -> FloatArray:
    return np.array([segment.end.p_WE for segment in segments])


def scene(seed: int, strength: float = 6.0) -> Scene:
    """One to three obstacles near the baseline that leave start and goal free, and a route."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 4))
    start, way = rng.normal(size=(2, 3))
    goal = start + way / np.linalg.norm(way)
    R_WL = local_frame(start, goal)
    angle = rng.uniform(0.0, 6.28) + rng.normal(scale=0.3, size=count)
    direction = np.stack([np.zeros(count), np.cos(angle), np.sin(angle)], axis=1) @ R_WL.T
    # Off the baseline: exactly on it the last bit of a sum says whether guidance acts at rest.
    feet = start + rng.uniform(0.35, 0.65, (count, 1)) * (goal - start)
    feet += rng.choice([-1.0, 1.0], (count, 1)) * rng.uniform(0.002, 0.02, (count, 1)) * direction
    rows = np.exp(rng.uniform([1.6, -1.0, 0.7], [strength, 0.4, 3.4], size=(count, 3)))
    ellipsoids = replace(
        balls(*feet, stamp=math.inf),
        R_WO=Rotation.random(count, random_state=seed).as_matrix(),
        semi_axes=rng.uniform(0.003, 0.03, size=(count, 3)),
    )
    route = Route(
        direction_W=direction,
        normal_W=np.cross(R_WL[:, 0], direction),
        remaining_clearance=rng.uniform(0.05, 0.1, count),
        path_length=1.3,
    )
    coupling = CouplingParameters(*rows.T.copy(), np.ones(count, dtype=bool), feet)
    return start, goal, ellipsoids, coupling, route


def under_way(some: Scene, seed: int) -> PolicyState:
    """A state of a motion in a scene."""
    rng, state = np.random.default_rng([seed, 2]), begun(*some[:2]).end
    p_WE = state.p_WS + rng.uniform(0.0, 0.9) * (state.p_WG - state.p_WS)
    p_WE += rng.normal(scale=0.05, size=3)
    z_W = rng.normal(size=3) * rng.integers(0, 2)
    return replace(state, p_WE=p_WE, z_W=z_W, phase=rng.uniform(0.01, 1.0))


def step_of(state: PolicyState, *around: object) -> PolicyState:
    values = CouplingInputs.of(*around)
    return STEPPED(resting(state), state.p_WG, values, 0.0, STEP).end


# Holds.


SHUT = Route(blocked=True, note="every side of obstacle 7 is forbidden")
UNSAFE = replace(COUPLED, hold=HoldReason.OBSTACLES, note="no motion that clears obstacle 7 found")


@pytest.mark.parametrize(
    ("said", "around"),
    [
        ("", [None]),
        ("", [EllipsoidSet(stamp=9.51)]),
        ("", [seen(), None, Route()]),
        ("no observation yet (dark)", [EllipsoidSet(note="dark")]),
        ("obstacles not seen since t = 9.40 s", [EllipsoidSet(stamp=9.4)]),
        ("tool inside obstacle 7", [seen(10.0, 0.02)]),
        ("goal inside obstacle 7", [seen(10.0, 0.98)]),
        (SHUT.note, [seen(), None, SHUT]),
        (UNSAFE.note, [seen(), UNSAFE]),
    ],
)
def test_each_reason_to_hold_is_named(said: str, around: list) -> None:
    found = CouplingInputs.of(*(around + [None, None])[:3])
    hold, note = found.hold_at(begun(START, GOAL).end, 10.0, 0.5)
    assert note == said
    assert hold is (HoldReason.OBSTACLES if said else HoldReason.NONE)


def test_a_hold_brings_the_motion_to_rest_within_the_hold_time() -> None:
    segments = run(CouplingInputs.of(seen(0.3), COUPLED, None), 400)
    held = [bool(segment.state.note) for segment in segments]
    first = held.index(True)
    assert segments[first].state.stamp == pytest.approx(0.8, abs=2 * STEP)
    assert all(held[first:])
    still = segments[first + round(POLICY.hold_time / STEP) :]
    for segment in still:
        assert segment.end.speed == 0.0
        np.testing.assert_array_equal(segment.end.p_WE, still[0].state.p_WE)
    # Held at its start it does not begin.
    begun_held = run(CouplingInputs(EllipsoidSet()), 10)
    assert all((one.end.phase, one.end.speed) == (1.0, 0.0) for one in begun_held)
    # No jump of velocity on the way to rest.
    speed = np.linalg.norm([segment.velocity[1] for segment in segments[first:]], axis=1)
    assert speed[0] > 0.1
    assert (np.diff(speed) <= 1e-9).all()


# The compiled step against the readable one.


@given(seed=seeds)
def test_the_compiled_step_is_the_readable_one(seed: int) -> None:
    some = scene(seed, 10.0)
    _, goal, ellipsoids, coupling, route = some
    state, around = under_way(some, seed), CouplingInputs.of(ellipsoids, coupling, route)
    after = step_of(state, ellipsoids, coupling, route)
    rows, places = around.obstacles.terms.copy(), np.array([state.p_WE, state.z_W, goal])
    spread = state.R_WL * state.baseline
    guide(*(triple(places, i) for i in range(3)), tuple(spread[:, 0]), around.obstacles, rows)
    rows[:, 3] *= min(1.0, math.dist(state.p_WE, goal) / POLICY.fade) ** 4
    assert (
        np.abs(np.linalg.norm(rows[:, HEADING : HEADING + 3], axis=1) - 0.5) <= 0.5 + 1e-9
    ).all()
    ds = 0.5 * (state.speed + after.speed) * STEP
    begin = state.p_WE, state.z_W, state.phase
    p_WE, z_W, phase = dmp_step(DMP, *begin, ds, goal, spread, partial(turning, rows))
    np.testing.assert_allclose(after.p_WE, p_WE, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(after.z_W, z_W, rtol=0.0, atol=1e-9)
    assert after.phase == pytest.approx(phase, abs=1e-12)
    assert after.tau == pytest.approx(1.3)


@pytest.mark.parametrize(
    ("coupling", "route", "said"),
    [
        (replace(COUPLED, normal_W=np.zeros((9, 3))), None, "normal_W has 9 rows; there are 1"),
        (replace(COUPLED, psi=np.zeros(1)), None, "alpha, psi, kappa must be"),
        (replace(COUPLED, alpha=np.full(1, np.nan)), None, "finite"),
        (CouplingParameters(), None, "coupling_parameters has 0 rows; there are 1 ellipsoids"),
        (COUPLED, Route(direction_W=np.zeros((3, 3))), "route has 3 rows; there are 1"),
    ],
)
def test_parameters_that_cannot_be_used_are_refused(
    coupling: CouplingParameters, route: Route | None, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        CouplingInputs.of(seen(), coupling, route)


# Speed scaled from outside, and displacement.


@FEW
@given(seed=seeds)
def test_the_path_does_not_depend_on_the_speed(seed: int) -> None:
    scales = np.repeat(np.random.default_rng(seed).choice([0.0, 0.2, 0.6, 1.0, 7.0], 24), 20)
    around = CouplingInputs.of(seen(), COUPLED, None)
    free, scaled = run(around), run(around, speed_scale=scales)
    s_free, s = (-np.log([one.end.phase for one in found]) for found in (free, scaled))
    expected = np.stack([np.interp(s, s_free, axis) for axis in path(free).T], axis=1)
    np.testing.assert_allclose(path(scaled), expected, atol=2e-3)
    speed = np.array([segment.end.speed for segment in scaled]) * DMP.duration
    assert np.abs(np.diff(speed)).max() <= STEP / POLICY.hold_time + 1e-12
    assert speed[-1] <= 1.0
    assert [one.end.note == "speed_scale is 0" for one in scaled] == (scales == 0.0).tolist()


@FEW
@given(seed=seeds, share=st.floats(0.01, 0.99))
def test_the_outputs_of_a_displaced_motion_are_consistent(seed: int, share: float) -> None:
    u = np.cumsum(np.random.default_rng(seed).normal(0.0, 0.01, (200, 3)), axis=0)
    u[0] = np.nan
    found = run(CouplingInputs.of(seen(), COUPLED, None), 200, evasion_velocity=u)
    for one, other in pairwise(found):
        np.testing.assert_array_equal(one.velocity[1], other.velocity[0])
        np.testing.assert_array_equal(one.end.p_WE, other.state.p_WE)
    segment, h = found[100], 1e-6
    between = segment.state.stamp + share * STEP
    before, now, after = (segment.interpolate(between + dt) for dt in (-h, 0.0, h))
    np.testing.assert_allclose((after - before)[:2] / (2.0 * h), now[1:], atol=1e-3, rtol=1e-3)
    # Beyond its end it goes on at its last velocity.
    later = segment.interpolate(segment.end.stamp + 0.01)
    np.testing.assert_allclose(later[0], segment.end.p_WE + 0.01 * segment.velocity[1])
    assert not later[2].any()
    # While it is held, the displacement is all.
    hold = round(POLICY.hold_time / STEP)
    held = run(CouplingInputs(), 200, evasion_velocity=u, speed_scale=np.zeros(200))
    expected = STEP * (0.5 * (u[hold:] + u[hold - 1 : -1])).sum(axis=0)
    moved_by = held[-1].end.p_WE - held[hold - 1].end.p_WE
    np.testing.assert_allclose(moved_by, expected, atol=1e-12)


def test_a_resting_motion_begins_anew_where_it_is() -> None:
    p_WE, goal = np.array([0.4, 0.1, 0.3]), np.array([0.9, 0.2, 0.4])
    state = PolicyState(p_WE=p_WE, z_W=goal, phase=0.3, p_WG=GOAL, note="held")
    restart = restarted(resting(state), goal, 2.0).end
    np.testing.assert_array_equal([restart.p_WE, restart.p_WS, restart.p_WG], [p_WE, p_WE, goal])
    np.testing.assert_allclose(restart.R_WL, local_frame(p_WE, goal))
    assert (restart.phase, restart.speed, restart.stamp, restart.note) == (1.0, 0.0, 2.0, "held")
    assert not restart.z_W.any()
    # One that moves, or is at its start, is left.
    for change in ({"speed": 0.1}, {"p_WS": p_WE}):
        segment = resting(replace(state, **change))
        assert restarted(segment, goal, 0.0) is segment


# What whole motions keep.


@given(seed=seeds, period=st.floats(1e-6, 10.0), ratio=st.sampled_from([0.01, 0.25, 4.0]))
def test_energy_never_rises_over_a_step(seed: int, period: float, ratio: float) -> None:
    some = scene(seed, 20.0)
    rng, goal, state = np.random.default_rng(seed), some[1], under_way(some, seed)
    alpha = rng.uniform(0.1, 200.0)
    dmp = Dmp(alpha, ratio * alpha, 4.6, np.ones(1), np.ones(1), np.zeros((3, 1)))
    around, segment = CouplingInputs.of(*some[2:]), resting(state)
    energies = []
    for _ in range(5):
        p, z = segment.end.p_WE, segment.end.z_W
        energies.append(alpha**2 * ratio * ((goal - p) ** 2).sum() + (z**2).sum())
        segment = take_step(
            segment, goal, around, segment.end.stamp, period, dmp=dmp, config=POLICY
        )
    assert (np.diff(energies) <= 1e-12 * energies[0]).all()


def path_in(some: Scene, *, tau: float = 1.0, steps: int = 200) -> FloatArray:
    """Positions of the compiled action level from s = 0 to 1.2, where nothing holds it."""
    start, goal, ellipsoids, coupling, route = some
    stepped = partial(take_step, dmp=replace(DMP, duration=1.0), config=POLICY)
    segment = begun(start, goal, tau=tau, speed=1.0 / tau)
    around = CouplingInputs.of(ellipsoids, replace(coupling, tau=tau, verified=True), route)
    around = replace(around, obstacles=CouplingInputs.of(ellipsoids, coupling, route).obstacles)
    found = [start]
    for _ in range(round(1.2 * steps)):
        segment = stepped(segment, goal, around, segment.end.stamp, tau / steps)
        found.append(segment.end.p_WE)
    return np.array(found)


@FEW
@given(seed=seeds, tau=st.floats(1.0, 20.0), power=st.floats(-3.0, 3.0), mirror=st.booleans())
def test_the_path_moves_mirrors_and_scales_with_the_scene_at_any_tau(
    seed: int, tau: float, power: float, mirror: bool
) -> None:
    shift, scale = np.random.default_rng([seed, 1]).normal(size=3), 10.0**power
    # The demonstration is straight: nothing is left of the vertical but in the normals.
    Q = Rotation.random(random_state=seed).as_matrix() @ np.diag([1.0, 1.0 - 2.0 * mirror, 1.0])
    some = scene(seed)
    start, goal, ellipsoids, coupling, route = some
    # A mirror leaves left-handed axes: one of them turned around is the same ellipsoid.
    axes = Q @ ellipsoids.R_WO
    axes[..., 2] *= np.linalg.det(Q)
    start, goal, p_WO, centers = (
        scale * points @ Q.T + shift for points in (start, goal, ellipsoids.p_WO, coupling.center_W)
    )
    moved = (
        start,
        goal,
        replace(ellipsoids, p_WO=p_WO, R_WO=axes, semi_axes=scale * ellipsoids.semi_axes),
        replace(coupling, kappa=coupling.kappa / scale**2, center_W=centers),
        replace(
            route,
            direction_W=route.direction_W @ Q.T,
            normal_W=np.linalg.det(Q) * route.normal_W @ Q.T,
            remaining_clearance=scale * route.remaining_clearance,
        ),
    )
    again = (path_in(moved, tau=tau) - shift) / scale
    # The turned numbers differ in their last bits, and three guided terms amplify that.
    np.testing.assert_allclose(again, path_in(some) @ Q.T, rtol=0.0, atol=1e-8)
