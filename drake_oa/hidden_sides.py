"""What a camera does not see: the far side of a thing, as deep as the thing is broad."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from drake_oa.clusters import voxel_keys
from drake_oa.values import FloatArray, ObstacleClouds

VOXEL = 0.02
"""Edge of the voxels that points are thinned to [m]."""
_DEEPEST = 0.08
"""A thing that is seen from one side is taken to be at most so deep [m]."""
_TOO_NEAR = 0.05
"""A viewpoint so near above a thing says nothing of its depth [m]."""


def with_hidden_sides(
    obstacles: ObstacleClouds, viewpoint_W: FloatArray, moved: frozenset[int] = frozenset()
) -> ObstacleClouds:
    """The obstacles, those that move or have moved with a far side.

    What moves toward a link from behind is nearer than the side of it that is seen, and is so
    still when it has come to rest beside the link. What has always rested is left as it is: a
    link may pass behind it.

    Args:
        obstacles: what is seen.
        viewpoint_W: (3,) from where [m].
        moved: names of those that have moved.

    Returns:
        `obstacles` itself where none has.
    """
    deep = [
        bool(v_WO.any()) or int(name) in moved
        for name, v_WO in zip(obstacles.ids, obstacles.v_WO, strict=True)
    ]
    if not any(deep):
        return obstacles
    clouds = tuple(
        np.concatenate([cloud, deepened(thinned(cloud), viewpoint_W)]) if is_deep else cloud
        for cloud, is_deep in zip(obstacles.clouds_W, deep, strict=True)
    )
    return replace(obstacles, clouds_W=clouds)


def names_moved(obstacles: ObstacleClouds, before: frozenset[int]) -> frozenset[int]:
    """The names of the obstacles that move now, or did before and are still there."""
    moving = obstacles.v_WO.any(axis=1)
    return frozenset(
        int(name)
        for name, moves in zip(obstacles.ids, moving, strict=True)
        if moves or int(name) in before
    )


def deepened(cloud: FloatArray, viewpoint_W: FloatArray) -> FloatArray:
    """The points, and behind them, horizontally, more layers of them.

    Args:
        cloud: (N, 3) points of a thing [m].
        viewpoint_W: (3,) from where they were seen [m]; (0,): from all sides.

    Returns:
        (N', 3) points, so deep along the view as they are broad across it, at most 8 cm.
    """
    if not len(viewpoint_W) or not len(cloud):
        return cloud
    away = cloud.mean(axis=0)[:2] - viewpoint_W[:2]
    distance = float(np.linalg.norm(away))
    if distance < _TOO_NEAR:
        return cloud
    away /= distance
    across = cloud[:, :2] @ np.array([-away[1], away[0]])
    along = cloud[:, :2] @ away
    depth = min(float(np.ptp(across)), _DEEPEST) - float(np.ptp(along))
    if depth <= 0.0:
        return cloud
    layers = np.linspace(0.0, depth, 1 + math.ceil(depth / VOXEL))
    moved = cloud + layers[:, None, None] * np.append(away, 0.0)
    return thinned(moved.reshape(-1, 3))


def thinned(cloud: FloatArray) -> FloatArray:
    """One point of each voxel of 2 cm of a cloud (N, 3) [m]."""
    if len(cloud) < 2:
        return np.array(cloud, dtype=float)
    _, first = np.unique(voxel_keys(cloud, VOXEL), return_index=True)
    return np.asarray(cloud[np.sort(first)], dtype=float)
