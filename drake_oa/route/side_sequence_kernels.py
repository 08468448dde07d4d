"""Legs of a way past obstacles, compiled; call `drake_oa.route.side_sequence` instead."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import BoolArray, FloatArray


@njit(cache=True, error_model="numpy")
def obstruction(
    p_WA: FloatArray,
    p_WB: FloatArray,
    p_WO: FloatArray,
    R_WO: FloatArray,
    semi_axes: FloatArray,
    counts: BoolArray,
    clearance: float,
    out: FloatArray,
) -> None:
    """How much obstacles are in the way of straight legs.

    With g the least norm of a leg's points in the axes of an obstacle, scaled so that the
    obstacle grown by the clearance is the unit ball, it is 1 - g, at least 0; and 1 where the
    leg meets the obstacle itself.

    Args:
        p_WA: (I, 3) where legs begin [m].
        p_WB: (J, 3) where they end [m].
        p_WO, R_WO, semi_axes: M ellipsoids.
        counts: (M,) which of them.
        clearance: that they are grown by [m].
        out: (I, J) receives the largest of the obstacles'.
    """
    out[:] = 0.0
    a, b = np.empty((len(p_WA), 3)), np.empty((len(p_WB), 3))
    scale = np.empty(3)
    for m in range(len(p_WO)):
        if not counts[m]:
            continue
        for grown in range(2):
            for axis in range(3):
                scale[axis] = 1.0 / (semi_axes[m, axis] + (clearance if grown else 0.0))
            _in_axes(p_WA, p_WO[m], R_WO[m], scale, a)
            _in_axes(p_WB, p_WO[m], R_WO[m], scale, b)
            for i in range(len(a)):
                for j in range(len(b)):
                    if out[i, j] >= 1.0:
                        continue
                    g = _least_norm(a[i, 0], a[i, 1], a[i, 2], b[j, 0], b[j, 1], b[j, 2])
                    if g < 1.0:
                        out[i, j] = max(out[i, j], 1.0 - g if grown else 1.0)


@njit(cache=True, error_model="numpy")
def _in_axes(
    p_W: FloatArray, center: FloatArray, R: FloatArray, scale: FloatArray, out: FloatArray
) -> None:
    for i in range(len(p_W)):
        x, y, z = p_W[i, 0] - center[0], p_W[i, 1] - center[1], p_W[i, 2] - center[2]
        for axis in range(3):
            out[i, axis] = scale[axis] * (R[0, axis] * x + R[1, axis] * y + R[2, axis] * z)


@njit(cache=True, error_model="numpy")
def _least_norm(ax: float, ay: float, az: float, bx: float, by: float, bz: float) -> float:
    """Distance of the segment from a to b to the origin."""
    dx, dy, dz = bx - ax, by - ay, bz - az
    d2 = dx * dx + dy * dy + dz * dz
    share = 0.0
    if d2 > 0.0:
        share = min(max(-(ax * dx + ay * dy + az * dz) / d2, 0.0), 1.0)
    x, y, z = ax + share * dx, ay + share * dy, az + share * dz
    return math.sqrt(x * x + y * y + z * z)
