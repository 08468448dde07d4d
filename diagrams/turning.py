"""What turns the tool, in a diagram that avoids obstacles.

perception, dmp_integrator, goal -> tool_turn_selector -> orientation_integrator (turn)
dmp_integrator -> orientation_integrator -> controller, tool_turn_selector (tool_turn)
tool_turn_selector -> ellipsoid_descriptor (planned_turn)
tool_turn_selector, supervisor -> slowest -> dmp_integrator (speed_scale)
"""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder, InputPort, OutputPort

from drake_oa.control.min_speed_scale import Slowest
from drake_oa.diagrams import turn_layers
from drake_oa.diagrams.orienting import add_orientation
from drake_oa.diagrams.ports import obstacles_port
from drake_oa.robot.plant import RobotPlant
from drake_oa.scenario.scenario import Scenario


def wire_turn(
    builder: DiagramBuilder, scenario: Scenario, robot_plant: RobotPlant
) -> dict[str, OutputPort]:
    """Adds what turns the tool, where the scenario has it turned.

    Args:
        builder: with goal, dmp_integrator, ellipsoid_descriptor and controller.
        scenario: with a robot.
        robot_plant: the robot alone.

    Returns:
        The ports to log, by name; none without a turn.
    """
    selector = turn_layers.make_tool_turn_selector(scenario, robot_plant)
    if selector is None:
        return {}
    builder.AddNamedSystem("tool_turn_selector", selector)
    policy = builder.GetSubsystemByName("dmp_integrator")
    builder.Connect(policy.GetOutputPort("policy_state"), selector.GetInputPort("policy_state"))
    goal = builder.GetSubsystemByName("goal")
    builder.Connect(goal.get_output_port(0), selector.GetInputPort("goal"))
    descriptor = builder.GetSubsystemByName("ellipsoid_descriptor")
    builder.Connect(obstacles_port(builder), selector.GetInputPort("obstacles_W"))
    builder.Connect(selector.GetOutputPort("planned_turn"), descriptor.GetInputPort("tool_turn"))

    if not builder.HasSubsystemNamed("orientation_integrator"):
        # Besides its turn the tool keeps its orientation.
        add_orientation(builder, turn_layers.make_kept_orientation(scenario))
    orientation = builder.GetSubsystemByName("orientation_integrator")
    builder.Connect(selector.GetOutputPort("turn"), orientation.GetInputPort("turn"))
    turned = orientation.GetOutputPort("tool_turn")
    builder.Connect(turned, selector.GetInputPort("tool_turn"))

    scale = selector.GetOutputPort("speed_scale")
    signals = {
        "tool_turn": turned,
        "planned_turn": selector.GetOutputPort("planned_turn"),
        "decision_turn": selector.GetOutputPort("decision"),
    }
    if scenario.supervisor is None:
        builder.Connect(scale, policy.GetInputPort("speed_scale"))
        signals["speed_scale"] = scale
    else:
        slowest = builder.AddNamedSystem("slowest", Slowest())
        builder.Connect(scale, slowest.GetInputPort("turn_speed_scale"))
        builder.Connect(slowest.get_output_port(), policy.GetInputPort("speed_scale"))
    return signals


def speed_scale_port(builder: DiagramBuilder) -> InputPort:
    """What a supervisor's share of full speed goes to."""
    if builder.HasSubsystemNamed("slowest"):
        return builder.GetSubsystemByName("slowest").GetInputPort("speed_scale")
    return builder.GetSubsystemByName("dmp_integrator").GetInputPort("speed_scale")
