"""The parameters by which a depth image or a cloud is segmented."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np


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
    # Where that shows little, against the direction towards the camera (-z).
    facing_tilt: float = np.deg2rad(15.0)
    # Distance from the plane at which a point (at depth 0) belongs to it.
    plane_tolerance: float = 0.006
    # Height of the table in the world, or None when unknown.
    table_height: float | None = None
    # How far the table may be from that height.
    table_height_tolerance: float = 0.05
    # Heights above the table that may be an obstacle (the lower limit at depth 0; what
    # noise may look like is added to it).
    min_height: float = 0.004
    max_height: float = 1.2
    # How far beyond the table's seen extent an obstacle may stand,
    table_margin: float = 0.02
    # and how far one that stands over it may jut out.
    overhang: float = 0.15
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
        for name in ("plane_tilt", "plane_tilt_unknown_pose", "facing_tilt"):
            if not 0.0 < getattr(self, name) < np.pi / 2:
                raise ValueError(f"SegmentationConfig.{name} must lie in (0, pi/2)")
