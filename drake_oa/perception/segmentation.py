"""Segmentation of depth images of one instant, or of a point cloud, into table and obstacles.

Stages; each is one function:

1. Plane, `_find_plane`: the support plane, fitted to a subsample of each image (`table`).
2. Height, `_points_above`: the points of each image above the plane; all points without a table.
3. Voxels, `voxel_means`: the mean of the points of all images in each voxel (cube of a grid).
4. Self filter, `_is_off_robot`: voxels on the robot are removed.
5. Extent, `_is_over_table`: voxels beside the table are removed.
6. Clusters, `_clusters`: connected voxels; clusters are merged across occluded gaps.
7. Size and height, `_select_obstacles`: clusters that are large and high enough are obstacles.

Frames: W world, C depth camera (x right, y down, z forward). Poses are (4, 4) homogeneous matrices,
as ``RigidTransform.GetAsMatrix4()`` returns them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from drake_oa.common.messages import BoolArray, FloatArray, IntArray, TablePlane, zeros
from drake_oa.geometry.collision_scene import CollisionGeometries, least_distances
from drake_oa.geometry.pinhole import View, pixel_at, pixel_rays
from drake_oa.geometry.voxels import connected_clusters, voxel_means
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.table import (
    DEPTH_NOISE,
    HEIGHT_TOLERANCE,
    LEAST_SHARE,
    PlaneFit,
    distance_beyond,
    find_table,
    table_extent,
)

_DEVIATIONS = 6.0
"""Height above the table below which a point may be depth noise, in standard deviations of the
measured height [-]."""
_WARP_START = 1.1
"""Depth beyond which structured-light cameras measure a flat table as bent upward [m].

The value is from the scans of docs/results/real_scans.md.
"""
_WARP = 0.15
"""Apparent height of a flat table far from the camera, divided by the square of the depth beyond
`_WARP_START` [1/m]."""
_MAX_WARP = 0.04
"""Maximum apparent height of a flat table that a structured-light camera measures as bent upward
[m]."""
_HIGHER_SHARE = 0.1
"""Minimum fraction of a cluster's voxels whose height above the table exceeds the measurement error
[-]. The error is depth noise, plus the upward bend with which the camera measures a distant flat
table. Clusters with a smaller fraction are no obstacles."""
OCCLUSION_GAP = 0.06
"""Maximum width of an occluded gap across which two clusters are merged into one obstacle [m]."""
_BRIDGES = 16
"""Maximum number of connections (straight lines) between nearest points of two clusters that are
tested for occlusion; the shortest ones are tested. A connection is open if some image shows free
space at one of its places: a larger depth than that of the place, in a pixel of neither cluster.
The clusters are merged if at most half of the connections are open."""
_BRIDGE_PLACES = np.linspace(0.0, 1.0, 7)[1:-1, None, None]
"""Places (5, 1, 1) along a connection between points of two clusters that are tested for occlusion,
as fractions of the connection's length [-]."""
_MIN_HEIGHT = 0.004
"""Minimum height of an obstacle's points above the table, to which the allowance for depth noise is
added [m]."""
_OVERHANG = 0.15
"""Maximum distance by which an obstacle on the table may extend beyond the margin `table_margin`
around the table [m]."""
_OVER_TABLE = 0.15
"""Minimum fraction of a cluster's voxels that lie over the table [-]. With less, the voxels beside
the table are not included in the obstacle. A cluster that reaches the maximum overhang
(`_OVERHANG`) requires one half instead."""
_MIN_OCCUPANCY = 2
"""Minimum number of points in a voxel that is used; voxels with fewer points are ignored."""
_STRIDE = 4
"""Row and column stride of the pixels of an image to which the table is fitted [pixel]."""
_CLOUD_SAMPLES = 20_000
"""Approximate number of points of a cloud to which the table is fitted."""
_NO_TABLE = "no support plane found"
"""Note (reason why an image or cloud is not usable) if no support plane is found in it."""
_NO_DEPTH = "hardly any depth is measured"
"""Note (reason why an image or cloud is not usable) if less than 5 % (`table.LEAST_SHARE`) of its
pixels have depth."""


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Table and obstacles segmented from one frame: depth images of one instant, or a point cloud.

    Attributes:
        clouds_W: for each obstacle an (N_i, 3) array of the mean points of its voxels in the world
            frame [m], largest obstacle first.
        labels: for each image in `views`, or for the cloud, an array (N,) with the obstacle of each
            pixel (row-major) or point, as index into `clouds_W`; -1: none.
        table: support plane in the world frame; None: not expected or not found.
        points_W: (N, 3) all points above the table, without a table all points, in the world frame
            [m]; including the robot's, for visualization.
        plane_rms: root mean square distance from the support plane of the sampled points that lie
            on it [m]; NaN without plane.
        X_WC: (4, 4) pose of the first camera in the world. If no pose was given, the pose for which
            the table is the plane z = 0 (see `segment_depth`).
        usable: whether an image or the cloud has depth in at least 5 % of its pixels or points, and
            a table was found or is not expected; False: the frame contains no information about
            obstacles.
        note: empty, or the reason why the frame is not usable.
        views: images from which the obstacles are segmented: those with depth in at least 5 % of
            their pixels, if `usable`; empty for a cloud.
        unusable_views: mapping from the index of each other image to the reason, which is missing
            depth or a missing table.
    """

    clouds_W: tuple[FloatArray, ...] = ()
    labels: tuple[NDArray[np.int16], ...] = ()
    table: TablePlane | None = None
    points_W: FloatArray = zeros(0, 3)
    plane_rms: float = np.nan
    X_WC: FloatArray = field(default_factory=lambda: np.eye(4))
    usable: bool = True
    note: str = ""
    views: tuple[View, ...] = ()
    unusable_views: dict[int, str] = field(default_factory=dict)

    @property
    def pixels(self) -> tuple[IntArray, ...]:
        """Pixels of each obstacle, or its points in a cloud: for each obstacle an array of flat
        indices, which are counted consecutively over all images in `views`.
        """
        label = np.concatenate([np.zeros(0), *self.labels])
        return tuple(np.flatnonzero(label == row) for row in range(len(self.clouds_W)))


class _Frame(NamedTuple):
    """One depth image or point cloud during segmentation, with the support plane found in it.

    The points in the camera frame C are p_CQ = depth * ray.

    Attributes:
        ray: (N, 3) float32 rays through the points in C; z = 1 in an image, unit vectors in a
            cloud.
        depth: (N,) float32 depth, in a cloud distance from the camera [m].
        depth_range: minimum and maximum depth in use [m].
        X_WC: (4, 4) pose of the camera in the world; None: unknown.
        view: the image; None: a cloud.
        table: support plane in the world; None: not found.
        extent_W: (E, 3) points in the world whose convex hull is the extent of the table in this
            image [m].
        samples: number of sampled points that lie on the table.
        rms: root mean square distance of these samples from the table [m].
        note: empty, or the reason why this image or cloud cannot be segmented by itself: hardly any
            depth, or no table. An image without a table is segmented with the table of another one.
    """

    ray: NDArray[np.float32]
    depth: NDArray[np.float32]
    depth_range: tuple[float, float]
    X_WC: FloatArray | None
    view: View | None = None
    table: TablePlane | None = None
    extent_W: FloatArray = zeros(0, 3)
    samples: int = 0
    rms: float = np.nan
    note: str = ""

    def is_valid(self, depth: NDArray[np.float32]) -> BoolArray:
        """Checks for each depth [m] whether it lies in the range of depths that the segmentation
        uses.
        """
        return np.asarray((depth >= self.depth_range[0]) & (depth <= self.depth_range[1]))

    def points(self, index: IntArray) -> NDArray[np.float32]:
        """Computes the points (M, 3) of an image or cloud at the indices (M,), in the camera frame
        C [m].
        """
        return np.take(self.ray, index, axis=0) * self.depth[index, None]


class _AbovePlane(NamedTuple):
    """Points of one depth image or cloud above the support plane; without a table, all its points.

    Attributes:
        frame: image or cloud of the points.
        p_WQ: (N, 3) points in the world [m].
        number: (N,) indices of the points in the image (row-major pixels) or cloud.
        is_higher: (N,) whether the height of each point above the table exceeds the measurement
            error: depth noise, plus the upward bend with which the camera measures a distant flat
            table.
    """

    frame: _Frame
    p_WQ: FloatArray
    number: IntArray
    is_higher: BoolArray


def segment_depth(
    depth: NDArray[np.floating],
    K: FloatArray,
    X_WC: FloatArray | None,
    config: SegmentationConfig | None = None,
    robot: CollisionGeometries | None = None,
) -> Segmentation:
    """Segments a depth image into the table and one cluster of points per obstacle.

    If the pose of the camera is unknown, the table defines the world: z along the table's normal
    (toward the camera), x along the camera's x axis. The origin is the intersection of table and
    optical axis; without an intersection, the camera's perpendicular foot on the table.

    Args:
        depth: (H, W) depth along the optical axis [m]; 0 (too near), inf (too far) and NaN
            (missing) are ignored.
        K: (4,) fx, fy, cx, cy [pixel].
        X_WC: (4, 4) pose of the camera (x right, y down, z forward) in the world; None: unknown.
        config: parameters; None: defaults.
        robot: collision geometry of the robot at the time of the image, whose points are removed;
            None: no points are removed.

    Returns:
        Table and obstacles; if depth or an expected table is missing, only a note with the reason.

    Raises:
        ValueError: without X_WC if `config.table` is False.
    """
    return segment_views([(depth, K, X_WC)], config, robot)


def segment_views(
    views: Sequence[View] | Sequence[tuple[Any, Any, Any]],
    config: SegmentationConfig | None = None,
    robot: CollisionGeometries | None = None,
) -> Segmentation:
    """Segments depth images of one instant together into the table and one cluster of points per
    obstacle.

    The largest table of all images is also used for images without a table, or with a different
    one. An image in which less than 5 % of the pixels have depth is ignored, and listed in
    `unusable_views`. If all are ignored, or none shows an expected table, the result is not usable.
    If the pose X_WC of a camera is unknown, the table in its image defines the pose: the table is
    the plane z = 0 of the world, as `segment_depth` describes.

    Args:
        views: one or more depth images; for each image depth (H, W) along the optical axis [m],
            K = [fx, fy, cx, cy] [pixel], and the pose X_WC (4, 4) of the camera (x right, y down,
            z forward) in the world; None: unknown.
        config: parameters; None: defaults.
        robot: collision geometry of the robot at the time of the images, whose points are removed;
            None: no points are removed.

    Raises:
        ValueError: if the pose X_WC of a camera is unknown and no table in its image defines it:
            `config.table` is False, or only other images contain a table.
    """
    config = config or SegmentationConfig()
    frames = []
    for depth, K, X_WC in views:
        z = np.asarray(depth, dtype=np.float32)
        view = View(z, np.asarray(K, dtype=float), np.eye(4) if X_WC is None else X_WC)
        ray = pixel_rays(z.shape, *view.K.tolist())
        frames.append(_Frame(ray, z.ravel(), (config.near, config.far), X_WC, view))
    return _segment(frames, config, robot)


def segment_points(
    points: FloatArray,
    X_WC: FloatArray | None,
    config: SegmentationConfig | None = None,
    robot: CollisionGeometries | None = None,
) -> Segmentation:
    """Segments a point cloud without image structure into the table and one cluster of points per
    obstacle.

    As in an image, points above the table form clusters. Clusters are not merged across occluded
    gaps, since a cloud does not show occlusion.

    Args:
        points: (N, 3) points in the frame C of the camera or of the world [m]; rows that are not
            finite or all zero are ignored.
        X_WC: (4, 4) pose of C in the world: that of the camera, or the identity for points in the
            world. None: unknown; then the table defines the world, as for `segment_depth`.
        config: parameters; `near` and `far` have no effect. None: defaults.
        robot: collision geometry of the robot at the time of the cloud, whose points are removed;
            None: no points are removed.

    Raises:
        ValueError: without X_WC if `config.table` is False.
    """
    points = np.asarray(points, dtype=np.float32)
    distance = np.linalg.norm(points, axis=1)
    with np.errstate(invalid="ignore"):
        ray = points / distance[:, None]
    frame = _Frame(ray, distance, (1e-9, 1e9), X_WC)
    return _segment([frame], config or SegmentationConfig(), robot)


def _segment(
    frames: Sequence[_Frame], config: SegmentationConfig, robot: CollisionGeometries | None
) -> Segmentation:
    """Segments images of one instant, or one cloud, into table and obstacles, by the seven stages
    in the module's docstring.

    Args:
        frames: images of one instant, or one cloud, before their tables are found.
        config: parameters of the segmentation.
        robot: collision geometry of the robot, whose points are removed; None: no points are
            removed.
    """
    frames = [_find_plane(frame, config) for frame in frames]
    # The largest table is also used for images without one.
    largest = max(frames, key=lambda frame: frame.samples)
    unusable_views = {
        number: frame.note
        for number, frame in enumerate(frames)
        if frame.note == _NO_DEPTH or (frame.note and largest.table is None)
    }
    pose = frames[0].X_WC
    X_WC = np.eye(4) if pose is None else pose
    if len(unusable_views) == len(frames):
        return Segmentation(
            X_WC=X_WC, usable=False, note=unusable_views[0], unusable_views=unusable_views
        )
    parts = [
        _points_above(frame, largest.table, config)
        for number, frame in enumerate(frames)
        if number not in unusable_views
    ]
    p_WQ = np.concatenate([part.p_WQ for part in parts])
    means, voxel_of, count = voxel_means(p_WQ, config.voxel)
    is_used = count >= _MIN_OCCUPANCY
    if robot is not None:
        is_used[is_used] = _is_off_robot(means[is_used], robot, config)
    if largest.table is not None:
        is_used[is_used] = _is_over_table(means[is_used], parts, largest.table, config)
    label = _clusters(means, is_used, voxel_of, parts, config)
    is_higher = None
    if largest.table is not None:
        higher = np.bincount(voxel_of, np.concatenate([part.is_higher for part in parts]))
        is_higher = higher >= 0.5 * count
    label = _select_obstacles(label, is_higher, config)
    return Segmentation(
        tuple(means[label == cluster] for cluster in range(label.max(initial=-1) + 1)),
        tuple(_pixel_labels(parts, label[voxel_of])),
        largest.table,
        p_WQ,
        plane_rms=largest.rms,
        X_WC=X_WC,
        views=tuple(part.frame.view for part in parts if part.frame.view is not None),
        unusable_views=unusable_views,
    )


def _find_plane(frame: _Frame, config: SegmentationConfig) -> _Frame:
    """Fits the support plane to a subsample of an image or cloud (stage 1 of the segmentation).

    Returns:
        The image or cloud with its table. If depth or the table is missing: with a note, the reason
        why it is not usable. If `config.table` is False and depth is not missing: unchanged.
    """
    # Infinite depth is a measurement of free space; missing depth is none.
    if np.count_nonzero(frame.depth > 0.0) < max(1.0, LEAST_SHARE * frame.depth.size):
        return frame._replace(note=_NO_DEPTH)
    if not config.table:
        return frame
    size, view = frame.depth.size, frame.view
    shape, rows, columns = (size, 1), max(1, size // _CLOUD_SAMPLES), 1
    if view is not None:
        shape, rows, columns = view.z.shape, _STRIDE, _STRIDE
    grid = shape[1] * np.arange(0, shape[0], rows)[:, None] + np.arange(0, shape[1], columns)
    pixel = np.flatnonzero(frame.is_valid(frame.depth[grid.ravel()]))
    index = grid.ravel()[pixel]
    points = frame.points(index).astype(float)
    fit = find_table(points, frame.depth[index].astype(float), frame.X_WC, config.table_height)
    if fit is None:
        return frame._replace(note=_NO_TABLE)
    X_WC = _pose_from_plane(fit) if frame.X_WC is None else frame.X_WC
    extent, normal_W = points[fit.inliers], X_WC[:3, :3] @ fit.normal
    if view is not None:
        extent, view = table_extent(fit, points, pixel, grid.shape), view._replace(X_WC=X_WC)
    return frame._replace(
        X_WC=X_WC,
        view=view,
        table=TablePlane(normal_W, float(fit.offset + normal_W @ X_WC[:3, 3])),
        extent_W=extent @ X_WC[:3, :3].T + X_WC[:3, 3],
        samples=int(fit.inliers.sum()),
        rms=fit.rms,
    )


def _points_above(
    frame: _Frame, table: TablePlane | None, config: SegmentationConfig
) -> _AbovePlane:
    """Finds the points of an image or cloud above the table; all points without a table (stage 2 of
    the segmentation).

    The plane is n . p = offset in the camera frame. A pixel with ray r (z = 1) and depth z is the
    point z r, at the height z n . r - offset above the plane. Its depth has the standard deviation
    `DEPTH_NOISE` z^2. For a point on the plane, |n . r| = |offset| / z. The height of such a point
    therefore has the standard deviation `DEPTH_NOISE` z |offset|. Points are above the plane if
    their height is at least `_MIN_HEIGHT` plus `_DEVIATIONS` times this standard deviation.

    Args:
        frame: image or cloud. The plane that was found in it is used instead of `table` if both
            planes differ in height by at most 5 cm (`HEIGHT_TOLERANCE`) within 1 m of the world
            origin.
        table: largest table of all images; None: no table.
        config: `max_height` is used.

    Raises:
        ValueError: if the pose of the camera is unknown, and no table in its image defines it.
    """
    X_WC, depth = frame.X_WC, frame.depth
    if X_WC is None:
        raise ValueError("X_WC: must be given, since no table in the image defines the camera pose")
    if table is None:
        normal, offset, low, high = np.zeros(3), 0.0, -1.0, 1.0
    else:
        # A plane that differs is another object, such as the top of a box.
        plane = frame.table
        if plane is None or plane.distance_to(table) > HEIGHT_TOLERANCE:
            plane, frame = table, frame._replace(extent_W=np.zeros((0, 3)))
        normal, offset = X_WC[:3, :3].T @ plane.normal_W, -float(plane.height(X_WC[:3, 3]))
        low, high = offset + _MIN_HEIGHT, offset + config.max_height
    noise = np.float32(_DEVIATIONS * DEPTH_NOISE * abs(offset))
    slope = frame.ray @ normal.astype(np.float32)
    with np.errstate(invalid="ignore"):
        number = np.flatnonzero(depth * (slope - noise) > np.float32(low))
    z = depth[number]
    is_used = frame.is_valid(z) & (z * slope[number] < high)
    number, z = number[is_used], z[is_used]
    bend = np.minimum(_WARP * np.maximum(z - _WARP_START, 0.0) ** 2, _MAX_WARP)
    is_higher = z * (slope[number] - noise) > low + bend
    p_WQ = frame.points(number) @ X_WC[:3, :3].T + X_WC[:3, 3]
    return _AbovePlane(frame, p_WQ, number, is_higher)


def _is_off_robot(
    means: FloatArray, robot: CollisionGeometries, config: SegmentationConfig
) -> BoolArray:
    """Checks for each point whether it is at least `robot_margin` away from the robot (stage 4 of
    the segmentation, self filter).

    Args:
        means: (M, 3) mean points of the voxels in the world [m].
        robot: collision geometry of the robot in the world.
        config: `robot_margin` is used.
    """
    margin = config.robot_margin
    return np.asarray(least_distances(robot, means, 0.0, margin, margin) >= margin)


def _is_over_table(
    means: FloatArray, parts: Sequence[_AbovePlane], table: TablePlane, config: SegmentationConfig
) -> BoolArray:
    """Checks for each voxel whether it belongs to an object over the table, overhanging objects
    included (stage 5 of the segmentation).

    An object with contact to a wall behind the table does not include the wall: most of the wall is
    beside the table, and the wall continues beyond the maximum overhang.

    Args:
        means: (M, 3) mean points of the voxels in the world frame [m].
        parts: points above the table in each image, with the extent of the table in the image.
        table: the largest table of all images.
        config: `table_margin`, `cluster_tolerance` and `voxel` are used.

    Returns:
        (M,) whether each voxel belongs to an object over the table.
    """
    extent_W = np.concatenate([part.frame.extent_W for part in parts])
    distance = distance_beyond(means, extent_W, table.normal_W)
    limit = config.table_margin + _OVERHANG
    inside, near = distance <= config.table_margin, distance <= limit
    if (inside == near).all():
        return inside
    label = connected_clusters(means[near], config.cluster_tolerance)
    continues = np.bincount(label, distance[near] > limit - 2.0 * config.voxel) > 0.0
    fraction = np.bincount(label, inside[near]) / np.bincount(label)
    overhangs = fraction >= np.where(continues, 0.5, _OVER_TABLE)
    inside[near] |= overhangs[label]
    return inside


def _clusters(
    means: FloatArray,
    is_used: BoolArray,
    voxel_of: IntArray,
    parts: Sequence[_AbovePlane],
    config: SegmentationConfig,
) -> IntArray:
    """Clusters voxels, and merges clusters across short gaps that are occluded in the images (stage
    6 of the segmentation).

    Without the merge, the rim and the inside of a bowl would be separate clusters. Two boxes with a
    gap between them remain separate if an image observes the table through the gap.

    Args:
        means: (M, 3) mean points of the voxels in the world frame [m].
        is_used: (M,) whether each voxel is clustered.
        voxel_of: (N,) index of the voxel of each point of the images.
        parts: points above the table in each image, or in the cloud.
        config: `cluster_tolerance`, `voxel` and `min_cluster_voxels` are used; clusters with fewer
            than `min_cluster_voxels` voxels are not merged.

    Returns:
        (M,) index of the cluster of each voxel, -1: not clustered.
    """
    label = np.full(len(means), -1)
    label[is_used] = connected_clusters(means[is_used], config.cluster_tolerance)
    images = [
        (part.frame.view, owner)
        for part, owner in zip(parts, _pixel_labels(parts, label[voxel_of]), strict=True)
        if part.frame.view is not None
    ]
    if not images:
        return label
    sizes = np.bincount(label + 1, minlength=1)[1:]
    large = np.flatnonzero(sizes >= config.min_cluster_voxels).tolist()
    trees = [(cluster, cKDTree(means[label == cluster])) for cluster in large]
    cluster_of = np.append(np.arange(len(sizes)), -1)
    for (one, first), (other, second) in combinations(trees, 2):
        if np.maximum(first.mins - second.maxes, second.mins - first.maxes).max() > OCCLUSION_GAP:
            continue
        length, nearest = second.query(first.data, distance_upper_bound=OCCLUSION_GAP)
        bridges = np.argsort(length, kind="stable")[:_BRIDGES]
        bridges = bridges[np.isfinite(length[bridges])]
        start, end = first.data[bridges], second.data[nearest[bridges]]
        places = start + _BRIDGE_PLACES * (end - start)
        is_open = np.zeros(len(bridges), dtype=bool)
        for view, owner in images:
            p_C = (places - view.X_WC[:3, 3]) @ view.X_WC[:3, :3]
            pixel = pixel_at(p_C, view.z.shape, view.K)
            is_behind = (pixel >= 0) & (view.z.ravel()[pixel] > p_C[..., 2] + config.voxel)
            cluster = owner[pixel]
            is_open |= (is_behind & (cluster != one) & (cluster != other)).any(axis=0)
        if 0 < len(bridges) >= 2 * np.count_nonzero(is_open):
            cluster_of[cluster_of == cluster_of[other]] = cluster_of[one]
    return cluster_of[label]


def _select_obstacles(
    label: IntArray, is_higher: BoolArray | None, config: SegmentationConfig
) -> IntArray:
    """Selects the clusters that are large and high enough to be obstacles, and sorts them by size
    (stage 7 of the segmentation).

    Args:
        label: (M,) index of the cluster of each voxel, -1: none.
        is_higher: (M,) whether the height of each voxel above the table exceeds the measurement
            error: depth noise, plus the upward bend with which the camera measures a distant flat
            table. None: without a table.
        config: `min_cluster_voxels` is used.

    Returns:
        (M,) index of the obstacle of each voxel; -1: none, 0: the largest obstacle.
    """
    sizes = np.bincount(label + 1, minlength=1)[1:]
    is_obstacle = sizes >= config.min_cluster_voxels
    if is_higher is not None:
        higher = np.bincount(label + 1, is_higher, minlength=1)[1:]
        is_obstacle &= higher >= np.maximum(_HIGHER_SHARE * sizes, 3.0)
    clusters = np.argsort(-sizes * is_obstacle, kind="stable")[: np.count_nonzero(is_obstacle)]
    row = np.full(len(sizes) + 1, -1)
    row[clusters] = np.arange(len(clusters))
    return row[label]


def _pixel_labels(parts: Sequence[_AbovePlane], point_label: IntArray) -> list[NDArray[np.int16]]:
    """Returns for each image an array (H W,) with the labels (indices of obstacles or clusters) of
    all its pixels, given the labels of the points above the table.

    Args:
        parts: points above the table in each image or cloud; every other pixel gets the label -1.
        point_label: (N,) labels of the points of all images in sequence, -1: none.
    """
    labels, ends = [], np.cumsum([len(part.number) for part in parts])[:-1]
    for part, values in zip(parts, np.split(point_label, ends), strict=True):
        label = np.full(len(part.frame.depth), -1, dtype=np.int16)
        label[part.number] = values
        labels.append(label)
    return labels


def _pose_from_plane(plane: PlaneFit) -> FloatArray:
    """Computes the pose X_WC (4, 4) of a camera in the world that the table defines.

    The z axis of the world is the table's normal, its x axis is that of the camera, projected to
    the table. The origin is the intersection of table and optical axis; without an intersection,
    the perpendicular foot of the camera on the table.

    Args:
        plane: table in the frame of the camera (x right, y down, z forward).
    """
    n = plane.normal
    # The ray (0, 0, t) intersects the plane n . p = offset, if in front and not nearly parallel
    # to the plane (3 degrees).
    t = plane.offset / n[2] if abs(n[2]) > 0.05 else -1.0
    origin_C = np.array([0.0, 0.0, t]) if t > 0.0 else plane.offset * n
    x = np.array([1.0, 0.0, 0.0]) - n[0] * n
    x /= np.linalg.norm(x)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.stack([x, np.cross(n, x), n])
    X_WC[:3, 3] = -X_WC[:3, :3] @ origin_C
    return X_WC
