"""Random scenes in which things cross the way while the robot moves.

One or two boxes, spheres and cylinders of 5 to 15 cm move at 0.1 to 0.4 m/s, each along a
straight, level course, on the table or in the air; they rest before and after. None to two
things besides stand on the table. They are drawn again until

- the first meets the pre-planned motion in time: some link of the robot, followed along the
  straight line as it is planned, goes at least 5 mm into it while it moves;
- where they rest at first, and for the first second, they leave the robot's start free (5 cm
  of the whole robot), and where they rest at last, the robot's goal;
- no course comes nearer than 2 cm to another thing at any time (spheres round the shapes), to
  the robot's base, or leaves the camera's view.

Nothing else is asked: a thing may pass where the robot would stand and wait.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import Box, Cylinder, Sphere, bounding_radius, pose
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.studies.panda.obstacles import COLORS, half_height
from drake_oa.studies.panda.scene_parts import (
    BASE_RADIUS,
    FREE,
    GAP,
    ON_BASE,
    OUT_OF_VIEW,
    TOO_NEAR,
    TOUCH,
    TOUCHES_TABLE,
    Drawn,
    base_scenario,
    draw_motion,
    draw_obstacles,
    in_view,
    scene_cell,
)
from drake_oa.studies.tally import Tally

SMALLEST, LARGEST = 0.05, 0.15
"""Least and largest dimension of a thing that moves [m]."""
SLOWEST, FASTEST = 0.1, 0.4
"""[m/s]."""
MOST_MOVING, MOST_RESTING = 2, 2
QUIET = 1.0
"""So long nothing touches the robot where it stands at the start [s]."""

MET = (0.25, 0.75)
"""When the robot is met, as a share of the planned duration."""
_BEFORE, _AFTER = (0.5, 2.5), (0.5, 2.5)
"""How long a thing moves before and after it meets the robot [s]."""
AIMED_ASIDE = (-0.05, 0.05)
"""How far the middle of its course is from that of a link then, along each axis [m]."""
_NEAR_TABLE = 0.05
"""What is aimed at no higher than this over its lowest place slides on the table [m]."""
_OFF_TABLE = 2e-3
"""How high a thing slides over the table [m]: it does not rub."""
HIGHEST = 0.6
"""Of the middle of anything [m]."""
HIT_LINKS = ("panda_link5", "panda_link6", "panda_link7", "panda_hand")
"""Links of which one is met: those that reach out."""
_SETS = 12
"""Sets of things tried for the same motion."""
_SAMPLE = 0.05
"""Between the instants at which courses are looked at [s]."""
_MOST_MOTIONS = 1000

# Why candidates are dropped.
TOO_HIGH = "above 0.6 m"
NOT_MET = "the first thing that moves does not touch the planned motion"


def draw_moving(random: np.random.Generator, tally: Tally) -> Drawn:
    """A scene with one or two moving things.

    Raises:
        RuntimeError: if none was found for `_MOST_MOTIONS` motions.
    """
    moving = int(random.integers(1, MOST_MOVING + 1))
    resting = int(random.integers(MOST_RESTING + 1))
    for _ in range(_MOST_MOTIONS):
        drawn = draw_motion(random, tally)
        if drawn is None:
            continue
        start, goal, motion = drawn
        for _ in range(_SETS):
            obstacles = _draw_set(random, tally, motion, moving, resting)
            if obstacles is not None and tally.takes("scenes", _no_scene(motion, goal, obstacles)):
                return obstacles, start, goal
    raise RuntimeError(
        f"no scene of {moving} moving and {resting} resting things found for "
        f"{_MOST_MOTIONS} motions"
    )


def _draw_set(
    random: np.random.Generator, tally: Tally, motion: FloatArray, moving: int, resting: int
) -> list[Obstacle] | None:
    """Things that keep off each other, or None where there is no room for all."""
    crossing = [_draw_crossing(random, motion, number) for number in range(moving)]
    fit = [tally.takes("courses", _misfit(obstacle)) for obstacle in crossing]
    if not all(fit):
        return None
    standing = draw_obstacles(random, resting, tally) if resting else []
    if standing is None:
        return None
    number_things(standing, moving)
    things = [*crossing, *standing]
    apart = all(
        course_gap(one, other) >= GAP
        for row, one in enumerate(crossing)
        for other in things[row + 1 :]
    )
    return things if tally.takes("sets of things", "" if apart else TOO_NEAR) else None


def number_things(things: Sequence[Obstacle], start: int) -> None:
    """Names and colours things by their number from `start` on."""
    for number, thing in enumerate(things, start=start):
        thing.name = f"{thing.name.rstrip('0123456789')}{number}"
        thing.color = list(COLORS[number % len(COLORS)])


def _draw_crossing(random: np.random.Generator, motion: FloatArray, number: int) -> Obstacle:
    """A thing whose course passes the middle of a link when the robot is there."""
    duration = base_scenario().task.duration
    row = int(random.uniform(*MET) * len(motion))
    met = row * duration / (len(motion) - 1)
    points = scene_cell().shape_centers(motion[row], HIT_LINKS)
    point = points[random.integers(len(points))] + random.uniform(*AIMED_ASIDE, 3)
    shape = draw_shape(random, SMALLEST, LARGEST)
    z = level_height(shape, float(point[2]))
    speed, heading = random.uniform(SLOWEST, FASTEST), random.uniform(-math.pi, math.pi)
    velocity = speed * np.array([math.cos(heading), math.sin(heading)])
    begins = max(met - float(random.uniform(*_BEFORE)), 0.0)
    ends = met + float(random.uniform(*_AFTER))
    begins, ends = round(begins, 2), round(ends, 2)
    x, y = point[:2] - velocity * (met - begins)
    way = np.round(velocity * (ends - begins), 4)
    return Obstacle(
        name=f"moving{number}",
        shapes=[shape],
        translation=[round(float(x), 4), round(float(y), 4), round(z, 4)],
        rpy=[0.0, 0.0, float(random.uniform(-math.pi, math.pi))],
        color=list(COLORS[number % len(COLORS)]),
        waypoints=[[begins, 0.0, 0.0, 0.0], [ends, *map(float, way), 0.0]],
    )


def level_height(shape: Box | Cylinder | Sphere, z: float) -> float:
    """Height of a shape's middle on a course at about height z [m]: near the table it slides."""
    lowest = half_height(shape) + _OFF_TABLE
    return z if z > lowest + _NEAR_TABLE else lowest


def draw_shape(
    random: np.random.Generator, smallest: float, largest: float
) -> Box | Cylinder | Sphere:
    """A box, a cylinder or a sphere whose dimensions are within two lengths [m]."""
    x, y, z = (float(v) for v in random.uniform(smallest, largest, 3))
    kind = random.integers(3)
    if kind == 0:
        return Box(size=[x, y, z])
    return Cylinder(radius=0.5 * x, length=z) if kind == 1 else Sphere(radius=0.5 * x)


def _ends(obstacle: Obstacle) -> tuple[FloatArray, FloatArray]:
    """(3,) first and (3,) last place [m]."""
    first, last = (np.asarray(obstacle.waypoints[row][1:]) for row in (0, -1))
    return obstacle.translation + first, obstacle.translation + last


def _misfit(obstacle: Obstacle) -> str:
    """Why its course will not do; "": it stays in view, off the base and low enough."""
    line = np.linspace(*_ends(obstacle), 11)
    radius = bounding_radius(obstacle.shapes[0])
    if (line[:, 2] > HIGHEST).any():
        return TOO_HIGH
    if (np.hypot(line[:, 0], line[:, 1]) < radius + BASE_RADIUS).any():
        return ON_BASE
    return "" if all(map(in_view, line)) else OUT_OF_VIEW


def course_gap(one: Obstacle, other: Obstacle) -> float:
    """Least distance in time of the spheres round the shapes of two things [m]."""
    end = max(item.waypoints[-1][0] for item in (one, other) if item.waypoints)
    times = np.arange(0.0, end + _SAMPLE, _SAMPLE)
    return min(
        float(np.linalg.norm(a - b, axis=1).min()) - bounding_radius(shape) - bounding_radius(thing)
        for shape, a in course_tracks(one, times)
        for thing, b in course_tracks(other, times)
    )


def course_tracks(
    obstacle: Obstacle, times: FloatArray
) -> list[tuple[Box | Cylinder | Sphere, FloatArray]]:
    """The shapes and the (T, 3) places of their middles at (T,) times [m]."""
    X_WO, offsets = pose(obstacle), np.zeros((len(times), 3))
    if obstacle.waypoints:
        t, *axes = np.array(obstacle.waypoints).T
        offsets = np.stack([np.interp(times, t, axis) for axis in axes], axis=1)
    return [(shape, X_WO @ np.asarray(shape.translation) + offsets) for shape in obstacle.shapes]


def _no_scene(motion: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> str:
    if not is_met(motion, obstacles):
        return NOT_MET
    if not touches_no_table(motion):
        return TOUCHES_TABLE
    if not _start_is_free(motion[0], obstacles):
        return "in the first second the start leaves the robot less than 5 cm"
    if not _goal_is_free(motion[-1], goal, obstacles):
        return "at last the goal leaves the robot less than 5 cm"
    return ""


def is_met(motion: FloatArray, obstacles: Sequence[Obstacle]) -> bool:
    """Whether the first thing hits the planned motion while it moves."""
    cell, first = scene_cell(), obstacles[0]
    begins, ends = first.waypoints[0][0], first.waypoints[-1][0]
    times = np.linspace(0.0, base_scenario().task.duration, len(motion))
    for q, time in zip(motion, times, strict=True):
        if begins <= time <= ends:
            cell.put([first], time)
            if any(distance <= -TOUCH for _, _, distance in cell.nearby(q, 0.0)):
                return True
    return False


def touches_no_table(motion: FloatArray) -> bool:
    """Whether the planned motion keeps off the table and whatever else is not put."""
    cell = scene_cell()
    cell.put([])
    return not any(cell.contacts(q) for q in motion)


def _start_is_free(q: FloatArray, obstacles: Sequence[Obstacle]) -> bool:
    cell = scene_cell()
    for time in np.arange(0.0, QUIET + _SAMPLE, _SAMPLE):
        cell.put(obstacles, float(time))
        if cell.nearby(q, FREE):
            return False
    return True


def _goal_is_free(q: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> bool:
    cell = scene_cell()
    cell.put(obstacles, max(item.waypoints[-1][0] for item in obstacles if item.waypoints))
    return not any(cell.nearby(positions, FREE) for positions in (q, cell.tool_down(goal)))
