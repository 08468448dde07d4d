"""Compiled loops behind `drake_oa.studies.scenes.judge` and the suites.

They share no code with the kernels that make the motions: only the exact nearest point
of `drake_oa.geometry.ellipsoid_kernels`. Every kernel takes writable C-contiguous float64 arrays.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid_kernels import nearest_point

_GOLDEN = 0.5 * (math.sqrt(5.0) - 1.0)
_COARSE = 32
"""Every how many samples the first pass looks, to bound the least distance from above."""


@numba.njit(cache=True, error_model="numpy")
def distance_to(
    p: FloatArray, center: FloatArray, R: FloatArray, semi_axes: FloatArray, work: FloatArray
) -> float:
    """Signed distance of a point (3,) to one ellipsoid; work is (3, 3) scratch."""
    for i in range(3):
        work[0, i] = abs(
            R[0, i] * (p[0] - center[0])
            + R[1, i] * (p[1] - center[1])
            + R[2, i] * (p[2] - center[2])
        )
    return nearest_point(work[0], semi_axes, work[1], work[2])


@numba.njit(cache=True, error_model="numpy", parallel=True)
def segment_distances(
    begin: FloatArray,
    end: FloatArray,
    center: FloatArray,
    R: FloatArray,
    semi_axes: FloatArray,
    out: FloatArray,
) -> None:
    """Least signed distance of segments (N, 3) to (N, 3) to one ellipsoid each, row by row.

    The signed distance to a convex body is convex along a line, so a golden-section
    search finds it: to 1e-8 of the segment's length in place, far closer in distance.
    """
    for n in numba.prange(out.shape[0]):
        work, p = np.empty((3, 3)), np.empty(3)
        low, high = 0.0, 1.0
        left, right = 1.0 - _GOLDEN, _GOLDEN
        f = np.empty(4)
        for k in range(4):
            share = (0.0, 1.0, left, right)[k]
            for i in range(3):
                p[i] = begin[n, i] + share * (end[n, i] - begin[n, i])
            f[k] = distance_to(p, center[n], R[n], semi_axes[n], work)
        best = min(min(f[0], f[1]), min(f[2], f[3]))
        f_left, f_right = f[2], f[3]
        for _ in range(38):
            if f_left <= f_right:
                high, right, f_right = right, left, f_left
                left = high - _GOLDEN * (high - low)
                share = left
            else:
                low, left, f_left = left, right, f_right
                right = low + _GOLDEN * (high - low)
                share = right
            for i in range(3):
                p[i] = begin[n, i] + share * (end[n, i] - begin[n, i])
            d = distance_to(p, center[n], R[n], semi_axes[n], work)
            if share == left:
                f_left = d
            else:
                f_right = d
            best = min(best, d)
        out[n] = best


@numba.njit(cache=True, error_model="numpy")
def hermite(path: FloatArray, velocity: FloatArray, dt: float, at: float, p: FloatArray) -> None:
    """Writes the cubic Hermite interpolant of one motion at `at` intervals from its start."""
    k = min(int(at), path.shape[0] - 2)
    s = at - k
    r = 1.0 - s
    h00, h01 = (1.0 + 2.0 * s) * r * r, (1.0 + 2.0 * r) * s * s
    h10, h11 = s * r * r * dt, -s * s * r * dt
    for i in range(3):
        p[i] = (
            h00 * path[k, i]
            + h01 * path[k + 1, i]
            + h10 * velocity[k, i]
            + h11 * velocity[k + 1, i]
        )


@numba.njit(cache=True, error_model="numpy")
def _refined(
    path: FloatArray,
    velocity: FloatArray,
    dt: float,
    center: FloatArray,
    R: FloatArray,
    semi_axes: FloatArray,
    drift: FloatArray,
    low: float,
    high: float,
    work: FloatArray,
) -> float:
    """Least distance between two instants [intervals] by golden-section search."""
    p, best = np.empty(3), np.inf
    left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
    f_left = f_right = np.inf
    share = left
    for step in range(30):
        hermite(path, velocity, dt, share, p)
        for i in range(3):
            p[i] -= drift[i] * (share * dt)
        d = distance_to(p, center, R, semi_axes, work)
        best = min(best, d)
        if step == 0:
            f_left, share = d, right
            continue
        if share == right:
            f_right = d
        else:
            f_left = d
        if f_left <= f_right:
            high, right, f_right = right, left, f_left
            left = high - _GOLDEN * (high - low)
            share = left
        else:
            low, left, f_left = left, right, f_right
            right = low + _GOLDEN * (high - low)
            share = right
    return best


@numba.njit(cache=True, error_model="numpy", parallel=True)
def judge_motions(
    path: FloatArray,
    velocity: FloatArray,
    duration: FloatArray,
    center: FloatArray,
    R: FloatArray,
    semi_axes: FloatArray,
    drift: FloatArray,
    substeps: int,
    out: FloatArray,
) -> None:
    """Rows of out: least signed distance to any obstacle (inf: none), path length.

    The motion is sampled at `substeps` instants an interval. The distance changes by no
    more than the obstacle and the point move against each other, so from a sample at
    the distance d every sample is passed over until they have moved by d - best. The
    neighbourhood of the nearest sample is searched to the end.

    Args:
        path, velocity, duration: as in Motions.
        center, R, semi_axes, drift: as in Scenes, drift being the obstacles' velocity.
        substeps: samples an interval.
        out: (N, 2), written.
    """
    for n in numba.prange(out.shape[0]):
        intervals = path.shape[1] - 1
        count = intervals * substeps + 1
        dt = duration[n] / intervals
        points, p, work = np.empty((count, 3)), np.empty(3), np.empty((3, 3))
        length = 0.0
        for k in range(count):
            hermite(path[n], velocity[n], dt, k / substeps, points[k])
            if k > 0:
                length += math.sqrt(
                    (points[k, 0] - points[k - 1, 0]) ** 2
                    + (points[k, 1] - points[k - 1, 1]) ** 2
                    + (points[k, 2] - points[k - 1, 2]) ** 2
                )
        best, best_k, best_m = np.inf, 0, -1
        fine = dt / substeps
        for m in range(center.shape[1]):
            if math.isnan(center[n, m, 0]):
                continue
            c, A, a, v = center[n, m], R[n, m], semi_axes[n, m], drift[n, m]
            for coarse in range(0, count + _COARSE - 1, _COARSE):
                k = min(coarse, count - 1)
                for i in range(3):
                    p[i] = points[k, i] - v[i] * (k * fine)
                d = distance_to(p, c, A, a, work)
                if d < best:
                    best, best_k, best_m = d, k, m
            k = 0
            while k < count:
                for i in range(3):
                    p[i] = points[k, i] - v[i] * (k * fine)
                d = distance_to(p, c, A, a, work)
                if d < best:
                    best, best_k, best_m = d, k, m
                spare = d - best
                moved = 0.0
                while True:
                    k += 1
                    if k >= count:
                        break
                    moved += math.sqrt(
                        (points[k, 0] - points[k - 1, 0] - v[0] * fine) ** 2
                        + (points[k, 1] - points[k - 1, 1] - v[1] * fine) ** 2
                        + (points[k, 2] - points[k - 1, 2] - v[2] * fine) ** 2
                    )
                    if moved >= spare:
                        break
        if best_m >= 0:
            best = min(
                best,
                _refined(
                    path[n],
                    velocity[n],
                    dt,
                    center[n, best_m],
                    R[n, best_m],
                    semi_axes[n, best_m],
                    drift[n, best_m],
                    max(best_k - 1, 0) / substeps,
                    min(best_k + 1, count - 1) / substeps,
                    work,
                ),
            )
        out[n, 0] = best
        out[n, 1] = length
