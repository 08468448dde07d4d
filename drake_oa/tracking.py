"""Obstacles from frame to frame: their names, and what an arm hides of them.

A frame shows only what nothing stands in front of. Points seen before are kept
while no ray reaches them, and dropped as soon as one passes through them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_oa.clusters import connected_clusters, nearest_points, pixels_of, voxel_keys
from drake_oa.point_cloud import Segmentation, SegmentationConfig
from drake_oa.self_filter import PosedShapes
from drake_oa.values import FloatArray, IntArray, ObstacleClouds

_NEAR = 0.03  # points this near to an old one speak for its obstacle [m]
_JUMP = 0.1  # the farthest a centroid moves between two frames [m]
_HIDDEN_MARGIN = 0.03  # depth difference that tells "in front of" from "at" [m]


def fuse(
    previous: ObstacleClouds,
    frame: Segmentation,
    depth: NDArray[np.floating],
    K: FloatArray,
    stamp: float,
    config: SegmentationConfig | None = None,
    robot: PosedShapes | None = None,
    first_new_id: int = 0,
) -> ObstacleClouds:
    """Joins a new frame with what was known before it.

    An old point is kept when the frame cannot tell: its pixel shows something in
    front of it that is not its own obstacle (the arm, another obstacle), has no
    depth (NaN), or lies outside the image; or the robot is where the point is. It
    is dropped when the frame shows its place, empty or not: the frame's own points
    then stand for it. An obstacle behind a parked arm is therefore remembered for
    as long as the arm stays.

    Args:
        previous: the obstacles known so far.
        frame: the new frame, segmented; its X_WC is used.
        depth: (H, W) the depth image of that frame [m]; inf counts as free space.
        K: (4,) fx, fy, cx, cy [pixel].
        stamp: time of the frame [s].
        config: the parameters the frame was segmented with; None for the defaults.
        robot: the robot's primitives at that time, or None.
        first_new_id: new obstacles are named from here on, or from the largest
            previous name + 1 if that is larger.

    Returns:
        The obstacles after the frame, named as before where they match: by common
        points, else by centroids less than 0.1 m apart.
    """
    config = config or SegmentationConfig()
    score = _scores(previous, frame.clouds_W)
    kept, owner = _unobservable(previous, frame, score, np.asarray(depth), K, config, robot)
    new = np.concatenate([np.zeros((0, 3)), *frame.clouds_W])
    if len(kept):
        fresh = ~np.isin(voxel_keys(kept, config.voxel), voxel_keys(new, config.voxel))
        kept, owner = kept[fresh], owner[fresh]
    if not len(kept):
        return _named(previous, frame.clouds_W, score, frame, stamp, first_new_id)
    lengths = [len(cloud) for cloud in frame.clouds_W]
    groups = np.concatenate([np.repeat(np.arange(len(lengths)), lengths), len(lengths) + owner])
    points = np.concatenate([new, kept])
    label = connected_clusters(points, config.cluster_tolerance, groups)
    sizes = np.bincount(label)
    names = np.flatnonzero(sizes >= config.min_cluster_voxels)
    names = names[np.argsort(-sizes[names], kind="stable")]
    clouds = tuple(points[label == name] for name in names)
    return _named(previous, clouds, _scores(previous, clouds), frame, stamp, first_new_id)


def track(
    previous: ObstacleClouds, frame: Segmentation, stamp: float, first_new_id: int = 0
) -> ObstacleClouds:
    """Names the obstacles of a frame as `fuse` does, without memory of hidden ones."""
    score = _scores(previous, frame.clouds_W)
    return _named(previous, frame.clouds_W, score, frame, stamp, first_new_id)


def _unobservable(
    previous: ObstacleClouds,
    frame: Segmentation,
    score: FloatArray,
    depth: NDArray[np.floating],
    K: FloatArray,
    config: SegmentationConfig,
    robot: PosedShapes | None,
) -> tuple[FloatArray, IntArray]:
    """The old points (N, 3) that the frame cannot tell about, and whose they are."""
    if not len(previous):
        return np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    points, owner = _joined(previous)
    X_WC = frame.X_WC
    p_CQ = (points - X_WC[:3, 3]) @ X_WC[:3, :3]
    pixel = pixels_of(p_CQ, depth.shape, K)
    beyond = np.where(pixel >= 0, depth.ravel()[pixel], np.nan) - p_CQ[:, 2]
    at_robot = np.zeros(len(points), dtype=bool)
    if robot is not None:
        at_robot = robot.contains(points, config.robot_margin)
    shown = (np.abs(beyond) <= _HIDDEN_MARGIN) & ~at_robot
    shown |= beyond > _HIDDEN_MARGIN

    # Hidden behind its own obstacle's new surface: the obstacle moved or turned.
    showing = np.full(depth.size, -1, dtype=np.int32)
    voted = np.where(score.max(axis=1) > 0.0, score.argmax(axis=1), -1)
    for old, pixels in zip(voted, frame.pixels, strict=True):
        showing[pixels] = old
    shown |= (pixel >= 0) & (showing[pixel] == owner)
    return points[~shown], owner[~shown]


def _named(
    previous: ObstacleClouds,
    clouds: tuple[FloatArray, ...],
    score: FloatArray,
    frame: Segmentation,
    stamp: float,
    first_new_id: int,
) -> ObstacleClouds:
    ids = np.full(len(clouds), -1, dtype=np.int64)
    left = score.copy()
    for _ in range(min(left.shape)):
        row, column = np.unravel_index(np.argmax(left), left.shape)
        if left[row, column] <= 0.0:
            break
        ids[row] = previous.ids[column]
        left[row], left[:, column] = 0.0, 0.0
    unnamed = np.flatnonzero(ids < 0)
    first = max(first_new_id, int(previous.ids.max(initial=-1)) + 1)
    ids[unnamed] = first + np.arange(len(unnamed))
    for cloud in clouds:
        cloud.flags.writeable = False
    return ObstacleClouds(stamp, clouds, ids, frame.table, frame.note)


def _scores(previous: ObstacleClouds, clouds: tuple[FloatArray, ...]) -> FloatArray:
    """(M_new, M_old): common points; below 1, the nearness of the centroids."""
    if not len(previous) or not clouds:
        return np.zeros((len(clouds), len(previous)))
    old, owner = _joined(previous)
    center = np.stack([cloud.mean(axis=0) for cloud in previous.clouds_W])
    score = np.zeros((len(clouds), len(previous)))
    nearest = nearest_points(np.concatenate(clouds), old, _NEAR)
    starts = np.cumsum([0, *map(len, clouds)])
    for row, cloud in enumerate(clouds):
        found = nearest[starts[row] : starts[row + 1]]
        score[row] = np.bincount(owner[found[found >= 0]], minlength=len(previous))
        gap = np.linalg.norm(center - cloud.mean(axis=0), axis=1)
        score[row] += np.maximum(0.0, 1.0 - gap / _JUMP) * 0.999
    return score


def _joined(clouds: ObstacleClouds) -> tuple[FloatArray, IntArray]:
    lengths = [len(cloud) for cloud in clouds.clouds_W]
    return np.concatenate(clouds.clouds_W), np.repeat(np.arange(len(lengths)), lengths)
