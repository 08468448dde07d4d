"""Primitive shapes of obstacles and grasped objects, as configuration blocks `!Box`, `!Cylinder`
and `!Sphere` of a scenario.
"""

from typing import Annotated, Any

import pydrake.geometry as geometry
from pydantic import Field
from pydantic.dataclasses import dataclass
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.config import BLOCK, Angles, Vector3, length

_Length = Annotated[float, Field(gt=0.0, le=10.0)]
"""Type of a dimension of a shape: a positive length of at most 10 m."""


@dataclass(config=BLOCK)
class Box:
    """Box as a shape of an obstacle or grasped object; its center is the origin of the shape's
    frame G.
    """

    size: Annotated[list[_Length], length(3)] = Field(default=[0.1, 0.1, 0.1])
    """Edge lengths of the box along x, y and z of its frame [m]."""
    translation: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Position of the box's center in the frame of the obstacle or, for a grasped object, of the
    hand [m]."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of the box in the frame of the obstacle or, for a grasped object, of the
    hand [rad]."""


@dataclass(config=BLOCK)
class Cylinder:
    """Cylinder as a shape of an obstacle or grasped object; its center is the origin of its frame
    G, and its axis is z.
    """

    radius: _Length = 0.05
    """Radius of the cylinder [m]."""
    length: _Length = 0.1
    """Length of the cylinder along its axis z [m]."""
    translation: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Position of the cylinder's center in the frame of the obstacle or, for a grasped object, of
    the hand [m]."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of the cylinder in the frame of the obstacle or, for a grasped object, of
    the hand [rad]."""


@dataclass(config=BLOCK)
class Sphere:
    """Sphere as a shape of an obstacle or grasped object; its center is the origin of the shape's
    frame G.
    """

    radius: _Length = 0.05
    """Radius of the sphere [m]."""
    translation: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Position of the sphere's center in the frame of the obstacle or, for a grasped object, of the
    hand [m]."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of the sphere in the frame of the obstacle or, for a grasped object, of
    the hand [rad]; without effect on its geometry."""


def pose(item: Any) -> RigidTransform:
    """Returns the pose of a configuration block, such as a shape, from its fields `translation` [m]
    and `rpy` [rad].
    """
    return RigidTransform(RollPitchYaw(item.rpy), item.translation)


def shape_geometry(shape: Box | Cylinder | Sphere) -> geometry.Shape:
    """Converts a shape of a scenario to the Drake shape of the same dimensions, without a pose."""
    if isinstance(shape, Box):
        return geometry.Box(*shape.size)
    if isinstance(shape, Cylinder):
        return geometry.Cylinder(shape.radius, shape.length)
    return geometry.Sphere(shape.radius)
