"""Compiled loops over depth images: pixels to points, and points to the table's surroundings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, IntArray


@compiled
def sampled(
    z: NDArray[np.float32], stride: int, near: float, far: float
) -> tuple[IntArray, IntArray]:
    """The pixels with a depth in [near, far] on every stride-th row and column.

    Returns:
        (N,) their flat indices in that coarser image, and (N,) in the image itself.
    """
    rows, columns = (z.shape[0] - 1) // stride + 1, (z.shape[1] - 1) // stride + 1
    coarse = np.empty(rows * columns, dtype=np.int64)
    fine = np.empty(rows * columns, dtype=np.int64)
    n = 0
    for row in range(rows):
        for column in range(columns):
            depth = z[row * stride, column * stride]
            if depth >= near and depth <= far:
                coarse[n] = row * columns + column
                fine[n] = row * stride * z.shape[1] + column * stride
                n += 1
    return coarse[:n].copy(), fine[:n].copy()


@compiled
def pixels_between(
    z: NDArray[np.float32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    limits: NDArray[np.float32],
) -> IntArray:
    """Flat indices of the pixels whose height over a plane is within limits.

    The height above the plane less the noise is ``z (u + v) - offset``.

    Args:
        z: (H, W) float32 depth [m].
        u: (W,) float32 share of the column.
        v: (H,) float32 share of the row.
        limits: (5,) float32 near, far, lowest ``z (u + v)``, noise per depth, and
            highest ``z (u + v + noise)``.
    """
    near, far, low, noise, high = limits
    # A mask first, then its places, both without branches: so the first loop uses
    # vector instructions, and the second need not predict the outcomes. The mask's
    # rows are whole words, of which most are empty.
    rows, columns = z.shape
    words = (columns + 7) // 8
    inside = np.empty((rows, 8 * words), dtype=np.uint8)
    inside[:, columns:] = 0
    for row in range(rows):
        for column in range(columns):
            depth = z[row, column]
            raised = depth * (u[column] + v[row])
            seen = (depth >= near) & (depth <= far)
            inside[row, column] = seen & (raised > low) & (raised + noise * depth < high)
    flags = inside.ravel()
    word = flags.view(np.uint64)
    full, count = np.empty(len(word), dtype=np.int64), 0
    for i in range(len(word)):
        full[count] = i
        count += word[i] != 0
    out = np.empty(8 * count + 1, dtype=np.int64)
    n = 0
    for i in full[:count]:
        start = 8 * i - (i // words) * (8 * words - columns)
        for bit in range(8):
            out[n] = start + bit
            n += flags[8 * i + bit]
    return out[:n]


@compiled
def back_projected(z: NDArray[np.float32], index: IntArray, K: FloatArray) -> FloatArray:
    """Points (N, 3) in the camera frame of the pixels with ascending flat indices (N,)."""
    p_CQ = np.empty((len(index), 3))
    row, start = 0, 0
    for i in range(len(index)):
        while index[i] >= start + z.shape[1]:
            row += 1
            start += z.shape[1]
        column = index[i] - start
        depth = z[row, column]
        p_CQ[i, 0] = (column - K[2]) * (depth / K[0])
        p_CQ[i, 1] = (row - K[3]) * (depth / K[1])
        p_CQ[i, 2] = depth
    return p_CQ


@compiled
def cropped_to_world(
    p_CQ: FloatArray, index: IntArray, axes: FloatArray, reach: FloatArray, X_WC: FloatArray
) -> tuple[FloatArray, IntArray]:
    """The points whose coordinates along two axes are in reach, in the world frame.

    Args:
        p_CQ: (N, 3) points in the camera frame [m].
        index: (N,) their numbers, handed through.
        axes: (2, 3) unit vectors in the camera frame.
        reach: (2, 2) lowest and highest coordinate along each axis [m].
        X_WC: (4, 4) pose of the camera.
    """
    p_WQ = np.empty(p_CQ.shape)
    kept = np.empty(len(index), dtype=np.int64)
    n = 0
    for i in range(len(index)):
        x, y, depth = p_CQ[i, 0], p_CQ[i, 1], p_CQ[i, 2]
        inside = True
        for k in range(2):
            along = axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * depth
            inside &= (along >= reach[k, 0]) & (along <= reach[k, 1])
        kept[n] = index[i]
        for k in range(3):
            p_WQ[n, k] = X_WC[k, 0] * x + X_WC[k, 1] * y + X_WC[k, 2] * depth + X_WC[k, 3]
        n += inside
    return p_WQ[:n], kept[:n]
