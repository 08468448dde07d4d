"""The obstacles of a scenario: primitive shapes that stand, move, appear or vanish."""

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK, Angles, Tagged, Vector3, length
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import Box, Cylinder, Sphere

OBSTACLE_PREFIX = "obstacle"
"""Obstacles are the model instances whose name starts with this."""


_FARTHEST = 10.0
ABSENT_HEIGHT = 50.0
"""Height above its place of an obstacle that is absent [m]: out of any camera's sight."""
_ROUNDING = 1e-9  # of a time [s]


def _check_trajectory(waypoints: list[list[float]]) -> list[list[float]]:
    before = -math.inf
    for row, (time, *offset) in enumerate(waypoints):
        if time <= before:
            raise ValueError(f"[{row}]: its time {time:g} s must be later than {before:g} s")
        if max(map(abs, offset)) > _FARTHEST:
            raise ValueError(f"[{row}]: {offset} is outside [-{_FARTHEST:g}, {_FARTHEST:g}]")
        before = time
    return waypoints


def _check_presence(present: list[float]) -> list[float]:
    if present != sorted(set(present)):
        raise ValueError(f"the obstacle must vanish later than it appears, not at {present}")
    return present


@dataclass(config=BLOCK)
class Obstacle:
    """An obstacle of primitive shapes; several shapes form one obstacle."""

    name: str = Field(min_length=1)
    """Name of the obstacle, without a namesake; the model instance is named "obstacle_<name>"."""
    shapes: list[Annotated[Box | Cylinder | Sphere, Tagged()]] = Field(min_length=1)
    """Shapes in the frame of the obstacle."""
    translation: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Position of the obstacle in the world [m]. Raising it moves the obstacle along the axis."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of the obstacle in the world [rad]."""
    color: Annotated[list[Annotated[float, Field(ge=0.0, le=1.0)]], length(4)] = Field(
        default=[0.76, 0.53, 0.31, 1.0]
    )
    """Red, green, blue and opacity [1]. Raising one makes the obstacle brighter or more opaque."""
    waypoints: Annotated[
        list[Annotated[list[float], length(4)]],
        AfterValidator(_check_trajectory),
    ] = Field(default_factory=list)
    """Motion of the obstacle: rows t, x, y, z [s, m], the offset from `translation` in the world at
    time t, interpolated linearly; at rest before the first and after the last row. Empty: the
    obstacle does not move."""
    present: Annotated[
        list[Annotated[float, Field(ge=0.0)]],
        Field(max_length=2),
        AfterValidator(_check_presence),
    ] = Field(default_factory=list)
    """Time at which the obstacle appears, or times at which it appears and vanishes [s]; empty: it
    is always present. Raising them makes the change later."""
    stiffness: float | None = Field(default=None, gt=0.0, le=1e12)
    """Stiffness of the surface in a point contact [N/m]; null: Drake's default, which is hard.
    Raising it makes contacts harder."""

    @property
    def driven(self) -> bool:
        """Whether it moves, appears or vanishes: then it hangs on slides."""
        return bool(self.waypoints or self.present)

    @property
    def last_change(self) -> float:
        """When it has ended its course, and comes and goes no more [s]; 0: it never moves."""
        return max([0.0, *(waypoint[0] for waypoint in self.waypoints), *self.present])

    def offset_at(self, time: float) -> FloatArray:
        """Returns the offset (3,) from `translation` at a time [s], in the world [m].

        It is straight and at constant speed between waypoints, at rest outside, and
        `ABSENT_HEIGHT` higher while the obstacle is absent.
        """
        times, *axes = np.array(self.waypoints or [[0.0] * 4], dtype=float).T
        offset = np.array([np.interp(time, times, axis) for axis in axes])
        begin, end = [*(self.present or [-math.inf]), math.inf][:2]
        if not begin <= time + _ROUNDING < end:
            offset[2] += ABSENT_HEIGHT
        return offset


def last_change(obstacles: Iterable[Obstacle]) -> float:
    """When all have ended their courses, and come and go no more [s]; 0: none ever moves."""
    return max((obstacle.last_change for obstacle in obstacles), default=0.0)


def obstacle_problems(obstacles: Sequence[Obstacle]) -> Iterator[str]:
    """Yields one line for each obstacle whose name another one has."""
    names = [obstacle.name for obstacle in obstacles]
    for row, name in enumerate(names):
        if name in names[:row]:
            yield f"obstacles[{row}].name: two obstacles are named '{name}'"
