"""The supporting plane of a scene: a robust fit that knows which way is up.

A plane is ``normal . p = offset`` with a unit normal that points to the free
side. Hypotheses that contradict gravity are dropped before they are scored, so
that a wall never wins over a table that covers fewer pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_oa.point_cloud_kernels import band_moments, on_plane, votes_for_planes
from drake_oa.values import BoolArray, FloatArray

_HYPOTHESES = 400
_SCORED_POINTS = 800
_REFINED_POINTS = 4000
_SEED = 20190701


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
    with weights ``1 / tolerance**2``.

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
    if height is not None:
        level, reach = np.append(up, height), np.full(len(points), float(height_tolerance))
        on_plane(points, reach, level, allowed, allowed)
    candidates = np.flatnonzero(allowed)
    needed = max(20, int(min_fraction * len(points)))
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
    return _refined(points, allowed, tolerance, best, up, max_tilt, needed)


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
) -> PlaneFit | None:
    normal, offset = plane
    step = 1 + len(points) // _REFINED_POINTS
    chosen = step * np.flatnonzero(allowed[::step])
    some, some_tolerance, moments = points[chosen], tolerance[chosen], np.empty((4, 4))
    # A narrowing band sheds the feet of what stands on the plane.
    for band in (1.0, 0.7, 0.5, 0.5):
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
