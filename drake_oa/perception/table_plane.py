"""The supporting plane of a scene: a robust fit that knows which way is up.

A plane is ``normal . p = offset`` with a unit normal that points to the free
side. Hypotheses that contradict gravity are dropped before they are scored, so
that a wall never wins over a table that covers fewer pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.perception.point_cloud_kernels import band_moments, on_plane, votes_for_planes

_HYPOTHESES = 400
_SCORED_POINTS = 800
_REFINED_POINTS = 4000
_SEED = 20190701
# A narrowing band sheds the feet of what stands on the plane.
_BANDS = (1.0, 1.0, 0.7, 0.5, 0.5)
# From an expected plane that holds so much of what lies at its height within this share
# of the tolerance, no other plane can be the one; there fewer steps suffice.
_EXPECTED_SHARE = 0.5
_EXPECTED_BAND = 0.5
_EXPECTED_BANDS = (1.0, 0.5, 0.5)
# What is lower stands on a floor or table; what is higher and wide is a table on a floor.
_OBJECT_HEIGHT = 0.45
_TABLE_HEIGHT = 1.3
_LEAST_TABLE = 0.1  # area [m^2]
_LARGEST_TOP = 0.4  # of a box [m^2]
_BIN = 0.01  # of a histogram of heights [m]


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
    height_tolerance: float = 0.05,
    origin_above: bool = False,
    min_fraction: float = 0.05,
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
            points within ``height_tolerance`` of it are considered. None: unknown.
        height_tolerance: see ``height`` [m].
        origin_above: whether the origin (the camera) must be on the free side.
        min_fraction: smallest share of the points that makes a plane.

    Returns:
        The plane, or None when no plane is supported by enough points.
    """
    points, tolerance = (np.require(x, np.float64, ["C", "W"]) for x in (points, tolerance))
    allowed = np.ones(len(points), dtype=bool)
    needed = max(20, int(min_fraction * len(points)))
    if height is not None:
        level, reach = np.append(up, height), np.full(len(points), float(height_tolerance))
        on_plane(points, reach, level, allowed, allowed)
        near = np.empty(len(points), dtype=bool)
        on_plane(points, _EXPECTED_BAND * tolerance, level, allowed, near)
        most = max(needed, _EXPECTED_SHARE * np.count_nonzero(allowed))
        if np.count_nonzero(near) >= most and not (origin_above and height >= 0.0):
            expected = (up, float(height))
            fit = _refined(
                points, allowed, tolerance, expected, up, max_tilt, needed, _EXPECTED_BANDS
            )
            if fit is not None:
                return fit
    candidates = np.flatnonzero(allowed)
    if len(candidates) < needed:
        return None

    rng = np.random.default_rng(_SEED)
    if len(candidates) > _SCORED_POINTS:
        candidates = rng.choice(candidates, _SCORED_POINTS, replace=False)
    best = _best_hypothesis(
        points[candidates], up, max_tilt, tolerance[candidates], origin_above, rng
    )
    if best is None:
        return None
    fit = _refined(points, allowed, tolerance, best, up, max_tilt, needed)
    if fit is None or height is not None:
        return fit
    support = _supporting_level(points, fit, tolerance, needed)
    if support is None:
        return fit
    other = _refined(points, allowed, tolerance, (fit.normal, support), up, max_tilt, needed)
    # A level that is no plane leaves its height when it is refined.
    if other is None or other.normal @ fit.normal < np.cos(np.deg2rad(5.0)):
        return fit
    return fit if origin_above and other.offset >= 0.0 else other


def _supporting_level(
    points: FloatArray, fit: PlaneFit, tolerance: FloatArray, needed: int
) -> float | None:
    """The offset of a plane parallel to a fit that supports what is seen, if another does.

    - Above a floor: a wide level that is higher than objects are, and nearer to the
      origin (where the camera is) than the floor: the table.
    - Below a box: a level wider than the fit, within the height of objects, is what
      the box stands on.

    Args:
        points: (N, 3) points [m].
        fit: the plane with the most points on it.
        tolerance: (N,) distance [m] at which a point belongs to a plane.
        needed: number of points that makes a plane.
    """
    height = points @ fit.normal - fit.offset
    edges = np.arange(-_OBJECT_HEIGHT, _TABLE_HEIGHT, _BIN)
    bins = ((height + _OBJECT_HEIGHT) * (1.0 / _BIN)).astype(np.int64)
    count = np.bincount(bins[(bins >= 0) & (bins < len(edges))], minlength=len(edges))
    votes = np.convolve(count, np.ones(3, dtype=np.int64), mode="same")
    middle = edges + 0.5 * _BIN
    own = int(np.count_nonzero(fit.inliers))
    above = np.where((middle > _OBJECT_HEIGHT) & (votes >= max(needed, own // 5)), votes, 0)
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
    covariance = np.cov(points.T)
    # The product of the two variances in the plane: the determinant of the rest.
    trace, along = np.trace(covariance), float(normal @ covariance @ normal)
    squares = np.einsum("ij,ij->", covariance, covariance)
    cross = covariance @ normal
    product = 0.5 * ((trace - along) ** 2 - (squares - 2.0 * (cross @ cross) + along**2))
    return float(12.0 * np.sqrt(max(product, 0.0)))


def _best_hypothesis(
    points: FloatArray,
    up: FloatArray,
    max_tilt: float,
    tolerance: FloatArray,
    origin_above: bool,
    rng: np.random.Generator,
) -> tuple[FloatArray, float] | None:
    a, b, c = points[rng.integers(len(points), size=(3, _HYPOTHESES))]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    usable = length > 1e-9
    normals, a = normals[usable] / length[usable, None], a[usable]
    cosine = normals @ up
    normals = np.where(cosine[:, None] < 0.0, -normals, normals)
    offsets = np.einsum("ij,ij->i", normals, a)
    upright = np.abs(cosine) >= np.cos(max_tilt)
    if origin_above:
        upright &= offsets < 0.0
    normals, offsets = normals[upright], offsets[upright]
    if not len(normals):
        return None
    votes = votes_for_planes(normals, offsets, points, tolerance)
    winner = int(np.argmax(votes))
    return normals[winner], float(offsets[winner])


def _refined(
    points: FloatArray,
    allowed: BoolArray,
    tolerance: FloatArray,
    plane: tuple[FloatArray, float],
    up: FloatArray,
    max_tilt: float,
    needed: int,
    bands: tuple[float, ...] = _BANDS,
) -> PlaneFit | None:
    normal, offset = plane
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
    if normal @ up < np.cos(max_tilt):
        return None
    inliers = np.empty(len(points), dtype=bool)
    total = on_plane(points, tolerance, np.append(normal, offset), allowed, inliers)
    count = np.count_nonzero(inliers)
    if count < needed:
        return None
    rms = float(np.sqrt(total / count))
    return PlaneFit(normal, offset, rms, inliers)
