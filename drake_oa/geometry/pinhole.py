"""The pinhole camera, and what its depth image shows where points should be.

Column u = fx x / z + cx and row v = fy y / z + cy of a point (x, y, z).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, IntArray

HIDDEN, AT, FREE, OUT, EMPTY = 0, 1, 2, 3, 4
"""What an image shows where a point should be: something before it, something at its
depth, only what is behind it, nothing at all, or nothing far around it either: as before a
background that is too far away to be measured."""
_AROUND = 12  # how far around it [pixel]: shadows beside what stands before it are narrower


class View(NamedTuple):
    """A depth image, and where it was taken from.

    Attributes:
        z: (H, W) float32 depth [m].
        K: (4,) fx, fy, cx, cy [pixel].
        X_WC: (4, 4) pose of the camera (x right, y down, z forward).
    """

    z: NDArray[np.float32]
    K: FloatArray
    X_WC: FloatArray

    @staticmethod
    def of(depth: NDArray[np.floating], K: FloatArray, X_WC: FloatArray) -> View:
        """The arrays as kernels take them: writable, C-contiguous, of one type each."""
        z = np.require(depth, np.float32, ["C", "W"])
        return View(z, *(np.require(a, np.float64, ["C", "W"]) for a in (K, X_WC)))


def pinhole(camera: CameraInfo) -> list[float]:
    """[fx, fy, cx, cy] of a camera [pixel]."""
    return [camera.focal_x(), camera.focal_y(), camera.center_x(), camera.center_y()]


@lru_cache(maxsize=8)
def pixel_rays(
    shape: tuple[int, int], fx: float, fy: float, cx: float, cy: float
) -> NDArray[np.float32]:
    """Rays (H W, 3) of unit depth through the pixels of an image, in the camera frame."""
    row, column = np.indices(shape)
    ray = np.stack([(column - cx) / fx, (row - cy) / fy, np.ones(shape)], axis=-1)
    return ray.reshape(-1, 3).astype(np.float32)


def pixel_at(p_C: FloatArray, shape: tuple[int, ...], K: FloatArray) -> IntArray:
    """Computes flat indices of the pixels of an image at points of the camera frame.

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


@compiled
def shown(points: FloatArray, view: View, margin: float, pixel: IntArray) -> IntArray:
    """What a depth image shows where points should be.

    Nine pixels are asked about each point, so that one that is missing, or flies,
    decides nothing.

    Args:
        points: (N, 3) in the world frame [m].
        view: the depth image.
        margin: depth difference that tells "before" and "behind" from "at" [m].
        pixel: (N,) written: flat index of each point's pixel, -1 outside the image.

    Returns:
        (N,) HIDDEN, AT, FREE, OUT or EMPTY.
    """
    z, K, X_WC = view
    rows, columns = z.shape
    seen = np.full(len(points), OUT, dtype=np.int64)
    p = np.empty(3)
    for i in range(len(points)):
        pixel[i] = -1
        for k in range(3):
            p[k] = 0.0
            for m in range(3):
                p[k] += X_WC[m, k] * (points[i, m] - X_WC[m, 3])
        if p[2] < 1e-6:
            continue
        u = int(np.floor(K[0] * p[0] / p[2] + K[2] + 0.5))
        v = int(np.floor(K[1] * p[1] / p[2] + K[3] + 0.5))
        if u < 0 or u >= columns or v < 0 or v >= rows:
            continue
        pixel[i] = v * columns + u
        at, before, behind = 0, 0, 0
        for row in range(max(0, v - 1), min(rows, v + 2)):
            for column in range(max(0, u - 1), min(columns, u + 2)):
                depth = z[row, column]
                if not depth > 0.0:
                    continue
                beyond = depth - p[2]
                if beyond > margin:
                    behind += 1
                elif beyond < -margin:
                    before += 1
                else:
                    at += 1
        if at > 0:
            seen[i] = AT
        elif before > 0:
            seen[i] = HIDDEN
        elif behind > 2:
            seen[i] = FREE
        elif behind == 0 and _is_empty(z, v, u):
            seen[i] = EMPTY
    return seen


@compiled
def _is_empty(z: NDArray[np.float32], row: int, column: int) -> bool:
    """Whether pixels all around a pixel have no depth; not where the image ends."""
    rows, columns = z.shape
    for i in range(-2, 3):
        for j in range(-2, 3):
            v, u = row + i * _AROUND // 2, column + j * _AROUND // 2
            if v < 0 or v >= rows or u < 0 or u >= columns or z[v, u] > 0.0:
                return False
    return True
