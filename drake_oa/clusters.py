"""Voxels, clusters of points, and what a camera sees between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from drake_oa.point_cloud_kernels import cell_keys, nearest_within, unite_neighbours
from drake_oa.values import FloatArray, IntArray

_BRIDGES = 16  # shortest connections between two clusters that are looked at


def voxel_keys(points: FloatArray, voxel: float) -> IntArray:
    """(N, 3) points -> (N,) integers, equal for points of one voxel.

    The grid is anchored at the origin; coordinates up to 2**20 voxels are told apart.
    """
    return cell_keys(np.require(points, np.float64, ["C", "W"]), float(voxel))


def connected_clusters(
    points: FloatArray, tolerance: float, groups: IntArray | None = None
) -> IntArray:
    """Labels (N,) of points (N, 3): those nearer than ``tolerance`` [m] share one.

    Points of equal ``groups`` (N,) share one too, however far apart.
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    parent = np.arange(len(points))
    if groups is not None:
        _, first, group = np.unique(groups, return_index=True, return_inverse=True)
        parent = np.ascontiguousarray(first[group], dtype=np.int64)
    order, keys = _sorted_cells(points, tolerance)
    unite_neighbours(_rows(points, order), keys, order, float(tolerance), parent)
    # Clusters are numbered in the order of their first points.
    is_root = parent == np.arange(len(points))
    return np.asarray((np.cumsum(is_root) - 1)[parent], dtype=np.int64)


def nearest_points(query: FloatArray, points: FloatArray, radius: float) -> IntArray:
    """Index (Q,) of the point nearest to each query (Q, 3), -1 where none is in reach.

    Args:
        query: (Q, 3) [m].
        points: (N, 3) [m].
        radius: a point is in reach when it is nearer than this [m].
    """
    order, keys = _sorted_cells(points, radius)
    found = nearest_within(
        np.require(query, np.float64, ["C", "W"]), _rows(points, order), keys, float(radius)
    )
    return np.append(order, -1)[found]


def _sorted_cells(points: FloatArray, edge: float) -> tuple[IntArray, IntArray]:
    """Order (N,) of the points by cell of a grid, and their cells' keys in that order."""
    keys = voxel_keys(points, edge)
    order = np.argsort(keys, kind="stable")
    return order, keys[order]


def _rows(points: FloatArray, order: IntArray) -> FloatArray:
    return np.require(points[order], np.float64, ["C", "W"])


def pixels_of(p_CQ: FloatArray, shape: tuple[int, ...], K: FloatArray) -> IntArray:
    """Projects points of the camera frame, (N, 3) [m], to pixels of an (H, W) image.

    Returns:
        (N,) flat indices; -1 for a point behind the camera or outside the image.
    """
    pixel = np.full(len(p_CQ), -1, dtype=np.int64)
    ahead = np.flatnonzero(p_CQ[:, 2] > 1e-6)
    column = np.rint(K[0] * p_CQ[ahead, 0] / p_CQ[ahead, 2] + K[2])
    row = np.rint(K[1] * p_CQ[ahead, 1] / p_CQ[ahead, 2] + K[3])
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    pixel[ahead[inside]] = (row[inside] * shape[1] + column[inside]).astype(np.int64)
    return pixel


def joined_across_unseen(
    means: FloatArray,
    label: IntArray,
    pixel: IntArray,
    pixel_label: IntArray,
    depth: NDArray[np.floating],
    K: FloatArray,
    X_WC: FloatArray,
    *,
    gap: float,
    voxel: float,
    min_size: int,
) -> IntArray:
    """Joins clusters a short gap apart when nothing else shows through the gap.

    The rim and the inside of a bowl are seen apart; so are two boxes with a gap
    between them, but there the table shows through.

    Args:
        means: (N, 3) points in the world frame [m].
        label: (N,) their clusters.
        pixel: (P,) ascending flat indices of the pixels above the table.
        pixel_label: (P,) the cluster that each of them shows, -1 for none.
        depth: (H, W) depth image [m].
        K: (4,) fx, fy, cx, cy [pixel].
        X_WC: (4, 4) pose of the camera.
        gap: the longest gap to join across [m].
        voxel: depth difference that shows something behind the gap [m].
        min_size: clusters of fewer points are left alone.

    Returns:
        (N,) the labels after joining.
    """
    names = np.flatnonzero(np.bincount(label, minlength=1) >= min_size)
    if len(names) < 2:
        return label
    parts = [means[label == name] for name in names]
    lows, highs = (np.stack([f(part, axis=0) for part in parts]) for f in (np.min, np.max))
    label, joined = label.copy(), names.copy()
    steps = np.linspace(0.0, 1.0, 7)[1:-1, None, None]
    for i in range(len(parts)):
        apart = np.maximum(lows[i] - highs, lows - highs[i]).max(axis=1)
        for j in np.flatnonzero(apart[:i] < gap):
            start, end = _bridges(parts[j], parts[i], gap)
            if not len(start):
                continue
            between = (start + steps * (end - start)).reshape(-1, 3)
            p_CQ = (between - X_WC[:3, 3]) @ X_WC[:3, :3]
            seen = pixels_of(p_CQ, depth.shape, K)
            through = depth.ravel()[seen] > p_CQ[:, 2] + voxel
            place = np.minimum(np.searchsorted(pixel, seen), len(pixel) - 1)
            shown = np.where(pixel[place] == seen, pixel_label[place], -1)
            other = (shown != names[i]) & (shown != names[j])
            open_gap = ((seen >= 0) & through & other).reshape(len(steps), -1).any(axis=0)
            if np.count_nonzero(open_gap) <= len(start) / 2:
                label[label == joined[i]] = joined[j]
                joined[joined == joined[i]] = joined[j]
    return label


def _bridges(first: FloatArray, second: FloatArray, gap: float) -> tuple[FloatArray, FloatArray]:
    """The shortest connections, below ``gap``, from points of one cluster to the other's."""
    near_first, near_second = first, second
    for _ in range(2):  # the second time against what the first has left
        near_first = _close_to(near_first, near_second, gap)
        near_second = _close_to(near_second, near_first, gap)
    if not len(near_first) or not len(near_second):
        return near_first[:0], near_first[:0]
    tree = cKDTree(near_second, balanced_tree=False, compact_nodes=False)
    distance, nearest = tree.query(near_first, distance_upper_bound=gap)
    shortest = np.argsort(distance, kind="stable")[:_BRIDGES]
    shortest = shortest[np.isfinite(distance[shortest])]
    return near_first[shortest], near_second[nearest[shortest]]


def _close_to(points: FloatArray, others: FloatArray, gap: float) -> FloatArray:
    """The points within ``gap`` of the axis-aligned box round the others."""
    if not len(points) or not len(others):
        return points[:0]
    beyond = np.maximum(others.min(axis=0) - points, points - others.max(axis=0))
    return np.asarray(points[(beyond <= gap).all(axis=1)])
