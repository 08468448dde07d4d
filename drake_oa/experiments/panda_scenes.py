"""Random table-top scenes for the whole Panda; each is a scenario.

A scene has 1 to 6 obstacles (see `panda_obstacles`) on the table, whose middles the camera of
the shipped table-top scenarios has in view, and a motion of 0.5 to 1.0 m whose straight line
the arm can follow, tool down, within its joint limits. The number of obstacles is drawn once;
the rest is drawn again until

- no two obstacles are nearer to each other than 2 cm (circles round them, seen from above),
  and none stands on the robot's base;
- start and goal are free: the whole robot, posed there, keeps 5 cm to every obstacle and
  does not touch the table;
- the pre-planned motion is not clear: followed along the straight line, some link of the
  robot goes at least 5 mm into an obstacle (by SceneGraph, with the joints that the arm
  takes there).

Scene i of a seed depends on nothing else, and not on perception or method.
"""

from __future__ import annotations

import copy
import math
import threading
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from drake_oa.experiments.panda_cell import PandaCell
from drake_oa.experiments.panda_obstacles import draw_obstacle, footprint_radius, middle
from drake_oa.obstacles import Obstacle
from drake_oa.scenario import (
    GroundTruth,
    Scenario,
    load_scenario,
    parse_scenario,
)
from drake_oa.values import FloatArray
from drake_oa.workspace import tool_down_margin

GENERATOR = 1
"""To be raised when the same seed draws another scene."""
KINDS = ("tabletop",)
PERCEPTIONS = ("depth", "truth")

MOST_OBSTACLES = 6
FREE = 0.05
"""Clearance of the whole robot at start and goal [m]."""

_LIKE = "tabletop_box"
"""The shipped scenario whose robot, camera and constants the scenes have."""
_CELL = """\
directives:
- add_directives: {file: package://drake_oa/scenes/table.dmd.yaml}
- add_directives: {file: package://drake_oa/scenes/camera_xtion.dmd.yaml}
"""
_BASELINE = (0.5, 1.0)
"""Distance of start and goal [m]."""
_LOW = np.array([0.10, -0.70, 0.10])
_HIGH = np.array([0.80, 0.70, 0.50])
"""Where start and goal are drawn [m]; the tool-down workspace is smaller."""
_REACH_MARGIN = 0.02
"""What the straight line keeps from the end of the tool-down workspace [m]."""
_TABLE_X, _TABLE_Y = (0.22, 0.85), (-0.60, 0.60)
"""Where obstacles stand, seen from above [m]: their circles may reach beyond."""
_BASE_RADIUS = 0.16
"""Of a circle round the robot's base, seen from above [m]."""
_GAP = 0.02
"""Between the circles round two obstacles [m]."""
_TOUCH = 5e-3
"""How far a link must go into an obstacle on the straight motion [m]."""
_ARM_WIDTH = 0.15
"""How far the arm may be aside of the triangle of base, start and goal [m]."""
_MOTIONS = 12
"""Motions tried among the same obstacles."""
_MOST_PLACES = 20
"""Obstacles tried for each that is asked for."""
_MOST_ATTEMPTS = 2000


def draw_panda_scene(
    seed: int, index: int, *, kind: str = "tabletop", perception: str = "depth"
) -> Scenario:
    """One random scene.

    Args:
        seed: of the evaluation, >= 0.
        index: of the scene, >= 0.
        kind: one of `KINDS`.
        perception: "depth", the camera as the shipped scenarios have it, or "truth".

    Raises:
        ValueError: for an unknown kind or perception.
        RuntimeError: if no scene was found in `_MOST_ATTEMPTS` attempts.
    """
    check_kind(kind)
    check_perception(perception)
    scenario = copy.deepcopy(_base())
    random = np.random.default_rng(np.random.SeedSequence([seed, index]))
    scenario.seed = int(random.integers(2**31))
    with _drawing:
        scenario.obstacles, start, goal = _draw(random)
    scenario.task.start = [round(float(v), 4) for v in start]
    scenario.task.goal = [round(float(v), 4) for v in goal]
    scenario.description = f"random table-top scene {index} of seed {seed}"
    if perception == "truth":
        scenario.perception = GroundTruth()
    return scenario


def check_kind(kind: str) -> None:
    """Raises ValueError if there is no such kind of scenes."""
    if kind not in KINDS:
        raise ValueError(f"unknown kind of scenes '{kind}': it must be one of {', '.join(KINDS)}")


def check_perception(name: str) -> None:
    """Raises ValueError for what is no perception of the scenes."""
    if name not in PERCEPTIONS:
        raise ValueError(f"unknown perception '{name}': it must be one of {', '.join(PERCEPTIONS)}")


@lru_cache(maxsize=1)
def _base() -> Scenario:
    """The shipped scenario, with nothing but table and camera in its world."""
    scenario = load_scenario(_LIKE)
    scenario.directives = parse_scenario(_CELL).directives
    return scenario


@lru_cache(maxsize=1)
def _cell() -> PandaCell:
    return PandaCell(_base())


_drawing = threading.Lock()
"""There is one cell a process, and a cluster's worker may have threads."""


def _draw(random: np.random.Generator) -> tuple[list[Obstacle], FloatArray, FloatArray]:
    """Obstacles, start and goal."""
    count = int(random.integers(1, MOST_OBSTACLES + 1))
    for _ in range(_MOST_ATTEMPTS):
        obstacles = _draw_obstacles(random, count)
        if obstacles is None:
            continue
        _cell().put(obstacles)
        for _ in range(_MOTIONS):
            ends = _draw_ends(random)
            if ends is not None and _is_scene(*ends, obstacles):
                return obstacles, *ends
    raise RuntimeError(f"no scene of {count} obstacles found in {_MOST_ATTEMPTS} attempts")


def _draw_obstacles(random: np.random.Generator, count: int) -> list[Obstacle] | None:
    """Obstacles apart from each other, or None where there is no room for all."""
    obstacles: list[Obstacle] = []
    for _ in range(_MOST_PLACES * count):
        obstacle = draw_obstacle(random, len(obstacles))
        x, y = (float(random.uniform(*side)) for side in (_TABLE_X, _TABLE_Y))
        obstacle.translation = [round(x, 4), round(y, 4), 0.0]
        if _fits(obstacle, obstacles):
            obstacles.append(obstacle)
        if len(obstacles) == count:
            return obstacles
    return None


def _fits(obstacle: Obstacle, others: Sequence[Obstacle]) -> bool:
    """Whether it stands in view of the camera, beside the robot's base and the others."""
    place, radius = obstacle.translation[:2], footprint_radius(obstacle)
    return (
        math.hypot(*place) >= radius + _BASE_RADIUS
        and all(
            math.dist(place, other.translation[:2]) >= radius + footprint_radius(other) + _GAP
            for other in others
        )
        and _in_view(middle(obstacle))
    )


def _in_view(p_WQ: FloatArray) -> bool:
    """Whether a point is in the camera's image."""
    camera = _base().cameras[0]
    X_WC = _cell().frame_pose(camera.X_PB.base_frame) @ camera.X_PB.GetDeterministicValue()
    x, y, z = X_WC.inverse() @ p_WQ
    if not camera.z_near < z < camera.z_far:
        return False
    u = camera.focal_x() * x / z + camera.principal_point()[0]
    v = camera.focal_y() * y / z + camera.principal_point()[1]
    return bool(0.0 <= u <= camera.width and 0.0 <= v <= camera.height)


def _draw_ends(random: np.random.Generator) -> tuple[FloatArray, FloatArray] | None:
    # Four decimals, as the scenario has them: what is checked is what runs.
    start, goal = np.round(random.uniform(_LOW, _HIGH, (2, 3)), 4)
    if not _BASELINE[0] <= np.linalg.norm(goal - start) <= _BASELINE[1]:
        return None
    line = np.linspace(start, goal, 41)
    return None if tool_down_margin(line).min() < _REACH_MARGIN else (start, goal)


def _is_scene(start: FloatArray, goal: FloatArray, obstacles: Sequence[Obstacle]) -> bool:
    """Whether start and goal are free and the straight motion is feasible, but not clear."""
    if _line_is_far(start, goal, obstacles):
        return False
    cell = _cell()
    motion = cell.straight_motion(start, goal)
    if motion is None:
        return False
    touched = [hit for q in motion for hit in cell.contacts(q)]
    if not any(thing and depth >= _TOUCH for _, thing, depth in touched):
        return False
    if not all(thing for _, thing, _ in touched):
        return False
    return all(
        not cell.contacts(q) and cell.clearance(q) >= FREE
        for q in (motion[0], motion[-1], cell.tool_down(goal))
    )


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
