"""Random scenes of things on a table, some of them in the way: table-top scenes and clutter.

A table-top scene has 1 to 6 things. The number is drawn once; the rest is drawn again until

- no two obstacles are nearer to each other than 2 cm (circles round them, seen from above),
  and none stands on the robot's base;
- start and goal are free: the whole robot, posed there, keeps 5 cm to every obstacle and
  does not touch the table;
- the pre-planned motion is not clear: followed along the straight line, some link of the
  robot goes at least 5 mm into an obstacle (by SceneGraph, with the joints that the arm
  takes there).

Clutter is the same with exactly six things, three or more of them beside the way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.studies.panda.obstacles import footprint_radius, height
from drake_oa.studies.panda.scene_parts import (
    ENDS_TAKEN,
    NOT_FOLLOWED,
    TOUCH,
    TOUCHES_TABLE,
    Drawn,
    draw_ends,
    draw_obstacles,
    ends_are_free,
    first_drawn,
    planning_scene,
)
from drake_oa.studies.tally import Tally

MOST_OBSTACLES = 6
NEAR, NEAR_OBSTACLES = 0.25, 3
"""In clutter so many obstacles are nearer than this to the straight line [m]."""

_ARM_WIDTH = 0.15
"""How far the arm may be aside of the triangle of base, start and goal [m]."""
_MOTIONS = 12
"""Motions tried among the same obstacles."""
_MOST_ATTEMPTS = 2000
_SAMPLES = 41
"""Of the straight line."""

Condition = Callable[[FloatArray, FloatArray, Sequence[Obstacle]], str]
"""Why start, goal and obstacles are no scene; "": they may be one."""


def draw_tabletop(random: np.random.Generator, tally: Tally) -> Drawn:
    """A scene of 1 to 6 obstacles, see `first_drawn`."""
    return _draw_on_table(random, tally, int(random.integers(1, MOST_OBSTACLES + 1)), _no_scene)


def draw_clutter(random: np.random.Generator, tally: Tally) -> Drawn:
    """A scene of six obstacles, see `first_drawn`."""
    return _draw_on_table(random, tally, MOST_OBSTACLES, _no_clutter)


def _draw_on_table(
    random: np.random.Generator, tally: Tally, count: int, no_scene: Condition
) -> Drawn:
    def attempt() -> Drawn | None:
        obstacles = draw_obstacles(random, count, tally)
        if obstacles is None:
            return None
        planning_scene().put(obstacles)
        for _ in range(_MOTIONS):
            ends = draw_ends(random, tally)
            if ends is not None and tally.takes("scenes", no_scene(*ends, obstacles)):
                return obstacles, *ends
        return None

    return first_drawn(attempt, _MOST_ATTEMPTS, f"{count} obstacles")


def _no_clutter(start: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> str:
    near = sum(distance_to_line(start, goal, obstacle) < NEAR for obstacle in obstacles)
    if near < NEAR_OBSTACLES:
        return "fewer than three things within 25 cm of the way"
    return _no_scene(start, goal, obstacles)


def distance_to_line(start: FloatArray, goal: FloatArray, obstacle: Obstacle) -> float:
    """Least distance of the upright cylinder round an obstacle to the line of the tool [m]."""
    line = np.linspace(start, goal, _SAMPLES)
    aside = np.linalg.norm(line[:, :2] - obstacle.translation[:2], axis=1)
    aside = np.maximum(aside - footprint_radius(obstacle), 0.0)
    above = np.maximum(line[:, 2] - height(obstacle), 0.0)
    return float(np.hypot(aside, above).min())


def _no_scene(start: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> str:
    """Why not; "": start and goal are free and the straight motion is feasible, but not clear."""
    clear = "the planned motion is clear"
    if _line_is_far(start, goal, obstacles):
        return clear
    cell = planning_scene()
    motion = cell.straight_motion(start, goal)
    if motion is None:
        return NOT_FOLLOWED
    touched = [hit for q in motion for hit in cell.contacts(q)]
    if not any(thing and depth >= TOUCH for _, thing, depth in touched):
        return clear
    if not all(thing for _, thing, _ in touched):
        return TOUCHES_TABLE
    return "" if ends_are_free(motion, goal) else ENDS_TAKEN


def _line_is_far(start: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> bool:
    """Whether neither the tool nor the arm above the line can come near an obstacle.

    Seen from above, the arm stays in the triangle of base, start and goal, about its own
    width aside.
    """
    corners = np.array([[0.0, 0.0], start[:2], goal[:2]])
    return all(
        _distance_to_triangle(np.asarray(o.translation[:2]), corners)
        > footprint_radius(o) + _ARM_WIDTH
        for o in obstacles
    )


def _distance_to_triangle(p: FloatArray, corners: FloatArray) -> float:
    following = np.roll(corners, -1, axis=0)
    edges = following - corners
    to_p = p - corners
    turn = edges[:, 0] * to_p[:, 1] - edges[:, 1] * to_p[:, 0]
    if (turn >= 0.0).all() or (turn <= 0.0).all():
        return 0.0
    share = np.clip((to_p * edges).sum(1) / (edges**2).sum(1), 0.0, 1.0)
    return float(np.linalg.norm(to_p - share[:, None] * edges, axis=1).min())
