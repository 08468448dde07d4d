"""Distances of a block of lanes to the ellipsoids that they pass, and what each has kept.

`D` is the block's account of one obstacle, `S` its state (`drake_oa.regulation.lane_steps`). An
obstacle's distance is asked for only where the motion may have come nearer.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.regulation.lane_math import TINY_DOUBLE, widest_vectors
from drake_oa.regulation.lane_steps import (
    ALIVE,
    CLOSEST,
    ENDS,
    LANES,
    MARGIN,
    SECONDS,
    Y0,
    Y1,
    Y2,
    T,
    X,
    Y,
    Z,
    lane_jit,
)

# Rows of a block's account of one obstacle: the least distance, a bound of the clearance
# that counts as feasible, the last multiplier, and the plane that touches it there.
LEAST, FEASIBLE, LAST_T, UX, UY, UZ, OFFSET = range(0, 7 * LANES, LANES)
N_OBSTACLE = 7 * LANES


@lane_jit
def may_come_nearer(
    n: int, S: FloatArray, D: FloatArray, number: float, moving: bool,
    cx: float, cy: float, cz: float, vx: float, vy: float, vz: float,
) -> int:  # fmt: skip
    """How many lanes may be nearer to an obstacle than what counts so far.

    Distance is convex: it is not less than that to the plane which touched the obstacle
    where it was last asked for. What counts for obstacles at rest is the least distance to
    any of them and the least margin; a moving one's feasible clearance is known at the end.
    """
    widest_vectors()
    count = np.int64(0)
    for i in range(n):
        time = number * S[SECONDS + i]
        ex, ey, ez = (
            S[X + i] - cx - vx * time,
            S[Y + i] - cy - vy * time,
            S[Z + i] - cz - vz * time,
        )
        bound = D[UX + i] * ex + D[UY + i] * ey + D[UZ + i] * ez - D[OFFSET + i]
        closest, margin = S[CLOSEST + i], S[MARGIN + i] + D[FEASIBLE + i]
        least = D[LEAST + i]
        counts = closest if closest > margin else margin
        counts = least if moving else counts
        count += np.int64((bound < counts) & (S[ALIVE + i] > 0.0))
    return int(count)


@lane_jit
def _inside(
    n: int, S: FloatArray, D: FloatArray, number: float,
    cx: float, cy: float, cz: float, vx: float, vy: float, vz: float,
    r00: float, r01: float, r02: float, r10: float, r11: float, r12: float,
    r20: float, r21: float, r22: float, a0: float, a1: float, a2: float,
) -> None:  # fmt: skip
    """Puts the bound of the depth in the place of the distance of the lanes inside."""
    small = min(a0, a1, a2)
    for i in range(n):
        time = number * S[SECONDS + i]
        ex, ey, ez = (
            S[X + i] - cx - vx * time,
            S[Y + i] - cy - vy * time,
            S[Z + i] - cz - vz * time,
        )
        g0 = (r00 * ex + r10 * ey + r20 * ez) / a0
        g1 = (r01 * ex + r11 * ey + r21 * ez) / a1
        g2 = (r02 * ex + r12 * ey + r22 * ez) / a2
        gauge = math.sqrt(g0 * g0 + g1 * g1 + g2 * g2)
        if gauge <= 1.0:
            scale = small / (gauge + TINY_DOUBLE)
            S[T + i] = small * (gauge - 1.0)
            # Its slope: as the gauge is convex, a bound everywhere.
            S[Y0 + i], S[Y1 + i], S[Y2 + i] = scale * g0 / a0, scale * g1 / a1, scale * g2 / a2
            D[OFFSET + i] = small
            D[LAST_T + i] = 0.0


@lane_jit
def come_nearer(
    n: int, S: FloatArray, D: FloatArray, number: float, shortest: float,
    cx: float, cy: float, cz: float, vx: float, vy: float, vz: float,
    r00: float, r01: float, r02: float, r10: float, r11: float, r12: float,
    r20: float, r21: float, r22: float, a0: float, a1: float, a2: float,
) -> None:  # fmt: skip
    """Distances of all lanes to an obstacle, see `spatial_kernels.point_distance`."""
    widest_vectors()
    q0, q1, q2 = a0 * a0, a1 * a1, a2 * a2
    small = min(a0, a1, a2)
    enough = 1e-6 * small * small
    inverse0, inverse1, inverse2 = 1.0 / q0, 1.0 / q1, 1.0 / q2
    inside = np.int64(0)
    for i in range(n):
        time = number * S[SECONDS + i]
        ex, ey, ez = (
            S[X + i] - cx - vx * time,
            S[Y + i] - cy - vy * time,
            S[Z + i] - cz - vz * time,
        )
        y0 = r00 * ex + r10 * ey + r20 * ez
        y1 = r01 * ex + r11 * ey + r21 * ez
        y2 = r02 * ex + r12 * ey + r22 * ez
        S[Y0 + i], S[Y1 + i], S[Y2 + i] = y0, y1, y2
        S[T + i] = D[LAST_T + i]
        inside += np.int64(y0 * y0 * inverse0 + y1 * y1 * inverse1 + y2 * y2 * inverse2 <= 1.0)
    for _ in range(30):
        open_ = np.int64(0)
        for i in range(n):
            t = S[T + i]
            b0, b1, b2 = q0 + t, q1 + t, q2 + t
            b01, b12, b20 = b0 * b1, b1 * b2, b2 * b0
            inverse = 1.0 / (b01 * b2)
            i0, i1, i2 = b12 * inverse, b20 * inverse, b01 * inverse
            u0, u1, u2 = a0 * S[Y0 + i] * i0, a1 * S[Y1 + i] * i1, a2 * S[Y2 + i] * i2
            u0, u1, u2 = u0 * u0, u1 * u1, u2 * u2
            total = u0 + u1 + u2
            slope = u0 * i0 + u1 * i1 + u2 * i2
            change = total * (math.sqrt(total) - 1.0) / (slope + TINY_DOUBLE)
            new = t + change
            new = new if new > 0.0 else 0.0
            S[T + i] = new
            open_ += np.int64(abs(new - t) > 0.1 * new + enough)
        if open_ == 0:
            break
    # The distance to the supporting plane whose normal is the foot point's: the error of the
    # multiplier enters it squared.
    for i in range(n):
        t, y0, y1, y2 = S[T + i], S[Y0 + i], S[Y1 + i], S[Y2 + i]
        b0, b1, b2 = q0 + t, q1 + t, q2 + t
        d0, d1, d2 = y0 * (b1 * b2), y1 * (b2 * b0), y2 * (b0 * b1)
        scale = 1.0 / math.sqrt(d0 * d0 + d1 * d1 + d2 * d2 + TINY_DOUBLE)
        d0, d1, d2 = scale * d0, scale * d1, scale * d2
        S[Y0 + i], S[Y1 + i], S[Y2 + i] = d0, d1, d2
        support = math.sqrt(q0 * d0 * d0 + q1 * d1 * d1 + q2 * d2 * d2)
        D[LAST_T + i], D[OFFSET + i] = t, support
        S[T + i] = d0 * y0 + d1 * y1 + d2 * y2 - support
    if inside > 0:
        _inside(
            n, S, D, number, cx, cy, cz, vx, vy, vz,
            r00, r01, r02, r10, r11, r12, r20, r21, r22, a0, a1, a2,
        )  # fmt: skip
    for i in range(n):
        d, d0, d1, d2 = S[T + i], S[Y0 + i], S[Y1 + i], S[Y2 + i]
        D[UX + i] = r00 * d0 + r01 * d1 + r02 * d2
        D[UY + i] = r10 * d0 + r11 * d1 + r12 * d2
        D[UZ + i] = r20 * d0 + r21 * d1 + r22 * d2
        alive, least, feasible = S[ALIVE + i], D[LEAST + i], D[FEASIBLE + i]
        closest, margin, ends = S[CLOSEST + i], S[MARGIN + i], S[ENDS + i]
        d = d if alive > 0.0 else least
        least = d if d < least else least
        excess = least - feasible
        D[LEAST + i] = least
        S[CLOSEST + i] = least if least < closest else closest
        S[MARGIN + i] = excess if excess < margin else margin
        S[ENDS + i] = 1.0 if excess < -shortest else ends
