"""Compiled loops behind clusters of points and what is seen between them.

Call the functions of `clusters` instead. Every kernel takes writable C-contiguous arrays
of one type (float64 and int64 unless a comment says otherwise), so that numba compiles
each of them once, and caches it on disk.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.voxel_kernels import cell_keys, filed, members_of, place_of

_BRIDGES = 16  # shortest connections between two clusters that are looked at
_STEPS = 5  # places along each of them


@njit(cache=True, error_model="numpy")
def _first_at_least(sorted_keys: IntArray, key: int) -> int:
    low, high = 0, len(sorted_keys)
    while low < high:
        middle = (low + high) // 2
        if sorted_keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, error_model="numpy")
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@njit(cache=True, error_model="numpy")
def _unite_cells(
    points: FloatArray, first: IntArray, second: IntArray, tolerance: float, parent: IntArray
) -> None:
    """Unites the points (N, 3) of two cells (their numbers) within a tolerance [m]."""
    for i in first:
        own = _root(parent, i)
        for j in second:
            other = _root(parent, j)
            if own == other:
                continue
            distance2 = 0.0
            for k in range(3):
                distance2 += (points[i, k] - points[j, k]) ** 2
            if distance2 <= tolerance * tolerance:
                low = min(own, other)
                parent[max(own, other)] = low
                own = low


@njit(cache=True, error_model="numpy")
def clustered(points: FloatArray, tolerance: float, parent: IntArray) -> IntArray:
    """Labels (N,) of points (N, 3) [m]; see `drake_oa.geometry.clusters.connected_clusters`.

    Args:
        points: (N, 3) points [m].
        tolerance: points as near as this belong together [m].
        parent: (N,) a forest of sets of points that do too, changed: no parent has a
            higher number than its child.
    """
    keys = cell_keys(points, tolerance)
    cells, cell_of, slots = filed(keys)
    bits = 0
    while (1 << bits) < len(slots):
        bits += 1
    begin, members = members_of(cell_of, len(cells))
    for cell in range(len(cells)):
        own = members[begin[cell] : begin[cell + 1]]
        _unite_cells(points, own, own, tolerance, parent)
    whole = np.ones(len(cells), dtype=np.bool_)
    for i in range(len(points)):
        cell = cell_of[i]
        whole[cell] &= _root(parent, i) == _root(parent, members[begin[cell]])
    for cell in range(len(cells)):
        # Half of the neighbours; the other half finds this cell itself.
        for number in range(14, 27):
            a, b, c = number // 9 - 1, number // 3 % 3 - 1, number % 3 - 1
            key = cells[cell] + a * (np.int64(1) << 42) + b * (np.int64(1) << 21) + c
            other = place_of(key, cells, slots, bits)
            if other < 0:
                continue
            own, near = members[begin[cell]], members[begin[other]]
            # Of what belongs together already there is nothing to unite.
            together = whole[cell] and whole[other]
            if together and _root(parent, own) == _root(parent, near):
                continue
            _unite_cells(
                points,
                members[begin[cell] : begin[cell + 1]],
                members[begin[other] : begin[other + 1]],
                tolerance,
                parent,
            )
    # Numbered in the order of their first points, which are the roots.
    label, count = np.empty(len(points), dtype=np.int64), 0
    for i in range(len(points)):
        root = _root(parent, i)
        if root == i:
            label[i] = count
            count += 1
        else:
            label[i] = label[root]
    return label


@njit(cache=True, error_model="numpy")
def nearest_within(
    query: FloatArray, points: FloatArray, keys: IntArray, radius: float
) -> IntArray:
    """For each query the sorted place of the nearest point nearer than a radius, or -1.

    Args:
        query: (Q, 3) points [m].
        points: (N, 3) points [m], sorted by key.
        keys: (N,) their keys in cells of edge ``radius``, ascending, z in the lowest
            bits: the cells of a column follow each other.
        radius: [m].
    """
    nearest = np.full(len(query), -1, dtype=np.int64)
    cell, gap = np.empty(3, dtype=np.int64), np.empty((2, 3))
    # The own column first: what it holds mostly rules out all others.
    steps = (0, -1, 1)
    for q in range(len(query)):
        best = radius * radius
        for k in range(2):
            at = query[q, k] / radius
            cell[k] = np.int64(np.floor(at))
            below = (at - cell[k]) * radius
            gap[k, 0], gap[k, 1], gap[k, 2] = 0.0, below * below, (radius - below) ** 2
        cell[2] = np.int64(np.floor(query[q, 2] / radius))
        for a in range(3):
            for b in range(3):
                if gap[0, a] + gap[1, b] >= best:
                    continue
                key = cell[0] + steps[a] + (1 << 20)
                key = (key << 21) | (cell[1] + steps[b] + (1 << 20))
                key = (key << 21) | (cell[2] + (1 << 20))
                j = _first_at_least(keys, key - 1)
                while j < len(keys) and keys[j] <= key + 1:
                    distance2 = 0.0
                    for k in range(3):
                        distance2 += (query[q, k] - points[j, k]) ** 2
                    if distance2 < best:
                        best = distance2
                        nearest[q] = j
                    j += 1
    return nearest


@njit(cache=True, error_model="numpy")
def pixel_at(x: float, y: float, z: float, rows: int, columns: int, K: FloatArray) -> int:
    """Flat index of the pixel that shows a point of the camera frame; see `pixels_of`."""
    if not z > 1e-6:
        return -1
    column = np.rint(K[0] * x / z + K[2])
    row = np.rint(K[1] * y / z + K[3])
    if not (column >= 0 and column < columns and row >= 0 and row < rows):
        return -1
    return int(row) * columns + int(column)


@njit(cache=True, error_model="numpy")
def pixels_at(p_CQ: FloatArray, rows: int, columns: int, K: FloatArray) -> IntArray:
    """See `drake_oa.geometry.clusters.pixels_of`."""
    pixel = np.empty(len(p_CQ), dtype=np.int64)
    for i in range(len(p_CQ)):
        pixel[i] = pixel_at(p_CQ[i, 0], p_CQ[i, 1], p_CQ[i, 2], rows, columns, K)
    return pixel


@njit(cache=True, error_model="numpy")
def _close_to(points: FloatArray, some: IntArray, others: IntArray, gap: float) -> IntArray:
    """Which of some points lie within a gap [m] of the axis-aligned box round others."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for j in others:
        for k in range(3):
            low[k], high[k] = min(low[k], points[j, k]), max(high[k], points[j, k])
    kept, n = np.empty(len(some), dtype=np.int64), 0
    for i in some:
        near = True
        for k in range(3):
            near &= max(low[k] - points[i, k], points[i, k] - high[k]) <= gap
        kept[n] = i
        n += near
    return kept[:n]


@njit(cache=True, error_model="numpy")
def _bridges(points: FloatArray, first: IntArray, second: IntArray, gap: float) -> IntArray:
    """The shortest connections (B, 2), below a gap [m], from points of one cluster to
    the nearest ones of the other's."""
    for _ in range(2):  # the second time against what the first has left
        first = _close_to(points, first, second, gap)
        second = _close_to(points, second, first, gap)
    pairs = np.empty((_BRIDGES, 2), dtype=np.int64)
    length2, count = np.empty(_BRIDGES), 0
    for i in first:
        # One that is longer than the longest of enough others is none.
        best, nearest = gap * gap if count < _BRIDGES else length2[count - 1], -1
        for j in second:
            along = points[i, 0] - points[j, 0]
            distance2 = along * along
            if distance2 >= best:
                continue
            distance2 += (points[i, 1] - points[j, 1]) ** 2
            distance2 += (points[i, 2] - points[j, 2]) ** 2
            if distance2 < best:
                best, nearest = distance2, j
        if nearest < 0:
            continue
        count = min(count + 1, _BRIDGES)
        n = count - 1
        while n > 0 and length2[n - 1] > best:
            length2[n], pairs[n, 0], pairs[n, 1] = length2[n - 1], pairs[n - 1, 0], pairs[n - 1, 1]
            n -= 1
        length2[n], pairs[n, 0], pairs[n, 1] = best, i, nearest
    return pairs[:count]


@njit(cache=True, error_model="numpy")
def _shows_through(
    start: FloatArray,
    end: FloatArray,
    own: tuple[int, int],
    pixel: IntArray,
    pixel_label: IntArray,
    z: NDArray[np.float32],
    K: FloatArray,
    X_WC: FloatArray,
    voxel: float,
) -> bool:
    """Whether anything but the two clusters shows behind a connection of theirs."""
    p = np.empty(3)
    for step in range(1, _STEPS + 1):
        for k in range(3):
            p[k] = 0.0
            for m in range(3):
                at = start[m] + step / (_STEPS + 1) * (end[m] - start[m])
                p[k] += (at - X_WC[m, 3]) * X_WC[m, k]
        seen = pixel_at(p[0], p[1], p[2], z.shape[0], z.shape[1], K)
        if seen < 0 or not z[seen // z.shape[1], seen % z.shape[1]] > p[2] + voxel:
            continue
        place = _first_at_least(pixel, seen)
        shown = pixel_label[place] if place < len(pixel) and pixel[place] == seen else -1
        if shown != own[0] and shown != own[1]:
            return True
    return False


@njit(cache=True, error_model="numpy")
def joined(
    points: FloatArray,
    label: IntArray,
    pixel: IntArray,
    pixel_label: IntArray,
    z: NDArray[np.float32],
    K: FloatArray,
    X_WC: FloatArray,
    gap: float,
    voxel: float,
    min_size: int,
) -> IntArray:
    """See `drake_oa.geometry.clusters.joined_across_unseen`; z is float32."""
    count = label.max() + 1 if len(label) else 0
    begin, members = members_of(label, count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for i in range(len(label)):
        c = label[i]
        for k in range(3):
            low[c, k], high[c, k] = min(low[c, k], points[i, k]), max(high[c, k], points[i, k])
    name = np.arange(count)
    for i in range(count):
        if begin[i + 1] - begin[i] < min_size:
            continue
        for j in range(i):
            if begin[j + 1] - begin[j] < min_size or name[i] == name[j]:
                continue
            apart = -np.inf
            for k in range(3):
                apart = max(apart, low[i, k] - high[j, k], low[j, k] - high[i, k])
            if apart >= gap:
                continue
            first, second = members[begin[j] : begin[j + 1]], members[begin[i] : begin[i + 1]]
            pairs = _bridges(points, first, second, gap)
            opened = 0
            for b in range(len(pairs)):
                start, end = points[pairs[b, 0]], points[pairs[b, 1]]
                opened += _shows_through(start, end, (i, j), pixel, pixel_label, z, K, X_WC, voxel)
            if len(pairs) and 2 * opened <= len(pairs):
                old, new = name[i], name[j]
                for c in range(count):
                    if name[c] == old:
                        name[c] = new
    return name[label]
