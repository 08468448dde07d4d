"""Voxels, clusters of points, and what a camera sees between them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.cluster_kernels import clustered, joined, nearest_within, pixels_at
from drake_oa.geometry.voxel_kernels import cell_keys


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
    parent = np.arange(len(points))
    if groups is not None:
        _, first, group = np.unique(groups, return_index=True, return_inverse=True)
        parent = np.ascontiguousarray(first[group], dtype=np.int64)
    return clustered(np.require(points, np.float64, ["C", "W"]), float(tolerance), parent)


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
    p_CQ, K = (np.require(a, np.float64, ["C", "W"]) for a in (p_CQ, K))
    return pixels_at(p_CQ, shape[0], shape[1], K)


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
    return joined(
        np.require(means, np.float64, ["C", "W"]),
        label,
        pixel,
        pixel_label,
        np.require(depth, np.float32, ["C", "W"]),
        np.require(K, np.float64, ["C", "W"]),
        np.require(X_WC, np.float64, ["C", "W"]),
        float(gap),
        float(voxel),
        min_size,
    )
