"""From depth images of one instant, or a cloud, to one cluster of points for each obstacle.

The order keeps a 640x480 frame cheap: the supporting plane from a subsample,
the height of every pixel above it (one linear map on the image), then points,
voxels and clusters of only those pixels that stand on the plane. Without a table every pixel
that is not the robot's counts. Up to the points each image goes its own way; voxels and clusters
are of the points of all.

Frames: W world, C depth camera (x right, y down, z forward). Poses are (4, 4)
homogeneous matrices, as ``RigidTransform.GetAsMatrix4()`` gives them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.messages import BoolArray, FloatArray, IntArray, TablePlane, zeros
from drake_oa.geometry.pinhole import View
from drake_oa.geometry.solids import Solids, least_distances
from drake_oa.geometry.voxels import (
    connected_clusters,
    filed,
    joined_across_unseen,
    points_of_groups,
    voxel_means,
)
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.depth_image import (
    back_projected,
    cropped_to_world,
    pixels_between,
    sampled,
)
from drake_oa.perception.table import (
    DEPTH_NOISE,
    HEIGHT_TOLERANCE,
    LEAST_SHARE,
    PlaneFit,
    beyond_extent,
    find_table,
    plane_axes,
    seen_extent,
)

_DEVIATIONS = 6.0
"""Standard deviations of depth that may look like a height."""
_WARP_START = 1.1
"""Depth from which structured-light cameras bend a plane (docs/results/real_scans.md) [m]."""
_WARP = 0.15
"""Height that the bend adds to a plane, by the square of the depth beyond `_WARP_START` [1/m]."""
_LARGEST_WARP = 0.04
"""Largest height that the bend adds to a plane [m]."""
_HIGHER_SHARE = 0.1
"""Share of the voxels of a cluster that must be higher than noise and bend."""
UNSEEN_GAP = 0.06
"""Distance up to which clusters are one where nothing shows through the gap between them [m]."""


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What stands on the table in one frame; without a table, all that is not the robot.

    Attributes:
        clouds_W: one (N_i, 3) array an obstacle: the mean point of each voxel, in
            the world frame [m]; the largest cluster first.
        pixels: for each cluster the flat indices (row-major) of its pixels, those of a further
            image counted on from the one before, or of its input points when the frame was a
            cloud.
        table: the supporting plane in the world frame, or None.
        points_W: (N, 3) every single point over the table (without one, all), the robot's
            included, in the world frame [m]: for viewing.
        plane_rms: rms distance of the plane's points from it [m]; NaN without plane.
        X_WC: (4, 4) the pose of the first camera; when it was not given, the pose that makes
            the table the plane z = 0 (see `segment_depth`).
        usable: whether the table was found, or none is there: else it tells nothing of obstacles.
        note: empty, or why it was not, in words.
        views: the images that tell of obstacles; none of a cloud.
        blind: number of each image that does not, and why.
    """

    clouds_W: tuple[FloatArray, ...] = ()
    pixels: tuple[IntArray, ...] = ()
    table: TablePlane | None = None
    points_W: FloatArray = zeros(0, 3)
    plane_rms: float = np.nan
    X_WC: FloatArray = field(default_factory=lambda: np.eye(4))
    usable: bool = True
    note: str = ""
    views: tuple[View, ...] = ()
    blind: dict[int, str] = field(default_factory=dict)

    def pixels_in(self, image: int) -> tuple[IntArray, ...]:
        """For each cluster its ascending pixels in one of `views`, counted in that image."""
        if len(self.views) == 1:
            return self.pixels
        begin = sum(view.z.size for view in self.views[:image])
        ends = begin, begin + self.views[image].z.size
        return tuple(part[slice(*np.searchsorted(part, ends))] - begin for part in self.pixels)


def _unusable(X_WC: FloatArray | None, note: str) -> Segmentation:
    return Segmentation(X_WC=np.eye(4) if X_WC is None else X_WC, usable=False, note=note)


def segment_depth(
    depth: NDArray[np.floating],
    K: FloatArray,
    X_WC: FloatArray | None,
    config: SegmentationConfig | None = None,
    robot: Solids | None = None,
) -> Segmentation:
    """Segments a depth image into the table and one cluster an obstacle.

    When the pose of the camera is unknown the table defines the world: z along its
    normal (towards the camera), the origin where the optical axis meets it (or at
    the foot of the camera when it does not), x along the camera's x axis.

    Args:
        depth: (H, W) depth along the optical axis [m]; 0 (too near), inf (too far)
            and NaN (missing) are ignored.
        K: (4,) fx, fy, cx, cy [pixel].
        X_WC: (4, 4) pose of the camera, or None when unknown.
        config: the parameters; None for the defaults.
        robot: the robot's solids at the time of the image, or None.

    Returns:
        The segmentation. A frame that shows no table is no error: it has no clouds
        and a note.

    Raises:
        ValueError: for an array of the wrong shape or type, an invalid K or X_WC, or none where
            `config.table` says that there is no table.
    """
    return segment_views([(depth, K, X_WC)], config, robot)


def segment_views(
    views: Sequence[View] | Sequence[tuple[Any, Any, Any]],
    config: SegmentationConfig | None = None,
    robot: Solids | None = None,
) -> Segmentation:
    """Segments depth images of one instant together; otherwise as `segment_depth`.

    An image in which no table is found, or another one than in the image that shows most of it, is
    taken to show that of the others. One that shows
    hardly anything is left out, and named in `blind`; if that is so of all of them, the frame is
    not usable.

    Args:
        views: one or more depth images: depth, K and X_WC of each, as `segment_depth` has them.
        config: the parameters; None for the defaults.
        robot: the robot's solids at the time of the images, or None.

    Raises:
        ValueError: as `segment_depth` does.
    """
    config = config or SegmentationConfig()
    seen = [_looked_at(depth, K, X_WC, config) for depth, K, X_WC in views]
    # The table of the image that shows most of it.
    supports = [image.support for image in seen if image.support is not None]
    most = max(supports, key=lambda support: support.plane.inliers.sum(), default=None)
    table = None if most is None else most.table_W
    # Of an image without the table the others' will do, if it shows anything.
    blind = {
        number: image.note
        for number, image in enumerate(seen)
        if image.note and (table is None or image.note != _NO_TABLE)
    }
    if len(blind) == len(seen):
        return replace(_unusable(seen[0].X_WC, seen[0].note), blind=blind)
    standing = [
        _standing_in(image, table, config)
        for number, image in enumerate(seen)
        if number not in blind
    ]
    return replace(_cluster(standing, table, config, robot), blind=blind)


def segment_points(
    points: FloatArray,
    X_WC: FloatArray | None,
    config: SegmentationConfig | None = None,
    robot: Solids | None = None,
) -> Segmentation:
    """Segments a cloud without image structure; otherwise as `segment_depth`.

    Args:
        points: (N, 3) points [m] in the frame C that X_WC places: the camera's, or
            the world itself with the identity. Rows that are not finite, or all
            zero, are ignored; there is no crop by depth.
        X_WC: (4, 4) pose of that frame, or None when unknown.
        config: the parameters; None for the defaults.
        robot: the robot's solids at the time of the cloud, or None.

    Raises:
        ValueError: for an array of the wrong shape or type or an invalid X_WC.
    """
    config = config or SegmentationConfig()
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3 or not np.issubdtype(points.dtype, np.floating):
        raise ValueError(
            f"points must be an (N, 3) array of floats, not {points.dtype} {points.shape}"
        )
    X_WC = _valid_pose(X_WC)
    index = np.flatnonzero(np.isfinite(points).all(axis=1) & (points != 0.0).any(axis=1))
    if not len(index):
        return _unusable(X_WC, "no valid point")
    p_CQ = np.require(points[index], np.float64, ["C", "W"])
    if not config.table:
        return _cluster([_Standing(p_CQ, index, None, _pose_known(X_WC))], None, config, robot)
    distance = np.linalg.norm(p_CQ, axis=1)
    step = max(1, len(index) // 20_000)
    sample = p_CQ[::step]
    plane = find_table(sample, distance[::step], X_WC, config.table_height)
    if plane is None:
        return _unusable(X_WC, _NO_TABLE)
    height = p_CQ @ plane.normal - plane.offset
    low = config.min_height + _height_noise(plane.offset) * distance
    above = np.flatnonzero((height > low) & (height < config.max_height))
    X_WC = _pose_from_plane(plane) if X_WC is None else X_WC
    support = _Support(plane, sample[plane.inliers], _table_W(plane, X_WC))
    standing = _Standing(p_CQ[above], index[above], support, X_WC)
    return _cluster([standing], support.table_W, config, robot)


_NO_TABLE = "no supporting plane found"


def _height_noise(offset: float) -> float:
    """What noise may look like a height, per metre of depth.

    The depth's deviation is ``DEPTH_NOISE z**2``; of a plane's point, at the ray z r
    with z n . r = offset, the height's is that times abs(n . r) = abs(offset) / z.
    """
    return _DEVIATIONS * DEPTH_NOISE * abs(offset)


class _Support(NamedTuple):
    """The table that obstacles stand on, as it is seen: its plane and points (M, 3) of it in C,
    and its plane in the world."""

    plane: PlaneFit
    extent_C: FloatArray
    table_W: TablePlane


class _Image(NamedTuple):
    """A depth image: z (H, W) [m], K (4,), X_WC (4, 4), the table in it, or why there is none."""

    z: NDArray[np.float32]
    K: FloatArray
    X_WC: FloatArray | None
    support: _Support | None
    note: str


class _Standing(NamedTuple):
    """What one image, or a cloud, shows over the table.

    Points p_CQ (N, 3) in its frame C and their numbers (N,), ascending; the table in it, None:
    not seen; X_WC (4, 4); the image, None: it is a cloud.
    """

    p_CQ: FloatArray
    number: IntArray
    support: _Support | None
    X_WC: FloatArray
    view: View | None = None


def _looked_at(
    depth: NDArray[np.floating], K: FloatArray, X_WC: FloatArray | None, config: SegmentationConfig
) -> _Image:
    """A checked image, with the table in it; its pose by the table where it was not known."""
    depth = np.asarray(depth)
    K = _valid_intrinsics(depth, K)
    X_WC = _valid_pose(X_WC)
    z = np.require(depth, np.float32, ["C", "W"])
    if not config.table:
        # What is too far is told too; what is missing, or too near, is not.
        if np.count_nonzero(z > 0.0) < LEAST_SHARE * z.size:
            return _Image(z, K, X_WC, None, "hardly any pixel tells of something")
        return _Image(z, K, _pose_known(X_WC), None, "")
    step = config.stride
    on_grid, pixels = sampled(z, step, float(config.near), float(config.far))
    if not len(on_grid):
        return _Image(z, K, X_WC, None, "no valid pixel")
    sample = back_projected(z, pixels, K)
    plane = find_table(sample, sample[:, 2], X_WC, config.table_height)
    if plane is None:
        return _Image(z, K, X_WC, None, _NO_TABLE)
    extent = seen_extent(
        (-(-z.shape[0] // step), -(-z.shape[1] // step)),
        on_grid,
        plane.inliers,
        sample,
        plane,
        (step / K[0], step / K[1]),
    )
    X_WC = _pose_from_plane(plane) if X_WC is None else X_WC
    return _Image(z, K, X_WC, _Support(plane, extent, _table_W(plane, X_WC)), "")


def _table_W(plane: PlaneFit, X_WC: FloatArray) -> TablePlane:
    normal_W = X_WC[:3, :3] @ plane.normal
    return TablePlane(normal_W, float(plane.offset + normal_W @ X_WC[:3, 3]))


def _standing_in(image: _Image, table: TablePlane | None, config: SegmentationConfig) -> _Standing:
    z, K, X_WC = image.z, image.K, _pose_known(image.X_WC)
    support = image.support
    # It may be missing, or something else taken for it.
    if support is not None and table is not None:
        apart = abs(support.table_W.offset - table.offset)
        apart += float(np.linalg.norm(support.table_W.normal_W - table.normal_W))
        support = support if apart <= HEIGHT_TOLERANCE else None
    if table is None:
        _, index = sampled(z, 1, float(config.near), float(config.far))
    elif support is not None:
        index = _pixels_above(z, K, support.plane, config)
    else:
        offset = table.offset - float(table.normal_W @ X_WC[:3, 3])
        normal = X_WC[:3, :3].T @ table.normal_W
        plane = PlaneFit(normal, offset, np.nan, np.zeros(0, dtype=bool))
        index = _pixels_above(z, K, plane, config)
    p_CQ = back_projected(z, index, K)
    return _Standing(p_CQ, index, support, X_WC, View(z, K, X_WC))


def _pose_known(X_WC: FloatArray | None) -> FloatArray:
    if X_WC is None:
        raise ValueError("X_WC must be given where there is no table to find it by")
    return X_WC


def _in_world(part: _Standing, config: SegmentationConfig) -> tuple[FloatArray, IntArray]:
    """Points (N, 3) in the world [m], those far beyond the table left out; their numbers (N,)."""
    axes, reach = np.eye(2, 3), np.array([[-np.inf, np.inf]] * 2)
    if part.support is not None:
        # A rectangle around the table is a quick crop; its convex extent comes later.
        axes = plane_axes(part.support.plane.normal)
        along = axes @ part.support.extent_C.T
        low, high = along.min(axis=1, initial=np.inf), along.max(axis=1, initial=-np.inf)
        beyond = config.table_margin + config.overhang
        reach = np.column_stack([low - beyond, high + beyond])
    return cropped_to_world(part.p_CQ, part.number, axes, reach, part.X_WC)


def _cluster(
    parts: Sequence[_Standing],
    table: TablePlane | None,
    config: SegmentationConfig,
    robot: Solids | None,
) -> Segmentation:
    """What stands on the table, of all that images of one instant, or a cloud, show over it.

    Without a table all of it counts.
    """
    views = tuple(part.view for part in parts if part.view is not None)
    placed = [_in_world(part, config) for part in parts]
    X_WC = parts[0].X_WC
    rms = np.nan if parts[0].support is None else parts[0].support.plane.rms
    p_WQ = np.concatenate([points for points, _ in placed])
    if not len(p_WQ):
        return Segmentation((), (), table, p_WQ, rms, X_WC, views=views)

    means, voxel_of, count = voxel_means(p_WQ, config.voxel)
    kept = np.flatnonzero(count >= config.min_occupancy)
    if robot is not None:
        margin = config.robot_margin
        kept = kept[least_distances(robot, means[kept], 0.0, margin, margin) >= margin]
    if table is None:
        found = connected_clusters(means[kept], config.cluster_tolerance)
    else:
        extent_W = np.concatenate(
            [
                part.support.extent_C @ part.X_WC[:3, :3].T + part.X_WC[:3, 3]
                for part in parts
                if part.support is not None
            ]
        )
        beyond = config.table_margin + config.overhang
        outside = beyond_extent(means[kept], extent_W, table.normal_W)
        kept, outside = kept[outside <= beyond], outside[outside <= beyond]
        standing, found = _standing(
            means[kept],
            outside <= config.table_margin,
            outside <= beyond - 2.0 * config.voxel,
            config,
        )
        kept = kept[standing]
    points = means[kept]
    label = np.full(len(means), -1)
    ends = np.cumsum([0, *(len(index) for _, index in placed)]).tolist()
    voxels_of = [voxel_of[slice(*pair)] for pair in pairwise(ends)]
    if views:
        label[kept] = found
        found = joined_across_unseen(
            points,
            found,
            [
                (index, label[own], view)
                for (_, index), own, view in zip(placed, voxels_of, views, strict=True)
            ],
            UNSEEN_GAP,
            float(config.voxel),
            config.min_cluster_voxels,
        )
    sizes = np.bincount(found, minlength=1)
    large = sizes >= config.min_cluster_voxels
    if table is not None:
        low = np.full(len(points), -np.inf)
        for part, own in zip(parts, voxels_of, strict=True):
            shown = np.zeros(len(means), dtype=bool)
            shown[own] = True
            at = np.flatnonzero(shown[kept])
            low[at] = np.maximum(low[at], _least_height(points[at], table, part, config))
        higher = points @ table.normal_W - table.offset > low
        least = np.maximum(_HIGHER_SHARE * sizes, 3)
        large &= np.bincount(found, weights=higher, minlength=1) >= least
    names = np.flatnonzero(large)
    names = names[np.argsort(-sizes[names], kind="stable")]
    place = np.full(len(sizes), -1)
    place[names] = np.arange(len(names))
    label[kept] = place[found]
    first = np.cumsum([0, *(view.z.size for view in views)]).tolist()
    index = np.concatenate([own + begin for (_, own), begin in zip(placed, first, strict=False)])
    pixels, begin = points_of_groups(label, voxel_of, index, len(names))
    return Segmentation(
        tuple(points[found == name] for name in names),
        tuple(pixels[slice(*pair)] for pair in pairwise(begin.tolist())),
        table,
        p_WQ,
        rms,
        X_WC,
        views=views,
    )


def _least_height(
    p_WQ: FloatArray, table: TablePlane, part: _Standing, config: SegmentationConfig
) -> FloatArray:
    """(N,) height from which points (N, 3) are over the table, however the camera bends it [m]."""
    p_CQ = (p_WQ - part.X_WC[:3, 3]) @ part.X_WC[:3, :3]
    distance = p_CQ[:, 2] if part.view is not None else np.linalg.norm(p_CQ, axis=1)
    offset = table.offset - float(table.normal_W @ part.X_WC[:3, 3])
    bend = _WARP * np.maximum(distance - _WARP_START, 0.0) ** 2
    low = config.min_height + _height_noise(offset) * distance
    return np.asarray(low + np.minimum(bend, _LARGEST_WARP))


def _standing(
    points: FloatArray, inside: BoolArray, inner: BoolArray, config: SegmentationConfig
) -> tuple[BoolArray, IntArray]:
    """Which points belong to what stands over the table: inside, or jutting out from there.

    A wall behind the table, which mostly is outside and goes on beyond all that is looked
    at, does not jut out from an object that it touches; nor does what touches several.

    Args:
        points: (N, 3) [m].
        inside: (N,) whether each is over the table.
        inner: (N,) whether it is not at the limit of what is looked at.
        config: `cluster_tolerance` and `over_table` count.

    Returns:
        (N,) whether each stands there, and (S,) the clusters of those that do.
    """
    whole = connected_clusters(points, config.cluster_tolerance)
    if inside.all():
        return inside, whole
    core = connected_clusters(points[inside], config.cluster_tolerance)
    count = int(whole.max()) + 1
    total = np.bincount(whole, minlength=count)
    within = np.bincount(whole[inside], minlength=count)
    whole_of_core = np.zeros(core.max(initial=-1) + 1, dtype=np.int64)
    whole_of_core[core] = whole[inside]
    objects = np.bincount(whole_of_core, minlength=count)
    goes_on = np.bincount(whole[~inner], minlength=count) > 0
    taken = (objects == 1) & (within >= np.where(goes_on, 0.5, config.over_table) * total)
    taken_points = taken[whole]
    cluster = np.where(taken_points, whole, -1)
    cluster[inside] = np.where(taken_points[inside], whole[inside], count + core)
    standing = inside | taken_points
    return standing, filed(cluster[standing])[1]


def _pixels_above(
    z: NDArray[np.float32], K: FloatArray, plane: PlaneFit, config: SegmentationConfig
) -> IntArray:
    """Flat indices of the pixels whose height over the plane may be an obstacle's."""
    # height = n . p_C - offset = z (a u + b v + c) - offset > min_height + noise z
    fx, fy, cx, cy = K
    n, offset = plane.normal, plane.offset
    a, b = n[0] / fx, n[1] / fy
    noise = _height_noise(offset)
    u = a * np.arange(z.shape[1]) + (n[2] - a * cx - b * cy - noise)
    v = b * np.arange(z.shape[0])
    limits = [
        config.near,
        config.far,
        offset + config.min_height,
        noise,
        offset + config.max_height,
    ]
    return pixels_between(
        z, u.astype(np.float32), v.astype(np.float32), np.array(limits, dtype=np.float32)
    )


def _pose_from_plane(plane: PlaneFit) -> FloatArray:
    """X_WC of the world that a table defines, see `segment_depth`."""
    n = plane.normal
    # Where the ray (0, 0, t) meets n . p = offset, if in front and not grazing.
    t = plane.offset / n[2] if abs(n[2]) > 0.05 else -1.0
    origin_C = np.array([0.0, 0.0, t]) if t > 0.0 else plane.offset * n
    x = np.array([1.0, 0.0, 0.0]) - n[0] * n
    x /= np.linalg.norm(x)
    R_WC = np.stack([x, np.cross(n, x), n])
    X_WC = np.eye(4)
    X_WC[:3, :3] = R_WC
    X_WC[:3, 3] = -R_WC @ origin_C
    return X_WC


def _valid_intrinsics(depth: NDArray[np.floating], K: FloatArray) -> FloatArray:
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(
            f"depth must be an (H, W) array of floats in metres, not {depth.dtype} {depth.shape}"
        )
    K = np.require(K, np.float64, ["C", "W"])
    if K.shape != (4,) or not np.isfinite(K).all() or (K[:2] <= 0.0).any():
        raise ValueError(f"K must be [fx, fy, cx, cy] with positive focal lengths, not {K}")
    return K


def _valid_pose(X_WC: FloatArray | None) -> FloatArray | None:
    if X_WC is None:
        return None
    X_WC = np.require(X_WC, np.float64, ["C", "W"])
    if X_WC.shape != (4, 4) or not np.isfinite(X_WC).all():
        raise ValueError(f"X_WC must be a finite (4, 4) pose, not one of shape {X_WC.shape}")
    R = X_WC[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0.0:
        raise ValueError("X_WC must hold a rotation: its upper left block is not orthonormal")
    return X_WC
