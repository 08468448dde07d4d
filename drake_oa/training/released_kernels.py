"""Compiled roll-outs of the released code's motion, many lanes at a time.

The motion is that of `drake_oa.training.released_code`, in the plane, around an ellipse in the
middle of a baseline of 1. Until the coupling term reaches `_ASLEEP` it is a straight
line that is known in closed form: a row starts at the first step where the term acts,
and a row that touches before the term can turn it aside takes no step at all.

A thread keeps `LANES` rows in hand. Each counts its own steps, and gives its place to
the next row when it ends. A step is several short loops over the lanes: the processor
overlaps one vector's latency with the next only where the loop's body is short.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from drake_oa.regulation.lane_math import (
    HALF,
    ONE,
    ROOT_HALF,
    TINY,
    TWO,
    ZERO,
    Single,
    angle,
    exp_negative,
    widest_vectors,
)
from drake_oa.training.planar_kernels import (
    BIG,
    LEAST_FOOT,
    LEAST_RATE,
    Constants,
    SingleArray,
    jit,
    least_between,
    nearer_foot,
    parallel,
)

Lanes = NDArray[np.float32] | NDArray[np.float64]

LANES = 64
"""Rows that one thread advances together."""

LONGEST_TILE = 16
"""Steps between two looks at which rows have ended, at most."""

CHUNK = 16384
"""Rows that one thread takes at a time, at most."""

CERTAIN_TURN, CERTAIN_SHIFT = 0.05, 0.2
"""A row is sure to touch if at nine tenths of the half length from the centre it has
turned by less than this [rad], and moved aside by less than this much of the half width;
the ellipse is 0.44 of its width there."""

_ASLEEP = 1e-5  # 1/s; a weaker term turns the motion by 1e-6 rad in all.
_DEEP = 0.9

# Rows of the lanes' state.
_X, _Y, _VX, _VY, _LENGTH, _STEP, _TX, _TY = (k * LANES for k in range(8))
_LEAST, _LEAST_X, _LEAST_Y, _LEAST_VX, _LEAST_VY, _LEAST_STEP = (k * LANES for k in range(8, 14))
_ALPHA, _PSI, _KAPPA, _STIFFNESS, _DAMPING = (k * LANES for k in range(14, 19))
_A, _B, _INVERSE_A, _INVERSE_B, _EVOLUTE_X, _EVOLUTE_Y = (k * LANES for k in range(19, 25))
_TOUCHED, _EXPONENT = (k * LANES for k in range(25, 27))
_SIZE = 27 * LANES

# Columns of the rows that wait for a lane.
_WAITING = 8
_AWAY = Single(-1e6)

Motion = tuple[float, float, float, float, float, float]


# --- the straight motion ----------------------------------------------------------------


@numba.njit(cache=True)
def straight_motion(b: float, c: tuple[float, ...]) -> Motion:
    """Closed form of the motion without coupling: its offset, slope, rates and parts.

    Args:
        b: semi-axis across the baseline, which sets tau [m].
        c: step, stiffness, damping, first forcing term, its growth a step.

    Returns:
        r, q, l1, l2, c1, c2 with x(k) = r + q k + c1 exp(l1 k) + c2 exp(l2 k); c1 is NaN
        where the spring is not overdamped and no such form exists.
    """
    tau = math.sqrt(1.0 + 4.0 * b * b) + 0.1
    stiffness, damping = tau * tau * c[1], tau * tau * c[2]
    h = c[0]
    q = c[4] / stiffness
    r = 1.0 + (c[3] - damping * q / h) / stiffness
    mean = 1.0 - 0.5 * (damping * h + stiffness * h * h)
    root2 = mean * mean - (1.0 - damping * h)
    if not (root2 > 1e-9 and damping * h < 1.0 and mean > 0.0):
        return r, q, 0.0, 0.0, math.nan, math.nan
    f1, f2 = mean + math.sqrt(root2), mean - math.sqrt(root2)
    # From rest: x(0) = 0 and x(-1) = 0.
    now, before = -r, q - r
    c1 = (before - now / f2) / (1.0 / f1 - 1.0 / f2)
    return r, q, math.log(f1), math.log(f2), c1, now - c1


@numba.njit(cache=True)
def straight_state(m: Motion, step: int, h: float) -> tuple[float, float]:
    """Position and velocity along the baseline after `step` steps of length h."""
    u, w = m[4] * math.exp(m[2] * step), m[5] * math.exp(m[3] * step)
    x = m[0] + m[1] * step + u + w
    return x, (m[1] - u * math.expm1(-m[2]) - w * math.expm1(-m[3])) / h


@numba.njit(cache=True)
def _first_beyond(m: Motion, x: float, steps: int) -> int:
    """The first step after which the straight motion is beyond x; steps + 1: none."""
    low, high = 0, steps + 1
    while high - low > 1:
        middle = (low + high) // 2
        at = m[0] + m[1] * middle + m[4] * math.exp(m[2] * middle) + m[5] * math.exp(m[3] * middle)
        if at > x:
            high = middle
        else:
            low = middle
    return high


@numba.njit(cache=True)
def entry(
    a: float, b: float, alpha: float, kappa: float, m: Motion, steps: int, tile: int, h: float
) -> int:
    """Step at which the row is to start, a multiple of `tile`; -1: it is sure to touch.

    Args:
        a: semi-axis along the baseline [m].
        b: semi-axis across it [m].
        alpha: [1/s].
        kappa: [1/m^2].
        m: what `straight_motion` returned.
        steps: number of steps.
        tile: number of steps between two looks.
        h: length of a step [s].

    Returns:
        The step.
    """
    # The velocity is zero at the start and has at most one more zero.
    if not (a < 0.5 and straight_state(m, 1, h)[1] > 0.0):
        return 0
    awake = 0.0
    if alpha > _ASLEEP:
        awake = math.sqrt(math.log(alpha / _ASLEEP) / kappa) if kappa > 0.0 else 1.0
    if awake >= 0.5:
        return 0
    first = _first_beyond(m, 0.5 - awake, steps) - 1
    before, speed = straight_state(m, first, h)
    if not speed > 0.0:
        return 0
    deep = _first_beyond(m, 0.5 - _DEEP * a, steps)
    if deep <= steps:
        x, at_deep = straight_state(m, deep, h)
        left = 0.5 - x
        if left > 0.0 and at_deep > 0.0:
            if deep <= first:
                return -1
            # The velocity has one extremum, so the lesser end is its least.
            slow, fall = min(speed, at_deep), 2.0 * kappa * left
            turn = alpha * math.exp(-kappa * left * left) * (1.0 / (fall * slow) + h)
            shift = turn * (1.0 / fall + h * max(speed, at_deep))
            if turn < CERTAIN_TURN and shift < CERTAIN_SHIFT * b:
                return -1
    # It must not touch before it starts.
    while first > 0 and before > 0.5 - a - 1e-3:
        first -= tile
        if first > 0:
            before = straight_state(m, first, h)[0]
    return max(first - first % tile, 0)


# --- lanes ------------------------------------------------------------------------------


@jit
def _advance(S: Lanes, count: int, c: Constants) -> None:
    """Takes all lanes `count` steps on."""
    widest_vectors()
    h, first_drive, growth = c[0], c[3], c[4]
    for _ in range(count):
        for i in range(LANES):
            dx, y, vx, vy = HALF - S[_X + i], S[_Y + i], S[_VX + i], S[_VY + i]
            cross = -vx * y - vy * dx
            theta = angle(abs(cross), vx * dx - vy * y)
            u = theta * theta * S[_PSI + i] + S[_KAPPA + i] * (dx * dx + y * y)
            S[_EXPONENT + i] = -u
        for i in range(LANES):
            x, y, vx, vy = S[_X + i], S[_Y + i], S[_VX + i], S[_VY + i]
            step = S[_STEP + i]
            push = S[_ALPHA + i] * exp_negative(S[_EXPONENT + i]) + LEAST_RATE
            push = -push if -vx * y - vy * (HALF - x) > ZERO else push
            stiffness, damping = S[_STIFFNESS + i], S[_DAMPING + i]
            drive = first_drive + growth * step
            ax = stiffness * (ONE - x) - damping * vx + drive - push * vy
            ay = push * vx - stiffness * y - damping * vy
            vx += h * ax
            vy += h * ay
            S[_X + i] = x + h * vx
            S[_Y + i] = y + h * vy
            S[_VX + i] = vx
            S[_VY + i] = vy
            S[_STEP + i] = step + ONE
            speed2 = vx * vx + vy * vy
            S[_LENGTH + i] += speed2 * (ONE / math.sqrt(speed2 + TINY))
        for i in range(LANES):
            px, py = abs(S[_X + i] - HALF), abs(S[_Y + i])
            tx, ty = nearer_foot(
                px, py, S[_A + i], S[_B + i], S[_EVOLUTE_X + i], S[_EVOLUTE_Y + i],
                S[_INVERSE_A + i], S[_INVERSE_B + i], S[_TX + i], S[_TY + i],
            )  # fmt: skip
            S[_TX + i], S[_TY + i] = tx, ty
        for i in range(LANES):
            x, y, vx, vy = S[_X + i], S[_Y + i], S[_VX + i], S[_VY + i]
            step = S[_STEP + i]
            px, py = abs(x - HALF), abs(y)
            ux, uy = px * S[_INVERSE_A + i], py * S[_INVERSE_B + i]
            hx, hy = px - S[_A + i] * S[_TX + i], py - S[_B + i] * S[_TY + i]
            distance = hx * hx + hy * hy
            distance = -ONE if ux * ux + uy * uy < S[_TOUCHED + i] else distance
            if distance < S[_LEAST + i]:
                S[_LEAST + i] = distance
                S[_LEAST_X + i] = x
                S[_LEAST_Y + i] = y
                S[_LEAST_VX + i] = vx
                S[_LEAST_VY + i] = vy
                S[_LEAST_STEP + i] = step


@jit
def _start(S: Lanes, i: int, w: Lanes, c: Constants, band: Single) -> None:
    """Puts a waiting row (a, b, alpha, psi, kappa, step, x, vx) into lane i."""
    a, b, psi, step, x, vx = w[0], w[1], w[3], w[5], w[6], w[7]
    tau = math.sqrt(ONE + TWO * TWO * b * b) + 0.1
    S[_ALPHA + i], S[_PSI + i], S[_KAPPA + i] = w[2], ONE / (psi * psi), w[4]
    S[_STIFFNESS + i], S[_DAMPING + i] = tau * tau * c[1], tau * tau * c[2]
    S[_A + i], S[_B + i], S[_INVERSE_A + i], S[_INVERSE_B + i] = a, b, ONE / a, ONE / b
    S[_EVOLUTE_X + i], S[_EVOLUTE_Y + i] = (a * a - b * b) / a, (b * b - a * a) / b
    inside = ONE - band / min(a, b)
    S[_TOUCHED + i] = inside * inside if inside > ZERO else ZERO
    S[_X + i], S[_Y + i], S[_VX + i], S[_VY + i] = x, ZERO, vx, ZERO
    S[_STEP + i], S[_LENGTH + i] = step, x / c[0]
    # On the baseline, before the ellipse, its vertex is the nearest point.
    S[_TX + i], S[_TY + i] = ONE, LEAST_FOOT
    gap = HALF - a - x
    S[_LEAST + i] = gap * gap if step > ZERO else BIG
    S[_LEAST_X + i], S[_LEAST_Y + i] = x, ZERO
    S[_LEAST_VX + i], S[_LEAST_VY + i], S[_LEAST_STEP + i] = vx, ZERO, step


@jit
def _distance(S: Lanes, i: int, x: Single, y: Single) -> float:
    """Signed distance to the lane's ellipse, negative inside."""
    a, b, inverse_a, inverse_b = S[_A + i], S[_B + i], S[_INVERSE_A + i], S[_INVERSE_B + i]
    px, py = abs(x - HALF), abs(y)
    tx = ty = ROOT_HALF
    for _ in range(8):
        tx, ty = nearer_foot(
            px, py, a, b, S[_EVOLUTE_X + i], S[_EVOLUTE_Y + i], inverse_a, inverse_b, tx, ty
        )
    hx, hy = px - a * tx, py - b * ty
    size = math.sqrt(hx * hx + hy * hy)
    ux, uy = px * inverse_a, py * inverse_b
    return -size if ux * ux + uy * uy < ONE else size


@jit
def _clearance(S: Lanes, i: int, steps: int, c: Constants, between: bool) -> float:
    x, y, vx, vy = S[_LEAST_X + i], S[_LEAST_Y + i], S[_LEAST_VX + i], S[_LEAST_VY + i]
    nearest = _distance(S, i, x, y)
    step = S[_LEAST_STEP + i]
    if not between or step >= Single(steps):
        return nearest
    h = c[0]
    before = _distance(S, i, x - h * vx, y - h * vy)
    dx = HALF - x
    cross = -vx * y - vy * dx
    theta = angle(abs(cross), vx * dx - vy * y)
    u = theta * theta * S[_PSI + i] + S[_KAPPA + i] * (dx * dx + y * y)
    push = S[_ALPHA + i] * exp_negative(-u) + LEAST_RATE
    push = -push if cross > ZERO else push
    stiffness, damping = S[_STIFFNESS + i], S[_DAMPING + i]
    drive = c[3] + c[4] * step
    ax = stiffness * (ONE - x) - damping * vx + drive - push * vy
    ay = push * vx - stiffness * y - damping * vy
    after = _distance(S, i, x + h * (vx + h * ax), y + h * (vy + h * ay))
    return least_between(before, nearest, after)


@jit
def _run(
    waiting: Lanes, rows: NDArray[np.int64], n: int, steps: int, tile: int, c: Constants,
    band: Single, between: bool, out: Lanes,
) -> None:  # fmt: skip
    """Rolls out n waiting rows, whose places in `out` are `rows`."""
    S = np.zeros(_SIZE, waiting.dtype)
    lane_row = np.full(LANES, -1)
    last = Single(steps)
    taken, live = 0, 0
    for i in range(LANES):
        _start(S, i, waiting[0], c, band)
        # An empty lane ends at once and is filled then.
        S[_LEAST + i], S[_STEP + i] = -ONE, ZERO
    first_look = True
    while first_look or live > 0:
        if not first_look:
            _advance(S, tile, c)
        first_look = False
        for i in range(LANES):
            if S[_LEAST + i] >= ZERO and S[_STEP + i] < last:
                continue
            row = lane_row[i]
            if row >= 0:
                live -= 1
                if S[_LEAST + i] < ZERO:
                    out[0, row], out[1, row], out[2, row] = -ONE, np.inf, np.inf
                else:
                    out[0, row] = _clearance(S, i, steps, c, between)
                    ex, ey = S[_X + i] - ONE, S[_Y + i]
                    out[1, row] = math.sqrt(ex * ex + ey * ey)
                    out[2, row] = S[_LENGTH + i] * c[0]
            if taken < n:
                _start(S, i, waiting[taken], c, band)
                lane_row[i] = rows[taken]
                taken += 1
                live += 1
            else:
                lane_row[i] = -1
                S[_ALPHA + i] = ZERO
                S[_TOUCHED + i] = ZERO
                S[_LEAST + i], S[_STEP + i] = ONE, _AWAY


@numba.njit(cache=True)
def _chunk(n: int) -> int:
    return max(4 * LANES, min(CHUNK, n // 16))


@parallel
def released_batch(
    semi_axes: Lanes, parameters: Lanes, steps: int, tile: int,
    c: tuple[float, ...], lanes_c: Constants, band: Single, between: bool, out: Lanes,
) -> None:  # fmt: skip
    """Rolls out rows of semi-axes and parameters.

    Args:
        semi_axes: (N, 2) along and across the baseline of 1, in its middle.
        parameters: (N, 3) alpha, psi, kappa.
        steps: number of steps.
        tile: number of steps between two looks at which rows have ended; divides steps.
        c: step, alpha_x beta_x, alpha_x, first forcing term, its growth a step.
        lanes_c: the same in the precision of the rows.
        band: a row counts as touching where it is this deep inside the ellipse.
        between: whether clearance is also taken between the samples of the path.
        out: (3, N) signed clearance (negative for a certain contact), goal error, length.
    """
    n = len(semi_axes)
    size = _chunk(n)
    for chunk in numba.prange((n + size - 1) // size):
        waiting = np.empty((size, _WAITING), semi_axes.dtype)
        rows = np.empty(size, np.int64)
        found = 0
        for row in range(chunk * size, min((chunk + 1) * size, n)):
            a, b = semi_axes[row, 0], semi_axes[row, 1]
            alpha, kappa = parameters[row, 0], parameters[row, 2]
            m = straight_motion(float(b), c)
            step = entry(float(a), float(b), float(alpha), float(kappa), m, steps, tile, c[0])
            if step < 0:
                out[0, row], out[1, row], out[2, row] = -ONE, np.inf, np.inf
                continue
            x, v = straight_state(m, step, c[0]) if step > 0 else (0.0, 0.0)
            w = waiting[found]
            w[0], w[1], w[2], w[3], w[4] = a, b, alpha, parameters[row, 1], kappa
            w[5], w[6], w[7] = step, x, v
            rows[found] = row
            found += 1
        if found > 0:
            _run(waiting, rows, found, steps, tile, lanes_c, band, between, out)


@parallel
def released_lattice_batch(
    axes_1: SingleArray, axes_2: SingleArray, alphas: SingleArray, psis: SingleArray,
    kappas: SingleArray, first_row: int, steps: int, tile: int, c: tuple[float, ...],
    lanes_c: Constants, band: Single, between: bool, out: SingleArray,
) -> None:  # fmt: skip
    """As `released_batch` for rows first_row... of a lattice, the last axis fastest."""
    n = out.shape[1]
    n_1, n_2, n_alpha, n_kappa = len(axes_1), len(axes_2), len(alphas), len(kappas)
    n_psi = len(psis)
    # Neither depends on psi.
    entries = np.empty((n_1 * n_2, n_alpha, n_kappa), np.int32)
    states = np.zeros((n_2, steps // tile + 1, 2), np.float32)
    for place in numba.prange(n_1 * n_2):
        a, b = float(axes_1[place // n_2]), float(axes_2[place % n_2])
        m = straight_motion(b, c)
        for i in range(n_alpha):
            for k in range(n_kappa):
                alpha, kappa = float(alphas[i]), float(kappas[k])
                entries[place, i, k] = entry(a, b, alpha, kappa, m, steps, tile, c[0])
        if place < n_2:
            for look in range(1, steps // tile + 1):
                x, v = straight_state(m, look * tile, c[0])
                states[place, look, 0], states[place, look, 1] = x, v
    size = _chunk(n)
    for chunk in numba.prange((n + size - 1) // size):
        waiting = np.empty((size, _WAITING), np.float32)
        rows = np.empty(size, np.int64)
        found = 0
        rest = first_row + chunk * size
        k, rest = rest % n_kappa, rest // n_kappa
        j, rest = rest % n_psi, rest // n_psi
        i, place = rest % n_alpha, rest // n_alpha
        for row in range(chunk * size, min((chunk + 1) * size, n)):
            step = entries[place, i, k]
            if step < 0:
                out[0, row], out[1, row], out[2, row] = -ONE, np.inf, np.inf
            else:
                w = waiting[found]
                w[0], w[1] = axes_1[place // n_2], axes_2[place % n_2]
                w[2], w[3], w[4] = alphas[i], psis[j], kappas[k]
                state = states[place % n_2, step // tile]
                w[5], w[6], w[7] = step, state[0], state[1]
                rows[found] = row
                found += 1
            k += 1
            if k == n_kappa:
                k, j = 0, j + 1
                if j == n_psi:
                    j, i = 0, i + 1
                    if i == n_alpha:
                        i, place = 0, place + 1
        if found > 0:
            _run(waiting, rows, found, steps, tile, lanes_c, band, between, out)
