"""Signed distance field of a cloud of points: a grid of voxels around it, in its own frame.

The cost of a distance is independent of the number of points. The frame O has
the world's axes; its origin is the first node of the grid, and it moves with the obstacle. Nodes
lie in the middle of the world's voxels, so that a cloud of one point a voxel fills the same ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray, TablePlane

VOXEL = 0.01
"""Edge of a field's voxels [m]."""
MARGIN = 0.25
"""Distance by which a field exceeds the cloud's box [m]: beyond, distances are lower bounds."""
MAX_CELLS = 1 << 20
"""Maximum number of nodes of a field (4 MB); larger clouds have coarser voxels."""
DEEPEST = 0.08
"""Maximum depth of an obstacle that is seen from one side [m]."""

OFFSET = 0.13
"""Reduction of every distance [voxel], so that it is at most one voxel too large.

A point is at most sqrt(3) / 2 from its node, and interpolation adds at most 0.26 to the distance
from a node (found by search: near the middle of a voxel that has the node as a corner).
"""
_THIN = 1e-4
"""Half the breadth of each point in the outline from above [m]."""
_TOO_NEAR = 0.05
"""Distance of a viewpoint below which it contains no information about depth [m]."""
_PIXEL = 1.0
"""Size of a pixel of the image from a viewpoint, at the middle of the cloud [voxel]."""
_MAX_PIXELS = 1024
"""Maximum number of rows and columns of that image."""


@dataclass(frozen=True, eq=False)
class DistanceField(Frozen):
    """Signed distances to a cloud at the nodes of a grid.

    Between nodes they are interpolated. Outside the cloud the distance is at most one voxel, as it
    was requested, too large; for the opposite error see `field_of`.

    Attributes:
        p_WO: (3,) the first node in the world, when the cloud was seen [m].
        voxel: edge of a voxel [m].
        values: (nx, ny, nz) float32 distances at the nodes p_WO + voxel (i, j, k) [m].
        low, high: (3,) box, in O, of the occupied nodes [m].
    """

    p_WO: FloatArray
    voxel: float
    values: NDArray[np.float32]
    low: FloatArray
    high: FloatArray


def field_of(
    cloud: FloatArray,
    *,
    viewpoints_W: ArrayLike = (),
    deepest: float = DEEPEST,
    table: TablePlane | None = None,
    seen_free: Callable[[FloatArray], BoolArray] | None = None,
) -> DistanceField:
    """Computes the distance field of a cloud, exact at its nodes for the voxels of the points.

    With a viewpoint, the space that the obstacle occludes is filled too: voxels behind the visible
    surface, on a ray of the viewpoint, horizontally by at most
    `deepest` (or the obstacle's breadth or visible depth); within its outline from above, which
    is that of the visible part and of its image beyond the middle of an object as deep as visible,
    or as broad, at most `deepest`; and above the table, without one above the lowest point, and as
    far below the highest as it is thick. With several viewpoints, the union is filled, without the
    space that is seen to be free.

    The distance is at most one voxel larger than that to the points, and smaller by at most two
    (the point to its node, sqrt(3)/2; a crease of the distance between nodes, as much again;
    the offset, 0.13); away from creases, as outside a surface, by at most one. With voxels
    coarser than requested, all distances are smaller by the difference.

    Args:
        cloud: (N, 3) points in the world, at least one [m].
        viewpoints_W: (n, 3) positions of the cameras that saw the cloud [m]; none: nothing is
            filled.
        deepest: maximum depth of an obstacle that is seen from one side [m].
        table: nothing is filled below it.
        seen_free: returns of points (N, 3) [m] whether an image sees through them: they are not
            filled. None: no image is known but for the cloud.
    """
    points = np.asarray(cloud, dtype=float)
    low, high = points.min(axis=0), points.max(axis=0)
    if table is not None:
        low[2] -= np.clip(table.height(points).min(), 0.0, MARGIN)
    voxel, first, count = _grid(low, high)
    p_WO, coarser = (first + 0.5) * voxel, voxel - VOXEL
    occupied = np.zeros(tuple(count), dtype=bool)
    # The node nearest to each point.
    occupied[tuple(np.floor((points - p_WO) / voxel + 0.5).astype(np.int64).T)] = True
    for p_WV in np.reshape(viewpoints_W, (-1, 3)):
        nodes = _hidden(points, p_WV, p_WO, voxel, deepest, table)
        nodes = nodes[~occupied[tuple(nodes.T)]]
        if seen_free is not None:
            nodes = nodes[~seen_free(p_WO + voxel * nodes)]
        occupied[tuple(nodes.T)] = True
    outside = _distances(occupied)
    # Around the occupied nodes there are free ones.
    within = ndimage.find_objects(occupied.view(np.int8))[0]
    around = tuple(slice(side.start - 1, side.stop + 1) for side in within)
    inside = _distances(~occupied[around])
    outside[around] -= np.maximum(inside - 1.0, 0.0)
    low, high = (np.array([getattr(side, end) for side in within]) for end in ("start", "stop"))
    return DistanceField(
        p_WO,
        voxel,
        (voxel * (outside - OFFSET) - coarser).astype(np.float32),
        low * voxel - coarser,
        (high - 1) * voxel + coarser,
    )


def _distances(occupied: BoolArray) -> FloatArray:
    """Distances from the nodes of a grid to the nearest of those that are occupied [voxel]."""
    squared = np.where(occupied, 0.0, np.inf).astype(np.float32)
    for _ in range(3):
        lines = np.ascontiguousarray(np.moveaxis(squared, 0, 2))
        squared = _nearest_along(lines.reshape(-1, lines.shape[2])).reshape(lines.shape)
    return np.sqrt(squared, dtype=float)


@compiled
def _nearest_along(lines: FloatArray) -> FloatArray:
    """Minimum over j of f_j + (i - j)^2 at each i of lines f (L, n), by the lower envelope.

    P. Felzenszwalb and D. Huttenlocher, "Distance transforms of sampled functions", Theory of
    Computing 8(19), 2012.
    """
    least, n = np.empty_like(lines), lines.shape[1]
    vertex, begin = np.zeros(n, dtype=np.int64), np.empty(n)
    for row in range(len(lines)):
        f, count = lines[row], 0
        for j in range(n):
            if f[j] == np.inf:
                continue
            while count > 0:
                k = vertex[count - 1]
                at = (f[j] - f[k] + j * j - k * k) / (2 * (j - k))
                if at > begin[count - 1]:
                    break
                count -= 1
            vertex[count], begin[count] = j, at if count > 0 else -np.inf
            count += 1
        place = 0
        for i in range(n):
            while place + 1 < count and begin[place + 1] < i:
                place += 1
            least[row, i] = f[vertex[place]] + (i - vertex[place]) ** 2
    return least


def _grid(low: FloatArray, high: FloatArray) -> tuple[float, FloatArray, IntArray]:
    """Edge of a voxel [m], numbers (3,) of the first in the world, and count (3,)."""
    voxel = VOXEL
    while True:
        # All around the occupied nodes at least one is free.
        past = max(MARGIN, 1.5 * voxel)
        first = np.floor((low - past) / voxel)
        count = np.floor((high + past) / voxel) - first + 1.0
        cells = math.prod(count.tolist())
        if cells <= MAX_CELLS:
            return voxel, first, count.astype(np.int64)
        voxel *= min(max(1.01, (cells / MAX_CELLS) ** (1.0 / 3.0)), 1e3)


def _hidden(
    points: FloatArray,
    p_WV: FloatArray,
    p_WO: FloatArray,
    voxel: float,
    deepest: float,
    table: TablePlane | None,
) -> IntArray:
    """Finds the nodes (K, 3) of a grid that are occluded from a viewpoint, see `field_of`.

    Args:
        points: (N, 3) points of the obstacle [m].
        p_WV: (3,) the viewpoint [m].
        p_WO: (3,) the first node of the grid [m].
        voxel: edge of its voxels [m].
        deepest: maximum depth [m].
        table: nothing is filled below it.
    """
    nodes = np.zeros((0, 3), dtype=np.int64)
    low, high = points.min(axis=0), points.max(axis=0)
    view = 0.5 * (low + high) - p_WV
    distance, level = float(np.linalg.norm(view)), float(np.hypot(view[0], view[1]))
    if np.linalg.norm(np.clip(p_WV, low, high) - p_WV) < _TOO_NEAR:
        return nodes
    away = view[:2] / level if level > 1e-6 else np.array([1.0, 0.0])
    along, across = points[:, :2] @ away, points[:, :2] @ [away[1], -away[0]]
    breadth, depth = float(np.ptp(across)), float(np.ptp(along))
    outline = _outline(along, across, max(depth, min(breadth, deepest)))
    run, thick = min(max(breadth, depth), deepest), min(breadth, deepest)
    # Down to the table, or as thick as it is deep.
    normal, offset = (table.normal_W, table.offset) if table else (np.array([0.0, 0.0, 1.0]), 0.0)
    height = points @ normal - offset
    bottom = 0.0 if table is not None else min(float(height.min()), float(height.max()) - thick)
    # Points around a near viewpoint make no image; those beside it are left as they are.
    z_V = view / distance
    x_V = np.array([away[1], -away[0], 0.0])
    R_WV = np.column_stack([x_V, np.cross(z_V, x_V), z_V])
    p_VQ = (points - p_WV) @ R_WV
    p_VQ = p_VQ[p_VQ[:, 2] > 0.2 * np.linalg.norm(p_VQ, axis=1)]
    if not len(p_VQ):
        return nodes
    image = p_VQ[:, :2] / p_VQ[:, 2:]
    pixel = max(_PIXEL * voxel / distance, float(np.ptp(image, axis=0).max()) / _MAX_PIXELS)
    corner = image.min(axis=0) - 1.5 * pixel
    near = _depth_image((image - corner) / pixel, np.linalg.norm(p_VQ, axis=1))

    first = np.floor((low - deepest - p_WO) / voxel).astype(np.int64)
    last = np.floor((high + deepest - p_WO) / voxel).astype(np.int64) + 1
    first[2] = 1
    columns = np.indices(last[:2] - first[:2]).reshape(2, -1).T + first[:2]
    p_WN = p_WO[:2] + voxel * columns
    place = np.column_stack([p_WN @ away, p_WN @ [away[1], -away[0]]])
    columns = columns[(place @ outline[:, :2].T <= outline[:, 2] + 0.5 * voxel).all(axis=1)]
    rows = np.arange(first[2], last[2])
    nodes = np.column_stack([np.repeat(columns, len(rows), axis=0), np.tile(rows, len(columns))])
    p_WN = p_WO + voxel * nodes
    nodes = nodes[p_WN @ normal >= offset + bottom]
    p_VN = (p_WO + voxel * nodes - p_WV) @ R_WV
    with np.errstate(all="ignore"):
        u, v = np.floor((p_VN[:, :2] / p_VN[:, 2:] - corner) / pixel).T
    in_image = (p_VN[:, 2] > 0.0) & (u >= 0) & (v >= 0)
    in_image &= (u < near.shape[0]) & (v < near.shape[1])
    nodes, r = nodes[in_image], np.linalg.norm(p_VN[in_image], axis=1)
    behind = r - near[u[in_image].astype(np.int64), v[in_image].astype(np.int64)]
    horizontal = np.hypot(*(p_WO + voxel * nodes - p_WV)[:, :2].T) / r
    is_hidden = (behind >= 0.0) & (behind * horizontal <= run + 0.5 * voxel)
    return nodes[is_hidden]


def _outline(along: FloatArray, across: FloatArray, depth: float) -> FloatArray:
    """(E, 3) sides of the outline of an obstacle from above, with its occluded part.

    Most objects are symmetric about a vertical axis (J. Bohg et al., ICRA 2011, mirror the visible
    part at a plane): the outline is the convex hull of the points and of their images beyond the
    middle.

    Args:
        along, across: (N,) places of the points along the view and across it [m].
        depth: of the obstacle along the view, from its first point [m].
    """
    points = np.column_stack([along, across])
    middle = [along.min() + 0.5 * depth, 0.5 * (across.min() + across.max())]
    points = np.concatenate([points, 2.0 * np.array(middle) - points])
    # The visible part may be a line, or one point.
    corners = _THIN * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    sides = ConvexHull((points[:, None] + corners).reshape(-1, 2)).equations
    return np.asarray(sides * [1.0, 1.0, -1.0])


def _depth_image(place: FloatArray, distance: FloatArray) -> FloatArray:
    """Draws the nearest distances of points; inf where there are none.

    Args:
        place: (N, 2) of the points [pixel].
        distance: (N,) of them [m].
    """
    near = np.full(tuple(np.floor(place.max(axis=0)).astype(np.int64) + 3), np.inf)
    # Each point is drawn on the four nearest pixels.
    corner = np.floor(place - 0.5).astype(np.int64)
    for step in np.ndindex(2, 2):
        np.minimum.at(near, tuple((corner + step).T), distance)
    drawn = near < np.inf
    gap = ndimage.binary_closing(drawn, np.ones((3, 3))) & ~drawn
    return np.where(gap, ndimage.minimum_filter(near, 3), near)
