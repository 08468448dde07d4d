"""Computation of obstacle descriptors: ellipsoids of obstacle clouds dilated by the tool.

An obstacle has one ellipsoid, or several if one would contain a point that is known to be free.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import PART_ID_STRIDE, EllipsoidSet, FloatArray, ObstacleClouds
from drake_oa.geometry.ellipsoid import dilate, enclosing_ellipsoid, signed_distance
from drake_oa.geometry.superquadric import fit_superquadric

HALVINGS = (1, 2, 3)
"""Numbers of successive halvings by which an obstacle's cloud is divided into parts.

They are tried in this order until the ellipsoids of the parts are at least 2 cm (`_ROOM`) away from
the points that are known to be free, such as start and goal."""
_FEWEST = 8
"""Number of points below which a cloud, or a part of it, is not halved."""
_MERGED = 1.3
"""Maximum ratio of volumes at which two parts of the tool are merged [-].

It is the volume of one bounding box around both parts, divided by the sum of the volumes of their
separate bounding boxes."""


def cloud_parts(points: FloatArray, halvings: int) -> list[FloatArray]:
    """Divides a cloud into parts by recursive halving across its longest principal axis.

    Args:
        points: (N, 3) points [m].
        halvings: number of successive halvings; each divides all parts of the previous one.

    Returns:
        At most 2^halvings clouds (N_i, 3) [m], which together contain each point once. Fewer than 8
        points, or equal points, are not divided.
    """
    if halvings == 0 or len(points) < _FEWEST:
        return [points]
    offset = points - points.mean(axis=0)
    along = offset @ np.linalg.eigh(offset.T @ offset)[1][:, -1]
    low = along <= 0.5 * (along.min() + along.max())
    if low.all():
        return [points]
    return [part for half in (low, ~low) for part in cloud_parts(points[half], halvings - 1)]


def merged_parts(parts: Sequence[FloatArray]) -> tuple[FloatArray, ...]:
    """Merges parts of a tool if one bounding box around both is hardly larger than separate ones.

    Two parts are merged if the volume of their common axis-aligned bounding box is at most 1.3
    times (`_MERGED`) the sum of the volumes of their separate bounding boxes.

    Args:
        parts: vertices (K_i, 3) of each convex part of the tool, all in one frame [m].

    Returns:
        Vertices (K_j, 3) of each merged part in the same frame [m].
    """
    merged = [np.asarray(part, dtype=float) for part in parts]
    i = 0
    while i < len(merged):
        for j in range(i + 1, len(merged)):
            both = np.concatenate([merged[i], merged[j]])
            if _box_volume(both) <= _MERGED * (_box_volume(merged[i]) + _box_volume(merged[j])):
                merged[i] = both
                del merged[j]
                break
        else:
            i += 1
    return tuple(merged)


def _box_volume(points: FloatArray) -> float:
    """Computes the volume of the axis-aligned bounding box of points (N, 3) [m^3]."""
    return float(np.prod(np.ptp(points, axis=0)))


Method = Literal["enclosing", "least_squares"]
"""Name of a method by which `describe` computes the ellipsoid of a dilated cloud: "enclosing", the
ellipsoid of minimum volume that contains the cloud, or "least_squares", the superquadric fit by
equation (11) of Pairet et al., RA-L 2019."""

_ROOM = 0.02
"""Minimum distance between an obstacle's ellipsoid and the points that are known to be free, such
as start and goal [m]. With less, the obstacle is divided into parts."""


Shape = tuple[FloatArray, FloatArray, FloatArray]
"""Ellipsoid as a tuple of center (3,) in the world [m], rotation (3, 3) with the principal axes in
the world as columns, and semi-axes (3,) [m]."""


def describe(
    obstacles: ObstacleClouds,
    tool_W: FloatArray,
    *,
    method: Method = "enclosing",
    free_W: ArrayLike = (),
    tool_parts: Sequence[FloatArray] = (),
) -> EllipsoidSet:
    """Computes the ellipsoids of obstacle clouds dilated by the tool.

    Points that are not finite are ignored. An obstacle without finite points is omitted, and the
    note of the result names the obstacle. The velocities are those of the clouds.

    Args:
        obstacles: M clouds in the world frame [m] with IDs, velocities, stamp, support plane
            (`table`) and `note`, the reason why the observation is degraded.
        tool_W: (K, 3) vertices of the tool's convex hull relative to the tool point E, in world
            orientation [m].
        method: "enclosing": the ellipsoid of minimum volume (`ellipsoid.enclosing_ellipsoid`).
            "least_squares": the fit of a superquadric to the support points of the dilated cloud by
            equation (11) of Pairet et al., RA-L 2019. With its exponents of 1 it is an ellipsoid;
            parts of the obstacle stay outside.
        free_W: (F, 3) positions of the tool point E in the world frame that are known to be free,
            such as start and goal [m]. If an ellipsoid contains one of these positions, or is
            closer than 2 cm to one, the obstacle is divided into parts. The parts are used only if
            their ellipsoids have a larger distance. Method "enclosing" only.
        tool_parts: vertices (K_i, 3) of each convex part of the tool, relative to E in world
            orientation [m]. A divided obstacle has one ellipsoid for each pair of a part of the
            obstacle and a part of the tool. Empty: the whole tool is the only part.

    Returns:
        Set with one ellipsoid for each obstacle, or several for a divided obstacle.
    """
    free = np.asarray(free_W, dtype=float).reshape(-1, 3)
    tool, tools = _key(tool_W), [_key(part) for part in tool_parts or (tool_W,)]
    shapes: list[Shape] = []
    rows: list[int] = []
    ids: list[int] = []
    notes = [obstacles.note] if obstacles.note else []
    for row, (track, cloud) in enumerate(zip(obstacles.ids, obstacles.clouds_W, strict=True)):
        points = np.asarray(cloud, dtype=float)
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            notes.append(f"obstacle {track} omitted: none of its {len(cloud)} points is finite")
            continue
        # The result is cached, as the cloud of an obstacle does not change between observations.
        ellipsoids = [_ellipsoid(_key(points), tool, method)]
        room = math.inf if method == "least_squares" else _room(free, ellipsoids)
        for halvings in HALVINGS:
            if room >= _ROOM:
                break
            parts, parts_room = _parts(points, tools, halvings, free, room)
            if parts_room > room:
                ellipsoids, room = parts, parts_room
        shapes += ellipsoids
        rows += [row] * len(ellipsoids)
        ids += [track + PART_ID_STRIDE * part for part in range(len(ellipsoids))]
    p_WO, R_WO, semi_axes = zip(*shapes, strict=True) if shapes else ((), (), ())
    return EllipsoidSet(
        stamp=obstacles.stamp,
        p_WO=np.reshape(p_WO, (-1, 3)),
        R_WO=np.reshape(R_WO, (-1, 3, 3)),
        semi_axes=np.reshape(semi_axes, (-1, 3)),
        v_WO=obstacles.v_WO[rows],
        ids=np.array(ids, dtype=np.int64),
        table=obstacles.table,
        note="; ".join(notes),
    )


def _key(points: FloatArray) -> bytes:
    """Returns the bytes of an array of points (N, 3), as a hashable argument of `_ellipsoid`, whose
    results are cached.
    """
    return np.ascontiguousarray(points, dtype=float).tobytes()


@lru_cache(maxsize=256)
def _ellipsoid(points: bytes, tool: bytes, method: Method = "enclosing") -> Shape:
    """Computes the ellipsoid of a cloud dilated by a tool; results are cached.

    Args:
        points: bytes of the points (N, 3) of the cloud in the world [m], computed by `_key`.
        tool: bytes of the tool's vertices (K, 3) relative to the tool point E, in world orientation
            [m], computed by `_key`.
        method: "enclosing": the ellipsoid of minimum volume that contains the dilated cloud;
            "least_squares": the superquadric fit of Pairet et al., RA-L 2019.
    """
    cloud, corners = (np.frombuffer(key).reshape(-1, 3) for key in (points, tool))
    if method == "enclosing":
        one = enclosing_ellipsoid(cloud, tool=corners)
        return one.center, one.R, one.semi_axes
    return fit_superquadric(dilate(cloud, corners))


def _parts(
    points: FloatArray, tools: Sequence[bytes], halvings: int, free: FloatArray, min_room: float
) -> tuple[list[Shape], float]:
    """Computes the ellipsoids of each part of a cloud, dilated by each part of the tool.

    Args:
        points: (N, 3) points of the cloud in the world [m].
        tools: for each part of the tool, bytes of its vertices relative to E in world orientation,
            computed by `_key`.
        halvings: number of successive halvings of the cloud into parts.
        free: (F, 3) positions of the tool point E in the world that are known to be free, such as
            start and goal [m].
        min_room: distance from the free positions that every ellipsoid must exceed for the result
            to be used [m]. The computation stops at the first ellipsoid that does not.

    Returns:
        Ellipsoids, and their minimum distance from the free positions [m].
    """
    ellipsoids: list[Shape] = []
    room = math.inf
    for part in cloud_parts(points, halvings):
        for tool in tools:
            ellipsoids.append(_ellipsoid(_key(part), tool))
            room = min(room, _room(free, ellipsoids[-1:]))
            if room <= min_room:
                return ellipsoids, room
    return ellipsoids, room


def _room(free: FloatArray, ellipsoids: Sequence[Shape]) -> float:
    """Computes the minimum distance of points (F, 3) in the world from ellipsoids [m]; inf without
    points.

    The points are known to be free, such as start and goal. The distance is negative for a point
    inside an ellipsoid.
    """
    distances = [signed_distance(free, *shape) for shape in ellipsoids]
    return float(np.min(distances, initial=np.inf))
