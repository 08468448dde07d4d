"""What random scenes of the Panda have in common: their world, and what they are drawn from.

Every kind draws by one skeleton: attempts until one gives a scene (`first_drawn`), each with a
motion (`draw_ends`, `draw_motion`) and things (`draw_obstacles`) that are tried for it, and a
tally of what was dropped and why. Which numbers are drawn, and in which order, is part of a scene.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from functools import lru_cache

import numpy as np
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.annulus import Annulus, sector_margin
from drake_oa.robot.plant import make_robot_plant
from drake_oa.robot.tool_down import given_annulus
from drake_oa.scenario.loading import load_scenario, parse_scenario
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.obstacles import draw_obstacle, footprint_radius, middle
from drake_oa.studies.panda.planning_scene import PlanningScene
from drake_oa.studies.tally import Tally

FREE = 0.05
"""Clearance of the whole robot at start and goal [m]."""
TOUCH = 5e-3
"""How far a link must go into an obstacle on the straight motion [m]."""
BASE_RADIUS = 0.16
"""Of a circle round the robot's base, seen from above [m]."""
GAP = 0.02
"""Between the circles round two obstacles [m]."""
TABLE_X, TABLE_Y = (0.22, 0.85), (-0.60, 0.60)
"""Where obstacles stand, seen from above [m]: their circles may reach beyond."""

Drawn = tuple[list[Obstacle], FloatArray, FloatArray]
"""Obstacles, start and goal of a scene."""

LIKE = "tabletop_box"
"""The shipped scenario whose robot, camera and constants scenes have."""
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
_MOST_PLACES = 20
"""Obstacles tried for each that is asked for."""

# Why candidates are dropped.
ON_BASE = "at the robot's base"
TOO_NEAR = "nearer than 2 cm to another thing"
OUT_OF_VIEW = "out of the camera's view"
NOT_FOLLOWED = "the arm cannot follow the straight line"
TOUCHES_TABLE = "the planned motion touches the table"
ENDS_TAKEN = "start or goal leave the robot less than 5 cm"

drawing = threading.Lock()
"""There is one cell a process, and a cluster's worker may have threads."""


@lru_cache(maxsize=4)
def base_scenario(like: str = LIKE) -> Scenario:
    """A shipped scenario, with nothing but table and camera in its world."""
    scenario = load_scenario(like)
    scenario.directives = parse_scenario(_CELL).directives
    scenario.obstacles = []
    return scenario


@lru_cache(maxsize=1)
def planning_scene() -> PlanningScene:
    """The robot on its table; to be asked under `drawing` only."""
    return PlanningScene(base_scenario())


def first_drawn(attempt: Callable[[], Drawn | None], most: int, what: str) -> Drawn:
    """The first scene that an attempt gives.

    Raises:
        RuntimeError: if none of so many did.
    """
    for _ in range(most):
        drawn = attempt()
        if drawn is not None:
            return drawn
    raise RuntimeError(f"no scene of {what} found in {most} attempts")


def draw_obstacles(random: np.random.Generator, count: int, tally: Tally) -> list[Obstacle] | None:
    """Obstacles apart from each other on the table, or None where there is no room for all."""
    obstacles: list[Obstacle] = []
    if not count:
        return obstacles
    for _ in range(_MOST_PLACES * count):
        obstacle = draw_obstacle(random, len(obstacles))
        x, y = (float(random.uniform(*side)) for side in (TABLE_X, TABLE_Y))
        obstacle.translation = [round(x, 4), round(y, 4), 0.0]
        if tally.takes("places on the table", _misfit(obstacle, obstacles)):
            obstacles.append(obstacle)
        if len(obstacles) == count:
            return obstacles
    return None


def _misfit(obstacle: Obstacle, others: Sequence[Obstacle]) -> str:
    """Why it cannot stand there; "": it stands in view, beside the robot's base and the others."""
    if math.hypot(*obstacle.translation[:2]) < footprint_radius(obstacle) + BASE_RADIUS:
        return ON_BASE
    if not stands_apart(obstacle, others):
        return TOO_NEAR
    return "" if in_view(middle(obstacle)) else OUT_OF_VIEW


def stands_apart(obstacle: Obstacle, others: Sequence[Obstacle]) -> bool:
    """Whether the circle round it, seen from above, keeps `GAP` to those round the others."""
    place, radius = obstacle.translation[:2], footprint_radius(obstacle)
    return all(
        math.dist(place, other.translation[:2]) >= radius + footprint_radius(other) + GAP
        for other in others
    )


def in_view(p_WQ: FloatArray, like: str = LIKE) -> bool:
    """Whether a point is in the image of a shipped scenario's camera."""
    camera, (x, y, z) = _seen_from_camera(p_WQ, like)
    if not camera.z_near < z < camera.z_far:
        return False
    u = camera.focal_x() * x / z + camera.principal_point()[0]
    v = camera.focal_y() * y / z + camera.principal_point()[1]
    return bool(0.0 <= u <= camera.width and 0.0 <= v <= camera.height)


def is_outside_image(p_WQ: FloatArray, radius: float, like: str = LIKE) -> bool:
    """Whether a ball round a point is wholly outside the image, near and far alike [m]."""
    camera, (x, y, z) = _seen_from_camera(p_WQ, like)
    u, v = camera.principal_point()
    return any(
        (focal * aside - to_edge * z) / math.hypot(focal, to_edge) > radius
        for focal, aside, to_edge in (
            (camera.focal_x(), -x, u),
            (camera.focal_x(), x, camera.width - u),
            (camera.focal_y(), -y, v),
            (camera.focal_y(), y, camera.height - v),
        )
    )


def _seen_from_camera(p_WQ: FloatArray, like: str) -> tuple[CameraConfig, FloatArray]:
    """The camera of a shipped scenario, and the point in its frame [m]."""
    camera = base_scenario(like).cameras[0]
    X_WC = planning_scene().frame_pose(camera.X_PB.base_frame) @ camera.X_PB.GetDeterministicValue()
    return camera, X_WC.inverse() @ p_WQ


def draw_ends(random: np.random.Generator, tally: Tally) -> tuple[FloatArray, FloatArray] | None:
    """Start and goal of a motion within the tool-down workspace, or None."""
    # Four decimals, as the scenario has them: what is checked is what runs.
    start, goal = np.round(random.uniform(_LOW, _HIGH, (2, 3)), 4)
    return (start, goal) if tally.takes("pairs of start and goal", _not_ends(start, goal)) else None


@lru_cache(maxsize=1)
def _workspace() -> tuple[Annulus, float]:
    """The tool-down workspace about the base, and the first joint's limit [rad]."""
    robot = base_scenario().robot
    annulus = None if robot is None else given_annulus(robot)
    if robot is None or annulus is None:
        raise RuntimeError(f"{LIKE}: scenes are drawn in the robot's annulus, and it has none")
    return annulus, float(make_robot_plant(robot).plant.GetPositionUpperLimits()[0])


def _not_ends(start: FloatArray, goal: FloatArray) -> str:
    if not _BASELINE[0] <= np.linalg.norm(goal - start) <= _BASELINE[1]:
        return "not 0.5 to 1.0 m apart"
    if sector_margin(np.linspace(start, goal, 41), *_workspace()).min() < _REACH_MARGIN:
        return "the line leaves the workspace of a tool that points down"
    return ""


def draw_motion(
    random: np.random.Generator, tally: Tally
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """(3,) start, (3,) goal and the (T, nq) straight motion between them, or None."""
    ends = draw_ends(random, tally)
    if ends is None:
        return None
    motion = planning_scene().straight_motion(*ends)
    taken = tally.takes("straight motions", NOT_FOLLOWED if motion is None else "")
    return (*ends, motion) if taken and motion is not None else None


def ends_are_free(motion: FloatArray, goal: FloatArray) -> bool:
    """Whether the whole robot keeps `FREE` to what was put at both ends of a motion.

    Args:
        motion: (T, nq) positions of the robot in `planning_scene`.
        goal: (3,) where the motion ends [m]: the robot is posed there in one step, too.
    """
    cell = planning_scene()
    return all(
        not cell.contacts(q) and cell.clearance(q) >= FREE
        for q in (motion[0], motion[-1], cell.tool_down(goal))
    )
