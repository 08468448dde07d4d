"""Compiled loops behind `drake_oa.geometry.ellipsoid`; call those functions instead.

Every kernel takes writable C-contiguous float64 arrays, so that numba compiles
each of them once, and caches it on disk.
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
from numba.extending import register_jitable

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray

Metres = TypeVar("Metres", float, FloatArray)

_TINY = 1e-150
"""Ratios below this are zero: their squares would not be normal numbers."""


@register_jitable
def feasible_clearance(asked: Metres, start: Metres, goal: Metres) -> Metres:
    """min(asked, start, goal): nobody keeps more than start and goal themselves have.

    As it is in Python, and compiled into the kernels that call it.

    Args:
        asked: asked clearance Delta [m].
        start, goal: signed distance of the start and of the goal to the obstacle [m]; each
            where the obstacle is as the motion starts and ends.
    """
    return np.minimum(asked, np.minimum(start, goal))


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
def signed_distances(
    p: FloatArray,
    center: FloatArray,
    R: FloatArray,
    semi_axes: FloatArray,
    work: FloatArray,
    distance: FloatArray,
) -> bool:
    """Computes distances row by row; inputs of one row serve every row.

    Returns False where a semi-axis is not positive.
    """
    y = work[0]
    for n in range(distance.shape[0]):
        a = semi_axes[n if semi_axes.shape[0] > 1 else 0]
        A = R[n if R.shape[0] > 1 else 0]
        c = center[n if center.shape[0] > 1 else 0]
        q = p[n if p.shape[0] > 1 else 0]
        if not (a[0] > 0.0 and a[1] > 0.0 and a[2] > 0.0):
            return False
        for i in range(3):
            y[i] = abs(A[0, i] * (q[0] - c[0]) + A[1, i] * (q[1] - c[1]) + A[2, i] * (q[2] - c[2]))
        distance[n] = nearest_point(y, a, work[1], work[2])
    return True


@compiled
def _exchange(
    x: FloatArray, j: int, beta: float, H: FloatArray, u: FloatArray, g: FloatArray
) -> None:
    """Moves the weight beta (negative: away) to row j; H is the inverse moment matrix."""
    w = np.empty(4)
    for a in range(4):
        w[a] = H[a, 0] * x[j, 0] + H[a, 1] * x[j, 1] + H[a, 2] * x[j, 2] + H[a, 3]
    keep = 1.0 / (1.0 - beta)
    f = beta / (1.0 - beta + beta * g[j])
    for i in range(x.shape[0]):
        t = w[0] * x[i, 0] + w[1] * x[i, 1] + w[2] * x[i, 2] + w[3]
        g[i] = keep * (g[i] - f * t * t)
        u[i] *= 1.0 - beta
    u[j] += beta
    for a in range(4):
        for b in range(4):
            H[a, b] = keep * (H[a, b] - f * w[a] * w[b])


@compiled
def optimal_weights(
    points: FloatArray, rank: int, tolerance: float, max_steps: int, u: FloatArray
) -> int:
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

    Returns:
        Steps taken.
    """
    count = points.shape[0]
    n = rank + 1.0
    g = np.empty(count)
    H = np.zeros((4, 4))
    for i in range(4):
        H[i, i] = 1.0
    for i in range(count):
        u[i] = 1.0 / count
        g[i] = points[i, 0] ** 2 + points[i, 1] ** 2 + points[i, 2] ** 2 + 1.0
    for step in range(max_steps):
        far, near = 0, -1
        for i in range(count):
            if g[i] > g[far]:
                far = i
            if u[i] > 0.0 and (near < 0 or g[i] < g[near]):
                near = i
        over, under = g[far] / n - 1.0, 1.0 - g[near] / n
        if over <= tolerance and under <= tolerance:
            return step
        j = far if over >= under else near
        beta = (g[j] - n) / (n * (g[j] - 1.0)) if g[j] > 1.0 else -1.0
        least = -u[j] / (1.0 - u[j])
        _exchange(points, j, max(beta, least), H, u, g)
        if beta <= least:
            u[j] = 0.0
    return max_steps


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
def plane_sections(
    R: FloatArray,
    semi_axes: FloatArray,
    e1: FloatArray,
    e2: FloatArray,
    out: FloatArray,
) -> int:
    """Sections through the center; rows of out: semi-axes 2, axes 6.

    Returns:
        0, or 1 for a semi-axis that is not positive, 2 for a basis that is not
        orthonormal.
    """
    for m in range(out.shape[0]):
        A = R[m if R.shape[0] > 1 else 0]
        a = semi_axes[m if semi_axes.shape[0] > 1 else 0]
        u = e1[m if e1.shape[0] > 1 else 0]
        v = e2[m if e2.shape[0] > 1 else 0]
        if not (a[0] > 0.0 and a[1] > 0.0 and a[2] > 0.0):
            return 1
        uu = u[0] * u[0] + u[1] * u[1] + u[2] * u[2] - 1.0
        vv = v[0] * v[0] + v[1] * v[1] + v[2] * v[2] - 1.0
        uv = u[0] * v[0] + u[1] * v[1] + u[2] * v[2]
        if not (abs(uu) < 1e-6 and abs(vv) < 1e-6 and abs(uv) < 1e-6):
            return 2
        s11, s12, s22 = 0.0, 0.0, 0.0
        for i in range(3):
            f1 = (A[0, i] * u[0] + A[1, i] * u[1] + A[2, i] * u[2]) / a[i]
            f2 = (A[0, i] * v[0] + A[1, i] * v[1] + A[2, i] * v[2]) / a[i]
            s11 += f1 * f1
            s12 += f1 * f2
            s22 += f2 * f2
        mean, half = 0.5 * (s11 + s22), 0.5 * (s11 - s22)
        big = mean + math.sqrt(half * half + s12 * s12)
        # The product of the eigenvalues keeps the small one exact for flat sections.
        small = (s11 * s22 - s12 * s12) / big
        side = 1.0 if half >= 0.0 else -1.0
        angle = 0.5 * math.atan2(side * s12, abs(half))
        first, second = (big, small) if half >= 0.0 else (small, big)
        out[m, 0] = 1.0 / math.sqrt(first)
        out[m, 1] = 1.0 / math.sqrt(second)
        for i in range(3):
            out[m, 2 + i] = math.cos(angle) * u[i] + math.sin(angle) * v[i]
            out[m, 5 + i] = math.cos(angle) * v[i] - math.sin(angle) * u[i]
    return 0


@compiled
def _perpendicular(a: FloatArray, out: FloatArray) -> None:
    """Writes a unit vector perpendicular to the unit vector a."""
    k = 0
    for i in range(1, 3):
        if abs(a[i]) < abs(a[k]):
            k = i
    size = math.sqrt(1.0 - a[k] * a[k])
    for i in range(3):
        out[i] = ((1.0 if i == k else 0.0) - a[k] * a[i]) / size


@compiled
def passing_plane(
    to_center: FloatArray, omega: FloatArray, e1: FloatArray, e2: FloatArray
) -> float:
    """Writes e1 along to_center and e2 on the side of omega; returns the distance."""
    reach = math.sqrt(to_center[0] ** 2 + to_center[1] ** 2 + to_center[2] ** 2)
    size = math.sqrt(omega[0] ** 2 + omega[1] ** 2 + omega[2] ** 2)
    if reach > 0.0:
        for i in range(3):
            e1[i] = to_center[i] / reach
    elif size > 0.0:
        for i in range(3):
            e2[i] = omega[i] / size
        _perpendicular(e2, e1)
    else:
        e1[0], e1[1], e1[2] = 1.0, 0.0, 0.0
    for i in range(3):
        e2[i] = omega[i]
    # Twice: the first pass leaves round-off along e1 when omega is nearly parallel.
    for _ in range(2):
        along = e1[0] * e2[0] + e1[1] * e2[1] + e1[2] * e2[2]
        for i in range(3):
            e2[i] -= along * e1[i]
        left = math.sqrt(e2[0] ** 2 + e2[1] ** 2 + e2[2] ** 2)
        if not left > 1e-9 * size:
            _perpendicular(e1, e2)
            break
        for i in range(3):
            e2[i] /= left
        size = 1.0
    return reach


@compiled
def _supporting_angle(
    reach: float, b11: float, b12: float, b22: float, delta: float, high: float
) -> float:
    """Smallest angle in (0, high] at which the line through p supports the body.

    The root of f(phi) = reach sin(phi) - h(phi) - delta for the normal
    n = -sin(phi) e1 + cos(phi) e2; f < 0 at 0 and f >= 0 at `high`.
    """
    low = 0.0
    start = (math.sqrt(b22) + delta) / reach
    phi = math.asin(start) if start < 1.0 else 0.5 * high
    if not phi < high:
        phi = 0.5 * high
    for _ in range(80):
        s, c = math.sin(phi), math.cos(phi)
        h = math.sqrt(max(b11 * s * s - 2.0 * b12 * s * c + b22 * c * c, 0.0))
        f = reach * s - h - delta
        if abs(f) <= 1e-14 * reach:
            return phi
        if f < 0.0:
            low = phi
        else:
            high = phi
        slope = reach * c
        if h > 0.0:
            slope -= ((b11 - b22) * s * c - b12 * (c * c - s * s)) / h
        phi = phi - f / slope if slope > 0.0 else high
        if not low < phi < high:
            phi = 0.5 * (low + high)
            if not low < phi < high:
                break
    return high


@compiled
def tangent_headings(
    p: FloatArray,
    center: FloatArray,
    B: FloatArray,
    direction: FloatArray,
    clearance: FloatArray,
    work: FloatArray,
    heading: FloatArray,
    inside: FloatArray,
    normal: FloatArray,
) -> None:
    """Headings from p past M ellipsoids, at a clearance, on a chosen side.

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
        center: (M, 3) centres p_WO [m].
        B: (M, 3, 3) shape matrices [m^2], see `ellipsoid.shape_matrix`.
        direction: (M, 3) chosen sides omega in W. Parallel to e1 or zero: any side.
        clearance: (1,) or (M,) clearances Delta >= 0 [m].
        work: (7, 3) scratch.
        heading: (M, 3) written: unit headings in W.
        inside: (M,) written: 1 where p is within the grown shadow, else 0.
        normal: (M, 3) written: unit normals n in W.
    """
    e1, e2, to_center = work[0], work[1], work[2]
    axes, y, w, x = work[3], work[4], work[5], work[6]
    for m in range(heading.shape[0]):
        delta = clearance[m if clearance.shape[0] > 1 else 0]
        for i in range(3):
            to_center[i] = center[m, i] - p[i]
        reach = passing_plane(to_center, direction[m], e1, e2)
        b11, b12, b22 = 0.0, 0.0, 0.0
        for i in range(3):
            for j in range(3):
                b11 += e1[i] * B[m, i, j] * e1[j]
                b12 += e1[i] * B[m, i, j] * e2[j]
                b22 += e2[i] * B[m, i, j] * e2[j]
        # The shadow's ellipse: principal axes a, b at the angle psi from e1, e2.
        big = 0.5 * (b11 + b22) + math.sqrt(0.25 * (b11 - b22) ** 2 + b12 * b12)
        psi = 0.5 * math.atan2(2.0 * b12, b11 - b22)
        c, s = math.cos(psi), math.sin(psi)
        axes[0] = axes[2] = math.sqrt(big)
        axes[1] = math.sqrt(max((b11 * b22 - b12 * b12) / big, 0.0))
        y[0], y[1], y[2] = abs(reach * c), abs(reach * s), 0.0
        depth = delta - nearest_point(y, axes, w, x)
        # E is at -reach c, reach s in them; a tie goes to the side of omega.
        side0 = -c if reach * c != 0.0 else s
        side1 = s if reach * s != 0.0 else c
        g0 = math.copysign(x[0] / axes[0] ** 2, side0)
        g1 = math.copysign(x[1] / axes[1] ** 2, side1)
        phi = math.atan2(-(c * g0 - s * g1), s * g0 + c * g1)
        outward = 0.0
        if depth > 0.0:
            outward = min(depth / delta, 1.0) if delta > 0.0 else 1.0
        else:
            phi = _supporting_angle(reach, b11, b12, b22, delta, phi)
        inside[m] = 1.0 if depth > 0.0 else 0.0
        s, c = math.sin(phi), math.cos(phi)
        size = math.sqrt(1.0 + outward * outward)
        for i in range(3):
            normal[m, i] = c * e2[i] - s * e1[i]
            heading[m, i] = (c * e1[i] + s * e2[i] + outward * normal[m, i]) / size


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
