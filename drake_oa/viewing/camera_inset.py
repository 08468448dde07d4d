"""What a depth camera sees, as a small picture that stands in the view."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.perception import BaseField, Fields, PointCloud

from drake_oa.common.messages import FloatArray, ObstacleClouds
from drake_oa.geometry.pinhole import View, pixel_at
from drake_oa.viewing.viewer import floor_frame, looking_pose

_PATH = "/drake_oa/inset"
_COLUMNS = 128
_WIDTH = 0.42
"""Of the picture [m], at `_AWAY` [m] from whoever looks, in the upper left corner."""
_AWAY, _LEFT, _UP = 1.5, -0.44, 0.26
_MISSING = (0.12, 0.12, 0.14)
_NEAR, _FAR = np.array([0.97, 0.97, 0.99]), np.array([0.22, 0.28, 0.38])
_OBSTACLES = np.array([[0.90, 0.35, 0.13], [0.16, 0.55, 0.30], [0.55, 0.30, 0.70], [0.9, 0.7, 0.1]])
"""Colours of what is taken for obstacles, by their names."""


def depth_picture(view: View, seen: ObstacleClouds, columns: int = _COLUMNS) -> FloatArray:
    """A depth image as colours: near is light, missing dark, obstacles coloured.

    Args:
        view: the image, depth (H, W) [m].
        seen: what it was segmented into.
        columns: about how many the picture has.

    Returns:
        (h, w, 3) in [0, 1], each `stride` pixels of the image.
    """
    stride = max(1, view.z.shape[1] // columns)
    z = view.z[::stride, ::stride]
    there = np.isfinite(z) & (z > 0.0)
    picture = np.tile(_MISSING, (*z.shape, 1))
    if there.any():
        low, high = np.percentile(z[there], [2, 98])
        share = np.clip((z[there] - low) / max(high - low, 1e-3), 0.0, 1.0)[:, None]
        picture[there] = (1.0 - share) * _NEAR + share * _FAR
    R_WC, p_WC = view.X_WC[:3, :3], view.X_WC[:3, 3]
    for name, cloud_W in zip(seen.ids, seen.clouds_W, strict=True):
        pixel = pixel_at((np.asarray(cloud_W) - p_WC) @ R_WC, z.shape, view.K / stride)
        color = _OBSTACLES[int(name) % len(_OBSTACLES)]
        picture.reshape(-1, 3)[pixel[pixel >= 0]] = color
    return picture


class CameraInset:
    """Draws what cameras see where whoever looks first sees it."""

    def __init__(self, meshcat: Meshcat, X_WB: RigidTransform, floor: float) -> None:
        """Draws nothing yet; the arguments are those of `drake_oa.viewing.viewer.dress_scene`."""
        self._meshcat = meshcat
        # x to the right, y up.
        X_CS = RigidTransform(RotationMatrix.MakeXRotation(np.pi), [_LEFT, -_UP, _AWAY])
        self._X_WS = looking_pose(floor_frame(X_WB, floor)) @ X_CS

    def show(self, view: View, seen: ObstacleClouds) -> None:
        """Draws an image and what it was segmented into."""
        picture = depth_picture(view, seen)
        rows, columns, _ = picture.shape
        pitch = _WIDTH / columns
        x, y = np.meshgrid(np.arange(columns) - columns / 2, rows / 2 - np.arange(rows))
        cloud = PointCloud(rows * columns, Fields(BaseField.kXYZs | BaseField.kRGBs))
        cloud.mutable_xyzs()[:] = np.stack([pitch * x.ravel(), pitch * y.ravel(), np.zeros(x.size)])
        # Meshcat's colors are linear.
        cloud.mutable_rgbs()[:] = (255.0 * picture.reshape(-1, 3).T ** 2.2).astype(np.uint8)
        self._meshcat.SetObject(_PATH, cloud, point_size=2.6 * pitch)
        self._meshcat.SetTransform(_PATH, self._X_WS)

    def hide(self) -> None:
        """Takes the picture away."""
        self._meshcat.Delete(_PATH)
