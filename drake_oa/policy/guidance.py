"""Computation of the guidance heading v_d, which leads the motion past an obstacle.

The guidance term, (9) of Pairet et al., RA-L 2019, is a coupling term that turns the motion toward
v_d, on the selected side of the obstacle. The paper defines neither v_d for a selected passing
direction omega_d of an obstacle, nor when guidance ends. Here v_d is the direction from the tool
point E along the tangent to the obstacle at the requested clearance, on the selected side. This is
the shortest path past the obstacle.

Guidance acts while both conditions hold, with the heading u of the motion and the direction e from
E to the center of the obstacle:

- The ray from E along u enters the obstacle, grown by the clearance, before the goal.
- The avoidance term would turn the motion to another side: -n . (e x u) is positive, with the unit
  normal n of the plane in which the obstacle is to be passed. The avoidance term rotates about
  e x u, a passage on the selected side about n.

v_d blends linearly from u to the tangent as the ratio -n . (e x u) / |e x u|, the sine of an angle,
rises from 0 to 0.5 (30 degrees).
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
    """Ellipsoids of M obstacles and their coupling terms, for one step of the policy.

    Attributes:
        p_WO: (M, 3) centers of the ellipsoids in the world frame [m].
        R_WO: (M, 3, 3) rotations of the ellipsoids; the columns are the principal axes.
        semi_axes: (M, 3) semi-axes of the ellipsoids [m].
        terms: (M, 12) coupling terms (turning rates of the motion) at full strength, without the
            fading near the goal. The columns are the center of the term (3), alpha, psi, kappa, the
            guidance heading (3) and the normal (3) of the plane in which the obstacle is passed.
            The guidance heading, a direction past the obstacle on the selected side, is zero here
            and computed in each step. The normal is zero if no side is selected.
        direction: (M, 3) unit vectors omega_d in the world frame, from the baseline (line from
            start to goal) to the side on which each obstacle is passed.
        remaining_clearance: (M,) distance from each obstacle at which guidance leads the motion
            past the obstacle [m]: the requested clearance, or the distance of start or goal from
            the obstacle if that is smaller; 0: no guidance.
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
"""Empty set of obstacles, for motions without coupling terms or guidance."""


@compiled
def guide(
    p: Triple, z: Triple, p_WG: Triple, ahead: Triple, obstacles: Obstacles, terms: FloatArray
) -> None:
    """Writes the guidance heading v_d for each obstacle into the coupling terms of a step.

    v_d lies between the heading of the motion and the tangent to the obstacle at the requested
    clearance, on the selected side. It is zero unless two conditions hold: the ray along the motion
    enters the obstacle, grown by the clearance, before the goal; and avoidance would turn the
    motion to another side.

    Args:
        p: position p_WE of the tool point in the world frame [m].
        z: scaled velocity z_W, the derivative of p_WE by normalized time [m].
        p_WG: goal in the world frame [m].
        ahead: vector from start to goal [m], whose direction is the heading of a motion at rest.
        obstacles: M obstacles.
        terms: (M, 12) coupling terms of the obstacles. Columns 6 to 8, the guidance heading, are
            output. Columns 9 to 11 contain the normal of the plane in which the obstacle is passed.
    """
    along = z if norm(z) > 0.0 else ahead
    u = scaled(1.0 / norm(along), along)
    distance_G = norm(mixed(1.0, p_WG, -1.0, p))
    for row in range(len(obstacles.p_WO)):
        clearance, heading = obstacles.remaining_clearance[row], (0.0, 0.0, 0.0)
        o = mixed(1.0, triple(obstacles.p_WO, row), -1.0, p)
        reach, across = norm(o), cross(o, u)
        lean, size = -dot(across, triple(terms, row, NORMAL)), norm(across)
        # A heading straight at the center needs no guidance: avoidance then rotates about the
        # normal, to the selected side.
        if clearance > 0.0 and size > 1e-9 * reach and lean > 1e-9 * size:
            e1 = scaled(1.0 / reach, o)
            e2 = orthogonal(triple(obstacles.direction, row), e1)
            # a, b, c: coefficients of the intersection of the ray along u with the grown
            # ellipsoid. b11, b12, b22: projection of the ellipsoid onto the plane of e1 and e2.
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
                # b11 + more, b12, b22 + more: an ellipse that contains the projection grown by
                # the clearance.
                k = clearance / math.sqrt(mean)
                b11, b12, b22 = (1.0 + k) * b11, (1.0 + k) * b12, (1.0 + k) * b22
                more = (1.0 + 1.0 / k) * clearance**2
                root = b12**2 + (reach**2 - b11 - more) * (b22 + more)
                # Inside this ellipse the root is negative, and the heading points outward.
                signed_root = math.copysign(math.sqrt(abs(root)), root)
                angle = math.atan2(b22 + more, b12 + signed_root)
                tangent = mixed(math.cos(angle), e1, math.sin(angle), e2)
                share = min(2.0 * lean / size, 1.0)
                heading = mixed(1.0 - share, u, share, tangent)
                heading = scaled(1.0 / max(norm(heading), 1e-300), heading)
        for i in range(3):
            terms[row, HEADING + i] = heading[i]
