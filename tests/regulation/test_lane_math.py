"""The elementary functions of the loops over lanes against NumPy's."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from drake_oa.regulation.lane_math import angle, exponential, half_sine_cosine, log1p_positive


def applied(function: Callable[..., Any], *arguments: ArrayLike) -> NDArray[Any]:
    rows = np.broadcast_arrays(*(np.asarray(a, float) for a in arguments))
    return np.array([function(*row) for row in zip(*rows, strict=True)], dtype=float)


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e6])
def test_angle(size: float) -> None:
    truth = np.linspace(0.0, np.pi, 2001)
    got = applied(angle, size * np.sin(truth).clip(0.0), size * np.cos(truth))
    np.testing.assert_allclose(got, truth, atol=1e-12)
    assert angle(0.0, 0.0) == 0.0


def test_exponential() -> None:
    exponent = np.concatenate((-np.geomspace(1e-6, 41.0, 2001), (690.0, 50.0, 1e-300)))
    np.testing.assert_allclose(applied(exponential, exponent), np.exp(exponent), rtol=1e-11)
    assert 1e301 < exponential(1e300) < np.inf
    for least in (-np.inf, -1e300, np.nan):
        assert 0.0 < exponential(least) < 1e-24


def test_logarithm() -> None:
    value = np.geomspace(1e-12, 1e300, 4001)
    np.testing.assert_allclose(applied(log1p_positive, value), np.log1p(value), rtol=1e-11)


def test_sine_and_cosine() -> None:
    half = np.linspace(-np.pi / 2, np.pi / 2, 2001)
    got = applied(half_sine_cosine, half)
    np.testing.assert_allclose(got[:, 0], np.sin(half), rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(got[:, 1], np.cos(half), rtol=0.0, atol=1e-11)
