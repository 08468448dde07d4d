"""The obstacles of a scenario: primitive shapes that stand, move, appear or vanish."""

import dataclasses as dc
import math
from collections.abc import Iterable, Sequence

import numpy as np

from drake_oa.common.config import ScenarioError, roll_pitch_yaw, vector
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import Box, Cylinder, Sphere, check_shapes

OBSTACLE_PREFIX = "obstacle"
"""Obstacles are the model instances whose name starts with this."""


@dc.dataclass
class Obstacle:
    """One thing that stands in the world; several shapes make a pile, which is one obstacle."""

    # The model instance is named "obstacle_<name>".
    name: str = ""
    shapes: list[Box | Cylinder | Sphere] = dc.field(default_factory=list)
    # Pose of the obstacle in the world: translation [m], roll, pitch, yaw [rad].
    translation: list[float] = vector([0.0, 0.0, 0.0], "m")
    rpy: list[float] = roll_pitch_yaw([0.0, 0.0, 0.0])
    # Red, green, blue and opacity, 0 to 1.
    color: list[float] = vector([0.76, 0.53, 0.31, 1.0], "1")
    # Where it moves: rows [t, x, y, z], at time t [s] it is that far from `translation`, in
    # the world [m]. Straight between, at rest before and after; without any it stands still.
    waypoints: list[list[float]] = dc.field(default_factory=list)
    # When it is there: [from], or [from, until] [s]; empty: always. It appears and vanishes
    # within a step of the plant.
    present: list[float] = dc.field(default_factory=list, metadata={"unit": "s"})
    # Stiffness of its surface in a point contact [N/m]; null: Drake's default, which is hard.
    stiffness: float | None = dc.field(
        default=None, metadata={"unit": "N/m", "low": 0.0, "high": 1e12, "open_low": True}
    )

    @property
    def driven(self) -> bool:
        """Whether it moves, appears or vanishes: then it hangs on slides."""
        return bool(self.waypoints or self.present)

    @property
    def last_change(self) -> float:
        """When it has ended its course, and comes and goes no more [s]; 0: it never moves."""
        return max([0.0, *(waypoint[0] for waypoint in self.waypoints), *self.present])

    def offset_at(self, time: float) -> FloatArray:
        """(3,) how far from `translation` it is at a time [s], in the world [m]."""
        course = np.array(self.waypoints, dtype=float).reshape(-1, 4)
        return offset_at(course, time, self.present)


def last_change(obstacles: Iterable[Obstacle]) -> float:
    """When all have ended their courses, and come and go no more [s]; 0: none ever moves."""
    return max((obstacle.last_change for obstacle in obstacles), default=0.0)


def check_obstacles(obstacles: list[Obstacle]) -> None:
    """What no single field of an `obstacles` block can tell.

    Raises:
        ScenarioError: for a name that is missing or taken twice, an obstacle without
            shapes, and a box's edge or a colour out of range.
    """
    names = [obstacle.name for obstacle in obstacles]
    for row, obstacle in enumerate(obstacles):
        where = f"obstacles[{row}]"
        if not obstacle.name:
            raise ScenarioError(f"{where}.name: is empty; each obstacle needs a name of its own")
        if obstacle.name in names[:row]:
            raise ScenarioError(f"{where}.name: two obstacles are named '{obstacle.name}'")
        if not obstacle.shapes:
            raise ScenarioError(
                f"{where}.shapes: is empty; it needs at least one of !Box, !Cylinder, !Sphere"
            )
        check_waypoints(obstacle.waypoints, f"{where}.waypoints")
        check_present(obstacle.present, f"{where}.present")
        if not all(0.0 <= value <= 1.0 for value in obstacle.color):
            raise ScenarioError(f"{where}.color: {obstacle.color} is outside [0, 1]")
        check_shapes(obstacle.shapes, f"{where}.shapes")


_FARTHEST = 10.0


ABSENT_HEIGHT = 50.0
"""How far above its place an obstacle waits while it is absent [m]: out of any camera's sight."""


_ROUNDING = 1e-9  # of a time [s]


def check_waypoints(waypoints: Sequence[Sequence[float]], where: str) -> None:
    """Refuses a course that cannot be followed.

    Args:
        waypoints: rows t, x, y, z [s, m].
        where: the field that they are in.

    Raises:
        ScenarioError: naming `where` and the row.
    """
    before = -math.inf
    for row, waypoint in enumerate(waypoints):
        if len(waypoint) != 4:
            raise ScenarioError(
                f"{where}[{row}]: expected 4 numbers, t [s], x, y, z [m], not {list(waypoint)}"
            )
        if waypoint[0] < 0.0 or waypoint[0] <= before:
            raise ScenarioError(
                f"{where}[{row}]: its time {waypoint[0]:g} s must be at least 0 and later than "
                "that of the one before"
            )
        if max(map(abs, waypoint[1:])) > _FARTHEST:
            raise ScenarioError(
                f"{where}[{row}]: {list(waypoint[1:])} is outside [-{_FARTHEST:g}, "
                f"{_FARTHEST:g}] [m]"
            )
        before = waypoint[0]


def check_present(present: Sequence[float], where: str) -> None:
    """Refuses a time of presence that is none.

    Args:
        present: empty, [from] or [from, until] [s].
        where: the field that it is in.

    Raises:
        ScenarioError: naming `where`.
    """
    if len(present) > 2:
        raise ScenarioError(
            f"{where}: expected [from] or [from, until] [s], not {len(present)} numbers"
        )
    if present and present[0] < 0.0:
        raise ScenarioError(f"{where}[0]: {present[0]:g} must be at least 0 [s]")
    if len(present) == 2 and present[1] <= present[0]:
        raise ScenarioError(
            f"{where}[1]: {present[1]:g} must be later than {present[0]:g}, when it appears [s]"
        )


def is_present(present: Sequence[float], time: float) -> bool:
    """Whether an obstacle is there at a time [s]: from <= time < until."""
    if not present:
        return True
    after = present[1] if len(present) > 1 else math.inf
    return present[0] <= time + _ROUNDING < after


def offset_at(waypoints: FloatArray, time: float, present: Sequence[float] = ()) -> FloatArray:
    """Where a course is: straight and at a constant speed between waypoints, at rest outside.

    Args:
        waypoints: (N, 4) rows t, x, y, z with increasing t [s, m]; (0, 4): it stays.
        time: when [s].
        present: [from] or [from, until] [s]; at other times it is `ABSENT_HEIGHT` higher.

    Returns:
        (3,) offset from where the obstacle was put, in the world [m].
    """
    offset = np.zeros(3)
    if len(waypoints):
        after = int(waypoints[:, 0].searchsorted(time, side="right"))
        offset = waypoints[max(after - 1, 0), 1:].copy()
        if 0 < after < len(waypoints):
            begin, way = waypoints[after - 1], waypoints[after] - waypoints[after - 1]
            offset += way[1:] / way[0] * (time - begin[0])
    if not is_present(present, time):
        offset[2] += ABSENT_HEIGHT
    return offset
