"""Compiled loops over obstacles for `drake_oa.regulation.regressor`: a few rows, many small
steps."""

import math

import numba
import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray

_ROUNDING = 1e-12
"""By how much of L a query may be moved and still count as inside."""

_PARALLEL = 1e-6
"""Sine of the angle below which two directions do not span a plane."""


@numba.njit(cache=True)
def clamp_rows(
    extents: FloatArray,
    clearance: FloatArray,
    position: FloatArray,
    baseline: float,
    lower: FloatArray,
    upper: FloatArray,
    axis1: FloatArray,
    axis2: FloatArray,
    axis3: FloatArray,
    table: FloatArray,
    columns: FloatArray,
) -> tuple[BoolArray, BoolArray, bool]:
    """Moves queries into the trained range and tells which were inside.

    Args:
        extents: (M, 2) lambda1', lambda2' [m].
        clearance: (M,) Delta [m]; 0 where no coupling is needed.
        position: (M,) where along the baseline the centre is [m].
        baseline: L [m].
        lower: (d,) least values of lambda1'/L, lambda2'/L, Delta/L and, if d = 4,
            position/L.
        upper: (d,) greatest values.
        axis1: (n,) increasing lambda1'/L of the table; empty: no table.
        axis2: (m,) increasing lambda2'/L.
        axis3: (p,) increasing position/L.
        table: (n, m, p) largest attainable Delta/L, interpolated linearly.
        columns: (>= d, M) takes the moved queries in its first d rows.

    Returns:
        (M,) whether the query was inside (or needs no coupling), (M,) whether coupling is
        needed, and whether all values are valid: finite, extents positive, clearances
        not negative.
    """
    inside = np.ones(len(extents), dtype=np.bool_)
    needed = np.ones(len(extents), dtype=np.bool_)
    asked = np.empty(4)
    weight = np.empty((3, 2))
    for row in range(len(extents)):
        asked[0], asked[1] = extents[row, 0] / baseline, extents[row, 1] / baseline
        asked[2], asked[3] = clearance[row] / baseline, position[row] / baseline
        for k in range(len(lower)):
            columns[k, row] = min(max(asked[k], lower[k]), upper[k])
        valid = asked[0] > 0.0 and asked[1] > 0.0 and asked[2] >= 0.0
        if not valid or not math.isfinite(asked[0] + asked[1] + asked[2] + asked[3]):
            return inside, needed, False
        needed[row] = clearance[row] > 0.0
        if not needed[row]:
            continue
        moved = 0.0
        if len(axis1):
            i = _locate(axis1, columns[0, row], weight[0])
            j = _locate(axis2, columns[1, row], weight[1])
            k = _locate(axis3, columns[3, row], weight[2])
            limit = 0.0
            for corner in range(8):
                a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
                share = weight[0, a] * weight[1, b] * weight[2, c]
                limit += share * table[i + a, j + b, k + c]
            columns[2, row] = min(columns[2, row], max(limit, lower[2]))
            moved = max(0.0, lower[2] - limit)
        for k in range(len(lower)):
            moved = max(moved, abs(asked[k] - columns[k, row]))
        inside[row] = moved <= _ROUNDING
    return inside, needed, True


@numba.njit(cache=True)
def _locate(axis: FloatArray, x: float, weight: FloatArray) -> int:
    """Cell of x in an increasing axis, and the weights of its two ends."""
    i = min(max(int(np.searchsorted(axis, x)) - 1, 0), len(axis) - 2)
    weight[1] = (x - axis[i]) / (axis[i + 1] - axis[i])
    weight[0] = 1.0 - weight[1]
    return i


@numba.njit(cache=True)
def section_rows(
    p_WE: FloatArray,
    z_W: FloatArray,
    R_WL: FloatArray,
    p_WO: FloatArray,
    R_WO: FloatArray,
    semi_axes: FloatArray,
) -> FloatArray:
    """See `drake_oa.regulation.regressor.section_extents`."""
    extents = np.empty((len(p_WO), 2))
    zz = z_W[0] ** 2 + z_W[1] ** 2 + z_W[2] ** 2
    for row in range(len(p_WO)):
        e0, e1, e2 = p_WO[row, 0] - p_WE[0], p_WO[row, 1] - p_WE[1], p_WO[row, 2] - p_WE[2]
        n0 = e1 * z_W[2] - e2 * z_W[1]
        n1 = e2 * z_W[0] - e0 * z_W[2]
        n2 = e0 * z_W[1] - e1 * z_W[0]
        squared = n0 * n0 + n1 * n1 + n2 * n2
        if squared <= _PARALLEL**2 * (e0 * e0 + e1 * e1 + e2 * e2) * zz:
            n0, n1, n2, squared = R_WL[0, 1], R_WL[1, 1], R_WL[2, 1], 1.0
        norm = math.sqrt(squared)
        n0, n1, n2 = n0 / norm, n1 / norm, n2 / norm
        # u along the projection of the baseline into the plane, v across it.
        height = n0 * R_WL[0, 0] + n1 * R_WL[1, 0] + n2 * R_WL[2, 0]
        u0, u1, u2 = R_WL[0, 0] - height * n0, R_WL[1, 0] - height * n1, R_WL[2, 0] - height * n2
        squared = u0 * u0 + u1 * u1 + u2 * u2
        if squared <= _PARALLEL**2:
            # The plane is square to the baseline: measure along the way to the obstacle.
            u0, u1, u2, squared = e0, e1, e2, e0 * e0 + e1 * e1 + e2 * e2
        norm = math.sqrt(squared)
        u0, u1, u2 = u0 / norm, u1 / norm, u2 / norm
        v0, v1, v2 = n1 * u2 - n2 * u1, n2 * u0 - n0 * u2, n0 * u1 - n1 * u0
        s11, s12, s22 = 0.0, 0.0, 0.0
        for k in range(3):
            r0, r1, r2 = R_WO[row, 0, k], R_WO[row, 1, k], R_WO[row, 2, k]
            a = (u0 * r0 + u1 * r1 + u2 * r2) / semi_axes[row, k]
            b = (v0 * r0 + v1 * r1 + v2 * r2) / semi_axes[row, k]
            s11 += a * a
            s12 += a * b
            s22 += b * b
        determinant = s11 * s22 - s12 * s12
        extents[row, 0] = math.sqrt(s22 / determinant)
        extents[row, 1] = math.sqrt(s11 / determinant)
    return extents
