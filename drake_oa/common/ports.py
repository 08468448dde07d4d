"""Helpers for Drake systems: typed abstract inputs, periods, output ports of an abstract state."""

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
"""Delay of a decision on the motion or on sides after the start of each period of its layer [s].
Collision scene, nominal posture and motion guard are delayed by 0.5, 2 and 3 times this value.

Due to this delay, the decision uses an observation that perception outputs at the start of the
period."""


class AbstractInput(Generic[T]):
    """Abstract input port of a Drake system, with a check of the type of its values."""

    def __init__(self, system: LeafSystem, name: str, kind: type[T]) -> None:
        """Declares the abstract input port in a system.

        Args:
            system: system under construction, to which the port is added.
            name: name of the port.
            kind: class of the port's values.
        """
        self.port, self._kind = system.DeclareAbstractInputPort(name, Value(kind())), kind

    def read(self, context: Context) -> T:
        """Evaluates the port, and returns its value.

        Raises:
            TypeError: for a value of another class; names system, port and both classes.
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
        """Evaluates the port, and returns its value or, if the port is not connected, None."""
        return self.read(context) if self.port.HasValue(context) else None

    def read_or_empty(self, context: Context) -> T:
        """Evaluates the port, and returns its value; if the port is not connected, a default
        instance of its class.
        """
        return self.read(context) if self.port.HasValue(context) else self._kind()

    def ticket(self) -> DependencyTicket:
        """Returns Drake's dependency ticket of the port, for cache entries and output ports."""
        return self.port.ticket()


def valid_period(period: float) -> float:
    """Checks that the update period of a system [s] is positive and finite, and returns it.

    Raises:
        ValueError: if the period is not positive and finite.
    """
    return positive(period, "period [s]")


def positive(value: float, name: str) -> float:
    """Checks that a constructor argument is positive and finite, and returns it.

    Args:
        value: value of the argument.
        name: name and unit of the argument, such as "period [s]", for the error.

    Raises:
        ValueError: if the value is not positive and finite.
    """
    if not 0.0 < value < math.inf:
        raise ValueError(f"{name} must be positive and finite, not {value}")
    return float(value)


def declare_state_outputs(
    system: LeafSystem, state: AbstractStateIndex, *ports: tuple[str, int | type, str]
) -> None:
    """Declares output ports that publish attributes of a system's abstract state.

    Args:
        system: system under construction.
        state: index of the abstract state.
        ports: for each port a tuple of three items: the name of the port; the size of its vector,
            or the class of its abstract value; and the attribute of the state's value that it
            publishes, such as "pending.active".
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
