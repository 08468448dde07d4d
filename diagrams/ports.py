"""Ports that several parts of a diagram read."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder, OutputPort


def obstacles_port(builder: DiagramBuilder) -> OutputPort:
    """The clouds that ellipsoid_descriptor sees.

    Args:
        builder: with ellipsoid_descriptor, its port obstacles_W connected.
    """
    descriptor = builder.GetSubsystemByName("ellipsoid_descriptor")
    port = descriptor.GetInputPort("obstacles_W")
    source, index = builder.connection_map()[(descriptor, port.get_index())]
    return source.get_output_port(index)
