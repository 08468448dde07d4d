"""The steps of a block of roll-outs, and its distances to obstacles: loops over its lanes.

`S` is a block's state, `D` its account of one obstacle. The loops have neither branches nor calls
to the C library, so that the compiler makes them loops over vectors; all in float64.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import ALPHA, GUIDANCE_ALPHA, KAPPA, NORMAL, PSI
from drake_oa.regulation.lane_math import (
    STRICT,
    TINY,
    angle,
    exponential,
    half_sine_cosine,
    log1p_positive,
    widest_vectors,
)

lane_jit = njit(cache=True, error_model="numpy", fastmath=STRICT)

LANES = 32
"""Rows of a block: several vectors, so that one hides the other's latency."""

_LEAST_TURN = 1e-11
"""Turns below this in a step are left out [rad]."""
_LOG_LEAST = math.log(_LEAST_TURN)

MOST_PSI = 1e150
"""Cap of psi and of 1 / psi: squares stay finite, and no turn depends on it."""
_MOST_C = 1e150
"""The same for c, the turning rate times the step over psi."""
_LEAST_C = 1e-14
"""Below it the turn is the explicit one."""

# Rows of a block's state, one after the other in one array: with offsets known, the compiler
# sees that they do not overlap. Position, z, what came of it, whether the lane goes on.
STATE = tuple(range(0, 41 * LANES, LANES))
X, Y, Z, ZX, ZY, ZZ, LENGTH, TAKEN, ALIVE, ENDS, CLOSEST, MARGIN = STATE[:12]
# In the middle of the step.
PX, PY, PZ, WX, WY, WZ, WEIGHT, STRENGTH = STATE[12:20]
# The avoidance term, seconds a step.
CX, CY, CZ, NX, NY, NZ, TERM_PSI, INVERSE_PSI, TERM_KAPPA, LOG_GAIN, SECONDS = STATE[20:31]
# From the centre of an obstacle in its axes, multiplier.
Y0, Y1, Y2, T = STATE[31:35]
# On the way to the turn.
SINE, COSINE, THETA, C, GROWN, TURN = STATE[35:]
N_STATE = 41 * LANES

# Rows of a block's account of one obstacle: the least distance, a bound of the clearance
# that counts as feasible, the last multiplier, and the plane that touches it there.
LEAST, FEASIBLE, LAST_T, UX, UY, UZ, OFFSET = range(0, 7 * LANES, LANES)
N_OBSTACLE = 7 * LANES

Triple = tuple[float, float, float]


# --- one point ---------------------------------------------------------------------------


@lane_jit
def outside_distance(
    y0: float, y1: float, y2: float, a0: float, a1: float, a2: float, t: float
) -> tuple[float, float]:
    """Distance of a point outside to an ellipsoid, in its axes, and the multiplier t.

    The foot point is x_i = a_i^2 y_i / (a_i^2 + t) with t > 0 the root of
    sum (a_i y_i / (a_i^2 + t))^2 = 1; Newton's method on the inverse square root of that
    sum starts from the given t, the last point's.
    """
    q0, q1, q2 = a0 * a0, a1 * a1, a2 * a2
    for _ in range(30):
        i0, i1, i2 = 1.0 / (q0 + t), 1.0 / (q1 + t), 1.0 / (q2 + t)
        u0, u1, u2 = a0 * y0 * i0, a1 * y1 * i1, a2 * y2 * i2
        total = u0 * u0 + u1 * u1 + u2 * u2
        slope = u0 * u0 * i0 + u1 * u1 * i1 + u2 * u2 * i2
        change = total * (math.sqrt(total) - 1.0) / slope
        t = max(t + change, 0.0)
        if abs(change) <= 1e-5 * t:
            break
    d0, d1, d2 = y0 / (q0 + t), y1 / (q1 + t), y2 / (q2 + t)
    return t * math.sqrt(d0 * d0 + d1 * d1 + d2 * d2), t


@lane_jit
def point_distance(
    x: float,
    y: float,
    z: float,
    R: FloatArray,
    semi_axes: FloatArray,
    s: int,
    j: int,
    t: float,
) -> tuple[float, float]:
    """Distance to ellipsoid j of scene s of a point given from its centre, and the multiplier.

    Inside, minus a lower bound of the depth. (Views of the arrays would be counted
    references in the innermost loop: hence the indices.)
    """
    y0 = abs(R[s, j, 0, 0] * x + R[s, j, 1, 0] * y + R[s, j, 2, 0] * z)
    y1 = abs(R[s, j, 0, 1] * x + R[s, j, 1, 1] * y + R[s, j, 2, 1] * z)
    y2 = abs(R[s, j, 0, 2] * x + R[s, j, 1, 2] * y + R[s, j, 2, 2] * z)
    a0, a1, a2 = semi_axes[s, j, 0], semi_axes[s, j, 1], semi_axes[s, j, 2]
    gauge2 = (y0 / a0) ** 2 + (y1 / a1) ** 2 + (y2 / a2) ** 2
    if gauge2 <= 1.0:
        return (math.sqrt(gauge2) - 1.0) * min(a0, a1, a2), t
    return outside_distance(y0, y1, y2, a0, a1, a2, t)


# --- steps -------------------------------------------------------------------------------


@lane_jit
def first_half(
    n: int, S: FloatArray, spring: Triple, goal: Triple, flow: tuple[float, ...], fade: float
) -> int:
    """Half a step of the spring; returns how many lanes may turn.

    `fade`: one over the squared distance to the goal within which the terms fade; 0: they
    do not.
    """
    widest_vectors()
    rx, ry, rz = spring
    gx, gy, gz = goal
    f_xx, f_xz, f_zx, f_zz = flow
    strong = np.int64(0)
    for i in range(n):
        x, y, z, zx, zy, zz = S[X + i], S[Y + i], S[Z + i], S[ZX + i], S[ZY + i], S[ZZ + i]
        dx, dy, dz = gx - x, gy - y, gz - z
        left = (dx * dx + dy * dy + dz * dz) * fade
        left = left if left < 1.0 else 1.0
        S[WEIGHT + i] = left * left if fade > 0.0 else 1.0
        qx, qy, qz = x - rx, y - ry, z - rz
        px, py, pz = (
            rx + f_xx * qx + f_xz * zx,
            ry + f_xx * qy + f_xz * zy,
            rz + f_xx * qz + f_xz * zz,
        )
        S[PX + i], S[PY + i], S[PZ + i] = px, py, pz
        S[WX + i], S[WY + i], S[WZ + i] = (
            f_zx * qx + f_zz * zx,
            f_zx * qy + f_zz * zy,
            f_zx * qz + f_zz * zz,
        )
        ox, oy, oz = S[CX + i] - px, S[CY + i] - py, S[CZ + i] - pz
        strength = S[LOG_GAIN + i] - S[TERM_KAPPA + i] * (ox * ox + oy * oy + oz * oz)
        S[STRENGTH + i] = strength
        strong += np.int64(strength >= _LOG_LEAST)
    return int(strong)


@lane_jit
def turn_lanes(n: int, S: FloatArray) -> None:
    """Turns z of all lanes by their terms.

    In several loops: so short that the processor overlaps their passes.
    """
    widest_vectors()
    for i in range(n):
        ox, oy, oz = S[CX + i] - S[PX + i], S[CY + i] - S[PY + i], S[CZ + i] - S[PZ + i]
        nx, ny, nz = S[NX + i], S[NY + i], S[NZ + i]
        zx, zy, zz = S[WX + i], S[WY + i], S[WZ + i]
        o_n, z_n = ox * nx + oy * ny + oz * nz, zx * nx + zy * ny + zz * nz
        sine = nx * (oy * zz - oz * zy) + ny * (oz * zx - ox * zz) + nz * (ox * zy - oy * zx)
        cosine = ox * zx + oy * zy + oz * zz - o_n * z_n
        size = (ox * ox + oy * oy + oz * oz) * (zx * zx + zy * zy + zz * zz)
        sine = 0.0 if sine * sine <= 1e-18 * size else sine
        S[SINE + i], S[COSINE + i] = sine, cosine
    for i in range(n):
        S[THETA + i] = angle(abs(S[SINE + i]), S[COSINE + i])
    for i in range(n):
        u = S[THETA + i] * S[INVERSE_PSI + i]
        rate = S[WEIGHT + i] * exponential(S[STRENGTH + i] - u * u)
        c = rate * S[INVERSE_PSI + i]
        S[C + i] = c if c < _MOST_C else _MOST_C
    for i in range(n):
        u, c = S[THETA + i] * S[INVERSE_PSI + i], S[C + i]
        w = c / math.sqrt(1.0 + 2.0 * u * c)
        S[GROWN + i] = w + w * w / (1.0 + math.sqrt(1.0 + w * w))
    for i in range(n):
        u, asinh = S[THETA + i] * S[INVERSE_PSI + i], log1p_positive(S[GROWN + i])
        S[GROWN + i] = S[C + i] * (2.0 * u + asinh)
    for i in range(n):
        S[GROWN + i] = log1p_positive(S[GROWN + i])
    for i in range(n):
        theta, psi, sine, cosine = S[THETA + i], S[TERM_PSI + i], S[SINE + i], S[COSINE + i]
        u, grown = theta * S[INVERSE_PSI + i], S[GROWN + i]
        turn = psi * grown / (u + math.sqrt(u * u + grown) + TINY)
        # There the closed form loses its digits.
        turn = S[C + i] * psi if S[C + i] < _LEAST_C else turn
        most = math.pi - theta
        turn = turn if turn < most else most
        turn = turn if S[C + i] * psi >= _LEAST_TURN else 0.0
        # Opposite to the obstacle, or at rest: no side to turn to.
        turn = 0.0 if (sine == 0.0) & (cosine <= 0.0) else turn
        S[TURN + i] = -turn if sine < 0.0 else turn
    for i in range(n):
        nx, ny, nz = S[NX + i], S[NY + i], S[NZ + i]
        zx, zy, zz = S[WX + i], S[WY + i], S[WZ + i]
        half, other = half_sine_cosine(0.5 * S[TURN + i])
        versine = 2.0 * half * half
        cos, sin = 1.0 - versine, 2.0 * half * other
        along = (zx * nx + zy * ny + zz * nz) * versine
        S[WX + i] = cos * zx + sin * (ny * zz - nz * zy) + along * nx
        S[WY + i] = cos * zy + sin * (nz * zx - nx * zz) + along * ny
        S[WZ + i] = cos * zz + sin * (nx * zy - ny * zx) + along * nz


@lane_jit
def second_half(
    n: int,
    S: FloatArray,
    spring: Triple,
    goal: Triple,
    flow: tuple[float, ...],
    tolerance: float,
    longest: float,
) -> None:
    """The spring's other half for the lanes that go on, and which of them end there.

    `tolerance` is 0 as long as the motion may not end.
    """
    widest_vectors()
    rx, ry, rz = spring
    gx, gy, gz = goal
    f_xx, f_xz, f_zx, f_zz = flow
    near2, slow2 = tolerance * tolerance, 400.0 * tolerance * tolerance
    for i in range(n):
        alive, x, y, z, length = S[ALIVE + i], S[X + i], S[Y + i], S[Z + i], S[LENGTH + i]
        was_zx, was_zy, was_zz = S[ZX + i], S[ZY + i], S[ZZ + i]
        zx, zy, zz = S[WX + i], S[WY + i], S[WZ + i]
        qx, qy, qz = S[PX + i] - rx, S[PY + i] - ry, S[PZ + i] - rz
        nx, ny, nz = (
            rx + f_xx * qx + f_xz * zx,
            ry + f_xx * qy + f_xz * zy,
            rz + f_xx * qz + f_xz * zz,
        )
        zx, zy, zz = f_zx * qx + f_zz * zx, f_zx * qy + f_zz * zy, f_zx * qz + f_zz * zz
        goes = alive > 0.0
        nx, ny, nz = nx if goes else x, ny if goes else y, nz if goes else z
        zx, zy, zz = zx if goes else was_zx, zy if goes else was_zy, zz if goes else was_zz
        sx, sy, sz = nx - x, ny - y, nz - z
        length += math.sqrt(sx * sx + sy * sy + sz * sz)
        S[X + i], S[Y + i], S[Z + i] = nx, ny, nz
        S[ZX + i], S[ZY + i], S[ZZ + i] = zx, zy, zz
        S[LENGTH + i] = length
        S[TAKEN + i] += alive
        dx, dy, dz = gx - nx, gy - ny, gz - nz
        left2 = dx * dx + dy * dy + dz * dz
        rest = longest - length
        arrived = (left2 < near2) & (zx * zx + zy * zy + zz * zz < slow2)
        hopeless = (rest < 0.0) | (left2 > rest * rest)
        S[ENDS + i] = 1.0 if arrived | hopeless else 0.0


@lane_jit
def end_lanes(n: int, S: FloatArray) -> int:
    """Stops the lanes that end; returns how many go on."""
    widest_vectors()
    left = np.int64(0)
    for i in range(n):
        alive = S[ALIVE + i]
        alive = 0.0 if S[ENDS + i] > 0.0 else alive
        S[ALIVE + i] = alive
        left += np.int64(alive > 0.0)
    return int(left)


# --- distances ---------------------------------------------------------------------------


@lane_jit
def may_come_nearer(
    n: int, S: FloatArray, D: FloatArray, number: float, moving: bool, center: Triple, v: Triple
) -> int:
    """How many lanes may be nearer to an obstacle than what counts so far.

    Distance is convex: it is not less than that to the plane which touched the obstacle
    where it was last asked for. What counts for obstacles at rest is the least distance to
    any of them and the least margin; a moving one's feasible clearance is known at the end.
    """
    widest_vectors()
    cx, cy, cz = center
    vx, vy, vz = v
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
    n: int,
    S: FloatArray,
    D: FloatArray,
    number: float,
    center: Triple,
    v: Triple,
    R: tuple[float, ...],
    semi_axes: Triple,
) -> None:
    """Puts the bound of the depth in the place of the distance of the lanes inside."""
    cx, cy, cz = center
    vx, vy, vz = v
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = R
    a0, a1, a2 = semi_axes
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
            scale = small / (gauge + TINY)
            S[T + i] = small * (gauge - 1.0)
            # Its slope: as the gauge is convex, a bound everywhere.
            S[Y0 + i], S[Y1 + i], S[Y2 + i] = scale * g0 / a0, scale * g1 / a1, scale * g2 / a2
            D[OFFSET + i] = small
            D[LAST_T + i] = 0.0


@lane_jit
def come_nearer(
    n: int,
    S: FloatArray,
    D: FloatArray,
    number: float,
    center: Triple,
    v: Triple,
    R: tuple[float, ...],
    semi_axes: Triple,
    shortest: float,
) -> None:
    """Distances of all lanes to an obstacle, as of `point_distance`."""
    widest_vectors()
    cx, cy, cz = center
    vx, vy, vz = v
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = R
    a0, a1, a2 = semi_axes
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
            change = total * (math.sqrt(total) - 1.0) / (slope + TINY)
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
        scale = 1.0 / math.sqrt(d0 * d0 + d1 * d1 + d2 * d2 + TINY)
        d0, d1, d2 = scale * d0, scale * d1, scale * d2
        S[Y0 + i], S[Y1 + i], S[Y2 + i] = d0, d1, d2
        support = math.sqrt(q0 * d0 * d0 + q1 * d1 * d1 + q2 * d2 * d2)
        D[LAST_T + i], D[OFFSET + i] = t, support
        S[T + i] = d0 * y0 + d1 * y1 + d2 * y2 - support
    if inside > 0:
        _inside(n, S, D, number, center, v, R, semi_axes)
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


WRONG_TERMS = (
    "",
    "must be finite",
    "must not have a negative alpha",
    "must have a positive psi",
    "must not have a negative kappa",
    "must have a normal of length 1",
    "must not guide: guidance alpha must be 0",
)
"""What a term may not be; see `first_wrong_term`."""


@compiled
def first_wrong_term(terms: FloatArray) -> tuple[int, int]:
    """The first row that is no term, and what of `WRONG_TERMS` it is; (-1, 0): there is none."""
    for row in range(len(terms)):
        term = terms[row]
        for value in term:
            if not math.isfinite(value):
                return row, 1
        n = term[NORMAL : NORMAL + 3]
        acts = term[ALPHA] > 0.0
        if term[ALPHA] < 0.0:
            return row, 2
        if acts and not term[PSI] > 0.0:
            return row, 3
        if acts and not term[KAPPA] >= 0.0:
            return row, 4
        if acts and abs(math.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) - 1.0) > 1e-6:
            return row, 5
        if term[GUIDANCE_ALPHA] != 0.0:
            return row, 6
    return -1, 0
