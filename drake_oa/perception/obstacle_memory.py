"""What is remembered of the obstacles from frame to frame, as frozen values."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, TypeVar

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray, ObstacleClouds
from drake_oa.perception.obstacle_filter import FilterNoise, MotionEstimate

CERTAIN = 4
"""The most evidence that a point can have."""
CONFIRMED = 2
"""From this much evidence on a point is handed on."""


@dataclass(frozen=True)
class TrackingConfig:
    """How obstacles are followed. Lengths in metres, times in seconds."""

    filter: FilterNoise = field(default_factory=FilterNoise)
    # Depth difference that tells "before" and "behind" from "at".
    depth_margin: float = 0.03
    # A point of a frame this near to a remembered one speaks for its obstacle,
    match_radius: float = 0.02
    # this near it supports the point, and this near it is the same point.
    support_radius: float = 0.012
    same_radius: float = 0.008
    # A cluster without a common point belongs to the obstacle whose predicted centroid is
    # nearest, and nearer than this.
    gate: float = 0.1
    # A remembered point is the mean of at most so many frames.
    mean_frames: int = 20
    # An obstacle at rest that is found farther off than this was moved.
    jump: float = 0.01
    # An obstacle moves only when this share of its points is not found at its old place.
    doubt: float = 0.04
    # With this share a slow motion is believed that is little beyond noise.
    strong_doubt: float = 0.15
    # A moving obstacle that is not seen goes on for this long, and is then taken to rest;
    coast_time: float = 0.5
    # after this long it is mentioned in the note.
    mentioned_after: float = 0.3
    # An obstacle that does not move has no velocity along an axis that it was not measured
    # along for this long.
    blind_time: float = 0.2
    # After a gap longer than this between frames no velocity is believed.
    longest_gap: float = 1.0
    # Parts of an obstacle that are apart for so many frames are two.
    split_frames: int = 3
    # Obstacles at rest that are one cluster for this long are one.
    merge_time: float = 0.5
    # The cloud of an obstacle is handed on anew when it reaches this much farther
    # or less far in any direction, or when this share of its points is new or gone.
    grown: float = 0.0025
    shrunk: float = 0.005
    changed_share: float = 0.1
    # The table is handed on anew when it moved by more than this within its reach, 1 m.
    table_shift: float = 0.003

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if item.name == "filter":
                continue
            if not np.isfinite(value) or value <= 0.0:
                raise ValueError(f"TrackingConfig.{item.name} must be positive, not {value!r}")


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
            `FilterNoise.patience` times, and once where it was only likely.
        still: (M,) for how long it was not [s].
        unseen: (M,) for how long it was not measured [s].
        blind: (M, 3) for how long it was not along each axis of the world [s].
        odd: (M,) outliers in a row.
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
    odd: IntArray = _zeros(0, kind=np.int64)
    apart: IntArray = _zeros(0, kind=np.int64)
    together: FloatArray = _zeros(0)

    def __len__(self) -> int:
        return len(self.ids)


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
        reach: (D,) how far it reaches in the directions of `drake_oa.perception.cloud_hold`, in O
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
    """

    obstacles: ObstacleClouds = field(default_factory=ObstacleClouds)
    next_id: int = 0
    tracks: Tracks = field(default_factory=Tracks)
    points: Points = field(default_factory=Points)
    held: dict[int, HeldCloud] = field(default_factory=dict)


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
