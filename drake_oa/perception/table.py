"""The supporting plane of a scene: a robust fit with a prior on gravity and height.

A plane is ``normal . p = offset`` with a unit normal that points to the free side. Planes that
contradict gravity are rejected, so that a wall never replaces a table with fewer points.

The table extends over the convex hull of its visible points. Beyond the border of the image it
continues: the feet of objects in front of the lowest row are not visible.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from drake_oa.common.messages import BoolArray, FloatArray, IntArray

DEPTH_NOISE = 0.0015
"""Standard deviation of depth at 1 m; it grows with the square of the depth [1/m]."""
LEAST_SHARE = 0.05
"""Minimum fraction of the points that belong to a plane [1]."""
HEIGHT_TOLERANCE = 0.05
"""Maximum distance of the table from its expected height [m]."""
_PLANE_TOLERANCE = 0.006
"""Distance from the plane at which a point at depth 0 belongs to it [m]."""
_PLANE_TILT = math.radians(5.0)
"""Maximum tilt of the table against gravity with a known camera pose [rad]."""
_UP_UNKNOWN = np.array([0.0, -1.0, -1.0]) / math.sqrt(2.0)
"""Up direction of a camera that looks down by 45 degrees, in the camera frame."""
_PLANE_TILT_UNKNOWN = math.radians(50.0)
"""Maximum tilt of the table against `_UP_UNKNOWN` [rad]."""
_BANDS = (2.0, 1.0, 0.7, 0.5, 0.5)
"""Tolerances of the rounds of least squares; narrow bands exclude the feet of objects."""
_REFINED_POINTS = 4000
"""Approximate number of points for least squares."""
_SEARCHES = 5
"""Maximum number of planes that are searched for one with an accepted tilt."""
_TRIALS = 300
"""Number of triples of points of which a search takes the plane with the most points."""
_SEARCHED_POINTS = 800
"""Approximate number of points in the search for a plane."""
_BIN = 0.01
"""Width of a bin of a histogram of heights [m]."""
_OBJECT_HEIGHT = 0.45
"""Maximum height of an object above its support [m]."""
_TABLE_HEIGHT = 1.3
"""Maximum height of a table above the floor [m]."""
_LEAST_TABLE = 0.1
"""Minimum area of a table on a floor [m^2]."""
_LARGEST_TOP = 0.4
"""Maximum area of the top of a box [m^2]."""
_BEYOND_IMAGE = 0.3
"""Distance by which a table extends beyond the border of the image [m]."""
_BORDER = 2
"""Rows and columns of the grid of samples that are the border of the image."""
_ANGLES = np.arange(48) * (2.0 * np.pi / 48)
_OUTWARD = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Outer normals of the half-planes that bound the extent of a table, along the plane's axes."""


class PlaneFit(NamedTuple):
    """A plane ``normal . p = offset`` fitted to points.

    Attributes:
        normal: (3,) unit normal in the frame of the points.
        offset: distance of the plane from the origin along the normal [m].
        rms: root mean square distance of the inliers from the plane [m].
        inliers: (N,) whether each of the given points lies on the plane.
    """

    normal: FloatArray
    offset: float
    rms: float
    inliers: BoolArray


class _Samples(NamedTuple):
    """Points (N, 3) [m], their tolerances (N,) [m], and constraints on the plane."""

    points: FloatArray
    tolerance: FloatArray
    up: FloatArray
    max_tilt: float

    @property
    def needed(self) -> int:
        """Minimum number of points of a plane."""
        return max(20, int(LEAST_SHARE * len(self.points)))

    def accepts(self, normal: FloatArray) -> bool:
        """Checks the tilt of a plane."""
        return bool(normal @ self.up >= math.cos(self.max_tilt))


def find_table(
    points: FloatArray, distance: FloatArray, X_WC: FloatArray | None, table_height: float | None
) -> PlaneFit | None:
    """Finds the table in the camera's frame.

    A table of known height is sought near that height. Otherwise it is the plane
    with the most points (RANSAC), unless that is the floor around a table, or the top of a box on
    the table (see `_supporting_level`).

    Args:
        points: (N, 3) points in the frame of the camera [m].
        distance: (N,) their distances from the camera [m].
        X_WC: (4, 4) pose of the camera; None: unknown.
        table_height: height of the table in the world [m]; None: unknown.

    Returns:
        The plane, or None when no plane has enough points.
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
        return _refined(samples, up, level, is_near)
    found = _searched(samples)
    fit = found and _refined(samples, *found)
    support = fit and _supporting_level(samples, fit)
    if fit is None or support is None:
        return fit
    other = _refined(samples, fit.normal, support)
    # Least squares leave a level that is no plane.
    is_parallel = other is not None and other.normal @ fit.normal > math.cos(_PLANE_TILT)
    return other if is_parallel else fit


def _searched(samples: _Samples) -> tuple[FloatArray, float] | None:
    """Normal and offset of the largest accepted plane, by RANSAC."""
    step = 1 + len(samples.points) // _SEARCHED_POINTS
    points, random = samples.points[::step].astype(np.float32), np.random.default_rng(0)
    for _ in range(_SEARCHES):
        if len(points) < samples.needed / step:
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


def _supporting_level(samples: _Samples, fit: PlaneFit) -> float | None:
    """Offset of a plane parallel to a fit that supports the scene instead, if there is one.

    - Above a floor: a wide level that is higher than objects are, and nearer to the camera than
      the floor: the table.
    - Below a box: a level wider than the fit, within the height of objects: its support.
    """
    points, own = samples.points, samples.points[fit.inliers]
    height = points @ fit.normal - fit.offset
    for low, high, fraction in (
        (_OBJECT_HEIGHT, _TABLE_HEIGHT, 0.2),
        (-_OBJECT_HEIGHT, -2.0 * _BIN, 0.15),
    ):
        votes, edges = np.histogram(height, round((high - low) / _BIN), (low, high))
        votes = np.convolve(votes, np.ones(3, dtype=np.int64), mode="same")
        if votes.max() < max(samples.needed, fraction * len(own)):
            continue
        at = edges[votes.argmax()] + 0.5 * _BIN
        level = points[np.abs(height - at) < 1.5 * _BIN]
        wide = _area(level, fit.normal)
        if at > 0.0:
            near, far = (np.median(np.linalg.norm(part, axis=1)) for part in (level, own))
            is_support = near < far and wide > _LEAST_TABLE
        else:
            is_support = _area(own, fit.normal) < min(_LARGEST_TOP, wide)
        if is_support:
            return float(fit.offset + at)
    return None


def _area(points: FloatArray, normal: FloatArray) -> float:
    """Area [m^2] of the rectangle with the points' variances along a plane."""
    axes = plane_axes(normal)
    return float(12.0 * np.sqrt(max(np.linalg.det(axes @ np.cov(points.T) @ axes.T), 0.0)))


def _refined(
    samples: _Samples, normal: FloatArray, offset: float, allowed: BoolArray | None = None
) -> PlaneFit | None:
    """The plane by weighted least squares; None where too few allowed points (N,) support it."""
    step = 1 + len(samples.points) // _REFINED_POINTS
    points, tolerance = samples.points[::step], samples.tolerance[::step]
    weights = tolerance**-2
    for band in _BANDS:
        near = np.abs(points @ normal - offset) < band * tolerance
        if np.count_nonzero(near) < 3:
            return None
        weight, inner = weights[near], points[near]
        center = weight @ inner / weight.sum()
        apart = inner - center
        normal = np.linalg.eigh((weight * apart.T) @ apart)[1][:, 0]
        normal = normal if normal @ samples.up >= 0.0 else -normal
        offset = float(normal @ center)
    height = samples.points @ normal - offset
    inliers = np.abs(height) < samples.tolerance
    if allowed is not None:
        inliers &= allowed
    if np.count_nonzero(inliers) < samples.needed or not samples.accepts(normal):
        return None
    return PlaneFit(normal, offset, float(np.sqrt(np.mean(height[inliers] ** 2))), inliers)


def table_extent(
    fit: PlaneFit, points: FloatArray, pixel: IntArray, shape: tuple[int, ...]
) -> FloatArray:
    """Computes points (E, 3) that span the extent of a table in the frame of the camera [m].

    An opening of the table's mask by 3 x 3 pixels removes the thin line where its plane
    intersects a wall.

    Args:
        fit: the table.
        points: (N, 3) samples of which it has been found [m].
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
    # Not beyond the upper border: those parts are farther away than their feet.
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
        table_W: (E, 3) points of the table [m].
        normal_W: (3,) its unit normal.

    Returns:
        (N,) largest distance, along the plane, beyond any of the half-planes that bound
        the extent [m]: negative inside; infinite where the table has no extent.
    """
    outward = _OUTWARD @ plane_axes(normal_W)
    reach = (outward @ table_W.T).max(axis=1, initial=-np.inf)
    return np.asarray((p_WQ @ outward.T - reach).max(axis=1))


def plane_axes(normal: FloatArray) -> FloatArray:
    """(2, 3) orthonormal axes of the plane with a unit normal."""
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])
