"""Random scenes by the parameters of DRPBench, the benchmark of Deep Reactive Policy.

Kinds, levels, sizes, speeds and times of the moving boxes are those of its authors' program, an
episode of 1,000 steps of 1/60 s:

- `sudden`: a box appears at step 30 on the planned path of the tool, at the first place 0.1 m from
  the robot; gone 100 steps before the end;
- `floating`: three boxes start 0.8 to 1.0 m from (0.15, 0, 0.5), fly at it (within 0.2 m along each
  axis), and turn back at 1.2 m from it; gone 300 steps before the end;
- `goal_blocked`: a box appears at the goal when the planned tool is 0.5 m from it; gone 200 steps
  before the end;
- `moving_goal_blocked`: the robot starts at the goal; boxes start 0.5 to 0.6 m from it, 1 cm from
  the robot, fly at it, and turn back at 1.0 m from it; gone 300 steps before the end.

Flying boxes also turn back at the base (a cylinder of 0.25 m) and at x < 0.1 m. Static worlds and
motions are drawn by this module. It differs in that

- boxes depend on the planned motion, not the actual one, so that a scene is the same for all
  methods: a box that appears keeps its distance to the robot at all planned postures until then,
  and a sudden one does not appear again 200 steps later, when it has no such place any more;
- flying boxes also turn back at the table;
- in `moving_goal_blocked` the robot starts 5 cm from the goal: a task has no start at its goal;
- the tool points down, in the shelf forward and 20 degrees down.

The static worlds are an open box on the table and a shelf, a box over it that is open to the front.
Where start and goal are outside, the whole robot keeps 5 cm to them there as if they were closed,
inside to their boards. Flying boxes pass through them and one another.
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
    DrawThings,
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
"""Time step of DRPBench [s]."""
EPISODE = 1000 * _STEP
"""Duration of an episode of DRPBench [s]."""


@dataclass(frozen=True)
class Level:
    """Parameters of a level of DRPBench.

    Attributes:
        draw_boxes: draws the boxes that move or appear for a motion; no boxes: there is no place.
        size: range of the edges of a box [m].
        count: number of boxes that move.
        speed: range of their speeds [m/s].
        world: objects that stand on the table.
        inside: whether start and goal are inside the object.
        draw_motion: draws the planned motion.
    """

    draw_boxes: Callable[..., list[Obstacle]]
    size: tuple[float, float]
    count: int = 1
    speed: tuple[float, float] = (0.06, 0.18)
    world: tuple[str, ...] = ()
    inside: bool = False
    draw_motion: Callable[..., Motion | None] = draw_motion


def drp_things(random: Generator, *, level: Level) -> DrawThings:
    """Prepares the static world and the boxes of a level."""

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


_BEGIN = 0.05
"""Distance of the start from the goal where the robot starts at the goal [m]."""
_FORWARD = [0.0, math.radians(110.0), 0.0]
"""Roll, pitch and yaw of the tool in the shelf [rad]."""
_GOALS = (0.40, -0.40, 0.30), (0.60, 0.40, 0.55)
"""Corners of the box that contains the goals at which the robot starts [m]."""


def _draw_hold(random: Generator, *, forward: bool = False) -> Motion | None:
    """Draws a motion of 5 cm to a goal, with the tool forward or down; None if rejected."""
    goal = np.round(random.uniform(*_GOALS), 4)
    start = goal - [_BEGIN, 0.0, 0.0]
    return scene_arm().straight_motion(start, goal, rpy_WE=_FORWARD if forward else None)


# Static worlds --------------------------------------------------------------------------

_BOARD = 0.02
"""Thickness of boards [m]."""
_CASES = {
    "open_box": (5, (0.12, 0.12, 0.0, 0.12), (0.22, 0.22, 0.0, 0.25)),
    "shelf": (0, (0.10, 0.27, 0.15, 0.32), (0.15, 0.37, 0.30, 0.40)),
}
"""Open face, and ranges of half depth, half width, height over the table and height inside [m]."""


def _draw_case(random: Generator, name: str, number: int, inside: FloatArray | None) -> Obstacle:
    """Draws a case of boards, of which the last closes it.

    Args:
        random: source of random numbers.
        name: one of `_CASES`.
        number: of the obstacle, for its name and color.
        inside: (3,) tool point that is to be in a case that stands straight, 6 to 10 cm behind its
            front [m]; None: it stands on the table anywhere, its front to the base.
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

_MIDDLE = np.array([0.15, 0.0, 0.5])
"""Point that floating boxes are aimed at [m]."""
_AT_MIDDLE, _AT_GOAL = ((0.8, 1.0), 1.2, 0.2), ((0.5, 0.6), 1.0, 0.01)
"""Range of distances of flying boxes from that point, or from the goal, at the beginning, distance
at which they turn back, and maximum distance of their lines along each axis [m]."""
_BASE, _NEAREST_X = 0.25, 0.1
"""Radius of the cylinder around the base, and x coordinate, at which boxes turn back [m]."""
_CLEAR = 0.01
"""Minimum distance between the robot and a box that begins to move or appears [m]."""
_SUDDEN_CLEAR = 0.1
"""Minimum distance between the robot and a box that appears on its path [m]."""
_FINE = 0.005
"""Distance between the points of a line at which a box may turn back [m]."""


def _draw_box(random: Generator, level: Level, number: int, p_WB: FloatArray) -> Obstacle:
    """Draws a box with a random orientation at a position (3,) [m]."""
    rpy = Rotation.from_quat(random.normal(size=4)).as_euler("xyz")
    box = Box(size=random.uniform(*level.size, 3).tolist(), rpy=rpy.tolist())
    return make_obstacle(random, "box", number, [box], p_WB.tolist())


def _lowest(box: Obstacle) -> float:
    """Computes the minimum height of a box's middle, where it touches the table [m]."""
    return extent(box.shapes[0])[1]


def _appearing(box: Obstacle, p_WB: FloatArray, present: list[float]) -> Obstacle:
    """Returns a box that is at a position (3,) [m], raised off the table, from time to time [s]."""
    x, y, z = p_WB
    return replace(box, translation=[x, y, max(z, _lowest(box))], present=present)


def _is_clear(box: Obstacle, motion: Motion, distance: float) -> bool:
    """Checks that a box keeps a distance to the planned motion until it is there [m]."""
    begin = box.present[0]
    passed = motion.q[motion.t <= begin]
    return bool(scene_arm().distances(passed, [box], begin).min() >= distance)


def _tool_path(motion: Motion) -> FloatArray:
    """Computes the planned tool points (T, 3) of a motion [m]."""
    return posture_guide(motion.t / motion.t[-1], motion.start, motion.goal)


def _sudden(random: Generator, level: Level, motion: Motion) -> list[Obstacle]:
    """Draws a box that appears on the planned path."""
    box, begin = _draw_box(random, level, 0, motion.goal), 30 * _STEP
    path = _tool_path(motion)[motion.t > begin]
    items = (_appearing(box, p_WB, [begin, 900 * _STEP]) for p_WB in path)
    return [item for item in items if _is_clear(item, motion, _SUDDEN_CLEAR)][:1]


def _goal_blocked(random: Generator, level: Level, motion: Motion) -> list[Obstacle]:
    """Draws a box that appears at the goal."""
    near = np.linalg.norm(_tool_path(motion) - motion.goal, axis=1) <= 0.5
    present = [motion.t[near.argmax()], 800 * _STEP]
    box = _appearing(_draw_box(random, level, 0, motion.goal), motion.goal, present)
    return [box] if _is_clear(box, motion, _CLEAR) else []


def _flying(
    random: Generator,
    level: Level,
    motion: Motion,
    *,
    at_goal: bool,
) -> list[Obstacle]:
    """Draws boxes that fly at the goal, from above, or at `_MIDDLE`, and turn back."""
    target, boxes = motion.goal if at_goal else _MIDDLE, list[Obstacle]()
    begin, farthest, noise = _AT_GOAL if at_goal else _AT_MIDDLE
    for number in range(level.count):
        away = random.normal(size=3)
        away = np.where([True, False, at_goal], abs(away), away) / np.linalg.norm(away)
        box = _draw_box(random, level, number, target + random.uniform(*begin) * away)
        heading = target + random.uniform(-noise, noise, 3) - box.translation
        heading /= np.linalg.norm(heading)
        s = np.arange(-3.0, 3.0, _FINE)
        p = box.translation + s[:, None] * heading
        turns = np.linalg.norm(p - target, axis=1) > farthest
        turns |= (np.hypot(p[:, 0], p[:, 1]) < _BASE) | (p[:, 0] < _NEAREST_X)
        turns |= p[:, 2] < _lowest(box)
        back, ahead = s[turns & (s < 0.0)].max(), s[turns & (s > 0.0)].min()
        end, speed, way = 700 * _STEP, random.uniform(*level.speed), ahead - back
        box.present = [0.0, end]
        if min(-back, ahead) < 2.0 * _FINE or not _is_clear(box, motion, _CLEAR):
            return []
        turned = np.arange(ahead, speed * end, way) / speed
        t = np.array([0.0, *turned, end])
        # The distance that it would fly straight on, folded between both ends of its line.
        along = back + abs((speed * t - ahead) % (2.0 * way) - way)
        box.waypoints = np.column_stack([t, along[:, None] * heading]).round(4).tolist()
        boxes.append(box)
    return boxes


_SMALL, _BIG = (0.1, 0.2), (0.1, 0.3)
_FLOATING = Level(partial(_flying, at_goal=False), _SMALL, 3)
_HOLD = Level(partial(_flying, at_goal=True), _BIG, draw_motion=_draw_hold)
LEVELS = {
    "sudden1": Level(_sudden, (0.05, 0.3)),
    "sudden2": Level(_sudden, _SMALL, world=("open_box",)),
    "sudden3": Level(_sudden, _SMALL, world=("open_box", "shelf")),
    "floating1": _FLOATING,
    "floating2": replace(_FLOATING, size=_BIG, world=("open_box",)),
    "goal_blocked1": Level(_goal_blocked, (0.2, 0.4), world=("open_box",)),
    "goal_blocked2": Level(_goal_blocked, (0.2, 0.4)),
    "moving_goal_blocked1": _HOLD,
    "moving_goal_blocked2": replace(_HOLD, count=3),
    "moving_goal_blocked3": replace(_HOLD, world=("open_box",)),
    "moving_goal_blocked4": replace(
        _HOLD, world=("shelf",), inside=True, draw_motion=partial(_draw_hold, forward=True)
    ),
}
"""Levels of DRPBench by name."""
SPEED_LEVELS = {
    f"floating1_at_{speed}": replace(_FLOATING, speed=(speed, speed))
    for speed in (0.18, 0.5, 1.0, 1.6)
}
"""Levels with one speed of the boxes [m/s]."""
