"""Compiled loops behind `drake_oa.geometry.ellipsoid`; call those functions instead.

Every kernel takes writable C-contiguous float64 arrays, so that numba compiles
each of them once, and caches it on disk.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray

_TINY = 1e-150
"""Ratios below this are zero: their squares would not be normal numbers."""


@compiled
def nearest_point(y: FloatArray, e: FloatArray, w: FloatArray, x: FloatArray) -> float:
    """Point x nearest to y >= 0 on the ellipsoid of semi-axes e, in its own axes.

    With k the smallest axis, r_i = (e_i / e_k)^2 and w_i = r_i y_i / e_i, the nearest
    point is x_i = e_i w_i / (s + r_i - 1), where s >= 0 is the largest root of the
    secular equation sum_i (w_i / (s + r_i - 1))^2 = 1. Newton's method on the inverse
    square root of that sum, which is concave, climbs to the root from below.

    Args:
        y: (3,) non-negative coordinates.
        e: (3,) positive semi-axes.
        w: (3,) scratch.
        x: (3,) the nearest point, written.

    Returns:
        The signed distance, negative inside.
    """
    k = 0
    for i in range(1, 3):
        if e[i] < e[k]:
            k = i
    # In place of r_i - 1, which would cancel for nearly equal axes.
    scale = 1.0 / (e[k] * e[k])
    gap = (
        (e[0] - e[k]) * (e[0] + e[k]) * scale,
        (e[1] - e[k]) * (e[1] + e[k]) * scale,
        (e[2] - e[k]) * (e[2] + e[k]) * scale,
    )
    radius2, on_plane, low = 0.0, 0.0, 0.0
    for i in range(3):
        z = y[i] / e[i]
        radius2 += z * z
        w[i] = e[i] * e[i] * scale * z if z > _TINY else 0.0
        if w[i] > 0.0:
            on_plane += (w[i] / (gap[i])) ** 2
            low = max(low, w[i] - gap[i])
    s = low
    if w[k] > 0.0 or on_plane >= 1.0:
        for _ in range(100):
            total, slope = 0.0, 0.0
            for i in range(3):
                if w[i] > 0.0:
                    depth = s + gap[i]
                    term = (w[i] / depth) ** 2
                    total += term
                    slope += term / depth
            step = total * (math.sqrt(total) - 1.0) / slope
            s += max(step, 0.0)
            if not step > 2e-16 * s:
                break
    else:
        s = 0.0
    distance2, rest = 0.0, 1.0
    for i in range(3):
        share = w[i] / (s + gap[i]) if w[i] > 0.0 else 0.0
        x[i] = e[i] * share
        rest -= share * share
    if s == 0.0:
        x[k] = e[k] * math.sqrt(max(rest, 0.0))
    for i in range(3):
        distance2 += (y[i] - x[i]) ** 2
    distance = math.sqrt(distance2)
    return -distance if radius2 < 1.0 else distance


@compiled
def signed_distances(y: FloatArray, e: FloatArray, distance: FloatArray) -> None:
    """Writes the signed distances (N,) of points y >= 0 to ellipsoids of semi-axes e, (N, 3)."""
    w, x = np.empty(3), np.empty(3)
    for n in range(len(distance)):
        distance[n] = nearest_point(y[n], e[n], w, x)


@compiled
def optimal_weights(
    points: FloatArray, rank: int, tolerance: float, max_steps: int, u: FloatArray
) -> None:
    """Todd and Yildirim's D-optimal weights of points with mean 0 and covariance I.

    Coordinate ascent on the weight of one point a step: toward the point of
    largest g_i = q_i^T (sum_k u_k q_k q_k^T)^-1 q_i, q_i = (x_i, 1), or away from the
    one of least g_i that has weight, whichever breaks optimality more.

    Args:
        points: (N, 3), zero in the last 3 - rank coordinates.
        rank: dimension that the points span.
        tolerance: stop when g_i <= (1 + tolerance) n for all and g_i >= (1 - tolerance) n
            for those with weight, n = rank + 1.
        max_steps: steps at most.
        u: (N,) weights, written.
    """
    count = points.shape[0]
    n = rank + 1.0
    g, w = np.empty(count), np.empty(4)
    # Inverse of the moment matrix.
    H = np.eye(4)
    for i in range(count):
        u[i] = 1.0 / count
        g[i] = points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2 + 1.0
    for _ in range(max_steps):
        far, near = 0, -1
        for i in range(count):
            if g[i] > g[far]:
                far = i
            if u[i] > 0.0 and (near < 0 or g[i] < g[near]):
                near = i
        over, under = g[far] / n - 1.0, 1.0 - g[near] / n
        if over <= tolerance and under <= tolerance:
            return
        j = far if over >= under else near
        least = -u[j] / (1.0 - u[j])
        beta = max((g[j] - n) / (n * (g[j] - 1.0)) if g[j] > 1.0 else -1.0, least)
        # The weight beta (negative: away) moves to row j.
        for a in range(4):
            w[a] = H[a, 0] * points[j, 0] + H[a, 1] * points[j, 1] + H[a, 2] * points[j, 2]
            w[a] += H[a, 3]
        keep = 1.0 / (1.0 - beta)
        f = beta / (1.0 - beta + beta * g[j])
        for i in range(count):
            t = w[0] * points[i, 0] + w[1] * points[i, 1] + w[2] * points[i, 2] + w[3]
            g[i] = keep * (g[i] - f * t * t)
            u[i] *= 1.0 - beta
        u[j] = u[j] + beta if beta > least else 0.0
        for a in range(4):
            for b in range(4):
                H[a, b] = keep * (H[a, b] - f * w[a] * w[b])


@compiled
def farthest_pair(y: FloatArray, s: FloatArray) -> tuple[float, int, int]:
    """Largest |y_i - s_j|^2 over rows of y (N, 3) and s (K, 3), with i and j.

    Rows too short to matter, by the triangle inequality, are passed over.
    """
    count = y.shape[0]
    length = np.empty(count)
    first, reach = 0, 0.0
    for i in range(count):
        length[i] = math.sqrt(y[i, 0] ** 2 + y[i, 1] ** 2 + y[i, 2] ** 2)
        if length[i] > length[first]:
            first = i
    for j in range(s.shape[0]):
        reach = max(reach, math.sqrt(s[j, 0] ** 2 + s[j, 1] ** 2 + s[j, 2] ** 2))
    best, at_i, at_j = -1.0, 0, 0
    for n in range(-1, count):
        i = first if n < 0 else n
        # The margin is for rounding: no row may be passed over by a last digit.
        if (length[i] + reach) ** 2 * (1.0 + 1e-12) < best:
            continue
        for j in range(s.shape[0]):
            value = (y[i, 0] - s[j, 0]) ** 2 + (y[i, 1] - s[j, 1]) ** 2 + (y[i, 2] - s[j, 2]) ** 2
            if value > best:
                best, at_i, at_j = value, i, j
    return best, at_i, at_j


@compiled
def tangent_heading(
    p: FloatArray,
    center: FloatArray,
    B: FloatArray,
    direction: FloatArray,
    clearance: float,
    heading: FloatArray,
) -> None:
    """Writes the heading from p past an ellipsoid, at a clearance, on a chosen side.

    In the plane of e1 = unit(p_WO - p) and e2, the part of the direction omega perpendicular to
    e1, the ellipsoid's shadow grown by the clearance Delta has the support function h(n) + Delta,
    h(n)^2 = n^T B n. The line through p that supports it on the side of omega has the normal n
    with n . (p - p_WO) = h(n) + Delta, and the half space beyond it keeps Delta from the ellipsoid
    in all three dimensions. The heading is along that line, past the obstacle.

    Within the grown shadow there is no such line: n is then the direction in the plane of the
    shortest way out, and the heading, perpendicular to it, leans outward by up to 45 degrees in
    proportion to the depth below the clearance.

    Args:
        p: (3,) the point in W [m].
        center: (3,) centre p_WO [m].
        B: (3, 3) shape matrix [m^2], see `ellipsoid.shape_matrix`.
        direction: (3,) chosen side omega in W. Parallel to e1 or zero: any side.
        clearance: clearance Delta >= 0 [m].
        heading: (3,) written: unit heading in W.
    """
    reach = math.sqrt(((center - p) ** 2).sum())
    e1, e2 = np.array([1.0, 0.0, 0.0]), direction.copy()
    if reach > 0.0:
        e1 = (center - p) / reach
    # The first pass leaves round-off along e1 when omega is nearly parallel.
    for _ in range(3):
        size = math.sqrt((e2**2).sum())
        e2 -= (e1 * e2).sum() * e1
        left = math.sqrt((e2**2).sum())
        if left > 1e-9 * size:
            e2 /= left
        else:
            e2[:] = 0.0
            e2[np.argmin(np.abs(e1))] = 1.0
    b11, b12, b22 = 0.0, 0.0, 0.0
    for i in range(3):
        for j in range(3):
            b11 += e1[i] * B[i, j] * e1[j]
            b12 += e1[i] * B[i, j] * e2[j]
            b22 += e2[i] * B[i, j] * e2[j]
    # The shadow's ellipse: principal axes a, b at the angle psi from e1, e2.
    big = 0.5 * (b11 + b22) + math.sqrt(0.25 * (b11 - b22) ** 2 + b12 * b12)
    psi = 0.5 * math.atan2(2.0 * b12, b11 - b22)
    c, s = math.cos(psi), math.sin(psi)
    a, b = math.sqrt(big), math.sqrt(max((b11 * b22 - b12 * b12) / big, 0.0))
    y, w, x = np.array([abs(reach * c), abs(reach * s), 0.0]), np.empty(3), np.empty(3)
    depth = clearance - nearest_point(y, np.array([a, b, a]), w, x)
    # E is at -reach c, reach s in them; a tie goes to the side of omega.
    g0 = math.copysign(x[0] / a**2, -c if reach * c != 0.0 else s)
    g1 = math.copysign(x[1] / b**2, s if reach * s != 0.0 else c)
    phi = math.atan2(-(c * g0 - s * g1), s * g0 + c * g1)
    outward = 0.0
    if depth > 0.0:
        outward = min(depth / clearance, 1.0) if clearance > 0.0 else 1.0
    else:
        # Smallest root of f(phi) = reach sin(phi) - h(phi) - Delta, n = -sin(phi) e1 + cos(phi) e2:
        # f < 0 at 0, and f >= 0 at the normal of the nearest point.
        low, high = 0.0, phi
        start = (math.sqrt(b22) + clearance) / reach
        phi = math.asin(start) if start < 1.0 else high
        for _ in range(80):
            if not low < phi < high:
                phi = 0.5 * (low + high)
                if not low < phi < high:
                    break
            s, c = math.sin(phi), math.cos(phi)
            h = math.sqrt(max(b11 * s * s - 2.0 * b12 * s * c + b22 * c * c, 0.0))
            f = reach * s - h - clearance
            if f < 0.0:
                low = phi
            else:
                high = phi
            if abs(f) <= 1e-14 * reach:
                break
            slope = reach * c
            if h > 0.0:
                slope -= ((b11 - b22) * s * c - b12 * (c * c - s * s)) / h
            phi = phi - f / slope if slope > 0.0 else high
    s, c = math.sin(phi), math.cos(phi)
    for i in range(3):
        normal = c * e2[i] - s * e1[i]
        heading[i] = (c * e1[i] + s * e2[i] + outward * normal) / math.sqrt(1.0 + outward**2)


@compiled
def first_inside(p: FloatArray, center: FloatArray, R: FloatArray, semi_axes: FloatArray) -> int:
    """Row of the first ellipsoid that a point (3,) lies in or on, or -1."""
    for row in range(len(center)):
        gauge = 0.0
        for axis in range(3):
            along = 0.0
            for k in range(3):
                along += R[row, k, axis] * (p[k] - center[row, k])
            gauge += (along / semi_axes[row, axis]) ** 2
        if gauge <= 1.0:
            return row
    return -1
