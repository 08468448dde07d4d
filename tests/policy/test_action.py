"""The action level: one step against the readable form, holds, scaling, and what motions keep."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from drake_oa.common.compiled import kernel_arrays
from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    HoldCause,
    PolicyState,
    Route,
)
from drake_oa.policy import action_kernels as kernels
from drake_oa.policy.action import (
    ActionLevel,
    Segment,
    Surroundings,
    desired_headings,
    initial_segment,
    restarted,
)
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import Dmp, imitate, local_frame, minimum_jerk
from drake_oa.route.cost_rings import passing_normals
from tests.builders import balls
from tests.reference.coupling import terms, turning
from tests.reference.dmp import step as dmp_step

START, GOAL = np.zeros(3), np.array([1.0, 0.0, 0.0])
DMP = imitate(*minimum_jerk(START, GOAL, duration=2.0))
STEP = 0.005
PARAMETERS = Policy()
LEVEL = ActionLevel(DMP, PARAMETERS)
seeds = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=15)
MANY = settings(max_examples=60)

Scene = tuple[FloatArray, FloatArray, EllipsoidSet, CouplingParameters, Route]
"""Start, goal, obstacles, their parameters and the sides to pass."""


def goal_fade(state: PolicyState, fade: float) -> float:
    """At a state, by the kernel."""
    to_G = state.p_WG - state.p_WE
    return kernels.goal_fade(float(to_G @ to_G), state.baseline, fade)


def one_ellipsoid(
    stamp: float = math.inf, center: tuple[float, float, float] = (0.5, 0.02, 0.0)
) -> EllipsoidSet:
    return balls(center, radius=0.03, stamp=stamp, ids=[7])


COUPLED = CouplingParameters(
    np.array([300.0]), np.array([0.7]), np.array([5.0]), np.ones(1, dtype=bool)
)


def run(
    count: int,
    *,
    dmp: Dmp = DMP,
    sees: Callable[[float], EllipsoidSet | None] = lambda time: None,
    coupled: CouplingParameters | None = None,
    **inputs: FloatArray,
) -> list[Segment]:
    """`count` steps from rest at the start, with a row of each input a step."""
    level, segment = ActionLevel(dmp, PARAMETERS), initial_segment(dmp, START, GOAL, 0.0)
    found = []
    for number in range(count):
        around = Surroundings.of(sees(number * STEP), coupled, None)
        given_ = {name: rows[number] for name, rows in inputs.items()}
        segment = level.step(segment, GOAL, around, number * STEP, STEP, **given_)
        found.append(segment)
    return found


def path(segments: list[Segment]) -> FloatArray:
    return np.array([segment.end.p_WE for segment in segments])


def random_coupling(rng: np.random.Generator, count: int, log_alpha: float) -> CouplingParameters:
    """Parameters up to a strength, about points of their own or about the obstacles."""
    rows = np.exp(rng.uniform([-3, -3, -2], [log_alpha, 1, 6], size=(count, 3)))
    centers = rng.normal(size=(count, 3)) if rng.integers(0, 2) else np.zeros((0, 3))
    return CouplingParameters(*rows.T.copy(), np.ones(count, dtype=bool), centers)


def random_ellipsoids(rng: np.random.Generator, p_WO: ArrayLike, size: float) -> EllipsoidSet:
    """About these centers, of semi-axes up to a size."""
    seen = balls(*np.asarray(p_WO), stamp=math.inf)
    count = len(seen)
    return replace(
        seen,
        R_WO=Rotation.random(count, random_state=int(rng.integers(1 << 31))).as_matrix(),
        semi_axes=rng.uniform(0.1 * size, size, size=(count, 3)),
    )


def random_route(rng: np.random.Generator, count: int, R_WL: FloatArray) -> Route:
    """Sides to pass on, at a clearance to lead at."""
    angles = rng.uniform(0.0, 6.28, count)
    direction = np.stack([np.zeros(count), np.cos(angles), np.sin(angles)], axis=1) @ R_WL.T
    return Route(
        direction_W=direction,
        normal_W=passing_normals(direction, R_WL),
        remaining_clearance=rng.uniform(0.05, 0.2, count),
        path_length=1.2,
    )


# Fade.


def test_the_coupling_fades_to_nothing_at_the_goal() -> None:
    state = PolicyState(p_WS=START, p_WG=GOAL)

    def fade_at(x: float) -> float:
        return goal_fade(replace(state, p_WE=np.array([x, 0.0, 0.0])), 0.4)

    assert fade_at(0.0) == fade_at(0.6) == 1.0
    assert fade_at(0.8) == pytest.approx(1.0 / 16.0)
    assert fade_at(1.0) == 0.0
    assert (np.diff([fade_at(x) for x in np.linspace(0.0, 1.0, 50)]) <= 0.0).all()
    assert goal_fade(state, 0.0) == 1.0


# Holds.


SHUT = Route(blocked=True, note="every side of obstacle 7 is forbidden")
UNSAFE = replace(COUPLED, hold=HoldCause.OBSTACLES, note="no motion that clears obstacle 7 found")


@pytest.mark.parametrize(
    ("said", "around"),
    [
        ("", [None]),
        ("", [EllipsoidSet(stamp=10.0)]),
        ("", [EllipsoidSet(stamp=9.51)]),
        ("", [one_ellipsoid(), None, Route()]),
        ("no observation yet", [EllipsoidSet()]),
        ("no observation yet (dark)", [EllipsoidSet(note="dark")]),
        ("obstacles not seen since t = 9.40 s", [EllipsoidSet(stamp=9.4)]),
        ("obstacles not seen since t = 9.40 s (dark)", [EllipsoidSet(stamp=9.4, note="dark")]),
        ("tool inside obstacle 7", [one_ellipsoid(10.0, (0.02, 0.0, 0.0))]),
        ("goal inside obstacle 7", [one_ellipsoid(10.0, (0.98, 0.0, 0.0))]),
        (SHUT.note, [one_ellipsoid(), None, SHUT]),
        (UNSAFE.note, [one_ellipsoid(), UNSAFE]),
    ],
)
def test_each_reason_to_hold_is_named(said: str, around: list) -> None:
    found = Surroundings.of(*(around + [None, None])[:3])
    places = kernel_arrays(START, GOAL)
    code = kernels.hold_code(*places, found.facts, found.obstacles, 10.0, 0.5)
    assert found.reason(code) == said


def test_a_hold_brings_the_motion_to_rest_within_the_hold_time() -> None:
    segments = run(400, sees=lambda time: one_ellipsoid(min(time, 0.3)), coupled=COUPLED)
    held = [bool(segment.state.note) for segment in segments]
    first = held.index(True)
    assert segments[first].state.stamp == pytest.approx(0.8, abs=2 * STEP)
    assert all(held[first:])
    still = segments[first + round(PARAMETERS.hold_time / STEP) :]
    for segment in still:
        assert segment.end.speed == 0.0
        np.testing.assert_array_equal(segment.end.p_WE, still[0].state.p_WE)
        assert segment.end.phase == still[0].state.phase
    assert np.linalg.norm(segments[first].v_WE) > 0.1
    # No jump of velocity on the way to rest.
    speed = [np.linalg.norm(segment.motion.course.v_end) for segment in segments[first:]]
    assert (np.diff(speed) <= 1e-9).all()


def test_a_goal_that_moves_turns_the_local_frame() -> None:
    goal = np.array([0.0, 1.0, 0.0])
    begun = initial_segment(DMP, START, GOAL, 0.0)
    after = LEVEL.step(begun, goal, Surroundings(), 0.0, STEP)
    np.testing.assert_array_equal(after.end.R_WL, local_frame(START, goal))
    np.testing.assert_array_equal(after.end.p_WG, goal)


# The compiled step against the readable one.


def random_scene(
    seed: int, guided: bool = True, about_route: bool = True
) -> tuple[PolicyState, EllipsoidSet, CouplingParameters, Route]:
    """A policy under way among up to six obstacles, their parameters and the sides to pass."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(1, 7))
    along = rng.uniform(0.0, 1.0, count)[:, None] * GOAL
    state = PolicyState(
        p_WE=rng.uniform(0.0, 0.9) * GOAL + rng.normal(scale=0.05, size=3),
        z_W=rng.normal(size=3) * rng.integers(0, 2),
        phase=rng.uniform(0.01, 1.0),
        p_WS=START,
        p_WG=GOAL,
        speed=rng.uniform(0.1, 0.5),
    )
    coupled = random_coupling(rng, count, 10.0)
    route = random_route(rng, count, np.eye(3))
    return (
        state,
        random_ellipsoids(rng, along + rng.normal(scale=0.1, size=(count, 3)), 0.1),
        replace(coupled, center_W=along if about_route else np.zeros((0, 3))),
        replace(route, remaining_clearance=guided * route.remaining_clearance),
    )


def step_of(state: PolicyState, *around: object) -> Segment:
    return LEVEL.step(Segment.resting(state), GOAL, Surroundings.of(*around), 0.0, STEP)


def headings_of(state: PolicyState, ellipsoids: EllipsoidSet, route: Route) -> FloatArray:
    leads = route.direction_W, route.normal_W, route.remaining_clearance
    return desired_headings(state, ellipsoids, *leads)


@given(seed=seeds, guided=st.booleans(), about_route=st.booleans())
@MANY
def test_the_compiled_step_is_the_readable_one(seed: int, guided: bool, about_route: bool) -> None:
    state, ellipsoids, coupled, route = random_scene(seed, guided, about_route)
    after = step_of(state, ellipsoids, coupled, route)
    alpha = goal_fade(state, PARAMETERS.fade) * coupled.alpha
    heading = headings_of(state, ellipsoids, route)
    rows = terms(
        coupled.center_W if about_route else ellipsoids.p_WO,
        np.column_stack([alpha, coupled.psi, coupled.kappa]),
        heading,
        route.normal_W,
        np.minimum(alpha, PARAMETERS.guidance_gain),
    )
    turn = turning(rows, in_plane=True)
    ds = 0.5 * (state.speed + after.end.speed) * STEP
    begin = (state.p_WE, state.z_W, state.phase)
    p_WE, z_W, phase = dmp_step(DMP, *begin, ds, GOAL, frame=np.eye(3), baseline=1.0, turn=turn)
    np.testing.assert_allclose(after.end.p_WE, p_WE, rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(after.end.z_W, z_W, rtol=0.0, atol=1e-9)
    assert after.end.phase == pytest.approx(phase, abs=1e-12)
    np.testing.assert_array_equal(after.v_WE, state.speed * state.z_W)
    assert after.state.tau == pytest.approx(1.2)


@given(seed=seeds)
@FEW
def test_a_decision_leads_as_the_headings_made_from_it_do(seed: int) -> None:
    state, ellipsoids, coupled, route = random_scene(seed)
    heading = headings_of(state, ellipsoids, route)
    followed = step_of(state, ellipsoids, coupled, route)
    given_ = step_of(state, ellipsoids, coupled, replace(route, heading_W=heading))
    np.testing.assert_array_equal(followed.end.z_W, given_.end.z_W)


# What the regulation may give beside its parameters.


def test_given_normals_go_before_the_route_and_end_its_guidance() -> None:
    state, ellipsoids, coupled, route = random_scene(9)
    other = -route.normal_W
    unguided = replace(route, normal_W=other, remaining_clearance=np.zeros(len(other)))
    expected = step_of(state, ellipsoids, coupled, unguided).end.z_W
    found = step_of(state, ellipsoids, replace(coupled, normal_W=other), route).end.z_W
    np.testing.assert_array_equal(found, expected)
    assert (step_of(state, ellipsoids, coupled, route).end.z_W != expected).any()
    # A zero row is none.
    none = replace(coupled, normal_W=np.zeros_like(other))
    np.testing.assert_array_equal(
        step_of(state, ellipsoids, none, route).end.z_W,
        step_of(state, ellipsoids, coupled, route).end.z_W,
    )


def test_a_given_tau_goes_before_the_length_of_the_route() -> None:
    state, ellipsoids, coupled, route = random_scene(9)
    for tau, expected in ((1.7, 1.7), (0.8, 0.8), (0.0, 1.2)):
        found = step_of(state, ellipsoids, replace(coupled, tau=tau), route)
        assert found.end.tau == pytest.approx(expected)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"normal_W": np.zeros((9, 3))}, "normal_W has 9 rows; there are"),
        ({"center_W": np.zeros((9, 3))}, "center_W has 9 rows; there are"),
        ({"psi": np.zeros(1)}, "alpha, psi, kappa must be"),
        ({"alpha": np.full(1, np.nan)}, "not finite"),
    ],
)
def test_parameters_that_cannot_be_used_are_refused(
    change: dict[str, FloatArray], said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        Surroundings.of(one_ellipsoid(), replace(COUPLED, **change), None)  # type: ignore[arg-type]


def test_rows_that_do_not_match_the_ellipsoids_are_refused() -> None:
    two = balls(START, GOAL, stamp=math.inf)
    with pytest.raises(ValueError, match="coupling_parameters has 1 rows; there are 2 ellipsoids"):
        step_of(PolicyState(p_WG=GOAL), two, COUPLED, None)
    with pytest.raises(ValueError, match="route has 3 rows; there are 1"):
        step_of(PolicyState(p_WG=GOAL), one_ellipsoid(), COUPLED, Route(heading_W=np.zeros((3, 3))))


# Speed scaled from outside.


def scaled_path(scales: ArrayLike, around: list) -> tuple[list[Segment], FloatArray]:
    """Steps at given shares of full speed; normalised times s of their ends."""
    seen, coupled = around
    scales = np.asarray(scales, dtype=float)
    found = run(len(scales), sees=lambda time: seen, coupled=coupled, speed_scale=scales)
    return found, -np.log([segment.end.phase for segment in found]) / DMP.alpha_k


@FEW
@given(seed=seeds, bent=st.booleans())
def test_the_path_does_not_depend_on_the_speed(seed: int, bent: bool) -> None:
    around = [one_ellipsoid(), COUPLED] if bent else [None, None]
    free, s_free = scaled_path(np.ones(480), around)
    rng = np.random.default_rng(seed)
    scaled, s = scaled_path(np.repeat(rng.choice([0.0, 0.2, 0.6, 1.0], 24), 25), around)
    expected = np.stack([np.interp(s, s_free, path(free)[:, axis]) for axis in range(3)], axis=1)
    np.testing.assert_allclose(path(scaled), expected, atol=2e-3 if bent else 2e-4)


def test_the_speed_follows_the_scale_at_the_rate_of_a_hold() -> None:
    found = run(240, speed_scale=np.repeat([0.0, 0.5, 1.0], 80))
    speed = np.array([segment.end.speed for segment in found]) * DMP.duration
    assert np.abs(np.diff(speed)).max() <= STEP / PARAMETERS.hold_time + 1e-12
    np.testing.assert_allclose(speed[[79, 159, 239]], [0.0, 0.5, 1.0], atol=1e-12)
    notes = [segment.note for segment in found]
    assert notes[:80] == ["speed_scale is 0"] * 80
    assert not any(notes[80:])


@pytest.mark.parametrize(("scale", "meant"), [(-1.0, 0.0), (math.nan, 0.0), (7.0, 1.0)])
def test_a_scale_out_of_range_is_taken_as_the_nearest(scale: float, meant: float) -> None:
    found, expected = (run(5, speed_scale=np.full(5, one)) for one in (scale, meant))
    np.testing.assert_array_equal(path(found), path(expected))


def test_what_is_held_before_it_has_begun_does_not_begin() -> None:
    # Its reason goes before that of the scale.
    unseen = run(10, sees=lambda time: EllipsoidSet(), speed_scale=np.zeros(10))
    assert (path(unseen) == START).all()
    assert {(one.end.phase, one.end.speed, one.note) for one in unseen} == {
        (1.0, 0.0, "no observation yet")
    }


@given(seed=seeds, step=st.floats(1e-5, STEP))
@settings(max_examples=200)
def test_a_motion_that_begins_straight_at_a_term_turns_to_its_side(seed: int, step: float) -> None:
    rng = np.random.default_rng(seed)
    start, goal = rng.uniform(-1.0, 1.0, (2, 3))
    R_WL = local_frame(start, goal)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    side = np.cos(angle) * R_WL[:, 1] + np.sin(angle) * R_WL[:, 2]
    coupled = CouplingParameters(
        *np.array([[100.0], [1.0], [1.0]]),
        in_range=np.ones(1, dtype=bool),
        center_W=(start + rng.uniform(0.3, 0.95) * (goal - start))[None],
        normal_W=np.cross(R_WL[:, 0], side)[None],
        verified=True,
    )
    around = Surroundings.of(EllipsoidSet(stamp=0.0), coupled, None)
    segment = initial_segment(DMP, start, goal, 0.0)
    # An imitated motion may begin with a little step back, and its heading passes through none.
    for row in range(round(0.1 / step)):
        segment = LEVEL.step(segment, goal, around, row * step, step)
    assert segment.end.z_W @ side > 0.0


# Displaced in real time.


def test_a_held_motion_is_displaced_and_keeps_phase_and_velocity() -> None:
    hold = round(PARAMETERS.hold_time / STEP)
    u = np.zeros((hold + 200, 3))
    u[hold:] = np.sin(np.linspace(0.0, np.pi, 200))[:, None] * [0.0, 0.3, 0.1]
    found = run(len(u), evasion=u, speed_scale=np.zeros(len(u)))
    before, after = found[hold - 1].end, found[-1].end
    assert after.phase == before.phase
    np.testing.assert_array_equal(after.z_W, before.z_W)
    expected = STEP * (0.5 * (u[hold:] + u[hold - 1 : -1])).sum(axis=0)
    np.testing.assert_allclose(after.p_WE - before.p_WE, expected, atol=1e-12)


@FEW
@given(seed=seeds, share=st.floats(0.01, 0.99))
def test_the_outputs_of_a_displaced_motion_are_consistent(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    u = np.cumsum(rng.normal(0.0, 0.01, (200, 3)), axis=0)
    found = run(200, evasion=u, sees=lambda time: one_ellipsoid(), coupled=COUPLED)
    for one, other in pairwise(found):
        np.testing.assert_array_equal(one.motion.course.v_end, other.v_WE)
        np.testing.assert_array_equal(one.end.p_WE, other.state.p_WE)
    segment, h = found[100], 1e-6
    between = segment.state.stamp + share * STEP
    for derivative in (0, 1):
        ends = [segment.interpolate(between + sign * h)[derivative] for sign in (-1, 1)]
        rate = (ends[1] - ends[0]) / (2.0 * h)
        np.testing.assert_allclose(
            rate, segment.interpolate(between)[derivative + 1], atol=1e-3, rtol=1e-3
        )
    # Beyond its end it goes on at its last velocity.
    later = segment.interpolate(segment.end.stamp + 0.01)
    np.testing.assert_allclose(later[0], segment.end.p_WE + 0.01 * segment.motion.course.v_end)
    assert not later[2].any()


def test_a_displacement_that_is_not_finite_is_none() -> None:
    found = run(5, evasion=np.full((5, 3), np.nan))
    np.testing.assert_array_equal(path(found), path(run(5)))


def test_a_resting_motion_begins_anew_where_it_is() -> None:
    state = PolicyState(
        p_WE=np.array([0.4, 0.1, 0.3]),
        z_W=np.array([0.2, 0.0, 0.1]),
        phase=0.3,
        p_WS=np.array([0.0, 0.0, 0.3]),
        p_WG=np.array([0.9, 0.2, 0.3]),
        note="held",
    )
    goal = np.array([0.9, 0.2, 0.4])
    begun = restarted(Segment.resting(state), goal, 2.0).end
    np.testing.assert_array_equal(begun.p_WE, state.p_WE)
    np.testing.assert_array_equal(begun.p_WS, state.p_WE)
    np.testing.assert_array_equal(begun.p_WG, goal)
    np.testing.assert_allclose(begun.R_WL[:, 0] * math.dist(goal, state.p_WE), goal - state.p_WE)
    assert (begun.phase, begun.speed, begun.stamp, begun.note) == (1.0, 0.0, 2.0, "held")
    assert not begun.z_W.any()


@pytest.mark.parametrize("change", [{"speed": 0.1}, {"p_WS": np.array([0.4, 0.1, 0.3])}])
def test_a_motion_that_goes_or_is_at_its_start_is_left(change: dict[str, object]) -> None:
    state = PolicyState(p_WE=np.array([0.4, 0.1, 0.3]), p_WG=np.array([0.9, 0.2, 0.3]), **change)
    segment = Segment.resting(state)
    assert restarted(segment, np.array([0.9, 0.2, 0.3]), 0.0) is segment


# The Lyapunov function.


def energy(dmp: Dmp, p: FloatArray, z: FloatArray, goal: FloatArray) -> float:
    left = goal - p
    return float(0.5 * dmp.alpha_x * dmp.beta_x * left @ left + 0.5 * z @ z)


@MANY
@given(
    seed=seeds,
    count=st.integers(0, 20),
    period=st.floats(1e-6, 10.0),
    alpha_x=st.floats(0.1, 200.0),
    ratio=st.sampled_from([0.01, 0.25, 4.0]),
    routed=st.booleans(),
    form=st.sampled_from(["counterphase", "printed"]),
)
def test_energy_never_rises_over_a_step(
    seed: int, count: int, period: float, alpha_x: float, ratio: float, routed: bool, form: str
) -> None:
    rng = np.random.default_rng(seed)
    dmp = Dmp(alpha_x, ratio * alpha_x, 4.6, np.ones(1), np.ones(1), np.zeros((3, 1)))
    level = ActionLevel(dmp, Policy(guidance=form))  # type: ignore[arg-type]
    p, z, start, goal = rng.normal(size=(4, 3))
    frame = local_frame(start, goal)
    segment = Segment.resting(
        PolicyState(p_WE=p, z_W=z, p_WS=start, p_WG=goal, R_WL=frame, speed=1.0)
    )
    around = Surroundings.of(
        random_ellipsoids(rng, rng.normal(size=(count, 3)), 0.3),
        random_coupling(rng, count, 30.0),
        random_route(rng, count, frame) if routed and count else None,
    )
    energies = [energy(dmp, p, z, goal)]
    for _ in range(5):
        segment = level.step(segment, goal, around, segment.end.stamp, period)
        energies.append(energy(dmp, segment.end.p_WE, segment.end.z_W, goal))
    assert (np.diff(energies) <= 1e-12 * energies[0]).all()


# Invariances of whole motions.


def scene(seed: int) -> Scene:
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
    rows = np.exp(rng.uniform(np.log([5, 0.4, 2]), np.log([200, 1.5, 30]), size=(count, 3)))
    coupling = CouplingParameters(*rows.T.copy(), np.ones(count, dtype=bool), feet)
    route = Route(
        direction_W=direction,
        normal_W=passing_normals(direction, R_WL),
        remaining_clearance=rng.uniform(0.05, 0.1, count),
        path_length=1.3,
    )
    return start, goal, random_ellipsoids(rng, feet, 0.03), coupling, route


def path_in(some: Scene, *, tau: float = 1.0, steps: int = 200) -> FloatArray:
    """Positions of the compiled action level from s = 0 to 1.2, where nothing holds it."""
    start, goal, ellipsoids, coupling, route = some
    dmp = replace(DMP, duration=1.0)
    state = replace(initial_segment(dmp, start, goal, 0.0).state, tau=tau, speed=1.0 / tau)
    level, segment = ActionLevel(dmp, PARAMETERS), Segment.resting(state)
    around = Surroundings.of(ellipsoids, replace(coupling, tau=tau), route)
    found = [start]
    for _ in range(round(1.2 * steps)):
        segment = level.step(segment, goal, around, segment.end.stamp, tau / steps)
        assume(segment.note == "")
        found.append(segment.end.p_WE)
    return np.array(found)


def moved(some: Scene, Q: FloatArray, shift: FloatArray, scale: float) -> Scene:
    """The scene turned (or mirrored) by Q, shifted and scaled."""
    start, goal, ellipsoids, coupling, route = some

    def place(points: FloatArray) -> FloatArray:
        return scale * points @ Q.T + shift

    # A mirror leaves left-handed axes: one of them turned round is the same ellipsoid.
    axes = Q @ ellipsoids.R_WO
    axes[..., 2] *= np.linalg.det(Q)
    return (
        place(start),
        place(goal),
        replace(
            ellipsoids,
            p_WO=place(ellipsoids.p_WO),
            R_WO=axes,
            semi_axes=scale * ellipsoids.semi_axes,
        ),
        replace(coupling, kappa=coupling.kappa / scale**2, center_W=place(coupling.center_W)),
        replace(
            route,
            direction_W=route.direction_W @ Q.T,
            normal_W=np.linalg.det(Q) * route.normal_W @ Q.T,
            remaining_clearance=scale * route.remaining_clearance,
            path_length=scale * route.path_length,
        ),
    )


@FEW
@given(
    seed=seeds,
    tau=st.floats(1.0, 20.0),
    power=st.floats(-3.0, 3.0),
    about=st.sampled_from(["vertical", "any axis"]),
    mirror=st.booleans(),
)
def test_the_path_moves_mirrors_and_scales_with_the_scene_at_any_tau(
    seed: int, tau: float, power: float, about: str, mirror: bool
) -> None:
    rng = np.random.default_rng([seed, 1])
    # The demonstration is straight: nothing is left of the vertical but in the normals.
    rotation = Rotation.random(random_state=seed)
    if about == "vertical":
        rotation = Rotation.from_rotvec([0.0, 0.0, rng.uniform(-3.0, 3.0)])
    Q = rotation.as_matrix() @ np.diag([1.0, -1.0 if mirror else 1.0, 1.0])
    some, shift, scale = scene(seed), rng.normal(size=3), 10.0**power
    again = (path_in(moved(some, Q, shift, scale), tau=tau) - shift) / scale
    # The turned numbers differ in their last bits, and three guided terms amplify that.
    np.testing.assert_allclose(again, path_in(some) @ Q.T, rtol=0.0, atol=1e-8)


# No input is too odd.


@MANY
@given(
    seed=seeds,
    size=st.sampled_from([1e-6, 1.0, 1e6]),
    alpha=st.sampled_from([0.0, 1e-300, 1.0, 1e300]),
    psi=st.sampled_from([1e-300, 1e-3, 1.0, 1e300]),
    kappa=st.sampled_from([0.0, 1.0, 1e300]),
    where=st.sampled_from(["start", "goal", "near the start", "middle"]),
    moving=st.sampled_from([-1.0, 0.0, 1.0]),
    period=st.sampled_from([1e-300, 1e-3, 1.0, 1e3]),
    about_route=st.booleans(),
)
def test_odd_but_finite_scenes_yield_finite_motions(
    seed: int,
    size: float,
    alpha: float,
    psi: float,
    kappa: float,
    where: str,
    moving: float,
    period: float,
    about_route: bool,
) -> None:
    rng = np.random.default_rng(seed)
    way = rng.normal(size=3)
    start, goal = np.zeros(3), size * way
    place = {"start": 0.0, "goal": 1.0, "near the start": 1e-12, "middle": 0.5}[where]
    R_WL = local_frame(start, goal)
    state = PolicyState(z_W=moving * goal, p_WG=goal, R_WL=R_WL, speed=rng.choice([0.0, 1e-9, 1.0]))
    centers = np.repeat(place * goal[None], 2, axis=0)
    ellipsoids = random_ellipsoids(rng, centers, 0.3)
    coupling = CouplingParameters(
        *(np.full(2, value) for value in (alpha, psi, kappa)),
        np.ones(2, dtype=bool),
        centers if about_route else np.zeros((0, 3)),
    )
    around = Surroundings.of(ellipsoids, coupling, random_route(rng, 2, R_WL))
    segment = Segment.resting(state)
    for _ in range(3):
        segment = LEVEL.step(segment, goal, around, segment.end.stamp, period)
        motion = segment.motion
        for bundle in (motion.begin, motion.end, motion.course):
            assert all(np.isfinite(value).all() for value in bundle)
