"""Points of obstacles grouped into blocks of neighbours, compiled."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray, IntArray


@njit(cache=True, error_model="numpy")
def group_points(
    points: FloatArray, begin: IntArray, side: float, most: int
) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    """Groups the points of each obstacle by cells of a grid.

    Args:
        points: (N, 3) of all obstacles, one after the other [m].
        begin: (M + 1,) where each obstacle begins, and N.
        side: of a cell [m]; cells are larger where there would be too many of them.
        most: how many cells an obstacle may have.

    Returns:
        The points in order of their blocks, where each of the K blocks begins, and N; the
        row of its obstacle; (K, 4) centre and radius of a sphere that holds it [m].
    """
    total = len(points)
    ordered = np.empty((total, 3))
    start, owner = np.empty(total + 1, dtype=np.int64), np.empty(total, dtype=np.int64)
    sphere = np.empty((total, 4))
    cell = np.empty(total, dtype=np.int64)
    place = np.empty(most + 1, dtype=np.int64)
    blocks = 0
    across = np.ones(3, dtype=np.int64)
    low, high = np.empty(3), np.empty(3)
    for row in range(len(begin) - 1):
        first, last = begin[row], begin[row + 1]
        if first == last:
            continue
        low[:], high[:] = points[first], points[first]
        for i in range(first, last):
            for j in range(3):
                low[j] = min(low[j], points[i, j])
                high[j] = max(high[j], points[i, j])
        edge = side
        for j in range(3):
            # So that the product of the three counts stays below the limit.
            edge = max(edge, 1.01 * (high[j] - low[j]) / (most ** (1.0 / 3.0) - 1.0))
        for j in range(3):
            across[j] = int((high[j] - low[j]) / edge) + 1
        count = across[0] * across[1] * across[2]
        place[: count + 1] = 0
        for i in range(first, last):
            index = 0
            for j in range(3):
                index = index * across[j] + int((points[i, j] - low[j]) / edge)
            cell[i] = index
            place[index + 1] += 1
        for index in range(count):
            if place[index + 1] > 0:
                start[blocks], owner[blocks] = first + place[index], row
                blocks += 1
            place[index + 1] += place[index]
        for i in range(first, last):
            ordered[first + place[cell[i]]] = points[i]
            place[cell[i]] += 1
    start[blocks] = total
    for block in range(blocks):
        first, last = start[block], start[block + 1]
        low[:], high[:] = ordered[first], ordered[first]
        for i in range(first, last):
            for j in range(3):
                low[j] = min(low[j], ordered[i, j])
                high[j] = max(high[j], ordered[i, j])
        square = 0.0
        for i in range(first, last):
            away = 0.0
            for j in range(3):
                away += (ordered[i, j] - 0.5 * (low[j] + high[j])) ** 2
            square = max(square, away)
        for j in range(3):
            sphere[block, j] = 0.5 * (low[j] + high[j])
        sphere[block, 3] = math.sqrt(square)
    return ordered, start[: blocks + 1].copy(), owner[:blocks].copy(), sphere[:blocks].copy()
