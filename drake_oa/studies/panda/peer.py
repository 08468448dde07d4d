"""Drake's differential inverse kinematics on the simulated station, along the pre-planned motion.

    goal -> dmp_integrator [-> orientation_integrator] -> tool_pose -> desired_poses ->
    differential_ik -> commanded_position (integral), commanded_velocity (held) -> commanded_state
    [goal's joints ->] posture -> differential_ik
    commanded_position [+ where the moving obstacles are] -> differential_ik

    commanded_state -> controller -> actuation -> effort_limits -> plant

Its program starts from the commanded positions; `drake_oa.studies.panda.differential_ik` makes it
from the scenario.
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
from dataclasses import replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator
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
from drake_oa.common.messages import FloatArray, HoldCause, PolicyState
from drake_oa.common.wires import Wires
from drake_oa.diagrams.faults import add_drivers
from drake_oa.diagrams.policy import (
    add_orientation,
    make_dmp,
    make_dmp_integrator,
    make_goal,
    make_orientation_integrator,
)
from drake_oa.diagrams.posture import make_guide_follower
from drake_oa.geometry.rotation import rotation_vector
from drake_oa.policy.dmp import normalised_time
from drake_oa.policy.orientation_dmp import exponential, rotation_matrix
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.simulation import (
    ARRIVED,
    AT_THE_GOAL,
    LATEST_END,
    LONGEST_SCALING,
    STILL,
    Ending,
    MotionWatcher,
    run_motion,
)
from drake_oa.safety.supervision import Supervision
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task_joints import start_positions
from drake_oa.studies.panda import differential_ik as peer
from drake_oa.studies.panda.differential_ik import PeerParameters
from drake_oa.world.station import Station, make_station


def build_differential_ik(
    scenario: Scenario, q_start: FloatArray, parameters: peer.PeerParameters
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
    _wire_motion(wires, scenario)
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
    rest = order @ peer.posture(robot, q_start)
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
    parameters: peer.PeerParameters,
) -> None:
    """From commanded positions and velocities to the plant, and back; model: of the robot."""
    builder = wires.builder
    plant = station.plant
    state = plant.get_state_output_port(station.robot)
    controller = builder.AddNamedSystem("controller", peer.make_joint_controller(model, parameters))
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
        end_time: float,
        on_progress: Callable[[float, float], None] | None,
        *,
        latest_time: float | None,
    ) -> None:
        super().__init__(diagram, scenario, end_time, on_progress, latest_time=latest_time)
        self._duration = make_dmp(scenario).duration
        self._recent: deque[tuple[float, FloatArray]] = deque()
        self._command = diagram.GetSubsystemByName("commanded_velocity")

    def _record(
        self, root: Context, now: float, policy: PolicyState, supervision: Supervision
    ) -> None:
        lag = math.dist(policy.p_WE, self._tool_point(root, policy))
        command = self._command.get_output_port().Eval(self._command.GetMyContextFromRoot(root))
        held = lag > _AT_REST and not command.any()
        self._note(now, *((HoldCause.OBSTACLES, NO_VELOCITY) if held else (HoldCause.NONE, "")))

    def _why_ended(
        self, root: Context, now: float, policy: PolicyState, supervision: Supervision
    ) -> Ending | None:
        p_WE = self._tool_point(root, policy)
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
    end_time = make_dmp(scenario).duration * LONGEST_SCALING if duration is None else duration
    watcher = _ToolWatcher(
        simulator.get_system(), scenario, end_time, on_progress, latest_time=duration
    )
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
