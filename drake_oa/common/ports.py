"""Helpers of systems: typed abstract inputs, periods, and a robot's model in their Context."""

from __future__ import annotations

import math
from typing import Any, Generic, TypeVar

import numpy as np
from pydrake.common.value import Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.systems.framework import Context, InputPort, LeafSystem, ValueProducer

from drake_oa.common.messages import FloatArray

T = TypeVar("T")

DECISION_OFFSET = 1e-3
"""Delay of a layer's decision after the beginning of a period [s], so that inputs are new."""


def read_value(system: LeafSystem, port: InputPort, context: Context, kind: type[T]) -> T:
    """Evaluates an abstract input port and checks the type of its value.

    Raises:
        TypeError: naming system, port, the type found and the type expected.
        RuntimeError: from Drake, if the port is not connected.
    """
    value = port.Eval(context)
    if not isinstance(value, kind):
        raise TypeError(
            f"{system.get_name() or type(system).__name__}: input port '{port.get_name()}' "
            f"holds a {type(value).__name__}; it must be a {kind.__name__}"
        )
    return value


def read_optional(system: LeafSystem, port: InputPort, context: Context, kind: type[T]) -> T | None:
    """`read_value` of a port that need not be connected; None where it is not."""
    return read_value(system, port, context, kind) if port.HasValue(context) else None


def valid_period(period: float) -> float:
    """The period [s] if it is positive and finite; ValueError otherwise."""
    if not 0.0 < period < math.inf:
        raise ValueError(f"period must be positive and finite [s], not {period}")
    return float(period)


_ORIGIN = np.zeros(3)


class Cell(Generic[T]):
    """Slot of a cache entry for a Python value, which is set without the copy that Drake makes.

    Attributes:
        value: changed by nobody, so that clones share it; None before the first.
    """

    __slots__ = ("value",)

    def __init__(self, value: T | None = None) -> None:
        """Holds a value."""
        self.value = value

    def __deepcopy__(self, memo: dict[int, Any]) -> Cell[T]:
        return Cell(self.value)

    @property
    def known(self) -> T:
        """The value.

        Raises:
            RuntimeError: if there is none.
        """
        if self.value is None:
            raise RuntimeError("nothing has been put into the cache entry")
        return self.value


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
