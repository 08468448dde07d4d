"""From depth images of one instant, or a cloud, to one cluster of points for each obstacle.

1. `table`: the supporting plane, fitted to a subsample of each image.
2. Points above the plane, of each image: depth times a linear map of the pixel. Without a table
   every point counts.
3. `voxels`: their mean points by voxel, of all images together, without the robot and the
   surroundings of the table.
4. Clusters of the voxels, merged across gaps that no image sees through.

Frames: W world, C depth camera (x right, y down, z forward). Poses are (4, 4)
homogeneous matrices, as ``RigidTransform.GetAsMatrix4()`` returns them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
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
"""Standard deviations of depth that are not distinguished from a height."""
_WARP_START = 1.1
"""Depth from which structured-light cameras bend a plane (docs/results/real_scans.md) [m]."""
_WARP = 0.15
"""Height that the bend adds to a plane, by the square of the depth beyond `_WARP_START` [1/m]."""
_LARGEST_WARP = 0.04
"""Maximum height that the bend adds to a plane [m]."""
_HIGHER_SHARE = 0.1
"""Minimum fraction of the voxels of a cluster that are higher than noise and bend [1]."""
OCCLUSION_GAP = 0.06
"""Maximum gap between two clusters that are merged when nothing is visible through it [m]."""
_BRIDGES = 16
"""Number of the shortest connections between two clusters that are tested."""
_BRIDGE_PLACES = np.linspace(0.0, 1.0, 7)[1:-1, None, None]
"""Tested places along a connection, as fractions of its length [1]."""
_MIN_HEIGHT = 0.004
"""Minimum height of an obstacle's points above the table at zero depth [m]."""
_OVERHANG = 0.15
"""Maximum distance that an obstacle above the table may extend beyond its edge [m]."""
_OVER_TABLE = 0.15
"""Minimum fraction of an overhanging cluster that is above the table [1]."""
_MIN_OCCUPANCY = 2
"""Minimum number of points in an occupied voxel [1]."""
_STRIDE = 4
"""Row and column stride of the pixels used to fit the table [pixel]."""
_CLOUD_SAMPLES = 20_000
"""Approximate number of points of a cloud used to fit the table."""
_NO_TABLE, _NO_DEPTH = "no supporting plane found", "hardly any depth is measured"


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Table and obstacles of one frame; without a table, everything but the robot.

    Attributes:
        clouds_W: one (N_i, 3) array an obstacle: the mean point of each voxel, in
            the world frame [m]; the largest cluster first.
        labels: for each usable image, or for the cloud, the row (N,) of the cluster of each pixel
            (row-major) or point; -1: none.
        table: the supporting plane in the world frame, or None.
        points_W: (N, 3) every single point above the table (without one, all), including the
            robot's, in the world frame [m]: for viewing.
        plane_rms: rms distance of the plane's points from it [m]; NaN without plane.
        X_WC: (4, 4) pose of the first camera; when it was not given, the pose that makes
            the table the plane z = 0 (see `segment_depth`).
        usable: whether the table was found, or none exists; otherwise the frame carries no
            information about obstacles.
        note: empty, or the reason why the frame is not usable.
        views: the images that show obstacles; none of a cloud.
        unusable_views: index of each image that is not usable, and the reason.
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
        """Flat indices of the pixels or points of each cluster, counted on through the images."""
        label = np.concatenate([np.zeros(0), *self.labels])
        return tuple(np.flatnonzero(label == row) for row in range(len(self.clouds_W)))


class _Frame(NamedTuple):
    """One image or cloud, points p_CQ = depth ray, and its table.

    Attributes:
        ray: (N, 3) float32; z = 1 in an image, unit vectors in a cloud.
        depth: (N,) float32 [m].
        depth_range: minimum and maximum depth that is used [m].
        X_WC: (4, 4) pose; None: unknown.
        view: the image; None: a cloud.
        table: the supporting plane in the world; None: not found.
        extent_W: (E, 3) points that span it in this frame [m].
        samples: number of samples on it.
        rms: their rms distance from it [m].
        note: empty, or the reason why the frame is not usable by itself.
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
        """Checks which depths are in range."""
        return np.asarray((depth >= self.depth_range[0]) & (depth <= self.depth_range[1]))

    def points(self, index: IntArray) -> NDArray[np.float32]:
        """Points (M, 3) of some indices (M,) in the frame C [m]."""
        return np.take(self.ray, index, axis=0) * self.depth[index, None]


class _Part(NamedTuple):
    """Points of one frame above the table.

    Attributes:
        frame: the frame.
        p_WQ: (N, 3) points [m].
        number: (N,) their indices in the frame.
        is_higher: (N,) whether each is higher than noise and bend of the camera.
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
        The segmentation. A frame without a table is no error: it has no clouds
        and a note.

    Raises:
        ValueError: without X_WC where `config.table` excludes a table.
    """
    return segment_views([(depth, K, X_WC)], config, robot)


def segment_views(
    views: Sequence[View] | Sequence[tuple[Any, Any, Any]],
    config: SegmentationConfig | None = None,
    robot: CollisionGeometries | None = None,
) -> Segmentation:
    """Segments depth images of one instant together; otherwise as `segment_depth`.

    In an image without a table, or with another one than in the image with the largest table, the
    table of that image is used. An image with hardly any depth is ignored, and listed in `unusable_views`;
    if all are, the frame is not usable.

    Args:
        views: one or more depth images: depth, K and X_WC of each, as in `segment_depth`.
        config: the parameters; None for the defaults.
        robot: the robot's solids at the time of the images, or None.

    Raises:
        ValueError: as `segment_depth` does.
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
    """Segments a cloud without image structure; otherwise as `segment_depth`.

    Args:
        points: (N, 3) points [m] in the frame C that X_WC places: the camera's, or
            the world itself with the identity. Rows that are not finite, or all
            zero, are ignored.
        X_WC: (4, 4) pose of that frame, or None when unknown.
        config: the parameters; `near` and `far` have no effect. None for the defaults.
        robot: the robot's solids at the time of the cloud, or None.
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
    frames = [_with_table(frame, config) for frame in frames]
    # The table of the image that shows most of it also holds for images without one.
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
        _above(frame, largest.table, config)
        for number, frame in enumerate(frames)
        if number not in unusable_views
    ]
    found = _cluster(parts, largest.table, config, robot)
    return replace(found, plane_rms=largest.rms, X_WC=X_WC, unusable_views=unusable_views)


def _with_table(frame: _Frame, config: SegmentationConfig) -> _Frame:
    """Finds the table in a frame."""
    # Infinite depth counts as visible, missing depth does not.
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


def _above(frame: _Frame, table: TablePlane | None, config: SegmentationConfig) -> _Part:
    """Finds the points of a frame above the table; without a table, all."""
    X_WC, depth = frame.X_WC, frame.depth
    if X_WC is None:
        raise ValueError("X_WC must be given where no table defines it")
    if table is None:
        normal, offset, low, high = np.zeros(3), 0.0, -1.0, 1.0
    else:
        # A table that differs belongs to another object.
        plane = frame.table
        if plane is None or plane.distance_to(table) > HEIGHT_TOLERANCE:
            plane, frame = table, frame._replace(extent_W=np.zeros((0, 3)))
        normal, offset = X_WC[:3, :3].T @ plane.normal_W, -float(plane.height(X_WC[:3, 3]))
        low, high = offset + _MIN_HEIGHT, offset + config.max_height
    # The deviation of depth is DEPTH_NOISE z^2; the height of a point z r of a plane with
    # n . z r = offset deviates by that times |n . r| = |offset| / z.
    noise = np.float32(_DEVIATIONS * DEPTH_NOISE * abs(offset))
    slope = frame.ray @ normal.astype(np.float32)
    with np.errstate(invalid="ignore"):
        number = np.flatnonzero(depth * (slope - noise) > np.float32(low))
    z = depth[number]
    is_used = frame.is_valid(z) & (z * slope[number] < high)
    number, z = number[is_used], z[is_used]
    bend = np.minimum(_WARP * np.maximum(z - _WARP_START, 0.0) ** 2, _LARGEST_WARP)
    is_higher = z * (slope[number] - noise) > low + bend
    p_WQ = frame.points(number) @ X_WC[:3, :3].T + X_WC[:3, 3]
    return _Part(frame, p_WQ, number, is_higher)


def _cluster(
    parts: Sequence[_Part],
    table: TablePlane | None,
    config: SegmentationConfig,
    robot: CollisionGeometries | None,
) -> Segmentation:
    """Clusters the points of all frames above the table."""
    views = tuple(part.frame.view for part in parts if part.frame.view is not None)
    p_WQ = np.concatenate([part.p_WQ for part in parts])
    means, voxel_of, count = voxel_means(p_WQ, config.voxel)
    is_kept = count >= _MIN_OCCUPANCY
    if robot is not None:
        margin = config.robot_margin
        distance = least_distances(robot, means[is_kept], 0.0, margin, margin)
        is_kept[is_kept] = distance >= margin
    if table is not None:
        extent_W = np.concatenate([part.frame.extent_W for part in parts])
        outside = distance_beyond(means[is_kept], extent_W, table.normal_W)
        is_kept[is_kept] = _on_table(means[is_kept], outside, config)
    label = np.full(len(means), -1)
    label[is_kept] = connected_clusters(means[is_kept], config.cluster_tolerance)
    label = _merged(means, label, voxel_of, parts, config)
    sizes = np.bincount(label + 1, minlength=1)[1:]
    is_large = sizes >= config.min_cluster_voxels
    if table is not None:
        is_higher = np.bincount(voxel_of, np.concatenate([part.is_higher for part in parts]))
        higher = np.bincount(label + 1, is_higher >= 0.5 * count, minlength=1)[1:]
        is_large &= higher >= np.maximum(_HIGHER_SHARE * sizes, 3.0)
    chosen = np.argsort(-sizes * is_large, kind="stable")[: np.count_nonzero(is_large)]
    row = np.full(len(sizes) + 1, -1)
    row[chosen] = np.arange(len(chosen))
    label = row[label]
    return Segmentation(
        tuple(means[label == cluster] for cluster in range(len(chosen))),
        tuple(_labels(parts, label[voxel_of])),
        table,
        p_WQ,
        views=views,
    )


def _labels(parts: Sequence[_Part], of_point: IntArray) -> list[NDArray[np.int16]]:
    """Lists the clusters of all pixels of each frame, -1: none, by those of all points used."""
    labels, ends = [], np.cumsum([len(part.number) for part in parts])[:-1]
    for part, own in zip(parts, np.split(of_point, ends), strict=True):
        label = np.full(len(part.frame.depth), -1, dtype=np.int16)
        label[part.number] = own
        labels.append(label)
    return labels


def _on_table(points: FloatArray, outside: FloatArray, config: SegmentationConfig) -> BoolArray:
    """Finds points of objects above the table: above it, or overhanging parts.

    A wall behind the table, most of which is outside, and which continues beyond the overhang,
    is no part of an object that it touches.

    Args:
        points: (N, 3) [m].
        outside: (N,) their distances beyond the table [m].
        config: `table_margin`, `cluster_tolerance` and `voxel` are used.
    """
    beyond = config.table_margin + _OVERHANG
    inside, near = outside <= config.table_margin, outside <= beyond
    if (inside == near).all():
        return inside
    label = connected_clusters(points[near], config.cluster_tolerance)
    continues = np.bincount(label, outside[near] > beyond - 2.0 * config.voxel) > 0.0
    share = np.bincount(label, inside[near]) / np.bincount(label)
    overhangs = share >= np.where(continues, 0.5, _OVER_TABLE)
    inside[near] |= overhangs[label]
    return inside


def _merged(
    means: FloatArray,
    label: IntArray,
    voxel_of: IntArray,
    parts: Sequence[_Part],
    config: SegmentationConfig,
) -> IntArray:
    """Merges clusters with a short gap between them that no image sees through.

    The rim and the inside of a bowl are separate clusters; so are two boxes with a gap between
    them, but there the table is visible.

    Args:
        means: (M, 3) points in the world frame [m].
        label: (M,) their clusters, -1: none.
        voxel_of: (N,) row among them of each point of the frames.
        parts: the frames.
        config: `voxel` and `min_cluster_voxels` are used; smaller clusters are not merged.
    """
    images = [
        (part.frame.view, owner)
        for part, owner in zip(parts, _labels(parts, label[voxel_of]), strict=True)
        if part.frame.view is not None
    ]
    if not images:
        return label
    sizes = np.bincount(label + 1, minlength=1)[1:]
    large = np.flatnonzero(sizes >= config.min_cluster_voxels).tolist()
    trees = [(cluster, cKDTree(means[label == cluster])) for cluster in large]
    merged = np.append(np.arange(len(sizes)), -1)
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
            seen = owner[pixel]
            is_open |= (is_behind & (seen != one) & (seen != other)).any(axis=0)
        if 0 < len(bridges) >= 2 * np.count_nonzero(is_open):
            merged[merged == merged[other]] = merged[one]
    return merged[label]


def _pose_from_plane(plane: PlaneFit) -> FloatArray:
    """X_WC of the world that a table defines, see `segment_depth`."""
    n = plane.normal
    # The ray (0, 0, t) meets n . p = offset, if in front and not grazing.
    t = plane.offset / n[2] if abs(n[2]) > 0.05 else -1.0
    origin_C = np.array([0.0, 0.0, t]) if t > 0.0 else plane.offset * n
    x = np.array([1.0, 0.0, 0.0]) - n[0] * n
    x /= np.linalg.norm(x)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.stack([x, np.cross(n, x), n])
    X_WC[:3, 3] = -X_WC[:3, :3] @ origin_C
    return X_WC
