"""The desired heading v_d of the guidance term (eq. 9).

The paper leaves open which heading leads the motion along a chosen direction
omega_d, and for how long. Here v_d is the heading along the line through E that
supports the obstacle at the asked clearance on the chosen side: the shortest way
past it. It is asked for only while the avoidance term would lead past another side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid_kernels import tangent_heading
from drake_oa.policy.coupling import HEADING, NORMAL, Triple


class Obstacles(NamedTuple):
    """M obstacles as the policy goes by them, a row each.

    Attributes:
        p_WO, R_WO, semi_axes: the ellipsoids: (M, 3) [m], (M, 3, 3), (M, 3) [m].
        B: (M, 3, 3) their shape matrices [m^2].
        terms: (M, 13) their coupling terms, see `coupling.turn_step`, not faded and without
            guidance alpha: the normal is that of the plane in which one is passed, zero where none
            is known; the heading is a given one, zero where there is none.
        direction: (M, 3) unit directions omega_d of the route.
        remaining_clearance: (M,) distances that the route keeps [m]; 0: it does not guide.
    """

    p_WO: FloatArray
    R_WO: FloatArray
    semi_axes: FloatArray
    B: FloatArray
    terms: FloatArray
    direction: FloatArray
    remaining_clearance: FloatArray


@compiled
def guide(
    p: Triple,
    z: Triple,
    p_WG: FloatArray,
    R_WL: FloatArray,
    obstacles: Obstacles,
    terms: FloatArray,
) -> None:
    """Sets the headings of the terms (M, 13) of a step, see
    `drake_oa.policy.action.desired_headings`.

    Args:
        p, z: position p_WE and scaled velocity z_W [m].
        p_WG, R_WL: the goal (3,) [m] and the local frame (3, 3).
        obstacles: the obstacles, and the headings that terms without guidance have.
        terms: (M, 13) the terms. At rest the heading u is the baseline: the motion is about to
            set out along it.
    """
    u, p_WE = np.empty(3), np.array(p)
    speed = math.sqrt(z[0] ** 2 + z[1] ** 2 + z[2] ** 2)
    distance_G = 0.0
    for k in range(3):
        u[k] = z[k] / speed if speed > 0.0 else R_WL[k, 0]
        distance_G += (p_WG[k] - p[k]) ** 2
    distance_G = math.sqrt(distance_G)
    tangent = np.empty(3)
    for row in range(len(obstacles.p_WO)):
        clearance = obstacles.remaining_clearance[row]
        if not clearance > 0.0:
            continue
        share = _wrong_side(p_WE, u, obstacles.p_WO[row], terms[row, NORMAL:])
        if share == 0.0:
            continue
        entry = _ray_entry(
            p_WE, u, obstacles.p_WO[row], obstacles.R_WO[row], obstacles.semi_axes[row], clearance
        )
        if not entry < distance_G:
            continue
        tangent_heading(
            p_WE,
            obstacles.p_WO[row],
            obstacles.B[row],
            obstacles.direction[row],
            clearance,
            tangent,
        )
        size = 0.0
        for k in range(3):
            tangent[k] = u[k] + share * (tangent[k] - u[k])
            size += tangent[k] ** 2
        size = math.sqrt(size)
        if size > 0.0:
            for k in range(3):
                terms[row, HEADING + k] = tangent[k] / size


@compiled
def _wrong_side(p_WE: FloatArray, u: FloatArray, center: FloatArray, normal: FloatArray) -> float:
    """How far the guidance has gone over from u to the supporting heading, 0 to 1."""
    e0, e1, e2 = center[0] - p_WE[0], center[1] - p_WE[1], center[2] - p_WE[2]
    x, y, z = e1 * u[2] - e2 * u[1], e2 * u[0] - e0 * u[2], e0 * u[1] - e1 * u[0]
    size = math.sqrt(x * x + y * y + z * z)
    # Straight at the centre: the turn about the normal goes to the chosen side by itself.
    if size <= 1e-9 * math.sqrt(e0 * e0 + e1 * e1 + e2 * e2):
        return 0.0
    lean = -(x * normal[0] + y * normal[1] + z * normal[2])
    return min(2.0 * lean / size, 1.0) if lean > 1e-9 * size else 0.0


@compiled
def _ray_entry(
    p_WE: FloatArray,
    u: FloatArray,
    center: FloatArray,
    R: FloatArray,
    semi_axes: FloatArray,
    clearance: float,
) -> float:
    """How far along u the ray from E meets a grown ellipsoid; inf where it misses it."""
    a, b, c = 0.0, 0.0, -1.0
    for axis in range(3):
        p, w = 0.0, 0.0
        for k in range(3):
            p += R[k, axis] * (p_WE[k] - center[k])
            w += R[k, axis] * u[k]
        length = semi_axes[axis] + clearance
        p, w = p / length, w / length
        a += w * w
        b += p * w
        c += p * p
    discriminant = b * b - a * c
    if discriminant <= 0.0 or b >= 0.0:
        return np.inf
    return max((-b - math.sqrt(discriminant)) / a, 0.0)
