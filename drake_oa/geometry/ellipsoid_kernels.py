"""Compiled loops of `drake_oa.geometry.ellipsoid`, which fits ellipsoids to obstacles; other
modules call the functions there.

Every kernel takes writable C-contiguous float64 arrays, so that numba compiles each of them once,
and caches it on disk.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.compiled import compiled, leaf
from drake_oa.common.messages import FloatArray

_THIN = 1e-9
"""Minimum absolute coordinate of a point, relative to the semi-axis, for which its distance to an
ellipsoid is computed; smaller ones are replaced by it [-]."""


@leaf
def to_ellipsoid(x: float, y: float, z: float, e: FloatArray) -> float:
    """Computes the signed distance [m] from a point (x, y, z) to an ellipsoid with semi-axes e [m],
    in the frame of the ellipsoid.

    The distance is negative inside. With y_i the absolute coordinates of the point, the nearest
    point of the surface has the absolute coordinates e_i^2 y_i / (s + e_i^2). s is the largest root
    of the secular equation sum_i (e_i y_i / (s + e_i^2))^2 = 1 (Eberly 2013). Newton's method on
    the inverse square root of the sum, which is concave, converges to s from below.
    """
    a2, b2, c2 = e[0] * e[0], e[1] * e[1], e[2] * e[2]
    # On a plane of symmetry a term of the sum, and with it the largest root, would vanish.
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
    p, q, r = p - abs(x), q - abs(y), r - abs(z)
    return math.copysign(math.sqrt(p * p + q * q + r * r), s)


@compiled
def signed_distances(y: FloatArray, e: FloatArray, distance: FloatArray) -> None:
    """Computes the signed distances from N points to N ellipsoids, each point in the frame of its
    ellipsoid.

    Args:
        y: (N, 3) points [m].
        e: (N, 3) semi-axes [m].
        distance: (N,) distances, negative inside [m]; output.
    """
    for n in range(len(distance)):
        distance[n] = to_ellipsoid(y[n, 0], y[n, 1], y[n, 2], (e[n, 0], e[n, 1], e[n, 2]))


@compiled
def optimal_weights(
    points: FloatArray, rank: int, tolerance: float, max_steps: int, u: FloatArray
) -> None:
    """Computes the weights of points that determine their enclosing ellipsoid of least volume:
    D-optimal weights.

    The points have mean 0 and covariance I (Todd and Yildirim 2007). Each step of coordinate ascent
    changes the weight of one point, the one that violates optimality most:

        g_i = q_i^T (sum_k u_k q_k q_k^T)^-1 q_i   with q_i = (x_i, 1).

    The weight of the point with the largest g_i increases, or that of the point with the least g_i
    among the points with a weight above 0 decreases.

    Args:
        points: (N, 3) normalized points x_i [-], zero in the last 3 - rank coordinates.
        rank: dimension of the space that the points span.
        tolerance: relative tolerance of optimality: g_i <= (1 + tolerance) n for all points and g_i
            >= (1 - tolerance) n for those with a weight above 0, n = rank + 1.
        max_steps: maximum number of steps.
        u: (N,) weights u_k with the sum 1 [-]; output.
    """
    count = points.shape[0]
    n = rank + 1.0
    g, w = np.empty(count), np.empty(4)
    # Inverse of the moment matrix sum_k u_k q_k q_k^T.
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
        # Row j receives the weight beta; negative: it loses weight.
        for a in range(4):
            w[a] = H[a, 0] * points[j, 0] + H[a, 1] * points[j, 1] + H[a, 2] * points[j, 2]
            w[a] += H[a, 3]
        scale = 1.0 / (1.0 - beta)
        f = beta / (1.0 - beta + beta * g[j])
        for i in range(count):
            t = w[0] * points[i, 0] + w[1] * points[i, 1] + w[2] * points[i, 2] + w[3]
            g[i] = scale * (g[i] - f * t * t)
            u[i] *= 1.0 - beta
        u[j] = u[j] + beta if beta > least else 0.0
        for a in range(4):
            for b in range(4):
                H[a, b] = scale * (H[a, b] - f * w[a] * w[b])
