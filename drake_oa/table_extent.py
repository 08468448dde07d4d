"""How far a table reaches: the convex region of its plane that holds what was seen of it.

Projection keeps convexity, so the ends of the table's rows in the image span that
region. A table that the border of the image cuts goes on beyond it: the feet of what
stands in front of the lowest row are not seen.
"""

from __future__ import annotations

import numpy as np

from drake_oa.point_cloud_kernels import beyond_halfplanes
from drake_oa.values import BoolArray, FloatArray, IntArray

# Outer normals of the half-planes that bound the region.
_OUTWARD = np.column_stack([f(np.arange(64) * (2.0 * np.pi / 64)) for f in (np.cos, np.sin)])
_UNSEEN = 0.3  # how far a table is taken to go on beyond the border of the image [m]
_BEYOND = 0.5  # how far beyond the border, in sizes of the image, that is looked up
_BORDER = 2  # rows and columns of the grid that are the border


def seen_extent(
    shape: tuple[int, int],
    pixel: IntArray,
    on_table: BoolArray,
    p_CQ: FloatArray,
    normal: FloatArray,
    offset: float,
    pitch: tuple[float, float],
) -> FloatArray:
    """Points (E, 3) on the plane, in the camera frame [m], that span the table's extent.

    Args:
        shape: rows and columns of the grid of samples.
        pixel: (N,) ascending flat index of each sample in that grid.
        on_table: (N,) whether it lies on the table.
        p_CQ: (N, 3) the samples in the camera frame [m].
        normal: (3,) the table's unit normal in the camera frame.
        offset: ``normal . p`` of its points [m].
        pitch: tangents x / z and y / z from a column and a row of the grid to the next.
    """
    ends = _row_ends(shape, pixel, on_table)
    if not len(ends):
        return p_CQ[:0]
    row, column = np.divmod(pixel[ends], shape[1])
    seen_rows, seen_columns = pixel[[0, -1]] // shape[1], pixel % shape[1]
    left, right = int(seen_columns.min()), int(seen_columns.max())
    extent = [p_CQ[ends]]
    # Not beyond the upper border: what is there is farther away than its feet are.
    wide, high = _BEYOND * shape[1] * pitch[0], _BEYOND * shape[0] * pitch[1]
    for at_border, step in (
        (row >= seen_rows[1] - _BORDER, np.array([0.0, high, 0.0])),
        (column <= left + _BORDER, np.array([-wide, 0.0, 0.0])),
        (column >= right - _BORDER, np.array([wide, 0.0, 0.0])),
    ):
        if at_border.any():
            extent.append(_beyond(p_CQ[ends[at_border]], step, normal, offset))
    return np.concatenate(extent)


def beyond_extent(p_WQ: FloatArray, table_W: FloatArray, normal_W: FloatArray) -> FloatArray:
    """How far points stand beyond the convex extent of the table's points.

    Args:
        p_WQ: (N, 3) points [m].
        table_W: (E, 3) points of the table [m].
        normal_W: (3,) its unit normal.

    Returns:
        (N,) largest distance, along the plane, beyond any of the half-planes that bound
        the extent [m]: negative inside; infinite where the table has no extent.
    """
    if not len(table_W):
        return np.full(len(p_WQ), np.inf)
    axes = plane_axes(normal_W)
    reach = (_OUTWARD @ (axes @ table_W.T)).max(axis=1)
    return np.asarray(beyond_halfplanes(p_WQ, axes, _OUTWARD, reach))


def plane_axes(normal: FloatArray) -> FloatArray:
    """(2, 3) orthonormal axes of the plane with that normal."""
    across = np.eye(3)[np.argmin(np.abs(normal))]
    first = across - (across @ normal) * normal
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _beyond(border: FloatArray, step: FloatArray, normal: FloatArray, offset: float) -> FloatArray:
    """Points of the table beyond the border: where rays further out meet the plane.

    Args:
        border: (B, 3) points of the table at the border [m].
        step: (3,) tangents from the border outwards.
        normal: (3,) unit normal of the table.
        offset: ``normal . p`` of its points [m].
    """
    inner = border / border[:, 2:]
    ray = inner + step
    along = ray @ normal
    # Rays that do not meet the plane in front of the camera go on as far as any may.
    met = along * np.sign(offset) > 1e-3
    hit = ray * (offset / np.where(met, along, 1.0))[:, None]
    away = np.where(met[:, None], hit - border, step)
    away -= np.outer(away @ normal, normal)
    length = np.linalg.norm(away, axis=1)
    reach = np.where(met, np.minimum(length, _UNSEEN), _UNSEEN)
    return np.asarray(border + away * (reach / np.maximum(length, 1e-9))[:, None])


def _row_ends(shape: tuple[int, int], pixel: IntArray, on_table: BoolArray) -> IntArray:
    """Which of the samples are the ends of the table's rows; see `seen_extent`."""
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
