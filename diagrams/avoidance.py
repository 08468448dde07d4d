"""The whole diagram: a robot that sees obstacles and goes round them.

    late_<camera> -> perception; with images of the present rgbd_sensor_<camera> -> depth_noise
    -> perception; from ground truth scene_graph -> perception
    late_<camera> -> robot_at_image -> perception, or plant -> perception (robot_state)
    perception -> ellipsoid_descriptor -> regressor_chain -> dmp_integrator
    ellipsoid_descriptor -> dmp_integrator
    dmp_integrator -> controller -> plant -> controller (robot_state)
    dmp_integrator, controller -> integral_action -> controller (desired_acceleration)
    goal -> dmp_integrator, regressor_chain, and ellipsoid_descriptor where it is moved
    dmp_integrator -> regressor_chain (policy_state)
    perception, plant, controller, dmp_integrator -> supervisor -> dmp_integrator (speed_scale)
    perception, plant, dmp_integrator, regressor_chain -> evasion -> dmp_integrator, supervisor
    perception, camera -> hidden_sides -> supervisor, evasion, regressor_chain; with a depth camera

With the posture planned, `robot.posture`:

    perception or hidden_sides, plant, camera -> regressor_chain
    regressor_chain, dmp_integrator -> posture_follower -> controller

Without, where the task gives the joints at the goal:

    posture_guide, dmp_integrator -> guide_follower -> controller

With `robot.posture.coupling`:

    perception, plant -> null_space_coupling -> controller

Where the tool's orientation changes see `drake_oa.diagrams.orienting`, and where it is turned
to pass `drake_oa.diagrams.turning`.

With `regulation: !Regressor` the sides are the cost rings', unless it is not `guided`:

    ellipsoid_descriptor, dmp_integrator, goal -> cost_ring_selector
    cost_ring_selector -> regressor_chain, dmp_integrator (decision)

With a viewer the cost rings are there in any case:

    cost_ring_selector, regressor_chain -> taken_route -> overlay (route)

With faults that touch them:

    what perception is given of camera and robot -> camera_faults -> perception
    controller -> weak_actuators -> plant
    push -> plant

An obstacle that moves, appears or vanishes is driven by mover_<model instance>.
The systems are made from the scenario in `drake_oa.diagrams.layers`, `robot_layers` and
`fault_layers`; this file wires them, with `posture`, `safety`, `orienting` and `turning` beside it.
"""

from __future__ import annotations

from pydrake.geometry import Meshcat
from pydrake.systems.framework import Diagram, DiagramBuilder, LeafSystem, OutputPort
from pydrake.visualization import ApplyVisualizationConfig, VisualizationConfig

from drake_oa.control.cartesian_inverse_dynamics import CartesianInverseDynamics
from drake_oa.diagrams import fault_layers, layers, robot_layers
from drake_oa.diagrams.orienting import orientation_signals, wire_orientation
from drake_oa.diagrams.ports import log_signal
from drake_oa.diagrams.posture import wire_guide, wire_null_space, wire_posture
from drake_oa.diagrams.safety import wire_supervisor
from drake_oa.diagrams.turning import wire_turn
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.regulation.verified_regressor_chain import RobotArm, VerifiedRegressorChain
from drake_oa.robot.plant import RobotPlant, make_robot_plant
from drake_oa.route.selected_route import TakenRoute
from drake_oa.scenario.scenario import (
    DepthCamera,
    GivenEllipsoids,
    GroundTruth,
    Regressor,
    Scenario,
)
from drake_oa.world.station import Station, make_station


def build_avoidance(
    scenario: Scenario, *, modulated: bool = True, meshcat: Meshcat | None = None
) -> Diagram:
    """Wires a scenario.

    Subsystems by name: plant, scene_graph, camera_world, camera_scene_graph and
    rgbd_sensor_<camera>, or late_<camera> and robot_at_image; depth_noise, perception,
    ellipsoid_descriptor, regressor_chain, goal, dmp_integrator, integral_action, controller,
    supervisor, evasion, hidden_sides, posture_follower, log_<signal>; null_space_coupling with
    `robot.posture.coupling`; posture_guide and guide_follower; cost_ring_selector with `regulation:
    !Regressor` or a viewer, and overlay and taken_route with a viewer; orientation_integrator,
    tool_turn_selector, slowest, camera_faults, weak_actuators, push and mover_<model instance>
    where the scenario asks for them. Without a robot there is no plant, camera, descriptor,
    controller or supervisor.
    With `modulated=False` there is nothing from perception to regressor_chain, and no
    hidden_sides, posture_follower, null_space_coupling, tool_turn_selector, supervisor or
    evasion.

    The diagram exports dmp_integrator's desired_position, phase and policy_state.

    Args:
        scenario: what to build.
        modulated: whether the motion is bent round obstacles.
        meshcat: viewer, or None.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    builder = DiagramBuilder()
    robot_plant = None if scenario.robot is None else make_robot_plant(scenario.robot)
    station = None
    if robot_plant is not None:
        sees = modulated and isinstance(scenario.perception, DepthCamera)
        station = make_station(builder, scenario, render=sees)

    goal = builder.AddNamedSystem("goal", layers.make_goal(scenario))
    policy = builder.AddNamedSystem("dmp_integrator", layers.make_dmp_integrator(scenario))
    builder.Connect(goal.get_output_port(), policy.GetInputPort("goal"))
    log_signal(builder, "goal", goal.get_output_port())
    for name in ("desired_position", "desired_velocity", "desired_acceleration", "phase"):
        log_signal(builder, name, policy.GetOutputPort(name))
    for name in ("desired_position", "phase", "policy_state"):
        builder.ExportOutput(policy.GetOutputPort(name), name)

    seen: OutputPort | None = None
    if modulated:
        seen = _wire_perception(builder, scenario, station, robot_plant)
        if scenario.task.goal_moves and builder.HasSubsystemNamed("ellipsoid_descriptor"):
            descriptor = builder.GetSubsystemByName("ellipsoid_descriptor")
            builder.Connect(goal.get_output_port(), descriptor.GetInputPort("goal"))
    arm = None
    if robot_plant is not None:
        q_start = robot_layers.start_positions(robot_plant, scenario)
        arm = robot_layers.make_robot_arm(scenario, robot_plant, q_start) if modulated else None
    if seen is not None:
        _wire_decision(builder, scenario, seen, policy, goal, shown=meshcat is not None, arm=arm)
    if station is not None and robot_plant is not None:
        station.plant.SetDefaultPositions(station.robot, q_start)
        controller = robot_layers.make_controller(scenario, robot_plant, q_start)
        _wire_robot(builder, scenario, station, policy, controller)
        if arm is not None:
            wire_posture(builder, scenario, station, arm, q_start)
        else:
            wire_guide(builder, scenario, q_start)
        if modulated:
            wire_null_space(builder, scenario, station, robot_plant, q_start)
        wire_world(builder, scenario, station)
        wire_orientation(builder, scenario)
        if modulated:
            for name, port in wire_turn(builder, scenario, robot_plant).items():
                log_signal(builder, name, port)
        for name, port in orientation_signals(builder).items():
            log_signal(builder, name, port)
        if modulated and scenario.supervisor is not None:
            wire_supervisor(builder, scenario, station, robot_plant)
    if meshcat is not None:
        _wire_view(builder, scenario, station, meshcat)
    diagram = builder.Build()
    diagram.set_name("avoidance")
    return diagram


def _wire_perception(
    builder: DiagramBuilder,
    scenario: Scenario,
    station: Station | None,
    robot_plant: RobotPlant | None,
) -> OutputPort:
    """Perception and descriptor; returns the port with the ellipsoids."""
    source = scenario.perception
    perception = builder.AddNamedSystem(
        "perception", layers.make_perception(scenario, station, robot_plant)
    )
    if station is None or robot_plant is None or isinstance(source, GivenEllipsoids):
        return perception.get_output_port()
    if isinstance(source, DepthCamera):
        camera = station.cameras[source.camera]
        pose, depth = camera.pose, camera.depth_image
        noise = layers.make_depth_noise(scenario, station)
        if noise is not None:
            builder.AddNamedSystem("depth_noise", noise)
            builder.Connect(depth, noise.get_input_port())
            depth = noise.get_output_port()
        state = station.plant.get_state_output_port(station.robot)
        if camera.image_time is not None and camera.plant_state is not None:
            # The self filter takes the robot as it was when the image was taken.
            then = builder.AddNamedSystem("robot_at_image", layers.make_robot_state(station))
            builder.Connect(camera.plant_state, then.get_input_port())
            builder.Connect(camera.image_time, perception.GetInputPort("image_stamp"))
            state = then.get_output_port()
        faults = fault_layers.make_camera_faults(scenario, station, robot_plant)
        if faults is not None:
            builder.AddNamedSystem("camera_faults", faults)
            builder.Connect(depth, faults.GetInputPort("depth_image"))
            builder.Connect(pose, faults.GetInputPort("camera_pose"))
            builder.Connect(state, faults.GetInputPort("robot_state"))
            depth, state = faults.GetOutputPort("depth_image"), faults.GetOutputPort("robot_state")
            builder.Connect(
                faults.GetOutputPort("image_stamp"), perception.GetInputPort("image_stamp")
            )
        builder.Connect(depth, perception.GetInputPort("depth_image"))
        builder.Connect(pose, perception.GetInputPort("camera_pose"))
        builder.Connect(state, perception.GetInputPort("robot_state"))
    if isinstance(source, GroundTruth):
        builder.Connect(
            station.scene_graph.get_query_output_port(), perception.GetInputPort("query_object")
        )
    descriptor = builder.AddNamedSystem(
        "ellipsoid_descriptor", layers.make_ellipsoid_descriptor(scenario, robot_plant)
    )
    builder.Connect(perception.GetOutputPort("obstacles_W"), descriptor.GetInputPort("obstacles_W"))
    return descriptor.GetOutputPort("ellipsoids_W")


def _wire_decision(
    builder: DiagramBuilder,
    scenario: Scenario,
    seen: OutputPort,
    policy: DmpIntegrator,
    goal: LeafSystem,
    *,
    shown: bool,
    arm: RobotArm | None,
) -> None:
    """Regulation and, where they are used or shown, cost rings."""
    chain = builder.AddNamedSystem("regressor_chain", layers.make_regressor_chain(scenario, arm))
    for system in (chain, policy):
        builder.Connect(seen, system.GetInputPort("ellipsoids_W"))
    state = policy.GetOutputPort("policy_state")
    unguided = isinstance(scenario.regulation, Regressor) and not scenario.regulation.guided
    if shown or not (unguided or isinstance(chain, VerifiedRegressorChain)):
        rings = builder.AddNamedSystem(
            "cost_ring_selector", layers.make_cost_ring_selector(scenario)
        )
        builder.Connect(seen, rings.GetInputPort("ellipsoids_W"))
        builder.Connect(state, rings.GetInputPort("policy_state"))
        builder.Connect(goal.get_output_port(), rings.GetInputPort("goal"))
    builder.Connect(
        chain.GetOutputPort("coupling_parameters"), policy.GetInputPort("coupling_parameters")
    )
    if isinstance(chain, VerifiedRegressorChain):
        builder.Connect(state, chain.GetInputPort("policy_state"))
        builder.Connect(goal.get_output_port(), chain.GetInputPort("goal"))
        for name in ("shortfall", "short_of", "lowered"):
            log_signal(builder, name, chain.GetOutputPort(name))
        log_signal(builder, "decision_regulation", chain.GetOutputPort("decision"))
        return
    if unguided:
        builder.Connect(state, chain.GetInputPort("policy_state"))
        return
    builder.Connect(rings.GetOutputPort("decision"), policy.GetInputPort("route"))
    if scenario.policy.descriptor == "route":
        builder.Connect(rings.GetOutputPort("decision"), chain.GetInputPort("route"))
    else:
        builder.Connect(state, chain.GetInputPort("policy_state"))


def wire_world(builder: DiagramBuilder, scenario: Scenario, station: Station) -> None:
    """What pushes the robot, and drives obstacles; these being there, the world is logged."""
    plant = station.plant
    push = fault_layers.make_push(scenario, station)
    if push is not None:
        builder.AddNamedSystem("push", push)
        builder.Connect(push.get_output_port(), plant.get_applied_spatial_force_input_port())
    movers = fault_layers.make_obstacle_movers(scenario, station)
    for name, mover in movers.items():
        builder.AddNamedSystem(f"mover_{name}", mover)
        instance = plant.GetModelInstanceByName(name)
        builder.Connect(plant.get_state_output_port(instance), mover.GetInputPort("obstacle_state"))
        builder.Connect(mover.GetOutputPort("force"), plant.get_actuation_input_port(instance))
    if movers:
        log_signal(builder, "plant_state", plant.get_state_output_port())


def _wire_robot(
    builder: DiagramBuilder,
    scenario: Scenario,
    station: Station,
    policy: DmpIntegrator,
    controller: CartesianInverseDynamics,
) -> None:
    """Policy to controller to plant, and back."""
    builder.AddNamedSystem("controller", controller)
    state = station.plant.get_state_output_port(station.robot)
    builder.Connect(state, controller.GetInputPort("robot_state"))
    for name in ("desired_position", "desired_velocity"):
        builder.Connect(policy.GetOutputPort(name), controller.GetInputPort(name))
    acceleration = policy.GetOutputPort("desired_acceleration")
    integral = robot_layers.make_integral_action(scenario)
    if integral is not None:
        builder.AddNamedSystem("integral_action", integral)
        builder.Connect(
            controller.GetOutputPort("tracking_error"), integral.GetInputPort("tracking_error")
        )
        builder.Connect(acceleration, integral.GetInputPort("desired_acceleration"))
        acceleration = integral.get_output_port()
    builder.Connect(acceleration, controller.GetInputPort("desired_acceleration"))
    actuation = controller.GetOutputPort("actuation")
    weak = fault_layers.make_weak_actuators(scenario, station)
    if weak is not None:
        builder.AddNamedSystem("weak_actuators", weak)
        builder.Connect(actuation, weak.get_input_port())
        actuation = weak.get_output_port()
    builder.Connect(actuation, station.plant.get_actuation_input_port(station.robot))
    log_signal(builder, "robot_state", state)
    log_signal(builder, "actuation", actuation)
    for name in ("torque_saturation", "tracking_error"):
        log_signal(builder, name, controller.GetOutputPort(name))


def _wire_view(
    builder: DiagramBuilder, scenario: Scenario, station: Station | None, meshcat: Meshcat
) -> None:
    """Drake's own visualisation and the overlay of what our layers think."""
    overlay = builder.AddNamedSystem("overlay", layers.make_overlay(scenario, station, meshcat))
    policy = builder.GetSubsystemByName("dmp_integrator")
    builder.Connect(policy.GetOutputPort("policy_state"), overlay.GetInputPort("policy_state"))
    if builder.HasSubsystemNamed("cost_ring_selector"):
        builder.Connect(_shown_route(builder), overlay.GetInputPort("route"))
    if builder.HasSubsystemNamed("ellipsoid_descriptor"):
        seen = builder.GetSubsystemByName("ellipsoid_descriptor").GetOutputPort("ellipsoids_W")
        cloud = builder.GetSubsystemByName("perception").GetOutputPort("cloud")
        builder.Connect(seen, overlay.GetInputPort("ellipsoids_W"))
        builder.Connect(cloud, overlay.GetInputPort("cloud"))
    elif builder.HasSubsystemNamed("perception"):
        seen = builder.GetSubsystemByName("perception").get_output_port()
        builder.Connect(seen, overlay.GetInputPort("ellipsoids_W"))
    if station is None:
        return
    ApplyVisualizationConfig(
        VisualizationConfig(
            publish_period=1.0 / 30.0, publish_contacts=False, publish_proximity=False
        ),
        builder,
        plant=station.plant,
        scene_graph=station.scene_graph,
        meshcat=meshcat,
    )
    builder.Connect(station.plant.get_body_poses_output_port(), overlay.GetInputPort("body_poses"))
    if isinstance(scenario.perception, DepthCamera) and station.cameras:
        pose = station.cameras[scenario.perception.camera].pose
        builder.Connect(pose, overlay.GetInputPort("camera_pose"))


def _shown_route(builder: DiagramBuilder) -> OutputPort:
    """The route that the motion takes: a verified one need not take the rings' side."""
    route = builder.GetSubsystemByName("cost_ring_selector").GetOutputPort("route")
    chain = builder.GetSubsystemByName("regressor_chain")
    if not isinstance(chain, VerifiedRegressorChain):
        return route
    taken = builder.AddNamedSystem("taken_route", TakenRoute())
    builder.Connect(route, taken.GetInputPort("route"))
    builder.Connect(
        chain.GetOutputPort("coupling_parameters"), taken.GetInputPort("coupling_parameters")
    )
    return taken.get_output_port()
