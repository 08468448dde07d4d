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
from scipy.ndimage import binary_opening

from drake_oa.clusters import connected_clusters, joined_across_unseen, voxel_keys
from drake_oa.self_filter import PosedShapes
from drake_oa.table_plane import PlaneFit, fit_plane
from drake_oa.values import TablePlane

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

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
    fx, fy, cx, cy = _valid_intrinsics(depth, K)
    X_WC = _valid_pose(X_WC)
    z = depth.astype(np.float32, copy=False)
    step = config.stride
    coarse = z[::step, ::step]
    valid = (coarse >= config.near) & (coarse <= config.far)
    rows, columns = np.nonzero(valid)
    if not len(rows):
        return Segmentation(X_WC=np.eye(4) if X_WC is None else X_WC, note="no valid pixel")
    sample_z = coarse[rows, columns].astype(float)
    sample = np.asarray(
        _back_project(rows * step, columns * step, sample_z, fx, fy, cx, cy), dtype=float
    )
    plane = _find_table(sample, sample_z, X_WC, config)
    if plane is None:
        return Segmentation(X_WC=np.eye(4) if X_WC is None else X_WC, note=_NO_TABLE)

    # Opening removes the thin line where the plane cuts a wall. Projection keeps
    # convexity, so the ends of each row span the table's convex extent.
    on_table = np.zeros(valid.shape, dtype=np.int64)
    on_table[rows, columns] = np.where(plane.inliers, np.arange(1, len(rows) + 1), 0)
    on_table *= binary_opening(on_table > 0, np.ones((3, 3), dtype=bool))
    seen = on_table[on_table.any(axis=1)]
    first = (seen > 0).argmax(axis=1)
    last = seen.shape[1] - 1 - (seen[:, ::-1] > 0).argmax(axis=1)
    ends = np.arange(len(seen))
    extent = sample[np.concatenate([seen[ends, first], seen[ends, last]]) - 1]
    index = _pixels_above(z, (fx, fy, cx, cy), plane, config)
    row, column = np.divmod(index, z.shape[1])
    p_CQ = _back_project(row, column, z.ravel()[index], fx, fy, cx, cy)
    image = (z, np.array([fx, fy, cx, cy]))
    return _cluster_above(p_CQ, index, plane, extent, X_WC, config, robot, image)


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
    p_CQ = points[index].astype(float)
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
    near_table = _inside_box(p_CQ, extent_C, plane.normal, config.table_margin)
    index = index[near_table]
    p_WQ = p_CQ[near_table] @ X_WC[:3, :3].T + X_WC[:3, 3]
    if not len(index):
        return Segmentation((), (), table, p_WQ, plane.rms, X_WC)

    keys, voxel_of, count = np.unique(
        voxel_keys(p_WQ, config.voxel), return_inverse=True, return_counts=True
    )
    means = np.empty((len(keys), 3))
    for axis in range(3):
        means[:, axis] = np.bincount(voxel_of, p_WQ[:, axis], len(keys)) / count
    extent_W = extent_C @ X_WC[:3, :3].T + X_WC[:3, 3]
    keep = (count >= config.min_occupancy) & _above_extent(
        means, extent_W, normal_W, config.table_margin
    )
    if robot is not None:
        keep &= ~robot.contains(means, config.robot_margin)

    kept = np.flatnonzero(keep)
    label = np.full(len(keys), -1)
    found = connected_clusters(means[kept], config.cluster_tolerance)
    if image is not None:
        label[kept] = found
        pixel_label = np.full(image[0].size, -1, dtype=np.int64)
        pixel_label[index] = label[voxel_of]
        found = joined_across_unseen(
            means[kept],
            found,
            pixel_label,
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
    return Segmentation(
        tuple(means[label == name] for name in names),
        tuple(index[point_label == name] for name in names),
        table,
        p_WQ,
        plane.rms,
        X_WC,
    )


def _pixels_above(
    z: NDArray[np.float32], K: tuple[float, ...], plane: PlaneFit, config: SegmentationConfig
) -> IntArray:
    """Flat indices of the pixels whose height over the plane may be an obstacle's."""
    # height = n . p_C - offset = z (a u + b v + c) - offset > min_height + noise z
    fx, fy, cx, cy = K
    n, offset = plane.normal, plane.offset
    a, b = n[0] / fx, n[1] / fy
    noise = _height_noise(config, offset)
    u = (a * np.arange(z.shape[1]) + (n[2] - a * cx - b * cy - noise)).astype(np.float32)
    v = (b * np.arange(z.shape[0])).astype(np.float32)
    raised = u[None, :] + v[:, None]
    with np.errstate(invalid="ignore"):  # inf times zero: compares false, as it should
        raised *= z
    index = np.flatnonzero(raised > np.float32(offset + config.min_height))
    depth = z.ravel()[index]
    height = raised.ravel()[index] + np.float32(noise) * depth - np.float32(offset)
    index = index[(depth >= config.near) & (depth <= config.far) & (height < config.max_height)]
    return np.asarray(index)


def _plane_axes(normal: FloatArray) -> FloatArray:
    """(2, 3) orthonormal axes of the plane with that normal."""
    across = np.eye(3)[np.argmin(np.abs(normal))]
    first = across - (across @ normal) * normal
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _inside_box(
    points: NDArray[np.floating], table: FloatArray, normal: FloatArray, margin: float
) -> BoolArray:
    """Which points stand over a rectangle around the table's points: a quick crop."""
    if not len(table):
        return np.zeros(len(points), dtype=bool)
    axes = _plane_axes(normal)
    inside = np.ones(len(points), dtype=bool)
    for axis in axes:
        along, reach = points @ axis.astype(points.dtype), table @ axis
        inside &= (along >= reach.min() - margin) & (along <= reach.max() + margin)
    return inside


def _above_extent(
    p_WQ: FloatArray, table_W: FloatArray, normal_W: FloatArray, margin: float
) -> BoolArray:
    """Which points stand over the convex extent of the table's points."""
    angle = np.arange(_DIRECTIONS) * (2.0 * np.pi / _DIRECTIONS)
    directions = np.stack([np.cos(angle), np.sin(angle)]).T @ _plane_axes(normal_W)
    reach = (directions @ table_W.T).max(axis=1) + margin
    return np.asarray((directions @ p_WQ.T <= reach[:, None]).all(axis=0))


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


def _back_project(
    row: IntArray,
    column: IntArray,
    z: NDArray[np.floating],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
) -> NDArray[np.floating]:
    """Points (N, 3) of the pixels, in the precision of their depths."""
    p_CQ = np.empty((len(z), 3), dtype=z.dtype)
    p_CQ[:, 0] = (column - cx) * (z / fx)
    p_CQ[:, 1] = (row - cy) * (z / fy)
    p_CQ[:, 2] = z
    return p_CQ


def _valid_intrinsics(depth: NDArray[np.floating], K: FloatArray) -> FloatArray:
    if depth.ndim != 2 or not np.issubdtype(depth.dtype, np.floating):
        raise ValueError(
            f"depth must be an (H, W) array of floats in metres, not {depth.dtype} {depth.shape}"
        )
    K = np.asarray(K, dtype=float)
    if K.shape != (4,) or not np.isfinite(K).all() or (K[:2] <= 0.0).any():
        raise ValueError(f"K must be [fx, fy, cx, cy] with positive focal lengths, not {K}")
    return K


def _valid_pose(X_WC: FloatArray | None) -> FloatArray | None:
    if X_WC is None:
        return None
    X_WC = np.asarray(X_WC, dtype=float)
    if X_WC.shape != (4, 4) or not np.isfinite(X_WC).all():
        raise ValueError(f"X_WC must be a finite (4, 4) pose, not one of shape {X_WC.shape}")
    R = X_WC[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-6 or np.linalg.det(R) < 0.0:
        raise ValueError("X_WC must hold a rotation: its upper left block is not orthonormal")
    return X_WC
