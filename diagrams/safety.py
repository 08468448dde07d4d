"""Wires what watches the motion: supervisor, evasion, and what they see.

perception, camera -> hidden_sides -> supervisor, evasion
plant, controller, dmp_integrator -> supervisor -> dmp_integrator (speed_scale)
plant, dmp_integrator, regressor_chain -> evasion -> dmp_integrator, supervisor, posture_follower
"""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder, OutputPort

from drake_oa.diagrams import robot_layers
from drake_oa.diagrams.ports import log_signal, solid_obstacles_port
from drake_oa.diagrams.turning import speed_scale_port
from drake_oa.regulation.verified_regressor_chain import VerifiedRegressorChain
from drake_oa.robot.plant import RobotPlant
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.station import Station


def wire_supervisor(
    builder: DiagramBuilder, scenario: Scenario, station: Station, robot_plant: RobotPlant
) -> None:
    """What slows, holds or stops the policy; it sees the obstacles that the descriptor sees."""
    supervisor = builder.AddNamedSystem(
        "supervisor", robot_layers.make_supervisor(scenario, robot_plant)
    )
    policy = builder.GetSubsystemByName("dmp_integrator")
    controller = builder.GetSubsystemByName("controller")
    builder.Connect(
        station.plant.get_state_output_port(station.robot), supervisor.GetInputPort("robot_state")
    )
    builder.Connect(policy.GetOutputPort("policy_state"), supervisor.GetInputPort("policy_state"))
    for name in ("tracking_error", "torque_saturation"):
        builder.Connect(controller.GetOutputPort(name), supervisor.GetInputPort(name))
    if builder.HasSubsystemNamed("ellipsoid_descriptor"):
        obstacles = solid_obstacles_port(builder, scenario, station)
        builder.Connect(obstacles, supervisor.GetInputPort("obstacles_W"))
        if scenario.evasion is not None:
            _wire_evasion(builder, scenario, station, robot_plant, obstacles)
    builder.Connect(supervisor.GetOutputPort("speed_scale"), speed_scale_port(builder))
    # With a tool that turns it is the lesser of two.
    asked = (policy, policy.GetInputPort("speed_scale").get_index())
    source, index = builder.connection_map()[asked]
    log_signal(builder, "speed_scale", source.get_output_port(index))


def _wire_evasion(
    builder: DiagramBuilder,
    scenario: Scenario,
    station: Station,
    robot_plant: RobotPlant,
    obstacles: OutputPort,
) -> None:
    """What displaces policy and posture where slowing and holding does not help."""
    turns = builder.HasSubsystemNamed("posture_follower")
    evasion = builder.AddNamedSystem(
        "evasion", robot_layers.make_evasion(scenario, robot_plant, turns=turns)
    )
    policy = builder.GetSubsystemByName("dmp_integrator")
    chain = builder.GetSubsystemByName("regressor_chain")
    supervisor = builder.GetSubsystemByName("supervisor")
    builder.Connect(
        station.plant.get_state_output_port(station.robot), evasion.GetInputPort("robot_state")
    )
    builder.Connect(policy.GetOutputPort("policy_state"), evasion.GetInputPort("policy_state"))
    builder.Connect(obstacles, evasion.GetInputPort("obstacles_W"))
    if isinstance(chain, VerifiedRegressorChain):
        builder.Connect(chain.GetOutputPort("motion"), evasion.GetInputPort("motion"))
    builder.Connect(evasion.GetOutputPort("evasion"), policy.GetInputPort("evasion"))
    evading = evasion.GetOutputPort("evading")
    builder.Connect(evading, supervisor.GetInputPort("evading"))
    if turns:
        follower = builder.GetSubsystemByName("posture_follower")
        builder.Connect(evading, follower.GetInputPort("evading"))
    log_signal(builder, "evasion", evasion.GetOutputPort("evasion"))
    log_signal(builder, "decision_evasion", evasion.GetOutputPort("decision"))
