"""From obstacle clouds to descriptors: an ellipsoid an obstacle, the tool included.

Where that one ellipsoid holds a point that is known to be free, the obstacle gets several.
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
"""How often a cloud is halved, one after the other until there is room enough."""
_FEWEST = 8
"""A cloud of fewer points is not halved."""
_MERGED = 1.3
"""Parts of a tool become one where the box round both is at most this many times theirs."""


def cloud_parts(points: FloatArray, halvings: int) -> list[FloatArray]:
    """Halves a cloud across its longest principal axis, and the halves again.

    Args:
        points: (N, 3) points [m].
        halvings: how often.

    Returns:
        At most 2^halvings clouds (N_i, 3), each point in one. Fewer than 8 points, or points
        that are all equal, are not halved.
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
    """Vertices of a tool's parts, those that fill their common box made one.

    Args:
        parts: (K_i, 3) vertices of each part [m].

    Returns:
        As many parts or fewer, with all the vertices.
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
    return float(np.prod(np.ptp(points, axis=0)))


Method = Literal["enclosing", "least_squares"]

_ROOM = 0.02
"""Ellipsoids that leave less room than this to a point that is free are too large [m]."""


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
    """The unified system-obstacle descriptors of all clouds.

    Points that are not finite are left out; an obstacle without any other point is dropped and
    noted. Velocities are those of the clouds.

    Args:
        obstacles: M clouds in W [m], their names, velocities, stamp, table and note.
        tool_W: (K, 3) vertices of the tool's convex geometry from the TCP, in W
            orientation [m].
        method: "enclosing" (`ellipsoid.enclosing_ellipsoid`) or "least_squares": the paper's
            superquadric of eq. 11, squared, with exponents of 1. It is fitted to the support points
            of the dilated cloud and runs through it: parts of the obstacle stay outside.
        free_W: (F, 3) tool points that are known to be free, start and goal for two [m]. An
            obstacle whose ellipsoid holds one, or leaves it less than 2 cm, is described by
            those of its parts (`drake_oa.descriptor.descriptor`) if they leave more: rows
            whose names differ by multiples of `messages.PART_ID_STRIDE`. Of the method "enclosing" alone.
        tool_parts: (K_i, 3) vertices of the tool's convex parts; none: the tool itself.
    """
    free = np.asarray(free_W, dtype=float).reshape(-1, 3)
    tool, tools = _key(tool_W), [_key(part) for part in tool_parts or (tool_W,)]
    found: list[Shape] = []
    rows: list[int] = []
    ids: list[int] = []
    notes = [obstacles.note] if obstacles.note else []
    for row, (name, cloud) in enumerate(zip(obstacles.ids, obstacles.clouds_W, strict=True)):
        points = np.asarray(cloud, dtype=float)
        points = points[np.isfinite(points).all(axis=1)]
        if not len(points):
            notes.append(f"obstacle {name} dropped: none of its {len(cloud)} points is finite")
            continue
        # A perception source hands on the same cloud while it sees nothing new.
        described = [_ellipsoid(_key(points), tool, method)]
        room = math.inf if method == "least_squares" else _room(free, described)
        for halvings in HALVINGS:
            if room >= _ROOM:
                break
            parts, left = _parts(points, tools, halvings, free, room)
            if left > room:
                described, room = parts, left
        found += described
        rows += [row] * len(described)
        ids += [name + PART_ID_STRIDE * part for part in range(len(described))]
    p_WO, R_WO, semi_axes = zip(*found, strict=True) if found else ((), (), ())
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
    """Returns an array (N, 3) in a form that a cache can look up."""
    return np.ascontiguousarray(points, dtype=float).tobytes()


@lru_cache(maxsize=256)
def _ellipsoid(points: bytes, tool: bytes, method: Method = "enclosing") -> Shape:
    """Returns the ellipsoid of a cloud dilated by a tool."""
    cloud, corners = (np.frombuffer(key).reshape(-1, 3) for key in (points, tool))
    if method == "enclosing":
        one = enclosing_ellipsoid(cloud, tool=corners)
        return one.center, one.R, one.semi_axes
    return fit_superquadric(dilate(cloud, corners))


def _parts(
    points: FloatArray, tools: Sequence[bytes], halvings: int, free: FloatArray, least: float
) -> tuple[list[Shape], float]:
    """Returns ellipsoids around parts of a cloud, and their least distance to free points [m].

    Incomplete as soon as the distance is not above `least`.
    """
    ellipsoids: list[Shape] = []
    room = math.inf
    for part in cloud_parts(points, halvings):
        for tool in tools:
            ellipsoids.append(_ellipsoid(_key(part), tool))
            room = min(room, _room(free, ellipsoids[-1:]))
            if room <= least:
                return ellipsoids, room
    return ellipsoids, room


def _room(free: FloatArray, ellipsoids: Sequence[Shape]) -> float:
    """Least distance of the points (F, 3) to the ellipsoids [m]; inf without points."""
    distances = [signed_distance(free, *shape) for shape in ellipsoids]
    return float(np.min(distances, initial=np.inf))
