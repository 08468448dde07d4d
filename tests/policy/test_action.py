"""One step of the action level: holds, temporal scaling, coupling, interpolation."""

import math
from collections.abc import Callable
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    HoldCause,
    PolicyState,
    Route,
)
from drake_oa.common.numba_tools import kernel_arrays
from drake_oa.policy import action_kernels as kernels
from drake_oa.policy.action import (
    ActionLevel,
    Segment,
    Surroundings,
    initial_segment,
    restarted,
)
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import Dmp, imitate, local_frame, minimum_jerk, spring_flow
from drake_oa.policy.guidance import desired_headings, passing_normals
from tests.builders import balls
from tests.reference.coupling import terms, turning
from tests.reference.dmp import forcing
from tests.reference.dmp import step as dmp_step

START, GOAL = np.zeros(3), np.array([1.0, 0.0, 0.0])
DMP = imitate(*minimum_jerk(START, GOAL, duration=2.0))
UNFORCED = replace(DMP, weights=np.zeros_like(DMP.weights))
STEP = 0.005
PARAMETERS = Policy()


def advance(
    dmp: Dmp,
    state: PolicyState,
    p_WG: FloatArray,
    ellipsoids: EllipsoidSet | None,
    coupled: CouplingParameters | None,
    route: Route | None,
    *,
    time: float = 0.0,
    step: float = STEP,
) -> Segment:
    """One step, with what came on the ports."""
    around = Surroundings.of(ellipsoids, coupled, route)
    return ActionLevel(dmp, PARAMETERS).step(Segment.resting(state), p_WG, around, time, step)


def hold_reason(
    state: PolicyState,
    ellipsoids: EllipsoidSet | None,
    route: Route | None,
    coupled: CouplingParameters | None = None,
) -> str:
    """Why the motion must not go on at 10 s."""
    around = Surroundings.of(ellipsoids, coupled, route)
    places = kernel_arrays(state.p_WE, state.p_WG)
    return around.reason(kernels.hold_code(*places, around.facts, around.obstacles, 10.0, 0.5))


def goal_fade(state: PolicyState, fade: float) -> float:
    """At a state, by the kernel."""
    to_G = state.p_WG - state.p_WE
    return kernels.goal_fade(float(to_G @ to_G), state.baseline, fade)


def one_ellipsoid(
    stamp: float = math.inf, center: tuple[float, float, float] = (0.5, 0.02, 0.0)
) -> EllipsoidSet:
    return balls(center, radius=0.03, stamp=stamp, ids=[7])


def coupling(alpha: float = 300.0, rows: int = 1) -> CouplingParameters:
    return CouplingParameters(
        np.full(rows, alpha), np.full(rows, 0.7), np.full(rows, 5.0), np.ones(rows, dtype=bool)
    )


def run(
    count: int,
    *,
    dmp: Dmp = DMP,
    sees: Callable[[float], EllipsoidSet | None] = lambda time: None,
    coupled: CouplingParameters | None = None,
    route: Route | None = None,
    step: float = STEP,
) -> list[Segment]:
    """`count` steps from rest at the start."""
    state = initial_segment(dmp, START, GOAL, 0.0).state
    state = replace(state, speed=1.0 / dmp.duration)
    found = []
    for number in range(count):
        time = number * step
        segment = advance(dmp, state, GOAL, sees(time), coupled, route, time=time, step=step)
        found.append(segment)
        state = segment.end
    return found


def assert_same(one: object, other: object) -> None:
    """Two numbers, arrays or bundles of them."""
    if hasattr(one, "_fields"):
        for a, b in zip(one, other, strict=True):  # type: ignore[call-overload]
            assert_same(a, b)
    else:
        np.testing.assert_array_equal(one, other)  # type: ignore[arg-type]


def test_what_is_held_before_it_has_begun_does_not_begin() -> None:
    unseen = run(10, sees=lambda time: EllipsoidSet())
    assert (path(unseen) == START).all()
    assert all(segment.end.phase == 1.0 and segment.end.speed == 0.0 for segment in unseen)


def path(segments: list[Segment]) -> FloatArray:
    return np.array([segment.end.p_WE for segment in segments])


# Interpolation.


def test_the_desired_motion_is_continuous_from_step_to_step() -> None:
    segments = run(300, sees=lambda time: one_ellipsoid(), coupled=coupling())
    for before, after in pairwise(segments):
        time = after.state.stamp
        for derivative in (0, 1):
            np.testing.assert_allclose(
                before.interpolate(time, derivative),
                after.interpolate(time, derivative),
                atol=1e-12,
            )


def test_a_segment_begins_and_ends_where_the_policy_says() -> None:
    segment = run(100)[-1]
    np.testing.assert_array_equal(segment.interpolate(segment.state.stamp, 0), segment.state.p_WE)
    np.testing.assert_allclose(segment.interpolate(segment.end.stamp, 0), segment.end.p_WE)
    np.testing.assert_allclose(
        segment.interpolate(segment.end.stamp, 1), segment.motion.course.v_end
    )


def test_beyond_its_end_a_segment_goes_on_at_its_last_velocity() -> None:
    segment = run(100)[-1]
    later = segment.interpolate(segment.end.stamp + 0.01, 0)
    np.testing.assert_allclose(later, segment.end.p_WE + 0.01 * segment.motion.course.v_end)
    assert not segment.interpolate(segment.end.stamp + 0.01, 2).any()


def test_a_segment_at_rest_does_not_move() -> None:
    segment = Segment.at_rest(np.array([1.0, 2.0, 3.0]))
    for time in (0.0, 1.0):
        np.testing.assert_array_equal(segment.interpolate(time, 0), [1.0, 2.0, 3.0])
        assert not segment.interpolate(time, 1).any()
        assert not segment.interpolate(time, 2).any()


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


def reason(ellipsoids: EllipsoidSet | None, route: Route | None = None, **place: FloatArray) -> str:
    state = PolicyState(p_WE=START, p_WS=START, p_WG=GOAL)
    return hold_reason(replace(state, **place), ellipsoids, route)


@pytest.mark.parametrize(
    ("ellipsoids", "said"),
    [
        (None, ""),
        (EllipsoidSet(stamp=10.0), ""),
        (EllipsoidSet(stamp=9.51), ""),
        (one_ellipsoid(math.inf), ""),
        (EllipsoidSet(), "no observation yet"),
        (EllipsoidSet(note="dark"), "no observation yet (dark)"),
        (EllipsoidSet(stamp=9.4), "obstacles not seen since t = 9.40 s"),
        (EllipsoidSet(stamp=9.4, note="dark"), "obstacles not seen since t = 9.40 s (dark)"),
        (one_ellipsoid(10.0, (0.02, 0.0, 0.0)), "tool inside obstacle 7"),
        (one_ellipsoid(10.0, (0.98, 0.0, 0.0)), "goal inside obstacle 7"),
    ],
)
def test_each_reason_to_hold_is_named(ellipsoids: EllipsoidSet | None, said: str) -> None:
    assert reason(ellipsoids) == said


def test_a_route_without_an_allowed_side_is_a_reason_to_hold() -> None:
    shut = Route(blocked=True, note="every side of obstacle 7 is forbidden")
    assert reason(one_ellipsoid(10.0), shut) == shut.note
    assert reason(one_ellipsoid(10.0), Route()) == ""


def test_coupling_parameters_that_clear_nothing_are_a_reason_to_hold() -> None:
    state = PolicyState(p_WE=START, p_WS=START, p_WG=GOAL)
    found = hold_reason(
        state,
        one_ellipsoid(10.0),
        None,
        replace(
            coupling(),
            hold=HoldCause.OBSTACLES,
            note="no motion that clears obstacle 7 found",
        ),
    )
    assert found == "no motion that clears obstacle 7 found"


def test_a_hold_brings_the_motion_to_rest_within_the_hold_time() -> None:
    segments = run(400, sees=lambda time: one_ellipsoid(min(time, 0.3)), coupled=coupling())
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


def interrupted(time: float) -> EllipsoidSet:
    """Seen afresh except from 0.4 s to 1.5 s."""
    return one_ellipsoid(0.4 if 0.4 < time < 1.5 else time)


def test_a_hold_does_not_change_the_motion_of_the_spring() -> None:
    # Without forcing each step is the exact flow, whatever its length: at every phase
    # the motion is the flow from the start, hold or no hold.
    segments = run(800, dmp=UNFORCED, sees=interrupted)
    assert any(segment.state.note for segment in segments)
    for segment in segments:
        s = -math.log(segment.end.phase) / UNFORCED.alpha_k
        a, _, c, _ = spring_flow(UNFORCED.alpha_x, UNFORCED.beta_x, s)
        np.testing.assert_allclose(segment.end.p_WE, GOAL + a * (START - GOAL), atol=1e-9)
        np.testing.assert_allclose(segment.end.z_W, c * (START - GOAL), atol=1e-7)


def test_a_hold_does_not_change_the_path_among_obstacles() -> None:
    def at_common_phases(segments: list[Segment]) -> FloatArray:
        phase = np.array([segment.end.phase for segment in segments])
        moving = np.append(np.diff(phase) < 0.0, True)
        wanted = np.linspace(0.98, 0.02, 200)
        points = path(segments)[moving]
        return np.stack(
            [np.interp(-wanted, -phase[moving], points[:, i]) for i in range(3)], axis=1
        )

    def difference(step: float) -> float:
        freely, held = (
            run(round(4.0 / step), sees=sees, coupled=coupling(30.0), step=step)
            for sees in (lambda time: one_ellipsoid(), interrupted)
        )
        assert any(segment.state.note for segment in held)
        return float(np.abs(at_common_phases(freely) - at_common_phases(held)).max())

    # What is left is the integration error of unequal steps.
    assert difference(0.005) < 1e-3
    assert difference(0.00125) < 1e-4


def test_a_longer_way_takes_longer_and_none_less_than_the_demonstration() -> None:
    def tau_for(length: float) -> float:
        route = Route(path_length=length)
        return run(1, sees=lambda time: EllipsoidSet(stamp=time), route=route)[0].state.tau

    assert tau_for(1.5) == pytest.approx(1.5)
    assert tau_for(0.0) == tau_for(1.0) == 1.0


def test_the_motion_ends_at_the_goal_also_past_an_obstacle() -> None:
    segments = run(480, sees=lambda time: one_ellipsoid(), coupled=coupling())
    np.testing.assert_allclose(segments[-1].end.p_WE, GOAL, atol=1e-3)
    assert np.abs(path(segments)[:, 1]).max() > 0.05


def test_a_goal_that_moves_turns_the_local_frame() -> None:
    state = initial_segment(DMP, START, GOAL, 0.0).state
    goal = np.array([0.0, 1.0, 0.0])
    after = advance(DMP, state, goal, None, None, None)
    np.testing.assert_array_equal(after.end.R_WL, local_frame(START, goal))
    np.testing.assert_array_equal(after.end.p_WG, goal)


# Errors.


@pytest.mark.parametrize(
    ("coupled", "route", "said"),
    [
        (coupling(rows=2), None, "coupling_parameters has 2 rows; there are 1 ellipsoids"),
        (coupling(), Route(heading_W=np.zeros((3, 3))), "route has 3 rows; there are 1"),
    ],
)
def test_rows_that_do_not_match_the_ellipsoids_are_refused(
    coupled: CouplingParameters, route: Route | None, said: str
) -> None:
    with pytest.raises(ValueError, match=said):
        run(1, sees=lambda time: one_ellipsoid(), coupled=coupled, route=route)


def test_a_baseline_of_zero_length_is_refused() -> None:
    with pytest.raises(ValueError, match="apart"):
        initial_segment(DMP, START, START, 0.0)
    state = initial_segment(DMP, START, GOAL, 0.0).state
    with pytest.raises(ValueError, match="apart"):
        advance(DMP, state, START, None, None, None)


# The compiled step against the readable one.


def random_scene(
    seed: int, guided: bool, about_route: bool
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
    ellipsoids = EllipsoidSet(
        stamp=0.0,
        p_WO=along + rng.normal(scale=0.1, size=(count, 3)),
        R_WO=Rotation.random(count, random_state=seed).as_matrix(),
        semi_axes=rng.uniform(0.02, 0.1, size=(count, 3)),
        ids=np.arange(count),
    )
    angles = rng.uniform(0.0, 6.28, count)
    direction = np.stack([np.zeros(count), np.cos(angles), np.sin(angles)], axis=1)
    route = Route(
        direction_W=direction,
        normal_W=passing_normals(direction, np.eye(3)),
        remaining_clearance=rng.uniform(0.05, 0.2, count) if guided else np.zeros(count),
        path_length=1.2,
    )
    parameters = CouplingParameters(
        np.exp(rng.uniform(-3.0, 10.0, count)),
        rng.uniform(0.2, 1.5, count),
        np.exp(rng.uniform(-2.0, 5.0, count)),
        np.ones(count, dtype=bool),
        along if about_route else np.zeros((0, 3)),
    )
    return state, ellipsoids, parameters, route


def step_of(
    state: PolicyState, ellipsoids: EllipsoidSet, coupled: CouplingParameters, route: Route
) -> Segment:
    return advance(DMP, state, GOAL, ellipsoids, coupled, route)


@given(seed=st.integers(0, 2**32 - 1), guided=st.booleans(), about_route=st.booleans())
@settings(max_examples=60)
def test_the_compiled_step_is_the_readable_one(seed: int, guided: bool, about_route: bool) -> None:
    state, ellipsoids, coupled, route = random_scene(seed, guided, about_route)
    after = step_of(state, ellipsoids, coupled, route)
    alpha = goal_fade(state, PARAMETERS.fade) * coupled.alpha
    heading = desired_headings(
        state,
        ellipsoids,
        route.direction_W,
        route.normal_W,
        route.remaining_clearance,
    )
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


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_a_decision_leads_as_the_headings_made_from_it_do(seed: int) -> None:
    state, ellipsoids, coupled, route = random_scene(seed, True, True)
    heading = desired_headings(
        state,
        ellipsoids,
        route.direction_W,
        route.normal_W,
        route.remaining_clearance,
    )
    followed = step_of(state, ellipsoids, coupled, route)
    given_ = step_of(state, ellipsoids, coupled, replace(route, heading_W=heading))
    np.testing.assert_array_equal(followed.end.z_W, given_.end.z_W)


def test_several_steps_at_once_are_the_same_as_one_after_the_other() -> None:
    level = ActionLevel(DMP, PARAMETERS)
    around = Surroundings.of(one_ellipsoid(), coupling(), None)
    begin = segment = initial_segment(DMP, START, GOAL, 0.0)
    for _ in range(50):
        segment = level.step(segment, GOAL, around, segment.end.stamp, STEP)
    at_once = level.step(begin, GOAL, around, 0.0, STEP, 50)
    assert_same(at_once.motion, segment.motion)
    with pytest.raises(ValueError, match="count must be at least 1"):
        level.step(begin, GOAL, around, 0.0, STEP, 0)


def test_a_state_is_laid_out_and_read_back_unchanged() -> None:
    state = random_scene(3, True, True)[0]
    state = replace(state, hold=HoldCause.OBSTACLES, note="held", tau=1.5, stamp=2.0)
    for read in (Segment.resting(state).state, Segment.resting(state).end):
        for item in fields(PolicyState):
            np.testing.assert_array_equal(getattr(read, item.name), getattr(state, item.name))


@pytest.mark.parametrize("weights", [DMP.weights, UNFORCED.weights])
def test_the_compiled_forcing_is_the_readable_one(weights: FloatArray) -> None:
    dmp = replace(DMP, weights=weights)
    # Beyond the last centre the basis functions underflow.
    narrow = replace(dmp, widths=1e4 * dmp.widths)
    for k in (1.0, 0.5, 0.011, 1e-3, 0.0):
        np.testing.assert_allclose(dmp.forcing(k), forcing(dmp, k), rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(narrow.forcing(k), forcing(narrow, k), rtol=1e-9)


# What the regulation may give beside its parameters.


def test_given_normals_go_before_the_route_and_end_its_guidance() -> None:
    state, ellipsoids, coupled, route = random_scene(8, True, True)
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
    state, ellipsoids, coupled, route = random_scene(8, True, True)
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
        Surroundings.of(one_ellipsoid(), replace(coupling(), **change), None)  # type: ignore[arg-type]


# Speed scaled from outside.


def scaled_path(scales: FloatArray, around: Surroundings) -> tuple[list[Segment], FloatArray]:
    """Steps at given shares of full speed; normalised times s of their ends."""
    level = ActionLevel(DMP, PARAMETERS)
    segment = initial_segment(DMP, START, GOAL, 0.0)
    found, s = [], []
    for number, scale in enumerate(scales):
        segment = level.step(segment, GOAL, around, number * STEP, STEP, speed_scale=float(scale))
        found.append(segment)
        s.append(-math.log(segment.end.phase) / DMP.alpha_k)
    return found, np.array(s)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), bent=st.booleans())
def test_the_path_does_not_depend_on_the_speed(seed: int, bent: bool) -> None:
    around = Surroundings.of(one_ellipsoid() if bent else None, coupling() if bent else None, None)
    free, s_free = scaled_path(np.ones(480), around)
    rng = np.random.default_rng(seed)
    profile = np.repeat(rng.choice([0.0, 0.2, 0.6, 1.0], 24), 25)
    scaled, s = scaled_path(profile, around)
    expected = np.stack([np.interp(s, s_free, path(free)[:, axis]) for axis in range(3)], axis=1)
    np.testing.assert_allclose(path(scaled), expected, atol=2e-3 if bent else 2e-4)


def test_the_speed_follows_the_scale_at_the_rate_of_a_hold() -> None:
    profile = np.concatenate([np.zeros(80), np.full(80, 0.5), np.ones(80)])
    found, _ = scaled_path(profile, Surroundings())
    speed = np.array([segment.end.speed for segment in found]) * DMP.duration
    assert np.abs(np.diff(speed)).max() <= STEP / PARAMETERS.hold_time + 1e-12
    np.testing.assert_allclose(speed[[79, 159, 239]], [0.0, 0.5, 1.0], atol=1e-12)
    notes = [segment.note for segment in found]
    assert notes[:80] == ["speed_scale is 0"] * 80
    assert not any(notes[80:])


@pytest.mark.parametrize(("scale", "meant"), [(-1.0, 0.0), (math.nan, 0.0), (7.0, 1.0)])
def test_a_scale_out_of_range_is_taken_as_the_nearest(scale: float, meant: float) -> None:
    found, _ = scaled_path(np.full(5, scale), Surroundings())
    expected, _ = scaled_path(np.full(5, meant), Surroundings())
    np.testing.assert_array_equal(path(found), path(expected))


def test_a_reason_of_its_own_goes_before_the_scale() -> None:
    around = Surroundings.of(EllipsoidSet(), None, None)
    found, _ = scaled_path(np.zeros(1), around)
    assert found[0].note == "no observation yet"


# Displaced in real time.


@given(seed=st.integers(0, 2**32 - 1), step=st.floats(1e-5, STEP))
@settings(deadline=None, max_examples=200)
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
    segment, level = initial_segment(DMP, start, goal, 0.0), ActionLevel(DMP, PARAMETERS)
    # An imitated motion may begin with a little step back, and its heading passes through none.
    segment = level.step(segment, goal, around, 0.0, step, count=round(0.1 / step))
    assert segment.end.z_W @ side > 0.0


def displaced_steps(
    velocity: FloatArray, *, scale: float = 1.0, evasion: bool = True
) -> list[Segment]:
    """Steps with a velocity (N, 3) of displacement at the end of each."""
    level = ActionLevel(DMP, PARAMETERS)
    segment = initial_segment(DMP, START, GOAL, 0.0)
    found = []
    for number, u in enumerate(velocity):
        given = {"evasion": u} if evasion else {}
        around = Surroundings()
        segment = level.step(segment, GOAL, around, number * STEP, STEP, speed_scale=scale, **given)
        found.append(segment)
    return found


def test_no_displacement_is_the_same_to_the_last_bit() -> None:
    still = displaced_steps(np.zeros((100, 3)))
    plain = displaced_steps(np.zeros((100, 3)), evasion=False)
    for one, other in zip(still, plain, strict=True):
        assert_same(one.motion, other.motion)


def test_a_held_motion_is_displaced_and_keeps_phase_and_velocity() -> None:
    hold = round(PARAMETERS.hold_time / STEP)
    u = np.zeros((hold + 200, 3))
    u[hold:] = np.sin(np.linspace(0.0, np.pi, 200))[:, None] * [0.0, 0.3, 0.1]
    found = displaced_steps(u, scale=0.0)
    before, after = found[hold - 1].end, found[-1].end
    assert after.phase == before.phase
    np.testing.assert_array_equal(after.z_W, before.z_W)
    expected = STEP * (0.5 * (u[hold:] + u[hold - 1 : -1])).sum(axis=0)
    np.testing.assert_allclose(after.p_WE - before.p_WE, expected, atol=1e-12)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), share=st.floats(0.01, 0.99))
def test_the_outputs_of_a_displaced_motion_are_consistent(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    u = np.cumsum(rng.normal(0.0, 0.01, (200, 3)), axis=0)
    found = displaced_steps(u)
    for one, other in pairwise(found):
        np.testing.assert_array_equal(one.motion.course.v_end, other.v_WE)
        np.testing.assert_array_equal(one.end.p_WE, other.state.p_WE)
    segment, h = found[100], 1e-6
    between = segment.state.stamp + share * STEP
    for derivative in (0, 1):
        ends = [segment.interpolate(between + sign * h, derivative) for sign in (-1, 1)]
        rate = (ends[1] - ends[0]) / (2.0 * h)
        np.testing.assert_allclose(
            rate, segment.interpolate(between, derivative + 1), atol=1e-3, rtol=1e-3
        )


def test_the_spring_leads_on_from_where_it_was_displaced_to() -> None:
    u = np.zeros((1200, 3))
    u[100:200, 1] = 0.3
    found = displaced_steps(u)
    assert path(found)[:, 1].max() > 0.05
    np.testing.assert_allclose(path(found)[-1], GOAL, atol=1e-3)


def test_a_displacement_that_is_not_finite_is_none() -> None:
    found = displaced_steps(np.full((5, 3), np.nan))
    plain = displaced_steps(np.zeros((5, 3)), evasion=False)
    np.testing.assert_array_equal(path(found), path(plain))


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
