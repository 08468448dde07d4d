"""Voxels and clusters of points."""

from __future__ import annotations

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, IntArray


def voxel_means(points: FloatArray, voxel: float) -> tuple[FloatArray, IntArray, IntArray]:
    """Averages points (N, 3) by voxel [m].

    The grid is anchored at the origin and has up to 2**16 voxels along each half axis.

    Returns:
        Means (M, 3) in the order of the voxels, the voxel (N,) of each point, and the number
        of points (M,) of each voxel.
    """
    keys = np.floor(points / voxel) @ [2.0**34, 2.0**17, 1.0]
    # Most points share the voxel of the one before; sorting first points only is faster.
    first = np.flatnonzero(np.diff(keys, prepend=np.nan))
    _, voxel_of = np.unique(keys[first], return_inverse=True)
    voxel_of = np.repeat(voxel_of, np.diff(first, append=len(keys)))
    count = np.bincount(voxel_of)
    sums = np.stack([np.bincount(voxel_of, along) for along in points.T], axis=1)
    return sums / count[:, None], voxel_of, count


@compiled
def _root(parent: IntArray, i: int) -> int:
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@compiled
def _unite(points: FloatArray, tolerance: float, parent: IntArray) -> None:
    """Unites near points (N, 3), ascending along their first axis, in a forest (N,) of sets."""
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
    """Labels (N,) of points (N, 3): those within the tolerance [m] share one.

    Labels are in the order of the first points.
    Points of equal ``groups`` (N,) share one too, at any distance.
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
