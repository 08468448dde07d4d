"""A cloud of points as a signed distance field: a grid of voxels round it, in its own frame.

What a point costs to ask is then independent of how many points the cloud has. The frame O has
the world's axes; its origin is the first node of the grid, and it moves with the obstacle. Nodes
lie in the middle of the world's voxels, so that a cloud of one point a voxel fills the same ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError

from drake_oa.common.compiled import compiled, leaf
from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray, TablePlane

VOXEL = 0.01
"""Edge of a field's voxels [m]."""
MARGIN = 0.25
"""How far a field goes past the cloud's box [m]: beyond, distances are lower bounds."""
MAX_CELLS = 1 << 20
"""Nodes that one field may have (4 MB); of a larger cloud the voxels are coarser."""
DEEPEST = 0.08
"""What is seen from one side is taken to be at most so deep [m]."""

OFFSET = 0.13
"""Taken off every distance [voxel], so that it is at most one voxel too large.

A point is at most sqrt(3) / 2 from its node, and interpolation adds at most 0.26 to the distance
from a node (found by search: near the middle of a voxel that has the node as a corner).
"""
_THIN = 1e-4
"""Half the thickness of what is seen of a plane, seen from above [m]."""
_TOO_NEAR = 0.05
"""A viewpoint so near above a thing says nothing of its depth [m]."""
_FAR = 1 << 28
"""Squared distance of what is nowhere [voxel^2]."""
_LONGEST = 4096  # nodes along an axis: so that squares of distances are integers of 32 bits
_MOST = 1 << 14  # longer than any row
_SPARSE = 2.0
"""Pixels that show a point, by the number of points: above, the pixels are too small."""
_WIDEST = 1024  # pixels of the image
_COARSEST = 4.0
"""How much larger they may become."""

ByteArray = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class DistanceField(Frozen):
    """Signed distances to a cloud at the nodes of a grid.

    Between nodes they are interpolated. Outside the cloud the distance is at most one voxel, as it
    was asked, too large; how much too small it may be, see `field_of`.

    Attributes:
        p_WO: (3,) the first node in the world, when the cloud was seen [m].
        voxel: edge of a voxel [m].
        values: (nx, ny, nz) float32 distances at the nodes p_WO + voxel (i, j, k) [m].
        low, high: (3,) box, in O, of what is occupied [m].
        note: empty, or that the voxels are coarser than was asked.
    """

    p_WO: FloatArray
    voxel: float
    values: NDArray[np.float32]
    low: FloatArray
    high: FloatArray
    note: str


def field_of(
    cloud: FloatArray,
    *,
    viewpoints_W: ArrayLike = (),
    deepest: float = DEEPEST,
    table: TablePlane | None = None,
    seen_free: Callable[[FloatArray], BoolArray] | None = None,
) -> DistanceField:
    """The distance field of a cloud, exact at its nodes for the voxels that the points fill.

    With a viewpoint, what the thing hides of itself is filled too. A voxel counts as occupied
    that lies behind the seen surface, on a ray of the viewpoint, horizontally by at most
    `deepest` (or what the thing is broad or seen to be deep); within its outline from above, which
    is that of what is seen and of its image beyond the middle of what is as deep as seen, or as
    broad, at most `deepest`; and above the table, without one above the lowest point, and as far
    below the highest as it is thick. Seen from several places, what counts from any of them does,
    but for what is seen to be free.

    The distance is at most one voxel larger than that to the points, and smaller by at most two
    (the point to its node, sqrt(3)/2; a crease of the distance between nodes, as much again;
    the offset, 0.13); away from creases, as outside a surface, by at most one. Where the voxels
    are coarser than asked, all distances are smaller by as much as they are coarser.

    Args:
        cloud: (N, 3) points in the world, at least one [m].
        viewpoints_W: (n, 3) from where the cloud was seen, of each camera [m]; none: nothing is
            filled.
        deepest: what is seen from one side is taken to be at most so deep [m].
        table: nothing is filled below it.
        seen_free: tells of points (N, 3) [m] which of them an image sees through: they are not
            filled. None: no image is known but for the cloud.
    """
    points = np.asarray(cloud, dtype=float)
    low, high = points.min(axis=0), points.max(axis=0)
    voxel, first, count = _grid(low, high, VOXEL)
    places = np.reshape(viewpoints_W, (-1, 3))
    looked = [_shade(points, p_WV, voxel, deepest, table) for p_WV in places]
    shades = [shade for shade in looked if shade is not None]
    for shade in shades:
        low, high = np.minimum(low, shade.low), np.maximum(high, shade.high)
    if shades:
        voxel, first, count = _grid(low, high, voxel)
    note, coarser = "", voxel - VOXEL
    if coarser > 0.0:
        note = (
            f"voxels of {voxel:.3g} m in place of {VOXEL:.3g} m: the cloud is large, and taken to "
            "be as much thicker"
        )
    p_WO = (first + 0.5) * voxel
    occupied = np.zeros(tuple(count), dtype=np.uint8)
    # The node nearest to each point.
    occupied[tuple(np.floor((points - p_WO) / voxel + 0.5).astype(np.int64).T)] = 1
    hidden = occupied if seen_free is None else np.zeros_like(occupied)
    for shade in shades:
        _fill_hidden(p_WO, voxel, shade, hidden)
    if seen_free is not None:
        nodes = np.argwhere(hidden)
        hidden[tuple(nodes[seen_free(p_WO + voxel * nodes)].T)] = 0
        occupied |= hidden
    values, box = _signed_distances(occupied, voxel)
    if coarser > 0.0:
        values -= np.float32(coarser)
    low, high = box[0] * voxel - coarser, (box[1] - 1) * voxel + coarser
    return DistanceField(p_WO, voxel, values, low, high, note)


def _grid(low: FloatArray, high: FloatArray, voxel: float) -> tuple[float, FloatArray, IntArray]:
    """Edge of a voxel [m], numbers (3,) of the first in the world, and how many (3,)."""
    while True:
        # All round what is occupied at least one node is free.
        past = max(MARGIN, 1.5 * voxel)
        first = np.floor((low - past) / voxel)
        count = np.floor((high + past) / voxel) - first + 1.0
        cells = math.prod(count.tolist())
        if cells <= MAX_CELLS and count.max() <= _LONGEST:
            return voxel, first, count.astype(np.int64)
        voxel *= min(max(1.01, (cells / MAX_CELLS) ** (1.0 / 3.0)), 1e3)


class _Shade(NamedTuple):
    """The seen surface as an image from the viewpoint, and how far behind it is filled.

    Attributes:
        p_WV: (3,) the viewpoint [m].
        R_WV: (3, 3) columns: across, up, and along the view.
        pixel: edge of a pixel at distance one.
        corner: (2,) of the image, at distance one.
        near, far: (rows, columns) distances of the nearest and farthest point; inf, -inf: none.
        outline: (E, 3) horizontal normals and offsets of the lines within which is filled [m];
            none where it is seen from above.
        run: nor so far behind the surface, horizontally [m].
        floor: (4,) upward normal and offset of the plane below which nothing is filled [m].
        low, high: (3,) box of what may be filled [m].
    """

    p_WV: FloatArray
    R_WV: FloatArray
    pixel: float
    corner: FloatArray
    near: FloatArray
    far: FloatArray
    outline: FloatArray
    run: float
    floor: FloatArray
    low: FloatArray
    high: FloatArray


def _shade(
    points: FloatArray, p_WV: FloatArray, edge: float, deepest: float, table: TablePlane | None
) -> _Shade | None:
    """The surface as it was seen; None: the viewpoint lies in it."""
    low, high = points.min(axis=0), points.max(axis=0)
    view = 0.5 * (low + high) - p_WV
    distance, level = float(np.linalg.norm(view)), float(np.hypot(view[0], view[1]))
    nearest = float(np.linalg.norm(np.clip(p_WV, low, high) - p_WV))
    nearest_level = float(np.linalg.norm((np.clip(p_WV, low, high) - p_WV)[:2]))
    if nearest < _TOO_NEAR:
        return None
    z_V = view / distance
    if level < _TOO_NEAR:
        away, depth, outline = np.zeros(2), 0.0, np.zeros((0, 3))
        breadth = float((high - low)[:2].min())
        x_V = np.array([1.0, 0.0, 0.0])
    else:
        away = view[:2] / level
        x_V = np.array([away[1], -away[0], 0.0])
        along, across = points[:, :2] @ away, points[:, :2] @ x_V[:2]
        breadth, depth = float(np.ptp(across)), float(np.ptp(along))
        outline = _outline(along, across, max(depth, min(breadth, deepest)))
        outline[:, :2] = outline[:, :1] * away + outline[:, 1:2] * x_V[:2]
    y_V = np.cross(z_V, x_V)
    y_V /= np.linalg.norm(y_V)
    run, thick = min(max(breadth, depth), deepest), min(breadth, deepest)
    R_WV = np.column_stack([np.cross(y_V, z_V), y_V, z_V])
    # Down to the table, or as thick as it is deep; so far down as the run along a ray leads.
    normal, offset = (table.normal_W, table.offset) if table else (np.array([0.0, 0.0, 1.0]), 0.0)
    height = points @ normal - offset
    bottom = 0.0 if table is not None else min(float(height.min()), float(height.max()) - thick)
    floor = np.append(normal, offset + bottom)
    rest = max(0.0, thick - depth) * np.append(away, 0.0)
    low, high = np.minimum(low, low + rest), np.maximum(high, high + rest)
    steep = max(0.0, p_WV[2] - low[2]) / max(nearest_level, _TOO_NEAR)
    below = max(0.0, float(height.min()) - bottom) / max(0.5, float(normal[2]))
    low[2] -= below if level < _TOO_NEAR else min(below, (run + edge) * steep)
    p_VQ = (points - p_WV) @ R_WV
    # Points all round a near viewpoint make no image; those beside it are left as they are.
    p_VQ = p_VQ[p_VQ[:, 2] > 0.2 * np.linalg.norm(p_VQ, axis=1)]
    if not len(p_VQ):
        return None
    q, distances = p_VQ[:, :2] / p_VQ[:, 2:], np.linalg.norm(p_VQ, axis=1)
    pixel = max(edge / distance, float(np.ptp(q, axis=0).max()) / _WIDEST)
    while True:
        # Where most points have pixels of their own the points are sparse.
        corner = q.min(axis=0) - 0.5 * pixel
        shape = ((q.max(axis=0) - corner) / pixel + 0.5).astype(np.int64) + 2
        near, far = np.full(shape, np.inf), np.full(shape, -np.inf)
        # Each point is drawn on the four pixels round it.
        u, v = ((q - corner) / pixel - 0.5).astype(np.int64).T
        for a, b in np.ndindex(2, 2):
            at = (u + a) * shape[1] + v + b
            np.minimum.at(near.reshape(-1), at, distances)
            np.maximum.at(far.reshape(-1), at, distances)
        filled = np.count_nonzero(near < np.inf)
        if filled <= _SPARSE * len(q) or pixel * distance > _COARSEST * edge:
            break
        pixel *= 1.25
    _close_gaps(near, far)
    return _Shade(p_WV, R_WV, pixel, corner, near, far, outline, run, floor, low, high)


def _outline(along: FloatArray, across: FloatArray, depth: float) -> FloatArray:
    """(E, 3) sides of what is seen from above of a thing, with what is hidden of it.

    Most things are symmetric about a vertical axis (J. Bohg et al., ICRA 2011, mirror what they see
    at a plane): the outline is the convex hull of the points and of their images beyond the middle.

    Args:
        along, across: (N,) places of the points along the view and across it [m].
        depth: of the thing along the view, from its first point [m].
    """
    points = np.column_stack([along, across])
    middle = [along.min() + 0.5 * depth, 0.5 * (across.min() + across.max())]
    points = np.concatenate([points, 2.0 * np.array(middle) - points])
    try:
        sides = ConvexHull(points).equations
    except QhullError:
        # A plane seen from above.
        corners = [[-_THIN, -_THIN], [-_THIN, _THIN], [_THIN, -_THIN], [_THIN, _THIN]]
        sides = ConvexHull((points[:, None] + corners).reshape(-1, 2)).equations
    sides[:, 2] *= -1.0
    return np.ascontiguousarray(np.unique(np.round(sides, 9), axis=0))


def _close_gaps(near: FloatArray, far: FloatArray) -> None:
    """Fills pixels that show nothing among five or more neighbours that do."""
    seen = near < np.inf
    count = ndimage.convolve(seen.astype(np.int64), np.ones((3, 3), dtype=np.int64))
    gap = ~seen & (count >= 5)
    gap[[0, -1]] = gap[:, [0, -1]] = False
    closest, farthest = ndimage.minimum_filter(near, 3), ndimage.maximum_filter(far, 3)
    near[gap], far[gap] = closest[gap], farthest[gap]


@compiled
def _fill_hidden(p_WO: FloatArray, voxel: float, shade: _Shade, occupied: ByteArray) -> None:
    """Occupies the nodes that lie behind the seen surface."""
    rows, columns = shade.near.shape
    R, V, floor = shade.R_WV, shade.p_WV, shade.floor
    first, last = np.empty(3, dtype=np.int64), np.empty(3, dtype=np.int64)
    for m in range(3):
        first[m] = math.floor((shade.low[m] - p_WO[m]) / voxel + 0.5)
        last[m] = math.floor((shade.high[m] - p_WO[m]) / voxel + 0.5)
    slack = 0.5 * voxel
    for i in range(first[0], last[0] + 1):
        x = p_WO[0] + i * voxel
        for j in range(first[1], last[1] + 1):
            y = p_WO[1] + j * voxel
            outside = False
            for e in range(len(shade.outline)):
                side = shade.outline[e]
                outside = outside or x * side[0] + y * side[1] > side[2] + slack
            if outside:
                continue
            a, b = x - V[0], y - V[1]
            level2 = a * a + b * b
            for k in range(first[2], last[2] + 1):
                z = p_WO[2] + k * voxel
                if x * floor[0] + y * floor[1] + z * floor[2] < floor[3]:
                    continue
                c = z - V[2]
                depth = a * R[0, 2] + b * R[1, 2] + c * R[2, 2]
                if depth <= 0.0:
                    continue
                scale = 1.0 / (depth * shade.pixel)
                u = (a * R[0, 0] + b * R[1, 0] + c * R[2, 0]) * scale
                v = (a * R[0, 1] + b * R[1, 1] + c * R[2, 1]) * scale
                u -= shade.corner[0] / shade.pixel
                v -= shade.corner[1] / shade.pixel
                if not (u >= 0.0 and v >= 0.0 and u < rows and v < columns):
                    continue
                near, far = shade.near[int(u), int(v)], shade.far[int(u), int(v)]
                r2 = level2 + c * c
                if r2 < near * near:
                    continue
                # Behind the nearest by no more than the run, or so behind the farthest.
                r = math.sqrt(r2)
                behind = r - far if r > far else r - near
                behind = min(behind, r - near)
                if behind * math.sqrt(level2) <= (shade.run + slack) * r:
                    occupied[i, j, k] = 1


@compiled
def _distances(
    seeds: ByteArray, box: IntArray, scale: float, shift: float, values: NDArray[np.float32]
) -> None:
    """Sets values to scale times the distance to the nearest seed, plus shift.

    The exact Euclidean transform, one axis after the other (Saito and Toriwaki 1994): of
    squared distances in integers, whole rows at a time. Seeds lie in the box (2, 3).
    """
    n0, n1, n2 = seeds.shape
    i0, j0 = box[0, 0], box[0, 1]
    m0, m1 = box[1, 0] - i0, box[1, 1] - j0
    line = np.empty((m1, n2), dtype=np.int32)
    plane = np.empty((n1, m0, n2), dtype=np.int32)
    # Least of each row, and of those of the lines: far where a line holds no seed.
    reach, least = np.empty(m1, dtype=np.int32), np.empty((n1, m0), dtype=np.int32)
    far, gain = np.int32(_FAR), np.empty((2, max(m0, m1)), dtype=np.int32)
    for i in range(m0):
        for j in range(m1):
            row, out = seeds[i0 + i, j0 + j], line[j]
            away = _MOST
            reach[j] = far
            for k in range(n2):
                if row[k] != 0:
                    away, reach[j] = 0, 0
                out[k] = away
                away = min(away + 1, _MOST)
            away = _MOST
            for k in range(n2 - 1, -1, -1):
                away = min(int(out[k]), away + 1)
                out[k] = away
            for k in range(n2):
                out[k] = out[k] * out[k]
        _gains(line, gain)
        for j in range(n1):
            out = plane[j, i]
            _nearest_rows(line, reach, gain, j - j0, out)
            smallest = far
            for k in range(n2):
                smallest = min(smallest, out[k])
            least[j, i] = smallest
    best = np.empty(n2, dtype=np.int32)
    factor, term = np.float32(scale), np.float32(shift)
    for j in range(n1):
        rows, lowest = plane[j], least[j]
        _gains(rows, gain)
        for i in range(n0):
            _nearest_rows(rows, lowest, gain, i - i0, best)
            out = values[i, j]
            for k in range(n2):
                out[k] = factor * np.float32(math.sqrt(np.float32(best[k]))) + term


@leaf
def _gains(rows: NDArray[np.int32], gain: NDArray[np.int32]) -> None:
    """Sets gain (2, M) to how much less rows (M, N) are anywhere than the first and the last."""
    for end in range(2):
        edge = 0 if end == 0 else len(rows) - 1
        for other in range(len(rows)):
            most = np.int32(0)
            for k in range(rows.shape[1]):
                value = np.int32(rows[edge, k] - rows[other, k])
                most = value if value > most else most
            gain[end, other] = most


@leaf
def _lowered(row: NDArray[np.int32], gap2: int, best: NDArray[np.int32]) -> int:
    """Lowers best (N,) to a row (N,) at a squared gap; its largest then."""
    more, most = np.int32(gap2), np.int32(0)
    for k in range(len(best)):
        value = np.int32(row[k] + more)
        value = value if value < best[k] else best[k]
        best[k] = value
        most = value if value > most else most
    return int(most)


@leaf
def _nearest_rows(
    rows: NDArray[np.int32],
    least: NDArray[np.int32],
    gain: NDArray[np.int32],
    place: int,
    best: NDArray[np.int32],
) -> None:
    """Sets best (N,) to the least of rows (M, N) at their squared gaps from a place.

    From the nearest row outward, as long as their least (M,) can be less than what is found; from
    a place beyond the rows, those whose gain over the nearest makes up for their greater gap.
    """
    count, largest = len(rows), np.int64(_FAR)
    for k in range(len(best)):
        best[k] = _FAR
    if 0 <= place < count:
        for step in range(count):
            gap2 = step * step
            if gap2 >= largest:
                break
            if step <= place and gap2 + least[place - step] < largest:
                largest = _lowered(rows[place - step], gap2, best)
            if 0 < step < count - place and gap2 + least[place + step] < largest:
                largest = _lowered(rows[place + step], gap2, best)
        return
    end, near, inward = (0, 0, 1) if place < 0 else (1, count - 1, -1)
    first = (place - near) * (place - near)
    for step in range(count):
        other = near + inward * step
        gap2 = (place - other) * (place - other)
        if gap2 >= largest:
            break
        if step > 0 and gain[end, other] <= gap2 - first:
            continue
        if gap2 + least[other] < largest:
            largest = _lowered(rows[other], gap2, best)


def _signed_distances(occupied: ByteArray, voxel: float) -> tuple[NDArray[np.float32], IntArray]:
    """Computes the distances [m] at the nodes, and the box (2, 3) of occupied nodes.

    Zero, less the offset, is where a node is occupied and has a neighbour that is not. The box
    is the first and one past the last index.
    """
    used = [np.flatnonzero(occupied.any(axis=axes)) for axes in ((1, 2), (0, 2), (0, 1))]
    box = np.array([[rows[0] for rows in used], [rows[-1] + 1 for rows in used]])
    values = np.empty(occupied.shape, dtype=np.float32)
    _distances(occupied, box, voxel, -OFFSET * voxel, values)
    # Within, to the nearest free node; all round there are such.
    within = tuple(slice(first - 1, last + 1) for first, last in box.T)
    free = 1 - occupied[within]
    inner = np.empty(free.shape, dtype=np.float32)
    whole = np.array([(0, 0, 0), free.shape])
    _distances(free, whole, -voxel, (1.0 - OFFSET) * voxel, inner)
    np.copyto(values[within], inner, where=free == 0)
    return values, box
