"""Tests of the policy's time step: reference form, holds, speed scaling, evasion, invariances."""

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
from drake_oa.policy.action import CouplingInputs, Segment, make_segment, restart, take_step
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
"""Start, goal, obstacles, their coupling parameters, and the sides to pass on."""


def ball(stamp: float = math.inf, x: float = 0.5) -> EllipsoidSet:
    """Returns an observation of one ball beside the baseline, with ID 7."""
    return balls((x, 0.02, 0.0), radius=0.03, stamp=stamp, ids=[7])


COUPLED = CouplingParameters(*np.array([[300.0], [0.7], [5.0]]), np.ones(1, dtype=bool))


def at_start(start: FloatArray, goal: FloatArray, speed: float = 0.5, **more: float) -> Segment:
    """Returns a segment of zero length at the start of a motion."""
    R_WL = local_frame(start, goal)
    return make_segment(
        PolicyState(p_WE=start, p_WS=start, p_WG=goal, R_WL=R_WL, speed=speed, **more)
    )


def run(inputs: CouplingInputs, count: int = 480, **values: ArrayLike) -> list[Segment]:
    """Computes steps of a motion from its start; row i of each value is the argument of step i."""
    segments = [at_start(START, GOAL)]
    for row in range(count):
        arguments = {name: rows[row] for name, rows in values.items()}
        segments.append(STEPPED(segments[-1], GOAL, inputs, row * STEP, STEP, **arguments))
    return segments[1:]


def path(segments: list[Segment]) -> FloatArray:
    """Returns the positions (T, 3) at the ends of segments [m]."""
    return np.array([segment.end.p_WE for segment in segments])


def scene(seed: int, strength: float = 6.0) -> Scene:
    """Draws one to three obstacles near a baseline that do not contain its ends, and a route."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 4))
    start, heading = rng.normal(size=(2, 3))
    goal = start + heading / np.linalg.norm(heading)
    R_WL = local_frame(start, goal)
    angle = rng.uniform(0.0, 6.28) + rng.normal(scale=0.3, size=count)
    direction = np.stack([np.zeros(count), np.cos(angle), np.sin(angle)], axis=1) @ R_WL.T
    # Beside the baseline: exactly on it rounding would determine whether guidance acts at rest.
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


def random_state(some: Scene, seed: int) -> PolicyState:
    """Draws a state of a motion in a scene."""
    rng, state = np.random.default_rng([seed, 2]), at_start(*some[:2]).end
    p_WE = state.p_WS + rng.uniform(0.0, 0.9) * (state.p_WG - state.p_WS)
    p_WE += rng.normal(scale=0.05, size=3)
    z_W = rng.normal(size=3) * rng.integers(0, 2)
    return replace(state, p_WE=p_WE, z_W=z_W, phase=rng.uniform(0.01, 1.0))


# Holds.


SHUT = Route(blocked=True, note="every side of obstacle 7 is forbidden")
UNSAFE = replace(COUPLED, hold=HoldReason.OBSTACLES, note="no motion that clears obstacle 7 found")


@pytest.mark.parametrize(
    ("note", "values"),
    [
        ("", [None]),
        ("", [EllipsoidSet(stamp=9.51)]),
        ("", [ball(), None, Route()]),
        ("no observation yet (dark)", [EllipsoidSet(note="dark")]),
        ("obstacles not seen since t = 9.40 s", [EllipsoidSet(stamp=9.4)]),
        ("tool inside obstacle 7", [ball(10.0, 0.02)]),
        ("goal inside obstacle 7", [ball(10.0, 0.98)]),
        (SHUT.note, [ball(), None, SHUT]),
        (UNSAFE.note, [ball(), UNSAFE]),
    ],
)
def test_the_note_names_the_hold_reason(note: str, values: list) -> None:
    inputs = CouplingInputs.of(*(values + [None, None])[:3])
    reason = HoldReason.OBSTACLES if note else HoldReason.NONE
    assert inputs.hold_at(at_start(START, GOAL).end, 10.0, 0.5) == (reason, note)


def test_a_hold_brings_the_motion_to_rest_within_the_hold_time() -> None:
    segments = run(CouplingInputs.of(ball(0.3), COUPLED, None), 400)
    is_held = [bool(segment.state.note) for segment in segments]
    first = is_held.index(True)
    assert segments[first].state.stamp == pytest.approx(0.8, abs=2 * STEP)
    assert all(is_held[first:])
    still = segments[first + round(POLICY.hold_time / STEP) :]
    for segment in still:
        assert segment.end.speed == 0.0
        np.testing.assert_array_equal(segment.end.p_WE, still[0].state.p_WE)
    # A motion held at its start does not move.
    never_started = run(CouplingInputs(EllipsoidSet()), 10)
    never_started += run(CouplingInputs(), 10, speed_scale=np.zeros(10))
    assert all((one.end.phase, one.end.speed) == (1.0, 0.0) for one in never_started)
    # The speed decreases without a jump.
    speed = np.linalg.norm([segment.velocity[1] for segment in segments[first:]], axis=1)
    assert speed[0] > 0.1
    assert (np.diff(speed) <= 1e-9).all()


def test_a_goal_that_is_not_finite_holds_the_motion() -> None:
    (moving,) = run(CouplingInputs(), 1)
    waiting = CouplingInputs.of(ball(), COUPLED, Route())
    held = STEPPED(moving, GOAL * np.nan, waiting, STEP, STEP)
    assert (held.end.hold, held.end.p_WG.tolist()) == (HoldReason.GOAL, GOAL.tolist())
    assert STEPPED(held, GOAL, CouplingInputs(), 2 * STEP, STEP).end.hold is HoldReason.NONE


# Compiled step and reference.


@given(seed=seeds)
def test_the_compiled_step_equals_the_reference(seed: int) -> None:
    some = scene(seed, 10.0)
    _, goal, ellipsoids, coupling, route = some
    state, inputs = random_state(some, seed), CouplingInputs.of(ellipsoids, coupling, route)
    after = STEPPED(make_segment(state), goal, inputs, 0.0, STEP).end
    rows, places = inputs.obstacles.terms.copy(), np.array([state.p_WE, state.z_W, goal])
    spread = state.R_WL * state.baseline
    guide(*(triple(places, i) for i in range(3)), tuple(spread[:, 0]), inputs.obstacles, rows)
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
    ("coupling", "route", "message"),
    [
        (replace(COUPLED, normal_W=np.zeros((9, 3))), None, "normal_W has 9 rows; it must have 1"),
        (replace(COUPLED, psi=np.zeros(1)), None, r"term 0: psi = 0\.0; .* psi above 0"),
        (replace(COUPLED, alpha=np.full(1, np.nan)), None, "alpha = nan; .* finite"),
        (CouplingParameters(), None, "coupling_parameters has 0 rows; it must have 1"),
        (COUPLED, Route(direction_W=np.zeros((3, 3))), "route has 3 rows; it must have 1"),
    ],
)
def test_invalid_parameters_are_refused(
    coupling: CouplingParameters, route: Route | None, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        CouplingInputs.of(ball(), coupling, route)


# Speed scale and evasion velocity.


@FEW
@given(seed=seeds)
def test_the_path_does_not_depend_on_the_speed(seed: int) -> None:
    scales = np.repeat(np.random.default_rng(seed).choice([0.0, 0.2, 0.6, 1.0, 7.0], 24), 20)
    inputs = CouplingInputs.of(ball(), COUPLED, None)
    free, scaled = run(inputs), run(inputs, speed_scale=scales)
    s_free, s = (-np.log([one.end.phase for one in segments]) for segments in (free, scaled))
    expected = np.stack([np.interp(s, s_free, axis) for axis in path(free).T], axis=1)
    np.testing.assert_allclose(path(scaled), expected, atol=2e-3)
    speed = np.array([segment.end.speed for segment in scaled]) * DMP.duration
    assert np.abs(np.diff(speed)).max() <= STEP / POLICY.hold_time + 1e-12
    assert speed[-1] <= 1.0
    assert [one.end.note == "speed_scale is 0" for one in scaled] == (scales == 0.0).tolist()


@FEW
@given(seed=seeds, share=st.floats(0.01, 0.99))
def test_velocity_and_acceleration_are_derivatives_during_evasion(seed: int, share: float) -> None:
    u = np.cumsum(np.random.default_rng(seed).normal(0.0, 0.01, (200, 3)), axis=0)
    u[0] = np.nan
    segments = run(CouplingInputs.of(ball(), COUPLED, None), 200, evasion_velocity=u)
    for one, other in pairwise(segments):
        np.testing.assert_array_equal(one.velocity[1], other.velocity[0])
        np.testing.assert_array_equal(one.end.p_WE, other.state.p_WE)
    segment, h = segments[100], 1e-6
    between = segment.state.stamp + share * STEP
    before, now, after = (segment.interpolate(between + dt) for dt in (-h, 0.0, h))
    np.testing.assert_allclose((after - before)[:2] / (2.0 * h), now[1:], atol=1e-3, rtol=1e-3)
    # After the end of a segment the velocity is constant.
    later = segment.interpolate(segment.end.stamp + 0.01)
    np.testing.assert_allclose(later[0], segment.end.p_WE + 0.01 * segment.velocity[1])
    assert not later[2].any()
    # While the motion is held, only the evasion velocity displaces the tool.
    hold = round(POLICY.hold_time / STEP)
    segments = run(CouplingInputs(), 200, evasion_velocity=u, speed_scale=np.zeros(200))
    expected = STEP * (0.5 * (u[hold:] + u[hold - 1 : -1])).sum(axis=0)
    displacement = segments[-1].end.p_WE - segments[hold - 1].end.p_WE
    np.testing.assert_allclose(displacement, expected, atol=1e-12)


def test_a_motion_at_rest_restarts_at_its_position() -> None:
    p_WE, goal = np.array([0.4, 0.1, 0.3]), np.array([0.9, 0.2, 0.4])
    state = PolicyState(p_WE=p_WE, z_W=goal, phase=0.3, p_WG=GOAL, note="held")
    after = restart(make_segment(state), goal, 2.0).end
    np.testing.assert_array_equal([after.p_WE, after.p_WS, after.p_WG], [p_WE, p_WE, goal])
    np.testing.assert_allclose(after.R_WL, local_frame(p_WE, goal))
    assert (after.phase, after.speed, after.stamp, after.note) == (1.0, 0.0, 2.0, "held")
    assert not after.z_W.any()
    # A motion that moves, or is at its start, does not restart.
    for change in ({"speed": 0.1}, {"p_WS": p_WE}):
        segment = make_segment(replace(state, **change))
        assert restart(segment, goal, 0.0) is segment


# Invariances of whole motions.


@given(seed=seeds, period=st.floats(1e-6, 10.0), ratio=st.sampled_from([0.01, 0.25, 4.0]))
def test_energy_never_rises_over_a_step(seed: int, period: float, ratio: float) -> None:
    some = scene(seed, 20.0)
    rng, goal, state = np.random.default_rng(seed), some[1], random_state(some, seed)
    alpha = rng.uniform(0.1, 200.0)
    dmp = Dmp(alpha, ratio * alpha, 4.6, np.ones(1), np.ones(1), np.zeros((3, 1)))
    inputs, segment = CouplingInputs.of(*some[2:]), make_segment(state)
    energies = []
    for _ in range(5):
        p, z = segment.end.p_WE, segment.end.z_W
        energies.append(alpha**2 * ratio * ((goal - p) ** 2).sum() + (z**2).sum())
        segment = take_step(
            segment, goal, inputs, segment.end.stamp, period, dmp=dmp, config=POLICY
        )
    assert (np.diff(energies) <= 1e-12 * energies[0]).all()


def path_in(some: Scene, *, tau: float = 1.0, steps: int = 200) -> FloatArray:
    """Computes the positions of a motion without holds from s = 0 to 1.2."""
    start, goal, ellipsoids, coupling, route = some
    stepped = partial(take_step, dmp=replace(DMP, duration=1.0), config=POLICY)
    segment = at_start(start, goal, tau=tau, speed=1.0 / tau)
    inputs = CouplingInputs.of(ellipsoids, replace(coupling, tau=tau, verified=True), route)
    inputs = replace(inputs, obstacles=CouplingInputs.of(ellipsoids, coupling, route).obstacles)
    positions = [start]
    for _ in range(round(1.2 * steps)):
        segment = stepped(segment, goal, inputs, segment.end.stamp, tau / steps)
        positions.append(segment.end.p_WE)
    return np.array(positions)


@FEW
@given(seed=seeds, tau=st.floats(1.0, 20.0), power=st.floats(-3.0, 3.0), mirror=st.booleans())
def test_the_path_moves_mirrors_and_scales_with_the_scene_at_any_tau(
    seed: int, tau: float, power: float, mirror: bool
) -> None:
    shift, scale = np.random.default_rng([seed, 1]).normal(size=3), 10.0**power
    # As the demonstration is straight, only the normals depend on the vertical.
    Q = Rotation.random(random_state=seed).as_matrix() @ np.diag([1.0, 1.0 - 2.0 * mirror, 1.0])
    some = scene(seed)
    start, goal, ellipsoids, coupling, route = some
    # Mirrored axes are left-handed; negating one of them describes the same ellipsoid.
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
    result = (path_in(moved, tau=tau) - shift) / scale
    # Three guided terms amplify the rounding of the transformed scene.
    np.testing.assert_allclose(result, path_in(some) @ Q.T, rtol=0.0, atol=1e-8)
