"""Ellipsoids as unified descriptors of an obstacle and the tool, so that avoidance treats the tool
as a point.

The obstacle's points are dilated by the tool, and one ellipsoid encloses the result. The other
layers then treat the tool as the tool point E (Pairet et al., RA-L 2019, section IV-B, with the
exponents lambda_4 = lambda_5 = 1 of the superquadric (10)). An ellipsoid O has a center p_WO, a
rotation R_WO with the principal axes as columns, and semi-axes a:

    x inside  <=>  gauge(x) = | diag(1/a) R_WO^T (x - p_WO) | <= 1.

Functions of many ellipsoids broadcast their leading shapes as NumPy does: centers (M, 3), rotations
(M, 3, 3) and semi-axes (M, 3) against one point (3,) give (M,); for N points against M ellipsoids
pass the points as (N, 1, 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from drake_oa.common.compiled import kernel_arrays
from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.geometry import ellipsoid_kernels as kernels
from drake_oa.geometry.directions import sphere_points

LEAST_SEMI_AXIS = 1e-3
"""Minimum semi-axis of an ellipsoid that is fitted to a point cloud [m].

A cloud that is thinner than a hundredth of this value along a principal axis is enclosed along the
other axes only."""
_TOLERANCE = 1e-2
"""Relative tolerance with which an enclosing ellipsoid has the least volume [-].

The gauge of a point is 1 on the surface of the ellipsoid and grows in proportion to the distance
from the center. Before the final scaling, which encloses all points, points may be slightly
outside: the squared gauge is at most about 1 plus this value for the points that determine the fit.
If the squared gauge of another point is above 1 plus twice this value, the fit is repeated with the
farthest such point."""
_DIRECTIONS = sphere_points(156)
"""Unit vectors (162, 3) in whose directions the support points (farthest points) of a dilated cloud
are computed."""
_MAX_STEPS = 100_000
"""Maximum number of steps of the optimization that weights the support points of one enclosing
ellipsoid [-]."""
_MAX_ROUNDS = 20
"""Maximum number of fits of an enclosing ellipsoid; each fit after the first has one more support
point [-]."""


@dataclass(frozen=True, eq=False)
class Ellipsoid(Frozen):
    """Ellipsoid in the world frame that encloses an obstacle dilated by the tool.

    Attributes:
        center: (3,) center p_WO [m].
        R: (3, 3) rotation R_WO; its columns are the principal axes, right-handed.
        semi_axes: (3,) semi-axes along those columns, largest first [m].
        gauge: largest gauge of all dilated points; a value of at most 1 certifies that the
            ellipsoid encloses them. A dilated point x is the difference of a point of the
            obstacle's cloud and a vertex of the tool. Its gauge
            |diag(1 / semi_axes) R^T (x - center)| is 1 on the surface and smaller inside.
    """

    center: FloatArray
    R: FloatArray
    semi_axes: FloatArray
    gauge: float


def dilate(points: ArrayLike, tool: ArrayLike) -> FloatArray:
    """Computes points on the C-obstacle O + (-E), the Minkowski sum of a point cloud O and a
    reflected convex tool E.

    The C-obstacle (configuration-space obstacle) contains the positions of the tool's reference
    point at which tool and obstacle intersect (Lozano-Perez). The support point in a direction is
    the farthest one. The support point of a Minkowski sum is the sum of the support points of both
    sets. No hull is needed, so that a single point, a line or a plane of points is a valid cloud.

    Args:
        points: (N, 3) surface points in W [m].
        tool: (K, 3) vertices of the tool's convex geometry relative to its reference point (the
            TCP), expressed in W [m]; [[0, 0, 0]]: a point.

    Returns:
        (S, 3) distinct support points in W [m], at most one for each of 162 directions.

    Raises:
        ValueError: if points or tool are empty, not of shape (., 3), or not finite.
    """
    points, tool = checked_points(points, "points"), checked_points(tool, "tool")
    rows = (_DIRECTIONS @ points.T).argmax(axis=1), (_DIRECTIONS @ tool.T).argmin(axis=1)
    point, corner = np.unique(rows, axis=1)
    return np.asarray(points[point] - tool[corner])


def enclosing_ellipsoid(points: ArrayLike, *, tool: ArrayLike | None = None) -> Ellipsoid:
    """Computes the ellipsoid of least volume that encloses a point cloud dilated by a tool, and
    certifies it.

    A dilated point is the difference of a point and a vertex of the tool. Khachiyan's algorithm
    with the away steps of Todd and Yildirim (2007) encloses the support points, the dilated points
    that are farthest in one of 162 directions. While a dilated point is outside by more than about
    1 %, the farthest one is added to the support points, and the fit is repeated, up to 20 fits in
    all. Finally the ellipsoid is scaled about its center until it contains the farthest of all
    N x K dilated points, and is checked.

    Args:
        points: (N, 3) points in W [m].
        tool: (K, 3) vertices of the tool's convex geometry relative to its reference point,
            expressed in W [m]; None: a point.

    Returns:
        Ellipsoid whose field `gauge` is at most 1: it contains all dilated points.

    Raises:
        ValueError: if points or tool are empty, not of shape (., 3), or not finite.
    """
    points = checked_points(points, "points")
    corners = checked_points(np.zeros((1, 3)) if tool is None else tool, "tool")
    # The points are relative to their mean: far from the origin the sums would lose digits.
    origin = points.mean(axis=0)
    cloud = points - origin
    support = dilate(cloud, corners)
    center, R, semi_axes, gauge = np.zeros(3), np.eye(3), np.ones(3), 0.0
    for _ in range(_MAX_ROUNDS):
        center, R, semi_axes = _least_volume(support)
        gauge, i, j = _farthest(cloud, corners, center, R, semi_axes)
        if gauge**2 <= 1.0 + 2.0 * _TOLERANCE:
            break
        support = np.concatenate([support, (cloud[i] - corners[j])[None, :]])
    semi_axes = np.maximum(semi_axes * gauge, LEAST_SEMI_AXIS)
    center = center + origin
    gauge, _, _ = _farthest(points, corners, center, R, semi_axes)
    while gauge > 1.0:
        # Scaled slightly more, since rounding could leave the gauge one digit above 1.
        semi_axes = semi_axes * (gauge * (1.0 + 1e-13))
        gauge, _, _ = _farthest(points, corners, center, R, semi_axes)
    return Ellipsoid(center, R, semi_axes, gauge)


def signed_distance(
    p: ArrayLike, center: ArrayLike, R: ArrayLike, semi_axes: ArrayLike
) -> FloatArray:
    """Computes the Euclidean distances of points to the surfaces of ellipsoids, negative inside.

    A monotone Newton iteration solves the secular equation of the nearest point (Eberly) in the
    ellipsoid's axes.

    Args:
        p: (..., 3) points in W [m].
        center: (..., 3) centers p_WO [m].
        R: (..., 3, 3) rotations R_WO.
        semi_axes: (..., 3) positive semi-axes [m].

    Returns:
        (...) distances [m], with the broadcast leading shape; NaN for a point that is NaN.

    Raises:
        ValueError: for a semi-axis that is not positive, or shapes that do not fit.
    """
    p_WQ, p_WO, R_WO, axes = (np.asarray(a, dtype=float) for a in (p, center, R, semi_axes))
    y, axes = np.broadcast_arrays(np.abs(np.einsum("...i,...ij->...j", p_WQ - p_WO, R_WO)), axes)
    if not (axes > 0.0).all():
        raise ValueError(f"semi_axes: must be positive, not {semi_axes!r}")
    rows = kernel_arrays(y.reshape(-1, 3), axes.reshape(-1, 3))
    distance = np.empty(len(rows[0]))
    kernels.signed_distances(*rows, distance)
    return distance.reshape(y.shape[:-1])


def section_matrix(R: ArrayLike, semi_axes: ArrayLike, U: ArrayLike) -> FloatArray:
    """Computes the matrices S of the ellipses in which planes through their centers cut ellipsoids.

    With A = R diag(1/a^2) R^T and semi-axes a, S = U A U^T. The ellipse is {x : x^T S x <= 1}, with
    coordinates x along the rows of U.

    Args:
        R: (..., 3, 3) rotations R_WO.
        semi_axes: (..., 3) positive semi-axes [m].
        U: (..., 2, 3) orthonormal vectors in W that span the planes, one per row.

    Returns:
        (..., 2, 2) matrices S [1/m^2].
    """
    scaled = np.asarray(U) @ R / np.asarray(semi_axes)[..., None, :]
    return np.asarray(scaled @ np.swapaxes(scaled, -1, -2))


def plane_section(
    R: ArrayLike, semi_axes: ArrayLike, e1: ArrayLike, e2: ArrayLike
) -> tuple[FloatArray, FloatArray]:
    """Computes the ellipse in which the plane through an ellipsoid's center along e1 and e2 cuts
    the ellipsoid.

    The semi-axes of the ellipse are eig(S)^(-1/2), with S = U R diag(1/a^2) R^T U^T, semi-axes a of
    the ellipsoid and rows e1, e2 of U. On the P-plane, the plane of tool, velocity and obstacle
    center, they are the lambda' with which Pairet et al., RA-L 2019, describe an obstacle.

    Args:
        R: (..., 3, 3) rotations R_WO.
        semi_axes: (..., 3) positive semi-axes [m].
        e1: (..., 3) unit vector in W; on the P-plane, toward the obstacle's center.
        e2: (..., 3) unit vector in W perpendicular to e1.

    Returns:
        (..., 2) semi-axes [m]: of the principal axis within 45 degrees of e1, then of the other
        axis; and (..., 2, 3) these axes in W, one per row.
    """
    U = np.stack([e1, e2], axis=-2)
    value, V = np.linalg.eigh(section_matrix(R, semi_axes, U))
    # Sorted so that the first axis is the one nearer to e1.
    swapped = np.abs(V[..., 0, 0]) < np.abs(V[..., 0, 1])
    value = np.where(swapped[..., None], value[..., ::-1], value)
    turn = np.swapaxes(np.where(swapped[..., None, None], V[..., ::-1], V), -1, -2)
    sign = np.where(turn[..., :1, :1] < 0.0, -1.0, 1.0)
    return value**-0.5, sign * turn @ U


def checked_points(points: ArrayLike, name: str) -> FloatArray:
    """Checks an array of points, and returns it as float64 array, without a copy if it already is
    one.

    Args:
        points: (N, 3) points, N >= 1.
        name: name of the points in error messages.

    Raises:
        ValueError: if the points are empty, not (N, 3) or not finite.
    """
    array = np.asarray(points, dtype=float)
    if array.ndim != 2 or array.shape[1] != 3 or len(array) == 0:
        raise ValueError(f"{name}: must be a non-empty (N, 3) array, not of shape {array.shape}")
    if not np.isfinite(array).all():
        bad = int((~np.isfinite(array).all(axis=1)).sum())
        raise ValueError(f"{name}: must be finite; {bad} of {len(array)} rows are not")
    return array


def _least_volume(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Computes the ellipsoid of least volume that encloses points, up to the tolerance
    `_TOLERANCE`.

    Points may be outside: their distance from the center is up to about 1 % larger than that of the
    surface in the same direction. The semi-axes are at least `LEAST_SEMI_AXIS` (1 mm).

    Args:
        points: (N, 3) points [m].

    Returns:
        Center (3,) [m], rotation (3, 3) whose columns are the principal axes, and semi-axes (3,),
        largest first [m].
    """
    mean = points.mean(axis=0)
    spread = points - mean
    variance, V = np.linalg.eigh(spread.T @ spread / len(points))
    V = V[:, ::-1]
    scale = np.sqrt(np.maximum(variance[::-1], 0.0))
    local = spread @ V
    flat = np.abs(local).max(axis=0) <= max(0.01 * LEAST_SEMI_AXIS, 1e-9 * float(scale[0]))
    rank = 3 - int(flat.sum())
    whitened = np.where(flat, 0.0, local / np.where(flat, 1.0, scale))
    u = np.empty(len(points))
    kernels.optimal_weights(whitened, rank, _TOLERANCE, _MAX_STEPS, u)
    middle = u @ whitened
    offset = whitened - middle
    moment = (offset * u[:, None]).T @ offset * np.outer(scale, scale) * max(rank, 1)
    moment[flat, :] = 0.0
    moment[:, flat] = 0.0
    moment[flat, flat] = LEAST_SEMI_AXIS * LEAST_SEMI_AXIS
    squared, W = np.linalg.eigh(moment)
    R = right_handed(V @ W[:, ::-1])
    semi_axes = np.maximum(np.sqrt(np.maximum(squared[::-1], 0.0)), LEAST_SEMI_AXIS)
    return mean + V @ (middle * scale), R, semi_axes


def right_handed(axes: FloatArray) -> FloatArray:
    """Returns the rotation matrix (3, 3) whose columns are three orthonormal axes, all negated if
    they are left-handed.
    """
    return np.asarray(np.sign(np.linalg.det(axes)) * axes)


def _farthest(
    points: FloatArray, tool: FloatArray, center: FloatArray, R: FloatArray, semi_axes: FloatArray
) -> tuple[float, int, int]:
    """Finds the dilated point with the largest gauge relative to an ellipsoid.

    A dilated point x is the difference of a point and a tool vertex. Its gauge
    |diag(1 / semi_axes) R^T (x - center)| is 1 on the surface and larger outside.

    Args:
        points: (N, 3) points of a cloud [m].
        tool: (K, 3) vertices of the tool, relative to its reference point [m]; they are subtracted
            from the points.
        center, R, semi_axes: center (3,) [m], rotation (3, 3) and semi-axes (3,) [m] of the
            ellipsoid.

    Returns:
        Largest gauge, index of the point, and index of the tool vertex.
    """
    y, s = (points - center) @ R / semi_axes, tool @ R / semi_axes
    length = np.linalg.norm(y, axis=1)
    # By the triangle inequality shorter rows cannot be the farthest; the margin is for rounding.
    least = cdist(y[[length.argmax()]], s).max() - np.linalg.norm(s, axis=1).max()
    rows = np.flatnonzero(length >= least * (1.0 - 1e-12))
    gauge = cdist(y[rows], s)
    i, j = divmod(int(gauge.argmax()), len(s))
    return float(gauge[i, j]), int(rows[i]), j
