"""Compiled loops behind `drake_oa.geometry.ellipsoid`; call those functions instead.

Every kernel takes writable C-contiguous float64 arrays, so that numba compiles
each of them once, and caches it on disk.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.compiled import compiled, leaf
from drake_oa.common.messages import FloatArray

_THIN = 1e-9
"""Minimum coordinate of a point off an ellipsoid's plane of symmetry, by its semi-axis."""


@leaf
def to_ellipsoid(x: float, y: float, z: float, e: FloatArray) -> tuple[float, float, float, float]:
    """Signed distance to an ellipsoid and its gradient.

    The nearest point is e_i^2 y_i / (s + e_i^2), s the largest root of the secular equation
    sum_i (e_i y_i / (s + e_i^2))^2 = 1 (Eberly 2013): Newton's method on the inverse square
    root of the sum, which is concave, climbs to it from below.
    """
    a2, b2, c2 = e[0] * e[0], e[1] * e[1], e[2] * e[2]
    # Off the planes of symmetry, so that the root is the one of the sum.
    u = e[0] * max(abs(x), _THIN * e[0])
    v = e[1] * max(abs(y), _THIN * e[1])
    w = e[2] * max(abs(z), _THIN * e[2])
    s = max(u - a2, v - b2, w - c2)
    for _ in range(100):
        p, q, r = u / (s + a2), v / (s + b2), w / (s + c2)
        total = p * p + q * q + r * r
        slope = p * p / (s + a2) + q * q / (s + b2) + r * r / (s + c2)
        step = total * (math.sqrt(total) - 1.0) / slope
        s += max(step, 0.0)
        if not step > 1e-15 * (abs(s) + a2):
            break
    p, q, r = e[0] * u / (s + a2), e[1] * v / (s + b2), e[2] * w / (s + c2)
    gx = math.copysign(p / a2, x)
    gy = math.copysign(q / b2, y)
    gz = math.copysign(r / c2, z)
    size = 1.0 / math.sqrt(gx * gx + gy * gy + gz * gz)
    p, q, r = p - abs(x), q - abs(y), r - abs(z)
    d = math.copysign(math.sqrt(p * p + q * q + r * r), s)
    return d, gx * size, gy * size, gz * size


@compiled
def signed_distances(y: FloatArray, e: FloatArray, distance: FloatArray) -> None:
    """Writes the signed distances (N,) of points y to ellipsoids of semi-axes e, both (N, 3)."""
    for n in range(len(distance)):
        distance[n] = to_ellipsoid(y[n, 0], y[n, 1], y[n, 2], (e[n, 0], e[n, 1], e[n, 2]))[0]


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
    # E is at -reach c, reach s in them; a tie goes to the side of omega.
    away, x, y, _ = to_ellipsoid(abs(reach * c), abs(reach * s), 0.0, (a, b, a))
    depth = clearance - away
    g0 = math.copysign(x, -c if reach * c != 0.0 else s)
    g1 = math.copysign(y, s if reach * s != 0.0 else c)
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
