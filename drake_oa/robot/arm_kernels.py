"""Forward kinematics and the Jacobian of an arm, compiled.

Every kernel takes C-contiguous float64 and int64 arrays, so that numba compiles each of them once,
and caches it on disk.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray


@compiled
def poses(q: FloatArray, X_PJ: FloatArray, X_WB: FloatArray) -> None:
    """Forward kinematics of n revolute joints in a row, each about its z axis.

    Args:
        q: (n,) positions [rad].
        X_PJ: (n + 1, 4, 4) frame of each joint in the body before it, and of the tool in
            the last body.
        X_WB: (n + 1, 4, 4) receives the bodies' poses, and the tool's.
    """
    n = len(q)
    X = np.eye(4)
    for i in range(n + 1):
        c, s = (math.cos(q[i]), math.sin(q[i])) if i < n else (1.0, 0.0)
        Y = X_PJ[i]
        for row in range(3):
            a = X[row, 0] * Y[0, 0] + X[row, 1] * Y[1, 0] + X[row, 2] * Y[2, 0]
            b = X[row, 0] * Y[0, 1] + X[row, 1] * Y[1, 1] + X[row, 2] * Y[2, 1]
            X_WB[i, row, 0], X_WB[i, row, 1] = c * a + s * b, c * b - s * a
            X_WB[i, row, 2] = X[row, 0] * Y[0, 2] + X[row, 1] * Y[1, 2] + X[row, 2] * Y[2, 2]
            X_WB[i, row, 3] = (
                X[row, 0] * Y[0, 3] + X[row, 1] * Y[1, 3] + X[row, 2] * Y[2, 3] + X[row, 3]
            )
            X_WB[i, 3, row] = 0.0
        X_WB[i, 3, 3] = 1.0
        X = X_WB[i]


@compiled
def jacobian(X_WB: FloatArray, J: FloatArray) -> None:
    """The tool's Jacobian, rotation before translation, in the world.

    Args:
        X_WB: (n + 1, 4, 4) as `poses` leaves them.
        J: (6, n) receives it.
    """
    n = len(X_WB) - 1
    tool = X_WB[n]
    for i in range(n):
        ax, ay, az = X_WB[i, 0, 2], X_WB[i, 1, 2], X_WB[i, 2, 2]
        rx = tool[0, 3] - X_WB[i, 0, 3]
        ry = tool[1, 3] - X_WB[i, 1, 3]
        rz = tool[2, 3] - X_WB[i, 2, 3]
        J[0, i], J[1, i], J[2, i] = ax, ay, az
        J[3, i], J[4, i], J[5, i] = ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx
