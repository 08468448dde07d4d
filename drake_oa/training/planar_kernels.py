"""Compiled roll-outs in the plane, float32, many lanes at a time.

The rows of a call are advanced in groups of `LANES`, one structure of arrays each, by
an inner loop without branches, so that the compiler makes it a loop over vectors: the
elementary functions are those of `drake_oa.regulation.lane_math`, every constant is float32,
and the distance to the ellipse takes one curvature iteration a step, started from the
last foot point.
All groups of a batch take `TILE` steps each; then the lanes that touched the ellipse
give their place to the last ones. `drake_oa.training.planar_double` holds the same motions in
float64, row by row.

The motion is the project's own (`drake_oa.training.planar_rollout`); that of the authors' released
code is in `drake_oa.training.released_kernels`, which shares what is done for one lane.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from drake_oa.regulation.lane_math import (
    FAST,
    HALF,
    ONE,
    PI,
    ROOT_HALF,
    TINY,
    TWO,
    ZERO,
    Single,
    angle_single,
    exp_negative_single,
    forced_single,
    log1p_positive_single,
    sine_cosine_single,
    widest_vectors,
)

SingleArray = NDArray[np.float32]
Constants = tuple[np.float32, ...]
"""Scalars: an array would have to be read again after each write to another."""

LANES = 64
"""Rows of a group: several vectors, so that one's latency is hidden by the next."""

TILE = 16
"""Steps that a group takes before its lanes are compacted."""

BATCH = 2048
"""Rows that are advanced together by one thread."""

BAND = np.float32(2e-4)
"""A row counts as touching for certain where it is this deep inside the ellipse."""

# Rows of a group's state. The first ones change from step to step.
_X, _Y, _ZX, _ZY, _LENGTH, _TX, _TY = range(7)
# Least squared distance so far, the state before the step that reached it, the step.
_LEAST, _LEAST_X, _LEAST_Y, _LEAST_ZX, _LEAST_ZY, _LEAST_STEP, _DEPTH = range(7, 14)
_CHANGING = 14
_ALPHA, _PSI, _KAPPA, _CX, _CY, _SPRING, _A, _B, _INVERSE_A, _INVERSE_B = range(14, 24)
_EVOLUTE_X, _EVOLUTE_Y, _TOUCHED = range(24, 27)
_ROWS = 27

# With Python's error model each division would branch.
jit = numba.njit(cache=True, fastmath=FAST, error_model="numpy")
_inline = numba.njit(cache=True, fastmath=FAST, error_model="numpy", inline="always")
parallel = numba.njit(cache=True, fastmath=FAST, error_model="numpy", parallel=True)

BIG = Single(1e30)
# Keeps lateral motion, and its squares, out of the denormal numbers, which are slow.
LEAST_RATE = Single(1e-9)
LEAST_FOOT = Single(1e-10)


# --- one step of a lane ----------------------------------------------------------------


@forced_single
def nearer_foot(
    px: Single, py: Single, a: Single, b: Single, ea: Single, eb: Single,
    inverse_a: Single, inverse_b: Single, tx: Single, ty: Single,
) -> tuple[Single, Single]:  # fmt: skip
    """One curvature iteration toward the foot point (a tx, b ty) of (px, py) >= 0.

    The ellipse is replaced by its osculating circle at the last estimate.
    """
    ex, ey = ea * tx * tx * tx, eb * ty * ty * ty
    rx, ry, qx, qy = a * tx - ex, b * ty - ey, px - ex, py - ey
    radius2 = rx * rx + ry * ry
    # The processor estimates 1 / sqrt quickly, but neither a quotient nor a root.
    scale = radius2 * (ONE / math.sqrt(radius2 * (qx * qx + qy * qy) + TINY))
    tx, ty = (qx * scale + ex) * inverse_a, (qy * scale + ey) * inverse_b
    tx = tx if tx > LEAST_FOOT else LEAST_FOOT
    ty = ty if ty > LEAST_FOOT else LEAST_FOOT
    tx = tx if tx < ONE else ONE
    ty = ty if ty < ONE else ONE
    size = ONE / math.sqrt(tx * tx + ty * ty)
    return tx * size, ty * size


@forced_single
def project_step(
    x: Single, y: Single, zx: Single, zy: Single, drive: Single, alpha: Single, psi: Single,
    kappa: Single, cx: Single, cy: Single, spring: Single, c: Constants,
) -> tuple[Single, Single, Single, Single]:  # fmt: skip
    """Half the spring, the linearly implicit turn, the spring's other half.

    alpha stands for alpha x step, psi for 1 / psi, spring for psi, drive for where the
    spring rests; c: the spring's flow over half a step, 1 / fade^2.
    """
    ex = x - drive
    x, px = drive + c[0] * ex + c[1] * zx, c[2] * ex + c[3] * zx
    y, py = c[0] * y + c[1] * zy, c[2] * y + c[3] * zy
    dx, dy = cx - x, cy - y
    cross = px * dy - py * dx
    theta = angle_single(abs(cross), px * dx + py * dy)
    u = theta * psi
    left = ((x - ONE) * (x - ONE) + y * y) * c[4]
    left = left if left < ONE else ONE
    fall = exp_negative_single(-(u * u + kappa * (dx * dx + dy * dy)))
    rate = LEAST_RATE + alpha * left * left * fall
    g = rate * psi
    w = g / math.sqrt(ONE + TWO * u * g)
    asinh = log1p_positive_single(w + w * w / (ONE + math.sqrt(ONE + w * w)))
    grown = log1p_positive_single(g * (TWO * u + asinh))
    turn = grown * spring / (u + math.sqrt(u * u + grown) + TINY)
    most = PI - theta
    turn = turn if turn < most else most
    turn = -turn if cross > ZERO else turn
    sine, cosine = sine_cosine_single(turn)
    zx, zy = cosine * px - sine * py, sine * px + cosine * py
    ex = x - drive
    return (
        drive + c[0] * ex + c[1] * zx,
        c[0] * y + c[1] * zy,
        c[2] * ex + c[3] * zx,
        c[2] * y + c[3] * zy,
    )


# --- a group of lanes ------------------------------------------------------------------


@_inline
def _step_lane(S, i, moved, x, y, zx, zy, number):  # type: ignore[no-untyped-def]
    """Takes lane i to the state `moved` from (x, y, zx, zy), and keeps its account."""
    nx, ny, nzx, nzy = moved
    sx, sy = nx - x, ny - y
    S[_LENGTH, i] += math.sqrt(sx * sx + sy * sy)
    a, b, inverse_a, inverse_b = S[_A, i], S[_B, i], S[_INVERSE_A, i], S[_INVERSE_B, i]
    px, py = abs(nx - S[_CX, i]), abs(ny - S[_CY, i])
    tx, ty = nearer_foot(
        px, py, a, b, S[_EVOLUTE_X, i], S[_EVOLUTE_Y, i], inverse_a, inverse_b, S[_TX, i], S[_TY, i]
    )
    S[_TX, i], S[_TY, i] = tx, ty
    ux, uy = px * inverse_a, py * inverse_b
    depth, deepest = ux * ux + uy * uy, S[_DEPTH, i]
    S[_DEPTH, i] = depth if depth < deepest else deepest
    hx, hy = px - a * tx, py - b * ty
    distance, least = hx * hx + hy * hy, S[_LEAST, i]
    nearer = distance < least
    # Each old value is read whether it is needed or not: a load in a branch would keep
    # the loop from becoming one over vectors.
    was_x, was_y, was_zx = S[_LEAST_X, i], S[_LEAST_Y, i], S[_LEAST_ZX, i]
    was_zy, was_number = S[_LEAST_ZY, i], S[_LEAST_STEP, i]
    S[_LEAST, i] = distance if nearer else least
    S[_LEAST_X, i] = x if nearer else was_x
    S[_LEAST_Y, i] = y if nearer else was_y
    S[_LEAST_ZX, i] = zx if nearer else was_zx
    S[_LEAST_ZY, i] = zy if nearer else was_zy
    S[_LEAST_STEP, i] = number if nearer else was_number
    S[_X, i], S[_Y, i], S[_ZX, i], S[_ZY, i] = nx, ny, nzx, nzy


@jit
def _project_tile(W: SingleArray, drive: SingleArray, first: int, end: int, c: Constants) -> None:
    widest_vectors()
    S = np.empty((_ROWS, LANES), np.float32)
    for k in range(_ROWS):
        line = W[k]
        for i in range(LANES):
            S[k, i] = line[i]
    for step in range(first, end):
        number, rest = Single(step), drive[step]
        for i in range(LANES):
            x, y, zx, zy = S[_X, i], S[_Y, i], S[_ZX, i], S[_ZY, i]
            moved = project_step(
                x, y, zx, zy, rest, S[_ALPHA, i], S[_PSI, i], S[_KAPPA, i], S[_CX, i], S[_CY, i],
                S[_SPRING, i], c,
            )  # fmt: skip
            _step_lane(S, i, moved, x, y, zx, zy, number)
    for k in range(_CHANGING):
        line = W[k]
        for i in range(LANES):
            line[i] = S[k, i]


# --- batches ----------------------------------------------------------------------------


@jit
def _place(W: SingleArray, i: int, a: Single, b: Single, cx: Single, cy: Single) -> None:
    """Puts a lane at rest at the start."""
    for k in range(_ROWS):
        W[k, i] = ZERO
    W[_TX, i] = W[_TY, i] = ROOT_HALF
    W[_LEAST, i] = W[_DEPTH, i] = BIG
    W[_CX, i], W[_CY, i], W[_A, i], W[_B, i] = cx, cy, a, b
    W[_INVERSE_A, i], W[_INVERSE_B, i] = ONE / a, ONE / b
    W[_EVOLUTE_X, i], W[_EVOLUTE_Y, i] = (a * a - b * b) / a, (b * b - a * a) / b
    inside = ONE - BAND / min(a, b)
    W[_TOUCHED, i] = inside * inside if inside > ZERO else ZERO


@jit
def _compact(W: SingleArray, rows: NDArray[np.int64], alive: int, out: SingleArray) -> int:
    """Drops the lanes that touched; returns how many are left."""
    lane = 0
    while lane < alive:
        group, i = lane // LANES, lane % LANES
        if W[group, _DEPTH, i] > W[group, _TOUCHED, i]:
            lane += 1
            continue
        row = rows[lane]
        out[0, row], out[1, row], out[2, row] = -BAND, np.inf, np.inf
        alive -= 1
        last, j = alive // LANES, alive % LANES
        for k in range(_ROWS):
            W[group, k, i] = W[last, k, j]
        rows[lane] = rows[alive]
    return alive


@jit
def _distance(W: SingleArray, i: int, x: Single, y: Single) -> Single:
    """Signed distance to the lane's ellipse, negative inside."""
    a, b = W[_A, i], W[_B, i]
    px, py = abs(x - W[_CX, i]), abs(y - W[_CY, i])
    tx = ty = ROOT_HALF
    for _ in range(8):
        tx, ty = nearer_foot(
            px, py, a, b, W[_EVOLUTE_X, i], W[_EVOLUTE_Y, i], W[_INVERSE_A, i], W[_INVERSE_B, i],
            tx, ty,
        )  # fmt: skip
    hx, hy = px - a * tx, py - b * ty
    size = Single(math.sqrt(hx * hx + hy * hy))
    ux, uy = px * W[_INVERSE_A, i], py * W[_INVERSE_B, i]
    return -size if ux * ux + uy * uy < ONE else size


@jit
def least_between(before: Single, nearest: Single, after: Single) -> Single:
    """Least distance between samples: the vertex of the parabola through three."""
    bend = before - TWO * nearest + after
    if not bend > ZERO:
        return nearest
    shift = HALF * (before - after) / bend
    shift = shift if shift > -ONE else -ONE
    shift = shift if shift < ONE else ONE
    vertex = nearest + shift * (HALF * (after - before) + HALF * shift * bend)
    return vertex if vertex < nearest else nearest


@jit
def _least_project(W: SingleArray, i: int, drive: SingleArray, c: Constants) -> Single:
    step = int(W[_LEAST_STEP, i])
    x, y, zx, zy = W[_LEAST_X, i], W[_LEAST_Y, i], W[_LEAST_ZX, i], W[_LEAST_ZY, i]
    p = W[_ALPHA, i], W[_PSI, i], W[_KAPPA, i], W[_CX, i], W[_CY, i], W[_SPRING, i]
    before = _distance(W, i, x, y)
    x, y, zx, zy = project_step(x, y, zx, zy, drive[step], p[0], p[1], p[2], p[3], p[4], p[5], c)
    nearest = _distance(W, i, x, y)
    if step + 1 >= len(drive):
        return nearest
    x, y, zx, zy = project_step(
        x, y, zx, zy, drive[step + 1], p[0], p[1], p[2], p[3], p[4], p[5], c
    )
    return least_between(before, nearest, _distance(W, i, x, y))


@jit
def _arrive(W: SingleArray, i: int, row: int, least: Single, out: SingleArray) -> None:
    out[0, row] = least
    ex, ey = W[_X, i] - ONE, W[_Y, i]
    out[1, row] = math.sqrt(ex * ex + ey * ey)
    out[2, row] = W[_LENGTH, i]


@parallel
def project_batch(
    extents: SingleArray, parameters: SingleArray, centers: SingleArray, drive: SingleArray,
    c: Constants, out: SingleArray,
) -> None:  # fmt: skip
    """The project's own motion, see `drake_oa.training.planar_rollout.planar_rollouts`.

    Args:
        extents: (N, 2) semi-axes along and across the baseline of 1.
        parameters: (N, 3) alpha, psi, kappa.
        centers: (N, 2).
        drive: (steps,) where the spring rests.
        c: the spring's flow over half a step, 1 / fade^2, steps a unit of s.
        out: (3, N) signed clearance (-BAND for a certain contact), goal error, length.
    """
    n, steps = len(extents), len(drive)
    for batch in numba.prange((n + BATCH - 1) // BATCH):
        first = batch * BATCH
        alive = min(BATCH, n - first)
        W = np.zeros((BATCH // LANES, _ROWS, LANES), np.float32)
        rows = np.arange(first, first + alive)
        for lane in range(alive):
            row = first + lane
            G, i = W[lane // LANES], lane % LANES
            _place(G, i, extents[row, 0], extents[row, 1], centers[row, 0], centers[row, 1])
            psi = parameters[row, 1]
            G[_ALPHA, i], G[_KAPPA, i] = parameters[row, 0] / c[5], parameters[row, 2]
            G[_PSI, i], G[_SPRING, i] = ONE / psi, psi
        step = 0
        while step < steps and alive > 0:
            end = min(step + TILE, steps)
            for group in range((alive + LANES - 1) // LANES):
                _project_tile(W[group], drive, step, end, c)
            step = end
            alive = _compact(W, rows, alive, out)
        for lane in range(alive):
            G, i = W[lane // LANES], lane % LANES
            _arrive(G, i, rows[lane], _least_project(G, i, drive, c), out)
