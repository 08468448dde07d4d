"""Parts of random scenes of the Panda: obstacles on the table, motions, and the camera's view.

Obstacles on the table are boxes, cylinders, spheres and piles of them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.messages import FloatArray
from drake_oa.evaluation.panda.scene_arm import ELBOW_LIKE, LIKE, Motion, base_scenario, scene_arm
from drake_oa.geometry.shapes import Box, Cylinder, Sphere, pose
from drake_oa.scenario.obstacles import Obstacle

SMALLEST, LARGEST = 0.04, 0.30
"""Minimum and maximum dimension of a shape on the table, and maximum height of a pile [m]."""
FREE = 0.05
"""Minimum clearance of the whole robot at start and goal [m]."""
TOUCH = 0.009
"""Minimum penetration of the robot's spheres in contact [m]: of 5 mm of its true shapes."""
BASE_RADIUS = 0.16
"""Radius of a circle around the robot's base, seen from above [m]."""
GAP = 0.02
"""Minimum distance between the circles around two obstacles [m]."""
TABLE_X, TABLE_Y = (0.22, 0.85), (-0.60, 0.60)
"""Positions of obstacles on the table [m]."""

_PILE = 0.25
"""Probability that an obstacle is a pile."""
_LYING = 0.25
"""Probability that a cylinder lies."""
_LEANING = 0.4
"""Probability that the next shape of a pile leans on its lowest box."""
_COLORS = (
    [0.76, 0.53, 0.31, 1.0],
    [0.29, 0.46, 0.66, 1.0],
    [0.75, 0.29, 0.24, 1.0],
    [0.42, 0.60, 0.35, 1.0],
    [0.85, 0.70, 0.28, 1.0],
    [0.55, 0.42, 0.62, 1.0],
)
_BASELINE = (0.5, 1.0)
"""Distance between start and goal [m]."""
_LOW, _HIGH = (0.10, -0.70, 0.10), (0.80, 0.70, 0.50)
"""Corners of the box that contains start and goal [m]."""
_ATTEMPTS = 20
"""Attempts to place each requested obstacle."""

_DRAWN_FROM = [1.2473, 0.2902, 1.05]
"""Position in the world of the camera in whose image scenes are drawn [m], whatever perceives."""
_ROLL = {LIKE: -135.0, ELBOW_LIKE: -120.0}
"""Shipped scenario -> roll of that camera [degrees]."""

Shape = Box | Cylinder | Sphere
DrawThings = Callable[[Motion], list[Obstacle] | None]
"""Draws obstacles for a planned motion; None if they are rejected."""


def make_obstacle(
    random: Generator,
    kind: str,
    number: int,
    shapes: list[Shape],
    p_WO: Sequence[float] = (0.0, 0.0, 0.0),
) -> Obstacle:
    """Makes an obstacle at a position (3,) [m] with a random yaw, named and colored by number."""
    return Obstacle(
        name=f"{kind}{number}",
        shapes=shapes,
        translation=[round(float(v), 4) for v in p_WO],
        rpy=[0.0, 0.0, random.uniform(-math.pi, math.pi)],
        color=list(_COLORS[number % len(_COLORS)]),
    )


def draw_shape(random: Generator, smallest: float, highest: float, widest: float) -> Shape:
    """Draws a box, a cylinder or a sphere whose dimensions are within limits [m]."""
    x, y = random.uniform(smallest, widest, 2)
    z, kind = random.uniform(smallest, highest), random.integers(3)
    if kind == 0:
        return Box(size=[x, y, z])
    if kind == 1 and random.random() < _LYING:
        return Cylinder(radius=0.5 * z, length=x, rpy=[0.0, 0.5 * math.pi, 0.0])
    return Cylinder(radius=0.5 * x, length=z) if kind == 1 else Sphere(radius=0.5 * z)


def extent(shape: Shape) -> tuple[float, float]:
    """Computes radius and half height of an upright cylinder that encloses a shape [m]."""
    if isinstance(shape, Sphere):
        return shape.radius, shape.radius
    if isinstance(shape, Cylinder) and not any(shape.rpy):
        return shape.radius, 0.5 * shape.length
    size = shape.size if isinstance(shape, Box) else [2 * shape.radius] * 2 + [shape.length]
    corners = 0.5 * np.array(size) * np.array(np.meshgrid(*[[-1, 1]] * 3)).T.reshape(-1, 3)
    x, y, z = pose(shape).rotation() @ corners.T
    return np.hypot(x, y).max(), z.max()


def footprint_radius(obstacle: Obstacle) -> float:
    """Computes the radius of a circle around an obstacle's origin that encloses it [m]."""
    return max(math.hypot(*s.translation[:2]) + extent(s)[0] for s in obstacle.shapes)


def bounding_ball(obstacle: Obstacle) -> tuple[FloatArray, float]:
    """Computes center (3,), on its vertical axis, and radius of a ball around an obstacle [m]."""
    low = min(s.translation[2] - extent(s)[1] for s in obstacle.shapes)
    high = max(s.translation[2] + extent(s)[1] for s in obstacle.shapes)
    center = obstacle.translation + np.array([0.0, 0.0, 0.5 * (low + high)])
    return center, math.hypot(footprint_radius(obstacle), 0.5 * (high - low))


def _resting(shape: Shape, x: float = 0.0, y: float = 0.0, ground: float = 0.0) -> Shape:
    """Moves a shape so that its lowest point is at a height [m]."""
    return replace(shape, translation=[x, y, ground + extent(shape)[1]])


def _draw_pile(random: Generator) -> list[Shape]:
    """Draws a low box, and one to three shapes on it or leaning on it."""
    x, y = random.uniform(0.10, 0.24, 2)
    top = random.uniform(SMALLEST, 0.14)
    shapes: list[Shape] = [_resting(Box(size=[x, y, top]))]
    for _ in range(random.integers(1, 4)):
        if random.random() < _LEANING:
            tilt, length = random.uniform(0.3, 0.8), random.uniform(0.1, 0.27)
            side = random.choice([-1.0, 1.0])
            board = Box(size=[SMALLEST, 0.8 * y, length], rpy=[0.0, -side * tilt, 0.0])
            shapes.append(_resting(board, side * 0.5 * (x + length * math.sin(tilt))))
        elif LARGEST - top > SMALLEST:
            item = draw_shape(random, SMALLEST, LARGEST - top, max(min(x, y), SMALLEST))
            x_item, y_item = random.uniform(-0.02, 0.02, 2)
            shapes.append(_resting(item, x_item, y_item, top))
            top += 2.0 * extent(item)[1]
    return shapes


def draw_obstacles(random: Generator, count: int, first: int = 0) -> list[Obstacle] | None:
    """Draws obstacles on the table, apart from each other.

    Args:
        random: source of random numbers.
        count: number of obstacles.
        first: number of the first obstacle, for names and colors.

    Returns:
        The obstacles, or None if there is no room for all.
    """
    obstacles: list[Obstacle] = []
    for _ in range(_ATTEMPTS * count):
        if len(obstacles) == count:
            break
        if random.random() < _PILE:
            kind, shapes = "pile", _draw_pile(random)
        else:
            shape = draw_shape(random, SMALLEST, LARGEST, LARGEST)
            kind, shapes = type(shape).__name__.lower(), [_resting(shape)]
        x, y = (random.uniform(*side) for side in (TABLE_X, TABLE_Y))
        obstacle = make_obstacle(random, kind, first + len(obstacles), shapes, (x, y, 0.0))
        if fits(obstacle, obstacles):
            obstacles.append(obstacle)
    return obstacles if len(obstacles) == count else None


def fits(obstacle: Obstacle, others: Sequence[Obstacle], like: str = LIKE) -> bool:
    """Checks that an obstacle is off the base, apart from others, and in the camera's view.

    Args:
        obstacle: what is placed.
        others: obstacles that it must be apart from.
        like: shipped scenario whose camera must have its middle in view.
    """
    place, footprint = obstacle.translation[:2], footprint_radius(obstacle)
    apart = [math.dist(place, item.translation[:2]) - footprint_radius(item) for item in others]
    return (
        math.hypot(*place) >= footprint + BASE_RADIUS
        and min(apart, default=math.inf) >= footprint + GAP
        and bool(view_margin(bounding_ball(obstacle)[0][None], like)[0] >= 0.0)
    )


def view_margin(p_WQ: FloatArray, like: str = LIKE) -> FloatArray:
    """Computes signed distances (N,) of points (N, 3) to the border of a camera's view [m].

    They are positive inside the view.
    """
    camera, rpy = base_scenario(like).cameras[0], np.radians([_ROLL[like], 0.0, 110.0])
    x, y, z = RigidTransform(RollPitchYaw(rpy), _DRAWN_FROM).inverse() @ np.asarray(p_WQ).T
    u, v = camera.principal_point()
    sides = [
        (focal * aside + to_edge * z) / math.hypot(focal, to_edge)
        for focal, aside, to_edge in (
            (camera.focal_x(), x, u),
            (camera.focal_x(), -x, camera.width - u),
            (camera.focal_y(), y, v),
            (camera.focal_y(), -y, camera.height - v),
        )
    ]
    return np.asarray(np.min([*sides, z - camera.z_near, camera.z_far - z], axis=0))


def draw_motion(random: Generator) -> Motion | None:
    """Draws start and goal of a straight motion that the arm can follow; None if rejected."""
    # Four decimals, as in the scenario's text: the motion that is checked is the one that runs.
    start, goal = np.round(random.uniform(_LOW, _HIGH, (2, 3)), 4)
    apart = _BASELINE[0] <= math.dist(start, goal) <= _BASELINE[1]
    return scene_arm().straight_motion(start, goal) if apart else None


def ends_are_free(motion: Motion, obstacles: Sequence[Obstacle]) -> bool:
    """Checks that the whole robot is at least `FREE` from obstacles at rest at both ends."""
    return bool((scene_arm().distances(motion.ends, obstacles) >= FREE).all())
