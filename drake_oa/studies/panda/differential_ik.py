"""Drake's differential inverse kinematics on the simulated station, along the pre-planned motion.

    goal -> dmp_integrator [-> orientation_integrator] -> tool_pose -> desired_poses ->
    differential_ik -> commanded_position (integral), commanded_velocity (held) -> commanded_state
    [goal's joints ->] posture -> differential_ik
    commanded_position [+ where the moving obstacles are] -> differential_ik

    commanded_state -> controller -> actuation -> effort_limits -> plant

The program starts from the commanded positions. At each step of
`DifferentialInverseKinematicsSystem` a quadratic program finds the joint velocity that brings the
tool nearest to the asked pose, subject to joint velocity limits and, for every pair (robot link,
thing) with padded distance phi = d - p below the influence distance, to

    phi + (dphi/dq) v dt >= s,

so that a pair keeps s + p. The safety distance s is the smaller of what tool and arm keep, and
the padding p is what a pair keeps besides. Between d = 0 and d = p the gradient of Drake 1.51
has the wrong sign (RobotLocomotion/drake#25016), and the program would drive such a pair
further in: with s > 0 this region lies s inside of what is kept.
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import math
import os
import sys
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.inverse_kinematics import DifferentialInverseKinematicsSystem
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.planning import DofMask, JointLimits, RobotDiagramBuilder, SceneGraphCollisionChecker
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamicsController
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem, OutputPort
from pydrake.systems.primitives import (
    Adder,
    AffineSystem,
    BusCreator,
    ConstantVectorSource,
    DiscreteTimeIntegrator,
    MatrixGain,
    Multiplexer,
    Saturation,
    ZeroOrderHold,
)

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import BoolArray, FloatArray, HoldCause, PolicyState
from drake_oa.common.wires import Wires
from drake_oa.diagrams.control import make_guide_follower
from drake_oa.diagrams.faults import add_drivers
from drake_oa.diagrams.motion import (
    add_orientation,
    make_dmp,
    make_dmp_integrator,
    make_goal,
    make_orientation_integrator,
)
from drake_oa.geometry.rotation import rotation_vector
from drake_oa.policy.dmp import normalised_time, trajectory
from drake_oa.policy.orientation_dmp import exponential, rotation_matrix
from drake_oa.robot.config import Robot
from drake_oa.robot.grasped_object import part_carried, tool_links
from drake_oa.robot.plant import TOOL_FRAME, make_robot_plant
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.simulation import (
    ARRIVED,
    AT_THE_GOAL,
    LATEST_END,
    STILL,
    Ending,
    MotionWatcher,
    run_motion,
)
from drake_oa.safety.supervision import Supervision
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.station import Station, add_world, make_station

_EDGE_STEP = 0.1
"""The collision checker wants a step for checks of edges, which are not used here [rad]."""
_FINGER_PULL = 0.01
"""How far the posture's fingers are from those of the robot [m]: see `posture`."""


@dataclass(frozen=True)
class PeerParameters:
    """What may be chosen about the method.

    Attributes:
        tool_distance: what the tool keeps from obstacles [m].
        arm_distance: what the other links keep from obstacles, and every link from
            the rest of the world [m].
        self_distance: what links keep from one another [m]. Not 0, where the gradient's sign
            changes; links of the UR5 that cannot come apart are 13 mm from one another.
        influence: pairs further apart than their distance and this are left out [m].
        horizon: dt of the collision constraint [s]: a link may use up the distance that
            is left to it within this time, and no faster. With the policy's step of 8 ms
            for it, the program was left without a solution in 8 of 9 scenes; with 0.3 s
            in 1.
        gain: share of the pose error that the asked velocity makes up in a step.
        speed_share: largest asked tool velocity along an axis, as a multiple of the
            planned motion's greatest speed.
        angular_limit: largest asked tool rate about an axis [rad/s].
        posture_gain: pull to the posture of the start in the null space [1/s].
        weight: of the tool's velocity error against the posture's.
        kp: stiffness of the joint controller [1/s^2].
        kd: its damping [1/s].
    """

    tool_distance: float = 0.03
    arm_distance: float = 0.02
    self_distance: float = 0.005
    influence: float = 0.2
    horizon: float = 0.3
    gain: float = 0.2
    speed_share: float = 1.2
    angular_limit: float = 2.5
    posture_gain: float = 1.0
    weight: float = 100.0
    kp: float = 2500.0
    kd: float = 100.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not math.isfinite(value) or value < 0.0:
                raise ValueError(
                    f"PeerParameters.{item.name} is {value}; it must be finite and not negative"
                )
            if value == 0.0 and item.name in ("horizon", "gain"):
                raise ValueError(f"PeerParameters.{item.name} is 0; it must be positive")

    @property
    def safety_distance(self) -> float:
        """The distance that tool and arm both keep from obstacles [m]."""
        return min(self.tool_distance, self.arm_distance)


def look_ahead(period: float, parameters: PeerParameters) -> float:
    """How far ahead the plan is asked for, so that the robot is on it in time [s].

    Making up the share g of an error at each step h, the command follows a steady motion
    h (1 / g - 1) late at the end of the step; it is given at its beginning and is held, so
    that it is half a step early there.
    """
    return period * (1.0 / parameters.gain - 0.5)


def posture(robot: Robot, q_start: FloatArray) -> FloatArray:
    """(n,) posture that the null space is pulled to: the start, fingers out of place.

    The fingers do not follow: their velocity is limited to zero. That limit is so always
    active, and OSQP refines (and says nothing about) a solution only where a constraint is.
    """
    q = np.array(q_start, dtype=float)
    q[len(robot.q_seed) :] += _FINGER_PULL
    return q


def joint_limits(plant: MultibodyPlant, robot: Robot) -> JointLimits:
    """The plant's own limits, and no velocity for the joints of the hand."""
    limits = JointLimits(plant)
    own = robot_dofs(plant)
    arm = np.arange(own.sum()) < len(robot.q_seed)
    return JointLimits(
        limits.position_lower()[own],
        limits.position_upper()[own],
        np.where(arm, limits.velocity_lower()[own], 0.0),
        np.where(arm, limits.velocity_upper()[own], 0.0),
        limits.acceleration_lower()[own],
        limits.acceleration_upper()[own],
    )


def robot_dofs(plant: MultibodyPlant) -> BoolArray:
    """(nq,) which positions are the robot's."""
    robot = plant.GetFrameByName(TOOL_FRAME).model_instance()
    marked = np.zeros(plant.num_positions())
    plant.SetPositionsInArray(robot, np.ones(plant.num_positions(robot)), marked)
    return marked > 0.0


def make_collision_checker(
    scenario: Scenario, parameters: PeerParameters
) -> SceneGraphCollisionChecker:
    """The collision model of a scenario's world, the same as the station's.

    Links that no joint moves are left out: no velocity changes what they keep.

    Raises:
        ScenarioError: if something can move besides the robot and the obstacles that the
            scenario drives, of which the method is told where they are.
    """
    builder = RobotDiagramBuilder(time_step=0.0)
    plant = builder.plant()
    instance = add_world(plant, scenario)
    plant.Finalize()
    part_carried(plant, builder.scene_graph(), scenario.robot)
    driven = sum(plant.num_positions(other) for other in _driven_instances(plant, scenario))
    if plant.num_positions() != plant.num_positions(instance) + driven:
        raise ScenarioError(
            "directives: something besides the robot and the obstacles that are driven can move; "
            "differential inverse kinematics needs to know where everything is"
        )
    checker = SceneGraphCollisionChecker(
        model=builder.Build(), robot_model_instances=[instance], edge_step_size=_EDGE_STEP
    )
    _pad(checker, instance, scenario, parameters)
    return checker


def _pad(
    checker: SceneGraphCollisionChecker,
    instance: ModelInstanceIndex,
    scenario: Scenario,
    parameters: PeerParameters,
) -> None:
    plant = checker.plant()
    of_tool = tool_links(scenario.robot) if scenario.robot else []
    safety = parameters.safety_distance
    checker.SetPaddingAllRobotEnvironmentPairs(parameters.arm_distance - safety)
    checker.SetPaddingAllRobotRobotPairs(parameters.self_distance - safety)
    for link in map(plant.get_body, plant.GetBodyIndices(instance)):
        if plant.IsAnchored(link):
            checker.SetCollisionFilteredWithAllBodies(link.index())
            continue
        if link.name() in of_tool:
            for thing in _obstacle_bodies(plant):
                checker.SetPaddingBetween(
                    link.index(), thing.index(), parameters.tool_distance - safety
                )


def _driven_instances(plant: MultibodyPlant, scenario: Scenario) -> list[ModelInstanceIndex]:
    return [
        plant.GetModelInstanceByName(f"{OBSTACLE_PREFIX}_{obstacle.name}")
        for obstacle in scenario.obstacles
        if obstacle.driven
    ]


def position_orders(plant: MultibodyPlant, scenario: Scenario) -> dict[str, FloatArray]:
    """Model instance -> (nq, n) matrix that takes its positions to their places in the plant's.

    Of the robot, the first, and of the obstacles that the scenario drives.
    """
    robot = plant.GetFrameByName(TOOL_FRAME).model_instance()
    orders = {}
    for instance in (robot, *_driven_instances(plant, scenario)):
        columns = np.zeros((plant.num_positions(), plant.num_positions(instance)))
        for row, unit in enumerate(np.eye(columns.shape[1])):
            q = np.zeros(plant.num_positions())
            plant.SetPositionsInArray(instance, unit, q)
            columns[:, row] = q
        orders[plant.GetModelInstanceName(instance)] = columns
    return orders


def of_state(order: FloatArray) -> FloatArray:
    """(nq, 2 n) matrix that takes a state, positions and as many velocities, to (nq, n) order."""
    return np.hstack([order, np.zeros_like(order)])


def _obstacle_bodies(plant: MultibodyPlant) -> list[RigidBody]:
    """Bodies of the model instances that are obstacles by name."""
    return [
        plant.get_body(index)
        for instance in map(ModelInstanceIndex, range(plant.num_model_instances()))
        if plant.GetModelInstanceName(instance).startswith(OBSTACLE_PREFIX)
        for index in plant.GetBodyIndices(instance)
    ]


def tool_frame_name(plant: MultibodyPlant) -> str:
    """Scoped name of the tool point's frame E."""
    return str(plant.GetFrameByName(TOOL_FRAME).scoped_name().get_full())


def make_differential_ik(
    scenario: Scenario, checker: SceneGraphCollisionChecker, parameters: PeerParameters
) -> DifferentialInverseKinematicsSystem:
    """The system with its program; it is to be asked every `scenario.policy.period`.

    Raises:
        ScenarioError: if the scenario has no robot.
    """
    if scenario.robot is None:
        raise ScenarioError("robot: differential inverse kinematics needs one; it is null")
    System, plant = DifferentialInverseKinematicsSystem, checker.plant()
    tracking = System.LeastSquaresCost.Config(cartesian_qp_weight=parameters.weight)
    centering = System.JointCenteringCost.Config(posture_gain=parameters.posture_gain)
    collision = System.CollisionConstraint.Config(
        safety_distance=parameters.safety_distance,
        influence_distance=parameters.safety_distance + parameters.influence,
    )
    recipe = System.Recipe()
    recipe.AddIngredient(System.LeastSquaresCost(tracking))
    recipe.AddIngredient(System.JointCenteringCost(centering))
    recipe.AddIngredient(
        System.JointVelocityLimitConstraint(
            System.JointVelocityLimitConstraint.Config(), joint_limits(plant, scenario.robot)
        )
    )
    recipe.AddIngredient(System.CollisionConstraint(collision))
    return System(
        recipe=recipe,
        task_frame=plant.world_frame().scoped_name().get_full(),
        collision_checker=checker,
        active_dof=DofMask([bool(own) for own in robot_dofs(plant)]),
        time_step=parameters.horizon,
        # The system asks for gain (X - X_now) / time_step; the step is the policy's.
        K_VX=parameters.gain * parameters.horizon / scenario.policy.period,
        Vd_TG_limit=SpatialVelocity(
            w=np.full(3, parameters.angular_limit),
            v=np.full(3, parameters.speed_share * _planned_speed(scenario)),
        ),
    )


def _planned_speed(scenario: Scenario) -> float:
    """Greatest speed of the planned motion [m/s]."""
    dmp = make_dmp(scenario)
    planned = trajectory(dmp, scenario.task.start, scenario.task.goal)
    return float(np.linalg.norm(planned.z, axis=1).max()) / dmp.duration


def make_joint_controller(
    plant: MultibodyPlant, parameters: PeerParameters
) -> InverseDynamicsController:
    """Drake's inverse dynamics controller over all joints of a plant."""
    n = plant.num_positions()
    return InverseDynamicsController(
        plant,
        kp=np.full(n, parameters.kp),
        ki=np.zeros(n),
        kd=np.full(n, parameters.kd),
        has_reference_acceleration=False,
    )


def build_differential_ik(
    scenario: Scenario, q_start: FloatArray, parameters: PeerParameters
) -> Diagram:
    """Wires the peer on a scenario's station.

    Subsystems by name: plant, scene_graph, goal, dmp_integrator, tool_pose, desired_poses,
    differential_ik, posture, mover_<model instance>, commanded_position, commanded_velocity,
    commanded_state, controller, actuation, effort_limits, log_<signal>; where obstacles
    move also positions_<model instance> and world_positions; where the tool turns
    orientation_integrator; where the joints at the goal are given posture_guide and
    guide_follower.

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
    plant = station.plant
    plant.SetDefaultPositions(station.robot, q_start)
    wires = Wires(builder)
    wires.offer("plant_state", plant.get_state_output_port())
    add_drivers(wires, scenario, station)
    position, velocity = _wire_command(wires, scenario, station, q_start, parameters)
    command = builder.AddNamedSystem("commanded_state", Multiplexer([len(q_start)] * 2))
    builder.Connect(position, command.get_input_port(0))
    builder.Connect(velocity, command.get_input_port(1))
    # The arm's dynamics are its own: of driven obstacles the controller need not know.
    alone = plant.num_positions() == plant.num_positions(station.robot)
    model = plant if alone else make_robot_plant(scenario.robot).plant
    _wire_controller(wires, station, model, command.get_output_port(), parameters)
    wires.connect()
    diagram = builder.Build()
    diagram.set_name(METHOD)
    return diagram


def _wire_motion(wires: Wires, scenario: Scenario) -> None:
    """The pre-planned motion, and where the tool turns that of its orientation."""
    wires.add("goal", make_goal(scenario), offers={"y0": "goal"})
    wires.add("dmp_integrator", make_dmp_integrator(scenario))
    wires.log("goal", "desired_position", "desired_velocity", "desired_acceleration", "phase")
    orientation = make_orientation_integrator(scenario)
    if orientation is not None:
        add_orientation(wires, orientation)


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
            order = of_state(order)
        placed = builder.AddNamedSystem(f"positions_{name}", MatrixGain(order))
        builder.Connect(source, placed.get_input_port())
        builder.Connect(placed.get_output_port(), whole.get_input_port(number))
    return whole.get_output_port()


def _wire_command(
    wires: Wires,
    scenario: Scenario,
    station: Station,
    q_start: FloatArray,
    parameters: PeerParameters,
) -> tuple[OutputPort, OutputPort]:
    """From the pre-planned motion to the commanded positions and velocities."""
    robot = scenario.robot
    if robot is None:
        raise ScenarioError("robot: differential inverse kinematics needs one; it is null")
    period = scenario.policy.period
    builder = wires.builder
    _wire_motion(wires, scenario)
    R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix()
    pose = wires.add("tool_pose", ToolPose(R_WE, look_ahead=look_ahead(period, parameters)))

    checker = make_collision_checker(scenario, parameters)
    ik = builder.AddNamedSystem(
        "differential_ik", make_differential_ik(scenario, checker, parameters)
    )
    poses = builder.AddNamedSystem("desired_poses", BusCreator())
    poses.DeclareAbstractInputPort(tool_frame_name(checker.plant()), Value(RigidTransform()))
    wires.take(pose.get_output_port().get_name(), poses.get_input_port(0))
    builder.Connect(poses.get_output_port(), ik.GetInputPort("desired_cartesian_poses"))
    orders = position_orders(checker.plant(), scenario)
    _wire_posture(wires, scenario, q_start, next(iter(orders.values())))
    wires.take("nominal_posture", ik.GetInputPort("nominal_posture"))

    position = builder.AddNamedSystem(
        "commanded_position", DiscreteTimeIntegrator(len(q_start), period)
    )
    velocity = builder.AddNamedSystem("commanded_velocity", ZeroOrderHold(period, len(q_start)))
    for held in (position, velocity):
        builder.Connect(ik.GetOutputPort("commanded_velocity"), held.get_input_port())
    whole = _wire_positions(builder, orders, station, position.get_output_port())
    builder.Connect(whole, ik.GetInputPort("position"))
    return position.get_output_port(), velocity.get_output_port()


def _wire_posture(wires: Wires, scenario: Scenario, q_start: FloatArray, order: FloatArray) -> None:
    """The posture of the start, or what leads from it to the goal's joints where they are given.

    Args:
        wires: offers nominal_posture.
        scenario: with a robot.
        q_start: (n,) all positions of the robot at the start.
        order: (nq, n) matrix that takes them to their places in the plant's.
    """
    robot = scenario.robot or Robot()
    # The obstacles have none: of their zeros nothing is asked.
    rest = order @ posture(robot, q_start)
    made = make_guide_follower(scenario, q_start)
    if made is None:
        wires.add("posture", ConstantVectorSource(rest), offers={"y0": "nominal_posture"})
        return
    follower, guide = made
    wires.add("posture_guide", guide, offers={"y0": "guided_posture"})
    wires.add("guide_follower", follower, reads={"motion": "guided_posture", "evading": None})
    n = len(robot.q_seed)
    of_arm, none = order[:, :n], np.zeros((0, 0))
    whole = AffineSystem(
        A=none,
        B=np.zeros((0, 2 * n)),
        f0=np.zeros(0),
        C=np.zeros((len(order), 0)),
        D=np.hstack([of_arm, np.zeros_like(of_arm)]),
        y0=rest - of_arm @ q_start[:n],
    )
    wires.add("posture", whole, reads={"u0": "desired_posture"}, offers={"y0": "nominal_posture"})


def _wire_controller(
    wires: Wires,
    station: Station,
    model: MultibodyPlant,
    command: OutputPort,
    parameters: PeerParameters,
) -> None:
    """From commanded positions and velocities to the plant, and back; model: of the robot."""
    builder = wires.builder
    plant = station.plant
    state = plant.get_state_output_port(station.robot)
    controller = builder.AddNamedSystem("controller", make_joint_controller(model, parameters))
    builder.Connect(state, controller.get_input_port_estimated_state())
    builder.Connect(command, controller.get_input_port_desired_state())
    actuation = builder.AddNamedSystem("actuation", MatrixGain(model.MakeActuationMatrix().T))
    effort = model.GetEffortUpperLimits()
    limits = builder.AddNamedSystem("effort_limits", Saturation(-effort, effort))
    builder.Connect(controller.get_output_port_control(), actuation.get_input_port())
    builder.Connect(actuation.get_output_port(), limits.get_input_port())
    builder.Connect(limits.get_output_port(), plant.get_actuation_input_port(station.robot))
    wires.offer("robot_state", state)
    wires.offer("actuation", limits.get_output_port())
    wires.log("robot_state", "actuation")


class ToolPose(LeafSystem):
    """The pose that a moving tool has a moment later.

    .. pydrake_system::

      name: ToolPose
      input_ports:
      - desired_position
      - desired_velocity
      - desired_orientation (optional)
      - desired_angular_velocity (optional)
      output_ports:
      - desired_pose

    - desired_position: (3,) p_WE [m].
    - desired_velocity: (3,) v_WE [m/s].
    - desired_orientation (optional): (4,) quaternion w, x, y, z of R_WE. Without it the
      orientation is the one given once.
    - desired_angular_velocity (optional): (3,) w_WE [rad/s].
    - desired_pose: abstract `RigidTransform` X_WE: p_WE + look_ahead v_WE, and
      exp(look_ahead w_WE) R_WE.

    There is no state.
    """

    def __init__(self, R_WE: RotationMatrix, *, look_ahead: float = 0.0) -> None:
        """Declares the ports.

        Args:
            R_WE: orientation of the tool where none is connected.
            look_ahead: how much later [s]; finite.

        Raises:
            ValueError: if look_ahead is not finite.
        """
        super().__init__()
        if not np.isfinite(look_ahead):
            raise ValueError(f"look_ahead must be finite [s], not {look_ahead}")
        self._R_WE = R_WE
        self._look_ahead = float(look_ahead)
        self._position = self.DeclareVectorInputPort("desired_position", 3)
        self._velocity = self.DeclareVectorInputPort("desired_velocity", 3)
        self._orientation = self.DeclareVectorInputPort("desired_orientation", 4)
        self._turning = self.DeclareVectorInputPort("desired_angular_velocity", 3)
        self.DeclareAbstractOutputPort(
            "desired_pose", lambda: Value(RigidTransform()), self._calc_pose
        )

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        ahead = self._position.Eval(context) + self._look_ahead * self._velocity.Eval(context)
        R_WE = self._R_WE
        if self._orientation.HasValue(context):
            R = rotation_matrix(self._orientation.Eval(context))
            if self._turning.HasValue(context):
                turn = exponential(self._look_ahead * self._turning.Eval(context))
                R = rotation_matrix(turn) @ R
            R_WE = RotationMatrix(R)
        output.set_value(RigidTransform(R_WE, ahead))


STUCK_TIME = 1.0
"""A tool that stands still for this long after the planned motion is over is stuck [s]."""
STUCK_DISTANCE = 1e-3
"""It stands still while it stays this near to where it was [m]."""
METHOD = "DifferentialInverseKinematics"
"""The log's `regulation`."""
NO_VELOCITY = "held: no joint velocity keeps the distances"
"""The note while the program has no solution: Drake then commands no velocity."""
_AT_REST = 1e-5
"""A command of exactly zero is no solution while the tool is asked further than this [m]."""


class _ToolWatcher(MotionWatcher):
    """Looks after each step at where the tool is, and ends the run."""

    def __init__(
        self,
        diagram: Diagram,
        scenario: Scenario,
        duration: float | None,
        on_progress: Callable[[float, float], None] | None,
    ) -> None:
        super().__init__(diagram, scenario, duration, on_progress=on_progress)
        self._duration = make_dmp(scenario).duration
        self._recent: deque[tuple[float, FloatArray]] = deque()
        self._command = diagram.GetSubsystemByName("commanded_velocity")

    def _record(
        self, root: Context, now: float, policy: PolicyState, supervision: Supervision
    ) -> None:
        lag = math.dist(policy.p_WE, self.tool_point(root))
        command = self._command.get_output_port().Eval(self._command.GetMyContextFromRoot(root))
        held = lag > _AT_REST and not command.any()
        self._note(now, *((HoldCause.OBSTACLES, NO_VELOCITY) if held else (HoldCause.NONE, "")))

    def _why_ended(
        self, root: Context, now: float, policy: PolicyState, supervision: Supervision
    ) -> Ending | None:
        p_WE = self.tool_point(root)
        s = normalised_time(policy.phase, self._alpha_k)
        error = math.dist(p_WE, policy.p_WG)
        if s >= 1.0 - 1e-9:
            if error < ARRIVED and self._speed(now, p_WE) * self._duration < STILL * ARRIVED:
                return AT_THE_GOAL
            if now >= self.world_end and self._stands_still(now, p_WE):
                note = self.events[-1][2] if self.events else ""
                why = f"stuck {1e3 * error:.1f} mm short of the goal" + (
                    f" ({note})" if note else ""
                )
                return Ending(MotionEnd.STUCK, why)
        self._remember(now, p_WE)
        if s >= LATEST_END and now >= self.world_end:
            why = f"goal missed by {1e3 * error:.1f} mm at s = {LATEST_END:g}"
            return Ending(MotionEnd.MISSED, why)
        return self._time_limit() if now >= self._end_time else None

    def _remember(self, now: float, p_WE: FloatArray) -> None:
        self._recent.append((now, p_WE))
        while now - self._recent[0][0] > STUCK_TIME:
            self._recent.popleft()

    def _speed(self, now: float, p_WE: FloatArray) -> float:
        if not self._recent:
            return math.inf
        then, before = self._recent[-1]
        return math.dist(p_WE, before) / (now - then)

    def _stands_still(self, now: float, p_WE: FloatArray) -> bool:
        long_enough = bool(self._recent) and now - self._recent[0][0] > STUCK_TIME - self._period
        return long_enough and all(
            math.dist(p_WE, before) < STUCK_DISTANCE for _, before in self._recent
        )


@contextlib.contextmanager
def _without_solver_messages() -> Iterator[None]:
    """Drake warns at every step that has no solution; the log has one note for them all.

    And OSQP prints wherever no constraint is active, as of an arm whose joints all move.
    """

    def is_other(record: logging.LogRecord) -> bool:
        return "QP failed to solve" not in record.getMessage()

    logger = logging.getLogger("drake")
    logger.addFilter(is_other)
    sys.stdout.flush()
    out, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    try:
        yield
    finally:
        # What is printed from C waits in a buffer of its own.
        ctypes.CDLL(None).fflush(None)
        os.dup2(out, 1)
        os.close(out)
        os.close(nowhere)
        logger.removeFilter(is_other)


def simulate_differential_ik(
    scenario: Scenario,
    *,
    duration: float | None = None,
    on_progress: Callable[[float, float], None] | None = None,
    parameters: PeerParameters | None = None,
) -> MotionLog:
    """Runs one motion of the peer until the goal, a standstill or the time limit.

    Until the planned duration is over the tool is asked along the planned motion, and
    then to the goal. The motion ends with the reason "goal" when the tool itself has
    arrived as near as `drake_oa.runs.simulation.simulate` asks of the desired motion,
    "stuck ..." when it has stood still for `STUCK_TIME` after the planned duration,
    and "goal missed ..." at `LATEST_END` durations. Where the program has no solution
    the robot is held, and `event` says so.

    Args:
        scenario: with a robot; its perception and regulation are not used.
        duration: time limit [s]; None: `LONGEST_SCALING` demonstrated durations.
        on_progress: called with time [s] and phase, a few hundred times a second.
        parameters: of the method; None: the defaults.

    Returns:
        The log; `regulation` is `METHOD`, and there are no observations.

    Raises:
        ScenarioError: if the scenario has no robot, or its start or goal is out of reach.
        MotionInterruptedError: if the simulation raised or was interrupted; it
            carries the log until then, and the cause.
    """
    q_start = start_positions(scenario)
    diagram = build_differential_ik(scenario, q_start, parameters or PeerParameters())
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    integral = diagram.GetSubsystemByName("commanded_position")
    integral.set_integral_value(integral.GetMyMutableContextFromRoot(root), q_start)
    with _without_solver_messages():
        return _run(scenario, simulator, duration, on_progress)


def _run(
    scenario: Scenario,
    simulator: Simulator,
    duration: float | None,
    on_progress: Callable[[float, float], None] | None,
) -> MotionLog:
    watcher = _ToolWatcher(simulator.get_system(), scenario, duration, on_progress)
    log = run_motion(scenario, simulator, watcher, modulated=True)
    saturated = (np.abs(log.torque) >= log.effort_limit).any(axis=1).astype(float)
    log = replace(log, regulation=METHOD, saturated=saturated)
    if not len(log.desired_orientation) or scenario.robot is None:
        return log
    left = np.zeros((len(log.t), 3))
    for row, X_WE in enumerate(make_robot_plant(scenario.robot).tool_poses(log.q)):
        desired = rotation_matrix(log.desired_orientation[row])
        left[row] = rotation_vector(np.ascontiguousarray(desired @ X_WE.rotation().matrix().T))
    return replace(log, orientation_error=left)
