"""Grasped object of the robot: functions that add its primitive shapes to a plant, fixed to the
hand, and exclude contacts with the tool.
"""

from __future__ import annotations

import numpy as np
from pydrake.geometry import CalcVolume, CollisionFilterDeclaration, GeometrySet, SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import CalcSpatialInertia, ModelInstanceIndex

from drake_oa.geometry.shapes import pose, shape_geometry
from drake_oa.robot.config import Robot

_COLOR = np.array([0.25, 0.35, 0.6, 1.0])
"""Color of the grasped object in images and viewers: red, green, blue and opacity [-]."""
_FRICTION = 0.7
"""Coulomb friction coefficient, static and dynamic, of the grasped object's surface [-]."""


def carried_links(robot: Robot) -> list[str]:
    """Returns the names of the bodies of the grasped object in the plant, one per shape: carried0,
    carried1, and so on.
    """
    return [f"carried{row}" for row in range(len(robot.carried))]


def tool_links(robot: Robot) -> list[str]:
    """Returns the names of the tool's bodies in the plant: the tool's links and the bodies of the
    grasped object.
    """
    return [*robot.tool_links, *carried_links(robot)]


def add_carried(plant: MultibodyPlant, instance: ModelInstanceIndex, robot: Robot) -> None:
    """Adds the bodies of the grasped object `robot.carried` to the robot's model instance.

    Each shape is a separate body that is welded to the hand link H. The mass of the object is
    distributed by volume.

    Args:
        plant: plant with the arm and not finalized.
        instance: model instance of the robot.
        robot: configuration of the robot, whose link `hand_link` is in the plant.
    """
    if not robot.carried:
        return
    hand = plant.GetFrameByName(robot.hand_link, instance)
    geometries = [shape_geometry(shape) for shape in robot.carried]
    density = robot.carried_mass / sum(map(CalcVolume, geometries))
    identity, friction = RigidTransform(), CoulombFriction(_FRICTION, _FRICTION)
    for name, shape, geometry in zip(carried_links(robot), robot.carried, geometries, strict=True):
        body = plant.AddRigidBody(name, instance, CalcSpatialInertia(geometry, density))
        plant.WeldFrames(hand, body.body_frame(), pose(shape))
        if plant.geometry_source_is_registered():
            plant.RegisterVisualGeometry(body, identity, geometry, f"{name}_visual", _COLOR)
            plant.RegisterCollisionGeometry(body, identity, geometry, name, friction)


def exclude_grasp_contacts(
    plant: MultibodyPlant, scene_graph: SceneGraph, robot: Robot | None
) -> None:
    """Excludes the contacts between the grasped object and the tool from collision detection,
    because the object always touches the fingers.

    Args:
        plant: finalized plant with the grasped object.
        scene_graph: scene graph of the plant, of which no Context has been created yet.
        robot: configuration of the robot; None: no effect.
    """
    if robot is None or not robot.carried:
        return
    instance = plant.GetBodyByName(carried_links(robot)[0]).model_instance()
    links = {robot.hand_link, *tool_links(robot)}
    geometry_ids = [
        geometry_id
        for link in sorted(links)
        if plant.HasBodyNamed(link, instance)
        for geometry_id in plant.GetCollisionGeometriesForBody(plant.GetBodyByName(link, instance))
    ]
    scene_graph.collision_filter_manager().Apply(
        CollisionFilterDeclaration().ExcludeWithin(GeometrySet(geometry_ids))
    )
