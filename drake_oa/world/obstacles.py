"""Obstacles written in a scenario: primitive shapes that stand in the world."""

# No postponed annotations here: yaml_load_typed reads the fields' types.

import pydrake.geometry as geometry
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, SpatialInertia, UnitInertia

from drake_oa.common.schema_check import ScenarioError
from drake_oa.geometry.shapes import pose, shape_geometry
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX, Obstacle
from drake_oa.world.moving_obstacles import (
    hang_on_slides,
)

_FRICTION = 0.7


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
