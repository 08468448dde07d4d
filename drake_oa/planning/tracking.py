"""The joints of an arm along a path of its tool: differential inverse kinematics, compiled.

From pose to pose two Gauss-Newton steps, damped where the arm is singular,

    dq = k (g - q) + J^T (J J^T + damp I)^-1 (e - k J (g - q)),

e the way and turn to the next pose, g a posture that the null space is drawn to, k by how much.
The first step draws, the second one lands. An arm of six joints has no null space.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled, leaf
from drake_oa.common.messages import FloatArray
from drake_oa.planning.arm_world import Chain, chain_poses

PULL = 0.3
"""Share of the way to the guiding posture that is gone from one pose to the next."""
_DRAWN, _LANDED = 1e-4, 1e-7
"""Damping of the two steps [m^2]: at 1e-4 a singular arm moves a joint by 1 rad for 1 cm."""


class Scratch(NamedTuple):
    """Room that the kernels work in: poses (n + 2, 12), Jacobian (6, n), its square, an error."""

    X: FloatArray
    J: FloatArray
    JJ: FloatArray
    e: FloatArray


@compiled
def scratch(n: int) -> Scratch:
    """Of an arm of n joints."""
    return Scratch(np.empty((n + 2, 12)), np.empty((6, n)), np.empty((6, 6)), np.empty(6))


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
    largest = 0.0
    for i in range(3):
        e[3 + i] = target[9 + i] - X[last, 9 + i]
        largest = max(largest, abs(e[i]), abs(e[3 + i]))
    return largest


@leaf
def step_toward(
    q: FloatArray,
    target: FloatArray,
    guide: FloatArray,
    pull: float,
    damping: float,
    chain: Chain,
    room: Scratch,
) -> float:
    """One step of q, in place and within the limits, to a pose of the tool.

    Args:
        q: (n,) [rad]; `room.X` holds its poses, see `chain_poses`.
        target: (12,) pose that is asked.
        guide: (n,) posture that the null space is drawn to [rad].
        pull: share of the way to it.
        damping: [m^2].
        chain: the arm.
        room: to work in.

    Returns:
        The largest error before the step [m, rad].
    """
    n = len(q)
    X, J, JJ, e = room
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
            e[i] -= pull * J[i, k] * (guide[k] - q[k])
    _solve(JJ, e)
    for k in range(n):
        v = pull * (guide[k] - q[k])
        for i in range(6):
            v += J[i, k] * e[i]
        q[k] = min(max(q[k] + v, chain.lower[k]), chain.upper[k])
    return largest


@leaf
def follow(
    q: FloatArray, target: FloatArray, guide: FloatArray, pull: float, chain: Chain, room: Scratch
) -> float:
    """q, in place, goes on to the next pose of the tool; leaves the poses of the new q in `room`.

    Returns:
        The error that is left [m, rad].
    """
    chain_poses(q, chain.X_PJ, room.X)
    step_toward(q, target, guide, pull, _DRAWN, chain, room)
    chain_poses(q, chain.X_PJ, room.X)
    step_toward(q, target, q, 0.0, _LANDED, chain, room)
    chain_poses(q, chain.X_PJ, room.X)
    return pose_error(room.X, target, room.e)


@compiled
def reach(
    q: FloatArray, target: FloatArray, chain: Chain, room: Scratch, steps: int, tolerance: float
) -> bool:
    """Whether q, in place, reaches a pose of the tool in so many steps, within [m, rad]."""
    for _ in range(steps):
        chain_poses(q, chain.X_PJ, room.X)
        if step_toward(q, target, q, 0.0, _DRAWN, chain, room) <= tolerance:
            return True
    return False
