"""What turns the tool along its motion, in a diagram that avoids obstacles.

dmp_integrator -> orientation_integrator -> controller
"""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder, OutputPort

from drake_oa.diagrams.orientation_layers import make_orientation_integrator
from drake_oa.policy.orientation_integrator import OrientationIntegrator
from drake_oa.scenario.scenario import Scenario


def wire_orientation(builder: DiagramBuilder, scenario: Scenario) -> None:
    """Adds orientation_integrator, where the scenario has the orientation change.

    Args:
        builder: with dmp_integrator and controller.
        scenario: with a robot.
    """
    system = make_orientation_integrator(scenario)
    if system is not None:
        add_orientation(builder, system)


def add_orientation(builder: DiagramBuilder, system: OrientationIntegrator) -> None:
    """Adds orientation_integrator between dmp_integrator and controller.

    Args:
        builder: with both.
        system: that is added.
    """
    builder.AddNamedSystem("orientation_integrator", system)
    policy = builder.GetSubsystemByName("dmp_integrator")
    controller = builder.GetSubsystemByName("controller")
    builder.Connect(policy.GetOutputPort("policy_state"), system.GetInputPort("policy_state"))
    for what in ("orientation", "angular_velocity", "angular_acceleration"):
        name = f"desired_{what}"
        builder.Connect(system.GetOutputPort(name), controller.GetInputPort(name))


def orientation_signals(builder: DiagramBuilder) -> dict[str, OutputPort]:
    """The ports to log, by name, where something turns the tool."""
    if not builder.HasSubsystemNamed("orientation_integrator"):
        return {}
    system = builder.GetSubsystemByName("orientation_integrator")
    controller = builder.GetSubsystemByName("controller")
    return {
        "desired_orientation": system.GetOutputPort("desired_orientation"),
        "orientation_error": controller.GetOutputPort("orientation_error"),
    }
