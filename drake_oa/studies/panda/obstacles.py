"""Random things that stand on a table: boxes, cylinders, spheres and piles of them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import Box, Cylinder, Sphere, bounding_radius, pose
from drake_oa.scenario.obstacles import Obstacle

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
