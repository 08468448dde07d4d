"""Projection of points by a pinhole camera, and classification of points by a depth image as free,
occluded or at a surface.

In the camera frame x is right, y down and z forward. A point (x, y, z) is projected to

    column u = fx x / z + cx,    row v = fy y / z + cy.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.messages import FloatArray, IntArray

HIDDEN, AT, FREE, OUT, EMPTY = 0, 1, 2, 3, 4
"""States of a point in a depth image, as returned by `classify_points`.

HIDDEN: occluded; AT: at the depth of a surface; FREE: in free space; OUT: outside the image, or
with too few measured pixels to decide; EMPTY: without depth in the pixels around it and 12 pixels
away, as in front of a background that is too far to be measured."""
_AROUND = 12
"""Distance along rows and columns from a point's pixel to eight pixels around it [pixel].

They are tested for a point without depth in its pixel and the adjacent ones. If all eight are in
the image and have no depth either, the point is EMPTY, otherwise OUT. The distance is larger than
the width of the bands without depth beside nearer objects."""
_STEPS = np.indices((3, 3)).reshape(2, -1) - 1
"""Row and column offsets (2, 9) from a pixel to itself and its eight neighbors [pixel]."""


class View(NamedTuple):
    """Depth image of a camera, with the intrinsics and the pose of this camera.

    Attributes:
        z: (H, W) float32 depth along the optical axis [m]; not positive: no depth.
        K: (4,) focal lengths fx, fy and principal point cx, cy [pixel].
        X_WC: (4, 4) pose of the camera in the world (x right, y down, z forward).
    """

    z: NDArray[np.float32]
    K: FloatArray
    X_WC: FloatArray


def pinhole(camera: CameraInfo) -> list[float]:
    """Returns the intrinsics of a camera: focal lengths fx, fy, and principal point cx, cy, in
    pixels.
    """
    return [camera.focal_x(), camera.focal_y(), camera.center_x(), camera.center_y()]


@lru_cache(maxsize=8)
def pixel_rays(
    shape: tuple[int, int], fx: float, fy: float, cx: float, cy: float
) -> NDArray[np.float32]:
    """Computes rays (H W, 3) through the pixels of an image, in the camera frame and scaled to a
    depth of 1.

    Args:
        shape: rows H and columns W of the image.
        fx, fy, cx, cy: focal lengths and principal point of the camera [pixel].
    """
    row, column = np.indices(shape)
    ray = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(shape)], axis=-1)
    return ray.reshape(-1, 3).astype(np.float32)


def pixel_at(p_C: FloatArray, shape: tuple[int, ...], K: FloatArray) -> IntArray:
    """Computes the pixels to which a camera projects points, as indices of the flattened image.

    Args:
        p_C: (..., 3) points in the camera frame [m].
        shape: rows and columns of the image.
        K: (4,) focal lengths fx, fy and principal point cx, cy [pixel].

    Returns:
        (...) indices, row times the number of columns plus column; -1 behind the camera and outside
        the image.
    """
    z = np.where(p_C[..., 2] > 1e-6, p_C[..., 2], np.nan)
    column = np.rint(K[0] * p_C[..., 0] / z + K[2])
    row = np.rint(K[1] * p_C[..., 1] / z + K[3])
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    return np.where(inside, row * shape[1] + column, -1).astype(np.int64)


def classify_points(points: FloatArray, view: View, margin: float) -> tuple[IntArray, IntArray]:
    """Classifies points by a depth image: occluded, at a surface, in free space, or unobserved.

    The depths of the point's pixel and its eight neighbors are compared with that of the point. If
    any is equal up to `margin`, the point is AT; otherwise HIDDEN if any is smaller, and FREE if at
    least three are larger. Thus a single pixel without depth does not make a point EMPTY, and one
    with the mixed depth of an edge does not make it FREE.

    Args:
        points: (N, 3) points in the world frame [m].
        view: depth image with intrinsics and pose of its camera.
        margin: maximum difference in depth for which a point counts as at a surface [m].

    Returns:
        (N,) states: HIDDEN (occluded), AT (at a surface), FREE (in free space), EMPTY (no depth in
        the nine pixels, nor in eight pixels at a distance of 12 pixels around them, all in the
        image) or OUT (all other points); and (N,) indices of the points' pixels in the flattened
        image, -1 outside it.
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


def look_at_pose(X_WF: RigidTransform, p_FC: ArrayLike, p_FT: ArrayLike) -> RigidTransform:
    """Returns the pose X_WC of a camera C at a given position that looks at a target T.

    The z axis of the camera points at T, and its x axis is horizontal, to the right in the image.

    Args:
        X_WF: pose in the world of the frame F in which both positions are given.
        p_FC: (3,) position of the camera in F [m].
        p_FT: (3,) position of the target T in F [m].
    """
    p_WC = X_WF @ np.asarray(p_FC)
    ahead = X_WF @ np.asarray(p_FT) - p_WC
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    axes = np.column_stack([right, np.cross(ahead, right), ahead])
    return RigidTransform(RotationMatrix(axes / np.linalg.norm(axes, axis=0)), p_WC)
