"""Random scenes by the parameters of DRPBench, the benchmark of Deep Reactive Policy (Yang et al.,
CoRL 2025).

A level of the benchmark is one set of parameters, for example `sudden2`. Kinds, levels, sizes,
speeds and times of the moving boxes are those of its authors' program, with an episode (one trial)
of 1,000 steps of 1/60 s:

- `sudden`: a box appears at step 30 on the nominal path of the tool, at the first position at least
  0.1 m from the robot; it disappears 100 steps before the end;
- `floating`: three boxes start 0.8 to 1.0 m from the point (0.15, 0, 0.5) m in the world. Each
  flies toward a random place within 0.2 m of the point along each axis, and reverses at 1.2 m from
  the point. The boxes disappear 300 steps before the end;
- `goal_blocked`: a box appears at the goal when the nominal tool position is 0.5 m from it; it
  disappears 200 steps before the end;
- `moving_goal_blocked`: the robot starts at the goal; boxes start 0.5 to 0.6 m from the goal and at
  least 1 cm from the robot, fly toward the goal, and reverse at 1.0 m from it; they disappear 300
  steps before the end.

Flying boxes also reverse at the base (a cylinder with a radius of 0.25 m) and at x < 0.1 m in the
world. This module draws static objects and nominal motions (tool motions without avoidance).
Differences from DRPBench:

- Boxes depend on the nominal motion, not on the executed one, so that a scene is the same for all
  methods. Until a box appears, the robot on its nominal motion keeps at least 1 cm distance to the
  place of the box, or 0.1 m in `sudden`. A sudden box does not appear a second time 200 steps
  later.
- Flying boxes also reverse at the table.
- In `moving_goal_blocked` the robot starts 5 cm from the goal, since start and goal of a task must
  differ.
- The tool points down; in the shelf it points forward, tilted down by 20 degrees.

Static objects are an open box on the table, and a shelf: a raised box that is open at its front. If
start and goal are outside a static object, the robot has at both at least 5 cm clearance to the
object, as if a board closed its open face. If they are inside, the robot has at least 5 cm
clearance to the boards of the object. Flying boxes pass through static objects and each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.evaluation.panda.scene_arm import Motion, scene_arm
from drake_oa.evaluation.panda.scene_parts import (
    TABLE_X,
    TABLE_Y,
    DrawObjects,
    Shape,
    draw_motion,
    ends_are_free,
    extent,
    fits,
    make_obstacle,
)
from drake_oa.geometry.shapes import Box
from drake_oa.scenario.end_poses import posture_guide
from drake_oa.scenario.obstacles import Obstacle

_STEP = 1.0 / 60.0
"""Time step of the benchmark DRPBench, in which its authors state times [s]."""
EPISODE = 1000 * _STEP
"""Duration of an episode, one trial of the benchmark DRPBench [s]."""


@dataclass(frozen=True)
class Level:
    """Parameters of one level of the benchmark DRPBench.

    Attributes:
        draw_boxes: function that draws the flying or appearing boxes from a source of random
            numbers, a level and a nominal motion; an empty list if they cannot be placed.
        size: range of the edge lengths of a flying or appearing box [m].
        count: number of flying boxes.
        speed: range of the speeds of flying boxes [m/s].
        world: names of the static objects in the scene: "open_box", "shelf", both or none.
        inside: whether start and goal are inside the only static object.
        draw_motion: function that draws the nominal motion from a source of random numbers; it
            returns None if a draw is rejected.
    """

    draw_boxes: Callable[..., list[Obstacle]]
    size: tuple[float, float]
    count: int = 1
    speed: tuple[float, float] = (0.06, 0.18)
    world: tuple[str, ...] = ()
    inside: bool = False
    draw_motion: Callable[..., Motion | None] = draw_motion


def drp_objects(random: Generator, *, level: Level) -> DrawObjects:
    """Returns a function that draws the static objects and the moving or appearing boxes of a level
    of the benchmark DRPBench.

    Args:
        random: source of random numbers.
        level: parameters of the level.

    Returns:
        Function from a nominal motion to obstacles, boxes first; it returns None if an object
        cannot be placed.
    """

    def draw(motion: Motion) -> list[Obstacle] | None:
        world: list[Obstacle] = []
        for name in level.world:
            closed = _draw_case(random, name, len(world), motion.goal if level.inside else None)
            item = replace(closed, shapes=closed.shapes[:-1])
            if not (level.inside or fits(item, world)):
                return None
            if not ends_are_free(motion, [item if level.inside else closed]):
                return None
            world.append(item)
        boxes = level.draw_boxes(random, level, motion)
        return [*boxes, *world] if boxes else None

    return draw


_START_DISTANCE = 0.05
"""Distance from start to goal in the DRPBench levels `moving_goal_blocked`, in which the robot is
to stay near its goal [m]."""
_FORWARD = [0.0, math.radians(110.0), 0.0]
"""Roll, pitch and yaw in the world of a tool that points forward into the shelf, tilted down by 20
degrees [rad]."""
_GOALS = (0.40, -0.40, 0.30), (0.60, 0.40, 0.55)
"""Lower and upper corner (x, y, z) in the world of the box from which goals of the DRPBench levels
`moving_goal_blocked` are drawn [m]."""


def _draw_hold(random: Generator, *, forward: bool = False) -> Motion | None:
    """Draws a tool motion of 5 cm along the world's x axis to a random goal, for the DRPBench
    levels `moving_goal_blocked`.

    Args:
        random: source of random numbers.
        forward: whether the tool points forward, tilted down by 20 degrees; else it points down.

    Returns:
        The motion; None if the arm cannot follow it.
    """
    goal = np.round(random.uniform(*_GOALS), 4)
    start = goal - [_START_DISTANCE, 0.0, 0.0]
    return scene_arm().straight_motion(start, goal, rpy_WE=_FORWARD if forward else None)


# Static objects -------------------------------------------------------------------------

_BOARD = 0.02
"""Thickness of the boards of which static objects (open box and shelf) consist [m]."""
_CASES = {
    "open_box": (5, (0.12, 0.12, 0.0, 0.12), (0.22, 0.22, 0.0, 0.25)),
    "shelf": (0, (0.10, 0.27, 0.15, 0.32), (0.15, 0.37, 0.30, 0.40)),
}
"""Name of a static object -> index of its open face, and minima and maxima of four dimensions [m].

Faces 0 to 2 are at the minimum of x, y and z in the object's frame, 3 to 5 at the maximum. The
dimensions are measured between the middle planes of the boards: half depth (along x), half width
(along y), height of the lower board above the table, and height of the upper board above the lower
one."""


def _draw_case(random: Generator, name: str, number: int, inside: FloatArray | None) -> Obstacle:
    """Draws a static object as a closed box of six boards; the open object lacks the last board.

    Args:
        random: source of random numbers.
        name: "open_box" or "shelf".
        number: number of the obstacle, which determines its name and color.
        inside: (3,) tool position in the world that is to be inside the object, 6 to 10 cm behind
            the object's front (the face at minimum x in its frame) [m]; the object then has a yaw
            of 0. None: the object is anywhere on the table, and its front faces the robot's base.
    """
    opening, smallest, largest = _CASES[name]
    x, y, low, height = random.uniform(smallest, largest)
    place = [random.uniform(*TABLE_X), random.uniform(*TABLE_Y), 0.0]
    yaw = math.atan2(place[1], place[0])
    if inside is not None:
        aside = random.uniform(-1.0, 1.0) * y / 3.0
        place = [inside[0] + x - random.uniform(0.06, 0.10), inside[1] + aside, 0.0]
        low, yaw = inside[2] - 0.5 * height, 0.0
    boards: list[Shape] = []
    for face in [*({*range(6)} - {opening}), opening]:
        # Faces 0 to 2 are at the minimum of x, y and z, 3 to 5 at the maximum.
        corners = np.array([[-x, -y, low], [x, y, low + height]])
        corners[:, face % 3] = corners[face // 3, face % 3]
        size = np.maximum(np.ptp(corners, axis=0), _BOARD)
        boards.append(Box(size=size.tolist(), translation=corners.mean(axis=0).tolist()))
    return replace(make_obstacle(random, name, number, boards, place), rpy=[0.0, 0.0, yaw])


# Boxes that move or appear --------------------------------------------------------------

_FLOATING_TARGET = np.array([0.15, 0.0, 0.5])
"""Point in the world toward which the boxes of the DRPBench levels `floating` fly [m]."""
_FLOATING_RANGES = (0.8, 1.0), 1.2, 0.2
"""Distances from the point `_FLOATING_TARGET` that determine the lines of flying boxes in the
DRPBench levels `floating` [m]: range of the distance at which a box starts, distance at which a box
reverses, and maximum offset along each world axis of the place toward which a box flies."""
_GOAL_RANGES = (0.5, 0.6), 1.0, 0.01
"""Parameters of the straight lines on which boxes fly to and fro in the DRPBench levels
`moving_goal_blocked` [m]: range of the distances from the goal at which a box starts; distance from
the goal at which it reverses; and maximum offset, along each world axis, from the goal to the place
toward which it flies."""
_BASE_RADIUS = 0.25
"""Radius of a vertical cylinder around the robot's base at which flying boxes reverse [m]."""
_MIN_X = 0.1
"""Minimum x coordinate of flying boxes in the world, at which they reverse [m]."""
_MIN_DISTANCE = 0.01
"""Minimum distance between the robot and the place of a box, at all times until the box starts to
fly or appears at the goal [m]."""
_MIN_SUDDEN_DISTANCE = 0.1
"""Minimum distance between the robot and the place of a box that appears on the tool's path, at all
times until it appears [m]."""
_SPACING = 0.005
"""Distance between neighboring points on the line of a flying box, at which it is checked whether
the box must reverse [m]."""


def _draw_box(random: Generator, level: Level, number: int, p_WB: FloatArray) -> Obstacle:
    """Draws a box with random edge lengths and a random orientation.

    Args:
        random: source of random numbers.
        level: level of the benchmark DRPBench, with the range of edge lengths.
        number: number of the obstacle, which determines its name and color.
        p_WB: (3,) position of the box's center in the world [m].
    """
    rpy = Rotation.from_quat(random.normal(size=4)).as_euler("xyz")
    box = Box(size=random.uniform(*level.size, 3).tolist(), rpy=rpy.tolist())
    return make_obstacle(random, "box", number, [box], p_WB.tolist())


def _min_height(box: Obstacle) -> float:
    """Computes the height of a box's center at which the box touches the table [m]."""
    return extent(box.shapes[0])[1]


def _place_box(box: Obstacle, p_WB: FloatArray, present: list[float]) -> Obstacle:
    """Returns a copy of a box at a position, raised if necessary so that it is not below the table.

    Args:
        box: box to move.
        p_WB: (3,) position of its center in the world [m].
        present: times at which the box appears and disappears [s].
    """
    x, y, z = p_WB
    return replace(box, translation=[x, y, max(z, _min_height(box))], present=present)


def _is_clear(box: Obstacle, motion: Motion, distance: float) -> bool:
    """Checks whether the robot on its nominal motion keeps a minimum distance to the place at which
    a box will appear, at all times until then.

    Args:
        box: box with the time at which it appears; a flying box appears at time 0.
        motion: nominal motion.
        distance: minimum distance [m].
    """
    begin = box.present[0]
    passed = motion.q[motion.t <= begin]
    return bool(scene_arm().distances(passed, [box], begin).min() >= distance)


def _tool_path(motion: Motion) -> FloatArray:
    """Computes the tool positions (T, 3) at the T times of a nominal motion, in the world [m]."""
    return posture_guide(motion.t / motion.t[-1], motion.start, motion.goal)


def _draw_sudden_box(random: Generator, level: Level, motion: Motion) -> list[Obstacle]:
    """Draws a box that appears after 0.5 s on the tool's nominal path, at the first position that
    is at least 0.1 m from the robot.

    Returns:
        One box, or none if no position is far enough from the robot.
    """
    box, begin = _draw_box(random, level, 0, motion.goal), 30 * _STEP
    path = _tool_path(motion)[motion.t > begin]
    items = (_place_box(box, p_WB, [begin, 900 * _STEP]) for p_WB in path)
    return [item for item in items if _is_clear(item, motion, _MIN_SUDDEN_DISTANCE)][:1]


def _draw_goal_box(random: Generator, level: Level, motion: Motion) -> list[Obstacle]:
    """Draws a box that appears at the goal when the tool on its nominal motion is 0.5 m from the
    goal.

    Returns:
        One box, or none if the robot comes within 1 cm of its place before it appears.
    """
    near = np.linalg.norm(_tool_path(motion) - motion.goal, axis=1) <= 0.5
    present = [motion.t[near.argmax()], 800 * _STEP]
    box = _place_box(_draw_box(random, level, 0, motion.goal), motion.goal, present)
    return [box] if _is_clear(box, motion, _MIN_DISTANCE) else []


def _draw_flying_boxes(
    random: Generator, level: Level, motion: Motion, *, at_goal: bool
) -> list[Obstacle]:
    """Draws boxes that fly to and fro along straight lines through the goal or a fixed target
    point.

    Args:
        random: source of random numbers.
        level: level of the benchmark DRPBench, with number, sizes and speeds of the boxes.
        motion: nominal motion.
        at_goal: whether the lines pass within 1 cm of the goal along each world axis, and boxes
            start above the goal; else the lines pass within 20 cm of `_FLOATING_TARGET` along each
            world axis.

    Returns:
        The boxes, or none if one of them cannot be placed.
    """
    target, boxes = motion.goal if at_goal else _FLOATING_TARGET, list[Obstacle]()
    begin, farthest, noise = _GOAL_RANGES if at_goal else _FLOATING_RANGES
    for number in range(level.count):
        away = random.normal(size=3)
        away = np.where([True, False, at_goal], abs(away), away) / np.linalg.norm(away)
        box = _draw_box(random, level, number, target + random.uniform(*begin) * away)
        heading = target + random.uniform(-noise, noise, 3) - box.translation
        heading /= np.linalg.norm(heading)
        s = np.arange(-3.0, 3.0, _SPACING)
        p = box.translation + s[:, None] * heading
        turns = np.linalg.norm(p - target, axis=1) > farthest
        turns |= (np.hypot(p[:, 0], p[:, 1]) < _BASE_RADIUS) | (p[:, 0] < _MIN_X)
        turns |= p[:, 2] < _min_height(box)
        back, ahead = s[turns & (s < 0.0)].max(), s[turns & (s > 0.0)].min()
        end, speed, line_length = 700 * _STEP, random.uniform(*level.speed), ahead - back
        box.present = [0.0, end]
        if min(-back, ahead) < 2.0 * _SPACING or not _is_clear(box, motion, _MIN_DISTANCE):
            return []
        # A turn just before the end would have the same rounded time as the end.
        turned = np.arange(ahead, speed * (end - _STEP), line_length) / speed
        t = np.array([0.0, *turned, end])
        # Distance flown without reversal, folded between both ends of the line.
        along = back + abs((speed * t - ahead) % (2.0 * line_length) - line_length)
        box.waypoints = np.column_stack([t, along[:, None] * heading]).round(4).tolist()
        boxes.append(box)
    return boxes


_SMALL = (0.1, 0.2)
"""Range of the edge lengths of small boxes in DRPBench [m]."""
_BIG = (0.1, 0.3)
"""Range of the edge lengths of large boxes in DRPBench [m]."""
_FLOATING = Level(partial(_draw_flying_boxes, at_goal=False), _SMALL, 3)
"""Parameters of the DRPBench level `floating1`, with three boxes that fly through a fixed target
point."""
_HOLD = Level(partial(_draw_flying_boxes, at_goal=True), _BIG, draw_motion=_draw_hold)
"""Parameters of the DRPBench level `moving_goal_blocked1`, with one box that flies through the goal
near which the robot starts."""
LEVELS = {
    "sudden1": Level(_draw_sudden_box, (0.05, 0.3)),
    "sudden2": Level(_draw_sudden_box, _SMALL, world=("open_box",)),
    "sudden3": Level(_draw_sudden_box, _SMALL, world=("open_box", "shelf")),
    "floating1": _FLOATING,
    "floating2": replace(_FLOATING, size=_BIG, world=("open_box",)),
    "goal_blocked1": Level(_draw_goal_box, (0.2, 0.4), world=("open_box",)),
    "goal_blocked2": Level(_draw_goal_box, (0.2, 0.4)),
    "moving_goal_blocked1": _HOLD,
    "moving_goal_blocked2": replace(_HOLD, count=3),
    "moving_goal_blocked3": replace(_HOLD, world=("open_box",)),
    "moving_goal_blocked4": replace(
        _HOLD, world=("shelf",), inside=True, draw_motion=partial(_draw_hold, forward=True)
    ),
}
"""Name of a level of the benchmark DRPBench -> its parameters, as in the program of the benchmark's
authors."""
SPEED_LEVELS = {
    f"floating1_at_{speed}": replace(_FLOATING, speed=(speed, speed))
    for speed in (0.18, 0.5, 1.0, 1.6)
}
"""Name of an additional level -> its parameters: DRPBench's `floating1` with a single speed of all
boxes, from 0.18 to 1.6 m/s."""
