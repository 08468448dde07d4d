"""Projection of a pinhole camera, and classification of points by a depth image.

Column u = fx x / z + cx and row v = fy y / z + cy of a point (x, y, z) in the camera frame
(x right, y down, z forward).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.messages import FloatArray, IntArray

HIDDEN, AT, FREE, OUT, EMPTY = 0, 1, 2, 3, 4
"""States of a point in a depth image.

HIDDEN: occluded; AT: at the depth of a surface; FREE: in free space; OUT: outside the image, or
without depth; EMPTY: without depth, also far around it, as before a background too far to be
measured.
"""
_AROUND = 12
"""Distance of the pixels around a pixel that decide between OUT and EMPTY [pixel].

It is larger than the width of the bands without depth beside nearer objects.
"""
_STEPS = np.indices((3, 3)).reshape(2, -1) - 1
"""Row and column offsets (2, 9) of a pixel and its eight neighbors [pixel]."""


class View(NamedTuple):
    """Depth image with the intrinsics and the pose of its camera.

    Attributes:
        z: (H, W) float32 depth along the optical axis [m].
        K: (4,) fx, fy, cx, cy [pixel].
        X_WC: (4, 4) pose of the camera (x right, y down, z forward).
    """

    z: NDArray[np.float32]
    K: FloatArray
    X_WC: FloatArray


def pinhole(camera: CameraInfo) -> list[float]:
    """Returns the intrinsics [fx, fy, cx, cy] of a camera [pixel]."""
    return [camera.focal_x(), camera.focal_y(), camera.center_x(), camera.center_y()]


@lru_cache(maxsize=8)
def pixel_rays(
    shape: tuple[int, int], fx: float, fy: float, cx: float, cy: float
) -> NDArray[np.float32]:
    """Computes rays (H W, 3) of unit depth through the pixels of an image, in the camera frame."""
    row, column = np.indices(shape)
    ray = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(shape)], axis=-1)
    return ray.reshape(-1, 3).astype(np.float32)


def pixel_at(p_C: FloatArray, shape: tuple[int, ...], K: FloatArray) -> IntArray:
    """Computes flat indices of the pixels of points in the camera frame.

    Args:
        p_C: (..., 3) points [m].
        shape: rows and columns of the image.
        K: (4,) fx, fy, cx, cy [pixel].

    Returns:
        (...) indices; -1 behind the camera and outside the image.
    """
    z = np.where(p_C[..., 2] > 1e-6, p_C[..., 2], np.nan)
    column = np.rint(K[0] * p_C[..., 0] / z + K[2])
    row = np.rint(K[1] * p_C[..., 1] / z + K[3])
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    return np.where(inside, row * shape[1] + column, -1).astype(np.int64)


def classify_points(points: FloatArray, view: View, margin: float) -> tuple[IntArray, IntArray]:
    """Classifies points by a depth image: occluded, at a surface, free, or unobserved.

    Nine pixels around each point are used: a single pixel without depth, or with the mixed depth of
    an edge, does not decide.

    Args:
        points: (N, 3) points in the world frame [m].
        view: depth image.
        margin: maximum depth difference of a point and the surface that it is at [m].

    Returns:
        (N,) states HIDDEN, AT, FREE, OUT or EMPTY, and (N,) flat indices of the pixels, -1 outside
        the image.
    """
    p_C = (points - view.X_WC[:3, 3]) @ view.X_WC[:3, :3]
    z, (rows, columns) = view.z, view.z.shape
    pixel = pixel_at(p_C, z.shape, view.K)
    row, column = np.divmod(pixel, columns)
    near = _STEPS[:, :, None]
    depth = z[np.clip(row + near[0], 0, rows - 1), np.clip(column + near[1], 0, columns - 1)]
    is_measured = depth > 0.0
    with np.errstate(invalid="ignore"):
        beyond = depth - p_C[:, 2]
        behind = (is_measured & (beyond > margin)).sum(axis=0)
        is_before = (is_measured & (beyond < -margin)).any(axis=0)
        is_at = (is_measured & (np.abs(beyond) <= margin)).any(axis=0)
    # EMPTY requires pixels around it without depth; at the border of the image there are too few.
    far = _AROUND * near
    is_inside = (row >= _AROUND) & (row < rows - _AROUND)
    is_inside &= (column >= _AROUND) & (column < columns - _AROUND)
    around = z[np.clip(row + far[0], 0, rows - 1), np.clip(column + far[1], 0, columns - 1)]
    is_empty = is_inside & ~is_measured.any(axis=0) & ~(around > 0.0).any(axis=0)
    state = np.select(
        [pixel < 0, is_at, is_before, behind > 2, is_empty], [OUT, AT, HIDDEN, FREE, EMPTY], OUT
    )
    return state, pixel
