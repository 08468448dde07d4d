"""A peer: Drake's differential inverse kinematics follows the pre-planned motion.

    goal -> dmp_integrator -> tool_pose -> desired_poses -> differential_ik
    differential_ik -> commanded_position (integral), commanded_velocity (held)
    commanded position and velocity -> controller -> actuation -> effort_limits -> plant
    commanded_position [+ where the moving obstacles are] -> differential_ik

The program starts from the commanded positions, which the controller follows. Both are
Drake's; `drake_oa.studies.panda.differential_ik` makes them from the scenario.
"""

from __future__ import annotations

from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import (
    Adder,
    BusCreator,
    ConstantVectorSource,
    DiscreteTimeIntegrator,
    MatrixGain,
    Multiplexer,
    Saturation,
    ZeroOrderHold,
)

from drake_oa.common.messages import FloatArray
from drake_oa.common.schema_check import ScenarioError
from drake_oa.common.wires import Wires
from drake_oa.diagrams.faults import add_drivers
from drake_oa.diagrams.policy import make_dmp_integrator, make_goal
from drake_oa.robot.plant import make_robot_plant
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda import differential_ik as peer
from drake_oa.studies.panda.tool_pose import ToolPose
from drake_oa.world.station import Station, make_station


def build_differential_ik(
    scenario: Scenario, q_start: FloatArray, parameters: peer.PeerParameters
) -> Diagram:
    """Wires the peer on a scenario's station.

    Subsystems by name: plant, scene_graph, goal, dmp_integrator, tool_pose, desired_poses,
    differential_ik, posture, mover_<model instance>, commanded_position, commanded_velocity,
    commanded_state, controller, actuation, effort_limits, log_<signal>; where obstacles
    move also positions_<model instance> and world_positions.

    Args:
        scenario: with a robot; its perception is not used.
        q_start: (n,) all positions of the robot at the start, and its posture.
        parameters: of the method.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    if scenario.robot is None:
        raise ScenarioError("robot: differential inverse kinematics needs one; it is null")
    builder = DiagramBuilder()
    station = make_station(builder, scenario, render=False)
    station.plant.SetDefaultPositions(station.robot, q_start)
    wires = Wires(builder)
    wires.offer("plant_state", station.plant.get_state_output_port())
    add_drivers(wires, scenario, station)
    position, velocity = _wire_command(wires, scenario, station, q_start, parameters)
    # The arm's dynamics are its own: of driven obstacles the controller need not know.
    alone = station.plant.num_positions() == len(q_start)
    model = station.plant if alone else make_robot_plant(scenario.robot).plant
    _wire_controller(wires, station, model, position, velocity, parameters)
    wires.connect()
    diagram = builder.Build()
    diagram.set_name("differential_ik")
    return diagram


def _wire_positions(
    builder: DiagramBuilder,
    orders: dict[str, FloatArray],
    station: Station,
    commanded: OutputPort,
) -> OutputPort:
    """Positions of the whole world: the commanded ones, and where the obstacles are."""
    if len(orders) == 1:
        return commanded
    plant = station.plant
    whole = builder.AddNamedSystem(
        "world_positions", Adder(len(orders), len(next(iter(orders.values()))))
    )
    for number, (name, order) in enumerate(orders.items()):
        source = commanded
        if number:
            source = plant.get_state_output_port(plant.GetModelInstanceByName(name))
            order = peer.of_state(order)
        placed = builder.AddNamedSystem(f"positions_{name}", MatrixGain(order))
        builder.Connect(source, placed.get_input_port())
        builder.Connect(placed.get_output_port(), whole.get_input_port(number))
    return whole.get_output_port()


def _wire_command(
    wires: Wires,
    scenario: Scenario,
    station: Station,
    q_start: FloatArray,
    parameters: peer.PeerParameters,
) -> tuple[OutputPort, OutputPort]:
    """From the pre-planned motion to the commanded positions and velocities."""
    robot = scenario.robot
    if robot is None:
        raise ScenarioError("robot: differential inverse kinematics needs one; it is null")
    period = scenario.policy.period
    builder = wires.builder
    wires.add("goal", make_goal(scenario), offers={"y0": "goal"})
    wires.add("dmp_integrator", make_dmp_integrator(scenario))
    wires.log("goal", "desired_position", "desired_velocity", "desired_acceleration", "phase")

    R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix()
    look_ahead = peer.look_ahead(period, parameters)
    pose = wires.add("tool_pose", ToolPose(R_WE, look_ahead=look_ahead))

    checker = peer.make_collision_checker(scenario, parameters)
    ik = builder.AddNamedSystem(
        "differential_ik", peer.make_differential_ik(scenario, checker, parameters)
    )
    poses = builder.AddNamedSystem("desired_poses", BusCreator())
    poses.DeclareAbstractInputPort(peer.tool_frame_name(checker.plant()), Value(RigidTransform()))
    wires.take(pose.get_output_port().get_name(), poses.get_input_port(0))
    builder.Connect(poses.get_output_port(), ik.GetInputPort("desired_cartesian_poses"))
    orders = peer.position_orders(checker.plant(), scenario)
    # The obstacles have none: of their zeros nothing is asked.
    q_posture = next(iter(orders.values())) @ peer.posture(robot, q_start)
    posture = builder.AddNamedSystem("posture", ConstantVectorSource(q_posture))
    builder.Connect(posture.get_output_port(), ik.GetInputPort("nominal_posture"))

    position = builder.AddNamedSystem(
        "commanded_position", DiscreteTimeIntegrator(len(q_start), period)
    )
    velocity = builder.AddNamedSystem("commanded_velocity", ZeroOrderHold(period, len(q_start)))
    for held in (position, velocity):
        builder.Connect(ik.GetOutputPort("commanded_velocity"), held.get_input_port())
    whole = _wire_positions(builder, orders, station, position.get_output_port())
    builder.Connect(whole, ik.GetInputPort("position"))
    return position.get_output_port(), velocity.get_output_port()


def _wire_controller(
    wires: Wires,
    station: Station,
    model: MultibodyPlant,
    position: OutputPort,
    velocity: OutputPort,
    parameters: peer.PeerParameters,
) -> None:
    """From the commanded positions and velocities to the plant, and back; model: of the robot."""
    builder = wires.builder
    plant = station.plant
    state = plant.get_state_output_port(station.robot)
    n = position.size()
    command = builder.AddNamedSystem("commanded_state", Multiplexer([n, n]))
    builder.Connect(position, command.get_input_port(0))
    builder.Connect(velocity, command.get_input_port(1))
    controller = builder.AddNamedSystem("controller", peer.make_joint_controller(model, parameters))
    builder.Connect(state, controller.get_input_port_estimated_state())
    builder.Connect(command.get_output_port(), controller.get_input_port_desired_state())
    actuation = builder.AddNamedSystem("actuation", MatrixGain(peer.actuation_of_force(model)))
    effort = peer.effort_limits(model)
    limits = builder.AddNamedSystem("effort_limits", Saturation(-effort, effort))
    builder.Connect(controller.get_output_port_control(), actuation.get_input_port())
    builder.Connect(actuation.get_output_port(), limits.get_input_port())
    builder.Connect(limits.get_output_port(), plant.get_actuation_input_port(station.robot))
    wires.offer("robot_state", state)
    wires.offer("actuation", limits.get_output_port())
    wires.log("robot_state", "actuation")
