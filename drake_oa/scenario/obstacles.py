"""Configuration block of an obstacle of primitive shapes, which may be at rest, move, appear or
vanish.
"""

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
"""Prefix of the names of those model instances in a plant that are obstacles."""


_MAX_OFFSET = 10.0
"""Maximum displacement of an obstacle's waypoint from the obstacle's position `translation`, along
each axis of the world [m]."""
ABSENT_HEIGHT = 50.0
"""Height by which an obstacle is raised before it appears and after it vanishes, so that no camera
sees it [m]."""
_ROUNDING = 1e-9
"""Tolerance for rounding errors of the simulated time at which an obstacle appears or vanishes
[s]."""


def _check_trajectory(waypoints: list[list[float]]) -> list[list[float]]:
    """Checks that the waypoints t, x, y, z of an obstacle are ordered by time, and that each
    displacement is at most `_MAX_OFFSET`.

    Args:
        waypoints: rows t, x, y, z [s, m].

    Returns:
        The waypoints, unchanged.

    Raises:
        ValueError: naming the first invalid row.
    """
    before = -math.inf
    for row, (time, *offset) in enumerate(waypoints):
        if time <= before:
            raise ValueError(f"[{row}]: its time {time:g} s must be later than {before:g} s")
        if max(map(abs, offset)) > _MAX_OFFSET:
            raise ValueError(f"[{row}]: {offset} is outside [-{_MAX_OFFSET:g}, {_MAX_OFFSET:g}] m")
        before = time
    return waypoints


def _check_presence(present: list[float]) -> list[float]:
    """Checks that an obstacle vanishes later than it appears.

    Args:
        present: time at which the obstacle appears and, optionally, time at which it vanishes [s].

    Returns:
        The times, unchanged.

    Raises:
        ValueError: if the times are not in this order.
    """
    if present != sorted(set(present)):
        raise ValueError(f"the obstacle must vanish later than it appears, not at {present}")
    return present


@dataclass(config=BLOCK)
class Obstacle:
    """Configuration block of one obstacle, which consists of one or several primitive shapes."""

    name: str = Field(min_length=1)
    """Unique name of the obstacle; the model instance is named "obstacle_<name>"."""
    shapes: list[Annotated[Box | Cylinder | Sphere, Tagged()]] = Field(min_length=1)
    """Primitive shapes of the obstacle, with poses in the obstacle's frame."""
    translation: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Position of the obstacle's frame in the world [m]."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of the obstacle's frame in the world [rad]."""
    color: Annotated[list[Annotated[float, Field(ge=0.0, le=1.0)]], length(4)] = Field(
        default=[0.76, 0.53, 0.31, 1.0]
    )
    """Red, green, blue and opacity of the obstacle in images and viewers [-]."""
    waypoints: Annotated[
        list[Annotated[list[float], length(4)]], AfterValidator(_check_trajectory)
    ] = Field(default_factory=list)
    """Motion of the obstacle as rows t, x, y, z [s, m]: at time t, the obstacle is displaced from
    `translation` by x, y, z in the world. The displacement is interpolated linearly between rows,
    and constant before the first and after the last row. Empty: the obstacle does not move."""
    present: Annotated[
        list[Annotated[float, Field(ge=0.0)]], Field(max_length=2), AfterValidator(_check_presence)
    ] = Field(default_factory=list)
    """List of one time, at which the obstacle appears, or of two times, at which it appears and
    vanishes [s]. Empty: the obstacle is always present."""
    stiffness: float | None = Field(default=None, gt=0.0, le=1e12)
    """Stiffness of the obstacle's surface in point contacts [N/m]; null: Drake's default, a hard
    surface. Raising it reduces the penetration in contacts."""

    @property
    def is_driven(self) -> bool:
        """Whether the obstacle moves, appears or vanishes, and therefore needs prismatic joints
        instead of a weld to the world.
        """
        return bool(self.waypoints or self.present)

    @property
    def last_change(self) -> float:
        """Time of the obstacle's last waypoint, appearance or disappearance [s]; 0 for an obstacle
        that never changes.
        """
        return max([0.0, *(waypoint[0] for waypoint in self.waypoints), *self.present])

    def offset_at(self, time: float) -> FloatArray:
        """Returns the displacement (3,) of the obstacle from `translation` at a simulated time, in
        the world [m].

        The displacement is interpolated linearly between waypoints, and constant before the first
        and after the last waypoint. While the obstacle is absent, `ABSENT_HEIGHT` is added to its z
        coordinate.

        Args:
            time: simulated time [s].
        """
        times, *axes = np.array(self.waypoints or [[0.0] * 4], dtype=float).T
        offset = np.array([np.interp(time, times, axis) for axis in axes])
        begin, end = [*(self.present or [-math.inf]), math.inf][:2]
        if not begin <= time + _ROUNDING < end:
            offset[2] += ABSENT_HEIGHT
        return offset


def last_change(obstacles: Iterable[Obstacle]) -> float:
    """Returns the latest time at which one of several obstacles moves, appears or vanishes [s]; 0
    if no obstacle changes.
    """
    return max((obstacle.last_change for obstacle in obstacles), default=0.0)


def obstacle_problems(obstacles: Sequence[Obstacle]) -> Iterator[str]:
    """Yields one error line for each obstacle that has the same name as an earlier obstacle."""
    names = [obstacle.name for obstacle in obstacles]
    for row, name in enumerate(names):
        if name in names[:row]:
            yield f"obstacles[{row}].name: two obstacles are named '{name}'"
