"""Obstacles that move on a given course, or appear and vanish, and are as solid as any other.

Such an obstacle hangs on three slides along the world's axes. The force on each brings it,
within one step of the plant, to where its course is then: it pushes what it meets, and is
pushed off its course only by what a step's contact forces can do. While it is absent it waits
high above the world, from where it comes, and to where it goes, in one step: it is nowhere
between.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, RigidBody, SpatialInertia

from drake_oa.common.messages import FloatArray


def drive_force(
    offset: FloatArray, velocity: FloatArray, target: FloatArray, mass: float, step: float
) -> FloatArray:
    """The force that brings a free mass to a target in one step.

    The plant steps v+ = v + step f / m, then x+ = x + step v+; hence
    f = m ((target - x) / step - v) / step.

    Args:
        offset: (3,) x [m].
        velocity: (3,) v [m/s].
        target: (3,) where it is to be a step later [m].
        mass: m [kg].
        step: [s].

    Returns:
        (3,) f [N].
    """
    return mass * ((target - offset) / step - velocity) / step


def hang_on_slides(
    plant: MultibodyPlant, body: RigidBody, X_WO: RigidTransform, offset: Sequence[float]
) -> None:
    """Joins an obstacle to the world by actuated slides along the world's axes.

    Gravity does not act on it. The positions of its model instance are its offset (3,).

    Args:
        plant: not finalized.
        body: the obstacle, alone in its model instance.
        X_WO: its pose where the offset is zero.
        offset: (3,) where it is at first [m].
    """
    instance = body.model_instance()
    place = FixedOffsetFrame(
        f"{plant.GetModelInstanceName(instance)}_place",
        plant.world_frame(),
        RigidTransform(RotationMatrix(), X_WO.translation()),
        instance,
    )
    # The slides run along the world's axes whichever way the obstacle is turned.
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
