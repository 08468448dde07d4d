"""Tests of ellipsoids: enclosing fit with certificate, signed distance, plane section."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from drake_oa.geometry.directions import sphere_points
from drake_oa.geometry.ellipsoid import (
    Ellipsoid,
    enclosing_ellipsoid,
    plane_section,
    signed_distance,
)

seed = st.integers(0, 10**6)
semi_axis = st.floats(0.01, 1.0)
semi_axes3 = st.tuples(semi_axis, semi_axis, semi_axis).map(np.array)
POINT = np.zeros((1, 3))
HAND = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.03, 0.03) for z in (-0.02, 0.14)])


def pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Returns a random position (3,) [m] and rotation (3, 3)."""
    return rng.uniform(-1.0, 1.0, 3), Rotation.random(rng=rng).as_matrix()


def units(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Returns random unit vectors (..., 3)."""
    vectors = rng.normal(size=(*shape, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def volume(e: Ellipsoid) -> float:
    """Computes the volume of an ellipsoid [m^3]."""
    return 4.0 / 3.0 * np.pi * np.prod(e.semi_axes)


def gauges(e: Ellipsoid, points: np.ndarray, tool: np.ndarray) -> np.ndarray:
    """Computes the gauges of all points dilated by all corners of a tool."""
    sums = (points[:, None, :] - tool[None, :, :]).reshape(-1, 3)
    return np.linalg.norm((sums - e.center) @ e.R / e.semi_axes, axis=1)


@given(seed, st.integers(1, 200), st.integers(0, 3), st.sampled_from([POINT, HAND]))
def test_every_point_dilated_by_every_corner_is_enclosed(seed, count, rank, tool):
    rng = np.random.default_rng(seed)
    p, R = pose(rng)
    points = (rng.normal(size=(count, 3)) * [0.2, 0.1, 0.02] * (np.arange(3) < rank)) @ R.T + p
    e = enclosing_ellipsoid(points, tool=tool)
    assert 0.0 <= e.gauge <= 1.0
    assert gauges(e, points, tool).max() == pytest.approx(e.gauge, abs=1e-9)
    np.testing.assert_allclose(e.R.T @ e.R, np.eye(3), atol=1e-12)
    assert np.linalg.det(e.R) == pytest.approx(1.0)
    assert (e.semi_axes >= 1e-3).all()
    assert (np.diff(e.semi_axes) <= 0.0).all()


def test_volume_is_near_the_optimum_of_a_simplex_and_an_ellipsoid():
    rng = np.random.default_rng(1)
    simplex = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    ball = sphere_points(156)
    for points, radius in ((simplex, np.sqrt(3.0)), (ball, 1.0)):
        stretch = np.array([0.3, 0.1, 0.05])
        p, R = pose(rng)
        e = enclosing_ellipsoid((points * stretch) @ R.T + p)
        optimum = Ellipsoid(np.zeros(3), np.eye(3), radius * stretch, 0.0)
        assert 0.98 <= volume(e) / volume(optimum) <= 1.03
        assert gauges(e, (points * stretch) @ R.T + p, POINT).max() <= 1.0 + 1e-12


def reference_distance(y: np.ndarray, e: np.ndarray) -> float:
    """Computes the signed distance of a point off the principal planes, by bracketing.

    The root of Eberly's secular equation is bracketed; y (3,) is the point in the ellipsoid's axes
    and e (3,) are the semi-axes [m].
    """
    y = np.abs(y)
    size = float(e.max() + y.max())
    # Bounds of the root above the pole, widened by a factor of two against rounding.
    pole = -(e.min() ** 2)
    low = pole + 0.5 * (np.max(-(e**2) + e * y) - pole)
    high = 2.0 * np.linalg.norm(e * y) + 1e-9 * size - e.min() ** 2

    def secular(t: float) -> float:
        """Computes the residual of the secular equation."""
        return float(np.sum((e * y / (t + e**2)) ** 2) - 1.0)

    t = brentq(secular, low, high, xtol=1e-18, rtol=1e-15, maxiter=500)
    return float(np.sign(t) * np.linalg.norm(t * y / (t + e**2)))


@given(seed, semi_axes3, st.floats(-3.0, 1.0))
def test_distance_agrees_with_a_bracketing_solver(seed, e, decades):
    rng = np.random.default_rng(seed)
    p, R = pose(rng)
    local = units(rng) * e.max() * 10.0**decades
    expected = reference_distance(local, e)
    assert signed_distance(p + R @ local, p, R, e) == pytest.approx(expected, abs=1e-9)


@given(
    semi_axes3,
    st.tuples(*[st.sampled_from([0.0, 1e-300, 1e-160, 1e-30, 1e-9, 0.3, 0.99, 1.0, 5.0])] * 3),
)
def test_distance_on_axes_and_planes_of_symmetry_is_continuous(e, share):
    y = np.array(share) * e
    expected = reference_distance(y + 1e-7, e)
    assert signed_distance(y, np.zeros(3), np.eye(3), e) == pytest.approx(expected, abs=1e-6)


@given(seed, semi_axes3)
def test_section_lies_on_the_ellipsoid_and_on_the_plane(seed, e):
    rng = np.random.default_rng(seed)
    _, R = pose(rng)
    e1, e2, n = Rotation.random(rng=rng).as_matrix().T
    semi_axes, axes = plane_section(R, e, e1, e2)
    turn = np.linspace(0.0, 2.0 * np.pi, 25)
    ring = np.cos(turn)[:, None] * semi_axes[0] * axes[0]
    ring += np.sin(turn)[:, None] * semi_axes[1] * axes[1]
    np.testing.assert_allclose(np.linalg.norm(ring @ R / e, axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(ring @ n, 0.0, atol=1e-12)
    assert axes[0] @ e1 >= np.cos(np.pi / 4) - 1e-12
