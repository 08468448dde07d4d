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
"""Numbers of successive halvings of a cloud that are tried, until free points are outside."""
_FEWEST = 8
"""Minimum number of points of a cloud that is halved."""
_MERGED = 1.3
"""Maximum ratio of the box volume of two merged tool parts to the sum of their box volumes."""


def cloud_parts(points: FloatArray, halvings: int) -> list[FloatArray]:
    """Divides a cloud into parts by recursive halving across its longest principal axis.

    Args:
        points: (N, 3) points [m].
        halvings: number of halvings.

    Returns:
        At most 2^halvings clouds (N_i, 3), which partition the points. Fewer than 8 points, or
        equal points, are not divided.
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
    """Merges parts of a tool that fill most of their common bounding box.

    Args:
        parts: (K_i, 3) vertices of each part [m].

    Returns:
        Vertices of the merged parts [m].
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
    """Computes the volume of the axis-aligned bounding box of points [m^3]."""
    return float(np.prod(np.ptp(points, axis=0)))


Method = Literal["enclosing", "least_squares"]
"""Name of a method of describing a cloud, see `describe`."""

_ROOM = 0.02
"""Minimum distance of an obstacle's ellipsoids from free points; otherwise it is divided [m]."""


Shape = tuple[FloatArray, FloatArray, FloatArray]
"""Center (3,) [m], rotation (3, 3) and semi-axes (3,) [m] of an ellipsoid."""


def describe(
    obstacles: ObstacleClouds,
    tool_W: FloatArray,
    *,
    method: Method = "enclosing",
    free_W: ArrayLike = (),
    tool_parts: Sequence[FloatArray] = (),
) -> EllipsoidSet:
    """Computes the ellipsoids of obstacle clouds dilated by the tool.

    Points that are not finite are ignored; an obstacle without finite points is omitted and noted.
    Velocities are those of the clouds.

    Args:
        obstacles: M clouds in W [m] with IDs, velocities, stamp, table and note.
        tool_W: (K, 3) vertices of the tool's convex hull relative to the tool point E, in world
            orientation [m].
        method: "enclosing": the ellipsoid of minimum volume (`ellipsoid.enclosing_ellipsoid`).
            "least_squares": the superquadric of eq. 11 of the paper, squared, with exponents of 1,
            fitted to the support points of the dilated cloud; parts of the obstacle stay outside.
        free_W: (F, 3) positions of E that are known to be free, such as start and goal [m]. An
            obstacle whose ellipsoid contains one, or is closer than 2 cm, is divided into parts if
            these have a larger distance. Method "enclosing" only.
        tool_parts: (K_i, 3) vertices of the tool's convex parts, for divided obstacles [m]; empty:
            the whole tool.
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
        # Cached: the cloud of an obstacle does not change until it is observed again.
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
    """Returns the bytes of an array (N, 3), as a hashable argument of cached functions."""
    return np.ascontiguousarray(points, dtype=float).tobytes()


@lru_cache(maxsize=256)
def _ellipsoid(points: bytes, tool: bytes, method: Method = "enclosing") -> Shape:
    """Computes the ellipsoid of a cloud dilated by a tool.

    Args:
        points: cloud, see `_key`.
        tool: vertices of the tool, see `_key`.
        method: "enclosing" or "least_squares", see `describe`.
    """
    cloud, corners = (np.frombuffer(key).reshape(-1, 3) for key in (points, tool))
    if method == "enclosing":
        one = enclosing_ellipsoid(cloud, tool=corners)
        return one.center, one.R, one.semi_axes
    return fit_superquadric(dilate(cloud, corners))


def _parts(
    points: FloatArray, tools: Sequence[bytes], halvings: int, free: FloatArray, min_room: float
) -> tuple[list[Shape], float]:
    """Computes the ellipsoids of parts of a cloud, each dilated by each part of the tool.

    Args:
        points: (N, 3) points of the cloud [m].
        tools: vertices of the tool's parts, see `_key`.
        halvings: number of halvings of the cloud.
        free: (F, 3) free points [m].
        min_room: distance from free points at or below which the computation stops early [m].

    Returns:
        Ellipsoids, and their minimum distance from free points [m].
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
    """Computes the minimum distance of points (F, 3) from ellipsoids [m]; inf without points."""
    distances = [signed_distance(free, *shape) for shape in ellipsoids]
    return float(np.min(distances, initial=np.inf))
