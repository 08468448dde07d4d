"""A peer: Drake's differential inverse kinematics follows the pre-planned motion.

    goal -> dmp_integrator -> tool_pose -> desired_poses -> differential_ik
    differential_ik -> commanded_position (integral), commanded_velocity (held)
    commanded position and velocity -> controller -> actuation -> effort_limits -> plant
    commanded_position [+ where the moving obstacles are] -> differential_ik

The program starts from the commanded positions, which the controller follows. Both are
Drake's; `drake_oa.studies.panda.differential_ik` makes them from the scenario.
"""

from __future__ import annotations

import contextlib
import logging
import math
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
from drake_oa.diagrams.policy import make_dmp, make_dmp_integrator, make_goal
from drake_oa.policy.dmp import normalised_time
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
    """The pose that a moving tool has a moment later, with an orientation that stays.

    .. pydrake_system::

      name: ToolPose
      input_ports:
      - desired_position
      - desired_velocity
      output_ports:
      - desired_pose

    - desired_position: (3,) p_WE [m].
    - desired_velocity: (3,) v_WE [m/s].
    - desired_pose: abstract `RigidTransform` X_WE: p_WE + look_ahead v_WE, and the
      orientation given once.

    There is no state.
    """

    def __init__(self, R_WE: RotationMatrix, *, look_ahead: float = 0.0) -> None:
        """Declares the ports.

        Args:
            R_WE: orientation of the tool.
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
        self.DeclareAbstractOutputPort(
            "desired_pose",
            lambda: Value(RigidTransform()),
            self._calc_pose,
            prerequisites_of_calc={self._position.ticket(), self._velocity.ticket()},
        )

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        ahead = self._position.Eval(context) + self._look_ahead * self._velocity.Eval(context)
        output.set_value(RigidTransform(self._R_WE, ahead))


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


class _PeerWatcher(MotionWatcher):
    """Looks after each step at what was commanded and where the tool is; ends the run."""

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
        self._command = diagram.GetSubsystemByName("commanded_velocity")
        self._duration = make_dmp(scenario).duration
        self._recent: deque[tuple[float, FloatArray]] = deque()

    def _record(self, root: Context, now: float, policy: PolicyState) -> None:
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
def _without_solver_warnings() -> Iterator[None]:
    """Drake warns at every step that has no solution; the log has one note for them all."""

    def is_other(record: logging.LogRecord) -> bool:
        return "QP failed to solve" not in record.getMessage()

    logger = logging.getLogger("drake")
    logger.addFilter(is_other)
    try:
        yield
    finally:
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
    if scenario.robot is None:
        raise ScenarioError("robot: differential inverse kinematics needs one; it is null")
    q_start = start_positions(make_robot_plant(scenario.robot), scenario)
    diagram = build_differential_ik(scenario, q_start, parameters or PeerParameters())
    simulator = Simulator(diagram)
    root = simulator.get_mutable_context()
    integral = diagram.GetSubsystemByName("commanded_position")
    integral.set_integral_value(integral.GetMyMutableContextFromRoot(root), q_start)
    end_time = make_dmp(scenario).duration * LONGEST_SCALING if duration is None else duration
    watcher = _PeerWatcher(diagram, scenario, end_time, on_progress, latest_time=duration)
    with _without_solver_warnings():
        log = run_motion(scenario, simulator, watcher, modulated=True)
    saturated = (np.abs(log.torque) >= log.effort_limit).any(axis=1).astype(float)
    return replace(log, regulation=METHOD, saturated=saturated)
