"""Obstacles that move on a given course, or appear and vanish, and are as solid as any other.

Such an obstacle hangs on three slides along the world's axes. The force on each brings it,
within one step of the plant, to where its course is then: it pushes what it meets, and is
pushed off its course only by what a step's contact forces can do. While it is absent it waits
high above the world, from where it comes, and to where it goes, in one step: it is nowhere
between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, RigidBody, SpatialInertia

from drake_oa.schema_check import ScenarioError
from drake_oa.values import FloatArray

_FARTHEST = 10.0
ABSENT_HEIGHT = 50.0
"""How far above its place an obstacle waits while it is absent [m]: out of any camera's sight."""
OUT_OF_WORLD = 25.0
"""What is farther from the world's origin counts as absent [m]."""
_ROUNDING = 1e-9  # of a time [s]


def check_waypoints(waypoints: Sequence[Sequence[float]], where: str) -> None:
    """Refuses a course that cannot be followed.

    Args:
        waypoints: rows t, x, y, z [s, m].
        where: the field that they are in.

    Raises:
        ScenarioError: naming `where` and the row.
    """
    before = -math.inf
    for row, waypoint in enumerate(waypoints):
        if len(waypoint) != 4:
            raise ScenarioError(
                f"{where}[{row}]: expected 4 numbers, t [s], x, y, z [m], not {list(waypoint)}"
            )
        if waypoint[0] < 0.0 or waypoint[0] <= before:
            raise ScenarioError(
                f"{where}[{row}]: its time {waypoint[0]:g} s must be at least 0 and later than "
                "that of the one before"
            )
        if max(map(abs, waypoint[1:])) > _FARTHEST:
            raise ScenarioError(
                f"{where}[{row}]: {list(waypoint[1:])} is outside [-{_FARTHEST:g}, "
                f"{_FARTHEST:g}] [m]"
            )
        before = waypoint[0]


def check_present(present: Sequence[float], where: str) -> None:
    """Refuses a time of presence that is none.

    Args:
        present: empty, [from] or [from, until] [s].
        where: the field that it is in.

    Raises:
        ScenarioError: naming `where`.
    """
    if len(present) > 2:
        raise ScenarioError(
            f"{where}: expected [from] or [from, until] [s], not {len(present)} numbers"
        )
    if present and present[0] < 0.0:
        raise ScenarioError(f"{where}[0]: {present[0]:g} must be at least 0 [s]")
    if len(present) == 2 and present[1] <= present[0]:
        raise ScenarioError(
            f"{where}[1]: {present[1]:g} must be later than {present[0]:g}, when it appears [s]"
        )


def is_present(present: Sequence[float], time: float) -> bool:
    """Whether an obstacle is there at a time [s]: from <= time < until."""
    if not present:
        return True
    after = present[1] if len(present) > 1 else math.inf
    return present[0] <= time + _ROUNDING < after


def offset_at(waypoints: FloatArray, time: float, present: Sequence[float] = ()) -> FloatArray:
    """Where a course is: straight and at a constant speed between waypoints, at rest outside.

    Args:
        waypoints: (N, 4) rows t, x, y, z with increasing t [s, m]; (0, 4): it stays.
        time: when [s].
        present: [from] or [from, until] [s]; at other times it is `ABSENT_HEIGHT` higher.

    Returns:
        (3,) offset from where the obstacle was put, in the world [m].
    """
    offset = np.zeros(3)
    if len(waypoints):
        offset = np.array([np.interp(time, waypoints[:, 0], axis) for axis in waypoints.T[1:]])
    if not is_present(present, time):
        offset[2] += ABSENT_HEIGHT
    return offset


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
