"""From a depth image or a cloud to one cluster of points for each obstacle.

The order keeps a 640x480 frame cheap: the supporting plane from a subsample,
the height of every pixel above it (one linear map on the image), then points,
voxels and clusters of only those pixels that stand on the plane.

Frames: W world, C depth camera (x right, y down, z forward). Poses are (4, 4)
homogeneous matrices, as ``RigidTransform.GetAsMatrix4()`` gives them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from drake_oa.clusters import connected_clusters, joined_across_unseen, voxel_keys
from drake_oa.point_cloud_kernels import (
    back_projected,
    cropped_to_world,
    numbered,
    pixels_between,
    sampled,
    sums,
    within_halfplanes,
)
from drake_oa.self_filter import PosedShapes
from drake_oa.table_plane import PlaneFit, fit_plane
from drake_oa.values import BoolArray, FloatArray, IntArray, TablePlane

_DIRECTIONS = 64  # half-planes that bound the table's extent


@dataclass(frozen=True)
class SegmentationConfig:
    """How a frame is segmented. Lengths in metres, angles in radians."""

    # Depths outside [near, far] are ignored.
    near: float = 0.3
    far: float = 2.5
    # Standard deviation of depth at 1 m; it grows with the square of the depth.
    depth_noise: float = 0.0015
    # Largest tilt of the table against gravity when the camera's pose is known,
    plane_tilt: float = np.deg2rad(5.0)
    # and against the camera's up direction (-y) when it is not.
    plane_tilt_unknown_pose: float = np.deg2rad(75.0)
    # Distance from the plane at which a point (at depth 0) belongs to it.
    plane_tolerance: float = 0.006
    # Height of the table in the world, or None when unknown.
    table_height: float | None = None
    # How far the table may be from that height.
    table_height_tolerance: float = 0.05
    # Heights above the table that may be an obstacle (the lower limit at depth 0).
    min_height: float = 0.008
    max_height: float = 1.2
    # How far beyond the table's seen extent an obstacle may stand.
    table_margin: float = 0.02
    # Edge of a voxel, and the fewest points that make one.
    voxel: float = 0.01
    min_occupancy: int = 2
    # Points nearer to each other than this belong together.
    cluster_tolerance: float = 0.025
    # Clusters up to this far apart belong together too where nothing shows through
    # the gap (the rim and the inside of a bowl).
    unseen_gap: float = 0.06
    # The fewest voxels that make an obstacle.
    min_cluster_voxels: int = 12
    # Points within this of the robot are the robot's.
    robot_margin: float = 0.025
    # The plane is searched on every stride-th row and column.
    stride: int = 4

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if value is None and item.name == "table_height":
                continue
            number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
            if not number or not np.isfinite(value):
                raise ValueError(f"SegmentationConfig.{item.name} must be finite, not {value!r}")
            if item.name != "table_height" and value < 0.0:
                raise ValueError(f"SegmentationConfig.{item.name} must be >= 0, not {value!r}")
        for name in ("voxel", "cluster_tolerance", "plane_tolerance", "table_height_tolerance"):
            if getattr(self, name) <= 0.0:
                raise ValueError(f"SegmentationConfig.{name} must be > 0")
        for name in ("min_occupancy", "min_cluster_voxels", "stride"):
            if getattr(self, name) < 1 or getattr(self, name) != int(getattr(self, name)):
                raise ValueError(f"SegmentationConfig.{name} must be an integer >= 1")
            object.__setattr__(self, name, int(getattr(self, name)))
        for low, high in (("near", "far"), ("min_height", "max_height")):
            if getattr(self, low) >= getattr(self, high):
                raise ValueError(f"SegmentationConfig.{low} must be less than {high}")
        for name in ("plane_tilt", "plane_tilt_unknown_pose"):
            if not 0.0 < getattr(self, name) < np.pi / 2:
                raise ValueError(f"SegmentationConfig.{name} must lie in (0, pi/2)")


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What stands on the table in one frame.

    Attributes:
        clouds_W: one (N_i, 3) array an obstacle: the mean point of each voxel, in
            the world frame [m]; the largest cluster first.
        pixels: for each cluster the flat indices (row-major) of its pixels, or of
            its input points when the frame was a cloud.
        table: the supporting plane in the world frame, or None.
        points_W: (N, 3) every single point over the table, the robot's included, in
            the world frame [m]: for viewing.
        plane_rms: rms distance of the plane's points from it [m]; NaN without plane.
        X_WC: (4, 4) the camera's pose; when it was not given, the pose that makes
            the table the plane z = 0 (see `segment_depth`).
        note: empty, or why there is no plane.
    """

    clouds_W: tuple[FloatArray, ...] = ()
    pixels: tuple[IntArray, ...] = ()
    table: TablePlane | None = None
    points_W: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    plane_rms: float = np.nan
    X_WC: FloatArray = field(default_factory=lambda: np.eye(4))
    note: str = ""


def segment_depth(
    depth: NDArray[np.floating],
    K: FloatArray,
    X_WC: FloatArray | None,
    config: SegmentationConfig | None = None,
    robot: PosedShapes | None = None,
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
        robot: the robot's primitives at the time of the image, or None.

    Returns:
        The segmentation. A frame that shows no table is no error: it has no clouds
        and a note.

    Raises:
        ValueError: for an array of the wrong shape or type, an invalid K or X_WC.
    """
    config = config or SegmentationConfig()
    depth = np.asarray(depth)
    K = _valid_intrinsics(depth, K)
    X_WC = _valid_pose(X_WC)
    z = np.require(depth, np.float32, ["C", "W"])
    step = config.stride
    on_grid, pixels = sampled(z, step, float(config.near), float(config.far))
    if not len(on_grid):
        return Segmentation(X_WC=np.eye(4) if X_WC is None else X_WC, note="no valid pixel")
    sample = back_projected(z, pixels, K)
    plane = _find_table(sample, sample[:, 2], X_WC, config)
    if plane is None:
        return Segmentation(X_WC=np.eye(4) if X_WC is None else X_WC, note=_NO_TABLE)

    grid = (-(-z.shape[0] // step), -(-z.shape[1] // step))
    extent = sample[_row_ends(grid, on_grid, plane.inliers)]
    index = _pixels_above(z, K, plane, config)
    p_CQ = back_projected(z, index, K)
    return _cluster_above(p_CQ, index, plane, extent, X_WC, config, robot, (z, K))


def segment_points(
    points: FloatArray,
    X_WC: FloatArray | None,
    config: SegmentationConfig | None = None,
    robot: PosedShapes | None = None,
) -> Segmentation:
    """Segments a cloud without image structure; otherwise as `segment_depth`.

    Args:
        points: (N, 3) points [m] in the frame C that X_WC places: the camera's, or
            the world itself with the identity. Rows that are not finite, or all
            zero, are ignored; there is no crop by depth.
        X_WC: (4, 4) pose of that frame, or None when unknown.
        config: the parameters; None for the defaults.
        robot: the robot's primitives at the time of the cloud, or None.

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
        return Segmentation(X_WC=np.eye(4) if X_WC is None else X_WC, note="no valid point")
    p_CQ = np.require(points[index], np.float64, ["C", "W"])
    distance = np.linalg.norm(p_CQ, axis=1)
    step = max(1, len(index) // 20_000)
    sample = p_CQ[::step]
    plane = _find_table(sample, distance[::step], X_WC, config)
    if plane is None:
        return Segmentation(X_WC=np.eye(4) if X_WC is None else X_WC, note=_NO_TABLE)
    height = p_CQ @ plane.normal - plane.offset
    low = config.min_height + _height_noise(config, plane.offset) * distance
    above = np.flatnonzero((height > low) & (height < config.max_height))
    extent = sample[plane.inliers]
    return _cluster_above(p_CQ[above], index[above], plane, extent, X_WC, config, robot, None)


_NO_TABLE = "no supporting plane found"


def _height_noise(config: SegmentationConfig, offset: float) -> float:
    """What noise may look like a height (3 standard deviations), per metre of depth.

    The depth's deviation is ``depth_noise z**2``; of a plane's point, at the ray z r
    with z n . r = offset, the height's is that times abs(n . r) = abs(offset) / z.
    """
    return 3.0 * config.depth_noise * abs(offset)


def _find_table(
    sample: FloatArray, distance: FloatArray, X_WC: FloatArray | None, config: SegmentationConfig
) -> PlaneFit | None:
    tolerance = config.plane_tolerance + config.depth_noise * distance**2
    if X_WC is None:
        up = np.array([0.0, -1.0, 0.0])
        return fit_plane(sample, up, config.plane_tilt_unknown_pose, tolerance, origin_above=True)
    up = X_WC[2, :3]
    height = None if config.table_height is None else config.table_height - X_WC[2, 3]
    return fit_plane(
        sample,
        up,
        config.plane_tilt,
        tolerance,
        height=height,
        height_tolerance=config.table_height_tolerance,
    )


def _cluster_above(
    p_CQ: NDArray[np.floating],
    index: IntArray,
    plane: PlaneFit,
    extent_C: FloatArray,
    X_WC: FloatArray | None,
    config: SegmentationConfig,
    robot: PosedShapes | None,
    image: tuple[NDArray[np.floating], FloatArray] | None,
) -> Segmentation:
    X_WC = _pose_from_plane(plane) if X_WC is None else X_WC
    normal_W = X_WC[:3, :3] @ plane.normal
    table = TablePlane(normal_W, float(plane.offset + normal_W @ X_WC[:3, 3]))
    # A rectangle around the table is a quick crop; its convex extent comes later.
    axes = _plane_axes(plane.normal)
    along = axes @ extent_C.T
    low, high = along.min(axis=1, initial=np.inf), along.max(axis=1, initial=-np.inf)
    reach = np.column_stack([low - config.table_margin, high + config.table_margin])
    p_WQ, index = cropped_to_world(p_CQ, index, axes, reach, X_WC)
    if not len(index):
        return Segmentation((), (), table, p_WQ, plane.rms, X_WC)

    means, voxel_of, count = _voxel_means(p_WQ, config.voxel)
    extent_W = extent_C @ X_WC[:3, :3].T + X_WC[:3, 3]
    kept = np.flatnonzero(count >= config.min_occupancy)
    kept = kept[_above_extent(means[kept], extent_W, normal_W, config.table_margin)]
    if robot is not None:
        kept = kept[~robot.contains(means[kept], config.robot_margin)]
    label = np.full(len(means), -1)
    found = connected_clusters(means[kept], config.cluster_tolerance)
    if image is not None:
        label[kept] = found
        found = joined_across_unseen(
            means[kept],
            found,
            index,
            label[voxel_of],
            *image,
            X_WC,
            gap=config.unseen_gap,
            voxel=config.voxel,
            min_size=config.min_cluster_voxels,
        )
    label[kept] = found
    sizes = np.bincount(label[kept], minlength=1)
    names = np.flatnonzero(sizes >= config.min_cluster_voxels)
    names = names[np.argsort(-sizes[names], kind="stable")]
    point_label = label[voxel_of]
    clustered = np.flatnonzero(point_label >= 0)
    index, point_label = index[clustered], point_label[clustered]
    return Segmentation(
        tuple(means[label == name] for name in names),
        tuple(index[point_label == name] for name in names),
        table,
        p_WQ,
        plane.rms,
        X_WC,
    )


def _row_ends(shape: tuple[int, int], pixel: IntArray, on_table: BoolArray) -> IntArray:
    """Which of the samples are the ends of the table's rows.

    Projection keeps convexity, so the ends of each row span the table's convex extent.

    Args:
        shape: rows and columns of the grid that was sampled.
        pixel: (N,) flat index of each sample in that grid.
        on_table: (N,) whether it lies on the table.
    """
    table = np.zeros(shape, dtype=bool)
    table.ravel()[pixel[on_table]] = True
    # Opening removes the thin line where the plane cuts a wall.
    table = _opened(table)
    rows = np.flatnonzero(table.any(axis=1))
    seen = table[rows]
    last = shape[1] - 1 - seen[:, ::-1].argmax(axis=1)
    ends = np.concatenate([seen.argmax(axis=1), last]) + np.tile(rows, 2) * shape[1]
    return np.searchsorted(pixel, ends)


def _opened(mask: BoolArray) -> BoolArray:
    """Opening of a mask by a square of 3 x 3; outside the image is false."""
    inner = mask[:-2] & mask[1:-1] & mask[2:]
    eroded = np.zeros_like(mask)
    eroded[1:-1, 1:-1] = inner[:, :-2] & inner[:, 1:-1] & inner[:, 2:]
    wide = eroded.copy()
    wide[:, 1:] |= eroded[:, :-1]
    wide[:, :-1] |= eroded[:, 1:]
    opened = wide.copy()
    opened[1:] |= wide[:-1]
    opened[:-1] |= wide[1:]
    return opened


def _pixels_above(
    z: NDArray[np.float32], K: FloatArray, plane: PlaneFit, config: SegmentationConfig
) -> IntArray:
    """Flat indices of the pixels whose height over the plane may be an obstacle's."""
    # height = n . p_C - offset = z (a u + b v + c) - offset > min_height + noise z
    fx, fy, cx, cy = K
    n, offset = plane.normal, plane.offset
    a, b = n[0] / fx, n[1] / fy
    noise = _height_noise(config, offset)
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


def _voxel_means(points: FloatArray, voxel: float) -> tuple[FloatArray, IntArray, IntArray]:
    """Voxels of points (N, 3) in order of their keys.

    Returns:
        Means (M, 3), the voxel (N,) of each point, and counts (M,).
    """
    keys, number = numbered(voxel_keys(points, voxel))
    order = np.argsort(keys)
    place = np.empty_like(order)
    place[order] = np.arange(len(order))
    voxel_of, count = place[number], np.zeros(len(order), dtype=np.int64)
    total = np.zeros((len(order), 3))
    sums(points, voxel_of, count, total)
    return total / count[:, None], voxel_of, count


def _plane_axes(normal: FloatArray) -> FloatArray:
    """(2, 3) orthonormal axes of the plane with that normal."""
    across = np.eye(3)[np.argmin(np.abs(normal))]
    first = across - (across @ normal) * normal
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _above_extent(
    p_WQ: FloatArray, table_W: FloatArray, normal_W: FloatArray, margin: float
) -> BoolArray:
    """Which points stand over the convex extent of the table's points."""
    angle = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    directions = np.column_stack([np.cos(angle), np.sin(angle)])
    axes = _plane_axes(normal_W)
    reach = (directions @ (axes @ table_W.T)).max(axis=1) + margin
    return within_halfplanes(p_WQ, axes, directions, reach)


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
