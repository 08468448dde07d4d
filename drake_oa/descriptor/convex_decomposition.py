"""An obstacle described by several ellipsoids, where one would hold what is known to be free.

An ellipsoid holds more than what it is put round: of least volume round a box it has
pi sqrt(3) / 2 = 2.7 times its volume. Start or goal may lie inside it and be free. Halves of
the cloud and parts of the tool are smaller, and so is what their ellipsoids enclose in vain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import Ellipsoid, enclosing_ellipsoid

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


def ellipsoids_of_parts(
    points: FloatArray,
    tool_parts: Sequence[FloatArray],
    halvings: int,
    *,
    minimum_semi_axis: float = 1e-3,
) -> list[Ellipsoid]:
    """An ellipsoid round each part of a cloud dilated by each part of a tool.

    Together they hold every point dilated by every part.

    Args:
        points: (N, 3) points in W [m].
        tool_parts: (K_i, 3) vertices of the tool's parts from the TCP [m].
        halvings: how often the cloud is halved.
        minimum_semi_axis: least semi-axis [m].
    """
    return [
        enclosing_ellipsoid(part, tool=tool, minimum_semi_axis=minimum_semi_axis)
        for part in cloud_parts(points, halvings)
        for tool in tool_parts
    ]
