"""The coupling terms: their rates, the readable form, and what every term keeps.

Their invariances are tested with the whole action level.
"""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy import coupling as kernels
from drake_oa.policy.coupling import PARALLEL, dead_zone_free_rate, original_rate
from tests.reference.coupling import terms, turning

seeds = st.integers(0, 2**32 - 1)
finite = st.floats(allow_nan=False, allow_infinity=False)
nonnegative = st.floats(0.0, allow_infinity=False)
small = st.sampled_from([-1.0, 0.0, 1.0])
FEW = settings(max_examples=30)
MANY = settings(max_examples=60)
ORIGIN, AHEAD = np.zeros(3), np.array([1.0, 0.0, 0.0])


def turn_of(
    rows: FloatArray,
    p: FloatArray,
    z: FloatArray,
    step: float,
    in_plane: bool = False,
    printed: bool = False,
    max_rate: float = 1000.0,
) -> FloatArray:
    """(3,) turn of the compiled composition."""
    return np.array(
        kernels.turn_step(rows, in_plane, False, printed, max_rate, tuple(p), tuple(z), step)
    )


def turned_by(z: FloatArray, turn: FloatArray) -> FloatArray:
    return np.array(kernels.rotate(tuple(z), tuple(turn)))


def turned(
    rows: FloatArray, p: FloatArray, z: FloatArray, step: float, in_plane: bool = True
) -> FloatArray:
    """z after the turn."""
    return turned_by(z, turn_of(rows, p, z, step, in_plane))


def random_rows(
    rng: np.random.Generator, count: int, *, guided: bool = True, log_strength: float = 14.0
) -> FloatArray:
    """Terms about points around the origin, the strongest of exp(log_strength), some guided."""
    rows = rng.normal(size=(count, kernels.N_COLUMNS))
    rows[:, 3:6] = np.exp(rng.uniform([-3, -3, -2], [log_strength, 1, 6], size=(count, 3)))
    rows[:, 9:12] /= np.linalg.norm(rows[:, 9:12], axis=1)[:, None]
    guided_rows = rng.integers(0, 2, size=count) if guided else np.zeros(count)
    rows[:, 12] = np.exp(rng.uniform(-3, log_strength, size=count)) * guided_rows
    return rows


def angle(a: FloatArray, b: FloatArray) -> float:
    return math.atan2(float(np.linalg.norm(np.cross(a, b))), float(a @ b))


def orthogonal_to(e: FloatArray, rng: np.random.Generator) -> FloatArray:
    across = np.cross(e, rng.normal(size=3))
    return across / np.linalg.norm(across)


# Rates, and the readable form.


def test_original_rate_has_a_dead_zone_and_the_new_one_has_none() -> None:
    theta = np.array([-0.5, 0.0, 1e-3, 0.5])
    original = original_rate(theta, 1000.0, 20.0 / np.pi)
    assert original[1] == 0.0
    assert original[2] < original[3] == -original[0]
    np.testing.assert_allclose(original[3], 500.0 * np.exp(-10.0 / np.pi))
    rate = dead_zone_free_rate(theta, 0.2, 100.0, 0.7, 5.0)
    assert rate[1] > rate[2] > rate[3] == -rate[0] > 0.0
    np.testing.assert_allclose(rate[3], 100.0 * np.exp(-((0.5 / 0.7) ** 2)) * np.exp(-0.2))


@settings(max_examples=200)
@given(
    seed=seeds,
    count=st.integers(0, 6),
    step=st.floats(1e-6, 1.0),
    stiff=st.booleans(),
    printed=st.booleans(),
    in_plane=st.booleans(),
)
@example(4719, 6, math.exp(0.5), True, False, False)
def test_the_compiled_turn_is_the_readable_one(
    seed: int, count: int, step: float, stiff: bool, printed: bool, in_plane: bool
) -> None:
    rng = np.random.default_rng(seed)
    rows = random_rows(rng, count, log_strength=14.0 if stiff else 3.0)
    p, z = rng.normal(size=(2, 3))
    readable = turning(rows, in_plane=in_plane, printed=printed)(p, z, step)
    # Divisors reach 1e4 where terms are strong, and with them the condition number of the
    # composition: the turn itself changes by some 1e-12 with the last bit of its input.
    found = turn_of(rows, p, z, step, in_plane, printed)
    np.testing.assert_allclose(found, readable, rtol=0.0, atol=1e-10 if stiff else 1e-12)


@settings(max_examples=200)
@given(
    rows=st.lists(
        st.tuples(
            *[small] * 3,
            st.sampled_from([0.0, 1.0, 1e5]),
            st.just(0.6),
            st.sampled_from([0.0, 3.0]),
            *[small] * 6,
            st.sampled_from([0.0, 1.0, 1e5]),
        ),
        min_size=1,
        max_size=3,
    ).map(np.array),
    at=st.tuples(*[small] * 6),
    step=st.sampled_from([0.0, 1e-3, 1.0]),
    printed=st.booleans(),
    in_plane=st.booleans(),
)
def test_they_agree_where_directions_coincide_vanish_or_oppose(
    rows: FloatArray, at: tuple[float, ...], step: float, printed: bool, in_plane: bool
) -> None:
    p, z = np.array(at).reshape(2, 3)
    readable = turning(rows, in_plane=in_plane, printed=printed)(p, z, step)
    found = turn_of(rows, p, z, step, in_plane, printed)
    np.testing.assert_allclose(found, readable, rtol=0.0, atol=1e-11)


@settings(max_examples=200)
@given(seed=seeds, log_angle=st.floats(-20.0, 8.0))
def test_the_rotation_is_that_of_rodrigues(seed: int, log_angle: float) -> None:
    z, w = np.random.default_rng(seed).normal(size=(2, 3))
    w *= math.exp(log_angle)
    # A large angle is known to its last bit only.
    close = 1e-12 * max(1.0, float(np.linalg.norm(w)) / 1e3)
    expected = Rotation.from_rotvec(w).apply(z)
    np.testing.assert_allclose(turned_by(z, w), expected, rtol=0.0, atol=close)
    assert kernels.rotate(tuple(z), (0.0, 0.0, 0.0)) == tuple(z)


# How far it turns.


@MANY
@given(seed=seeds, count=st.integers(1, 12), step=st.floats(0.0, 10.0), in_plane=st.booleans())
def test_no_turn_is_longer_than_pi_or_depends_on_the_order(
    seed: int, count: int, step: float, in_plane: bool
) -> None:
    rng = np.random.default_rng(seed)
    rows, (p, z) = random_rows(rng, count), rng.normal(size=(2, 3))
    rows[: count // 2, :3] = rows[0, :3]
    turn = turn_of(rows, p, z, step, in_plane)
    assert np.linalg.norm(turn) <= math.pi * (1.0 + 1e-12)
    # In whatever order the obstacles come.
    again = turn_of(rows[rng.permutation(count)], p, z, step, in_plane)
    np.testing.assert_allclose(again, turn, rtol=0.0, atol=1e-9)


@MANY
@given(
    seed=seeds,
    step=st.floats(1e-6, 10.0),
    theta=st.sampled_from([0.0, 1e-12, 1e-6, 0.3, 1.5, 3.0, math.pi - 1e-6]),
)
def test_one_term_leads_away_from_the_centre_and_never_past_straight_away(
    seed: int, step: float, theta: float
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

    # Directions are parallel below a sine of PARALLEL: the turn is known no better than that.
    assert theta - 1e-9 <= seen(after) <= math.pi + PARALLEL + 1e-9
    # The part along the normal stays.
    assert after @ n == pytest.approx(z @ n, abs=1e-12)


@MANY
@given(seed=seeds, h=st.floats(1e-6, 10.0), log_alpha=st.floats(-3, 14), form=st.booleans())
def test_guidance_alone_never_turns_past_where_it_leads(
    seed: int, h: float, log_alpha: float, form: bool
) -> None:
    p, z, center, normal, v_d = np.random.default_rng(seed).normal(size=(5, 3))
    rows = terms(center, [0.0, 1.0, 1.0], v_d, normal, math.exp(log_alpha))
    after = turned_by(z, turn_of(rows, p, z, h, printed=form))
    assert angle(after, v_d) <= angle(z, v_d) + 1e-9
    assert np.cross(z, v_d) @ np.cross(after, v_d) >= -1e-9


@pytest.mark.parametrize("theta", [0.0, 0.1, 0.7, 1.6])
@pytest.mark.parametrize("size", [0.01, 0.3, 1.0, 10.0, 1000.0])
def test_an_avoidance_turn_is_the_exact_flow_within_three_hundredths(
    theta: float, size: float
) -> None:
    psi = 0.8
    exact = solve_ivp(
        lambda _, y: size * np.exp(-((y / psi) ** 2)),
        (0.0, 1.0),
        [theta],
        method="LSODA",
        rtol=1e-10,
        atol=1e-12,
    )
    z = np.array([np.cos(theta), np.sin(theta), 0.0])
    turn = turn_of(terms(AHEAD, [size, psi, 0.0], normal=[0, 0, 1.0]), ORIGIN, z, 1.0)
    np.testing.assert_allclose(turn, [0, 0, min(exact.y[0, -1], np.pi) - theta], rtol=0.03)
    assert turn[2] <= dead_zone_free_rate(theta, 1.0, size, psi, 0.0) * (1.0 + 1e-12)


@pytest.mark.parametrize("h", [1e-4, 0.1, 0.4, 3.0])
def test_the_saturated_guidance_turn_is_the_exact_flow(h: float) -> None:
    theta, gain, limit = 2.0, 3.0 * np.e, 2.5
    rows = terms([0.5, 0, 0], [0.0, 1, 0], [np.cos(theta), np.sin(theta), 0], guidance_alpha=3.0)
    linear = theta - limit / gain
    if h < linear / limit:
        expected = limit * h
    else:
        expected = theta - limit / gain * np.exp(-gain * (h - linear / limit))
    turn = turn_of(rows, ORIGIN, AHEAD, h, printed=True, max_rate=limit)
    np.testing.assert_allclose(turn, [0, 0, expected], rtol=1e-12)


# Straight at the centre.


@FEW
@given(seed=seeds, upright=st.booleans(), along=st.booleans(), in_plane=st.booleans())
def test_without_a_usable_normal_the_stand_in_says_the_side(
    seed: int, upright: bool, along: bool, in_plane: bool
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


# No input is too odd.


@settings(max_examples=200)
@given(
    at=st.tuples(*[finite] * 6),
    row=st.tuples(
        *[finite] * 3,
        nonnegative,
        st.floats(0.0, exclude_min=True, allow_infinity=False),
        nonnegative,
        *[finite] * 6,
        nonnegative,
    ),
    step=st.floats(0.0, 1e3),
    printed=st.booleans(),
    in_plane=st.booleans(),
)
@example((0.0,) * 6, (*[0.0] * 3, 1.0, 1.0, 1.0, *[0.0] * 6, 1.0), 0.1, True, True)
@example(
    (0.0, 0.0, 0.0, 1.0, 0.0, 0.0),
    (1.0, 0.0, 0.0, 1e308, 1e-308, 0.0, -1.0, 0.0, 0.0, 5e-324, 0.0, 0.0, 1e308),
    *(1e3, True, False),
)
def test_no_finite_input_yields_anything_but_a_finite_turn(
    at: tuple[float, ...], row: tuple[float, ...], step: float, printed: bool, in_plane: bool
) -> None:
    p, z = np.array(at).reshape(2, 3)
    again = [*row[2::-1], *row[3:6], *row[8:5:-1], *row[9:]]
    turn = turn_of(np.array([row, again]), p, z, step, in_plane, printed)
    assert np.isfinite(turn).all()
    assert np.linalg.norm(turn) <= np.pi * (1.0 + 1e-12)


@given(theta=st.floats(1e-3, 3.1), gamma=st.floats(0.1, 1e4), beta=st.floats(0.1, 20.0))
def test_the_compiled_original_term_is_the_printed_one(
    theta: float, gamma: float, beta: float
) -> None:
    heading, step = (np.cos(theta), np.sin(theta), 0.0), 1e-9
    _, explicit, divisor = kernels.avoidance_term(
        (1.0, 0.0, 0.0), heading, (0.0, 0.0, 0.0), gamma, 1.0 / beta, 7.0, False, True, step
    )
    expected = original_rate(theta, gamma, beta)
    assert explicit / divisor / step == pytest.approx(expected, rel=1e-6, abs=1e-12)
    _, explicit, divisor = kernels.avoidance_term(
        (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0), 1e4, 1.0, 0.0, False, True, 1.0
    )
    # No further than straight away.
    assert explicit / divisor == pytest.approx(0.5 * np.pi)
