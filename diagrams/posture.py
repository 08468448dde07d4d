"""Wires what moves the arm in the null space of the tool's task.

hidden_sides (without a camera perception), plant, camera -> regressor_chain
regressor_chain (motion), dmp_integrator -> posture_follower -> controller
posture_guide, dmp_integrator -> guide_follower -> controller; without a plan
perception, plant -> null_space_coupling -> controller
"""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.messages import FloatArray
from drake_oa.diagrams import robot_layers
from drake_oa.diagrams.ports import log_signal, obstacles_port, solid_obstacles_port
from drake_oa.regulation.verified_regressor_chain import RobotArm
from drake_oa.robot.plant import RobotPlant
from drake_oa.scenario.scenario import DepthCamera, Scenario
from drake_oa.world.station import Station


def wire_posture(
    builder: DiagramBuilder,
    scenario: Scenario,
    station: Station,
    arm: RobotArm,
    q_start: FloatArray,
) -> None:
    """The posture that the regulation plans along the motion, to the controller."""
    chain = builder.GetSubsystemByName("regressor_chain")
    controller = builder.GetSubsystemByName("controller")
    policy = builder.GetSubsystemByName("dmp_integrator")
    builder.Connect(
        station.plant.get_state_output_port(station.robot), chain.GetInputPort("robot_state")
    )
    if builder.HasSubsystemNamed("ellipsoid_descriptor"):
        obstacles = solid_obstacles_port(builder, scenario, station)
        builder.Connect(obstacles, chain.GetInputPort("obstacles_W"))
    if isinstance(scenario.perception, DepthCamera):
        pose = station.cameras[scenario.perception.camera].pose
        builder.Connect(pose, chain.GetInputPort("camera_pose"))
    follower = builder.AddNamedSystem(
        "posture_follower", robot_layers.make_posture_follower(scenario, arm, q_start)
    )
    builder.Connect(chain.GetOutputPort("motion"), follower.GetInputPort("motion"))
    builder.Connect(policy.GetOutputPort("policy_state"), follower.GetInputPort("policy_state"))
    builder.Connect(follower.get_output_port(), controller.GetInputPort("desired_posture"))
    log_signal(builder, "desired_posture", follower.get_output_port())


def wire_guide(builder: DiagramBuilder, scenario: Scenario, q_start: FloatArray) -> None:
    """The posture from the task's joints at the start to those at the goal, to the controller."""
    made = robot_layers.make_guide_follower(scenario, q_start)
    if made is None:
        return
    follower = builder.AddNamedSystem("guide_follower", made[0])
    guide = builder.AddNamedSystem("posture_guide", made[1])
    policy = builder.GetSubsystemByName("dmp_integrator")
    controller = builder.GetSubsystemByName("controller")
    builder.Connect(guide.get_output_port(), follower.GetInputPort("motion"))
    builder.Connect(policy.GetOutputPort("policy_state"), follower.GetInputPort("policy_state"))
    builder.Connect(follower.get_output_port(), controller.GetInputPort("desired_posture"))
    log_signal(builder, "desired_posture", follower.get_output_port())


def wire_null_space(
    builder: DiagramBuilder,
    scenario: Scenario,
    station: Station,
    robot_plant: RobotPlant,
    q_start: FloatArray,
) -> None:
    """What turns the links away from obstacles, to the controller, where it is asked for."""
    if not builder.HasSubsystemNamed("ellipsoid_descriptor"):
        return
    coupling = robot_layers.make_null_space_coupling(scenario, robot_plant, q_start)
    if coupling is None:
        return
    builder.AddNamedSystem("null_space_coupling", coupling)
    controller = builder.GetSubsystemByName("controller")
    state = station.plant.get_state_output_port(station.robot)
    builder.Connect(state, coupling.GetInputPort("robot_state"))
    builder.Connect(obstacles_port(builder), coupling.GetInputPort("obstacles_W"))
    asked = controller.GetInputPort("null_space_acceleration")
    builder.Connect(coupling.get_output_port(), asked)
