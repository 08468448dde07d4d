"""How far a table reaches: the convex region of its plane that holds what was seen of it.

Projection keeps convexity, so the ends of the table's rows in the image span that
region. A table that the border of the image cuts goes on beyond it: the feet of what
stands in front of the lowest row are not seen.
"""

from __future__ import annotations

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.perception.table_kernels import beyond_halfplanes, extent_points

# Outer normals of the half-planes that bound the region.
_OUTWARD = np.column_stack([f(np.arange(64) * (2.0 * np.pi / 64)) for f in (np.cos, np.sin)])


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
    plane = np.append(normal, offset)
    return np.asarray(extent_points(*shape, pixel, on_table, p_CQ, plane, np.array(pitch)))


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
    a, b, c = normal
    smallest = int(np.argmin(np.abs(normal)))
    first = -normal[smallest] * normal
    first[smallest] += 1.0
    first /= np.sqrt(first @ first)
    x, y, z = first
    # NumPy's cross product takes long for so few numbers.
    return np.array([first, [b * z - c * y, c * x - a * z, a * y - b * x]])
