"""Parts of random scenes of the Panda: their world, the things in it, and how they are drawn.

Every kind draws by one skeleton: attempts until one gives a scene (`first_drawn`), each with a
motion (`draw_ends`, `draw_motion`) and things (`draw_obstacles`) that are tried for it, and a
tally of what was dropped and why. Things on the table are boxes, cylinders, spheres and piles of
them (`draw_obstacle`). Which numbers are drawn, and in which order, is part of a scene.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.annulus import Annulus, sector_margin
from drake_oa.geometry.shapes import Box, Cylinder, Sphere, bounding_radius, pose
from drake_oa.robot.plant import make_robot_plant
from drake_oa.robot.tool_down import given_annulus
from drake_oa.scenario.loading import load_scenario, parse_scenario
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.cameras import camera_pose
from drake_oa.studies.panda.planning_scene import PlanningScene
from drake_oa.studies.results import Tally

SMALLEST, LARGEST = 0.04, 0.30
"""Least and largest dimension of a shape [m]; a pile is no higher than the largest."""

_Shape = Box | Cylinder | Sphere
COLORS = (
    [0.76, 0.53, 0.31, 1.0],
    [0.29, 0.46, 0.66, 1.0],
    [0.75, 0.29, 0.24, 1.0],
    [0.42, 0.60, 0.35, 1.0],
    [0.85, 0.70, 0.28, 1.0],
    [0.55, 0.42, 0.62, 1.0],
)


def draw_obstacle(random: np.random.Generator, number: int) -> Obstacle:
    """One random obstacle, standing on the plane z = 0, round the z axis.

    A box, a cylinder (upright or lying), a sphere and a pile are equally likely; each
    dimension is uniform within `SMALLEST` and `LARGEST`. A pile is a low box with one to
    three things stacked on it or leaning against it.

    Args:
        random: where the numbers come from.
        number: its place among the obstacles: name and colour follow from it.
    """
    kind = ("box", "cylinder", "sphere", "pile")[random.integers(4)]
    shapes = _draw_pile(random) if kind == "pile" else [_standing(_draw_shape(random, kind))]
    return Obstacle(
        name=f"{kind}{number}",
        shapes=shapes,
        rpy=[0.0, 0.0, float(random.uniform(-math.pi, math.pi))],
        color=list(COLORS[number % len(COLORS)]),
    )


def _draw_shape(
    random: np.random.Generator, kind: str, largest: float = LARGEST, width: float = LARGEST
) -> _Shape:
    """A shape no higher than `largest` and no wider than `width` [m]."""
    height = float(random.uniform(SMALLEST, largest))
    if kind == "box":
        x, y = random.uniform(SMALLEST, width, 2)
        return Box(size=[float(x), float(y), height])
    if kind == "sphere":
        return Sphere(radius=0.5 * min(height, width))
    across = float(random.uniform(SMALLEST, width))
    if random.random() < 0.25:
        # It lies: `across` is its length, its height the diameter.
        return Cylinder(radius=0.5 * min(height, width), length=across, rpy=[0.0, math.pi / 2, 0.0])
    return Cylinder(radius=0.5 * across, length=height)


def _standing(shape: _Shape, ground: float = 0.0) -> _Shape:
    """The shape lifted so that its lowest point is at height `ground`."""
    x, y, _ = shape.translation
    return replace(shape, translation=[x, y, ground + half_height(shape)])


def half_height(shape: _Shape) -> float:
    """Height of the shape's highest point over its centre [m]."""
    z_S = pose(shape).rotation().matrix()[2]
    if isinstance(shape, Box):
        return 0.5 * float(np.abs(z_S) @ np.asarray(shape.size))
    if isinstance(shape, Cylinder):
        return 0.5 * shape.length * abs(z_S[2]) + shape.radius * math.hypot(z_S[0], z_S[1])
    return shape.radius


def _draw_pile(random: np.random.Generator) -> list[_Shape]:
    """A low box at the bottom, and one to three shapes on it or leaning on its sides."""
    x, y = (float(v) for v in random.uniform(0.10, 0.24, 2))
    bottom = Box(size=[x, y, float(random.uniform(SMALLEST, 0.14))])
    shapes: list[_Shape] = [_standing(bottom)]
    top, width, side = bottom.size[2], min(x, y), 1
    for _ in range(random.integers(1, 4)):
        room = LARGEST - top
        if random.random() < 0.4 and side >= -1:
            shapes.append(_leaning(random, bottom, side))
            side -= 2
        elif room > SMALLEST:
            kind = ("box", "cylinder", "sphere")[random.integers(3)]
            item = _draw_shape(random, kind, room, max(width, SMALLEST))
            item.rpy = [item.rpy[0], item.rpy[1], float(random.uniform(-math.pi, math.pi))]
            item.translation = [float(v) for v in random.uniform(-0.02, 0.02, 2)] + [0.0]
            shapes.append(_standing(item, top))
            top += 2.0 * half_height(item)
            width = 0.0 if isinstance(item, Sphere) else 0.8 * width
    return shapes


def _leaning(random: np.random.Generator, bottom: Box, side: int) -> Box:
    """A board whose foot is on the table and that rests on an upper edge of the bottom box.

    Args:
        random: where the numbers come from.
        bottom: what it leans on; its sides face along x and y.
        side: 1 for its side towards x, -1 for the other.
    """
    tilt = float(random.uniform(0.3, 0.8))
    height = bottom.size[2]
    # Its inner face meets the edge above the foot, and it is no higher than a pile may be.
    shortest = height / math.cos(tilt) + 0.02
    thickness = SMALLEST
    longest = min(LARGEST, (LARGEST - thickness * math.sin(tilt)) / math.cos(tilt))
    length = float(random.uniform(min(shortest, longest), longest))
    size = [thickness, float(random.uniform(SMALLEST, bottom.size[1])), length]
    board = Box(size=size, rpy=[0.0, -side * tilt, 0.0])
    # The foot of the inner face is this far from the middle; then half the board's length
    # up along it and half its thickness out of it.
    foot = 0.5 * bottom.size[0] + height * math.tan(tilt)
    x = foot - 0.5 * length * math.sin(tilt) + 0.5 * thickness * math.cos(tilt)
    board.translation = [side * x, 0.0, half_height(board)]
    return board


def footprint_radius(obstacle: Obstacle) -> float:
    """Radius of the circle round the obstacle's origin that holds it, seen from above [m]."""
    return max(math.hypot(*s.translation[:2]) + _half_width(s) for s in obstacle.shapes)


def _half_width(shape: _Shape) -> float:
    """Radius of the upright cylinder round the shape's centre that holds it [m]."""
    if isinstance(shape, Sphere):
        return shape.radius
    R_WS = pose(shape).rotation().matrix()
    if isinstance(shape, Box):
        half = 0.5 * np.asarray(shape.size)
        signs = np.array([[1, 1, 1], [1, 1, -1], [1, -1, 1], [-1, 1, 1]])
        return float(np.linalg.norm((signs * half) @ R_WS.T[:, :2], axis=1).max())
    if abs(R_WS[2, 2]) > 1.0 - 1e-9:
        return shape.radius
    return bounding_radius(shape)


def height(obstacle: Obstacle) -> float:
    """Height of the obstacle's highest point [m]."""
    return max(s.translation[2] + half_height(s) for s in obstacle.shapes)


def middle(obstacle: Obstacle) -> FloatArray:
    """(3,) the point on the obstacle's axis at half its height, in the world [m]."""
    return np.array([*obstacle.translation[:2], 0.5 * height(obstacle)])


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


def first_on_motion(
    random: np.random.Generator,
    tally: Tally,
    draw_things: Callable[[FloatArray, FloatArray, FloatArray], list[Obstacle] | None],
    most: int,
    what: str,
) -> Drawn:
    """Draws motions until things are found for one.

    Args:
        random: where the numbers come from.
        tally: counts what is dropped.
        draw_things: of (3,) start, (3,) goal and the (T, nq) straight motion, draws obstacles.
        most: so many motions are tried.
        what: names the things for the error.

    Raises:
        RuntimeError: if none were found.
    """

    def attempt() -> Drawn | None:
        drawn = draw_motion(random, tally)
        obstacles = None if drawn is None else draw_things(*drawn)
        return None if drawn is None or obstacles is None else (obstacles, drawn[0], drawn[1])

    return first_drawn(attempt, most, what)


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
    camera, X_WC = _camera(like)
    x, y, z = X_WC.inverse() @ p_WQ
    if not camera.z_near < z < camera.z_far:
        return False
    u = camera.focal_x() * x / z + camera.principal_point()[0]
    v = camera.focal_y() * y / z + camera.principal_point()[1]
    return bool(0.0 <= u <= camera.width and 0.0 <= v <= camera.height)


def is_outside_image(p_WQ: FloatArray, radius: float, like: str = LIKE) -> bool:
    """Whether a ball round a point is wholly outside the image, near and far alike [m]."""
    camera, X_WC = _camera(like)
    x, y, z = X_WC.inverse() @ p_WQ
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


@lru_cache(maxsize=4)
def _camera(like: str) -> tuple[CameraConfig, RigidTransform]:
    """The camera of a shipped scenario, and its pose in the world."""
    scenario = base_scenario(like)
    return scenario.cameras[0], camera_pose(scenario, scenario.cameras[0])


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
        not cell.contacts(q) and not cell.nearby(q, FREE)
        for q in (motion[0], motion[-1], cell.tool_down(goal))
    )
