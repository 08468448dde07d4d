"""A robot's model, posed, within the Context of a system that reads it."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import Context, LeafSystem, ValueProducer

from drake_oa.common.messages import FloatArray

_ORIGIN = np.zeros(3)


class ModelContext:
    """Keeps a context of a plant as a cache entry of a system: clones have their own."""

    def __init__(self, system: LeafSystem, plant: MultibodyPlant) -> None:
        """Declares the entry.

        Args:
            system: under construction.
            plant: finalized; it is only read.
        """
        self._plant = plant
        self._entry = system.DeclareCacheEntry(
            "context of the robot's model",
            ValueProducer(
                allocate=lambda: Value(plant.CreateDefaultContext()),
                calc=ValueProducer.NoopCalc,
            ),
            prerequisites_of_calc={system.nothing_ticket()},
        )

    def at(self, context: Context, q: FloatArray, v: FloatArray | None = None) -> Context:
        """The plant's context at positions and, where they are given, velocities.

        Args:
            context: of the system.
            q: (nq,) [rad, m].
            v: (nv,) [rad/s, m/s].
        """
        model: Context = self._entry.get_mutable_cache_entry_value(context).GetMutableValueOrThrow()
        self._plant.SetPositions(model, q)
        if v is not None:
            self._plant.SetVelocities(model, v)
        return model

    def jacobian(self, model: Context, frame: Frame) -> FloatArray:
        """(6, nv) of the angular and linear velocity of a frame's origin in the world."""
        world = self._plant.world_frame()
        J: FloatArray = self._plant.CalcJacobianSpatialVelocity(
            model, JacobianWrtVariable.kV, frame, _ORIGIN, world, world
        )
        return J
