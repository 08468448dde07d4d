"""Points by the cells of a grid: voxels, clusters, and what a camera sees between clusters.

Kernels take writable C-contiguous arrays of float64 and int64 (images: float32), so that numba
compiles each of them once, and caches it on disk.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.geometry.pinhole import View, pixel_at

# The golden ratio's 64 bits: of the product the uppermost bits are mixed best.
_MIXER = np.uint64(0x9E3779B97F4A7C15)


@compiled
def _key(points: FloatArray, i: int, edge: float) -> np.int64:
    key = np.int64(0)
    for k in range(3):
        key = (key << 21) | (np.int64(np.floor(points[i, k] / edge)) + (1 << 20))
    return key


@compiled
def cell_keys(points: FloatArray, edge: float) -> IntArray:
    """Keys (N,) of the cells that hold points (N, 3) [m]."""
    keys = np.empty(len(points), dtype=np.int64)
    for i in range(len(points)):
        keys[i] = _key(points, i, edge)
    return keys


def voxel_keys(points: FloatArray, voxel: float) -> IntArray:
    """(N, 3) points -> (N,) integers, equal for points of one voxel.

    The grid is anchored at the origin; coordinates up to 2**20 voxels are told apart.
    """
    return cell_keys(np.require(points, np.float64, ["C", "W"]), float(voxel))


def first_in_voxels(points: FloatArray, voxel: float) -> IntArray:
    """Ascending indices of the points (N, 3) that are the first of their voxel [m]."""
    return np.sort(np.unique(voxel_keys(points, voxel), return_index=True)[1])


@compiled
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
@njit(cache=True, error_model="numpy", inline="always", fastmath=False)
def place_of(key: int, different: IntArray, slots: IntArray, bits: int) -> int:
    """The number of a key in a table of 2^bits from `filed`, -1 when it is not in there."""
    slot = np.int64((np.uint64(key) * _MIXER) >> np.uint64(64 - bits))
    while slots[slot] >= 0 and different[slots[slot]] != key:
        slot = (slot + 1) & (len(slots) - 1)
    return slots[slot]


@compiled
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


@compiled
def numbered(keys: IntArray) -> tuple[IntArray, IntArray]:
    """The different ones (M,) among keys (N,), by first appearance, and which each is (N,)."""
    different, which, _ = filed(keys)
    return different, which


@compiled
def cells_of(points: FloatArray, edge: float) -> tuple[IntArray, IntArray]:
    """The keys (M,) of the cells that hold points (N, 3), and the cell (N,) of each."""
    return numbered(cell_keys(points, edge))


@compiled
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


@compiled
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


_BRIDGES = 16  # shortest connections between two clusters that are looked at
_STEPS = 5  # places along each of them


@compiled
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
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


@compiled
def clustered(points: FloatArray, tolerance: float, parent: IntArray) -> IntArray:
    """Labels (N,) of points; see `connected_clusters`.

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


@compiled
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


@compiled
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


@compiled
def _shows_through(
    start: FloatArray,
    end: FloatArray,
    own: tuple[int, int],
    pixel: IntArray,
    pixel_label: IntArray,
    view: View,
    voxel: float,
) -> bool:
    """Whether anything but the two clusters shows behind a connection of theirs."""
    p, X_WC = np.empty(3), view.X_WC
    rows, columns = view.z.shape
    for step in range(1, _STEPS + 1):
        for k in range(3):
            p[k] = 0.0
            for m in range(3):
                at = start[m] + step / (_STEPS + 1) * (end[m] - start[m])
                p[k] += (at - X_WC[m, 3]) * X_WC[m, k]
        seen = pixel_at(p[0], p[1], p[2], rows, columns, view.K)
        if seen < 0 or not view.z[seen // columns, seen % columns] > p[2] + voxel:
            continue
        place = np.searchsorted(pixel, seen)
        shown = pixel_label[place] if place < len(pixel) and pixel[place] == seen else -1
        if shown != own[0] and shown != own[1]:
            return True
    return False


@compiled
def _gaps_of(
    points: FloatArray, label: IntArray, gap: float, min_size: int
) -> tuple[IntArray, IntArray]:
    """Pairs (P, 3) of clusters less than a gap [m] apart, and what bridges them (B, 2).

    A pair is the later cluster, the earlier one, and the number of its bridges, which follow each
    other: point of the earlier, and of the later.
    """
    count = label.max() + 1 if len(label) else 0
    begin, members = members_of(label, count)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for i in range(len(label)):
        c = label[i]
        for k in range(3):
            low[c, k], high[c, k] = min(low[c, k], points[i, k]), max(high[c, k], points[i, k])
    pairs, bridges = np.empty((16, 3), dtype=np.int64), np.empty((64, 2), dtype=np.int64)
    n, m = 0, 0
    for i in range(count):
        if begin[i + 1] - begin[i] < min_size:
            continue
        for j in range(i):
            if begin[j + 1] - begin[j] < min_size:
                continue
            apart = -np.inf
            for k in range(3):
                apart = max(apart, low[i, k] - high[j, k], low[j, k] - high[i, k])
            if apart >= gap:
                continue
            first, second = members[begin[j] : begin[j + 1]], members[begin[i] : begin[i + 1]]
            found = _bridges(points, first, second, gap)
            if n == len(pairs):
                pairs = np.concatenate((pairs, pairs))
            while m + len(found) > len(bridges):
                bridges = np.concatenate((bridges, bridges))
            pairs[n, 0], pairs[n, 1], pairs[n, 2] = i, j, len(found)
            bridges[m : m + len(found)] = found
            n, m = n + 1, m + len(found)
    return pairs[:n].copy(), bridges[:m].copy()


@compiled
def _mark_open(
    points: FloatArray,
    pairs: IntArray,
    bridges: IntArray,
    pixel: IntArray,
    pixel_label: IntArray,
    view: View,
    voxel: float,
    through: BoolArray,
) -> None:
    """Marks the bridges (B,) behind which an image shows something else."""
    b = 0
    for n in range(len(pairs)):
        own = (pairs[n, 0], pairs[n, 1])
        for _ in range(pairs[n, 2]):
            start, end = points[bridges[b, 0]], points[bridges[b, 1]]
            through[b] |= _shows_through(start, end, own, pixel, pixel_label, view, voxel)
            b += 1


@compiled
def _joined(label: IntArray, pairs: IntArray, through: BoolArray) -> IntArray:
    """The labels (N,) after joining the pairs of which no more than half the bridges are open."""
    name, b = np.arange(label.max() + 1 if len(label) else 0), 0
    for n in range(len(pairs)):
        opened, count = through[b : b + pairs[n, 2]].sum(), pairs[n, 2]
        b += count
        old, new = name[pairs[n, 0]], name[pairs[n, 1]]
        if old != new and count and 2 * opened <= count:
            for c in range(len(name)):
                if name[c] == old:
                    name[c] = new
    return name[label]


def joined_across_unseen(
    points: FloatArray,
    label: IntArray,
    images: Sequence[tuple[IntArray, IntArray, View]],
    gap: float,
    voxel: float,
    min_size: int,
) -> IntArray:
    """Joins clusters a short gap apart when nothing else shows through the gap in any image.

    The rim and the inside of a bowl are seen apart; so are two boxes with a gap
    between them, but there the table shows through.

    Args:
        points: (N, 3) points in the world frame [m].
        label: (N,) their clusters.
        images: of each the ascending flat indices (P,) of its pixels above the table, the cluster
            (P,) that each of them shows, -1 for none, and the image.
        gap: the longest gap to join across [m].
        voxel: depth difference that shows something behind the gap [m].
        min_size: clusters of fewer points are left alone.

    Returns:
        (N,) the labels after joining.
    """
    pairs, bridges = _gaps_of(points, label, gap, min_size)
    through = np.zeros(len(bridges), dtype=bool)
    for pixel, pixel_label, view in images:
        _mark_open(points, pairs, bridges, pixel, pixel_label, view, voxel, through)
    return _joined(label, pairs, through)


def connected_clusters(
    points: FloatArray, tolerance: float, groups: IntArray | None = None
) -> IntArray:
    """Labels (N,) of points (N, 3): those nearer than ``tolerance`` [m] share one.

    Points of equal ``groups`` (N,) share one too, however far apart.
    """
    parent = np.arange(len(points))
    if groups is not None:
        _, first, group = np.unique(groups, return_index=True, return_inverse=True)
        parent = np.ascontiguousarray(first[group], dtype=np.int64)
    return clustered(np.require(points, np.float64, ["C", "W"]), float(tolerance), parent)
