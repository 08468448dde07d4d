"""Ports that several parts of a diagram read, and how they are logged."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import VectorLogSink

LOG_PERIOD = 0.004
"""Time between logged instants [s]."""


def log_signal(builder: DiagramBuilder, name: str, port: OutputPort) -> None:
    """Logs a vector port every `LOG_PERIOD` in a sink log_<name>."""
    sink = builder.AddNamedSystem(f"log_{name}", VectorLogSink(port.size(), LOG_PERIOD))
    builder.Connect(port, sink.get_input_port())


def obstacles_port(builder: DiagramBuilder) -> OutputPort:
    """The clouds that ellipsoid_descriptor sees.

    Args:
        builder: with ellipsoid_descriptor, its port obstacles_W connected.
    """
    descriptor = builder.GetSubsystemByName("ellipsoid_descriptor")
    port = descriptor.GetInputPort("obstacles_W")
    source, index = builder.connection_map()[(descriptor, port.get_index())]
    return source.get_output_port(index)
