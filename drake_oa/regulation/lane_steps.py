"""The motion of a block of lanes in space, step by step.

One step is `first_half`, `turn_lanes` and `second_half`: half a step of the spring, the turn of z
by the lane's avoidance term, and the spring's other half, as in
`drake_oa.regulation.spatial_kernels.spatial_kernel`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray
from drake_oa.regulation.lane_math import (
    STRICT,
    TINY_DOUBLE,
    angle_double,
    exponential_double,
    half_sine_cosine_double,
    log1p_positive_double,
    widest_vectors,
)

LANES = 32
"""Rows of a block: several vectors, so that one hides the other's latency."""

lane_jit = njit(cache=True, error_model="numpy", fastmath=STRICT)

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
STATE = tuple(range(0, 42 * LANES, LANES))
X, Y, Z, ZX, ZY, ZZ, LENGTH, TAKEN, ALIVE, ENDS, WORLD, CLOSEST, MARGIN = STATE[:13]
# In the middle of the step.
PX, PY, PZ, WX, WY, WZ, WEIGHT, STRENGTH = STATE[13:21]
# The avoidance term, seconds a step.
CX, CY, CZ, NX, NY, NZ, PSI, INVERSE_PSI, KAPPA, LOG_GAIN, SECONDS = STATE[21:32]
# From the centre of an obstacle in its axes, multiplier.
Y0, Y1, Y2, T = STATE[32:36]
# On the way to the turn.
SINE, COSINE, THETA, C, GROWN, TURN = STATE[36:]
N_STATE = 42 * LANES


@lane_jit
def first_half(
    n: int, S: FloatArray, rx: float, ry: float, rz: float, gx: float, gy: float, gz: float,
    f_xx: float, f_xz: float, f_zx: float, f_zz: float, fade: float,
) -> int:  # fmt: skip
    """Half a step of the spring that rests at r; returns how many lanes may turn.

    `fade`: one over the squared distance to the goal within which the terms fade; 0: they
    do not.
    """
    widest_vectors()
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
        strength = S[LOG_GAIN + i] - S[KAPPA + i] * (ox * ox + oy * oy + oz * oz)
        S[STRENGTH + i] = strength
        strong += np.int64(strength >= _LOG_LEAST)
    return int(strong)


@lane_jit
def turn_lanes(n: int, S: FloatArray) -> None:
    """Turns z of all lanes, see `spatial_kernels.single_turn`.

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
        S[THETA + i] = angle_double(abs(S[SINE + i]), S[COSINE + i])
    for i in range(n):
        u = S[THETA + i] * S[INVERSE_PSI + i]
        rate = S[WEIGHT + i] * exponential_double(S[STRENGTH + i] - u * u)
        c = rate * S[INVERSE_PSI + i]
        S[C + i] = c if c < _MOST_C else _MOST_C
    for i in range(n):
        u, c = S[THETA + i] * S[INVERSE_PSI + i], S[C + i]
        w = c / math.sqrt(1.0 + 2.0 * u * c)
        S[GROWN + i] = w + w * w / (1.0 + math.sqrt(1.0 + w * w))
    for i in range(n):
        u, asinh = S[THETA + i] * S[INVERSE_PSI + i], log1p_positive_double(S[GROWN + i])
        S[GROWN + i] = S[C + i] * (2.0 * u + asinh)
    for i in range(n):
        S[GROWN + i] = log1p_positive_double(S[GROWN + i])
    for i in range(n):
        theta, psi, sine, cosine = S[THETA + i], S[PSI + i], S[SINE + i], S[COSINE + i]
        u, grown = theta * S[INVERSE_PSI + i], S[GROWN + i]
        turn = psi * grown / (u + math.sqrt(u * u + grown) + TINY_DOUBLE)
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
        half, other = half_sine_cosine_double(0.5 * S[TURN + i])
        versine = 2.0 * half * half
        cos, sin = 1.0 - versine, 2.0 * half * other
        along = (zx * nx + zy * ny + zz * nz) * versine
        S[WX + i] = cos * zx + sin * (ny * zz - nz * zy) + along * nx
        S[WY + i] = cos * zy + sin * (nz * zx - nx * zz) + along * ny
        S[WZ + i] = cos * zz + sin * (nx * zy - ny * zx) + along * nz


@lane_jit
def second_half(
    n: int, S: FloatArray, rx: float, ry: float, rz: float, gx: float, gy: float, gz: float,
    f_xx: float, f_xz: float, f_zx: float, f_zz: float, tolerance: float, longest: float,
) -> None:  # fmt: skip
    """The spring's other half for the lanes that go on, and which of them end there.

    `tolerance` is 0 as long as the motion may not end.
    """
    widest_vectors()
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
