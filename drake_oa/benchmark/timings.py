"""What the modules that time layers share."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, TypeVar

from pydrake.systems.analysis import Simulator

WARM_UP = 10
"""Steps before the first that is timed."""
JUST_AFTER = 1e-6
"""How long after an instant a Simulator has done what is due then [s]."""
DESIRED = ("desired_position", "desired_velocity", "desired_acceleration")
"""Ports of the desired motion, of policy and controller."""
_Answer = TypeVar("_Answer")


def timed(call: Callable[..., _Answer], *arguments: object) -> tuple[float, _Answer]:
    """Wall time [s] of a call, and its answer."""
    started = time.perf_counter()
    answer = call(*arguments)
    return time.perf_counter() - started, answer


def port_timer(simulator: Simulator, name: str, *ports: str) -> Callable[[], float]:
    """What times the evaluation of output ports of a system, by name [us]."""
    diagram: Any = simulator.get_system()
    system = diagram.GetSubsystemByName(name)
    context = system.GetMyContextFromRoot(simulator.get_context())
    outputs = [system.GetOutputPort(port) for port in ports]
    return lambda: 1e6 * sum(timed(port.Eval, context)[0] for port in outputs)
