"""Obstacles of primitive shapes in the simulated plant, and the system that moves an obstacle along
its trajectory.

An obstacle is welded to the world unless it moves, appears or vanishes. A moving obstacle has three
prismatic joints along the world's axes. The force of each joint moves the obstacle to its
trajectory within one step of the plant. The obstacle pushes objects in its way; it deviates from
its trajectory only by the effect of contact forces during one step.

While an obstacle is absent (before it appears and after it vanishes), it is raised by 50 m
(`ABSENT_HEIGHT`). It appears and vanishes within one step, without intermediate positions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pydrake.geometry as geometry
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    ModelInstanceIndex,
    PrismaticJoint,
    RigidBody,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_oa.common.config import ScenarioError
from drake_oa.geometry.shapes import pose, shape_geometry
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX, Obstacle


def add_prismatic_joints(
    plant: MultibodyPlant, body: RigidBody, X_WO: RigidTransform, offset: Sequence[float]
) -> None:
    """Connects an obstacle to the world by actuated prismatic joints along the world's axes.

    Gravity is disabled for the obstacle. The joint positions (3,) of its model instance are the
    displacement of the obstacle from the pose X_WO along the world's axes [m].

    Args:
        plant: plant, not finalized.
        body: body of the obstacle, which is the only body of its model instance.
        X_WO: pose of the obstacle in the world at zero joint positions.
        offset: (3,) initial displacement from X_WO along the world's axes [m].
    """
    instance = body.model_instance()
    place = FixedOffsetFrame(
        f"{plant.GetModelInstanceName(instance)}_place",
        plant.world_frame(),
        RigidTransform(RotationMatrix(), X_WO.translation()),
        instance,
    )
    # The joints are along the world's axes, whatever the orientation of the obstacle.
    end = FixedOffsetFrame(
        "slides", body.body_frame(), RigidTransform(X_WO.rotation().inverse(), [0.0, 0.0, 0.0])
    )
    slides = [
        plant.AddRigidBody(f"slide_{name}", instance, SpatialInertia.Zero()).body_frame()
        for name in "xy"
    ]
    frames = [plant.AddFrame(place), *slides, plant.AddFrame(end)]
    for number, name in enumerate("xyz"):
        joint = plant.AddJoint(
            PrismaticJoint(name, frames[number], frames[number + 1], np.eye(3)[number])
        )
        joint.set_default_translation(float(offset[number]))
        plant.AddJointActuator(name, joint)
    plant.set_gravity_enabled(instance, False)


_FRICTION = 0.7
"""Coulomb friction coefficient, static and dynamic, of the surfaces of obstacles [-]."""


def add_obstacle(plant: MultibodyPlant, obstacle: Obstacle) -> ModelInstanceIndex:
    """Adds an obstacle to a plant as the model instance `obstacle_<name>`: welded to the world, or
    with prismatic joints if it moves, appears or vanishes.

    Args:
        plant: plant registered with a scene graph, not finalized.
        obstacle: configuration of the obstacle: shapes, pose and motion.

    Raises:
        ScenarioError: if a model instance with this name exists.
    """
    name = f"{OBSTACLE_PREFIX}_{obstacle.name}"
    if plant.HasModelInstanceNamed(name):
        raise ScenarioError(f"obstacles: the model instance '{name}' already exists; rename one")
    instance = plant.AddModelInstance(name)
    # The inertia has no influence on a welded obstacle, nor on one with a given trajectory.
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
    if obstacle.is_driven:
        add_prismatic_joints(plant, body, pose(obstacle), obstacle.offset_at(0.0).tolist())
    else:
        plant.WeldFrames(plant.world_frame(), body.body_frame(), pose(obstacle))
    return instance


def obstacle_instances(plant: MultibodyPlant) -> tuple[ModelInstanceIndex, ...]:
    """Returns the model instances of a plant that are obstacles: their names begin with "obstacle"
    (`OBSTACLE_PREFIX`).
    """
    return tuple(
        instance
        for instance in map(ModelInstanceIndex, range(plant.num_model_instances()))
        if plant.GetModelInstanceName(instance).startswith(OBSTACLE_PREFIX)
    )


class ObstacleMover(LeafSystem):
    """System that moves an obstacle along its waypoints, and raises it by 50 m (`ABSENT_HEIGHT`)
    before it appears and after it vanishes.

    .. pydrake_system::

      name: ObstacleMover
      input_ports:
      - obstacle_state
      output_ports:
      - force

    - obstacle_state: (6,) displacement x of the obstacle from its configured pose [m] and its
      velocity v [m/s], both along the world's axes.
    - force: (3,) forces f of the prismatic joints along the world's axes [N]. Within one time step
      h of the plant, they move the obstacle to the offset r(t + h) of its trajectory: f = m ((r(t +
      h) - x) / h - v) / h, where m is the obstacle's mass.
    """

    def __init__(self, obstacle: Obstacle, *, mass: float, step: float) -> None:
        """Declares the input port `obstacle_state` and the output port `force`.

        Args:
            obstacle: configuration of the moving obstacle.
            mass: mass of the obstacle [kg].
            step: time step of the plant [s].
        """
        super().__init__()
        self._obstacle, self._mass, self._step = obstacle, mass, step
        self._state = self.DeclareVectorInputPort("obstacle_state", 6)
        self.DeclareVectorOutputPort("force", 3, self._calc_force)

    def _calc_force(self, context: Context, output: BasicVector) -> None:
        """Sets the output port `force` to the forces that move the obstacle to its trajectory
        within one step of the plant.
        """
        # One step of the plant is v+ = v + step f / m, then x+ = x + step v+.
        x, step = self._state.Eval(context), self._step
        target = self._obstacle.offset_at(context.get_time() + step)
        output.SetFromVector(self._mass * ((target - x[:3]) / step - x[3:]) / step)
