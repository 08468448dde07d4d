"""Judges motions by float64 geometry of its own, whatever kernel chose them.

The compiled loops share no code with the kernels that make the motions: only the exact nearest
point of `drake_oa.geometry.ellipsoid_kernels`. Every kernel takes writable C-contiguous float64
arrays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.common.numba_tools import kernel_arrays
from drake_oa.geometry.ellipsoid_kernels import nearest_point
from drake_oa.studies.scenes.scenes import DURATION, Batch, Motions, Scenes, scene_distance

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_COARSE = 32
"""Every how many samples the first pass looks, to bound the least distance from above."""


class Bodies(NamedTuple):
    """Moving ellipsoids (N, M, ...) of N scenes, as in `Scenes`, or one of them."""

    center: FloatArray
    R: FloatArray
    semi_axes: FloatArray
    velocity: FloatArray


class Curves(NamedTuple):
    """Motions (N, K + 1, 3) at instants dt apart, or one: positions, velocities, dt (N,)."""

    path: FloatArray
    velocity: FloatArray
    dt: Any


@compiled
def _distance(p: FloatArray, t: float, body: Bodies, work: FloatArray) -> float:
    """Signed distance of a point (3,) at a time to one body; work is (3, 3) scratch."""
    x0 = p[0] - body.velocity[0] * t - body.center[0]
    x1 = p[1] - body.velocity[1] * t - body.center[1]
    x2 = p[2] - body.velocity[2] * t - body.center[2]
    for i in range(3):
        work[0, i] = abs(body.R[0, i] * x0 + body.R[1, i] * x1 + body.R[2, i] * x2)
    return nearest_point(work[0], body.semi_axes, work[1], work[2])


@compiled
def _hermite(curve: Curves, at: float, p: FloatArray) -> None:
    """Writes the cubic Hermite interpolant of one motion at `at` intervals from its start."""
    k = min(int(at), curve.path.shape[0] - 2)
    s = at - k
    r = 1.0 - s
    h00, h01 = (1.0 + 2.0 * s) * r * r, (1.0 + 2.0 * r) * s * s
    h10, h11 = s * r * r * curve.dt, -s * s * r * curve.dt
    for i in range(3):
        p[i] = h00 * curve.path[k, i] + h01 * curve.path[k + 1, i]
        p[i] += h10 * curve.velocity[k, i] + h11 * curve.velocity[k + 1, i]


@compiled
def _distance_at(curve: Curves, at: float, body: Bodies, work: FloatArray) -> float:
    p = np.empty(3)
    _hermite(curve, at, p)
    return _distance(p, at * curve.dt, body, work)


@compiled
def _least_distance(
    curve: Curves, body: Bodies, low: float, high: float, work: FloatArray
) -> float:
    """Least distance between two instants [intervals] by golden-section search.

    To 1e-8 of the span in place, far closer in distance: it is convex along a line.
    """
    best = min(_distance_at(curve, low, body, work), _distance_at(curve, high, body, work))
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    f_left = _distance_at(curve, left, body, work)
    f_right = _distance_at(curve, right, body, work)
    for _ in range(38):
        best = min(best, f_left, f_right)
        if f_left <= f_right:
            high, right, f_right = right, left, f_left
            left = high - _GOLDEN * (high - low)
            f_left = _distance_at(curve, left, body, work)
        else:
            low, left, f_left = left, right, f_right
            right = low + _GOLDEN * (high - low)
            f_right = _distance_at(curve, right, body, work)
    return best


@numba.njit(cache=True, error_model="numpy", parallel=True, fastmath=False)
def segment_distances(begin: FloatArray, end: FloatArray, bodies: Bodies, out: FloatArray) -> None:
    """Least signed distance (N,) of segments (N, 3) to (N, 3) to one resting body each."""
    for n in numba.prange(out.shape[0]):
        path, velocity = np.empty((2, 3)), np.empty((2, 3))
        path[0], path[1] = begin[n], end[n]
        velocity[:] = end[n] - begin[n]
        curve = Curves(path, velocity, 1.0)
        body = Bodies(bodies.center[n], bodies.R[n], bodies.semi_axes[n], bodies.velocity[n])
        out[n] = _least_distance(curve, body, 0.0, 1.0, np.empty((3, 3)))


@numba.njit(cache=True, error_model="numpy", parallel=True, fastmath=False)
def judge_motions(curves: Curves, bodies: Bodies, substeps: int, out: FloatArray) -> None:
    """Rows of out (N, 2): least signed distance to any obstacle (inf: none), path length.

    The motion is sampled at `substeps` instants an interval. The distance changes by no
    more than the obstacle and the point move against each other, so from a sample at
    the distance d every sample is passed over until they have moved by d - best. The
    neighbourhood of the nearest sample is searched to the end.
    """
    for n in numba.prange(out.shape[0]):
        curve = Curves(curves.path[n], curves.velocity[n], curves.dt[n])
        count = (curve.path.shape[0] - 1) * substeps + 1
        points, work = np.empty((count, 3)), np.empty((3, 3))
        still, length = np.zeros(3), 0.0
        for k in range(count):
            _hermite(curve, k / substeps, points[k])
            if k > 0:
                length += _apart(points[k], points[k - 1], still, 0.0)
        best, best_k, best_m = np.inf, 0, -1
        fine = curve.dt / substeps
        for m in range(bodies.center.shape[1]):
            if math.isnan(bodies.center[n, m, 0]):
                continue
            body = _one(bodies, n, m)
            for coarse in range(0, count + _COARSE - 1, _COARSE):
                k = min(coarse, count - 1)
                d = _distance(points[k], k * fine, body, work)
                if d < best:
                    best, best_k, best_m = d, k, m
            k = 0
            while k < count:
                d = _distance(points[k], k * fine, body, work)
                if d < best:
                    best, best_k, best_m = d, k, m
                spare, moved, k = d - best, 0.0, k + 1
                while k < count:
                    moved += _apart(points[k], points[k - 1], body.velocity, fine)
                    if moved >= spare:
                        break
                    k += 1
        if best_m >= 0:
            low, high = max(best_k - 1, 0) / substeps, min(best_k + 1, count - 1) / substeps
            nearest = _least_distance(curve, _one(bodies, n, best_m), low, high, work)
            best = min(best, nearest)
        out[n, 0] = best
        out[n, 1] = length


@compiled
def _one(bodies: Bodies, n: int, m: int) -> Bodies:
    return Bodies(
        bodies.center[n, m], bodies.R[n, m], bodies.semi_axes[n, m], bodies.velocity[n, m]
    )


@compiled
def _apart(p: FloatArray, q: FloatArray, v: FloatArray, t: float) -> float:
    """Length of p - q - v t."""
    x, y, z = p[0] - q[0] - v[0] * t, p[1] - q[1] - v[1] * t, p[2] - q[2] - v[2] * t
    return math.sqrt(x * x + y * y + z * z)


SUBSTEPS = 4
"""Samples judged in each interval of a motion."""

SLACK = 1e-3
"""By how much a clearance may be short before it counts as short [m]."""


@dataclass(frozen=True, eq=False)
class Judgement(Batch):
    """What N motions came to.

    Attributes:
        kept_clearance: (N,) least signed distance to any obstacle over the whole motion,
            negative inside; inf in a scene without obstacles [m].
        feasible: (N,) min(Delta, distance of the start at t = 0, distance of the goal at
            the end of the motion) [m].
        goal_error: (N,) distance to the goal at the end [m].
        path_length: (N,) [m].
        baseline: (N,) distance from start to goal: the planned path's length [m].
        asked: (N,) the clearance Delta asked for [m].
        duration: (N,) how long the motion lasts [s].
        out_of_range: (N,) 1 where the regressor chain was asked outside its trained range.
    """

    kept_clearance: FloatArray
    feasible: FloatArray
    goal_error: FloatArray
    path_length: FloatArray
    baseline: FloatArray
    asked: FloatArray
    duration: FloatArray
    out_of_range: FloatArray

    def __len__(self) -> int:
        return len(self.kept_clearance)

    @property
    def collided(self) -> BoolArray:
        """(N,) whether an obstacle was touched."""
        return self.kept_clearance <= 0.0

    @property
    def short(self) -> BoolArray:
        """(N,) whether the clearance is more than `SLACK` short of the feasible one."""
        return self.kept_clearance < self.feasible - SLACK

    @property
    def path_ratio(self) -> FloatArray:
        """(N,) length of the path over that of the planned one."""
        return self.path_length / self.baseline

    @property
    def arrival(self) -> FloatArray:
        """(N,) duration over tau T, tau = path ratio, at least 1."""
        return self.duration / (DURATION * np.maximum(self.path_ratio, 1.0))


def judge(scenes: Scenes, motions: Motions, substeps: int = SUBSTEPS) -> Judgement:
    """Judges one motion a scene.

    The path is a cubic Hermite interpolant of positions and velocities, looked at
    `substeps` times an interval, and to convergence round the nearest of these samples.

    Args:
        scenes: N scenes.
        motions: N motions.
        substeps: samples an interval, at least 1.

    Returns:
        The judgement.

    Raises:
        ValueError: if shapes disagree, or a motion is not finite or has no duration.
    """
    N = len(scenes)
    _check(motions, N)
    if substeps < 1:
        raise ValueError(f"substeps must be at least 1, not {substeps}")
    out = np.empty((N, 2))
    judge_motions(
        Curves(*kernel_arrays(motions.path, motions.velocity, motions.duration / motions.steps)),
        Bodies(*kernel_arrays(scenes.center, scenes.R, scenes.semi_axes, scenes.velocity)),
        substeps,
        out,
    )
    goal = scenes.goal
    ends = (
        scene_distance(scenes, np.zeros_like(goal), np.zeros(N)),
        scene_distance(scenes, goal, motions.duration),
    )
    return Judgement(
        kept_clearance=out[:, 0].copy(),
        feasible=np.minimum(scenes.clearance, np.minimum(*ends)),
        goal_error=np.linalg.norm(motions.path[:, -1] - goal, axis=1),
        path_length=out[:, 1].copy(),
        baseline=np.array(scenes.baseline),
        asked=np.array(scenes.clearance),
        duration=np.array(motions.duration),
        out_of_range=np.zeros(N) if motions.in_range is None else (~motions.in_range).astype(float),
    )


def _check(motions: Motions, count: int) -> None:
    shape = motions.path.shape
    if len(shape) != 3 or shape[0] != count or shape[1] < 2 or shape[2] != 3:
        raise ValueError(f"path must be ({count}, S + 1, 3) with S >= 1, not {shape}")
    if motions.velocity.shape != shape:
        raise ValueError(f"velocity must be {shape} as path is, not {motions.velocity.shape}")
    if motions.duration.shape != (count,):
        raise ValueError(f"duration must be ({count},), not {motions.duration.shape}")
    for name, values in (("path", motions.path), ("velocity", motions.velocity)):
        finite = np.isfinite(values).all(axis=(1, 2))
        if not finite.all():
            row = int(np.argmin(finite))
            raise ValueError(f"{name} must be finite: that of scene {row} is not")
    lasting = np.isfinite(motions.duration) & (motions.duration > 0.0)
    if not lasting.all():
        row = int(np.argmin(lasting))
        raise ValueError(
            f"duration must be positive and finite: scene {row} has {motions.duration[row]} s"
        )
