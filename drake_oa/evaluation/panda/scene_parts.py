"""Parts of the Panda's random scenes: obstacles on the table, nominal motions, and the view of a
camera.

Obstacles on the table are boxes, cylinders, spheres, and piles of these shapes. A nominal motion is
the straight tool motion without avoidance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.random import Generator
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.messages import FloatArray
from drake_oa.evaluation.panda.scene_arm import (
    DEFAULT_SCENARIO,
    ELBOW_SCENARIO,
    Motion,
    base_scenario,
    scene_arm,
)
from drake_oa.geometry.collision_scene import CORNERS
from drake_oa.geometry.shapes import Box, Cylinder, Sphere, pose
from drake_oa.scenario.obstacles import Obstacle

MIN_SIZE = 0.04
"""Minimum dimension of a random shape on the table [m]."""
MAX_SIZE = 0.30
"""Maximum dimension of a random shape on the table, and maximum height of a pile of shapes [m]."""
MIN_END_CLEARANCE = 0.05
"""Minimum clearance of the whole robot to obstacles at start and goal of a random scene [m]."""
MIN_PENETRATION = 0.009
"""Minimum penetration of an obstacle by the robot's enclosing spheres on a nominal motion that must
collide [m]. It implies a penetration of 5 mm by the robot's true shapes."""
BASE_RADIUS = 0.16
"""Radius of a horizontal circle around the axis of the robot's base that random obstacles must not
overlap, seen from above [m]."""
MIN_GAP = 0.02
"""Minimum distance between two random obstacles, measured between circles or balls that contain
them [m]."""
TABLE_X = (0.22, 0.85)
"""Range of the x coordinates of random obstacles on the table, in the world frame [m]."""
TABLE_Y = (-0.60, 0.60)
"""Range of the y coordinates of random obstacles on the table, in the world frame [m]."""

_PILE_PROBABILITY = 0.25
"""Probability that a random obstacle on the table is a pile of several shapes."""
_LYING_PROBABILITY = 0.25
"""Probability that a random cylinder lies on its side instead of standing upright."""
_LEANING_PROBABILITY = 0.4
"""Probability that the next shape of a random pile is a board that leans on the pile's lowest box.
"""
_COLORS = (
    [0.76, 0.53, 0.31, 1.0],
    [0.29, 0.46, 0.66, 1.0],
    [0.75, 0.29, 0.24, 1.0],
    [0.42, 0.60, 0.35, 1.0],
    [0.85, 0.70, 0.28, 1.0],
    [0.55, 0.42, 0.62, 1.0],
)
"""Colors of random obstacles, in order of the obstacle's number: red, green, blue and opacity [-].
"""
_BASELINES = (0.5, 1.0)
"""Range of the distance between start and goal of a random nominal motion, a straight tool motion
[m]."""
_LOWER_CORNER = (0.10, -0.70, 0.10)
"""Lower corner of the box from which start and goal of a random nominal motion are drawn, in the
world [m]."""
_UPPER_CORNER = (0.80, 0.70, 0.50)
"""Upper corner of the box from which start and goal of a random nominal motion are drawn, in the
world [m]."""
_ATTEMPTS = 20
"""Maximum number of attempts to place random obstacles on the table, per requested obstacle."""

_CAMERA_POSITION = [1.2473, 0.2902, 1.05]
"""Position in the world of the camera whose view must contain the centers of random obstacles [m].
The condition applies even if another source perceives the obstacles."""
_CAMERA_ROLL = {DEFAULT_SCENARIO: -135.0, ELBOW_SCENARIO: -120.0}
"""Name of a shipped scenario -> roll angle in the world of the camera whose view must contain the
centers of random obstacles [degrees]. The camera's frame has z forward and y down; its pitch is 0
and its yaw 110 degrees."""

Shape = Box | Cylinder | Sphere
"""Type of the primitive shapes that random obstacles consist of."""
DrawObjects = Callable[[Motion], list[Obstacle] | None]
"""Function that draws the obstacles of a random scene for a nominal motion; its result is None if
the draw is rejected."""


def make_obstacle(
    random: Generator,
    kind: str,
    number: int,
    shapes: list[Shape],
    p_WO: Sequence[float] = (0.0, 0.0, 0.0),
) -> Obstacle:
    """Makes an obstacle of a random scene with a random yaw, and a name and color by number.

    Args:
        random: source of random numbers.
        kind: first part of the obstacle's name.
        number: number of the obstacle, which is the second part of its name and selects its color.
        shapes: primitive shapes in the obstacle's frame.
        p_WO: (3,) position of the obstacle's frame in the world [m].
    """
    return Obstacle(
        name=f"{kind}{number}",
        shapes=shapes,
        translation=[round(float(v), 4) for v in p_WO],
        rpy=[0.0, 0.0, random.uniform(-math.pi, math.pi)],
        color=list(_COLORS[number % len(_COLORS)]),
    )


def draw_shape(random: Generator, min_size: float, max_height: float, max_width: float) -> Shape:
    """Draws a random box, cylinder or sphere whose dimensions are within limits.

    Args:
        random: source of random numbers.
        min_size: minimum of all dimensions [m].
        max_height: maximum height of a box or standing cylinder, and maximum diameter of a sphere
            or lying cylinder [m].
        max_width: maximum horizontal edge of a box, diameter of a standing cylinder, and length of
            a lying cylinder [m].
    """
    x, y = random.uniform(min_size, max_width, 2)
    z, kind = random.uniform(min_size, max_height), random.integers(3)
    if kind == 0:
        return Box(size=[x, y, z])
    if kind == 1 and random.random() < _LYING_PROBABILITY:
        return Cylinder(radius=0.5 * z, length=x, rpy=[0.0, 0.5 * math.pi, 0.0])
    return Cylinder(radius=0.5 * x, length=z) if kind == 1 else Sphere(radius=0.5 * z)


def extent(shape: Shape) -> tuple[float, float]:
    """Computes radius and half height of an upright cylinder that contains a shape, about the
    shape's center [m].
    """
    if isinstance(shape, Sphere):
        return shape.radius, shape.radius
    if isinstance(shape, Cylinder) and not any(shape.rpy):
        return shape.radius, 0.5 * shape.length
    size = shape.size if isinstance(shape, Box) else [2 * shape.radius] * 2 + [shape.length]
    x, y, z = pose(shape).rotation() @ (0.5 * np.array(size) * CORNERS).T
    return np.hypot(x, y).max(), z.max()


def footprint_radius(obstacle: Obstacle) -> float:
    """Computes the radius of a horizontal circle about an obstacle's origin that contains the
    obstacle seen from above [m].
    """
    return max(math.hypot(*s.translation[:2]) + extent(s)[0] for s in obstacle.shapes)


def bounding_ball(obstacle: Obstacle) -> tuple[FloatArray, float]:
    """Computes a ball that contains an obstacle at its initial position.

    Returns:
        Center (3,) of the ball in the world, vertically above the obstacle's origin, and its radius
        [m].
    """
    low = min(s.translation[2] - extent(s)[1] for s in obstacle.shapes)
    high = max(s.translation[2] + extent(s)[1] for s in obstacle.shapes)
    center = obstacle.translation + np.array([0.0, 0.0, 0.5 * (low + high)])
    return center, math.hypot(footprint_radius(obstacle), 0.5 * (high - low))


def _rest_on(shape: Shape, x: float = 0.0, y: float = 0.0, ground: float = 0.0) -> Shape:
    """Returns a copy of a shape with its center at (x, y) and its lowest point at height `ground`
    [m], in the obstacle's frame. The origin of this frame is on the table.
    """
    return replace(shape, translation=[x, y, ground + extent(shape)[1]])


def _draw_pile(random: Generator) -> list[Shape]:
    """Draws the shapes of a random pile: a low box, and one to three shapes that stand or lean on
    it.
    """
    x, y = random.uniform(0.10, 0.24, 2)
    top = random.uniform(MIN_SIZE, 0.14)
    shapes: list[Shape] = [_rest_on(Box(size=[x, y, top]))]
    for _ in range(random.integers(1, 4)):
        if random.random() < _LEANING_PROBABILITY:
            tilt, length = random.uniform(0.3, 0.8), random.uniform(0.1, 0.27)
            side = random.choice([-1.0, 1.0])
            board = Box(size=[MIN_SIZE, 0.8 * y, length], rpy=[0.0, -side * tilt, 0.0])
            shapes.append(_rest_on(board, side * 0.5 * (x + length * math.sin(tilt))))
        elif MAX_SIZE - top > MIN_SIZE:
            item = draw_shape(random, MIN_SIZE, MAX_SIZE - top, max(min(x, y), MIN_SIZE))
            x_item, y_item = random.uniform(-0.02, 0.02, 2)
            shapes.append(_rest_on(item, x_item, y_item, top))
            top += 2.0 * extent(item)[1]
    return shapes


def draw_obstacles(random: Generator, count: int, first: int = 0) -> list[Obstacle] | None:
    """Draws random obstacles that rest on the table, in view of the camera, and do not overlap.

    Args:
        random: source of random numbers.
        count: number of obstacles.
        first: number of the first obstacle; numbers determine names and colors.

    Returns:
        The obstacles, or None if not all of them could be placed.
    """
    obstacles: list[Obstacle] = []
    for _ in range(_ATTEMPTS * count):
        if len(obstacles) == count:
            break
        if random.random() < _PILE_PROBABILITY:
            kind, shapes = "pile", _draw_pile(random)
        else:
            shape = draw_shape(random, MIN_SIZE, MAX_SIZE, MAX_SIZE)
            kind, shapes = type(shape).__name__.lower(), [_rest_on(shape)]
        x, y = (random.uniform(*side) for side in (TABLE_X, TABLE_Y))
        obstacle = make_obstacle(random, kind, first + len(obstacles), shapes, (x, y, 0.0))
        if fits(obstacle, obstacles):
            obstacles.append(obstacle)
    return obstacles if len(obstacles) == count else None


def fits(obstacle: Obstacle, others: Sequence[Obstacle], like: str = DEFAULT_SCENARIO) -> bool:
    """Checks whether an obstacle is apart from the robot's base and from other obstacles, and in
    view of a camera.

    Circles around obstacles must be outside the circle of radius `BASE_RADIUS` (16 cm) around the
    base and at least `MIN_GAP` (2 cm) apart. The camera must have the obstacle's center in view.

    Args:
        obstacle: obstacle to place.
        others: obstacles that are placed already.
        like: name of the shipped scenario that has the camera.
    """
    place, footprint = obstacle.translation[:2], footprint_radius(obstacle)
    apart = [math.dist(place, item.translation[:2]) - footprint_radius(item) for item in others]
    return (
        math.hypot(*place) >= footprint + BASE_RADIUS
        and min(apart, default=math.inf) >= footprint + MIN_GAP
        and bool(view_margin(bounding_ball(obstacle)[0][None], like)[0] >= 0.0)
    )


def view_margin(p_WQ: FloatArray, like: str = DEFAULT_SCENARIO) -> FloatArray:
    """Computes signed distances from points to the border of a camera's view volume, positive
    inside [m].

    The camera's minimum and maximum depth also bound the view volume.

    Args:
        p_WQ: (N, 3) points in the world [m].
        like: name of the shipped scenario that has the camera.

    Returns:
        (N,) signed distances [m].
    """
    camera, rpy = base_scenario(like).cameras[0], np.radians([_CAMERA_ROLL[like], 0.0, 110.0])
    x, y, z = RigidTransform(RollPitchYaw(rpy), _CAMERA_POSITION).inverse() @ np.asarray(p_WQ).T
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
    """Draws a random straight tool motion of 0.5 to 1.0 m, which is the nominal motion of a scene.

    Returns:
        The motion; None if its length is out of range or the arm cannot follow it.
    """
    # Four decimals, as in the scenario's text, so that the checked motion is the executed one.
    start, goal = np.round(random.uniform(_LOWER_CORNER, _UPPER_CORNER, (2, 3)), 4)
    apart = _BASELINES[0] <= math.dist(start, goal) <= _BASELINES[1]
    return scene_arm().straight_motion(start, goal) if apart else None


def ends_are_free(motion: Motion, obstacles: Sequence[Obstacle]) -> bool:
    """Checks whether the robot has a clearance of at least 5 cm (`MIN_END_CLEARANCE`) to resting
    obstacles at the start and goal of a motion.
    """
    return bool((scene_arm().distances(motion.ends, obstacles) >= MIN_END_CLEARANCE).all())
