"""Signed distance field of an obstacle's point cloud: distances to the cloud at the nodes of a grid
around it.

Distances are negative inside the obstacle. A distance query has the same cost for any number of
points. The frame O of the grid has the world's axes, and its origin is the first node; it moves
with the obstacle. Nodes are the centers of voxels, whose grid has a corner at the world's origin,
so that a cloud of one point per voxel occupies one node per point.
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
"""Edge of the voxels of a distance field, unless its cloud is so large that `MAX_CELLS` requires a
longer edge [m]."""
MARGIN = 0.25
"""Distance by which the grid of a distance field extends beyond the bounding box of its cloud [m].
"""
MAX_CELLS = 1 << 20
"""Maximum number of nodes of a distance field (4 MB); the voxels of a field for a larger cloud are
coarser [-]."""
DEEPEST = 0.08
"""Maximum depth that is assumed for an obstacle when its occluded part is filled [m].

Cameras often observe an obstacle from one side only, so that its depth along the view is unknown.
If the visible depth is larger than this value, the visible depth is assumed."""

OFFSET = 0.13
"""Constant that is subtracted from all distances of a distance field, so that they are at most one
voxel too large [voxel].

In voxels, a point of the cloud is at most sqrt(3) / 2 from the node that represents it, and the
interpolated distance to a node is at most 0.26 too large. The sum is 1.13. The value 0.26 is the
result of a numerical search; it occurs near the center of a grid cell with the node as a corner."""
_THIN = 1e-4
"""Half the edge of the square that replaces each point in the computation of an obstacle's outline
from above, so that collinear points have an outline [m]."""
_MIN_VIEW_DISTANCE = 0.05
"""Minimum distance of a camera from the bounding box of the cloud at which the space that the
obstacle occludes is filled [m]."""
_PIXEL = 1.0
"""Width that a pixel of a depth image covers at the distance of the center of the cloud [voxel].

The space that the cloud occludes is computed from this image of the cloud. If the image would have
more than `_MAX_PIXELS` rows or columns, pixels are wider."""
_MAX_PIXELS = 1024
"""Maximum number of rows and of columns of the depth image from which the space that a cloud
occludes is computed [-]."""


@dataclass(frozen=True, eq=False)
class DistanceField(Frozen):
    """Signed distances to a point cloud at the nodes of a grid; between nodes they are
    interpolated.

    The frame O of the grid has the world's axes and its origin at the first node. A node is
    occupied if its voxel contains a point, or if it is in the space behind the points that the
    obstacle probably fills. Distances are negative inside the occupied space. Outside, they differ
    from the true distances to the points: a value is at most one voxel too large and, without
    filled space and with voxels of the default edge of 1 cm, at most two voxels too small.

    Attributes:
        p_WO: (3,) first node in the world, at the observation of the cloud [m].
        voxel: edge of a voxel, the distance between neighboring nodes [m].
        values: (nx, ny, nz) float32 distances at the nodes p_WO + voxel (i, j, k) [m].
        low, high: (3,) corners in O of the bounding box of the occupied nodes, enlarged on each
            side by the excess of `voxel` over 1 cm (`VOXEL`) [m].
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
    """Computes the distance field of a point cloud, after filling the space that the obstacle
    occludes from the cameras.

    A node is occupied if its voxel contains a point. At each node the distance to the nearest
    occupied node is exact. Further nodes are occupied because the obstacle probably fills them. For
    each viewpoint, let the width be the horizontal extent of the points across the view, and the
    visible depth their horizontal extent along the view. The assumed depth is the larger of the
    visible depth and min(width, `deepest`). A node is also occupied if it satisfies all of
    these conditions:

    - The node is behind the visible surface on a ray of the viewpoint. Its horizontal distance from
      this surface is at most `deepest`, and at most the larger of width and visible depth.
    - Seen from above, the node is within the convex outline of the points and of their reflections
      about the center of the obstacle. Along the view, this center is half the assumed depth behind
      the nearest point; across the view, it is in the middle of the points.
    - The node is above the table. Without a table, it is above the lowest point, or at most
      min(width, `deepest`) below the highest point.
    - The node is not observed to be free.

    An interpolated distance is at most one voxel larger than that to the points. If no space is
    filled, it is at most two voxels smaller. These two consist of sqrt(3)/2 from the point to its
    node, as much again at creases of the distance field, where two occupied nodes are equally near,
    and the subtracted offset of 0.13. Away from creases, for example outside a flat surface, the
    distance is at most one voxel smaller. Voxels with an edge above `VOXEL` (1 cm) reduce all
    distances by the difference of the edges.

    Args:
        cloud: (N, 3) points in the world, at least one [m].
        viewpoints_W: (n, 3) positions of the cameras that observed the cloud [m]; empty: nothing is
            filled.
        deepest: maximum assumed depth of an obstacle that is observed from one side, unless its
            visible depth is larger [m].
        table: support plane; nothing is filled below it.
        seen_free: function from points (N, 3) [m] to (N,) booleans, True for a point that an image
            observes to be free. None: no image is available.
    """
    points = np.asarray(cloud, dtype=float)
    low, high = points.min(axis=0), points.max(axis=0)
    if table is not None:
        low[2] -= np.clip(table.height(points).min(), 0.0, MARGIN)
    voxel, first, count = _grid(low, high)
    p_WO, coarser = (first + 0.5) * voxel, voxel - VOXEL
    occupied = np.zeros(tuple(count), dtype=bool)
    # Occupy the node nearest to each point.
    occupied[tuple(np.floor((points - p_WO) / voxel + 0.5).astype(np.int64).T)] = True
    for p_WV in np.reshape(viewpoints_W, (-1, 3)):
        nodes = _find_occluded(points, p_WV, p_WO, voxel, deepest, table)
        nodes = nodes[~occupied[tuple(nodes.T)]]
        if seen_free is not None:
            nodes = nodes[~seen_free(p_WO + voxel * nodes)]
        occupied[tuple(nodes.T)] = True
    outside = _distances(occupied)
    # The grid has free nodes around the occupied ones.
    box = ndimage.find_objects(occupied.view(np.int8))[0]
    around = tuple(slice(side.start - 1, side.stop + 1) for side in box)
    inside = _distances(~occupied[around])
    outside[around] -= np.maximum(inside - 1.0, 0.0)
    low, high = (np.array([getattr(side, end) for side in box]) for end in ("start", "stop"))
    return DistanceField(
        p_WO,
        voxel,
        (voxel * (outside - OFFSET) - coarser).astype(np.float32),
        low * voxel - coarser,
        (high - 1) * voxel + coarser,
    )


def _distances(occupied: BoolArray) -> FloatArray:
    """Computes the Euclidean distance of each node of a grid (nx, ny, nz) to the nearest occupied
    node [voxel].
    """
    squared = np.where(occupied, 0.0, np.inf).astype(np.float32)
    for _ in range(3):
        lines = np.ascontiguousarray(np.moveaxis(squared, 0, 2))
        squared = _nearest_along(lines.reshape(-1, lines.shape[2])).reshape(lines.shape)
    return np.sqrt(squared, dtype=float)


@compiled
def _nearest_along(lines: FloatArray) -> FloatArray:
    """Computes min_j (f_j + (i - j)^2) for each index i of each row f of `lines` (L, n), one pass
    of a squared distance transform [voxel^2].

    The minimum is the lower envelope of parabolas: P. Felzenszwalb and D. Huttenlocher, "Distance
    transforms of sampled functions", Theory of Computing 8(19), 2012.
    """
    result, n = np.empty_like(lines), lines.shape[1]
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
            result[row, i] = f[vertex[place]] + (i - vertex[place]) ** 2
    return result


def _grid(low: FloatArray, high: FloatArray) -> tuple[float, FloatArray, IntArray]:
    """Computes the grid of the distance field of a cloud that has the bounding box from low to high
    (3,) [m].

    Returns:
        Edge of the voxels [m]; indices (3,) of the first voxel in a grid with a corner at the
        world's origin; and numbers (3,) of nodes along the axes.
    """
    voxel = VOXEL
    while True:
        # At least one free node on each side of the occupied nodes.
        past = max(MARGIN, 1.5 * voxel)
        first = np.floor((low - past) / voxel)
        count = np.floor((high + past) / voxel) - first + 1.0
        cells = math.prod(count.tolist())
        if cells <= MAX_CELLS:
            return voxel, first, count.astype(np.int64)
        voxel *= min(max(1.01, (cells / MAX_CELLS) ** (1.0 / 3.0)), 1e3)


def _find_occluded(
    points: FloatArray,
    p_WV: FloatArray,
    p_WO: FloatArray,
    voxel: float,
    deepest: float,
    table: TablePlane | None,
) -> IntArray:
    """Finds the nodes of a grid that an obstacle occludes from a viewpoint, and that it probably
    fills.

    The nodes are behind the visible surface. Their horizontal distance from this surface is at most
    `deepest`, and at most the larger horizontal extent of the points, along or across the view.
    Seen from above, the nodes are within the outline that `_outline` computes for the whole
    obstacle. They are above the table. Without a table, they are above the lowest point, or at most
    min(extent across the view, `deepest`) below the highest point.

    Args:
        points: (N, 3) points of the obstacle in the world [m].
        p_WV: (3,) viewpoint, the position of the camera in the world [m].
        p_WO: (3,) first node of the grid in the world [m].
        voxel: edge of a voxel [m].
        deepest: maximum assumed depth of the obstacle, unless its visible depth is larger [m].
        table: support plane; nothing is filled below it.

    Returns:
        (K, 3) indices of the occluded nodes; (0, 3) for a viewpoint less than 5 cm from the
        bounding box of the points.
    """
    nodes = np.zeros((0, 3), dtype=np.int64)
    low, high = points.min(axis=0), points.max(axis=0)
    view = 0.5 * (low + high) - p_WV
    distance, level = float(np.linalg.norm(view)), float(np.hypot(view[0], view[1]))
    if np.linalg.norm(np.clip(p_WV, low, high) - p_WV) < _MIN_VIEW_DISTANCE:
        return nodes
    away = view[:2] / level if level > 1e-6 else np.array([1.0, 0.0])
    along, across = points[:, :2] @ away, points[:, :2] @ [away[1], -away[0]]
    breadth, depth = float(np.ptp(across)), float(np.ptp(along))
    outline = _outline(along, across, max(depth, min(breadth, deepest)))
    run, thick = min(max(breadth, depth), deepest), min(breadth, deepest)
    # Filled down to the table, without a table by the thickness of the obstacle.
    normal, offset = (table.normal_W, table.offset) if table else (np.array([0.0, 0.0, 1.0]), 0.0)
    height = points @ normal - offset
    bottom = 0.0 if table is not None else min(float(height.min()), float(height.max()) - thick)
    # Points beside a near viewpoint have no place in its image; nothing is filled behind them.
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
    is_occluded = (behind >= 0.0) & (behind * horizontal <= run + 0.5 * voxel)
    return nodes[is_occluded]


def _outline(along: FloatArray, across: FloatArray, depth: float) -> FloatArray:
    """Computes the outline of an obstacle from above, including its occluded part, as half-planes.

    Most objects are symmetric about a vertical axis (J. Bohg et al., ICRA 2011, mirror the visible
    part at a plane). The outline is therefore the convex hull of the points and of their point
    reflections about the center of the obstacle: half of `depth` behind the nearest point along the
    view, and in the middle of the points across it.

    Args:
        along, across: (N,) horizontal coordinates of the points along the view and across it [m].
        depth: assumed depth of the obstacle along the view, from its nearest point [m].

    Returns:
        (E, 3) half-planes n x <= d, whose intersection is the outline: outer unit normal n (along,
        across), and offset d [m].
    """
    points = np.column_stack([along, across])
    middle = [along.min() + 0.5 * depth, 0.5 * (across.min() + across.max())]
    points = np.concatenate([points, 2.0 * np.array(middle) - points])
    # The visible part may be a line or a single point, which has no hull without a width.
    corners = _THIN * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
    sides = ConvexHull((points[:, None] + corners).reshape(-1, 2)).equations
    return np.asarray(sides * [1.0, 1.0, -1.0])


def _depth_image(place: FloatArray, distance: FloatArray) -> FloatArray:
    """Renders points to an image of distances from the viewpoint [m], the nearest in each pixel;
    inf: no point.

    Args:
        place: (N, 2) image coordinates of the points [pixel].
        distance: (N,) distances of the points from the viewpoint [m].
    """
    near = np.full(tuple(np.floor(place.max(axis=0)).astype(np.int64) + 3), np.inf)
    # Each point is rendered to the four nearest pixels; single-pixel gaps are closed.
    corner = np.floor(place - 0.5).astype(np.int64)
    for step in np.ndindex(2, 2):
        np.minimum.at(near, tuple((corner + step).T), distance)
    rendered = near < np.inf
    gap = ndimage.binary_closing(rendered, np.ones((3, 3))) & ~rendered
    return np.where(gap, ndimage.minimum_filter(near, 3), near)
