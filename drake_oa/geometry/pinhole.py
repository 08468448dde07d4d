"""The intrinsics of a pinhole camera."""

from __future__ import annotations

from pydrake.systems.sensors import CameraInfo


def pinhole(camera: CameraInfo) -> list[float]:
    """[fx, fy, cx, cy] of a camera [pixel]."""
    return [camera.focal_x(), camera.focal_y(), camera.center_x(), camera.center_y()]
