"""The elementary functions of the loops over lanes against NumPy's, in either precision."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numba import njit
from numpy.typing import ArrayLike, NDArray

from drake_oa.regulation import lane_math as functions

TURNS = np.linspace(-np.pi, np.pi, 2001)


@njit
def polar(sine, cosine):  # type: ignore[no-untyped-def]
    return functions.angle(sine, cosine)


@njit
def decay(exponent):  # type: ignore[no-untyped-def]
    return functions.exp_negative(exponent)


def applied(function: Callable[..., Any], dtype: type, *arguments: ArrayLike) -> NDArray[Any]:
    rows = np.broadcast_arrays(*(np.asarray(a, dtype) for a in arguments))
    return np.array([function(*row) for row in zip(*rows, strict=True)], dtype=float)


@pytest.mark.parametrize(("dtype", "atol"), [(np.float32, 1e-6), (np.float64, 1e-12)])
@pytest.mark.parametrize("size", [1e-12, 1.0, 1e6])
def test_angle(dtype: type, atol: float, size: float) -> None:
    truth = np.linspace(0.0, np.pi, 2001)
    got = applied(polar, dtype, size * np.sin(truth).clip(0.0), size * np.cos(truth))
    np.testing.assert_allclose(got, truth, atol=atol)
    assert polar(dtype(0.0), dtype(0.0)) == 0.0


@pytest.mark.parametrize(("dtype", "rtol"), [(np.float32, 4e-6), (np.float64, 1e-11)])
def test_exponential(dtype: type, rtol: float) -> None:
    exponent = -np.geomspace(1e-6, 41.0, 2001).astype(dtype)
    got = applied(decay, dtype, exponent)
    np.testing.assert_allclose(got, np.exp(exponent.astype(float)), rtol=rtol)
    assert 0.0 < decay(dtype(-1e6)) < 1e-17


def test_exponential_at_its_bounds() -> None:
    for exponent in (690.0, 50.0, 1e-300):
        got = functions.exponential_double(exponent)
        np.testing.assert_allclose(got, np.exp(exponent), rtol=1e-11)
    assert 1e301 < functions.exponential_double(1e300) < np.inf
    for exponent in (-np.inf, -1e300, np.nan):
        assert 0.0 < functions.exponential_double(exponent) < 1e-24


@pytest.mark.parametrize(
    ("function", "dtype", "most", "rtol"),
    [
        (functions.log1p_positive_single, np.float32, 1e20, 2e-6),
        (functions.log1p_positive_double, np.float64, 1e300, 1e-11),
    ],
)
def test_logarithm(function: Callable[..., Any], dtype: type, most: float, rtol: float) -> None:
    value = np.geomspace(1e-12, most, 4001).astype(dtype)
    truth = np.log1p(value.astype(float))
    np.testing.assert_allclose(applied(function, dtype, value), truth, rtol=rtol)


def test_sine_and_cosine() -> None:
    got = applied(functions.sine_cosine_single, np.float32, TURNS)
    np.testing.assert_allclose(got, np.column_stack((np.sin(TURNS), np.cos(TURNS))), atol=2e-6)
    half = 0.5 * TURNS
    got = applied(functions.half_sine_cosine_double, np.float64, half)
    np.testing.assert_allclose(got[:, 0], np.sin(half), rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(got[:, 1], np.cos(half), rtol=0.0, atol=1e-11)
