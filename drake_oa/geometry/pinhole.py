"""The pinhole camera: column u = fx x / z + cx and row v = fy y / z + cy of a point (x, y, z)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray


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


@compiled
def pixel_at(x: float, y: float, z: float, rows: int, columns: int, K: FloatArray) -> int:
    """Flat index of the pixel that shows a point of the camera frame; -1: none does."""
    if not z > 1e-6:
        return -1
    column = np.rint(K[0] * x / z + K[2])
    row = np.rint(K[1] * y / z + K[3])
    if not (column >= 0 and column < columns and row >= 0 and row < rows):
        return -1
    return int(row) * columns + int(column)
