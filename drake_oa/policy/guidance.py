"""The desired heading v_d of the guidance term (eq. 9).

The paper leaves open which heading leads the motion along a chosen direction
omega_d, and for how long. Here v_d is the heading along the line through E that
supports the obstacle at the requested clearance on the chosen side: the shortest way
past it. Guidance acts only while the motion is on its way into the obstacle's clearance and the
avoidance term would turn it to another side than the chosen one: with e the way to the center and
u the heading, the P-plane's normal e x u then leans away from the normal of the passing plane.
v_d goes over from u to the supporting heading as it leans by up to 30 degrees below the right
angle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import (
    HEADING,
    N_COLUMNS,
    NORMAL,
    Triple,
    cross,
    dot,
    mixed,
    norm,
    orthogonal,
    scaled,
    triple,
)


class Obstacles(NamedTuple):
    """M obstacles with their coupling terms, a row each.

    Attributes:
        p_WO, R_WO, semi_axes: the ellipsoids: (M, 3) [m], (M, 3, 3), (M, 3) [m].
        terms: (M, 12) their coupling terms, see `coupling.turn_step`, not faded and without
            headings: the normal is that of the plane in which one is passed, zero where none
            is known.
        direction: (M, 3) unit directions omega_d of the route.
        remaining_clearance: (M,) distances that the route keeps [m]; 0: it does not guide.
    """

    p_WO: FloatArray
    R_WO: FloatArray
    semi_axes: FloatArray
    terms: FloatArray
    direction: FloatArray
    remaining_clearance: FloatArray


NO_OBSTACLES = Obstacles(
    *(np.zeros(shape) for shape in ((0, 3), (0, 3, 3), (0, 3), (0, N_COLUMNS), (0, 3), (0,)))
)
"""Obstacles of which there are none."""


@compiled
def guide(
    p: Triple, z: Triple, p_WG: Triple, ahead: Triple, obstacles: Obstacles, terms: FloatArray
) -> None:
    """Sets the headings of the terms (M, 12) of a step; zero where guidance does not act.

    Args:
        p, z: position p_WE and scaled velocity z_W [m].
        p_WG: the goal [m].
        ahead: vector from start to goal. At rest the heading u is along it: the motion is about to
            set out along it.
        obstacles: the obstacles.
        terms: (M, 12) their terms.
    """
    along = z if norm(z) > 0.0 else ahead
    u = scaled(1.0 / norm(along), along)
    distance_G = norm(mixed(1.0, p_WG, -1.0, p))
    for row in range(len(obstacles.p_WO)):
        clearance, heading = obstacles.remaining_clearance[row], (0.0, 0.0, 0.0)
        o = mixed(1.0, triple(obstacles.p_WO, row), -1.0, p)
        reach, across = norm(o), cross(o, u)
        lean, size = -dot(across, triple(terms, row, NORMAL)), norm(across)
        # Straight at the center the turn about the normal goes to the chosen side by itself.
        if clearance > 0.0 and size > 1e-9 * reach and lean > 1e-9 * size:
            e1 = scaled(1.0 / reach, o)
            e2 = orthogonal(triple(obstacles.direction, row), e1)
            # Coefficients of the ray along u into the grown ellipsoid, and of the shadow of the
            # ellipsoid in the plane of e1 and e2.
            a, b, c, b11, b12, b22, mean = 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0
            for i in range(3):
                R, length = obstacles.R_WO[row], obstacles.semi_axes[row, i]
                axis = R[0, i], R[1, i], R[2, i]
                ahead_i, o_i = dot(axis, u), dot(axis, o)
                grown = (length + clearance) ** 2
                a, b, c = a + ahead_i**2 / grown, b + ahead_i * o_i / grown, c + o_i**2 / grown
                x, y = length * dot(axis, e1), length * dot(axis, e2)
                b11, b12, b22 = b11 + x * x, b12 + x * y, b22 + y * y
                mean += length**2 / 3.0
            enters = b > 0.0 and b * b > a * c
            if enters and b - math.sqrt(b * b - a * c) < a * distance_G:
                # An ellipsoid that holds the shadow grown by the clearance.
                k = clearance / math.sqrt(mean)
                b11, b12, b22 = (1.0 + k) * b11, (1.0 + k) * b12, (1.0 + k) * b22
                more = (1.0 + 1.0 / k) * clearance**2
                root = b12**2 + (reach**2 - b11 - more) * (b22 + more)
                # Inside of it the heading leans outward.
                signed = math.copysign(math.sqrt(abs(root)), root)
                angle = math.atan2(b22 + more, b12 + signed)
                tangent = mixed(math.cos(angle), e1, math.sin(angle), e2)
                share = min(2.0 * lean / size, 1.0)
                heading = mixed(1.0 - share, u, share, tangent)
                heading = scaled(1.0 / max(norm(heading), 1e-300), heading)
        for i in range(3):
            terms[row, HEADING + i] = heading[i]
