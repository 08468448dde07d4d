"""Compiled loops over cells of a grid: voxels, and who is in which.

Every kernel takes writable C-contiguous arrays of float64 and int64, so that numba
compiles each of them once, and caches it on disk.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray, IntArray

# The golden ratio's 64 bits: of the product the uppermost bits are mixed best.
_MIXER = np.uint64(0x9E3779B97F4A7C15)


@njit(cache=True, error_model="numpy")
def _key(points: FloatArray, i: int, edge: float) -> np.int64:
    key = np.int64(0)
    for k in range(3):
        key = (key << 21) | (np.int64(np.floor(points[i, k] / edge)) + (1 << 20))
    return key


@njit(cache=True, error_model="numpy")
def cell_keys(points: FloatArray, edge: float) -> IntArray:
    """See `drake_oa.geometry.clusters.voxel_keys`."""
    keys = np.empty(len(points), dtype=np.int64)
    for i in range(len(points)):
        keys[i] = _key(points, i, edge)
    return keys


@njit(cache=True, error_model="numpy")
def filed(keys: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """As `numbered`, and the hash table (a power of 2,) that finds them again."""
    different = np.empty(len(keys), dtype=np.int64)
    which = np.empty(len(keys), dtype=np.int64)
    bits = 4
    while (1 << bits) < min(2 * len(keys), 1 << 14):
        bits += 1
    while True:
        # A hash table that is at most half full; else once more with a larger one.
        slots = np.full(1 << bits, -1, dtype=np.int64)
        found, full = 0, False
        for i in range(len(keys)):
            key = keys[i]
            slot = np.int64((np.uint64(key) * _MIXER) >> np.uint64(64 - bits))
            while slots[slot] >= 0 and different[slots[slot]] != key:
                slot = (slot + 1) & (len(slots) - 1)
            if slots[slot] < 0:
                if 2 * found >= len(slots):
                    full = True
                    break
                slots[slot] = found
                different[found] = key
                found += 1
            which[i] = slots[slot]
        if not full:
            return different[:found].copy(), which, slots
        bits += 1


# Inlined: counting the references to its arrays would take longer than the look-up.
@njit(cache=True, error_model="numpy", inline="always")
def place_of(key: int, different: IntArray, slots: IntArray, bits: int) -> int:
    """The number of a key in a table of 2^bits from `filed`, -1 when it is not in there."""
    slot = np.int64((np.uint64(key) * _MIXER) >> np.uint64(64 - bits))
    while slots[slot] >= 0 and different[slots[slot]] != key:
        slot = (slot + 1) & (len(slots) - 1)
    return slots[slot]


@njit(cache=True, error_model="numpy")
def members_of(group: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """Where the members of each group begin (C + 1,), and who they are (N,), ascending."""
    begin = np.zeros(count + 1, dtype=np.int64)
    for i in range(len(group)):
        begin[group[i] + 1] += 1
    for g in range(count):
        begin[g + 1] += begin[g]
    members, place = np.empty(len(group), dtype=np.int64), begin.copy()
    for i in range(len(group)):
        members[place[group[i]]] = i
        place[group[i]] += 1
    return begin, members


@njit(cache=True, error_model="numpy")
def numbered(keys: IntArray) -> tuple[IntArray, IntArray]:
    """The different ones (M,) among keys (N,), by first appearance, and which each is (N,)."""
    different, which, _ = filed(keys)
    return different, which


@njit(cache=True, error_model="numpy")
def cells_of(points: FloatArray, edge: float) -> tuple[IntArray, IntArray]:
    """The keys (M,) of the cells that hold points (N, 3), and the cell (N,) of each."""
    return numbered(cell_keys(points, edge))


@njit(cache=True, error_model="numpy")
def cell_means(
    points: FloatArray, cell_of: IntArray, order: IntArray
) -> tuple[FloatArray, IntArray, IntArray]:
    """Means (M, 3), the place (N,) of each point's cell, and counts (M,) in a new order.

    Args:
        points: (N, 3) points [m].
        cell_of: (N,) the cell of each, from `cells_of`; changed.
        order: (M,) the cells in their new order.
    """
    place = np.empty(len(order), dtype=np.int64)
    for m in range(len(order)):
        place[order[m]] = m
    means, count = np.zeros((len(order), 3)), np.zeros(len(order), dtype=np.int64)
    for i in range(len(cell_of)):
        m = place[cell_of[i]]
        cell_of[i] = m
        count[m] += 1
        for k in range(3):
            means[m, k] += points[i, k]
    for m in range(len(order)):
        for k in range(3):
            means[m, k] /= count[m]
    return means, cell_of, count


@njit(cache=True, error_model="numpy")
def points_of_groups(
    group: IntArray, cell_of: IntArray, index: IntArray, count: int
) -> tuple[IntArray, IntArray]:
    """The numbers of the points of each group, one group after the other.

    Args:
        group: (M,) group of each cell, -1 for none.
        cell_of: (N,) cell of each point.
        index: (N,) its number.
        count: C, how many groups there are.

    Returns:
        The numbers, and (C + 1,) where each group begins.
    """
    # Those of no group come last: so the loops need not predict who is in one.
    begin = np.zeros(count + 2, dtype=np.int64)
    own = np.empty(len(group), dtype=np.int64)
    for m in range(len(group)):
        own[m] = group[m] if group[m] >= 0 else count
    for i in range(len(cell_of)):
        begin[own[cell_of[i]] + 1] += 1
    for g in range(count + 1):
        begin[g + 1] += begin[g]
    place, out = begin[:-1].copy(), np.empty(len(cell_of), dtype=np.int64)
    for i in range(len(cell_of)):
        g = own[cell_of[i]]
        out[place[g]] = index[i]
        place[g] += 1
    return out[: begin[count]].copy(), begin[: count + 1].copy()
