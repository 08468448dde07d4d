"""What an arm reaches over a grid, compiled; call `drake_oa.robot.reachability` instead."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.robot.arm_kernels import poses
from drake_oa.robot.pose_kernels import solve_pose

UNREACHED, STRAINED, REACHED = 0, 1, 2
"""What a grid point is: out of reach, reached only near a joint limit, reached."""

_ATTEMPTS = 4
"""Seeds that a point is tried from before it counts as out of reach."""
_HALVINGS = 3


@njit(cache=True, error_model="numpy")
def flood(
    origin: FloatArray,
    spacing: float,
    seeds: FloatArray,
    R_WE: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    X_PJ: FloatArray,
    kind: int,
    state: IntArray,
    found: FloatArray,
) -> None:
    """Grows the set of grid points that the tool reaches from neighbour to neighbour.

    Args:
        origin: (3,) first grid point [m].
        spacing: of the grid [m].
        seeds: (S, n) positions to begin from, each at the grid point nearest to its
            tool; then the points that are in `state` already go on.
        R_WE: (3, 3) the tool's orientation.
        lower, upper: (n,) limits to keep [rad].
        X_PJ: (n + 1, 4, 4) the arm.
        kind: what reached points become.
        state: (a, b, c) what the grid points are; changed.
        found: (a, b, c, n) positions there [rad]; changed.
    """
    shape = state.shape
    n = found.shape[3]
    X_WB = np.empty((n + 1, 4, 4))
    queue = np.empty((state.size, 3), dtype=np.int64)
    tried = np.zeros(shape, dtype=np.int64)
    end = 0
    p, q = np.empty(3), np.empty(n)
    at = np.empty(3, dtype=np.int64)
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                if state[i, j, k] != UNREACHED:
                    queue[end, 0], queue[end, 1], queue[end, 2] = i, j, k
                    end += 1
    for row in range(len(seeds)):
        q[:] = seeds[row]
        poses(q, X_PJ, X_WB)
        inside = True
        for c in range(3):
            at[c] = round((X_WB[n, c, 3] - origin[c]) / spacing)
            p[c] = origin[c] + spacing * at[c]
            inside &= 0 <= at[c] < shape[c]
        if inside and state[at[0], at[1], at[2]] == UNREACHED:
            for i in range(n):
                q[i] = min(max(q[i], lower[i]), upper[i])
            if solve_pose(q, p, R_WE, lower, upper, X_PJ, X_WB):
                state[at[0], at[1], at[2]] = kind
                found[at[0], at[1], at[2]] = q
                queue[end] = at
                end += 1
    begin = 0
    while begin < end:
        i, j, k = queue[begin]
        begin += 1
        for side in range(6):
            at[0], at[1], at[2] = i, j, k
            at[side // 2] += 2 * (side % 2) - 1
            if not 0 <= at[side // 2] < shape[side // 2]:
                continue
            if state[at[0], at[1], at[2]] != UNREACHED or tried[at[0], at[1], at[2]] >= _ATTEMPTS:
                continue
            for c in range(3):
                p[c] = origin[c] + spacing * at[c]
            q[:] = found[i, j, k]
            if solve_pose(q, p, R_WE, lower, upper, X_PJ, X_WB):
                state[at[0], at[1], at[2]] = kind
                found[at[0], at[1], at[2]] = q
                queue[end] = at
                end += 1
            else:
                tried[at[0], at[1], at[2]] += 1


@njit(cache=True, error_model="numpy")
def surface(
    origin: FloatArray,
    spacing: float,
    R_WE: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    X_PJ: FloatArray,
    least: int,
    state: IntArray,
    found: FloatArray,
    points: FloatArray,
) -> int:
    """Where the edges of the grid leave the set of points whose state is `least` or more.

    Args:
        points: (P, 3) receives them [m]; three rows a grid point are enough.
        (the others): as of `flood`; the border of the grid must be out of the set.

    Returns:
        How many there are.
    """
    shape = state.shape
    n = found.shape[3]
    X_WB = np.empty((n + 1, 4, 4))
    p, q = np.empty(3), np.empty(n)
    count = 0
    for i in range(shape[0]):
        for j in range(shape[1]):
            for k in range(shape[2]):
                if state[i, j, k] < least:
                    continue
                for side in range(6):
                    axis, sense = side // 2, 2 * (side % 2) - 1
                    a = i + (sense if axis == 0 else 0)
                    b = j + (sense if axis == 1 else 0)
                    c = k + (sense if axis == 2 else 0)
                    if state[a, b, c] >= least:
                        continue
                    p[0] = origin[0] + spacing * i
                    p[1] = origin[1] + spacing * j
                    p[2] = origin[2] + spacing * k
                    base = p[axis]
                    low, high = 0.0, 1.0
                    for _ in range(_HALVINGS):
                        share = 0.5 * (low + high)
                        p[axis] = base + sense * spacing * share
                        q[:] = found[i, j, k]
                        if solve_pose(q, p, R_WE, lower, upper, X_PJ, X_WB):
                            low = share
                        else:
                            high = share
                    p[axis] = base + sense * spacing * 0.5 * (low + high)
                    points[count] = p
                    count += 1
    return count


@njit(cache=True, error_model="numpy")
def interpolate(
    p_WQ: FloatArray, origin: FloatArray, spacing: float, grid: FloatArray, out: FloatArray
) -> None:
    """Trilinear interpolation of a grid (a, b, c) at points p_WQ (N, 3) into out (N,).

    Beyond the grid it is the value at its nearest point less the distance to it; NaN for a
    point that is not finite.
    """
    size = grid.shape
    at = np.empty(3, dtype=np.int64)
    share = np.empty(3)
    for row in range(len(p_WQ)):
        beyond = 0.0
        finite = True
        for c in range(3):
            u = (p_WQ[row, c] - origin[c]) / spacing
            if not math.isfinite(u):
                finite = False
                break
            kept = min(max(u, 0.0), size[c] - 1.0)
            beyond += (u - kept) ** 2
            at[c] = min(int(kept), size[c] - 2)
            share[c] = kept - at[c]
        if not finite:
            out[row] = np.nan
            continue
        total = 0.0
        for corner in range(8):
            a, b, c = corner & 1, (corner >> 1) & 1, corner >> 2
            total += (
                grid[at[0] + a, at[1] + b, at[2] + c]
                * (share[0] if a else 1.0 - share[0])
                * (share[1] if b else 1.0 - share[1])
                * (share[2] if c else 1.0 - share[2])
            )
        out[row] = total - spacing * math.sqrt(beyond)
