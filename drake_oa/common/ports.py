"""Helpers of systems: typed abstract inputs and periods."""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import attrgetter
from typing import Any, Generic, TypeVar

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import AbstractStateIndex, Context, DependencyTicket, LeafSystem

T = TypeVar("T")

DECISION_OFFSET = 1e-3
"""Delay of a layer's decision after the beginning of a period [s], so that inputs are new."""


class AbstractInput(Generic[T]):
    """Abstract input port of a system, with a check of the type of its values."""

    def __init__(self, system: LeafSystem, name: str, kind: type[T]) -> None:
        """Declares the port.

        Args:
            system: under construction.
            name: of the port.
            kind: class of its values.
        """
        self.port, self._kind = system.DeclareAbstractInputPort(name, Value(kind())), kind

    def read(self, context: Context) -> T:
        """Evaluates the port.

        Raises:
            TypeError: naming system, port, the type found and the type expected.
            RuntimeError: from Drake, if the port is not connected.
        """
        value = self.port.Eval(context)
        if not isinstance(value, self._kind):
            system = self.port.get_system()
            raise TypeError(
                f"{system.get_name() or type(system).__name__}: input port "
                f"'{self.port.get_name()}' holds a {type(value).__name__}; it must be a "
                f"{self._kind.__name__}"
            )
        return value

    def find(self, context: Context) -> T | None:
        """Evaluates the port; None where it is not connected."""
        return self.read(context) if self.port.HasValue(context) else None

    def read_or_empty(self, context: Context) -> T:
        """Evaluates the port; a default value where it is not connected."""
        return self.read(context) if self.port.HasValue(context) else self._kind()

    def ticket(self) -> DependencyTicket:
        """Returns the ticket for values that depend on the port."""
        return self.port.ticket()


def valid_period(period: float) -> float:
    """The period [s] if it is positive and finite; ValueError otherwise."""
    if not 0.0 < period < math.inf:
        raise ValueError(f"period must be positive and finite [s], not {period}")
    return float(period)


def declare_state_outputs(
    system: LeafSystem, state: AbstractStateIndex, *ports: tuple[str, int | type, str]
) -> None:
    """Declares output ports that hold parts of an abstract state.

    Args:
        system: under construction.
        state: row of the state.
        ports: name of each, the size of a vector or the class of an abstract value, and the path of
            attributes that leads to it.
    """
    tickets = {system.abstract_state_ticket(state)}
    for name, kind, path in ports:

        def part(context: Context, of: Callable[[Any], Any] = attrgetter(path)) -> Any:
            return of(context.get_abstract_state(state).get_value())

        if isinstance(kind, int):
            system.DeclareVectorOutputPort(
                name,
                kind,
                lambda context, output, part=part: output.SetFromVector(
                    np.array(part(context), dtype=float, ndmin=1)
                ),
                tickets,
            )
        else:
            system.DeclareAbstractOutputPort(
                name,
                lambda kind=kind: Value(kind()),
                lambda context, output, part=part: output.set_value(part(context)),
                tickets,
            )
