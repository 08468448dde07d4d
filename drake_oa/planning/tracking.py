"""The joints of an arm along a path of its tool: differential inverse kinematics, compiled.

From pose to pose two Gauss-Newton steps, damped where the arm is singular,

    dq = l + J^T (J J^T + damp I)^-1 (e - J l),    l = g' - g + k (g - q),

e the way and turn to the next pose, g a posture that the null space is led along, g' the next one,
k by how much it is drawn to it. The first step leads, the second one, with l = 0, lands. An arm of
six joints has no null space but where it is singular; what its posture says there, landing leaves.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled, leaf
from drake_oa.common.messages import FloatArray
from drake_oa.planning.arm_world import Chain, chain_poses

PULL = 20.0
"""How fast the null space is drawn to the guiding posture: what is left of the way to it falls to
1 / e in 1 / 20 of the motion."""
_DRAWN, _LANDED = 1e-4, 1e-7
"""Damping of the two steps [m^2]: at 1e-4 a singular arm moves a joint by 1 rad for 1 cm."""
_LANDINGS, _MISSED = 4, 1e-4
"""The second step is repeated so often, until no more is missed [m, rad]."""


class Scratch(NamedTuple):
    """Room that the kernels work in.

    Attributes:
        X: (n + 2, 12) poses.
        J, JJ: (6, n) the tool's Jacobian, and (6, 6) its square.
        e: (6,) an error.
        lead: (n,) where the null space is led.
    """

    X: FloatArray
    J: FloatArray
    JJ: FloatArray
    e: FloatArray
    lead: FloatArray


@compiled
def scratch(n: int) -> Scratch:
    """Of an arm of n joints."""
    X, J, JJ = np.empty((n + 2, 12)), np.empty((6, n)), np.empty((6, 6))
    return Scratch(X, J, JJ, np.empty(6), np.zeros(n))


@leaf
def _solve(A: FloatArray, b: FloatArray) -> None:
    """b becomes A^-1 b, A (m, m) positive definite, of which the lower half is read, and lost."""
    m = len(b)
    for j in range(m):
        d = A[j, j]
        for k in range(j):
            d -= A[j, k] * A[j, k] * A[k, k]
        A[j, j] = d
        for i in range(j + 1, m):
            v = A[i, j]
            for k in range(j):
                v -= A[i, k] * A[j, k] * A[k, k]
            A[i, j] = v / d
    for i in range(m):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
    for i in range(m):
        b[i] /= A[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            b[i] -= A[k, i] * b[k]


@leaf
def _half_turn(X: FloatArray, target: FloatArray, e: FloatArray) -> None:
    """Sets e (6,) to a turn that has no skew part, either way round: its matrix is 2 a a^T - I."""
    last, most = len(X) - 1, 0.0
    for i in range(3):
        # Column i of a a^T; that of the largest component is the longest.
        a, b, c = 0.0, 0.0, 0.0
        for k in range(3):
            v = 0.5 * X[last, 3 * i + k]
            a, b, c = a + target[k] * v, b + target[3 + k] * v, c + target[6 + k] * v
        a, b, c = a + 0.5 * (i == 0), b + 0.5 * (i == 1), c + 0.5 * (i == 2)
        length = math.sqrt(a * a + b * b + c * c)
        if length > most:
            most, scale = length, math.pi / length
            e[0], e[1], e[2] = scale * a, scale * b, scale * c


@leaf
def pose_error(X: FloatArray, target: FloatArray, e: FloatArray) -> float:
    """Sets e (6,) to the turn [rad] and the way [m] from the last pose of X to another (12,).

    Returns:
        The largest of them.
    """
    # The skew part of R_WT R_WE^T, and its trace.
    last = len(X) - 1
    x = y = z = trace = 0.0
    for k in range(3):
        t0, t1, t2 = target[k], target[3 + k], target[6 + k]
        e0, e1, e2 = X[last, k], X[last, 3 + k], X[last, 6 + k]
        x += t2 * e1 - t1 * e2
        y += t0 * e2 - t2 * e0
        z += t1 * e0 - t0 * e1
        trace += t0 * e0 + t1 * e1 + t2 * e2
    sine, cosine = 0.5 * math.sqrt(x * x + y * y + z * z), 0.5 * (trace - 1.0)
    scale = 0.5
    if cosine < 0.999 and sine > 1e-9:
        scale = 0.5 * math.atan2(sine, cosine) / sine
    e[0], e[1], e[2] = scale * x, scale * y, scale * z
    if cosine < 0.0 and sine <= 1e-9:
        _half_turn(X, target, e)
    largest = 0.0
    for i in range(3):
        e[3 + i] = target[9 + i] - X[last, 9 + i]
        largest = max(largest, abs(e[i]), abs(e[3 + i]))
    return largest


@leaf
def step_toward(
    q: FloatArray, target: FloatArray, damping: float, chain: Chain, room: Scratch
) -> float:
    """One step of q, in place and within the limits, to a pose of the tool.

    Args:
        q: (n,) [rad]; `room.X` holds its poses, see `chain_poses`, and `room.lead` where its null
            space is led.
        target: (12,) pose that is asked.
        damping: [m^2].
        chain: the arm.
        room: to work in.

    Returns:
        The largest error before the step [m, rad].
    """
    n = len(q)
    X, J, JJ, e, lead = room
    largest = pose_error(X, target, e)
    for i in range(n):
        ax, ay, az = X[i + 1, 2], X[i + 1, 5], X[i + 1, 8]
        rx = X[n + 1, 9] - X[i + 1, 9]
        ry = X[n + 1, 10] - X[i + 1, 10]
        rz = X[n + 1, 11] - X[i + 1, 11]
        J[0, i], J[1, i], J[2, i] = ax, ay, az
        J[3, i], J[4, i], J[5, i] = ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx
    for i in range(6):
        for j in range(i + 1):
            v = 0.0
            for k in range(n):
                v += J[i, k] * J[j, k]
            JJ[i, j] = v
        JJ[i, i] += damping
        for k in range(n):
            e[i] -= J[i, k] * lead[k]
    _solve(JJ, e)
    for k in range(n):
        v = lead[k]
        for i in range(6):
            v += J[i, k] * e[i]
        q[k] = min(max(q[k] + v, chain.lower[k]), chain.upper[k])
    return largest


@leaf
def follow(
    q: FloatArray,
    target: FloatArray,
    guide: FloatArray,
    row: int,
    pull: float,
    chain: Chain,
    room: Scratch,
) -> float:
    """q, in place, goes on to the next pose of the tool; leaves the poses of the new q in `room`.

    Args:
        q: (n,) [rad].
        target: (12,) the next pose.
        guide: (T, n) postures that the null space is led along [rad].
        row: of the next of them; 0: it is not led.
        pull: share of the way to them that it is drawn.
        chain: the arm.
        room: to work in.

    Returns:
        The error that is left [m, rad].
    """
    chain_poses(q, chain.X_PJ, room.X)
    landed = _LANDED if len(q) > 6 else _DRAWN
    if row > 0:
        for i in range(len(q)):
            ahead = guide[row, i] - guide[row - 1, i]
            room.lead[i] = ahead + pull * (guide[row - 1, i] - q[i])
    step_toward(q, target, _DRAWN, chain, room)
    room.lead[:] = 0.0
    chain_poses(q, chain.X_PJ, room.X)
    missed = np.inf
    for _ in range(_LANDINGS):
        step_toward(q, target, landed, chain, room)
        chain_poses(q, chain.X_PJ, room.X)
        missed = pose_error(room.X, target, room.e)
        if missed < _MISSED:
            break
    return missed


@compiled
def reach(
    q: FloatArray, target: FloatArray, chain: Chain, room: Scratch, steps: int, tolerance: float
) -> bool:
    """Whether q, in place, reaches a pose of the tool in so many steps, within [m, rad]."""
    for _ in range(steps):
        chain_poses(q, chain.X_PJ, room.X)
        if step_toward(q, target, _DRAWN, chain, room) <= tolerance:
            return True
    return False
