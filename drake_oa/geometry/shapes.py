"""Primitive shapes of obstacles and of what the hand holds, as blocks of a scenario."""

import dataclasses as dc
import math
from typing import Protocol

import pydrake.geometry as geometry
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.config import ScenarioError, number, roll_pitch_yaw, vector

_LARGEST = 10.0


@dc.dataclass
class Box:
    """A box; its centre is the shape's origin."""

    # Edges along x, y and z [m].
    size: list[float] = vector([0.1, 0.1, 0.1], "m")
    # Pose of the shape in the obstacle: translation [m], roll, pitch, yaw [rad].
    translation: list[float] = vector([0.0, 0.0, 0.0], "m")
    rpy: list[float] = roll_pitch_yaw([0.0, 0.0, 0.0])


@dc.dataclass
class Cylinder:
    """A cylinder along its z axis; its centre is the shape's origin."""

    radius: float = number(0.05, "m", 0.0, _LARGEST, open_low=True)
    length: float = number(0.1, "m", 0.0, _LARGEST, open_low=True)
    translation: list[float] = vector([0.0, 0.0, 0.0], "m")
    rpy: list[float] = roll_pitch_yaw([0.0, 0.0, 0.0])


@dc.dataclass
class Sphere:
    """A sphere; its centre is the shape's origin."""

    radius: float = number(0.05, "m", 0.0, _LARGEST, open_low=True)
    translation: list[float] = vector([0.0, 0.0, 0.0], "m")
    rpy: list[float] = roll_pitch_yaw([0.0, 0.0, 0.0])


def check_shapes(shapes: list[Box | Cylinder | Sphere], where: str) -> None:
    """Refuses a box whose edges are out of range.

    Raises:
        ScenarioError: naming the shape.
    """
    for place, shape in enumerate(shapes):
        if isinstance(shape, Box) and not all(0.0 < edge <= _LARGEST for edge in shape.size):
            raise ScenarioError(
                f"{where}[{place}].size: {shape.size} is outside (0, {_LARGEST:g}] [m]"
            )


class Placed(Protocol):
    """What has a place: a translation [m], and roll, pitch, yaw [rad]."""

    translation: list[float]
    rpy: list[float]


def pose(item: Placed) -> RigidTransform:
    """Pose of a shape in its obstacle, X_OG, or of an obstacle or a base in the world."""
    return RigidTransform(RollPitchYaw(item.rpy), item.translation)


def bounding_radius(shape: Box | Cylinder | Sphere) -> float:
    """Radius of the sphere round a shape's centre that holds it [m]."""
    if isinstance(shape, Box):
        return 0.5 * math.hypot(*shape.size)
    if isinstance(shape, Cylinder):
        return math.hypot(shape.radius, 0.5 * shape.length)
    return shape.radius


def shape_geometry(shape: Box | Cylinder | Sphere) -> geometry.Shape:
    """Drake's shape."""
    if isinstance(shape, Box):
        return geometry.Box(*shape.size)
    if isinstance(shape, Cylinder):
        return geometry.Cylinder(shape.radius, shape.length)
    return geometry.Sphere(shape.radius)
