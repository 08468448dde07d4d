"""Support plane of a scene, usually a table: a robust fit to depth points, with a prior on gravity
and height.

A plane is ``normal . p = offset``, with a unit normal that points to free space. Planes that
contradict gravity are rejected, so that a wall never replaces a table with fewer points.

The table covers the convex hull of its visible points. It is assumed to continue beyond the border
of the image, since the feet of objects near the lowest row are not visible.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from drake_oa.common.messages import BoolArray, FloatArray, IntArray

DEPTH_NOISE = 0.0015
"""Standard deviation of a measured depth divided by the square of that depth [1/m]: the camera
noise that the table fit and the segmentation assume."""
LEAST_SHARE = 0.05
"""Minimum fraction of pixels with depth in an image, and of sampled points on its support plane
[-]. An image, or a plane, with a smaller fraction is rejected."""
HEIGHT_TOLERANCE = 0.05
"""Maximum difference between the height of a table and its expected height, or between the tables
in two images that count as the same table [m]."""
_PLANE_TOLERANCE = 0.006
"""Maximum distance between a plane and a point on it, at zero depth [m]. At depth z the noise
`DEPTH_NOISE` z^2 is added."""
_PLANE_TILT = math.radians(5.0)
"""Maximum angle between the normal of a detected table and the vertical, if the camera's pose is
known [rad]."""
_UP_UNKNOWN = np.array([0.0, -1.0, -1.0]) / math.sqrt(2.0)
"""Assumed upward direction if the camera's pose is unknown: opposite to gravity for a camera
pitched down by 45 degrees, in the camera frame."""
_PLANE_TILT_UNKNOWN = math.radians(50.0)
"""Maximum angle between the normal of a detected table and `_UP_UNKNOWN`, if the camera's pose is
unknown [rad]."""
_BANDS = (2.0, 1.0, 0.7, 0.5, 0.5)
"""Half-widths of the bands around a plane whose points are used in five successive least-squares
fits of the plane [-].

A half-width is the maximum distance of a point from the plane, divided by the tolerance of the
point (`_PLANE_TOLERANCE` plus depth noise). The last, narrow bands exclude the feet of objects.
"""
_REFINED_POINTS = 4000
"""Approximate maximum number of points in a least-squares fit of the support plane."""
_SEARCHES = 5
"""Maximum number of RANSAC searches for a support plane. Each search leaves out the points of
previous planes, which were tilted too much."""
_TRIALS = 300
"""Number of random triples of points that one RANSAC search tries as planes."""
_RANSAC_POINTS = 800
"""Approximate maximum number of points in a RANSAC search for the support plane."""
_BIN = 0.01
"""Maximum distance of a RANSAC inlier from its plane, and width of a bin in the histogram of
heights above a plane [m]."""
_OBJECT_HEIGHT = 0.45
"""Assumed maximum height of an object above its support [m]. It distinguishes the top of a box on a
table from a table above the floor."""
_TABLE_HEIGHT = 1.3
"""Maximum height above the floor at which a level surface counts as a table [m]."""
_LEAST_TABLE = 0.1
"""Minimum area of a level surface above the floor that counts as a table [m^2]."""
_LARGEST_TOP = 0.4
"""Maximum area of a plane that may be the top of a box, so that a larger level surface below it is
the table [m^2]."""
_BEYOND_IMAGE = 0.3
"""Distance by which the extent of a table is assumed to continue beyond the border of the image
[m]."""
_BORDER = 2
"""Maximum distance of a table's border points from the outermost sampled points, in rows or columns
of the sampling grid. At these border points the table is assumed to continue beyond the image."""
_ANGLES = np.arange(48) * (2.0 * np.pi / 48)
"""Angles (48,) of the outer normals of the half-planes that bound the extent of a table [rad]. They
are measured in the table's plane, from the first axis of `plane_axes`."""
_OUTWARD = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Outer normals (48, 2) of the half-planes that bound the extent of a table, in two axes of the
table's plane."""


class PlaneFit(NamedTuple):
    """Plane ``normal . p = offset`` fitted to N points.

    Attributes:
        normal: (3,) unit normal in the frame of the points.
        offset: distance of the plane from the origin along the normal [m].
        rms: root mean square distance of the inliers from the plane [m].
        inliers: (N,) whether each point lies on the plane.
    """

    normal: FloatArray
    offset: float
    rms: float
    inliers: BoolArray


class _Samples(NamedTuple):
    """Sampled points of a depth image or cloud, and the conditions that a support plane fitted to
    them must satisfy.

    Attributes:
        points: (N, 3) samples in the frame of the camera [m].
        tolerance: (N,) maximum distance from a plane at which each sample lies on it [m].
        up: (3,) unit vector opposite to gravity in the frame of the camera.
        max_tilt: maximum angle between `up` and the normal of the plane [rad].
    """

    points: FloatArray
    tolerance: FloatArray
    up: FloatArray
    max_tilt: float

    @property
    def min_inliers(self) -> int:
        """Minimum number of samples that must lie on a plane for it to be the support plane."""
        return max(20, int(LEAST_SHARE * len(self.points)))

    def accepts(self, normal: FloatArray) -> bool:
        """Checks whether a plane with the unit normal (3,) is level enough, within `max_tilt`, to
        be the support plane.
        """
        return bool(normal @ self.up >= math.cos(self.max_tilt))


def find_table(
    points: FloatArray, distance: FloatArray, X_WC: FloatArray | None, table_height: float | None
) -> PlaneFit | None:
    """Finds the support plane (table) among points in the frame of the camera.

    A table of known height is searched near that height. Otherwise the plane with the most points
    (RANSAC) is the table. If that plane is the floor around a table, or the top of a box on a
    table, the table is searched above or below it (`_find_supporting_level`).

    Args:
        points: (N, 3) points in the frame of the camera [m].
        distance: (N,) depth of each point of an image along the optical axis, or distance of each
            point of a cloud from the camera, from which the noise of the point is computed [m].
        X_WC: (4, 4) pose of the camera in the world. None: unknown; then the normal of the table
            must be within 50 degrees of the vertical of a camera pitched down by 45 degrees.
        table_height: height of the table in the world [m]; None: unknown.

    Returns:
        The plane in the frame of the camera; None if no level plane has enough points.
    """
    up, max_tilt = _UP_UNKNOWN, _PLANE_TILT_UNKNOWN
    if X_WC is not None:
        up, max_tilt = X_WC[2, :3], _PLANE_TILT
    tolerance = _PLANE_TOLERANCE + DEPTH_NOISE * distance**2
    samples = _Samples(points, tolerance, up, max_tilt)
    if X_WC is not None and table_height is not None:
        height = points @ up - (table_height - X_WC[2, 3])
        is_near = np.abs(height) < HEIGHT_TOLERANCE
        level = table_height - X_WC[2, 3] + np.median(np.append(height[is_near], 0.0))
        return _refine(samples, up, level, is_near)
    initial = _search_plane(samples)
    fit = initial and _refine(samples, *initial)
    support = fit and _find_supporting_level(samples, fit)
    if fit is None or support is None:
        return fit
    other = _refine(samples, fit.normal, support)
    # Least squares diverge from a level that is no plane; then the first fit is used.
    is_parallel = other is not None and other.normal @ fit.normal > math.cos(_PLANE_TILT)
    return other if is_parallel else fit


def _search_plane(samples: _Samples) -> tuple[FloatArray, float] | None:
    """Finds the plane with the most samples by RANSAC, among planes that are level enough.

    Returns:
        Unit normal (3,) of the plane in the frame of the camera, and its distance from the origin
        along the normal [m]; None if no such plane is found.
    """
    step = 1 + len(samples.points) // _RANSAC_POINTS
    points, random = samples.points[::step].astype(np.float32), np.random.default_rng(0)
    for _ in range(_SEARCHES):
        if len(points) < samples.min_inliers / step:
            break
        a, b, c = points[random.integers(len(points), size=(3, _TRIALS))]
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1)
        is_near = np.abs(points @ normals.T - (normals * a).sum(axis=1)) < _BIN * length
        best = is_near.sum(axis=0).argmax()
        normal = normals[best] / max(length[best], 1e-9)
        normal = normal if normal @ samples.up >= 0.0 else -normal
        if samples.accepts(normal):
            return normal, float(normal @ a[best])
        points = points[~is_near[:, best]]
    return None


def _find_supporting_level(samples: _Samples, fit: PlaneFit) -> float | None:
    """Finds a level surface, parallel to a fitted plane, that is the support plane of the scene
    instead of the fitted plane.

    - If the fitted plane is a floor: the table is a level surface 0.45 to 1.3 m above it, of at
      least 0.1 m^2, and nearer to the camera.
    - If the fitted plane is the top of a box (at most 0.4 m^2): the support is a level surface of
      larger area at most 0.45 m below it.

    Args:
        samples: sampled points of the image or cloud.
        fit: plane with the most points.

    Returns:
        Offset of the level surface from the origin, along the normal of the fitted plane [m]; None
        if there is none.
    """
    points, inliers = samples.points, samples.points[fit.inliers]
    height = points @ fit.normal - fit.offset
    for low, high, fraction in (
        (_OBJECT_HEIGHT, _TABLE_HEIGHT, 0.2),
        (-_OBJECT_HEIGHT, -2.0 * _BIN, 0.15),
    ):
        votes, edges = np.histogram(height, round((high - low) / _BIN), (low, high))
        votes = np.convolve(votes, np.ones(3, dtype=np.int64), mode="same")
        if votes.max() < max(samples.min_inliers, fraction * len(inliers)):
            continue
        at = edges[votes.argmax()] + 0.5 * _BIN
        level = points[np.abs(height - at) < 1.5 * _BIN]
        wide = _area(level, fit.normal)
        if at > 0.0:
            near, far = (np.median(np.linalg.norm(part, axis=1)) for part in (level, inliers))
            is_support = near < far and wide > _LEAST_TABLE
        else:
            is_support = _area(inliers, fit.normal) < min(_LARGEST_TOP, wide)
        if is_support:
            return float(fit.offset + at)
    return None


def _area(points: FloatArray, normal: FloatArray) -> float:
    """Estimates the area [m^2] that points cover along a plane: that of a uniform rectangle with
    the same variances.

    Args:
        points: (N, 3) points [m].
        normal: (3,) unit normal of the plane.
    """
    axes = plane_axes(normal)
    return float(12.0 * np.sqrt(max(np.linalg.det(axes @ np.cov(points.T) @ axes.T), 0.0)))


def _refine(
    samples: _Samples, normal: FloatArray, offset: float, allowed: BoolArray | None = None
) -> PlaneFit | None:
    """Refines a plane by weighted least-squares fits to the samples in successively narrower bands
    around it.

    Args:
        samples: sampled points of the image or cloud, with tolerances and conditions.
        normal: (3,) initial unit normal in the frame of the camera.
        offset: initial distance of the plane from the origin along the normal [m].
        allowed: (N,) whether each sample may lie on the plane; None: all.

    Returns:
        The plane; None if it has too few samples or too much tilt.
    """
    step = 1 + len(samples.points) // _REFINED_POINTS
    points, tolerance = samples.points[::step], samples.tolerance[::step]
    weights = tolerance**-2
    for band in _BANDS:
        near = np.abs(points @ normal - offset) < band * tolerance
        if np.count_nonzero(near) < 3:
            return None
        weight, inner = weights[near], points[near]
        center = weight @ inner / weight.sum()
        spread = inner - center
        normal = np.linalg.eigh((weight * spread.T) @ spread)[1][:, 0]
        normal = normal if normal @ samples.up >= 0.0 else -normal
        offset = float(normal @ center)
    height = samples.points @ normal - offset
    inliers = np.abs(height) < samples.tolerance
    if allowed is not None:
        inliers &= allowed
    if np.count_nonzero(inliers) < samples.min_inliers or not samples.accepts(normal):
        return None
    return PlaneFit(normal, offset, float(np.sqrt(np.mean(height[inliers] ** 2))), inliers)


def table_extent(
    fit: PlaneFit, points: FloatArray, pixel: IntArray, shape: tuple[int, ...]
) -> FloatArray:
    """Computes points (E, 3) whose convex hull is the extent of a table, in the frame of the camera
    [m].

    They are the border points of the table's mask in the image. Points are added beyond the left,
    right and lower borders of the image, where the table is assumed to continue. An opening of the
    mask by 3 x 3 pixels removes the thin line along which the table's plane intersects a wall.

    Args:
        fit: plane of the table.
        points: (N, 3) samples to which the plane was fitted, in the frame of the camera [m].
        pixel: (N,) flat indices of the samples in the grid of sampled pixels.
        shape: rows and columns of the grid.
    """
    mask = np.zeros(shape, dtype=bool)
    mask.flat[pixel] = fit.inliers
    square = {"size": 3, "mode": "constant"}
    opened = ndimage.maximum_filter(ndimage.minimum_filter(mask, **square), **square)
    border = opened & ~ndimage.minimum_filter(opened, **square)
    is_border = border.ravel()[pixel]
    rows, columns = np.divmod(pixel, shape[1])
    row, column, span = rows[is_border], columns[is_border], points[is_border]
    # The upper border is no end of the table: feet of objects there are visible.
    borders = (
        (row >= rows.max() - _BORDER, [0.0, 1.0, 0.0]),
        (column <= columns.min() + _BORDER, [-1.0, 0.0, 0.0]),
        (column >= columns.max() - _BORDER, [1.0, 0.0, 0.0]),
    )
    parts = [span]
    for is_beside, axis in borders:
        outward = axis - (fit.normal @ axis) * fit.normal
        outward /= max(float(np.linalg.norm(outward)), 1e-9)
        parts.append(span[is_beside] + _BEYOND_IMAGE * outward)
    return np.concatenate(parts)


def distance_beyond(p_WQ: FloatArray, table_W: FloatArray, normal_W: FloatArray) -> FloatArray:
    """Computes how far points lie beyond the convex extent of a table, along its plane.

    Args:
        p_WQ: (N, 3) points in the world [m].
        table_W: (E, 3) points in the world whose convex hull is the extent of the table [m].
        normal_W: (3,) unit normal of the table in the world.

    Returns:
        (N,) largest distance of each point beyond the half-planes that bound the extent [m]:
        negative inside; infinite for a table without extent.
    """
    outward = _OUTWARD @ plane_axes(normal_W)
    reach = (outward @ table_W.T).max(axis=1, initial=-np.inf)
    return np.asarray((p_WQ @ outward.T - reach).max(axis=1))


def plane_axes(normal: FloatArray) -> FloatArray:
    """Computes two orthonormal axes (2, 3) that span the plane with a given unit normal (3,)."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])
