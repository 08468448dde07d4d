"""Ports that several parts of a diagram read, and how they are logged."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import VectorLogSink

from drake_oa.diagrams import layers
from drake_oa.scenario.scenario import DepthCamera, Scenario
from drake_oa.world.station import Station

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


def solid_obstacles_port(
    builder: DiagramBuilder, scenario: Scenario, station: Station
) -> OutputPort:
    """The clouds of `obstacles_port`; seen by a camera, what moves or has moved is solid.

    Adds hidden_sides where it is not there yet.

    Args:
        builder: as of `obstacles_port`.
        scenario: with the perception.
        station: with its camera.
    """
    if not isinstance(scenario.perception, DepthCamera):
        return obstacles_port(builder)
    if builder.HasSubsystemNamed("hidden_sides"):
        return builder.GetSubsystemByName("hidden_sides").get_output_port()
    hidden = builder.AddNamedSystem("hidden_sides", layers.make_hidden_sides(scenario))
    builder.Connect(obstacles_port(builder), hidden.GetInputPort("obstacles_W"))
    pose = station.cameras[scenario.perception.camera].pose
    builder.Connect(pose, hidden.GetInputPort("camera_pose"))
    return hidden.get_output_port()
