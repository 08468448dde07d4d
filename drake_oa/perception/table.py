"""The supporting plane of a scene: a robust fit that knows which way is up.

A plane is ``normal . p = offset`` with a unit normal that points to the free
side. Hypotheses that contradict gravity are dropped before they are scored, so
that a wall never wins over a table that covers fewer pixels.

It reaches as far as the convex region of its plane that holds what was seen of it: projection
keeps convexity, so the ends of the table's rows in the image span that region. A table that the
border of the image cuts goes on beyond it: the feet of what stands in front of the lowest row
are not seen.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, IntArray


@compiled
def on_plane(
    points: FloatArray, tolerance: FloatArray, plane: FloatArray, among: BoolArray, out: BoolArray
) -> float:
    """Marks, of some points (N, 3), those nearer to a plane than their tolerance (N,).

    Args:
        points: (N, 3) points [m].
        tolerance: (N,) [m].
        plane: (4,) unit normal and offset.
        among: (N,) which points are asked about.
        out: (N,) written.

    Returns:
        The sum of their squared distances [m^2].
    """
    total = 0.0
    for i in range(len(tolerance)):
        height = -plane[3]
        for k in range(3):
            height += plane[k] * points[i, k]
        out[i] = among[i] and abs(height) < tolerance[i]
        total += height * height if out[i] else 0.0
    return total


@compiled
def band_moments(
    points: FloatArray, tolerance: FloatArray, plane: FloatArray, band: float, out: FloatArray
) -> int:
    """Weighted moments of the points within ``band * tolerance`` of a plane.

    Args:
        points: (N, 3) points [m].
        tolerance: (N,) [m]; the weights are 1 / tolerance^2.
        plane: (4,) unit normal and offset.
        band: share of the tolerance.
        out: (4, 4) written: the sum of w p p^T with p = (x, y, z, 1), each point
            taken from the first one of the band for the sake of precision; its
            index is returned.

    Returns:
        The index of that point, or -1 when there are fewer than 3.
    """
    out[:] = 0.0
    first, count = -1, 0
    p = np.ones(4)
    for i in range(len(tolerance)):
        height = -plane[3]
        for k in range(3):
            height += plane[k] * points[i, k]
        if abs(height) >= band * tolerance[i]:
            continue
        if first < 0:
            first = i
        count += 1
        weight = 1.0 / (tolerance[i] * tolerance[i])
        for k in range(3):
            p[k] = points[i, k] - points[first, k]
        for k in range(4):
            for j in range(k + 1):
                out[k, j] += weight * p[k] * p[j]
    for k in range(4):
        for j in range(k):
            out[j, k] = out[k, j]
    return first if count >= 3 else -1


_UNSEEN = 0.3
"""Distance that a table is taken to go on beyond the border of the image [m]."""
_BEYOND = 0.5
"""Distance beyond the border, in sizes of the image, at which the table's plane is looked up."""
_BORDER = 2
"""Rows and columns of the grid that are the border."""
_ANGLES = np.arange(64) * (2.0 * np.pi / 64)
_OUTWARD = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])
"""Outer normals of the half-planes that bound the extent of a table, along the plane's axes."""


def seen_extent(
    shape: tuple[int, int],
    pixel: IntArray,
    on_table: BoolArray,
    p_CQ: FloatArray,
    fit: PlaneFit,
    pitch: tuple[float, float],
) -> FloatArray:
    """Points (E, 3) on the plane, in the camera frame [m], that span the table's extent.

    The table's mask is opened by a square of 3 x 3, which removes the thin line where its plane
    cuts a wall.

    Args:
        shape: rows and columns of the grid of samples.
        pixel: (N,) ascending flat index of each sample in that grid.
        on_table: (N,) whether it lies on the table.
        p_CQ: (N, 3) the samples in the camera frame [m].
        fit: the table in the camera frame.
        pitch: tangents x / z and y / z from a column and a row of the grid to the next.
    """
    rows, columns = shape
    sample = np.full(rows * columns, -1)
    sample[pixel[on_table]] = np.flatnonzero(on_table)
    sample = sample.reshape(shape)
    shown = sample >= 0
    shown = shown[:-2] & shown[1:-1] & shown[2:]
    inner = np.zeros((rows + 2, columns + 2), dtype=bool)
    inner[2:-2, 2:-2] = shown[:, :-2] & shown[:, 1:-1] & shown[:, 2:]
    opened = inner[:-2] | inner[1:-1] | inner[2:]
    opened = opened[:, :-2] | opened[:, 1:-1] | opened[:, 2:]
    row = np.flatnonzero(opened.any(axis=1))
    # First and last column, (2, R).
    ends = np.stack([opened[row].argmax(axis=1), columns - 1 - opened[row, ::-1].argmax(axis=1)])
    border = p_CQ[sample[row, ends]][:, :, None]
    # Not beyond the upper border: what is there is farther away than its feet are.
    across, down = _BEYOND * columns * pitch[0], _BEYOND * rows * pitch[1]
    step = np.array([[0.0, down, 0.0], [-across, 0.0, 0.0], [across, 0.0, 0.0]])
    column = pixel % columns
    at_border = [
        np.broadcast_to(row >= pixel[-1] // columns - _BORDER, ends.shape),
        ends <= column.min() + _BORDER,
        ends >= column.max() - _BORDER,
    ]
    points = np.concatenate([border, _beyond(border, step, fit)], axis=2)
    return np.asarray(points[np.stack([np.full(ends.shape, True), *at_border], axis=2)])


def _beyond(border: FloatArray, step: FloatArray, fit: PlaneFit) -> FloatArray:
    """Points of the table beyond the border, where rays further out meet its plane.

    Args:
        border: (..., 3) points of the table at the border [m].
        step: (..., 3) tangents from the border outwards.
        fit: the table.
    """
    ray = border / border[..., 2:] + step
    along = (ray * fit.normal).sum(axis=-1, keepdims=True)
    # Rays that do not meet the plane in front of the camera go on as far as any may.
    met = along * np.sign(fit.offset) > 1e-3
    way = np.where(met, ray * (fit.offset / np.where(met, along, 1.0)) - border, step)
    way = way - (way * fit.normal).sum(axis=-1, keepdims=True) * fit.normal
    length = np.sqrt((way * way).sum(axis=-1, keepdims=True))
    reach = np.where(met, np.minimum(length, _UNSEEN), _UNSEEN)
    return np.asarray(border + way * (reach / np.maximum(length, 1e-9)))


def beyond_extent(p_WQ: FloatArray, table_W: FloatArray, normal_W: FloatArray) -> FloatArray:
    """How far points stand beyond the convex extent of the table's points.

    Args:
        p_WQ: (N, 3) points [m].
        table_W: (E, 3) points of the table [m].
        normal_W: (3,) its unit normal.

    Returns:
        (N,) largest distance, along the plane, beyond any of the half-planes that bound
        the extent [m]: negative inside; infinite where the table has no extent.
    """
    if not len(table_W):
        return np.full(len(p_WQ), np.inf)
    axes = plane_axes(normal_W)
    reach = (_OUTWARD @ (axes @ table_W.T)).max(axis=1)
    a, b = ((axis * p_WQ).sum(axis=1) for axis in axes)
    distance = _OUTWARD[:, :1] * a + _OUTWARD[:, 1:] * b - reach[:, None]
    return np.asarray(distance.max(axis=0))


def plane_axes(normal: FloatArray) -> FloatArray:
    """(2, 3) orthonormal axes of the plane with that normal."""
    a, b, c = normal
    smallest = int(np.argmin(np.abs(normal)))
    first = -normal[smallest] * normal
    first[smallest] += 1.0
    first /= np.sqrt(first @ first)
    x, y, z = first
    # NumPy's cross product takes long for so few numbers.
    return np.array([first, [b * z - c * y, c * x - a * z, a * y - b * x]])


_SEED = 20190701
# A narrowing band sheds the feet of what stands on the plane; from an expected plane fewer
# steps suffice.
_BANDS = (1.0, 1.0, 0.7, 0.5, 0.5)
_EXPECTED_BANDS = (1.0, 0.5, 0.5)
_BIN = 0.01  # of a histogram of heights [m]
DEPTH_NOISE = 0.0015
"""Standard deviation of depth at 1 m; it grows with the square of the depth [1/m]."""
_PLANE_TILT = math.radians(5.0)
"""Largest tilt of the table against gravity where the pose of the camera is known [rad]."""
_PLANE_TILT_UNKNOWN_POSE = math.radians(75.0)
"""Largest tilt of the table against the camera's up direction (-y), pose unknown [rad]."""
_FACING_TILT = math.radians(15.0)
"""Largest tilt of the table against the direction towards a camera above it (-z) [rad]."""
_PLANE_TOLERANCE = 0.006
"""Distance from the plane at which a point at depth 0 belongs to it [m]."""
_HYPOTHESES = 400
"""Planes that are proposed."""
_SCORED_POINTS = 800
"""Most points that vote for the proposed planes."""
_REFINED_POINTS = 4000
"""About how many points refine the best plane."""
LEAST_SHARE = 0.05
"""Share of the points that the smallest plane holds."""
_EXPECTED_SHARE = 0.5
"""Share of the points at its height that an expected plane holds."""
_EXPECTED_BAND = 0.5
"""Share of the tolerance within which a point is on an expected plane."""
HEIGHT_TOLERANCE = 0.05
"""Greatest distance of the table from its expected height [m]."""
_OBJECT_HEIGHT = 0.45
"""Greatest height of an object over what it stands on [m]."""
_TABLE_HEIGHT = 1.3
"""Greatest height of a table over the floor [m]."""
_LEAST_TABLE = 0.1
"""Area of the smallest table on a floor [m^2]."""
_LARGEST_TOP = 0.4
"""Area of the largest top of a box [m^2]."""


@dataclass(frozen=True)
class PlaneFit:
    """A plane ``normal . p = offset`` fitted to points.

    Attributes:
        normal: (3,) unit normal in the frame of the points.
        offset: distance of the plane from the origin along the normal [m].
        rms: root mean square distance of the inliers from the plane [m].
        inliers: (N,) which of the given points lie on the plane.
    """

    normal: FloatArray
    offset: float
    rms: float
    inliers: BoolArray


def fit_plane(
    points: FloatArray,
    up: FloatArray,
    max_tilt: float,
    tolerance: FloatArray,
    *,
    height: float | None = None,
    origin_above: bool = False,
) -> PlaneFit | None:
    """Finds the plane with the most points on it among those that face ``up``.

    Random triples (of a fixed seed: equal input gives equal output) propose
    planes; those tilted by more than ``max_tilt`` are dropped, the rest is scored
    by its number of inliers, and the best is refined by weighted least squares,
    with weights ``1 / tolerance**2``. Where ``height`` is given and most of what lies about
    there lies on the level plane at that height, that plane is refined, without a search.
    Where ``height`` is not given, what has the most
    points may be the floor round a small table, or the top of a large box on one:
    see `_supporting_level`.

    Args:
        points: (N, 3) finite points [m], in any frame.
        up: (3,) unit vector that the normal roughly follows, same frame.
        max_tilt: largest angle between the normal and ``up`` [rad], below pi/2.
        tolerance: (N,) distance from the plane at which each point still belongs
            to it [m], positive.
        height: expected offset along ``up`` at the foot of the origin [m]; only
            points within `HEIGHT_TOLERANCE` of it are considered. None: unknown.
        origin_above: whether the origin (the camera) must be on the free side.

    Returns:
        The plane, or None when no plane is supported by enough points.
    """
    points, tolerance = (np.require(x, np.float64, ["C", "W"]) for x in (points, tolerance))
    needed = max(20, int(LEAST_SHARE * len(points)))
    allowed = np.ones(len(points), dtype=bool)
    seen = _Samples(points, tolerance, allowed, up, max_tilt, origin_above, needed)
    if height is not None:
        level, reach = np.append(up, height), np.full(len(points), HEIGHT_TOLERANCE)
        on_plane(points, reach, level, allowed, allowed)
        near = np.empty(len(points), dtype=bool)
        on_plane(points, _EXPECTED_BAND * tolerance, level, allowed, near)
        most = max(needed, _EXPECTED_SHARE * np.count_nonzero(allowed))
        if np.count_nonzero(near) >= most and not (origin_above and height >= 0.0):
            fit = _refined(seen, (up, float(height)), _EXPECTED_BANDS)
            if fit is not None:
                return fit
    if np.count_nonzero(allowed) < needed:
        return None
    best = _best_hypothesis(seen)
    if best is None:
        return None
    fit = _refined(seen, best)
    if fit is None or height is not None:
        return fit
    support = _supporting_level(seen, fit)
    if support is None:
        return fit
    other = _refined(seen, (fit.normal, support))
    # A level that is no plane leaves its height when it is refined.
    if other is None or other.normal @ fit.normal < np.cos(np.deg2rad(5.0)):
        return fit
    return fit if origin_above and other.offset >= 0.0 else other


def find_table(
    sample: FloatArray, distance: FloatArray, X_WC: FloatArray | None, table_height: float | None
) -> PlaneFit | None:
    """Finds the table in the camera's frame.

    Args:
        sample: (N, 3) points in the frame of the camera [m].
        distance: (N,) their depths [m].
        X_WC: (4, 4) pose of the camera; None: unknown.
        table_height: height of the table in the world [m]; None: unknown.
    """
    tolerance = _PLANE_TOLERANCE + DEPTH_NOISE * distance**2
    if X_WC is None:
        up = np.array([0.0, -1.0, 0.0])
        fit = fit_plane(sample, up, _PLANE_TILT_UNKNOWN_POSE, tolerance, origin_above=True)
        if fit is not None and np.mean(fit.inliers) > 0.4:
            return fit
        # A camera that looks straight down: its up direction lies in the table.
        toward = np.array([0.0, 0.0, -1.0])
        facing = fit_plane(sample, toward, _FACING_TILT, tolerance, origin_above=True)
        if fit is None or facing is None:
            return facing if fit is None else fit
        return facing if facing.inliers.sum() > 2 * fit.inliers.sum() else fit
    up = X_WC[2, :3]
    height = None if table_height is None else table_height - X_WC[2, 3]
    return fit_plane(sample, up, _PLANE_TILT, tolerance, height=height)


class _Samples(NamedTuple):
    """The points among which a plane is searched; as `fit_plane` takes them."""

    points: FloatArray
    tolerance: FloatArray
    allowed: BoolArray
    up: FloatArray
    max_tilt: float
    origin_above: bool
    needed: int


def _supporting_level(seen: _Samples, fit: PlaneFit) -> float | None:
    """The offset of a plane parallel to a fit that supports what is seen, if another does.

    - Above a floor: a wide level that is higher than objects are, and nearer to the
      origin (where the camera is) than the floor: the table.
    - Below a box: a level wider than the fit, within the height of objects, is what
      the box stands on.
    """
    points, needed = seen.points, seen.needed
    height = points @ fit.normal - fit.offset
    edges = np.arange(-_OBJECT_HEIGHT, _TABLE_HEIGHT, _BIN)
    bins = ((height + _OBJECT_HEIGHT) * (1.0 / _BIN)).astype(np.int64)
    count = np.bincount(bins[(bins >= 0) & (bins < len(edges))], minlength=len(edges))
    votes = np.convolve(count, np.ones(3, dtype=np.int64), mode="same")
    middle = edges + 0.5 * _BIN
    own = int(np.count_nonzero(fit.inliers))
    high = middle > _OBJECT_HEIGHT
    above = np.where(high & (votes >= max(needed, own // 5)), votes, 0)
    below = np.where((middle < -0.02) & (votes >= max(needed, own // 7)), votes, 0)
    if not above.any() and not below.any():
        return None
    area = _spread_area(points[fit.inliers], fit.normal)
    for level, is_above in ((above, True), (below, False)):
        if not level.any():
            continue
        at = middle[int(np.argmax(level))]
        on_level = points[np.abs(height - at) < 1.5 * _BIN]
        wide = _spread_area(on_level, fit.normal)
        if is_above:
            own_distance = np.median(np.linalg.norm(points[fit.inliers], axis=1))
            nearer = np.median(np.linalg.norm(on_level, axis=1)) < own_distance
            if nearer and wide > _LEAST_TABLE:
                return float(fit.offset + at)
        elif area < _LARGEST_TOP and wide > area:
            return float(fit.offset + at)
    return None


def _spread_area(points: FloatArray, normal: FloatArray) -> float:
    """Area [m^2] of the rectangle with the points' variances along a plane."""
    axes = plane_axes(normal)
    return float(12.0 * np.sqrt(max(np.linalg.det(axes @ np.cov(points.T) @ axes.T), 0.0)))


def _best_hypothesis(seen: _Samples) -> tuple[FloatArray, float] | None:
    """Normal and offset of the plane through three points that most others lie on."""
    rng = np.random.default_rng(_SEED)
    chosen = np.flatnonzero(seen.allowed)
    if len(chosen) > _SCORED_POINTS:
        chosen = rng.choice(chosen, _SCORED_POINTS, replace=False)
    points = seen.points[chosen]
    a, b, c = points[rng.integers(len(points), size=(3, _HYPOTHESES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    usable = length > 1e-9
    normals, a = normals[usable] / length[usable, None], a[usable]
    cosine = normals @ seen.up
    normals = np.where(cosine[:, None] < 0.0, -normals, normals)
    offsets = np.einsum("ij,ij->i", normals, a)
    upright = np.abs(cosine) >= np.cos(seen.max_tilt)
    if seen.origin_above:
        upright &= offsets < 0.0
    normals, offsets = normals[upright], offsets[upright]
    if not len(normals):
        return None
    x, y, z = points.T
    distance = normals[:, :1] * x + normals[:, 1:2] * y + normals[:, 2:] * z - offsets[:, None]
    votes = (np.abs(distance) < seen.tolerance[chosen]).sum(axis=1)
    winner = int(np.argmax(votes))
    return normals[winner], float(offsets[winner])


def _refined(
    seen: _Samples, plane: tuple[FloatArray, float], bands: tuple[float, ...] = _BANDS
) -> PlaneFit | None:
    """The plane by weighted least squares; None where too few points support it."""
    normal, offset = plane
    points, tolerance, allowed, up = seen[:4]
    step = 1 + len(points) // _REFINED_POINTS
    chosen = step * np.flatnonzero(allowed[::step])
    some, some_tolerance, moments = points[chosen], tolerance[chosen], np.empty((4, 4))
    for band in bands:
        first = band_moments(some, some_tolerance, np.append(normal, offset), band, moments)
        if first < 0:
            return None
        mean = moments[3, :3] / moments[3, 3]
        _, axes = np.linalg.eigh(moments[:3, :3] - moments[3, 3] * np.outer(mean, mean))
        normal = axes[:, 0] if axes[:, 0] @ up >= 0.0 else -axes[:, 0]
        offset = float(normal @ (some[first] + mean))
    if normal @ up < np.cos(seen.max_tilt):
        return None
    inliers = np.empty(len(points), dtype=bool)
    total = on_plane(points, tolerance, np.append(normal, offset), allowed, inliers)
    count = np.count_nonzero(inliers)
    if count < seen.needed:
        return None
    rms = float(np.sqrt(total / count))
    return PlaneFit(normal, offset, rms, inliers)
