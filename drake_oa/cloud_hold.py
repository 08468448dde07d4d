"""Clouds that stay the same, bit for bit, while nothing new is seen.

The remembered points of an obstacle follow the camera's noise from frame to frame. What
is handed on is a copy, renewed only when the obstacle reaches farther, or less far, than
the copy by more than noise does: receivers that compare see no change, and need not
plan again.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from drake_oa.obstacle_memory import HeldCloud, Points, TrackingConfig
from drake_oa.tracking_kernels import supports
from drake_oa.values import BoolArray, FloatArray, IntArray, TablePlane


def _directions() -> FloatArray:
    """(26, 3) unit vectors: the faces, edges and corners of a cube."""
    steps = np.array([d for d in product((-1.0, 0.0, 1.0), repeat=3) if any(d)])
    return np.asarray(steps / np.linalg.norm(steps, axis=1)[:, None])


_DIRECTIONS = _directions()


def held_clouds(
    ids: IntArray,
    shift_W: FloatArray,
    points: Points,
    listed: BoolArray,
    previous: dict[int, HeldCloud],
    config: TrackingConfig,
) -> dict[int, HeldCloud]:
    """The clouds to hand on, by name.

    Args:
        ids: (M,) names of the obstacles.
        shift_W: (M, 3) from the frame O of each obstacle's points to the world [m].
        points: the remembered points; only the confirmed are handed on.
        listed: (M,) which obstacles to hand on.
        previous: what was handed on last.
        config: how much may change unnoticed.
    """
    owner = np.where(points.confirmed, points.owner, -1)
    reach = supports(points.p_OQ, owner, len(ids), _DIRECTIONS)
    count = np.bincount(owner[points.confirmed], minlength=len(ids))
    held = {}
    for row in np.flatnonzero(listed):
        name = int(ids[row])
        old = previous.get(name)
        if old is None or _changed(old, reach[row], int(count[row]), config):
            p_OQ = points.p_OQ[owner == row]
            held[name] = _cloud(p_OQ, shift_W[row], reach[row])
        elif not np.array_equal(old.shift_W, shift_W[row]):
            held[name] = _cloud(old.p_OQ, shift_W[row], old.reach)
        else:
            held[name] = old
    return held


def _cloud(p_OQ: FloatArray, shift_W: FloatArray, reach: FloatArray) -> HeldCloud:
    p_WQ = p_OQ + shift_W
    p_WQ.flags.writeable = False
    return HeldCloud(p_OQ, p_WQ, np.array(shift_W), np.array(reach))


def _changed(old: HeldCloud, reach: FloatArray, count: int, config: TrackingConfig) -> bool:
    more = reach - old.reach
    if more.max() > config.grown or more.min() < -config.shrunk:
        return True
    return abs(count - len(old.p_OQ)) > config.changed_share * len(old.p_OQ)


def held_table(
    previous: TablePlane | None, seen: TablePlane | None, shift: float
) -> TablePlane | None:
    """The previous plane unless the new one is farther from it than ``shift`` [m].

    The planes are compared below the world's origin and at a reach of 1 m from there.
    """
    if previous is None or seen is None:
        return seen
    apart = abs(seen.offset - previous.offset)
    apart += float(np.linalg.norm(seen.normal_W - previous.normal_W))
    return seen if apart > shift else previous
