"""What is remembered of the obstacles from frame to frame, as frozen values.

The remembered points of an obstacle follow the camera's noise from frame to frame. What is
handed on is a copy, renewed only when the obstacle reaches farther, or less far, than the copy
by more than noise does (`held_clouds`): receivers that compare see no change, and need not plan
again.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import (
    BoolArray,
    FloatArray,
    Frozen,
    IntArray,
    ObstacleClouds,
    TablePlane,
)
from drake_oa.geometry.directions import DIRECTIONS


@dataclass(frozen=True, eq=False)
class MotionEstimate(Frozen):
    """Position and velocity of M obstacles.

    Attributes:
        p_W: (M, 3) positions [m].
        v_W: (M, 3) velocities [m/s].
        var_p: (M, 3) variances of the positions [m^2].
        cov_pv: (M, 3) covariances of position and velocity [m^2/s].
        var_v: (M, 3) variances of the velocities [m^2/s^2].
    """

    p_W: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    v_W: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    var_p: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    cov_pv: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    var_v: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.p_W)


CERTAIN = 4
"""The most evidence that a point can have."""
CONFIRMED = 2
"""From this much evidence on a point is handed on."""
PATIENCE = 3
"""Weight of a frame whose velocity is significant, of one that is only likely: 1."""
MOVED = 0.004
"""Distance from its place at rest beyond which an obstacle may move [m]."""
DOUBTED = 0.04
"""Share of missing points above which an obstacle may move."""
LONGEST_GAP = 1.0
"""Time between frames beyond which no velocity is believed [s]."""
INITIAL_SPEED = 0.4
"""Standard deviation of the velocity of an obstacle that is seen first [m/s]."""
_GROWN = 0.0025
"""Growth in any direction at which the cloud of an obstacle is handed on again [m]."""
_SHRUNK = 0.005
"""Shrinkage in any direction at which the cloud of an obstacle is handed on again [m]."""
_CHANGED_SHARE = 0.1
"""Relative change of the number of points at which a cloud is handed on again."""


def _zeros(*shape: int, kind: Any = float) -> Any:
    return field(default_factory=lambda: np.zeros(shape, dtype=kind))


@dataclass(frozen=True, eq=False)
class Tracks(Frozen):
    """M obstacles, one a row.

    Attributes:
        ids: (M,) their names.
        estimate: position and velocity, filtered. The position is that of a point fixed
            to the obstacle, which was its centroid when it was seen first.
        shift_W: (M, 3) from the frame O, in which its points are kept, to the world:
            p_WQ = p_OQ + shift_W [m].
        p_shift_W: (M, 3) the filter's position when it was shifted last [m].
        sides: (M, 3, 2) the lowest and highest side along the world's axes, from the
            position [m]; NaN while unknown.
        area: (M,) the largest area seen of it, across the line of sight [m^2].
        moving: (M,) whether it moves.
        doubt: (M,) share of what should be seen of it that was not where it was
            remembered: the most of late.
        significant: (M,) frames in a row whose velocity was significant, each counted
            `PATIENCE` times, and once where it was only likely.
        still: (M,) for how long it was not [s].
        unseen: (M,) for how long it was not measured [s].
        blind: (M, 3) for how long it was not along each axis of the world [s].
        odd: (M, 3) outliers in a row along each axis.
        age: (M,) for how long it is known [s].
        apart: (M,) frames in a row in which it was seen in parts.
        together: (M,) for how long it is one cluster with a larger one [s].
    """

    ids: IntArray = _zeros(0, kind=np.int64)
    estimate: MotionEstimate = field(default_factory=MotionEstimate)
    shift_W: FloatArray = _zeros(0, 3)
    p_shift_W: FloatArray = _zeros(0, 3)
    sides: FloatArray = _zeros(0, 3, 2)
    area: FloatArray = _zeros(0)
    moving: BoolArray = _zeros(0, kind=bool)
    doubt: FloatArray = _zeros(0)
    significant: IntArray = _zeros(0, kind=np.int64)
    still: FloatArray = _zeros(0)
    unseen: FloatArray = _zeros(0)
    blind: FloatArray = _zeros(0, 3)
    odd: IntArray = _zeros(0, 3, kind=np.int64)
    age: FloatArray = _zeros(0)
    apart: IntArray = _zeros(0, kind=np.int64)
    together: FloatArray = _zeros(0)

    def __len__(self) -> int:
        return len(self.ids)


def new_tracks(ids: IntArray, estimate: MotionEstimate) -> Tracks:
    """Obstacles (M,) that were just seen first: at rest, their sides not known."""
    none = Tracks()
    zeros = {
        name: np.zeros((len(ids), *part.shape[1:]), dtype=part.dtype)
        for name, part in vars(none).items()
        if isinstance(part, np.ndarray)
    }
    sides = np.full((len(ids), 3, 2), np.nan)
    parts: dict[str, Any] = {
        "ids": ids,
        "estimate": estimate,
        "p_shift_W": estimate.p_W,
        "sides": sides,
    }
    return Tracks(**(zeros | parts))


@dataclass(frozen=True, eq=False)
class Points(Frozen):
    """N remembered points of obstacles.

    Attributes:
        p_OQ: (N, 3) in the frame O of its obstacle [m].
        owner: (N,) row of its obstacle.
        evidence: (N,) from 1 to `CERTAIN`.
        weight: (N,) how many frames it is the mean of.
        confirmed: (N,) whether a second frame has shown it.
    """

    p_OQ: FloatArray = _zeros(0, 3)
    owner: IntArray = _zeros(0, kind=np.int64)
    evidence: IntArray = _zeros(0, kind=np.int64)
    weight: IntArray = _zeros(0, kind=np.int64)
    confirmed: BoolArray = _zeros(0, kind=bool)

    def __len__(self) -> int:
        return len(self.owner)


@dataclass(frozen=True, eq=False)
class HeldCloud(Frozen):
    """The cloud of an obstacle as it was handed on last.

    Attributes:
        p_OQ: (N, 3) in the obstacle's frame O [m].
        p_WQ: (N, 3) in the world [m].
        shift_W: (3,) from the one to the other [m].
        reach: (D,) how far it reaches in the directions of `drake_oa.perception.memory`, in O
        [m].
    """

    p_OQ: FloatArray = _zeros(0, 3)
    p_WQ: FloatArray = _zeros(0, 3)
    shift_W: FloatArray = _zeros(3)
    reach: FloatArray = _zeros(0)


@dataclass(frozen=True, eq=False)
class ObstacleMemory(Frozen):
    """Everything that perception remembers.

    Attributes:
        obstacles: what is handed on.
        next_id: the first name that was never given to an obstacle.
        tracks: the obstacles.
        points: their points.
        held: id -> its cloud as it was handed on last.
        shown: id -> (N, 3) what the last frame showed of it, in the world [m].
        taken: time of the last frame [s].
        told: (n,) times of the last image of each camera that told something [s].
    """

    obstacles: ObstacleClouds = field(default_factory=ObstacleClouds)
    next_id: int = 0
    tracks: Tracks = field(default_factory=Tracks)
    points: Points = field(default_factory=Points)
    held: dict[int, HeldCloud] = field(default_factory=dict)
    shown: dict[int, FloatArray] = field(default_factory=dict)
    taken: float = -np.inf
    told: FloatArray = _zeros(0)


_Value = TypeVar("_Value", bound=Frozen)


def changed(value: _Value, **parts: Any) -> _Value:
    """As `dataclasses.replace`, without a look at what stays: that is locked already."""
    kind: Any = type(value)
    if not parts.keys() <= value.__dict__.keys():
        raise TypeError(f"{kind.__name__} has no {sorted(parts.keys() - value.__dict__.keys())}")
    result: _Value = object.__new__(kind)
    result.__dict__.update(value.__dict__)
    for name, part in parts.items():
        if part.__class__ is np.ndarray and part.flags.writeable:
            part = part.view()
            part.flags.writeable = False
        result.__dict__[name] = part
    return result


def taken(value: _Value, index: IntArray | BoolArray) -> _Value:
    """Some rows of a value of which every field has rows."""
    kind: Any = type(value)
    parts: dict[str, Any] = {}
    for name, part in value.__dict__.items():
        parts[name] = taken(part, index) if isinstance(part, Frozen) else part[index]
    result: _Value = kind(**parts)
    return result


def appended(first: _Value, second: _Value) -> _Value:
    """The rows of one value, and then those of another."""
    kind: Any = type(first)
    parts: dict[str, Any] = {}
    for name, one in first.__dict__.items():
        other = getattr(second, name)
        nested = isinstance(one, Frozen)
        parts[name] = appended(one, other) if nested else np.concatenate([one, other])
    result: _Value = kind(**parts)
    return result


def held_clouds(
    ids: IntArray,
    shift_W: FloatArray,
    points: Points,
    listed: BoolArray,
    previous: dict[int, HeldCloud],
) -> dict[int, HeldCloud]:
    """The clouds to hand on, by name.

    Args:
        ids: (M,) names of the obstacles.
        shift_W: (M, 3) from the frame O of each obstacle's points to the world [m].
        points: the remembered points; only the confirmed are handed on.
        listed: (M,) which obstacles to hand on.
        previous: what was handed on last.
    """
    owner = np.where(points.confirmed, points.owner, -1)
    reach = supports(points.p_OQ, owner, len(ids), DIRECTIONS)
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
) -> tuple[BoolArray, BoolArray]:
    """Which of K held clouds, of these rows, still do, and which are where they were."""
    if not known:
        return np.zeros(0, dtype=bool), np.zeros(0, dtype=bool)
    more = reach[rows] - np.array([old.reach for old in known])
    sizes = np.array([len(old.p_OQ) for old in known])
    same = ((more <= _GROWN) & (more >= -_SHRUNK)).all(axis=1)
    same &= np.abs(count[rows] - sizes) <= _CHANGED_SHARE * sizes
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


@compiled
def supports(points: FloatArray, row: IntArray, count: int, directions: FloatArray) -> FloatArray:
    """(M, D) how far the points (N, 3) of each of M obstacles reach along directions (D, 3)."""
    out = np.full((count, len(directions)), -np.inf)
    # Their coordinates in rows: a loop along them uses vector instructions.
    a, b, c = directions[:, 0].copy(), directions[:, 1].copy(), directions[:, 2].copy()
    for i in range(len(points)):
        if row[i] >= 0:
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            own = out[row[i]]
            for d in range(len(a)):
                reach = a[d] * x + b[d] * y + c[d] * z
                own[d] = reach if reach > own[d] else own[d]
    return out
