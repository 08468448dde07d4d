"""Obstacles of a scenario: primitive shapes at rest, moving, appearing or vanishing."""

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
"""Prefix of the names of model instances that are obstacles."""


_MAX_OFFSET = 10.0
"""Maximum offset of a waypoint along each axis [m]."""
ABSENT_HEIGHT = 50.0
"""Height by which an absent obstacle is raised, outside the view of all cameras [m]."""
_ROUNDING = 1e-9
"""Rounding error of a time [s]."""


def _check_trajectory(waypoints: list[list[float]]) -> list[list[float]]:
    """Checks that waypoints (t, x, y, z) are in order of time and near the obstacle."""
    before = -math.inf
    for row, (time, *offset) in enumerate(waypoints):
        if time <= before:
            raise ValueError(f"[{row}]: its time {time:g} s must be later than {before:g} s")
        if max(map(abs, offset)) > _MAX_OFFSET:
            raise ValueError(f"[{row}]: {offset} is outside [-{_MAX_OFFSET:g}, {_MAX_OFFSET:g}] m")
        before = time
    return waypoints


def _check_presence(present: list[float]) -> list[float]:
    """Checks that an obstacle vanishes later than it appears."""
    if present != sorted(set(present)):
        raise ValueError(f"the obstacle must vanish later than it appears, not at {present}")
    return present


@dataclass(config=BLOCK)
class Obstacle:
    """Obstacle of one or several primitive shapes."""

    name: str = Field(min_length=1)
    """Unique name of the obstacle; the model instance is named "obstacle_<name>"."""
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
    """Time at which the obstacle appears, or times at which it appears and vanishes [s]; empty:
    always present. Raising a time makes the change later."""
    stiffness: float | None = Field(default=None, gt=0.0, le=1e12)
    """Stiffness of the surface in a point contact [N/m]; null: Drake's default, a hard surface.
    Raising it makes contacts harder."""

    @property
    def is_driven(self) -> bool:
        """Whether the obstacle moves, appears or vanishes, and thus has prismatic joints."""
        return bool(self.waypoints or self.present)

    @property
    def last_change(self) -> float:
        """Time of the last waypoint, appearance or disappearance [s]; 0 for a static obstacle."""
        return max([0.0, *(waypoint[0] for waypoint in self.waypoints), *self.present])

    def offset_at(self, time: float) -> FloatArray:
        """Returns the offset (3,) from `translation` at a time [s], in the world [m].

        The offset is interpolated linearly between waypoints, constant before the first and after
        the last, and `ABSENT_HEIGHT` higher while the obstacle is absent.
        """
        times, *axes = np.array(self.waypoints or [[0.0] * 4], dtype=float).T
        offset = np.array([np.interp(time, times, axis) for axis in axes])
        begin, end = [*(self.present or [-math.inf]), math.inf][:2]
        if not begin <= time + _ROUNDING < end:
            offset[2] += ABSENT_HEIGHT
        return offset


def last_change(obstacles: Iterable[Obstacle]) -> float:
    """Returns the time of the last change of all obstacles [s]; 0 if all are static."""
    return max((obstacle.last_change for obstacle in obstacles), default=0.0)


def obstacle_problems(obstacles: Sequence[Obstacle]) -> Iterator[str]:
    """Yields one error line for each obstacle with the name of an earlier one."""
    names = [obstacle.name for obstacle in obstacles]
    for row, name in enumerate(names):
        if name in names[:row]:
            yield f"obstacles[{row}].name: two obstacles are named '{name}'"
