"""Voxel grid and clustering of point clouds: mean point of each voxel, clusters of near points."""

from __future__ import annotations

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, IntArray


def voxel_means(points: FloatArray, voxel: float) -> tuple[FloatArray, IntArray, IntArray]:
    """Averages the points of a cloud in each voxel, a cube of a regular grid.

    The grid has a corner at the origin of the points' frame. Points must be within 2**16 voxels of
    the origin along each axis.

    Args:
        points: (N, 3) points [m].
        voxel: edge of a voxel [m].

    Returns:
        (M, 3) mean points of the M voxels with points [m], sorted by the voxel's position along x,
        then y, then z; (N,) index from 0 to M - 1 of the voxel of each point; (M,) number of points
        in each voxel.
    """
    keys = np.floor(points / voxel) @ [2.0**34, 2.0**17, 1.0]
    # Consecutive points usually share a voxel: sorting only the first of each run is faster.
    first = np.flatnonzero(np.diff(keys, prepend=np.nan))
    _, voxel_of = np.unique(keys[first], return_inverse=True)
    voxel_of = np.repeat(voxel_of, np.diff(first, append=len(keys)))
    count = np.bincount(voxel_of)
    sums = np.stack([np.bincount(voxel_of, along) for along in points.T], axis=1)
    return sums / count[:, None], voxel_of, count


@compiled
def _root(parent: IntArray, i: int) -> int:
    """Finds the root of the set that contains node i in a union-find forest, and shortens the path
    to the root.

    Args:
        parent: parent of each node; a root is its own parent.
        i: index of the node.
    """
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def _unite(points: FloatArray, tolerance: float, parent: IntArray) -> None:
    """Unites the sets of near points in a union-find forest, so that each set becomes a cluster.

    Args:
        points: (N, 3) points, sorted by their first coordinate [m].
        tolerance: maximum distance of two points that are united [m].
        parent: (N,) parent of each point in the forest; after the call, the root.
    """
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            x = points[j, 0] - points[i, 0]
            if x > tolerance:
                break
            y, z = points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
            if x * x + y * y + z * z <= tolerance * tolerance:
                one, other = _root(parent, i), _root(parent, j)
                parent[max(one, other)] = min(one, other)
    for i in range(len(points)):
        parent[i] = _root(parent, i)


def connected_clusters(
    points: FloatArray, tolerance: float, groups: IntArray | None = None
) -> IntArray:
    """Clusters points: two points belong to the same cluster if they are near or in the same given
    group, or are connected by a chain of such pairs.

    Args:
        points: (N, 3) points [m].
        tolerance: maximum distance of two points that count as near [m].
        groups: (N,) number of the group of each point; points with equal numbers are in the same
            cluster at any distance. None: no groups.

    Returns:
        (N,) labels of the points' clusters: 0, 1, ..., in the order of the clusters' first points.
    """
    if not len(points):
        return np.zeros(0, dtype=np.int64)
    longest = int(np.ptp(points, axis=0).argmax())
    order = np.argsort(points[:, longest], kind="stable")
    parent = np.arange(len(points))
    if groups is not None:
        _, first, group = np.unique(groups[order], return_index=True, return_inverse=True)
        parent = first[group]
    _unite(np.roll(points[order], -longest, axis=1), float(tolerance), parent)
    root = np.empty(len(points), dtype=np.int64)
    root[order] = parent
    _, first, label = np.unique(root, return_index=True, return_inverse=True)
    return np.asarray(first.argsort().argsort()[label])
