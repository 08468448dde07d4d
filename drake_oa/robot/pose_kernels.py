"""Inverse kinematics of an arm within its joint limits, compiled.

Every kernel takes C-contiguous float64 arrays.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray
from drake_oa.robot.arm_kernels import jacobian, poses

_ITERATIONS = 14
_POSITION, _ANGLE = 5e-4, 2e-3
"""Errors at which a pose counts as reached [m], [rad]."""
_LARGEST_STEP = 0.4
"""Of a joint in one iteration [rad]."""
_CENTRED = 0.2
"""Share of the way to the middle of the ranges, in the null space, of an iteration."""
_DAMPING = 1e-5


@njit(cache=True, error_model="numpy")
def solve_pose(
    q: FloatArray,
    p_WE: FloatArray,
    R_WE: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    X_PJ: FloatArray,
    X_WB: FloatArray,
) -> bool:
    """Damped Newton steps to a tool pose within joint limits, q (n,) being changed.

    A joint that a step would push through its limit stops there, and the others make
    the step without it; what they are free to do draws them to the middle of their ranges,
    the more so the wider these are.

    Args:
        q: (n,) seed within the limits; receives the positions [rad].
        p_WE: (3,) asked position [m].
        R_WE: (3, 3) asked orientation.
        lower, upper: (n,) limits [rad].
        X_PJ: (n + 1, 4, 4) see `arm_kernels.poses`.
        X_WB: (n + 1, 4, 4) room for the bodies' poses.

    Returns:
        Whether the pose is reached.
    """
    n = len(q)
    e, left = np.empty(6), np.empty(6)
    J, A = np.empty((6, n)), np.empty((6, 6))
    weight, dq = np.empty(n), np.empty(n)
    held = np.empty(n, dtype=np.bool_)
    for i in range(n):
        weight[i] = min(upper[i] - lower[i], 2.0 * math.pi) ** 2
    for _ in range(_ITERATIONS):
        poses(q, X_PJ, X_WB)
        if _pose_error(X_WB[n], p_WE, R_WE, e):
            return True
        jacobian(X_WB, J)
        for i in range(n):
            held[i] = False
            dq[i] = 0.0
            if upper[i] - lower[i] < 100.0:
                dq[i] = _CENTRED * (0.5 * (lower[i] + upper[i]) - q[i])
        pulled = dq.copy()
        for _ in range(n):
            for row in range(6):
                left[row] = e[row]
                for i in range(n):
                    left[row] -= J[row, i] * (dq[i] if held[i] else pulled[i])
                for column in range(row + 1):
                    total = 0.0
                    for i in range(n):
                        if not held[i]:
                            total += J[row, i] * weight[i] * J[column, i]
                    A[row, column] = total
                A[row, row] += _DAMPING
            _solve_spd(A, left)
            again = False
            for i in range(n):
                if held[i]:
                    continue
                step = pulled[i]
                for row in range(6):
                    step += weight[i] * J[row, i] * left[row]
                dq[i] = step
            largest = 0.0
            for i in range(n):
                largest = max(largest, abs(dq[i]))
            shrink = min(1.0, _LARGEST_STEP / largest) if largest > 0.0 else 1.0
            for i in range(n):
                if held[i]:
                    continue
                if q[i] + shrink * dq[i] > upper[i] + 1e-12:
                    dq[i], held[i], again = upper[i] - q[i], True, True
                elif q[i] + shrink * dq[i] < lower[i] - 1e-12:
                    dq[i], held[i], again = lower[i] - q[i], True, True
            if not again:
                break
        largest = 0.0
        for i in range(n):
            largest = max(largest, abs(dq[i]))
        shrink = min(1.0, _LARGEST_STEP / largest) if largest > 0.0 else 1.0
        for i in range(n):
            q[i] = min(max(q[i] + shrink * dq[i], lower[i]), upper[i])
    poses(q, X_PJ, X_WB)
    return _pose_error(X_WB[n], p_WE, R_WE, e)


@njit(cache=True, error_model="numpy")
def _pose_error(tool: FloatArray, p_WE: FloatArray, R_WE: FloatArray, e: FloatArray) -> bool:
    """Sets e (6,) to sin(angle) times the axis, and the way; says if both are small.

    Beyond a quarter turn the axis has the angle's sine of 1, so that half a turn is no rest.
    """
    cosine = -1.0
    for k in range(3):
        e[3 + k] = p_WE[k] - tool[k, 3]
        e[k] = 0.0
        i, j = (k + 1) % 3, (k + 2) % 3
        for c in range(3):
            # Sum over the columns of half tool x asked.
            e[k] += 0.5 * (tool[i, c] * R_WE[j, c] - tool[j, c] * R_WE[i, c])
            cosine += tool[k, c] * R_WE[k, c]
    cosine *= 0.5
    sine = math.sqrt(e[0] ** 2 + e[1] ** 2 + e[2] ** 2)
    distance = math.sqrt(e[3] ** 2 + e[4] ** 2 + e[5] ** 2)
    if cosine > 0.0:
        return distance < _POSITION and sine < _ANGLE
    if sine > 1e-6:
        for k in range(3):
            e[k] /= sine
    return False


@njit(cache=True, error_model="numpy")
def _solve_spd(A: FloatArray, b: FloatArray) -> None:
    """Solves A x = b in place of b for a positive definite A, whose lower half is given."""
    n = len(b)
    for j in range(n):
        total = A[j, j]
        for k in range(j):
            total -= A[j, k] * A[j, k]
        d = math.sqrt(max(total, 1e-30))
        A[j, j] = d
        for i in range(j + 1, n):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            A[i, j] = total / d
    for i in range(n):
        for k in range(i):
            b[i] -= A[i, k] * b[k]
        b[i] /= A[i, i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= A[k, i] * b[k]
        b[i] /= A[i, i]


@njit(cache=True, error_model="numpy")
def follow(
    q: FloatArray,
    path: FloatArray,
    R_WE: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    X_PJ: FloatArray,
    step: float,
    jump: float,
) -> int:
    """Leads the tool along straight legs.

    Args:
        q: (n,) where the arm is, at the first point or near it [rad]; changed.
        path: (P, 3) corners of the way [m].
        R_WE, lower, upper, X_PJ: as of `solve_pose`.
        step: of the tool [m].
        jump: of a joint in such a step, above which the arm does not follow [rad].

    Returns:
        The first corner that it does not get to; P where it gets to all.
    """
    n = len(q)
    X_WB = np.empty((n + 1, 4, 4))
    p, before = path[0].copy(), np.empty(n)
    if not solve_pose(q, p, R_WE, lower, upper, X_PJ, X_WB):
        return 0
    for corner in range(1, len(path)):
        length = 0.0
        for c in range(3):
            length += (path[corner, c] - path[corner - 1, c]) ** 2
        count = int(math.sqrt(length) / step) + 1
        for part in range(1, count + 1):
            before[:] = q
            for c in range(3):
                share = part / count
                p[c] = path[corner - 1, c] + share * (path[corner, c] - path[corner - 1, c])
            if not solve_pose(q, p, R_WE, lower, upper, X_PJ, X_WB):
                return corner
            for i in range(n):
                if abs(q[i] - before[i]) > jump:
                    return corner
    return len(path)
