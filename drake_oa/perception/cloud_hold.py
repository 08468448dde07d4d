"""Clouds that stay the same, bit for bit, while nothing new is seen.

The remembered points of an obstacle follow the camera's noise from frame to frame. What
is handed on is a copy, renewed only when the obstacle reaches farther, or less far, than
the copy by more than noise does: receivers that compare see no change, and need not
plan again.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, IntArray, TablePlane
from drake_oa.perception.obstacle_memory import HeldCloud, Points, TrackingConfig
from drake_oa.perception.tracking_kernels import supports


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
    rows = np.flatnonzero(listed)
    names = ids[rows].tolist()
    known = [previous[name] for name in names if name in previous]
    same, placed = _unchanged(
        known,
        reach,
        shift_W,
        count,
        rows[np.array([name in previous for name in names], dtype=bool)],
        config,
    )
    held, place = {}, 0
    for row, name in zip(rows, names, strict=True):
        old = previous.get(name)
        place += old is not None
        if old is None or not same[place - 1]:
            held[name] = _cloud(points.p_OQ[owner == row], shift_W[row], reach[row])
        elif not placed[place - 1]:
            held[name] = _cloud(old.p_OQ, shift_W[row], old.reach)
        else:
            held[name] = old
    return held


def _cloud(p_OQ: FloatArray, shift_W: FloatArray, reach: FloatArray) -> HeldCloud:
    p_WQ = p_OQ + shift_W
    p_WQ.flags.writeable = False
    return HeldCloud(p_OQ, p_WQ, np.array(shift_W), np.array(reach))


def _unchanged(
    known: list[HeldCloud],
    reach: FloatArray,
    shift_W: FloatArray,
    count: IntArray,
    rows: IntArray,
    config: TrackingConfig,
) -> tuple[BoolArray, BoolArray]:
    """Which of K held clouds, of these rows, still do, and which are where they were."""
    if not known:
        return np.zeros(0, dtype=bool), np.zeros(0, dtype=bool)
    more = reach[rows] - np.array([old.reach for old in known])
    sizes = np.array([len(old.p_OQ) for old in known])
    same = ((more <= config.grown) & (more >= -config.shrunk)).all(axis=1)
    same &= np.abs(count[rows] - sizes) <= config.changed_share * sizes
    return same, (shift_W[rows] == np.array([old.shift_W for old in known])).all(axis=1)


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
