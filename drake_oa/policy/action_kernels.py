"""One step of the whole action level, compiled.

What `drake_oa.policy.dmp.step` and `drake_oa.policy.coupling` do readably, and the holds, the
temporal scaling and the guidance of `drake_oa.policy.action`, on flat arrays whose layout is given
here.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid_kernels import first_inside
from drake_oa.policy.coupling_kernels import (
    GUIDANCE_ALPHA,
    HEADING,
    N_COLUMNS,
    NORMAL,
    rotate,
    turn_step,
)
from drake_oa.policy.guidance import guide

P, Z, PHASE, SPEED, STAMP = 0, 3, 6, 7, 8
"""Where a motion holds the policy at its beginning: p_WE, z_W, k, ds/dt, time."""
END = 9
"""Where the same of its end begins."""
TAU, START, GOAL, FRAME = 18, 19, 22, 25
"""Where it holds tau, p_WS, p_WG and R_WL (row by row)."""
V, V_END, DRIFT, ACCELERATION = 34, 37, 40, 43
"""Where it holds both velocities, and the coefficients of its interpolation."""
EVASION, EVASION_END = 46, 49
"""Where it holds the velocities at both ends by which it is displaced besides."""
N_MOTION = 52
"""Length of a motion."""

ALPHA_X, BETA_X, ALPHA_K, DURATION = 0, 1, 2, 3
GUIDANCE_GAIN, FADE, MAX_AGE, HOLD_TIME, PRINTED, MAX_RATE = 4, 5, 6, 7, 8, 9
"""Where the constants of movement primitive and action level are."""
N_CONSTANTS = 10
"""Number of constants."""

SEEN, OBSERVED, BLOCKED, PATH_LENGTH, GIVEN_TAU, COUPLES, IN_PLANE = 0, 1, 2, 3, 4, 5, 6
"""Where the facts are: whether obstacles are looked for, when they were seen, whether no way
past them is known, the route's length (negative: no route), the asked tau (0: none), whether
there are coupling terms, and whether they act in the planes of their normals."""
N_FACTS = 7
"""Number of facts."""

P_WO, SEMI_AXES, ABOUT, PASSING_NORMAL, DESIRED, DIRECTION, FOOT = 0, 1, 2, 3, 4, 5, 6
"""Blocks (M, 3): ellipsoids, what the terms act about, their normals and headings; and the
route's directions and centres."""
N_BLOCKS = 7
"""Number of blocks."""

FREE, UNOBSERVED, OUTDATED, FORBIDDEN, INSIDE = 0, 1, 2, 3, 4
"""Reasons to hold; INSIDE + 2 row: the tool is inside that obstacle, one more: the goal."""
GOAL_MOVED, BAD_STEP = -1, -2
"""Why no step was taken."""


@njit(cache=True, error_model="numpy")
def spring_flow(alpha_x: float, beta_x: float, step: float) -> tuple[float, float, float, float]:
    """See `drake_oa.policy.dmp.spring_flow`."""
    stiffness, half = alpha_x * beta_x, 0.5 * alpha_x
    square = half * half - stiffness
    if abs(square) <= 1e-14 * half * half:
        cosine = math.exp(-half * step)
        sine = cosine * step
    elif square < 0.0:
        omega = math.sqrt(-square)
        decay = math.exp(-half * step)
        cosine = decay * math.cos(omega * step)
        sine = decay * math.sin(omega * step) / omega
    else:
        omega = math.sqrt(square)
        slow = math.exp(-step * stiffness / (half + omega))
        fast = math.exp(-step * (half + omega))
        cosine = 0.5 * (slow + fast)
        sine = 0.5 * (slow - fast) / omega
    return cosine + half * sine, sine, -stiffness * sine, cosine - half * sine


@njit(cache=True, error_model="numpy")
def forcing(basis: FloatArray, k: float) -> tuple[float, float, float]:
    """Forcing term at phase k in the local frame, see `drake_oa.policy.dmp.Dmp.forcing`.

    Args:
        basis: (5, N) centres, widths and three rows of weights.
        k: phase.
    """
    most = 0.0
    for attempt in range(2):
        x = y = z = total = 0.0
        least = math.inf
        for i in range(basis.shape[1]):
            offset = k - basis[0, i]
            exponent = basis[1, i] * offset * offset
            least = min(least, exponent)
            weight = math.exp(most - exponent)
            total += weight
            x += basis[2, i] * weight
            y += basis[3, i] * weight
            z += basis[4, i] * weight
        if attempt == 1 or total >= 1e-200:
            break
        # Far from every centre: the quotient exists, its parts underflow.
        most = least
    share = k / total
    return x * share, y * share, z * share


@njit(cache=True, error_model="numpy")
def goal_fade(distance_squared: float, baseline: float, fade: float) -> float:
    """See `drake_oa.policy.action.goal_fade`."""
    reach = fade * baseline
    return min(1.0, distance_squared / (reach * reach)) ** 2 if reach > 0.0 else 1.0


@njit(cache=True, error_model="numpy")
def hold_code(
    p_WE: FloatArray,
    p_WG: FloatArray,
    facts: FloatArray,
    blocks: FloatArray,
    R_WO: FloatArray,
    time: float,
    max_age: float,
) -> int:
    """Why the motion must not go on now, as a number: see `drake_oa.policy.action.hold_reason`."""
    if facts[SEEN] == 0.0:
        return FREE
    if facts[OBSERVED] == -math.inf:
        return UNOBSERVED
    if time - facts[OBSERVED] > max_age:
        return OUTDATED
    if facts[BLOCKED] != 0.0:
        return FORBIDDEN
    row = first_inside(p_WE, blocks[P_WO], R_WO, blocks[SEMI_AXES])
    if row >= 0:
        return INSIDE + 2 * row
    row = first_inside(p_WG, blocks[P_WO], R_WO, blocks[SEMI_AXES])
    if row >= 0:
        return INSIDE + 2 * row + 1
    return FREE


@njit(cache=True, error_model="numpy")
def _terms(
    motion: FloatArray,
    parameters: FloatArray,
    clearance: FloatArray,
    blocks: FloatArray,
    R_WO: FloatArray,
    B: FloatArray,
    fade: float,
    guidance_gain: float,
) -> FloatArray:
    """Rows for `turn_step` at the beginning of a motion: alpha faded, headings led."""
    count = len(parameters)
    terms, heading = np.empty((count, N_COLUMNS)), blocks[DESIRED].copy()
    for row in range(count):
        alpha = parameters[row, 0] * fade
        terms[row, 3] = alpha
        terms[row, 4] = parameters[row, 1]
        terms[row, 5] = parameters[row, 2]
        terms[row, GUIDANCE_ALPHA] = min(alpha, guidance_gain)
        for k in range(3):
            terms[row, k] = blocks[ABOUT, row, k]
            terms[row, NORMAL + k] = blocks[PASSING_NORMAL, row, k]
    guide(
        motion[P : P + 3],
        motion[Z : Z + 3],
        motion[GOAL : GOAL + 3],
        motion[FRAME : FRAME + 9],
        blocks[FOOT],
        blocks[PASSING_NORMAL],
        blocks[DIRECTION],
        clearance,
        blocks[P_WO],
        R_WO,
        blocks[SEMI_AXES],
        B,
        heading,
    )
    terms[:, HEADING : HEADING + 3] = heading
    return terms


@njit(cache=True, error_model="numpy")
def take_steps(
    before: FloatArray,
    gx: float,
    gy: float,
    gz: float,
    constants: FloatArray,
    basis: FloatArray,
    facts: FloatArray,
    parameters: FloatArray,
    clearance: FloatArray,
    blocks: FloatArray,
    R_WO: FloatArray,
    B: FloatArray,
    scale: float,
    evasion: FloatArray,
    time: float,
    step: float,
    count: int,
    after: FloatArray,
) -> int:
    """Takes steps of the policy one after the other, see `drake_oa.policy.action.advance`.

    Args:
        before: (52,) the motion of the step before; its end is where the first one begins.
        gx, gy, gz: goal [m].
        constants: (10,) of movement primitive and action level.
        basis: (5, N) centres, widths and weights of the basis functions.
        facts: (7,) about perception, route and coupling.
        parameters: (M, 3) rows alpha, psi, kappa.
        clearance: (M,) clearances that the route keeps [m]; 0: it does not guide.
        blocks: (7, M, 3) of the obstacles.
        R_WO: (M, 3, 3) rotations of the ellipsoids.
        B: (M, 3, 3) their shape matrices [m^2].
        scale: share of full speed, 1 / (tau T), at which the motion is to go.
        evasion: (3,) velocity by which it is displaced besides, at the end of the first
            step and after [m/s].
        time: now [s].
        step: length of a step [s].
        count: how many steps, at least 1.
        after: (52,) the motion of the last step, to be filled.

    Returns:
        The reason to hold the motion in the last step; GOAL_MOVED or BAD_STEP if one
        could not be taken.
    """
    motion, code = before.copy(), FREE
    for i in range(count):
        if i > 0:
            motion[:] = after
            time = motion[END + STAMP]
        code = _take_step(
            motion,
            gx,
            gy,
            gz,
            constants,
            basis,
            facts,
            parameters,
            clearance,
            blocks,
            R_WO,
            B,
            scale,
            evasion,
            time,
            step,
            after,
        )
        if code < FREE:
            break
    return code


@njit(cache=True, error_model="numpy")
def _take_step(
    before: FloatArray,
    gx: float,
    gy: float,
    gz: float,
    constants: FloatArray,
    basis: FloatArray,
    facts: FloatArray,
    parameters: FloatArray,
    clearance: FloatArray,
    blocks: FloatArray,
    R_WO: FloatArray,
    B: FloatArray,
    scale: float,
    evasion: FloatArray,
    time: float,
    step: float,
    after: FloatArray,
) -> int:
    """One of `take_steps`."""
    if before[GOAL] != gx or before[GOAL + 1] != gy or before[GOAL + 2] != gz:
        return GOAL_MOVED
    for i in range(STAMP):
        after[i] = before[END + i]
    after[STAMP] = time
    for i in range(START, FRAME + 9):
        after[i] = before[i]
    code = hold_code(
        after[P : P + 3],
        after[GOAL : GOAL + 3],
        facts,
        blocks,
        R_WO,
        time,
        constants[MAX_AGE],
    )
    square = distance = 0.0
    for i in range(3):
        square += (after[GOAL + i] - after[START + i]) ** 2
        distance += (after[GOAL + i] - after[P + i]) ** 2
    baseline = math.sqrt(square)
    tau = before[TAU]
    if facts[GIVEN_TAU] > 0.0:
        tau = facts[GIVEN_TAU]
    elif facts[PATH_LENGTH] >= 0.0:
        tau = max(1.0, facts[PATH_LENGTH] / baseline)
    after[TAU] = tau
    duration = constants[DURATION]
    target = 0.0 if code != FREE else scale / (tau * duration)
    most = step / (duration * constants[HOLD_TIME])
    speed = after[SPEED] + min(max(target - after[SPEED], -most), most)
    ds = 0.5 * (after[SPEED] + speed) * step
    if not 0.0 <= ds < math.inf:
        return BAD_STEP
    after[END + SPEED] = speed
    after[END + STAMP] = time + step
    if ds == 0.0:
        for i in range(SPEED):
            after[END + i] = after[i]
    else:
        alpha_k = constants[ALPHA_K]
        stiffness = constants[ALPHA_X] * constants[BETA_X]
        middle = after[PHASE] * math.exp(-0.5 * alpha_k * ds)
        after[END + PHASE] = after[PHASE] * math.exp(-alpha_k * ds)
        fx, fy, fz = forcing(basis, middle)
        scale = baseline / stiffness
        # Where the spring is at rest; the place is filled with what belongs there below.
        rest = after[DRIFT : DRIFT + 3]
        for i in range(3):
            row = FRAME + 3 * i
            force = after[row] * fx + after[row + 1] * fy + after[row + 2] * fz
            rest[i] = after[GOAL + i] + force * scale
        couples = facts[COUPLES] != 0.0
        half = 0.5 * ds if couples else ds
        a, b, c, d = spring_flow(constants[ALPHA_X], constants[BETA_X], half)
        _spring(after[P:PHASE], rest, a, b, c, d, after[END : END + PHASE])
        if couples:
            terms = _terms(
                after,
                parameters,
                clearance,
                blocks,
                R_WO,
                B,
                goal_fade(distance, baseline, constants[FADE]),
                constants[GUIDANCE_GAIN],
            )
            end = after[END : END + PHASE]
            wx, wy, wz = turn_step(
                terms,
                facts[IN_PLANE] != 0.0,
                constants[PRINTED] != 0.0,
                constants[MAX_RATE],
                end[0],
                end[1],
                end[2],
                end[3],
                end[4],
                end[5],
                ds,
            )
            end[3], end[4], end[5] = rotate(end[3], end[4], end[5], wx, wy, wz)
            _spring(end, rest, a, b, c, d, end)
    for i in range(3):
        begin, end_of = before[EVASION_END + i], evasion[i]
        after[EVASION + i], after[EVASION_END + i] = begin, end_of
        if begin != 0.0 or end_of != 0.0:
            after[END + P + i] += 0.5 * (begin + end_of) * step
    _interpolation(after)
    return code


@njit(cache=True, error_model="numpy")
def _spring(
    begin: FloatArray, rest: FloatArray, a: float, b: float, c: float, d: float, end: FloatArray
) -> None:
    """Position and velocity (6,) after the flow (a, b, c, d) of the spring toward rest (3,)."""
    for i in range(3):
        e, z = begin[i] - rest[i], begin[i + 3]
        end[i] = rest[i] + a * e + b * z
        end[i + 3] = c * e + d * z


@njit(cache=True, error_model="numpy")
def _interpolation(motion: FloatArray) -> None:
    """Fills velocities and coefficients from the policy at both ends."""
    length = motion[END + STAMP] - motion[STAMP]
    for i in range(3):
        v = motion[SPEED] * motion[Z + i] + motion[EVASION + i]
        v_end = motion[END + SPEED] * motion[END + Z + i] + motion[EVASION_END + i]
        motion[V + i], motion[V_END + i] = v, v_end
        motion[DRIFT + i], motion[ACCELERATION + i] = v, 0.0
        if length > 0.0:
            mean = (motion[END + P + i] - motion[P + i]) / length
            motion[DRIFT + i] = v + (mean - 0.5 * (v + v_end))
            motion[ACCELERATION + i] = (v_end - v) / length


@njit(cache=True, error_model="numpy")
def interpolate(motion: FloatArray, time: float, derivative: int) -> FloatArray:
    """See `drake_oa.policy.action.Segment.interpolate`."""
    length = motion[END + STAMP] - motion[STAMP]
    since = min(max(time - motion[STAMP], 0.0), length)
    beyond = time - motion[END + STAMP] if length > 0.0 else 0.0
    value = np.zeros(3)
    for i in range(3):
        acceleration = motion[ACCELERATION + i]
        if derivative == 0:
            value[i] = motion[P + i] + since * (motion[DRIFT + i] + 0.5 * since * acceleration)
            if beyond > 0.0:
                value[i] += beyond * motion[V_END + i]
        elif derivative == 1:
            value[i] = motion[V + i] + since * acceleration
        elif beyond <= 0.0:
            value[i] = acceleration
    return value
