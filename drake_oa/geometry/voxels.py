"""Points by the cells of a grid: voxels, clusters, and what a camera sees between clusters.

Kernels take writable C-contiguous arrays of float64 and int64 (images: float32), so that numba
compiles each of them once, and caches it on disk.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.geometry.pinhole import View, pixel_at

# The golden ratio's 64 bits: of the product the uppermost bits are mixed best.
_MIXER = np.uint64(0x9E3779B97F4A7C15)


@compiled
def cell_keys(points: FloatArray, edge: float) -> IntArray:
    """Keys (N,) of the cells that hold points (N, 3) [m]."""
    keys = np.zeros(len(points), dtype=np.int64)
    for i in range(len(points)):
        for k in range(3):
            cell = np.int64(np.floor(points[i, k] / edge))
            keys[i] = (keys[i] << 21) | (cell + (1 << 20))
    return keys


def voxel_keys(points: FloatArray, voxel: float) -> IntArray:
    """(N, 3) points -> (N,) integers, equal for points of one voxel.

    The grid is anchored at the origin; coordinates up to 2**20 voxels are told apart.
    """
    return cell_keys(np.require(points, np.float64, ["C", "W"]), float(voxel))


@compiled
def filed(keys: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Finds the different keys among keys (N,).

    Returns:
        The different keys (M,) by first appearance, the number (N,) of each key among them, and
        the hash table (a power of 2,) that finds them again.
    """
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


@compiled
def members_of(group: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """Sorts members by group: begin of each group (C + 1,), and members (N,), ascending in each."""
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


def voxel_means(points: FloatArray, voxel: float) -> tuple[FloatArray, IntArray, IntArray]:
    """Averages points (N, 3) by voxel [m].

    Returns:
        Means (M, 3) in the order of the voxels' keys, the voxel (N,) of each point, and the number
        of points (M,) of each voxel.
    """
    keys, voxel_of, _ = filed(voxel_keys(points, voxel))
    place = np.empty(len(keys), dtype=np.int64)
    place[np.argsort(keys)] = np.arange(len(keys))
    voxel_of = place[voxel_of]
    count = np.bincount(voxel_of)
    return _sums(points, voxel_of, len(count)) / count[:, None], voxel_of, count


@compiled
def _sums(points: FloatArray, group: IntArray, count: int) -> FloatArray:
    """Adds up points (N, 3) by their groups (N,), (count, 3)."""
    sums = np.zeros((count, 3))
    for i in range(len(group)):
        for k in range(3):
            sums[group[i], k] += points[i, k]
    return sums


def points_of_groups(
    group: IntArray, cell_of: IntArray, index: IntArray, count: int
) -> tuple[IntArray, IntArray]:
    """Collects the numbers of the points of each group, one group after the other.

    Args:
        group: (M,) group of each cell, -1 for none.
        cell_of: (N,) cell of each point.
        index: (N,) its number.
        count: number C of groups.

    Returns:
        The numbers, and (C + 1,) where each group begins.
    """
    # Those of no group come last.
    begin, members = members_of(np.where(group < 0, count, group)[cell_of], count + 1)
    return index[members[: begin[count]]], begin[: count + 1]


_BRIDGES = 16  # shortest connections between two clusters that are looked at
_STEPS = 5  # places along each of them


@compiled
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def clustered(points: FloatArray, tolerance: float, parent: IntArray) -> IntArray:
    """Labels (N,) of points; see `connected_clusters`.

    Args:
        points: (N, 3) points [m].
        tolerance: points as near as this belong together [m].
        parent: (N,) a forest of sets of points that do too, changed: no parent has a
            higher number than its child.
    """
    cells, cell_of, slots = filed(cell_keys(points, tolerance))
    bits = 0
    while (1 << bits) < len(slots):
        bits += 1
    begin, members = members_of(cell_of, len(cells))
    whole = np.ones(len(cells), dtype=np.bool_)
    # A cell itself, then half of its neighbours; the other half finds this cell itself.
    for number in range(13, 27):
        a, b, c = number // 9 - 1, number // 3 % 3 - 1, number % 3 - 1
        for cell in range(len(cells)):
            key = cells[cell] + a * (np.int64(1) << 42) + b * (np.int64(1) << 21) + c
            slot = np.int64((np.uint64(key) * _MIXER) >> np.uint64(64 - bits))
            while slots[slot] >= 0 and cells[slots[slot]] != key:
                slot = (slot + 1) & (len(slots) - 1)
            near = slots[slot]
            if near < 0:
                continue
            # Of what belongs together already there is nothing to unite.
            own, other = _root(parent, members[begin[cell]]), _root(parent, members[begin[near]])
            if number > 13 and whole[cell] and whole[near] and own == other:
                continue
            for i in members[begin[cell] : begin[cell + 1]]:
                own = _root(parent, i)
                for j in members[begin[near] : begin[near + 1]]:
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
        if number == 13:
            for i in range(len(points)):
                cell = cell_of[i]
                whole[cell] &= _root(parent, i) == _root(parent, members[begin[cell]])
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


def _bridges(first: FloatArray, second: FloatArray, gap: float) -> tuple[FloatArray, FloatArray]:
    """Finds the shortest connections below a gap [m] from points of a cluster to those of another.

    Args:
        first: (N, 3) points of the one [m].
        second: (M, 3) points of the other [m].
        gap: longest length [m].

    Returns:
        (B, 3) points of the first, and (B, 3) the nearest ones of the second.
    """
    length, nearest = cKDTree(second).query(first, distance_upper_bound=gap)
    order = np.argsort(length, kind="stable")[:_BRIDGES]
    order = order[length[order] < gap]
    return first[order], second[nearest[order]]


def _are_open(
    bridges: tuple[FloatArray, FloatArray],
    clusters: tuple[int, int],
    image: tuple[IntArray, IntArray, View],
    voxel: float,
) -> BoolArray:
    """Checks behind which bridges (B,) of two clusters an image shows anything but these."""
    pixel, pixel_label, view = image
    start, end = bridges
    share = np.arange(1, _STEPS + 1)[:, None, None] / (_STEPS + 1)
    p_C = (start + share * (end - start) - view.X_WC[:3, 3]) @ view.X_WC[:3, :3]
    seen = pixel_at(p_C, view.z.shape, view.K)
    behind = (seen >= 0) & (view.z.ravel()[seen] > p_C[..., 2] + voxel)
    place = np.minimum(np.searchsorted(pixel, seen), max(len(pixel) - 1, 0))
    own = np.isin(pixel_label[place], clusters) & (pixel[place] == seen) if len(pixel) else False
    return (behind & ~np.asarray(own)).any(axis=0)


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
    if not len(label):
        return label
    name = np.arange(label.max() + 1)
    begin, members = members_of(label, len(name))
    points = points[members]
    clusters = np.split(points, begin[1:-1])
    low = np.minimum.reduceat(points, begin[:-1]) - gap
    high = np.maximum.reduceat(points, begin[:-1]) + gap
    near = ((low[:, None] + gap < high) & (low < high[:, None] - gap)).all(axis=2)
    near &= np.diff(begin) >= min_size
    for later, earlier in np.argwhere(np.tril(near & near.T, -1)):
        first, second = clusters[earlier], clusters[later]
        # Only points near the other's box can be as near as this to its points.
        first = first[((low[later] <= first) & (first <= high[later])).all(axis=1)]
        second = second[((low[earlier] <= second) & (second <= high[earlier])).all(axis=1)]
        if not len(first) or not len(second):
            continue
        bridges = _bridges(first, second, gap)
        through = np.zeros(len(bridges[0]), dtype=bool)
        for image in images:
            through |= _are_open(bridges, (later, earlier), image, voxel)
        if len(through) and 2 * through.sum() <= len(through):
            name[name == name[later]] = name[earlier]
    return name[label]


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
