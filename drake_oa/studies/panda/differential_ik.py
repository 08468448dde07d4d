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
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.inverse_kinematics import DifferentialInverseKinematicsSystem
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.planning import DofMask, JointLimits, RobotDiagramBuilder, SceneGraphCollisionChecker
from pydrake.systems.analysis import Simulator
from pydrake.systems.controllers import InverseDynamicsController
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem
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
from scipy.spatial.transform import Rotation

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray, HoldCause, IntArray, PolicyState
from drake_oa.common.wires import Wires
from drake_oa.diagrams.control import add_guide_follower
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
from drake_oa.policy.orientation_dmp import rotation_matrix
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
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.world.station import Station, make_station
from drake_oa.world.world_model import add_world

_EDGE_STEP = 0.1
"""Step of the collision checker's checks of edges, which are not used here [rad]."""
_FINGER_PULL = 0.01
"""Distance of the nominal posture's fingers from those of the robot [m].

The fingers do not follow: their velocity is limited to zero. That limit is so always active, and
OSQP refines (and says nothing about) a solution only where a constraint is.
"""
SELF_DISTANCE = 0.005
"""Distance that links keep from one another [m]. Not 0, where the gradient's sign changes; links of
the UR5 that cannot come apart are 13 mm from one another."""
INFLUENCE = 0.2
"""Pairs whose distance exceeds the safety distance by more than this are left out [m]."""
HORIZON = 0.3
"""dt of the collision constraint [s]: a link may use up the distance that is left to it within this
time, and no faster. With the policy's step of 8 ms for it, the program was left without a solution
in 8 of 9 scenes; with 0.3 s in 1."""
GAIN = 0.2
"""Share of the pose error that the asked velocity makes up in a step."""
SPEED_SHARE = 1.2
"""Largest asked tool velocity along an axis, as a multiple of the planned motion's greatest
speed."""
ANGULAR_LIMIT = 2.5
"""Largest asked tool rate about an axis [rad/s]."""
POSTURE_GAIN = 1.0
"""Pull to the posture of the start in the null space [1/s]."""
WEIGHT = 100.0
"""Weight of the tool's velocity error against the posture's."""
KP, KD = 2500.0, 100.0
"""Stiffness [1/s^2] and damping [1/s] of the joint controller."""


@dataclass(frozen=True)
class KeptDistances:
    """Distances that the program keeps.

    Attributes:
        tool: of the tool from obstacles [m].
        arm: of the other links from obstacles, and of every link from the rest of the world [m].
    """

    tool: float = 0.03
    arm: float = 0.02

    @property
    def safety(self) -> float:
        """Distance that tool and arm both keep from obstacles [m]."""
        return min(self.tool, self.arm)


_DISTANCES = KeptDistances()


def _robot_positions(plant: MultibodyPlant) -> IntArray:
    """(n,) places of the robot's positions among the plant's."""
    return _positions_of(plant, plant.GetFrameByName(TOOL_FRAME).model_instance())


def _positions_of(plant: MultibodyPlant, instance: ModelInstanceIndex) -> IntArray:
    """(n,) places of a model instance's positions among the plant's."""
    numbered = np.arange(plant.num_positions(), dtype=float)
    return np.asarray(plant.GetPositionsFromArray(instance, numbered), dtype=int)


def joint_limits(plant: MultibodyPlant, robot: Robot) -> JointLimits:
    """Returns the plant's own limits, with a velocity of zero for the joints of the hand."""
    limits, own = JointLimits(plant), _robot_positions(plant)
    arm = np.arange(len(own)) < len(robot.q_seed)
    return JointLimits(
        limits.position_lower()[own],
        limits.position_upper()[own],
        np.where(arm, limits.velocity_lower()[own], 0.0),
        np.where(arm, limits.velocity_upper()[own], 0.0),
        limits.acceleration_lower()[own],
        limits.acceleration_upper()[own],
    )


def make_collision_checker(
    scenario: Scenario, distances: KeptDistances
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
    plant, of_tool = checker.plant(), tool_links(robot_of(scenario))
    checker.SetPaddingAllRobotEnvironmentPairs(distances.arm - distances.safety)
    checker.SetPaddingAllRobotRobotPairs(SELF_DISTANCE - distances.safety)
    obstacles = [
        index
        for other in map(ModelInstanceIndex, range(plant.num_model_instances()))
        if plant.GetModelInstanceName(other).startswith(OBSTACLE_PREFIX)
        for index in plant.GetBodyIndices(other)
    ]
    for link in map(plant.get_body, plant.GetBodyIndices(instance)):
        if plant.IsAnchored(link):
            checker.SetCollisionFilteredWithAllBodies(link.index())
        elif link.name() in of_tool:
            for obstacle in obstacles:
                checker.SetPaddingBetween(link.index(), obstacle, distances.tool - distances.safety)
    return checker


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
    return {
        plant.GetModelInstanceName(instance): np.eye(plant.num_positions())[
            :, _positions_of(plant, instance)
        ]
        for instance in (robot, *_driven_instances(plant, scenario))
    }


def make_differential_ik(
    scenario: Scenario, checker: SceneGraphCollisionChecker, distances: KeptDistances
) -> DifferentialInverseKinematicsSystem:
    """Makes the system with its program, which runs every `scenario.policy.period`."""
    System, plant = DifferentialInverseKinematicsSystem, checker.plant()
    dmp = make_dmp(scenario)
    planned = trajectory(dmp, scenario.task.start, scenario.task.goal)
    greatest_speed = float(np.linalg.norm(planned.z, axis=1).max()) / dmp.duration
    tracking = System.LeastSquaresCost.Config(cartesian_qp_weight=WEIGHT)
    centering = System.JointCenteringCost.Config(posture_gain=POSTURE_GAIN)
    collision = System.CollisionConstraint.Config(
        safety_distance=distances.safety,
        influence_distance=distances.safety + INFLUENCE,
    )
    recipe = System.Recipe()
    recipe.AddIngredient(System.LeastSquaresCost(tracking))
    recipe.AddIngredient(System.JointCenteringCost(centering))
    recipe.AddIngredient(
        System.JointVelocityLimitConstraint(
            System.JointVelocityLimitConstraint.Config(), joint_limits(plant, robot_of(scenario))
        )
    )
    recipe.AddIngredient(System.CollisionConstraint(collision))
    return System(
        recipe=recipe,
        task_frame=plant.world_frame().scoped_name().get_full(),
        collision_checker=checker,
        active_dof=DofMask(np.isin(range(plant.num_positions()), _robot_positions(plant)).tolist()),
        time_step=HORIZON,
        # The system asks for gain (X - X_now) / time_step; the step is the policy's.
        K_VX=GAIN * HORIZON / scenario.policy.period,
        Vd_TG_limit=SpatialVelocity(
            w=np.full(3, ANGULAR_LIMIT),
            v=np.full(3, SPEED_SHARE * greatest_speed),
        ),
    )


def build_differential_ik(
    scenario: Scenario, q_start: FloatArray, distances: KeptDistances
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
        distances: that are kept.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    robot, period, n = robot_of(scenario), scenario.policy.period, len(q_start)
    builder = DiagramBuilder()
    station = make_station(builder, scenario, render=False)
    plant = station.plant
    plant.SetDefaultPositions(station.robot, q_start)
    wires = Wires(builder)
    wires.offer("plant_state", plant.get_state_output_port())
    wires.offer("robot_state", plant.get_state_output_port(station.robot))
    wires.take("actuation", plant.get_actuation_input_port(station.robot))
    add_drivers(wires, scenario, station)

    # The pre-planned motion, and where the tool turns that of its orientation.
    wires.add("goal", make_goal(scenario), offers={"y0": "goal"})
    wires.add("dmp_integrator", make_dmp_integrator(scenario))
    orientation = make_orientation_integrator(scenario)
    if orientation is not None:
        add_orientation(wires, orientation)
    # Making up the share g of an error at each step h, the command follows a steady motion
    # h (1 / g - 1) late at the end of the step; it is given at its beginning and is held, so that
    # it is half a step early there.
    look_ahead = period * (1.0 / GAIN - 0.5)
    R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix()
    wires.add("tool_pose", ToolPose(R_WE, look_ahead=look_ahead))

    # From there to the commanded positions and velocities.
    checker = make_collision_checker(scenario, distances)
    tool = str(checker.plant().GetFrameByName(TOOL_FRAME).scoped_name().get_full())
    poses = BusCreator()
    poses.DeclareAbstractInputPort(tool, Value(RigidTransform()))
    wires.add("desired_poses", poses, reads={tool: "desired_pose"}, offers={"y0": "desired_poses"})
    wires.add(
        "differential_ik",
        make_differential_ik(scenario, checker, distances),
        reads={"desired_cartesian_poses": "desired_poses", "position": "world_positions"},
        offers={"commanded_velocity": "joint_velocity"},
    )
    orders = position_orders(checker.plant(), scenario)
    _wire_positions(wires, orders, station)
    _wire_posture(wires, scenario, q_start, next(iter(orders.values())))
    for name, held in (
        ("commanded_position", DiscreteTimeIntegrator(n, period)),
        ("commanded_velocity", ZeroOrderHold(period, n)),
    ):
        wires.add(name, held, reads={"u": "joint_velocity"}, offers={"y": name})
    wires.add(
        "commanded_state",
        Multiplexer([n, n]),
        reads={"u0": "commanded_position", "u1": "commanded_velocity"},
        offers={"y0": "commanded_state"},
    )

    # From there to the plant. The arm's dynamics are its own: of driven obstacles the controller
    # need not know.
    alone = plant.num_positions() == n
    model = plant if alone else make_robot_plant(robot).plant
    controller = InverseDynamicsController(
        model,
        kp=np.full(n, KP),
        ki=np.zeros(n),
        kd=np.full(n, KD),
        has_reference_acceleration=False,
    )
    wires.add(
        "controller",
        controller,
        reads={"estimated_state": "robot_state", "desired_state": "commanded_state"},
        offers={controller.get_output_port_control().get_name(): "torque"},
    )
    wires.add(
        "actuation",
        MatrixGain(model.MakeActuationMatrix().T),
        reads={"u0": "torque"},
        offers={"y0": "unlimited_actuation"},
    )
    effort = model.GetEffortUpperLimits()
    wires.add(
        "effort_limits",
        Saturation(-effort, effort),
        reads={"u0": "unlimited_actuation"},
        offers={"y0": "actuation"},
    )
    wires.log("goal", "desired_position", "desired_velocity", "desired_acceleration", "phase")
    wires.log("robot_state", "actuation")
    wires.connect()
    diagram = builder.Build()
    diagram.set_name(METHOD)
    return diagram


def _wire_positions(wires: Wires, orders: dict[str, FloatArray], station: Station) -> None:
    """Adds the positions of the whole world: the commanded ones, and those of the obstacles."""
    if len(orders) == 1:
        wires.otherwise("world_positions", "commanded_position")
        return
    plant, (robot, *obstacles) = station.plant, orders
    wires.add(
        "world_positions",
        Adder(len(orders), len(orders[robot])),
        reads={f"u{number}": f"positions_{name}" for number, name in enumerate(orders)},
        offers={"sum": "world_positions"},
    )
    for name in obstacles:
        instance = plant.GetModelInstanceByName(name)
        wires.offer(f"state_{name}", plant.get_state_output_port(instance))
    for name, order in orders.items():
        signal = "commanded_position"
        if name != robot:
            # Of the state, positions and as many velocities, the positions.
            signal, order = f"state_{name}", np.hstack([order, np.zeros_like(order)])
        signals = {"u0": signal}, {"y0": f"positions_{name}"}
        wires.add(f"positions_{name}", MatrixGain(order), reads=signals[0], offers=signals[1])


def _wire_posture(wires: Wires, scenario: Scenario, q_start: FloatArray, order: FloatArray) -> None:
    """Adds the posture of the start, or a guide from it to the goal's joints if they are given.

    Args:
        wires: offers nominal_posture.
        scenario: with a robot.
        q_start: (n,) all positions of the robot at the start.
        order: (nq, n) matrix that takes them to their places in the plant's.
    """
    n = len(robot_of(scenario).q_seed)
    posture = np.array(q_start, dtype=float)
    posture[n:] += _FINGER_PULL
    # The obstacles have no posture: of their zeros nothing is asked.
    rest = order @ posture
    if not add_guide_follower(wires, scenario, q_start):
        wires.add("posture", ConstantVectorSource(rest), offers={"y0": "nominal_posture"})
        return
    of_arm = order[:, :n]
    whole = AffineSystem(
        A=np.zeros((0, 0)),
        B=np.zeros((0, 2 * n)),
        f0=np.zeros(0),
        C=np.zeros((len(order), 0)),
        D=np.hstack([of_arm, np.zeros_like(of_arm)]),
        y0=rest - of_arm @ q_start[:n],
    )
    wires.add("posture", whole, reads={"u0": "desired_posture"}, offers={"y0": "nominal_posture"})


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
                turn = Rotation.from_rotvec(self._look_ahead * self._turning.Eval(context))
                R = turn.as_matrix() @ R
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

    def __init__(self, diagram: Diagram, scenario: Scenario, duration: float | None) -> None:
        super().__init__(diagram, scenario, duration)
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
    distances: KeptDistances = _DISTANCES,
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
        distances: that are kept.

    Returns:
        The log; `regulation` is `METHOD`, and there are no observations.

    Raises:
        ScenarioError: if the scenario has no robot, or its start or goal is out of reach.
        MotionInterruptedError: if the simulation raised or was interrupted; it
            carries the log until then, and the cause.
    """
    q_start = start_positions(scenario)
    diagram = build_differential_ik(scenario, q_start, distances)
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    integral = diagram.GetSubsystemByName("commanded_position")
    integral.set_integral_value(integral.GetMyMutableContextFromRoot(root), q_start)
    watcher = _ToolWatcher(diagram, scenario, duration)
    with _without_solver_messages():
        log = run_motion(scenario, simulator, watcher, modulated=True)
    saturated = (np.abs(log.torque) >= log.effort_limit).any(axis=1).astype(float)
    log = replace(log, regulation=METHOD, saturated=saturated)
    if not len(log.desired_orientation):
        return log
    left = np.zeros((len(log.t), 3))
    for row, X_WE in enumerate(make_robot_plant(robot_of(scenario)).tool_poses(log.q)):
        desired = rotation_matrix(log.desired_orientation[row])
        left[row] = rotation_vector(np.ascontiguousarray(desired @ X_WE.rotation().matrix().T))
    return replace(log, orientation_error=left)
