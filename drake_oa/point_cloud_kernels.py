"""Compiled loops behind perception: images, voxels, neighbours, the robot's shapes.

Call the functions of `point_cloud`, `table_plane`, `clusters` and `self_filter`
instead. Every kernel takes writable C-contiguous arrays of one type (float64 and
int64 unless a comment says otherwise), so that numba compiles each of them once,
and caches it on disk.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_oa.values import BoolArray, FloatArray, IntArray


@njit(cache=True, error_model="numpy")
def sampled(
    z: NDArray[np.float32], stride: int, near: float, far: float
) -> tuple[IntArray, IntArray]:
    """The pixels with a depth in [near, far] on every stride-th row and column.

    Returns:
        (N,) their flat indices in that coarser image, and (N,) in the image itself.
    """
    rows, columns = (z.shape[0] - 1) // stride + 1, (z.shape[1] - 1) // stride + 1
    coarse = np.empty(rows * columns, dtype=np.int64)
    fine = np.empty(rows * columns, dtype=np.int64)
    n = 0
    for row in range(rows):
        for column in range(columns):
            depth = z[row * stride, column * stride]
            if depth >= near and depth <= far:
                coarse[n] = row * columns + column
                fine[n] = row * stride * z.shape[1] + column * stride
                n += 1
    return coarse[:n].copy(), fine[:n].copy()


@njit(cache=True, error_model="numpy")
def pixels_between(
    z: NDArray[np.float32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    limits: NDArray[np.float32],
) -> IntArray:
    """Flat indices of the pixels whose height over a plane is within limits.

    The height above the plane less the noise is ``z (u + v) - offset``.

    Args:
        z: (H, W) float32 depth [m].
        u: (W,) float32 share of the column.
        v: (H,) float32 share of the row.
        limits: (5,) float32 near, far, lowest ``z (u + v)``, noise per depth, and
            highest ``z (u + v + noise)``.
    """
    near, far, low, noise, high = limits
    # A mask first, then its places, both without branches: so the first loop uses
    # vector instructions, and the second need not predict the outcomes.
    inside = np.empty(z.shape, dtype=np.uint8)
    count = 0
    for row in range(z.shape[0]):
        for column in range(z.shape[1]):
            depth = z[row, column]
            raised = depth * (u[column] + v[row])
            seen = (depth >= near) & (depth <= far)
            inside[row, column] = seen & (raised > low) & (raised + noise * depth < high)
        for column in range(z.shape[1]):
            count += inside[row, column]
    out = np.empty(count + 1, dtype=np.int64)
    n = 0
    for row in range(z.shape[0]):
        for column in range(z.shape[1]):
            out[n] = row * z.shape[1] + column
            n += inside[row, column]
    return out[:count]


@njit(cache=True, error_model="numpy")
def back_projected(z: NDArray[np.float32], index: IntArray, K: FloatArray) -> FloatArray:
    """Points (N, 3) in the camera frame of the pixels with ascending flat indices (N,)."""
    p_CQ = np.empty((len(index), 3))
    row, start = 0, 0
    for i in range(len(index)):
        while index[i] >= start + z.shape[1]:
            row += 1
            start += z.shape[1]
        column = index[i] - start
        depth = z[row, column]
        p_CQ[i, 0] = (column - K[2]) * (depth / K[0])
        p_CQ[i, 1] = (row - K[3]) * (depth / K[1])
        p_CQ[i, 2] = depth
    return p_CQ


@njit(cache=True, error_model="numpy")
def cropped_to_world(
    p_CQ: FloatArray, index: IntArray, axes: FloatArray, reach: FloatArray, X_WC: FloatArray
) -> tuple[FloatArray, IntArray]:
    """The points whose coordinates along two axes are in reach, in the world frame.

    Args:
        p_CQ: (N, 3) points in the camera frame [m].
        index: (N,) their numbers, handed through.
        axes: (2, 3) unit vectors in the camera frame.
        reach: (2, 2) lowest and highest coordinate along each axis [m].
        X_WC: (4, 4) pose of the camera.
    """
    p_WQ = np.empty(p_CQ.shape)
    kept = np.empty(len(index), dtype=np.int64)
    n = 0
    for i in range(len(index)):
        x, y, z = p_CQ[i, 0], p_CQ[i, 1], p_CQ[i, 2]
        inside = True
        for k in range(2):
            along = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z
            inside &= (along >= reach[k, 0]) & (along <= reach[k, 1])
        kept[n] = index[i]
        for k in range(3):
            p_WQ[n, k] = X_WC[k, 0] * x + X_WC[k, 1] * y + X_WC[k, 2] * z + X_WC[k, 3]
        n += inside
    return p_WQ[:n], kept[:n]


@njit(cache=True, error_model="numpy")
def _key(points: FloatArray, i: int, edge: float) -> np.int64:
    key = np.int64(0)
    for k in range(3):
        key = (key << 21) | (np.int64(np.floor(points[i, k] / edge)) + (1 << 20))
    return key


@njit(cache=True, error_model="numpy")
def cell_keys(points: FloatArray, edge: float) -> IntArray:
    """See `drake_oa.clusters.voxel_keys`."""
    keys = np.empty(len(points), dtype=np.int64)
    for i in range(len(points)):
        keys[i] = _key(points, i, edge)
    return keys


@njit(cache=True, error_model="numpy")
def numbered(keys: IntArray) -> tuple[IntArray, IntArray]:
    """The different ones (M,) among keys (N,), by first appearance, and which each is (N,)."""
    different = np.empty(len(keys), dtype=np.int64)
    which = np.empty(len(keys), dtype=np.int64)
    bits, found, done = 12, 0, False
    while not done:
        # A hash table that is at most half full; else once more with a larger one.
        bits += 1
        slots = np.full(1 << bits, -1, dtype=np.int64)
        found, done = 0, True
        for i in range(len(keys)):
            key = keys[i]
            mixed = np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)
            slot = np.int64(mixed >> np.uint64(64 - bits))
            while slots[slot] >= 0 and different[slots[slot]] != key:
                slot = (slot + 1) & (len(slots) - 1)
            if slots[slot] < 0:
                if 2 * found >= len(slots):
                    done = False
                    break
                slots[slot] = found
                different[found] = key
                found += 1
            which[i] = slots[slot]
    return different[:found].copy(), which


@njit(cache=True, error_model="numpy")
def sums(points: FloatArray, group: IntArray, count: IntArray, total: FloatArray) -> None:
    """Adds points (N, 3), and their number, to the sums (M, 3) and counts (M,) of groups."""
    for i in range(len(group)):
        g = group[i]
        count[g] += 1
        for k in range(3):
            total[g, k] += points[i, k]


@njit(cache=True, error_model="numpy")
def within_halfplanes(
    points: FloatArray, axes: FloatArray, directions: FloatArray, reach: FloatArray
) -> BoolArray:
    """Which points lie, seen along a normal, in a convex region of the plane.

    Args:
        points: (N, 3) points [m].
        axes: (2, 3) axes of the plane.
        directions: (D, 2) outer normals of the half-planes, along these axes.
        reach: (D,) how far each half-plane reaches along its normal [m].
    """
    inside = np.ones(len(points), dtype=np.bool_)
    for i in range(len(points)):
        a, b = 0.0, 0.0
        for k in range(3):
            a += axes[0, k] * points[i, k]
            b += axes[1, k] * points[i, k]
        for k in range(len(reach)):
            if directions[k, 0] * a + directions[k, 1] * b > reach[k]:
                inside[i] = False
                break
    return inside


@njit(cache=True, error_model="numpy")
def votes_for_planes(
    normals: FloatArray, offsets: FloatArray, points: FloatArray, tolerance: FloatArray
) -> IntArray:
    """How many points (N, 3) lie within their tolerance (N,) of each plane (M,)."""
    votes = np.zeros(len(offsets), dtype=np.int64)
    # The points' coordinates in rows: a loop along them uses vector instructions.
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    for m in range(len(offsets)):
        a, b, c, offset = normals[m, 0], normals[m, 1], normals[m, 2], offsets[m]
        n = 0
        for i in range(len(tolerance)):
            n += abs(a * x[i] + b * y[i] + c * z[i] - offset) < tolerance[i]
        votes[m] = n
    return votes


@njit(cache=True, error_model="numpy")
def on_plane(
    points: FloatArray, tolerance: FloatArray, plane: FloatArray, among: BoolArray, out: BoolArray
) -> float:
    """Marks, of some points (N, 3), those nearer to a plane than their tolerance (N,).

    Args:
        points: (N, 3) points [m].
        tolerance: (N,) [m].
        plane: (4,) unit normal and offset.
        among: (N,) which points are asked about.
        out: (N,) written.

    Returns:
        The sum of their squared distances [m^2].
    """
    total = 0.0
    for i in range(len(tolerance)):
        height = -plane[3]
        for k in range(3):
            height += plane[k] * points[i, k]
        out[i] = among[i] and abs(height) < tolerance[i]
        total += height * height if out[i] else 0.0
    return total


@njit(cache=True, error_model="numpy")
def band_moments(
    points: FloatArray, tolerance: FloatArray, plane: FloatArray, band: float, out: FloatArray
) -> int:
    """Weighted moments of the points within ``band * tolerance`` of a plane.

    Args:
        points: (N, 3) points [m].
        tolerance: (N,) [m]; the weights are 1 / tolerance^2.
        plane: (4,) unit normal and offset.
        band: share of the tolerance.
        out: (4, 4) written: the sum of w p p^T with p = (x, y, z, 1), each point
            taken from the first one of the band for the sake of precision; its
            index is returned.

    Returns:
        The index of that point, or -1 when there are fewer than 3.
    """
    out[:] = 0.0
    first, count = -1, 0
    p = np.ones(4)
    for i in range(len(tolerance)):
        height = -plane[3]
        for k in range(3):
            height += plane[k] * points[i, k]
        if abs(height) >= band * tolerance[i]:
            continue
        if first < 0:
            first = i
        count += 1
        weight = 1.0 / (tolerance[i] * tolerance[i])
        for k in range(3):
            p[k] = points[i, k] - points[first, k]
        for k in range(4):
            for j in range(k + 1):
                out[k, j] += weight * p[k] * p[j]
    for k in range(4):
        for j in range(k):
            out[j, k] = out[k, j]
    return first if count >= 3 else -1


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
def unite_neighbours(
    points: FloatArray, keys: IntArray, order: IntArray, tolerance: float, parent: IntArray
) -> None:
    """Unites, in a forest of parents, the points within a tolerance of each other.

    Args:
        points: (N, 3) points [m], sorted by key.
        keys: (N,) their keys in cells of edge ``tolerance``, ascending, z in the
            lowest bits: the cells of a column follow each other.
        order: (N,) number of each sorted point in the forest.
        tolerance: [m].
        parent: (N,) the forest, changed: the root of a set is its least number, and
            on return the parent of each of its members.
    """
    # Half of the neighbouring columns; the other half finds this cell itself.
    columns = (np.int64(1) << 21, (np.int64(1) << 42) - (np.int64(1) << 21), np.int64(1) << 42,
               (np.int64(1) << 42) + (np.int64(1) << 21))  # fmt: skip
    n, start = len(keys), 0
    while start < n:
        key, stop = keys[start], start
        while stop < n and keys[stop] == key:
            stop += 1
        for column in range(-1, 4):
            if column < 0:
                low, last = start, key + 1
            else:
                low, last = (
                    _first_at_least(keys, key + columns[column] - 1),
                    key + columns[column] + 1,
                )
            high = low
            while high < n and keys[high] <= last:
                high += 1
            for i in range(start, stop):
                own = _root(parent, order[i])
                for j in range(max(low, i + 1), high):
                    other = _root(parent, order[j])
                    if own == other:
                        continue
                    distance2 = 0.0
                    for k in range(3):
                        distance2 += (points[i, k] - points[j, k]) ** 2
                    if distance2 <= tolerance * tolerance:
                        low_root = min(own, other)
                        parent[max(own, other)] = low_root
                        own = low_root
        start = stop
    for i in range(n):
        parent[i] = _root(parent, i)


@njit(cache=True, error_model="numpy")
def nearest_within(
    query: FloatArray, points: FloatArray, keys: IntArray, radius: float
) -> IntArray:
    """For each query the sorted place of the nearest point nearer than a radius, or -1.

    Args:
        query: (Q, 3) points [m].
        points: (N, 3) points [m], sorted by key.
        keys: (N,) their keys in cells of edge ``radius``, as in `unite_neighbours`.
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
def in_shapes(
    points: FloatArray, X_WG: FloatArray, size: FloatArray, margin: float, round_section: bool
) -> BoolArray:
    """Which points (N, 3) lie within a margin of rounded boxes, or of cylinders.

    Args:
        points: (N, 3) points in the world frame [m].
        X_WG: (S, 4, 4) poses of the shapes.
        size: (S, 4) half extents and rounding radius [m]; of a cylinder along z the
            first is its radius, the second is unused.
        margin: [m].
        round_section: whether the shapes are cylinders.
    """
    inside = np.zeros(len(points), dtype=np.bool_)
    p = np.empty(3)
    for s in range(len(size)):
        side = 0.0 if round_section else size[s, 1]
        reach = size[s, 3] + margin
        bound = reach + np.sqrt(size[s, 0] ** 2 + side * side + size[s, 2] ** 2)
        X = X_WG[s]
        for i in range(len(points)):
            x, y, z = points[i, 0] - X[0, 3], points[i, 1] - X[1, 3], points[i, 2] - X[2, 3]
            if inside[i] or x * x + y * y + z * z > bound * bound:
                continue
            for k in range(3):
                p[k] = abs(X[0, k] * x + X[1, k] * y + X[2, k] * z)
            if round_section:
                p[0], p[1] = np.sqrt(p[0] * p[0] + p[1] * p[1]), 0.0
            beyond = 0.0
            for k in range(3):
                half = side if k == 1 else size[s, k]
                beyond += max(p[k] - half, 0.0) ** 2
            inside[i] = beyond <= reach * reach
    return inside
