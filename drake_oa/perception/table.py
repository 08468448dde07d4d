"""Support plane of a scene, usually a table: a robust fit with a prior on gravity and height.

A plane is ``normal . p = offset``, with a unit normal that points to free space. Planes that
contradict gravity are rejected, so that a wall never replaces a table with fewer points.

The table covers the convex hull of its visible points, and continues beyond the border of the
image, since the feet of objects near the lowest row are not visible.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from drake_oa.common.messages import BoolArray, FloatArray, IntArray

DEPTH_NOISE = 0.0015
"""Standard deviation of depth over the square of the depth [1/m]."""
LEAST_SHARE = 0.05
"""Minimum fraction of a frame's points with depth, and of its samples on the table [1]."""
HEIGHT_TOLERANCE = 0.05
"""Maximum difference of the table's height from the expected one [m]."""
_PLANE_TOLERANCE = 0.006
"""Maximum distance from a plane of a point on it, at depth 0 [m]."""
_PLANE_TILT = math.radians(5.0)
"""Maximum tilt of the table against gravity with a known camera pose [rad]."""
_UP_UNKNOWN = np.array([0.0, -1.0, -1.0]) / math.sqrt(2.0)
"""Unit vector opposite to gravity in the frame of a camera pitched down by 45 degrees."""
_PLANE_TILT_UNKNOWN = math.radians(50.0)
"""Maximum tilt of the table against `_UP_UNKNOWN` [rad]."""
_BANDS = (2.0, 1.0, 0.7, 0.5, 0.5)
"""Widths of the bands of points in successive least-squares fits, relative to the tolerance [1].

Narrow bands exclude the feet of objects.
"""
_REFINED_POINTS = 4000
"""Approximate number of points in a least-squares fit of a plane."""
_SEARCHES = 5
"""Maximum number of RANSAC searches for a plane with an accepted tilt."""
_TRIALS = 300
"""Number of random triples of points in one RANSAC search for a plane."""
_RANSAC_POINTS = 800
"""Approximate number of points in a RANSAC search for a plane."""
_BIN = 0.01
"""Width of a histogram bin of heights, and half the thickness of a plane in RANSAC [m]."""
_OBJECT_HEIGHT = 0.45
"""Maximum height of an object above its support [m]."""
_TABLE_HEIGHT = 1.3
"""Maximum height of a table above the floor [m]."""
_LEAST_TABLE = 0.1
"""Minimum area of a table on a floor [m^2]."""
_LARGEST_TOP = 0.4
"""Maximum area of the top of a box that is mistaken for a table [m^2]."""
_BEYOND_IMAGE = 0.3
"""Distance by which a table is extended beyond the border of the image [m]."""
_BORDER = 2
"""Width of the border of the image, in rows and columns of the grid of samples."""
_ANGLES = np.arange(48) * (2.0 * np.pi / 48)
"""Angles (48,) of the half-planes that bound the extent of a table [rad]."""
_OUTWARD = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Outer normals (48, 2) of the half-planes that bound a table's extent, in axes of the plane."""


class PlaneFit(NamedTuple):
    """Plane ``normal . p = offset`` fitted to points.

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
    """Samples of a frame, and constraints on its support plane.

    Attributes:
        points: (N, 3) samples in the frame of the camera [m].
        tolerance: (N,) maximum distances from a plane of samples on it [m].
        up: (3,) unit vector opposite to gravity.
        max_tilt: maximum angle between `up` and the normal of the plane [rad].
    """

    points: FloatArray
    tolerance: FloatArray
    up: FloatArray
    max_tilt: float

    @property
    def min_inliers(self) -> int:
        """Minimum number of samples on a plane."""
        return max(20, int(LEAST_SHARE * len(self.points)))

    def accepts(self, normal: FloatArray) -> bool:
        """Checks whether the tilt of a plane with a normal is small enough."""
        return bool(normal @ self.up >= math.cos(self.max_tilt))


def find_table(
    points: FloatArray, distance: FloatArray, X_WC: FloatArray | None, table_height: float | None
) -> PlaneFit | None:
    """Finds the table in the frame of the camera.

    A table of known height is searched near that height. Otherwise the plane with the most points
    (RANSAC) is the table, unless it is the floor around a table, or the top of a box on the table
    (see `_find_supporting_level`).

    Args:
        points: (N, 3) points in the frame of the camera [m].
        distance: (N,) their distances from the camera [m].
        X_WC: (4, 4) pose of the camera; None: unknown.
        table_height: height of the table in the world [m]; None: unknown.

    Returns:
        The plane; None if no plane has enough points.
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
    """Finds normal and offset of the largest plane with an accepted tilt, by RANSAC."""
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
    """Finds the offset of a plane parallel to a fit that supports the scene instead, or None.

    - The fit is a floor: the table is a wide level above it, higher than objects, and nearer to the
      camera.
    - The fit is the top of a box: the support is a wider level below it, within the height of
      objects.
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
    """Computes the area [m^2] of a uniform rectangle with the variances of points along a plane."""
    axes = plane_axes(normal)
    return float(12.0 * np.sqrt(max(np.linalg.det(axes @ np.cov(points.T) @ axes.T), 0.0)))


def _refine(
    samples: _Samples, normal: FloatArray, offset: float, allowed: BoolArray | None = None
) -> PlaneFit | None:
    """Fits a plane by weighted least squares in successively narrower bands.

    Args:
        samples: samples of the frame.
        normal: (3,) initial normal.
        offset: initial offset [m].
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
    """Computes points (E, 3) that span the extent of a table in the frame of the camera [m].

    An opening of the table's mask by 3 x 3 pixels removes the thin line where its plane
    intersects a wall.

    Args:
        fit: plane of the table.
        points: (N, 3) samples of the fit [m].
        pixel: (N,) flat indices of the samples in a grid.
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
    """Computes distances of points beyond the convex extent of the table.

    Args:
        p_WQ: (N, 3) points [m].
        table_W: (E, 3) points that span the extent of the table [m].
        normal_W: (3,) unit normal of the table.

    Returns:
        (N,) distances along the plane to the half-planes that bound the extent, the largest for
        each point [m]: negative inside; infinite for a table without extent.
    """
    outward = _OUTWARD @ plane_axes(normal_W)
    reach = (outward @ table_W.T).max(axis=1, initial=-np.inf)
    return np.asarray((p_WQ @ outward.T - reach).max(axis=1))


def plane_axes(normal: FloatArray) -> FloatArray:
    """Computes orthonormal axes (2, 3) of the plane with a unit normal."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])
