"""From obstacle clouds to descriptors: an ellipsoid an obstacle, the tool included.

Where that one ellipsoid holds a point that is known to be free, the obstacle gets several.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import PART, EllipsoidSet, FloatArray, ObstacleClouds
from drake_oa.geometry.ellipsoid import (
    Ellipsoid,
    checked_points,
    dilate,
    enclosing_ellipsoid,
    signed_distance,
)
from drake_oa.geometry.superquadric import Superquadric, fit_superquadric

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


def check_descriptor_arguments(tool_W: ArrayLike, method: str) -> FloatArray:
    """The tool's vertices as an array of their own.

    Raises:
        ValueError: if the tool is empty, not (K, 3) or not finite, or the method unknown.
    """
    if method not in get_args(Method):
        raise ValueError(f"method '{method}'; it must be one of {', '.join(get_args(Method))}")
    return np.array(checked_points(tool_W, "tool_W"))


def describe(
    obstacles: ObstacleClouds,
    tool_W: ArrayLike,
    *,
    method: Method = "enclosing",
    exponent_prior: float | None = None,
    free_W: ArrayLike = (),
    tool_parts: Sequence[FloatArray] = (),
) -> EllipsoidSet:
    """The unified system-obstacle descriptors of all clouds.

    Points that are not finite are left out and noted; an obstacle without any
    other point is dropped and noted. Velocities are those of the clouds.

    Args:
        obstacles: M clouds in W [m], their names, velocities, stamp, table and note.
        tool_W: (K, 3) vertices of the tool's convex geometry from the TCP, in W
            orientation [m].
        method: "enclosing" (`ellipsoid.enclosing_ellipsoid`) or "least_squares".
        exponent_prior: of "least_squares", the paper's superquadric of eq. 11, squared: how
            strongly its exponents are drawn to 1, see `fit_superquadric`; None: they are 1, as in
            the paper. It is fitted to the support points of the dilated cloud and runs through
            it: parts of the obstacle stay outside.
        free_W: (F, 3) tool points that are known to be free, start and goal for two [m]. An
            obstacle whose ellipsoid holds one, or leaves it less than 2 cm, is described by
            those of its parts (`drake_oa.descriptor.descriptor`) if they leave more: rows
            whose names differ by multiples of `messages.PART`. Of the method "enclosing" alone.
        tool_parts: (K_i, 3) vertices of the tool's convex parts; none: the tool itself.

    Raises:
        ValueError: for a bad tool or method, clouds that are not (N, 3), or another number of
            ids or velocities than of clouds.
    """
    tool = check_descriptor_arguments(tool_W, method)
    if len(obstacles.ids) != len(obstacles.clouds_W):
        raise ValueError(
            f"obstacles_W holds {len(obstacles.clouds_W)} clouds but {len(obstacles.ids)} ids"
        )
    if obstacles.v_WO.shape != (len(obstacles.clouds_W), 3):
        raise ValueError(
            f"obstacles_W holds {len(obstacles.clouds_W)} clouds but velocities of shape "
            f"{obstacles.v_WO.shape}; one row of 3 a cloud is needed"
        )
    free = np.asarray(free_W, dtype=float).reshape(-1, 3)
    tools = tuple(_key(part) for part in (tool_parts or (tool,)))
    found: list[Ellipsoid] = []
    exponents: list[FloatArray] = []
    rows: list[int] = []
    part_names: list[int] = []
    notes = [obstacles.note] if obstacles.note else []
    names = obstacles.ids.tolist()
    for row, (name, cloud) in enumerate(zip(names, obstacles.clouds_W, strict=True)):
        points = np.asarray(cloud, dtype=float)
        if points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"cloud of obstacle {name} must be (N, 3), not {points.shape}")
        finite = np.isfinite(points).all(axis=1)
        if not finite.any():
            notes.append(f"obstacle {name} dropped: none of its {len(points)} points is finite")
            continue
        if not finite.all():
            lost = len(points) - int(finite.sum())
            notes.append(f"obstacle {name}: {lost} of {len(points)} points are not finite")
            points = points[finite]
        # A perception source hands on the same cloud while it sees nothing new.
        if method == "least_squares":
            fit = _fitted(_key(points), _key(tool), exponent_prior)
            found.append(Ellipsoid(fit.center, fit.R, fit.semi_axes, np.inf))
            exponents.append(fit.exponents)
            rows.append(row)
            part_names.append(name)
            continue
        described = [_whole(_key(points), _key(tool))]
        room = _room(free, described)
        for halvings in HALVINGS:
            if room >= _ROOM:
                break
            parts, left = _parts(_key(points), tools, halvings, _key(free), room)
            if left > room:
                described, room = parts, left
        found += described
        rows += [row] * len(described)
        part_names += [name + PART * part for part in range(len(described))]
    return EllipsoidSet(
        stamp=obstacles.stamp,
        p_WO=np.array([e.center for e in found]).reshape(-1, 3),
        R_WO=np.array([e.R for e in found]).reshape(-1, 3, 3),
        semi_axes=np.array([e.semi_axes for e in found]).reshape(-1, 3),
        exponents=np.array(exponents).reshape(-1, 2),
        v_WO=obstacles.v_WO[rows],
        ids=np.array(part_names, dtype=np.int64),
        table=obstacles.table,
        note="; ".join(notes),
    )


_Key = tuple[bytes, int]


def _key(points: FloatArray) -> _Key:
    """An array (N, 3) as what a cache can look up."""
    return np.ascontiguousarray(points, dtype=float).tobytes(), len(points)


def _array(key: _Key) -> FloatArray:
    return np.frombuffer(key[0]).reshape(key[1], 3)


@lru_cache(maxsize=64)
def _whole(points: _Key, tool: _Key) -> Ellipsoid:
    return enclosing_ellipsoid(_array(points), tool=_array(tool))


@lru_cache(maxsize=64)
def _fitted(points: _Key, tool: _Key, exponent_prior: float | None) -> Superquadric:
    return fit_superquadric(dilate(_array(points), _array(tool)), prior=exponent_prior)


@lru_cache(maxsize=64)
def _parts(
    points: _Key, tools: tuple[_Key, ...], halvings: int, free: _Key, least: float
) -> tuple[list[Ellipsoid], float]:
    """Returns ellipsoids round parts of a cloud, and their least distance to free points [m].

    Incomplete as soon as the distance is not above `least`.
    """
    ellipsoids: list[Ellipsoid] = []
    room = math.inf
    for part in cloud_parts(_array(points), halvings):
        for tool in tools:
            ellipsoids.append(enclosing_ellipsoid(part, tool=_array(tool)))
            room = min(room, _room(_array(free), ellipsoids[-1:]))
            if room <= least:
                return ellipsoids, room
    return ellipsoids, room


def _room(free: FloatArray, ellipsoids: Sequence[Ellipsoid]) -> float:
    """Least distance of the points (F, 3) to the ellipsoids [m]; inf without points."""
    distances = [signed_distance(free, e.center, e.R, e.semi_axes) for e in ellipsoids]
    return float(np.min(distances, initial=np.inf))
