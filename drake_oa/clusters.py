"""Voxels, clusters of points, and what a camera sees between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from drake_oa.point_cloud_kernels import nearest_within, unite_neighbours

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

_BRIDGES = 16  # shortest connections between two clusters that are looked at


def voxel_keys(points: FloatArray, voxel: float) -> IntArray:
    """(N, 3) points -> (N,) integers, equal for points of one voxel.

    The grid is anchored at the origin; coordinates up to 2**20 voxels are told apart.
    """
    cell = np.floor(points / voxel).astype(np.int64) + (1 << 20)
    return np.asarray((cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2])


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
        pixel_label: (H * W,) the cluster that each pixel shows, -1 for none.
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
    trees = [cKDTree(means[label == name]) for name in names]
    label, joined = label.copy(), names.copy()
    steps = np.linspace(0.0, 1.0, 7)[1:-1, None, None]
    for i, tree in enumerate(trees):
        for j in range(i):
            distance, nearest = tree.query(trees[j].data, distance_upper_bound=gap)
            close = np.argsort(distance, kind="stable")[:_BRIDGES]
            close = close[np.isfinite(distance[close])]
            if not len(close):
                continue
            start, end = trees[j].data[close], tree.data[nearest[close]]
            between = (start + steps * (end - start)).reshape(-1, 3)
            p_CQ = (between - X_WC[:3, 3]) @ X_WC[:3, :3]
            pixel = pixels_of(p_CQ, depth.shape, K)
            through = depth.ravel()[pixel] > p_CQ[:, 2] + voxel
            other = ~np.isin(pixel_label[pixel], (names[i], names[j]))
            open_gap = ((pixel >= 0) & through & other).reshape(len(steps), -1).any(axis=0)
            if np.count_nonzero(open_gap) <= len(close) / 2:
                label[label == joined[i]] = joined[j]
                joined[joined == joined[i]] = joined[j]
    return label
