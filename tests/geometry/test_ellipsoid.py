"""Dilation, the enclosing fit and its certificate, distance, section, support, tangents."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from drake_oa.geometry.ellipsoid import (
    Ellipsoid,
    certified,
    dilate,
    enclosing_ellipsoid,
    nearest,
    plane_section,
    shape_matrix,
    signed_distance,
    unit_directions,
)
from drake_oa.geometry.ellipsoid_kernels import tangent_headings

# The first call compiles.
untimed = settings(deadline=None)
seed = st.integers(0, 10**6)
semi_axis = st.floats(0.01, 1.0)
semi_axes3 = st.tuples(semi_axis, semi_axis, semi_axis).map(np.array)
HAND = np.array([[x, y, z] for x in (-0.1, 0.1) for y in (-0.03, 0.03) for z in (-0.02, 0.14)])
POINT = np.zeros((1, 3))


def pose(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(-1.0, 1.0, 3), Rotation.random(rng=rng).as_matrix()


def units(rng: np.random.Generator, *shape: int) -> np.ndarray:
    vectors = rng.normal(size=(*shape, 3))
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def basis(rng: np.random.Generator) -> np.ndarray:
    return Rotation.random(rng=rng).as_matrix().T


def volume(e: Ellipsoid) -> float:
    return 4.0 / 3.0 * np.pi * np.prod(e.semi_axes)


def support(n: np.ndarray, R: np.ndarray, e: np.ndarray) -> np.ndarray:
    """How far an ellipsoid about the origin reaches along unit vectors n (..., 3)."""
    return np.linalg.norm(n @ R * e, axis=-1)


# Dilation.


@pytest.mark.parametrize("count", [12, 42, 162, 642])
def test_directions_are_unit_distinct_and_symmetric(count):
    u = unit_directions(count)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, atol=1e-15)
    np.testing.assert_array_equal(u[count // 2 :], -u[: count // 2])
    gaps = u @ u.T - 2.0 * np.eye(count)
    assert gaps.max() < 1.0 - 1e-6


def test_an_unknown_number_of_directions_is_refused():
    with pytest.raises(ValueError, match=r"count is 100; it must be one of \[12, 42, 162"):
        unit_directions(100)


@untimed
@given(seed, st.integers(1, 30), st.integers(0, 3))
def test_dilated_points_are_the_minkowski_sums_support(seed, count, rank):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1.0, 1.0, (count, 3)) * (np.arange(3) < rank)
    found = dilate(points, HAND)
    all_sums = (points[:, None, :] - HAND[None, :, :]).reshape(-1, 3)
    u = unit_directions()
    np.testing.assert_allclose((found @ u.T).max(axis=0), (all_sums @ u.T).max(axis=0), atol=1e-12)
    assert len(found) <= 162
    assert len(np.unique(found, axis=0)) == len(found) or count > 1


def test_the_tool_is_reflected_about_its_reference_point():
    found = dilate(POINT, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.1]])
    np.testing.assert_allclose(found.min(axis=0), [0.0, 0.0, -0.1])
    np.testing.assert_allclose(found.max(axis=0), [0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("points", "tool", "message"),
    [
        (np.zeros((0, 3)), POINT, "points must be a non-empty"),
        (np.zeros(3), POINT, r"points must be a non-empty \(N, 3\) array, not of shape \(3,\)"),
        (POINT, np.zeros((0, 3)), "tool must be a non-empty"),
        (np.array([[0, 0, 0], [np.nan, 0, 0]]), POINT, "points must be finite; 1 of 2 rows"),
        (POINT, np.full((1, 3), np.inf), "tool must be finite"),
    ],
)
@pytest.mark.parametrize("function", [dilate, lambda p, t: enclosing_ellipsoid(p, tool=t)])
def test_bad_clouds_are_named(function, points, tool, message):
    with pytest.raises(ValueError, match=message):
        function(points, tool)


# The enclosing ellipsoid.


def gauges(e: Ellipsoid, points: np.ndarray, tool: np.ndarray) -> np.ndarray:
    sums = (points[:, None, :] - tool[None, :, :]).reshape(-1, 3)
    return np.linalg.norm((sums - e.center) @ e.R / e.semi_axes, axis=1)


@untimed
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


@pytest.mark.parametrize(("tolerance", "excess"), [(1e-2, 0.03), (1e-3, 0.003)])
def test_volume_is_near_the_optimum_of_a_box(tolerance, excess):
    half = np.array([0.2, 0.1, 0.05])
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * half
    p, R = pose(np.random.default_rng(0))
    e = enclosing_ellipsoid(corners @ R.T + p, tolerance)
    optimum = Ellipsoid(semi_axes=np.sqrt(3.0) * half)
    assert 1.0 - 1e-9 <= volume(e) / volume(optimum) <= 1.0 + excess
    np.testing.assert_allclose(e.semi_axes, optimum.semi_axes, rtol=2.0 * excess)
    np.testing.assert_allclose(e.center, p, atol=0.01 * half.max())


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3])
def test_volume_is_near_the_optimum_of_a_simplex_and_an_ellipsoid(tolerance):
    rng = np.random.default_rng(1)
    simplex = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1.0]])
    ball = unit_directions(642)
    for points, radius in ((simplex, np.sqrt(3.0)), (ball, 1.0)):
        stretch = np.array([0.3, 0.1, 0.05])
        p, R = pose(rng)
        e = enclosing_ellipsoid((points * stretch) @ R.T + p, tolerance)
        optimum = Ellipsoid(semi_axes=radius * stretch)
        assert 0.98 <= volume(e) / volume(optimum) <= 1.0 + 3.0 * tolerance
        assert gauges(e, (points * stretch) @ R.T + p, POINT).max() <= 1.0 + 1e-12


def test_dense_cloud_of_a_box_and_a_box_tool_gives_the_box_sum():
    rng = np.random.default_rng(2)
    half, tool_half = np.array([0.1, 0.15, 0.05]), np.array([0.05, 0.02, 0.1])
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    cloud = np.concatenate([rng.uniform(-1.0, 1.0, (2000, 3)), corners]) * half
    e = enclosing_ellipsoid(cloud, 1e-3, tool=corners * tool_half)
    expected = np.sort(np.sqrt(3.0) * (half + tool_half))[::-1]
    np.testing.assert_allclose(e.semi_axes, expected, rtol=2e-3)


@untimed
@given(seed, st.floats(0.1, 10.0))
def test_fit_moves_and_scales_with_the_cloud(seed, factor):
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(60, 3)) * [0.3, 0.1, 0.05]
    p, R = pose(rng)
    e = enclosing_ellipsoid(cloud)
    moved = enclosing_ellipsoid(factor * cloud @ R.T + p)
    # Other support points are drawn in other poses: equal to the tolerance, not exactly.
    assert volume(moved) == pytest.approx(factor**3 * volume(e), rel=0.05)


def test_fit_is_the_same_every_time_and_far_from_the_origin():
    cloud = np.random.default_rng(3).normal(size=(300, 3)) * [0.3, 0.1, 0.05]
    e, again = enclosing_ellipsoid(cloud, tool=HAND), enclosing_ellipsoid(cloud, tool=HAND)
    np.testing.assert_array_equal(e.R, again.R)
    np.testing.assert_array_equal(e.semi_axes, again.semi_axes)
    far = enclosing_ellipsoid(cloud + 1e5, tool=HAND)
    np.testing.assert_allclose(far.semi_axes, e.semi_axes, rtol=1e-6)
    assert far.gauge <= 1.0


def test_thin_clouds_have_the_fit_of_their_plane_and_line():
    square = np.array([[1, 1, 0], [1, -1, 0], [-1, 1, 0], [-1, -1, 0.0]]) * [0.2, 0.1, 0.0]
    e = enclosing_ellipsoid(square, 1e-4, minimum_semi_axis=0.005)
    np.testing.assert_allclose(e.semi_axes, [0.2 * 2**0.5, 0.1 * 2**0.5, 0.005], rtol=1e-3)
    line = np.linspace([0.0, 0.0, 0.0], [0.0, 0.4, 0.0], 9)
    e = enclosing_ellipsoid(line, 1e-4)
    np.testing.assert_allclose(e.semi_axes, [0.2, 1e-3, 1e-3], rtol=1e-3)
    np.testing.assert_allclose(e.center, [0.0, 0.2, 0.0], atol=1e-9)
    e = enclosing_ellipsoid([[1.0, 2.0, 3.0]] * 5)
    np.testing.assert_allclose(e.semi_axes, [1e-3] * 3)
    np.testing.assert_allclose(e.center, [1.0, 2.0, 3.0])


def test_certificate_reports_or_inflates():
    small = Ellipsoid(semi_axes=np.array([0.1, 0.1, 0.1]))
    report = certified(small, [[0.2, 0.0, 0.0]], POINT, inflate=False)
    assert report.gauge == pytest.approx(2.0)
    np.testing.assert_array_equal(report.semi_axes, small.semi_axes)
    inflated = certified(small, [[0.2, 0.0, 0.0]], POINT)
    assert 1.0 - 1e-12 < inflated.gauge <= 1.0
    np.testing.assert_allclose(inflated.semi_axes, 0.2)


@pytest.mark.parametrize("kwargs", [{"tolerance": 0.0}, {"minimum_semi_axis": -1.0}])
def test_bad_fit_arguments_are_named(kwargs):
    with pytest.raises(ValueError, match="must be positive"):
        enclosing_ellipsoid(POINT, **kwargs)


# The signed distance.


def reference_distance(y: np.ndarray, e: np.ndarray) -> float:
    """By brackets on Eberly's secular equation, for a point off the principal planes."""
    y = np.abs(y)
    size = float(e.max() + y.max())
    # Half and double the bounds of the root above the pole, so that rounding is no matter.
    pole = -(e.min() ** 2)
    low = pole + 0.5 * (np.max(-(e**2) + e * y) - pole)
    high = 2.0 * np.linalg.norm(e * y) + 1e-9 * size - e.min() ** 2

    def secular(t: float) -> float:
        return float(np.sum((e * y / (t + e**2)) ** 2) - 1.0)

    t = brentq(secular, low, high, xtol=1e-18, rtol=1e-15, maxiter=500)
    return float(np.sign(t) * np.linalg.norm(t * y / (t + e**2)))


@untimed
@given(seed, semi_axes3, st.floats(-3.0, 1.0))
def test_distance_agrees_with_a_bracketing_solver(seed, e, decades):
    rng = np.random.default_rng(seed)
    p, R = pose(rng)
    local = units(rng) * e.max() * 10.0**decades
    expected = reference_distance(local, e)
    assert signed_distance(p + R @ local, p, R, e) == pytest.approx(expected, abs=1e-9)


@untimed
@given(seed, semi_axes3, st.floats(-0.999, 3.0))
@example(0, np.array([1.0, 0.01, 0.01]), 2.0)
@example(0, np.array([1.0, 1.0, 0.01]), 2.0)
@example(0, np.array([0.5, 0.5, 0.5]), 0.1)
def test_point_at_a_known_distance_along_the_normal(seed, e, share):
    """Outward always; inward as far as the smallest radius of curvature reaches."""
    rng = np.random.default_rng(seed)
    p, R = pose(rng)
    surface = units(rng) * e
    normal = surface / e**2
    normal /= np.linalg.norm(normal)
    distance = share * e.min() ** 2 / e.max() if share < 0.0 else share
    found = nearest(p + R @ (surface + distance * normal), p, R, e)
    assert found.distance == pytest.approx(distance, abs=1e-9)
    if share > -0.9:
        np.testing.assert_allclose(found.normal, R @ normal, atol=1e-6)
        np.testing.assert_allclose(found.point, p + R @ surface, atol=1e-6)


@untimed
@given(
    semi_axes3,
    st.tuples(*[st.sampled_from([0.0, 1e-300, 1e-160, 1e-30, 1e-9, 0.3, 0.99, 1.0, 5.0])] * 3),
)
def test_degenerate_points_have_the_distance_of_the_nearest_surface_point(e, share):
    """On axes and planes of symmetry, at the centre, with coordinates near zero."""
    y = np.array(share) * e
    found = nearest(y, np.zeros(3), np.eye(3), e)
    assert np.linalg.norm(found.point / e) == pytest.approx(1.0, abs=1e-9)
    assert np.linalg.norm(found.point - y) == pytest.approx(abs(found.distance), abs=1e-9)
    assert np.linalg.norm(found.normal) == pytest.approx(1.0)
    u = unit_directions(642) * e
    assert abs(found.distance) <= np.linalg.norm(u - y, axis=1).min() + 1e-12
    inside = np.sum((y / e) ** 2) < 1.0
    assert (found.distance < 0.0) == inside or abs(found.distance) < 1e-9


@untimed
@given(st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.floats(1e-12, 1.0))
def test_distance_within_an_axis_of_symmetry_is_continuous(a, b, share):
    e = np.array([max(a, b), min(a, b), max(a, b)])
    y = np.array([share * e[0], 0.0, 0.0])
    on = signed_distance(y, np.zeros(3), np.eye(3), e)
    near = signed_distance(y + np.array([0.0, 1e-12, 0.0]), np.zeros(3), np.eye(3), e)
    assert on == pytest.approx(near, abs=1e-11)


def test_centre_is_as_deep_as_the_smallest_semi_axis():
    for e in ([0.3, 0.2, 0.1], [0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [0.1, 0.2, 0.2]):
        assert signed_distance(np.zeros(3), np.zeros(3), np.eye(3), e) == pytest.approx(-0.1)


@untimed
@given(seed)
def test_normal_is_the_gradient(seed):
    rng = np.random.default_rng(seed)
    p, R = pose(rng)
    e = rng.uniform(0.05, 0.5, 3)
    at = p + R @ (units(rng) * e * rng.uniform(1.05, 3.0))
    steps = 1e-6 * np.vstack([np.eye(3), -np.eye(3)])
    moved = signed_distance(at + steps, p, R, e)
    np.testing.assert_allclose(
        (moved[:3] - moved[3:]) / 2e-6, nearest(at, p, R, e).normal, atol=1e-4
    )


def test_distance_broadcasts_points_against_ellipsoids():
    rng = np.random.default_rng(5)
    c, e = rng.normal(size=(4, 3)), rng.uniform(0.1, 0.5, (4, 3))
    R = Rotation.random(4, rng=rng).as_matrix()
    p = rng.normal(size=(7, 3))
    table = signed_distance(p[:, None], c, R, e)
    assert table.shape == (7, 4)
    for n in range(7):
        np.testing.assert_array_equal(signed_distance(p[n], c, R, e), table[n])
    for m in range(4):
        np.testing.assert_array_equal(signed_distance(p, c[m], R[m], e[m]), table[:, m])
    assert signed_distance(p[0], c[0], R[0], e[0]) == table[0, 0]
    assert signed_distance(p[0], c[0], R[0], e[0]).shape == ()
    assert signed_distance(p[0], c[:0], R[:0], e[:0]).shape == (0,)
    assert nearest(p[:, None], c, R, e).point.shape == (7, 4, 3)


def test_distance_refuses_flat_ellipsoids_and_wrong_shapes():
    with pytest.raises(ValueError, match="semi_axes must be positive"):
        signed_distance(np.ones(3), np.zeros(3), np.eye(3), [0.1, 0.0, 0.1])
    with pytest.raises(ValueError, match="expected trailing shape"):
        signed_distance(np.ones(2), np.zeros(3), np.eye(3), np.ones(3))
    with pytest.raises(ValueError, match="broadcast"):
        signed_distance(np.ones((2, 3)), np.zeros((3, 3)), np.eye(3), np.ones(3))


def test_distance_of_a_nan_point_is_nan():
    assert np.isnan(signed_distance([np.nan, 0, 0], np.zeros(3), np.eye(3), np.ones(3)))


# Plane section, support, shadow.


@untimed
@given(seed, semi_axes3)
def test_section_lies_on_the_ellipsoid_and_on_the_plane(seed, e):
    rng = np.random.default_rng(seed)
    _, R = pose(rng)
    e1, e2, n = basis(rng)
    found = plane_section(R, e, e1, e2)
    turn = np.linspace(0.0, 2.0 * np.pi, 25)
    ring = np.cos(turn)[:, None] * found.semi_axes[0] * found.axes[0]
    ring += np.sin(turn)[:, None] * found.semi_axes[1] * found.axes[1]
    np.testing.assert_allclose(np.linalg.norm(ring @ R / e, axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(ring @ n, 0.0, atol=1e-12)
    assert found.axes[0] @ e1 >= np.cos(np.pi / 4) - 1e-12


@untimed
@given(seed, semi_axes3)
def test_section_through_the_centre_is_the_eigenvalue_formula(seed, e):
    rng = np.random.default_rng(seed)
    _, R = pose(rng)
    e1, e2, _ = basis(rng)
    U = np.stack([e1, e2], axis=1)
    S = U.T @ R @ np.diag(e**-2.0) @ R.T @ U
    found = plane_section(R, e, e1, e2)
    np.testing.assert_allclose(
        np.sort(found.semi_axes), np.sort(np.linalg.eigvalsh(S) ** -0.5), rtol=1e-8
    )


def test_section_of_principal_planes_is_exact_and_ordered_by_e1():
    axes = np.array([0.3, 0.2, 0.1])
    x, y, z = np.eye(3)
    for e1, e2, expected in ((x, y, [0.3, 0.2]), (y, x, [0.2, 0.3]), (z, x, [0.1, 0.3])):
        found = plane_section(np.eye(3), axes, e1, e2)
        np.testing.assert_allclose(found.semi_axes, expected, rtol=1e-14)
        np.testing.assert_allclose(found.axes, [e1, e2], atol=1e-15)


def test_section_works_over_many_ellipsoids_and_none():
    rng = np.random.default_rng(6)
    e, R = rng.uniform(0.1, 0.5, (5, 3)), Rotation.random(5, rng=rng).as_matrix()
    frames = Rotation.random(5, rng=rng).as_matrix()
    found = plane_section(R, e, frames[:, :, 0], frames[:, :, 1])
    assert found.semi_axes.shape == (5, 2)
    one = plane_section(R[2], e[2], frames[2, :, 0], frames[2, :, 1])
    np.testing.assert_array_equal(found.axes[2], one.axes)
    none = plane_section(R[:0], e[:0], frames[:0, :, 0], frames[:0, :, 1])
    assert none.axes.shape == (0, 2, 3)


def test_section_refuses_a_skew_basis_and_flat_ellipsoids():
    x, y, _ = np.eye(3)
    with pytest.raises(ValueError, match="perpendicular"):
        plane_section(np.eye(3), np.ones(3), x, x + y)
    with pytest.raises(ValueError, match="semi_axes must be positive"):
        plane_section(np.eye(3), np.zeros(3), x, y)


@untimed
@given(seed, semi_axes3)
def test_support_bounds_the_surface_and_is_reached(seed, e):
    rng = np.random.default_rng(seed)
    _, R = pose(rng)
    n = units(rng, 8)
    surface = (units(rng, 400) * e) @ R.T
    reach = support(n, R, e)
    assert ((surface @ n.T).max(axis=0) <= reach + 1e-12).all()
    B = shape_matrix(R, e)
    np.testing.assert_allclose(reach**2, np.einsum("ki,ij,kj->k", n, B, n), rtol=1e-9)
    touching = (n @ B) / reach[:, None]
    np.testing.assert_allclose(np.linalg.norm(touching @ R / e, axis=1), 1.0, rtol=1e-9)
    np.testing.assert_allclose(np.sum(touching * n, axis=1), reach, rtol=1e-9)


# The tangent heading.


def tangents(p, c, R, e, omega, delta):
    count = len(c)
    heading, inside, normal = np.empty((count, 3)), np.empty(count), np.empty((count, 3))
    delta = np.array(delta, dtype=float).reshape(-1)
    B = np.ascontiguousarray(shape_matrix(R, e))
    tangent_headings(p, c, B, omega, delta, np.empty((7, 3)), heading, inside, normal)
    return heading, inside > 0.0, normal


def one_tangent(p, c, R, e, omega, delta):
    heading, inside, normal = tangents(p, c[None], R[None], e[None], omega[None], delta)
    return heading[0], bool(inside[0]), normal[0]


@untimed
@given(seed, st.floats(0.0, 0.3), st.floats(0.0, 2.0))
def test_ray_along_the_heading_keeps_the_clearance(seed, delta, beyond):
    rng = np.random.default_rng(seed)
    c, R = pose(rng)
    e = rng.uniform(0.02, 0.5, 3)
    away, omega = units(rng), units(rng)
    p = c + away * (e.max() + delta + 1e-6 + beyond)
    v, inside, n = one_tangent(p, c, R, e, omega, delta)
    assert not inside
    e1 = (c - p) / np.linalg.norm(c - p)
    e2 = omega - (omega @ e1) * e1
    e2 /= np.linalg.norm(e2)
    assert np.linalg.norm(v) == pytest.approx(1.0)
    assert v @ n == pytest.approx(0.0, abs=1e-12)
    assert abs(v @ np.cross(e1, e2)) < 1e-9
    assert v @ e2 >= -1e-12
    assert n @ (p - c) == pytest.approx(float(support(n, R, e)) + delta, abs=1e-9)
    steps = np.concatenate([np.linspace(0.0, 3.0, 200), np.linspace(-3.0, 0.0, 20)])
    kept = signed_distance(p + steps[:, None] * v, c, R, e)
    assert kept.min() >= delta - 1e-9


@untimed
@given(seed, st.floats(0.0, 0.3), st.sampled_from([(0, 1), (1, 2), (2, 0)]))
def test_clearance_is_just_kept_in_a_principal_plane(seed, delta, plane):
    rng = np.random.default_rng(seed)
    c, R = pose(rng)
    e = rng.uniform(0.05, 0.3, 3)
    angle = rng.uniform(0.0, 2.0 * np.pi)
    away = np.cos(angle) * R[:, plane[0]] + np.sin(angle) * R[:, plane[1]]
    omega = rng.normal() * R[:, plane[0]] + rng.normal() * R[:, plane[1]]
    p = c + away * (e.max() + delta + rng.uniform(0.01, 1.0))
    v, _, _ = one_tangent(p, c, R, e, omega, delta)
    along = (c - p) @ v + np.linspace(-0.5, 0.5, 4001)
    kept = signed_distance(p + along[:, None] * v, c, R, e)
    assert delta - 1e-9 <= kept.min() <= delta + 2e-5


@untimed
@given(seed, st.floats(-1.0, 1.5))
def test_inside_leaves_outward_and_outside_touches(seed, share):
    """From the centre out across the border of the grown shadow."""
    rng = np.random.default_rng(seed)
    c, R = pose(rng)
    e, delta = rng.uniform(0.02, 0.4, 3), 0.15
    p = c + units(rng) * share * (e.max() + delta)
    v, inside, n = one_tangent(p, c, R, e, units(rng), delta)
    assert np.linalg.norm(v) == pytest.approx(1.0)
    assert np.linalg.norm(n) == pytest.approx(1.0)
    if signed_distance(p, c, R, e) < delta - 1e-9:
        assert inside
    if inside:
        assert 0.0 <= v @ n <= np.sqrt(0.5) + 1e-12
    else:
        assert v @ n == pytest.approx(0.0, abs=1e-12)


@untimed
@given(seed)
def test_heading_is_continuous_across_the_border(seed):
    rng = np.random.default_rng(seed)
    c, R = pose(rng)
    e, delta = rng.uniform(0.05, 0.3, 3), 0.1
    # In a principal plane shadow and section agree, so the border is where d = delta.
    away = units(rng)
    away -= (away @ R[:, 2]) * R[:, 2]
    away /= np.linalg.norm(away)
    omega = np.cross(R[:, 2], away)
    border = brentq(lambda s: signed_distance(c + s * away, c, R, e) - delta, 0.0, 1.0, xtol=1e-14)
    v0, inside, _ = one_tangent(c + (border - 1e-7) * away, c, R, e, omega, delta)
    v1, outside, _ = one_tangent(c + (border + 1e-7) * away, c, R, e, omega, delta)
    assert inside
    assert not outside
    np.testing.assert_allclose(v0, v1, atol=5e-3)


@pytest.mark.parametrize(
    ("p", "omega"),
    [
        ([0, 0, 0], [0, 0, 1]),
        ([0, 0, 0], [0, 0, 0]),
        ([-1, 0, 0], [1, 0, 0]),
        ([-1, 0, 0], [0, 0, 0]),
    ],
)
def test_heading_is_finite_without_a_direction_or_a_distance(p, omega):
    v, _, n = one_tangent(
        np.array(p, float),
        np.zeros(3),
        np.eye(3),
        np.array([0.1, 0.2, 0.3]),
        np.array(omega, float),
        0.1,
    )
    assert np.linalg.norm(v) == pytest.approx(1.0)
    assert np.linalg.norm(n) == pytest.approx(1.0)


def test_headings_of_many_obstacles_are_those_of_each():
    rng = np.random.default_rng(9)
    c, e = rng.normal(size=(6, 3)), rng.uniform(0.05, 0.3, (6, 3))
    R, omega = Rotation.random(6, rng=rng).as_matrix(), units(rng, 6)
    p, delta = rng.normal(size=3), rng.uniform(0.0, 0.2, 6)
    heading, inside, normal = tangents(p, c, R, e, omega, delta)
    for m in range(6):
        v, within, n = one_tangent(p, c[m], R[m], e[m], omega[m], delta[m])
        np.testing.assert_array_equal(heading[m], v)
        np.testing.assert_array_equal(normal[m], n)
        assert inside[m] == within
