"""What every coupling term keeps, in each of its three forms.

The readable reference (`CouplingTerms`), the compiled composition (`turn_step`) and the
roll-outs' own single term (`turn_lanes`) are held to the same properties.
"""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy import coupling as kernels
from drake_oa.policy.coupling import GuidanceForm
from drake_oa.regulation import rollout_kernels as lanes
from tests.reference.coupling import CouplingTerms, coupling_force, rotate

Turned = Callable[..., FloatArray]
"""z (3,) after the turn, of the rows (K, 13), p, z, the step and whether in the planes."""

seeds = st.integers(0, 2**32 - 1)
decades = st.floats(-6.0, 6.0).map(lambda power: 10.0**power)
forms = st.sampled_from(["counterphase", "printed"])
FEW = settings(max_examples=30, derandomize=True)
MANY = settings(max_examples=60, derandomize=True)


def terms_of(
    rows: FloatArray, in_plane: bool, form: GuidanceForm = "counterphase"
) -> CouplingTerms:
    return CouplingTerms(
        p_WO=rows[:, 0:3],
        parameters=rows[:, 3:6],
        heading_W=rows[:, 6:9],
        normal_W=rows[:, 9:12],
        guidance_alpha=rows[:, 12],
        form=form,
        in_plane=in_plane,
    )


def readable(
    rows: FloatArray,
    p: FloatArray,
    z: FloatArray,
    step: float,
    in_plane: bool = True,
    form: GuidanceForm = "counterphase",
) -> FloatArray:
    return rotate(z, terms_of(rows, in_plane, form).turn(p, z, step))


def compiled(
    rows: FloatArray,
    p: FloatArray,
    z: FloatArray,
    step: float,
    in_plane: bool = True,
    form: GuidanceForm = "counterphase",
) -> FloatArray:
    turn = kernels.turn_step(rows, in_plane, form == "printed", 1000.0, *p, *z, step)
    return np.array(kernels.rotate(*z, *turn))


def single(
    rows: FloatArray, p: FloatArray, z: FloatArray, step: float, in_plane: bool = True
) -> FloatArray:
    """The roll-outs' term: one row, in its plane, unguided."""
    (row,) = rows
    gain = row[kernels.ALPHA] * step
    if not gain > 0.0:
        return z
    S, n = np.zeros(lanes.N_STATE), 8
    away = row[:3] - p
    psi = min(max(row[4], 1.0 / lanes.MOST_PSI), lanes.MOST_PSI)
    for at, value in (
        *zip((lanes.CX, lanes.CY, lanes.CZ), row[:3], strict=True),
        *zip((lanes.NX, lanes.NY, lanes.NZ), row[9:12] / np.linalg.norm(row[9:12]), strict=True),
        *zip((lanes.PX, lanes.PY, lanes.PZ), p, strict=True),
        *zip((lanes.WX, lanes.WY, lanes.WZ), z, strict=True),
        (lanes.TERM_PSI, psi),
        (lanes.INVERSE_PSI, 1.0 / psi),
        (lanes.STRENGTH, math.log(gain) - row[5] * (away @ away)),
        (lanes.WEIGHT, 1.0),
    ):
        S[at : at + n] = value
    lanes.turn_lanes(n, S)
    return np.array([S[lanes.WX], S[lanes.WY], S[lanes.WZ]])


composed = pytest.mark.parametrize("turned", [readable, compiled])
each = pytest.mark.parametrize("turned", [readable, compiled, single])


def random_rows(rng: np.random.Generator, count: int, *, guided: bool = True) -> FloatArray:
    """Terms of any strength about points around the origin, some of them guided."""
    rows = rng.normal(size=(count, kernels.N_COLUMNS))
    rows[:, 3:6] = np.exp(rng.uniform([-3, -3, -2], [14, 1, 6], size=(count, 3)))
    rows[:, 9:12] /= np.linalg.norm(rows[:, 9:12], axis=1)[:, None]
    guided_rows = rng.integers(0, 2, size=count) if guided else np.zeros(count)
    rows[:, 12] = np.exp(rng.uniform(-3, 14, size=count)) * guided_rows
    return rows


def count_for(turned: Turned, count: int) -> int:
    return 1 if turned is single else count


def angle(a: FloatArray, b: FloatArray) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def orthogonal_to(e: FloatArray, rng: np.random.Generator) -> FloatArray:
    across = np.cross(e, rng.normal(size=3))
    return across / np.linalg.norm(across)


# The force turns, it does not push.


@MANY
@given(
    seed=seeds,
    count=st.integers(1, 8),
    theta=st.sampled_from([0.0, 1e-12, 2e-9, 1e-6, 1.0, math.pi - 1e-6, math.pi - 2e-9, math.pi]),
    scale=decades,
    in_plane=st.booleans(),
    form=forms,
)
def test_the_force_is_orthogonal_to_the_velocity(
    seed: int, count: int, theta: float, scale: float, in_plane: bool, form: GuidanceForm
) -> None:
    rng = np.random.default_rng(seed)
    rows, p, e = random_rows(rng, count), rng.normal(size=3), rng.normal(size=3)
    e /= np.linalg.norm(e)
    rows[0, :3] = p + 0.5 * (math.cos(theta) * e + math.sin(theta) * orthogonal_to(e, rng))
    z = scale * e
    Omega = terms_of(rows, in_plane, form).turning_rate(p, z)
    force = coupling_force(Omega, z)
    assert abs(force @ z) <= 1e-12 * math.hypot(*Omega) * scale**2 + 1e-300


@each
@MANY
@given(
    seed=seeds,
    count=st.integers(1, 8),
    step=st.floats(0.0, 10.0),
    scale=decades,
    in_plane=st.booleans(),
)
def test_the_turn_keeps_the_speed(
    turned: Turned, seed: int, count: int, step: float, scale: float, in_plane: bool
) -> None:
    rng = np.random.default_rng(seed)
    rows, p = random_rows(rng, count_for(turned, count)), rng.normal(size=3)
    z = scale * rng.normal(size=3)
    after = turned(rows, p, z, step, in_plane)
    assert np.linalg.norm(after) == pytest.approx(np.linalg.norm(z), rel=1e-12)


# How far it turns.


@MANY
@given(seed=seeds, count=st.integers(1, 12), step=st.floats(0.0, 10.0), in_plane=st.booleans())
def test_no_turn_is_longer_than_pi(seed: int, count: int, step: float, in_plane: bool) -> None:
    rng = np.random.default_rng(seed)
    rows, (p, z) = random_rows(rng, count), rng.normal(size=(2, 3))
    rows[: count // 2, :3] = rows[0, :3]
    turns = (
        terms_of(rows, in_plane).turn(p, z, step),
        kernels.turn_step(rows, in_plane, False, 1000.0, *p, *z, step),
    )
    for turn in turns:
        assert np.linalg.norm(turn) <= math.pi * (1.0 + 1e-12)


@each
@MANY
@given(
    seed=seeds,
    step=st.floats(1e-6, 10.0),
    theta=st.sampled_from([0.0, 1e-12, 1e-6, 0.3, 1.5, 3.0, math.pi - 1e-6]),
)
def test_one_term_leads_away_from_the_centre_and_never_past_straight_away(
    turned: Turned, seed: int, step: float, theta: float
) -> None:
    # Seen along the normal: in the plane that it defines.
    rng = np.random.default_rng(seed)
    rows, (p, n) = random_rows(rng, 1, guided=False), rng.normal(size=(2, 3))
    n /= np.linalg.norm(n)
    to_O = orthogonal_to(n, rng)
    rows[0, :3], rows[0, 9:12] = p + 0.7 * to_O, n
    # Positive angles are about the normal; some heading leaves the plane.
    z = math.cos(theta) * to_O + math.sin(theta) * np.cross(n, to_O) + rng.normal() * n
    after = turned(rows, p, z, step)

    def seen(v: FloatArray) -> float:
        found = math.atan2(float(np.cross(n, to_O) @ v), float(to_O @ v))
        return found if found > -0.1 else found + 2.0 * math.pi

    assert theta - 1e-9 <= seen(after) <= math.pi + 1e-9
    # The part along the normal stays.
    assert after @ n == pytest.approx(z @ n, abs=1e-12)


@composed
@MANY
@given(seed=seeds, step=st.floats(1e-6, 10.0), head_on=st.booleans())
def test_one_term_of_the_p_plane_never_turns_past_straight_away(
    turned: Turned, seed: int, step: float, head_on: bool
) -> None:
    rng = np.random.default_rng(seed)
    rows, (p, z) = random_rows(rng, 1, guided=False), rng.normal(size=(2, 3))
    if head_on:
        rows[0, :3] = p + 0.7 * z
    to_O = rows[0, :3] - p
    after = turned(rows, p, z, step, in_plane=False)
    assert angle(to_O, after) >= angle(to_O, z) - 1e-9
    if not head_on:
        assert np.cross(to_O, z) @ np.cross(to_O, after) >= -1e-9


# Straight at the centre.


@each
@MANY
@given(
    seed=seeds,
    distance=decades,
    speed=decades,
    log_alpha=st.floats(0.0, 14.0),
    step=st.floats(1e-5, 1.0),
)
def test_straight_at_the_centre_the_given_normal_says_the_side(
    turned: Turned, seed: int, distance: float, speed: float, log_alpha: float, step: float
) -> None:
    rng = np.random.default_rng(seed)
    e = rng.normal(size=3)
    e /= np.linalg.norm(e)
    n = orthogonal_to(e, rng)
    rows = np.zeros((1, kernels.N_COLUMNS))
    rows[0, :3] = distance * e
    rows[0, 3:6] = math.exp(log_alpha), 0.6, 0.3 / distance**2
    rows[0, 9:12] = n
    side = np.cross(n, e)
    first = turned(rows, np.zeros(3), speed * e, step)
    assert first @ side > 0.0
    assert abs(first @ n) <= 1e-12 * speed
    np.testing.assert_array_equal(turned(rows, np.zeros(3), speed * e, step), first)
    rows[0, 9:12] = -n
    assert turned(rows, np.zeros(3), speed * e, step) @ side < 0.0


@composed
@FEW
@given(seed=seeds, upright=st.booleans(), along=st.booleans(), in_plane=st.booleans())
def test_without_a_usable_normal_the_stand_in_says_the_side(
    turned: Turned, seed: int, upright: bool, along: bool, in_plane: bool
) -> None:
    rng = np.random.default_rng(seed)
    e = np.array([0.0, 0.0, rng.choice([-1.0, 1.0])]) if upright else rng.normal(size=3)
    e /= np.linalg.norm(e)
    rows = np.zeros((1, kernels.N_COLUMNS))
    rows[0, :6] = *(0.5 * e), 100.0, 0.6, 1.0
    # A normal along the heading is as good as none, but not in its own plane.
    if along and not in_plane:
        rows[0, 9:12] = e
    about = np.array([1.0, 0.0, 0.0]) if upright else np.array([0.0, 0.0, 1.0])
    turn = np.cross(e, turned(rows, np.zeros(3), e, 1e-3, in_plane))
    assert turn @ about > 0.0
    assert abs(turn @ np.cross(e, about)) <= 1e-12 * np.linalg.norm(turn)


@each
@FEW
@given(seed=seeds, scale=st.sampled_from([1e-6, 1.0, 1e6]))
def test_at_the_centre_or_straight_away_from_it_nothing_turns(
    turned: Turned, seed: int, scale: float
) -> None:
    rng = np.random.default_rng(seed)
    rows, e = random_rows(rng, 1, guided=False), rng.normal(size=3)
    rows[0, 9:12] = orthogonal_to(e, rng)
    rows[0, 5] = 0.0
    z = scale * e
    for p in (rows[0, :3], rows[0, :3] + z):
        np.testing.assert_allclose(turned(rows, p, z, 0.1), z, rtol=0.0, atol=1e-12 * scale)
    np.testing.assert_array_equal(turned(rows, np.zeros(3), np.zeros(3), 0.1), 0.0)


# Invariances.


@each
@MANY
@given(
    seed=seeds,
    count=st.integers(1, 4),
    scale=decades,
    speed=decades,
    step=st.floats(1e-4, 0.1),
    in_plane=st.booleans(),
)
def test_the_turn_is_free_of_scale(
    turned: Turned,
    seed: int,
    count: int,
    scale: float,
    speed: float,
    step: float,
    in_plane: bool,
) -> None:
    rng = np.random.default_rng(seed)
    rows, (p, z) = random_rows(rng, count_for(turned, count)), rng.normal(size=(2, 3))
    scaled = rows.copy()
    scaled[:, :3] *= scale
    scaled[:, 5] /= scale**2
    once = turned(rows, p, z, step, in_plane)
    again = turned(scaled, scale * p, speed * z, step, in_plane)
    np.testing.assert_allclose(again, speed * once, rtol=0.0, atol=1e-9 * speed)


@each
@MANY
@given(
    seed=seeds,
    count=st.integers(1, 4),
    step=st.floats(1e-4, 0.1),
    in_plane=st.booleans(),
    mirror=st.booleans(),
)
def test_the_turn_moves_and_mirrors_with_the_scene(
    turned: Turned, seed: int, count: int, step: float, in_plane: bool, mirror: bool
) -> None:
    rng = np.random.default_rng(seed)
    rows, (p, z, shift) = random_rows(rng, count_for(turned, count)), rng.normal(size=(3, 3))
    Q = Rotation.random(random_state=seed).as_matrix()
    if mirror:
        Q = Q @ np.diag([1.0, -1.0, 1.0])
    moved = rows.copy()
    moved[:, :3] = rows[:, :3] @ Q.T + shift
    moved[:, 6:9] = rows[:, 6:9] @ Q.T
    # A normal says a sense of turning, which a mirror reverses.
    moved[:, 9:12] = np.linalg.det(Q) * rows[:, 9:12] @ Q.T
    once = turned(rows, p, z, step, in_plane)
    again = turned(moved, Q @ p + shift, Q @ z, step, in_plane)
    np.testing.assert_allclose(again, Q @ once, rtol=0.0, atol=1e-9)


@composed
@FEW
@given(seed=seeds, turn=st.floats(-3.1, 3.1), upright=st.booleans())
def test_without_normals_it_turns_with_the_scene_about_the_vertical(
    turned: Turned, seed: int, turn: float, upright: bool
) -> None:
    # The stand-in for a missing normal is the vertical: only such rotations leave it alone.
    assume(not upright or turn == 0.0)
    rng = np.random.default_rng(seed)
    rows, e = random_rows(rng, 2), rng.normal(size=3)
    rows[:, 9:12] = 0.0
    rows[0, :3] = 0.4 * e
    Q = Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
    moved = rows.copy()
    moved[:, :3], moved[:, 6:9] = rows[:, :3] @ Q.T, rows[:, 6:9] @ Q.T
    once = turned(rows, np.zeros(3), e, 1e-3, in_plane=False)
    again = turned(moved, np.zeros(3), Q @ e, 1e-3, in_plane=False)
    np.testing.assert_allclose(again, Q @ once, rtol=0.0, atol=1e-9)


# No input is too odd.

powers = st.one_of(st.just(0.0), st.floats(-300.0, 300.0).map(lambda power: 10.0**power))
lengths = st.one_of(st.just(0.0), st.floats(-12.0, 6.0).map(lambda power: 10.0**power))


@each
@settings(max_examples=150, derandomize=True)
@given(
    seed=seeds,
    alpha=powers,
    psi=powers.filter(lambda value: value > 0.0),
    kappa=powers,
    place=lengths,
    distance=lengths,
    speed=lengths,
    offset=st.sampled_from([0.0, 1e-12, 1.0]),
    sense=st.sampled_from([-1.0, 0.0, 1.0]),
    step=st.sampled_from([0.0, 1e-300, 1e-3, 1.0, 1e3]),
    in_plane=st.booleans(),
)
@example(0, 1e300, 1e-20, 0.0, 0.0, 1.0, 1.0, 1e-12, 1.0, 1.0, True)
@example(0, 1.0, 1e300, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 1e-3, True)
def test_odd_but_finite_input_yields_a_finite_turn(
    turned: Turned,
    seed: int,
    alpha: float,
    psi: float,
    kappa: float,
    place: float,
    distance: float,
    speed: float,
    offset: float,
    sense: float,
    step: float,
    in_plane: bool,
) -> None:
    # Straight toward (sense 1), away from (-1) or across (0) the obstacle, up to the offset.
    rng = np.random.default_rng(seed)
    e = rng.normal(size=3)
    e /= np.linalg.norm(e)
    across = orthogonal_to(e, rng)
    normal = np.cross(e, across)
    p, z = place * rng.normal(size=3), speed * e
    row = np.zeros(kernels.N_COLUMNS)
    row[:3] = p + distance * (sense * e + offset * across)
    row[3:6] = alpha, psi, kappa
    row[6:9], row[9:12], row[12] = -e, normal, alpha
    rows = np.array([row] * count_for(turned, 3))
    after = turned(rows, p, z, step, in_plane)
    assert np.isfinite(after).all()
    assert np.linalg.norm(after) == pytest.approx(speed, rel=1e-12, abs=1e-300)
