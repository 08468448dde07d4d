"""Obstacles written in a scenario: primitive shapes that stand in the world."""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
import math
from collections.abc import Iterable

import numpy as np
import pydrake.geometry as geometry
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, SpatialInertia, UnitInertia

from drake_oa.moving_obstacles import check_present, check_waypoints, hang_on_slides, offset_at
from drake_oa.scenario_fields import number, vector
from drake_oa.schema_check import ScenarioError
from drake_oa.values import FloatArray

OBSTACLE_PREFIX = "obstacle"
"""Obstacles are the model instances whose name starts with this."""

_FRICTION = 0.7
_LARGEST = 10.0


@dc.dataclass
class Box:
    """A box; its centre is the shape's origin."""

    # Edges along x, y and z [m].
    size: list[float] = vector([0.1, 0.1, 0.1], "m")
    # Pose of the shape in the obstacle: translation [m], roll, pitch, yaw [rad].
    translation: list[float] = vector([0.0, 0.0, 0.0], "m")
    rpy: list[float] = vector([0.0, 0.0, 0.0], "rad")


@dc.dataclass
class Cylinder:
    """A cylinder along its z axis; its centre is the shape's origin."""

    radius: float = number(0.05, "m", 0.0, _LARGEST, open_low=True)
    length: float = number(0.1, "m", 0.0, _LARGEST, open_low=True)
    translation: list[float] = vector([0.0, 0.0, 0.0], "m")
    rpy: list[float] = vector([0.0, 0.0, 0.0], "rad")


@dc.dataclass
class Sphere:
    """A sphere; its centre is the shape's origin."""

    radius: float = number(0.05, "m", 0.0, _LARGEST, open_low=True)
    translation: list[float] = vector([0.0, 0.0, 0.0], "m")
    rpy: list[float] = vector([0.0, 0.0, 0.0], "rad")


@dc.dataclass
class Obstacle:
    """One thing that stands in the world; several shapes make a pile, which is one obstacle."""

    # The model instance is named "obstacle_<name>".
    name: str = ""
    shapes: list[Box | Cylinder | Sphere] = dc.field(default_factory=list)
    # Pose of the obstacle in the world: translation [m], roll, pitch, yaw [rad].
    translation: list[float] = vector([0.0, 0.0, 0.0], "m")
    rpy: list[float] = vector([0.0, 0.0, 0.0], "rad")
    # Red, green, blue and opacity, 0 to 1.
    color: list[float] = vector([0.76, 0.53, 0.31, 1.0], "1")
    # Where it moves: rows [t, x, y, z], at time t [s] it is that far from `translation`, in
    # the world [m]. Straight between, at rest before and after; without any it stands still.
    waypoints: list[list[float]] = dc.field(default_factory=list)
    # When it is there: [from], or [from, until] [s]; empty: always. It appears and vanishes
    # within a step of the plant.
    present: list[float] = dc.field(default_factory=list, metadata={"unit": "s"})
    # Stiffness of its surface in a point contact [N/m]; null: Drake's default, which is hard.
    stiffness: float | None = dc.field(
        default=None, metadata={"unit": "N/m", "low": 0.0, "high": 1e12, "open_low": True}
    )

    @property
    def driven(self) -> bool:
        """Whether it moves, appears or vanishes: then it hangs on slides."""
        return bool(self.waypoints or self.present)

    @property
    def last_change(self) -> float:
        """When it has ended its course, and comes and goes no more [s]; 0: it never moves."""
        return max([0.0, *(waypoint[0] for waypoint in self.waypoints), *self.present])

    def offset_at(self, time: float) -> FloatArray:
        """(3,) how far from `translation` it is at a time [s], in the world [m]."""
        course = np.array(self.waypoints, dtype=float).reshape(-1, 4)
        return offset_at(course, time, self.present)


def last_change(obstacles: Iterable[Obstacle]) -> float:
    """When all have ended their courses, and come and go no more [s]; 0: none ever moves."""
    return max((obstacle.last_change for obstacle in obstacles), default=0.0)


def check_obstacles(obstacles: list[Obstacle]) -> None:
    """What no single field of an `obstacles` block can tell.

    Raises:
        ScenarioError: for a name that is missing or taken twice, an obstacle without
            shapes, and a box's edge or a colour out of range.
    """
    names = [obstacle.name for obstacle in obstacles]
    for row, obstacle in enumerate(obstacles):
        where = f"obstacles[{row}]"
        if not obstacle.name:
            raise ScenarioError(f"{where}.name: is empty; each obstacle needs a name of its own")
        if obstacle.name in names[:row]:
            raise ScenarioError(f"{where}.name: two obstacles are named '{obstacle.name}'")
        if not obstacle.shapes:
            raise ScenarioError(
                f"{where}.shapes: is empty; it needs at least one of !Box, !Cylinder, !Sphere"
            )
        check_waypoints(obstacle.waypoints, f"{where}.waypoints")
        check_present(obstacle.present, f"{where}.present")
        if not all(0.0 <= value <= 1.0 for value in obstacle.color):
            raise ScenarioError(f"{where}.color: {obstacle.color} is outside [0, 1]")
        check_shapes(obstacle.shapes, f"{where}.shapes")


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


def shape_geometry(shape: Box | Cylinder | Sphere) -> geometry.Shape:
    """Drake's shape."""
    if isinstance(shape, Box):
        return geometry.Box(*shape.size)
    if isinstance(shape, Cylinder):
        return geometry.Cylinder(shape.radius, shape.length)
    return geometry.Sphere(shape.radius)


def pose(item: Box | Cylinder | Sphere | Obstacle) -> RigidTransform:
    """Pose of a shape in its obstacle, X_OG, or of an obstacle in the world, X_WO."""
    return RigidTransform(RollPitchYaw(item.rpy), item.translation)


def add_obstacle(plant: MultibodyPlant, obstacle: Obstacle) -> ModelInstanceIndex:
    """Adds an obstacle as model instance `obstacle_<name>`: welded, or on driven slides.

    Args:
        plant: registered with a scene graph and not finalized.
        obstacle: see `check_obstacles`.

    Raises:
        ScenarioError: if the world has a model instance of that name.
    """
    name = f"{OBSTACLE_PREFIX}_{obstacle.name}"
    if plant.HasModelInstanceNamed(name):
        raise ScenarioError(f"obstacles: the world already has a model instance '{name}'")
    instance = plant.AddModelInstance(name)
    # Welded or driven on its course: its inertia decides nothing.
    body = plant.AddRigidBody(
        "body", instance, SpatialInertia(1.0, [0.0, 0.0, 0.0], UnitInertia.SolidSphere(0.1))
    )
    properties = geometry.ProximityProperties()
    geometry.AddContactMaterial(
        dissipation=None,
        point_stiffness=obstacle.stiffness,
        friction=CoulombFriction(_FRICTION, _FRICTION),
        properties=properties,
    )
    for row, item in enumerate(obstacle.shapes):
        X_OG, shape = pose(item), shape_geometry(item)
        plant.RegisterVisualGeometry(body, X_OG, shape, f"visual{row}", obstacle.color)
        plant.RegisterCollisionGeometry(body, X_OG, shape, f"collision{row}", properties)
    if obstacle.driven:
        hang_on_slides(plant, body, pose(obstacle), obstacle.offset_at(0.0).tolist())
    else:
        plant.WeldFrames(plant.world_frame(), body.body_frame(), pose(obstacle))
    return instance


def bounding_radius(shape: Box | Cylinder | Sphere) -> float:
    """Radius of the sphere round a shape's centre that holds it [m]."""
    if isinstance(shape, Box):
        return 0.5 * math.hypot(*shape.size)
    if isinstance(shape, Cylinder):
        return math.hypot(shape.radius, 0.5 * shape.length)
    return shape.radius
