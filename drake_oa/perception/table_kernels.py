"""Compiled loops behind the extent of a table; see `table_extent`.

The kernels take writable C-contiguous arrays of float64 and int64 (masks: bool), so that
numba compiles each of them once, and caches it on disk.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from drake_oa.common.messages import BoolArray, FloatArray, IntArray

_UNSEEN = 0.3  # how far a table is taken to go on beyond the border of the image [m]
_BEYOND = 0.5  # how far beyond the border, in sizes of the image, that is looked up
_BORDER = 2  # rows and columns of the grid that are the border


@njit(cache=True, error_model="numpy")
def _row_ends(grid: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Rows that the table is in, and its first and last column there.

    The table's mask is opened by a square of 3 x 3, which removes the thin line where its
    plane cuts a wall; outside the image is no table.

    Args:
        grid: (H, W) which sample shows the table there, -1 for none.
    """
    rows, columns = grid.shape
    # Of the mask eroded by the square: every place all round which the table is seen.
    first = np.full(rows + 2, columns, dtype=np.int64)
    last = np.full(rows + 2, -1, dtype=np.int64)
    for row in range(1, rows - 1):
        for side in (1, -1):
            column = 1 if side == 1 else columns - 2
            while column > 0 and column < columns - 1:
                here = True
                for r in range(row - 1, row + 2):
                    for c in range(column - 1, column + 2):
                        here &= grid[r, c] >= 0
                if here:
                    if side == 1:
                        first[row + 1] = column
                    else:
                        last[row + 1] = column
                    break
                column += side
    found, n = np.empty(rows, dtype=np.int64), 0
    left, right = np.empty(rows, dtype=np.int64), np.empty(rows, dtype=np.int64)
    for row in range(rows):
        low = min(first[row], first[row + 1], first[row + 2])
        if low < columns:
            found[n], left[n] = row, low - 1
            right[n] = max(last[row], last[row + 1], last[row + 2]) + 1
            n += 1
    return found[:n], left[:n], right[:n]


@njit(cache=True, error_model="numpy")
def extent_points(
    rows: int,
    columns: int,
    pixel: IntArray,
    on_table: BoolArray,
    p_CQ: FloatArray,
    plane: FloatArray,
    pitch: FloatArray,
) -> FloatArray:
    """See `drake_oa.perception.table_extent.seen_extent`; plane (4,) is its normal and offset."""
    grid = np.full(rows * columns, -1, dtype=np.int64)
    bottom, left, right, start = -1, columns, -1, 0
    for i in range(len(pixel)):
        while pixel[i] >= start + columns:
            start += columns
        column = pixel[i] - start
        left, right = min(left, column), max(right, column)
        if on_table[i]:
            grid[pixel[i]] = i
    if len(pixel):
        bottom = pixel[-1] // columns
    row, first, last = _row_ends(grid.reshape(rows, columns))
    out, n = np.empty((8 * len(row), 3)), 0
    step = np.empty(3)
    for side in (0, 1):
        for i in range(len(row)):
            column = first[i] if side == 0 else last[i]
            p = p_CQ[grid[row[i] * columns + column]]
            out[n] = p
            n += 1
            # Not beyond the upper border: what is there is farther away than its feet are.
            for border in range(3):
                step[:] = 0.0
                if border == 0 and row[i] >= bottom - _BORDER:
                    step[1] = _BEYOND * rows * pitch[1]
                elif border == 1 and column <= left + _BORDER:
                    step[0] = -_BEYOND * columns * pitch[0]
                elif border == 2 and column >= right - _BORDER:
                    step[0] = _BEYOND * columns * pitch[0]
                else:
                    continue
                _beyond(p, step, plane, out[n])
                n += 1
    return out[:n].copy()


@njit(cache=True, error_model="numpy")
def _beyond(border: FloatArray, step: FloatArray, plane: FloatArray, out: FloatArray) -> None:
    """A point of the table beyond the border: where a ray further out meets the plane.

    Args:
        border: (3,) point of the table at the border [m].
        step: (3,) tangents from the border outwards.
        plane: (4,) normal and offset of the table.
        out: (3,) written.
    """
    along = 0.0
    for k in range(3):
        along += (border[k] / border[2] + step[k]) * plane[k]
    # Rays that do not meet the plane in front of the camera go on as far as any may.
    met = along * np.sign(plane[3]) > 1e-3
    across = 0.0
    for k in range(3):
        hit = (border[k] / border[2] + step[k]) * (plane[3] / along)
        out[k] = hit - border[k] if met else step[k]
        across += out[k] * plane[k]
    length = 0.0
    for k in range(3):
        out[k] -= across * plane[k]
        length += out[k] * out[k]
    length = np.sqrt(length)
    reach = min(length, _UNSEEN) if met else _UNSEEN
    for k in range(3):
        out[k] = border[k] + out[k] * (reach / max(length, 1e-9))


@njit(cache=True, error_model="numpy")
def beyond_halfplanes(
    points: FloatArray, axes: FloatArray, directions: FloatArray, reach: FloatArray
) -> FloatArray:
    """How far points lie, seen along a normal, beyond a convex region of the plane.

    Args:
        points: (N, 3) points [m].
        axes: (2, 3) axes of the plane.
        directions: (D, 2) outer normals of the half-planes, along these axes.
        reach: (D,) how far each half-plane reaches along its normal [m].

    Returns:
        (N,) the largest distance beyond a half-plane [m], negative inside.
    """
    a, b = np.zeros(len(points)), np.zeros(len(points))
    for i in range(len(points)):
        for k in range(3):
            a[i] += axes[0, k] * points[i, k]
            b[i] += axes[1, k] * points[i, k]
    beyond = np.full(len(points), -np.inf)
    for d in range(len(reach)):
        x, y, limit = directions[d, 0], directions[d, 1], reach[d]
        # A loop along the points uses vector instructions.
        for i in range(len(points)):
            distance = x * a[i] + y * b[i] - limit
            beyond[i] = distance if distance > beyond[i] else beyond[i]
    return beyond
