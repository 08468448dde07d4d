"""Primitive shapes of obstacles and grasped objects, as blocks of a scenario."""

from typing import Annotated, Any

import pydrake.geometry as geometry
from pydantic import Field
from pydantic.dataclasses import dataclass
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.config import BLOCK, Angles, Vector3, length

_Length = Annotated[float, Field(gt=0.0, le=10.0)]
"""Type of a positive length of at most 10 m."""


@dataclass(config=BLOCK)
class Box:
    """Box; its center is the origin of the shape's frame G."""

    size: Annotated[list[_Length], length(3)] = Field(default=[0.1, 0.1, 0.1])
    """Edge lengths along x, y and z [m]. Raising one makes the box larger."""
    translation: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Position of G in the frame of the obstacle or hand [m]. Raising it moves the shape along the
    axis."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of G in the frame of the obstacle or hand [rad]."""


@dataclass(config=BLOCK)
class Cylinder:
    """Cylinder along its z axis; its center is the origin of the shape's frame G."""

    radius: _Length = 0.05
    """Radius [m]. Raising it makes the cylinder thicker."""
    length: _Length = 0.1
    """Length along z [m]. Raising it makes the cylinder longer."""
    translation: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Position of G in the frame of the obstacle or hand [m]. Raising it moves the shape along the
    axis."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of G in the frame of the obstacle or hand [rad]."""


@dataclass(config=BLOCK)
class Sphere:
    """Sphere; its center is the origin of the shape's frame G."""

    radius: _Length = 0.05
    """Radius [m]. Raising it makes the sphere larger."""
    translation: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Position of G in the frame of the obstacle or hand [m]. Raising it moves the shape along the
    axis."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of G in the frame of the obstacle or hand [rad], without effect."""


def pose(item: Any) -> RigidTransform:
    """Returns the pose of a block with the fields `translation` [m] and `rpy` [rad]."""
    return RigidTransform(RollPitchYaw(item.rpy), item.translation)


def shape_geometry(shape: Box | Cylinder | Sphere) -> geometry.Shape:
    """Converts a shape of a scenario to a shape of Drake."""
    if isinstance(shape, Box):
        return geometry.Box(*shape.size)
    if isinstance(shape, Cylinder):
        return geometry.Cylinder(shape.radius, shape.length)
    return geometry.Sphere(shape.radius)
