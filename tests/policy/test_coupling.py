"""Tests of the coupling terms: compiled and reference form, degenerate directions, exact flow.

Their invariances are tested in test_action.py.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import HEADING, N_COLUMNS, rotate, turn_step
from tests.reference.coupling import turning

seeds = st.integers(0, 2**32 - 1)
lengths = st.floats(0.0, 10.0)
MANY = settings(max_examples=200)


def turn_of(rows: FloatArray, p: FloatArray, z: FloatArray, step: float) -> FloatArray:
    """Returns the rotation vector (3,) of `turn_step` [rad]."""
    return np.array(turn_step(rows, 1.0, tuple(p), tuple(z), step))


def random_rows(rng: np.random.Generator, count: int, log_strength: float = 14.0) -> FloatArray:
    """Draws coupling terms near the origin, alpha up to exp(log_strength), half with guidance."""
    rows = rng.normal(size=(count, N_COLUMNS))
    rows[:, 3:6] = np.exp(rng.uniform([-3, -3, -2], [log_strength, 1, 6], size=(count, 3)))
    heading = rows[:, HEADING : HEADING + 3]
    heading /= np.linalg.norm(heading, axis=1)[:, None]
    heading *= rng.integers(0, 2, (count, 1))
    rows[:, 9:] *= rng.integers(0, 2, (count, 1))
    return rows


@MANY
@given(seed=seeds, count=st.integers(0, 6), step=lengths, strong=st.booleans())
def test_the_compiled_rotation_equals_the_reference_in_any_order_and_is_at_most_pi(
    seed: int, count: int, step: float, strong: bool
) -> None:
    rng = np.random.default_rng(seed)
    rows, (p, z) = random_rows(rng, count, 14.0 if strong else 3.0), rng.normal(size=(2, 3))
    rows[: count // 2, :3] = rows[: min(count, 1), :3]
    turn = turn_of(rows, p, z, step)
    # With strong terms the condition number of the linear system reaches 1e4, so that rounding
    # of the input changes the rotation by some 1e-12.
    close = 1e-9 if strong else 1e-11
    np.testing.assert_allclose(turn, turning(rows, p, z, step), rtol=0.0, atol=close)
    permuted = turn_of(rows[rng.permutation(count)], p, z, step)
    np.testing.assert_allclose(permuted, turn, rtol=0.0, atol=close)
    assert np.linalg.norm(turn) <= math.pi * (1.0 + 1e-12)
    expected = Rotation.from_rotvec(turn).apply(z)
    np.testing.assert_allclose(rotate(tuple(z), tuple(turn)), expected, rtol=0.0, atol=1e-12)


@MANY
@given(seed=seeds, step=st.sampled_from([0.0, 1e-3, 1.0]))
def test_compiled_form_equals_the_reference_for_degenerate_directions(
    seed: int, step: float
) -> None:
    rng = np.random.default_rng(seed)
    rows = rng.choice([-1.0, 0.0, 1.0], (3, N_COLUMNS))
    rows[:, 3:6] = rng.choice([0.0, 1.0, 1e5], 3)[:, None] * [1, 0, 0] + [0.0, 0.6, 3.0]
    heading = rows[:, HEADING : HEADING + 3]
    heading /= np.maximum(np.linalg.norm(heading, axis=1, keepdims=True), 1.0)
    p, z = rng.choice([-1.0, 0.0, 1.0], (2, 3))
    turn = turn_of(rows, p, z, step)
    np.testing.assert_allclose(turn, turning(rows, p, z, step), rtol=0.0, atol=1e-10)


@pytest.mark.parametrize("theta", [0.0, 0.1, 0.7, 1.6])
@pytest.mark.parametrize("size", [0.01, 0.3, 1.0, 10.0, 1000.0])
def test_an_avoidance_rotation_equals_the_exact_flow_within_three_percent(
    theta: float, size: float
) -> None:
    def flow(_: float, y: FloatArray) -> FloatArray:
        return size * np.exp(-((y / 0.8) ** 2))

    exact = solve_ivp(flow, (0.0, 1.0), [theta], method="LSODA", rtol=1e-10, atol=1e-12)
    row = np.array([[1.0, 0, 0, size, 0.8, 0, 0, 0, 0, 0, 0, 1]])
    turn = turn_of(row, np.zeros(3), np.array([np.cos(theta), np.sin(theta), 0.0]), 1.0)
    np.testing.assert_allclose(turn, [0, 0, min(exact.y[0, -1], np.pi) - theta], rtol=0.03)
