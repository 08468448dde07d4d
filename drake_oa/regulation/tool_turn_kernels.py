"""Distances of a turned tool to points, compiled."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray


@njit(cache=True)
def tool_clearance(
    points: FloatArray,
    p_WE: FloatArray,
    turns: FloatArray,
    axis: FloatArray,
    center: FloatArray,
    R: FloatArray,
    half: FloatArray,
    most: float,
) -> FloatArray:
    """Least distance of a tool of boxes to points, at each place and turn.

    Args:
        points: (N, 3) in W [m].
        p_WE: (P, 3) places of the tool point [m].
        turns: (A,) turns about the axis through it [rad].
        axis: (3,) unit, in W.
        center: (B, 3) centres of the boxes from the tool point, at turn 0 [m].
        R: (B, 3, 3) their rotations R_WB at turn 0.
        half: (B, 3) half their edges [m].
        most: distances are not looked at beyond this [m].

    Returns:
        (P, A) distances, 0 inside, at most `most` [m].
    """
    P, A, N, B = len(p_WE), len(turns), len(points), len(center)
    reach = np.empty(B)
    for b in range(B):
        reach[b] = math.sqrt(half[b, 0] ** 2 + half[b, 1] ** 2 + half[b, 2] ** 2)
    largest = 0.0
    for b in range(B):
        middle = math.sqrt(center[b, 0] ** 2 + center[b, 1] ** 2 + center[b, 2] ** 2)
        largest = max(largest, middle + reach[b])
    found = np.empty((P, A))
    near = np.empty((N, 3))
    for p in range(P):
        count = 0
        for n in range(N):
            x = points[n, 0] - p_WE[p, 0]
            y = points[n, 1] - p_WE[p, 1]
            z = points[n, 2] - p_WE[p, 2]
            if x * x + y * y + z * z < (largest + most) ** 2:
                near[count, 0], near[count, 1], near[count, 2] = x, y, z
                count += 1
        for a in range(A):
            cos, sin = math.cos(turns[a]), math.sin(turns[a])
            least = most * most
            for n in range(count):
                x, y, z = near[n, 0], near[n, 1], near[n, 2]
                # Turned back: Rodrigues' formula with -turn.
                along = (axis[0] * x + axis[1] * y + axis[2] * z) * (1.0 - cos)
                u = cos * x - sin * (axis[1] * z - axis[2] * y) + along * axis[0]
                v = cos * y - sin * (axis[2] * x - axis[0] * z) + along * axis[1]
                w = cos * z - sin * (axis[0] * y - axis[1] * x) + along * axis[2]
                for b in range(B):
                    i, j, k = u - center[b, 0], v - center[b, 1], w - center[b, 2]
                    total = 0.0
                    for c in range(3):
                        q = abs(R[b, 0, c] * i + R[b, 1, c] * j + R[b, 2, c] * k) - half[b, c]
                        if q > 0.0:
                            total += q * q
                    least = min(least, total)
            found[p, a] = math.sqrt(least)
    return found
