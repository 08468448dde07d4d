"""Compiled arithmetic behind `drake_oa.policy.orientation_dmp`; call its functions instead.

r is the rotation vector from the start's orientation: R_WE = R_WS exp([r]). Along r(t),

    w_S = r' + a r x r' + b r x (r x r'),   a = (1 - cos |r|) / |r|^2,
                                            b = (|r| - sin |r|) / |r|^3,

the left Jacobian of the exponential map applied to r', is the angular velocity in S.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.rotation import rotation_of
from drake_oa.policy.action_kernels import spring_flow

# A motion between two steps of the policy: when it begins and how long it is, r and its rate
# at both ends, and the turn about the fixed axis: angle, rate, acceleration.
BEGIN, LENGTH, R, RATE, R_END, RATE_END, TURN, TURN_RATE, TURN_ACCELERATION = (
    0,
    1,
    2,
    5,
    8,
    11,
    14,
    15,
    16,
)
N_MOTION = 17

SUB_STEP = 5e-4
"""Forcing is held for this long, in normalised time: what it leaves of a saw-tooth in the
acceleration falls with its square."""

# What is evaluated of it at one instant.
QUATERNION, W, ALPHA, TURN_NOW = 0, 4, 7, 10
N_EVALUATED = 11


@njit(cache=True, error_model="numpy")
def forcing(basis: FloatArray, k: float) -> tuple[float, float, float, float]:
    """The four forcing terms at phase k, see `drake_oa.policy.dmp.Dmp.forcing`.

    Args:
        basis: (6, N) centres, widths and four rows of weights.
        k: phase.
    """
    most = 0.0
    for attempt in range(2):
        w = x = y = z = total = 0.0
        least = math.inf
        for i in range(basis.shape[1]):
            offset = k - basis[0, i]
            exponent = basis[1, i] * offset * offset
            least = min(least, exponent)
            weight = math.exp(most - exponent)
            total += weight
            w += basis[2, i] * weight
            x += basis[3, i] * weight
            y += basis[4, i] * weight
            z += basis[5, i] * weight
        if attempt == 1 or total >= 1e-200:
            break
        # Far from every centre: the quotient exists, its parts underflow.
        most = least
    share = k / total
    return w * share, x * share, y * share, z * share


@njit(cache=True, error_model="numpy")
def take_step(
    state: FloatArray, goal: FloatArray, constants: FloatArray, basis: FloatArray, ds: float
) -> None:
    """A step over ds of normalised time, in place, see `drake_oa.policy.orientation_dmp.step`.

    Args:
        state: (7,) r, z = dr/ds and the phase k.
        goal: (3,) rotation vector of the goal.
        constants: (3,) alpha_x, beta_x, alpha_k.
        basis: as in `forcing`.
        ds: at least 0.
    """
    alpha, beta, decay = constants
    count = max(math.ceil(ds / SUB_STEP - 1e-9), 1)
    part = ds / count
    a, b, c, d = spring_flow(alpha, beta, part)
    own = np.empty(3)
    for _ in range(count):
        share, own[0], own[1], own[2] = forcing(basis, state[6] * math.exp(-0.5 * decay * part))
        for i in range(3):
            rest = goal[i] + (share * goal[i] + own[i]) / (alpha * beta)
            e, z = state[i] - rest, state[3 + i]
            state[i] = rest + a * e + b * z
            state[3 + i] = c * e + d * z
        state[6] *= math.exp(-decay * part)


@njit(cache=True, error_model="numpy")
def roll(
    goal: FloatArray, constants: FloatArray, basis: FloatArray, s: FloatArray, step: float
) -> FloatArray:
    """(T, 6) r and dr/ds at normalised times s (T,), rising, from rest at s = 0.

    The steps are of the length `step`, but for those that end at an asked time.
    """
    samples = np.empty((len(s), 6))
    state = np.zeros(7)
    state[6] = 1.0
    now = 0.0
    for row in range(len(s)):
        count = math.ceil((s[row] - now) / step - 1e-9)
        for left in range(count, 0, -1):
            ds = min(step, s[row] - now) if left > 1 else s[row] - now
            take_step(state, goal, constants, basis, ds)
            now += ds
        now = max(now, s[row])
        samples[row] = state[:6]
    return samples


@njit(cache=True, error_model="numpy")
def exponential(r: FloatArray) -> FloatArray:
    """Quaternion (4,) of a rotation vector (3,), continuous in it over every angle."""
    angle = math.sqrt(r[0] ** 2 + r[1] ** 2 + r[2] ** 2)
    scale = math.sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    return np.array([math.cos(0.5 * angle), scale * r[0], scale * r[1], scale * r[2]])


@njit(cache=True, error_model="numpy")
def product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Product of two quaternions (4,)."""
    return np.array(
        [
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        ]
    )


@njit(cache=True, error_model="numpy")
def cross(u: FloatArray, v: FloatArray) -> FloatArray:
    """u x v of (3,)."""
    return np.array(
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    )


@njit(cache=True, error_model="numpy")
def angular_motion(r: FloatArray, dr: FloatArray, ddr: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angular velocity and acceleration in S, of a rotation vector and its derivatives (3,)."""
    square = r[0] ** 2 + r[1] ** 2 + r[2] ** 2
    if square > 1e-3:
        angle = math.sqrt(square)
        a = (1.0 - math.cos(angle)) / square
        b = (angle - math.sin(angle)) / (square * angle)
        # Derivatives of a and b by |r|, over |r|.
        da = (math.sin(angle) / angle - 2.0 * a) / square
        db = (a - 3.0 * b) / square
    else:
        a = 0.5 - square / 24.0 * (1.0 - square / 30.0)
        b = 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0)
        da = -1.0 / 12.0 + square / 180.0 * (1.0 - square / 56.0)
        db = -1.0 / 60.0 + square / 1260.0 * (1.0 - square / 72.0)
    radial = r[0] * dr[0] + r[1] * dr[1] + r[2] * dr[2]
    once, twice = cross(r, dr), cross(r, cross(r, dr))
    w = dr + a * once + b * twice
    alpha = (
        ddr
        + da * radial * once
        + a * cross(r, ddr)
        + db * radial * twice
        + b * (cross(dr, once) + cross(r, cross(r, ddr)))
    )
    return w, alpha


@njit(cache=True, error_model="numpy")
def evaluate(motion: FloatArray, start: FloatArray, axis_W: FloatArray, time: float) -> FloatArray:
    """(11,) quaternion, w_WE, alpha_WE and turn at a time of a motion.

    r is the cubic between the ends, the turn a parabola; after its end both go on at their
    last rate.

    Args:
        motion: (17,) as laid out above.
        start: (4,) quaternion of R_WS.
        axis_W: (3,) unit axis of the turn.
        time: [s].
    """
    length = motion[LENGTH]
    since = min(max(time - motion[BEGIN], 0.0), length)
    beyond = time - motion[BEGIN] - length
    if beyond < 1e-9:
        # Rounding, which must not end the acceleration at the end of a step.
        beyond = 0.0
    r, dr, ddr = np.empty(3), np.empty(3), np.zeros(3)
    for i in range(3):
        r[i], dr[i] = motion[R_END + i], motion[RATE_END + i]
        if beyond > 0.0 or length == 0.0:
            r[i] += beyond * dr[i]
            continue
        u = since / length
        jump = motion[R_END + i] - motion[R + i]
        v, v_end = length * motion[RATE + i], length * motion[RATE_END + i]
        square, cube = 3.0 * jump - 2.0 * v - v_end, v + v_end - 2.0 * jump
        r[i] = motion[R + i] + u * (v + u * (square + u * cube))
        dr[i] = (v + u * (2.0 * square + 3.0 * u * cube)) / length
        ddr[i] = (2.0 * square + 6.0 * u * cube) / (length * length)
    acceleration = motion[TURN_ACCELERATION]
    rate = motion[TURN_RATE] + acceleration * since
    turn = motion[TURN] + since * (motion[TURN_RATE] + 0.5 * since * acceleration)
    turn += beyond * rate
    if beyond > 0.0:
        acceleration = 0.0
    placed = product(exponential(turn * axis_W), start)
    w_S, alpha_S = angular_motion(r, dr, ddr)
    R_WS = rotation_of(placed)
    out = np.empty(N_EVALUATED)
    out[QUATERNION : QUATERNION + 4] = product(placed, exponential(r))
    w, alpha = np.zeros(3), np.zeros(3)
    for i in range(3):
        for j in range(3):
            w[i] += R_WS[i, j] * w_S[j]
            alpha[i] += R_WS[i, j] * alpha_S[j]
    # R = R_turn R_dmp: w = turn' axis + R_turn w_dmp, and its derivative.
    out[ALPHA : ALPHA + 3] = acceleration * axis_W + alpha + rate * cross(axis_W, w)
    out[W : W + 3] = rate * axis_W + w
    out[TURN_NOW] = turn
    return out


@njit(cache=True, error_model="numpy")
def turn_acceleration(
    turn: float, rate: float, wanted: float, step: float, most_rate: float, most: float
) -> float:
    """Acceleration over a step that brings a turn to where it is wanted [rad/s^2].

    A critically damped spring, bounded in rate and acceleration. Its frequency is
    2 most / most_rate: from the largest rate it then brakes with 2 / e of `most` at worst,
    so that the bound never makes it overshoot a turn that is wanted for good.

    Args:
        turn: angle now [rad].
        rate: now [rad/s].
        wanted: angle [rad].
        step: [s], positive.
        most_rate: bound of the rate [rad/s].
        most: bound of the acceleration [rad/s^2].
    """
    frequency = 2.0 * most / most_rate
    flow = spring_flow(2.0 * frequency, 0.5 * frequency, step)
    after = flow[2] * (turn - wanted) + flow[3] * rate
    after = min(max(after, -most_rate), most_rate)
    return min(max((after - rate) / step, -most), most)
