"""Simulation of one motion of a scenario, the monitor that terminates it, and the collection of its
log.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from typing import Any, NamedTuple, TypeVar

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, EventStatus
from pydrake.systems.primitives import VectorLogSink

from drake_oa.common.files import software_versions
from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    HoldReason,
    PlannedMotion,
    PolicyState,
)
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.diagrams.avoidance import Layers, build_avoidance
from drake_oa.diagrams.motion import make_dmp
from drake_oa.inference.config import Verified
from drake_oa.policy.dmp import normalized_time
from drake_oa.robot.plant import TOOL_FRAME, RobotLimits, make_robot_plant
from drake_oa.runs.motion_log import MotionEnd, MotionLog, pack_decisions, pack_ellipsoids
from drake_oa.safety.supervision import Supervision
from drake_oa.scenario.faults import CameraDropout, Push, TorqueSaturation
from drake_oa.scenario.loading import scenario_text
from drake_oa.scenario.obstacles import last_change
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import goal_at, last_move_time
from drake_oa.world.station import release_cameras

MAX_HOLD_TIME = 5.0
"""Maximum duration of a hold, in which the motion rests on its path, before the motion terminates
[s]. The time before the last move of the goal, and a hold until the first motion is selected
(`HoldReason.DECIDING`), do not count."""
MAX_TIME_SCALING = 6.0
"""Time limit of a motion after the last move of the goal, as a multiple of the demonstrated
duration [-]."""
MAX_NORMALIZED_TIME = 2.2
"""Normalized time at which a motion that has not reached the goal terminates [-].

Normalized time s advances at the rate 1 / (tau T) at full speed, with the demonstrated duration T
[s] and the temporal scaling tau [-]. A motion that is predicted to arrive later terminates later.
If the goal makes its last move at s > 1, the limit is higher by s - 1.
"""
_CONTINUE = EventStatus.DidNothing()
"""Event status that `MotionMonitor` returns to the Simulator while the simulation continues."""
_ARRIVAL_DELAY = 0.2
"""Normalized time by which a motion that was verified by simulation may exceed its predicted
arrival at the goal before it terminates as missed [-]."""
ARRIVAL_TOLERANCE = Verified().tolerance
"""Distance between the position of the movement primitive and the goal below which the desired
motion counts as arrived [m]."""
ARRIVAL_SPEED_RATIO = 20.0
"""Ratio tau T |v| / `ARRIVAL_TOLERANCE` below which the movement primitive counts as at rest at the
goal [-].

v is the velocity of the movement primitive [m/s], T the demonstrated duration [s], and tau the
temporal scaling [-]."""
AT_GOAL = 5e-3
"""Distance of the tool point to the goal up to which the tool is at the goal [m]."""
AT_REST = 0.01
"""Joint speed up to which the robot counts as at rest [rad/s, m/s]."""
REST_TIME = 1.0
"""Time for which the world must be at rest after the motion before the simulation ends [s]."""
MAX_SETTLING_TIME = 5.0
"""Maximum time for which the simulation waits until the robot is at rest [s]. It counts from the
motion's time limit or the world's last change, whichever is later."""


class MotionInterruptedError(RuntimeError):
    """Error for a simulation that was interrupted by an exception, or by a signal such as Ctrl-C.

    Attributes:
        log: log of the motion until the interruption.
    """

    def __init__(self, log: MotionLog) -> None:
        super().__init__(log.stop_reason)
        self.log = log


class MotionOutcome(NamedTuple):
    """Termination of a motion.

    Attributes:
        end: kind of the termination.
        reason: reason of the termination in words.
    """

    end: MotionEnd
    reason: str

    @property
    def may_continue(self) -> bool:
        """Whether the motion may still continue later: True for the kinds STOPPED and HELD, because
        the cause for which the motion was stopped or held may end.
        """
        return self.end in (MotionEnd.STOPPED, MotionEnd.HELD)


GOAL_OUTCOME = MotionOutcome(MotionEnd.GOAL, "goal")
"""Outcome of a motion that has reached the goal."""


EVENT = ("event_time", "event_hold", "event")
"""Keys in a `MotionLog` for the notes with which the policy (movement primitive) explains holds:
times, reasons of the holds, and texts."""
_SUPERVISION = ("supervision_time", "supervision_action", "supervision_reason")
"""Keys in a `MotionLog` for the changes of the motion guard's action (run, slow, hold or stop):
times, actions and reasons."""
T = TypeVar("T")


def _reader(diagram: Diagram, system: str, port: str, default: T) -> Callable[[Context], T]:
    """Creates a function that evaluates an output port from the root Context of a diagram.

    Args:
        diagram: diagram that contains the system.
        system: name of the system.
        port: name of the output port.
        default: value of the function if the diagram has no such system.
    """
    if not diagram.HasSubsystemNamed(system):
        return lambda root: default
    subsystem = diagram.GetSubsystemByName(system)
    return lambda root: subsystem.GetOutputPort(port).Eval(subsystem.GetMyContextFromRoot(root))


def motion_state(supervision: tuple[str, str], note: str) -> str:
    """Returns the state of a motion in words: action of the motion guard with its reason; if this
    action is "run", the note of a hold, or else "running".

    Args:
        supervision: action of the motion guard ("run", "slow", "hold" or "stop"), and its reason.
        note: text with which the policy (movement primitive) explains a hold; empty without a hold.
    """
    action, reason = supervision
    return note or "running" if action == "run" else f"motion guard: {action}, {reason}"


class MotionMonitor:
    """Monitor for `Simulator.set_monitor` that records a motion, detects its termination, and ends
    the simulation.

    After the termination, the simulation continues until obstacles, goal and faults do not change
    any more and the robot has been at rest for `REST_TIME`. Contacts in this time count, too. If a
    stopped or held motion continues in the meantime, it has not terminated.

    The conditions use the normalized time s, which is 1 at the end of the demonstrated motion. The
    desired motion has arrived if its position is almost at rest within `ARRIVAL_TOLERANCE` (0.6 mm)
    of the goal. The verified motion is the selected motion, which was checked by simulation:

    =============  ===================================================================
    `MotionEnd`    condition
    =============  ===================================================================
    GOAL           the tool is within `AT_GOAL` of the goal; also, either s >= 1 and the desired
                   motion has arrived, or s meets both conditions of MISSED
    STOPPED        the motion guard has stopped the motion
    MISSED         the tool is not within `AT_GOAL` of the goal, although s is at least
                   `MAX_NORMALIZED_TIME` and at least 0.2 later than the predicted arrival of the
                   verified motion
    HELD           a hold is longer than `MAX_HOLD_TIME`; its reason is not DECIDING
    TIME_LIMIT     the time limit of the motion is reached
    LEFT           after GOAL: the tool is not within `AT_GOAL` at the end of the simulation
    =============  ===================================================================

    Attributes:
        frames: ellipsoids around the observed obstacles, one set for each observation, in the order
            in which the observations became available.
        frame_times: times at which the observations became available [s].
        out_of_range: for each observation, the number of obstacles beyond the training range of
            the regressor chain.
        events: (time [s], reason of the hold, note) at each change of the note with which the
            policy (movement primitive) explains a hold.
        supervision: (time [s], action, reason) at each change of the motion guard's action ("run",
            "slow", "hold" or "stop") or its reason.
        phase: present canonical phase k of the movement primitive, from 1 down to 0.
        outcome: termination of the motion; None while it continues.
        motion_end: time of the termination [s]; NaN while the motion continues.
        settled: whether the world has come to rest after the termination.
        world_end: time after which neither obstacles, goal nor faults change [s].
        latest_time: time at which the simulation ends in any case [s].
        num_positions: number of positions of the station's plant; 0 without a robot.
    """

    def __init__(
        self,
        diagram: Diagram,
        scenario: Scenario,
        duration: float | None = None,
        on_step: OnStep = lambda monitor, root: None,
    ) -> None:
        """Prepares the monitor to read outputs of the systems of a diagram.

        Args:
            diagram: diagram with the system `dmp_integrator` (movement primitive) and, if the
                scenario has a robot, `plant`; other systems of `build_avoidance` are optional.
            scenario: configuration of the diagram.
            duration: time at which the simulation ends in any case [s]; None: the time limit of
                the motion is `MAX_TIME_SCALING` demonstrated durations after the last move of the
                goal. The simulation, which waits until everything is at rest, ends at most
                `MAX_SETTLING_TIME` after this time limit or the last change of obstacles, goal and
                temporary faults (those that end before the time limit), whichever is later.
            on_step: function that is called once per period of the policy with the monitor and the
                root Context.
        """
        self._diagram = diagram
        self._policy = _reader(diagram, "dmp_integrator", "policy_state", PolicyState())
        self._supervision = _reader(diagram, "motion_guard", "supervision", Supervision())
        self._motion = _reader(diagram, "motion_verifier", "motion", PlannedMotion())
        self._source = _reader(diagram, "motion_verifier", "source", np.full(1, -1.0))
        # With MotionVerifier the chain only proposes, and is evaluated only for a search.
        chain = "" if diagram.HasSubsystemNamed("motion_verifier") else "regressor_chain"
        self._coupling = _reader(diagram, chain, "coupling_parameters", CouplingParameters())
        has_descriptor = diagram.HasSubsystemNamed("ellipsoid_descriptor")
        source = "ellipsoid_descriptor" if has_descriptor else "perception"
        self._ellipsoids = _reader(diagram, source, "ellipsoids_W", EllipsoidSet())
        self._alpha_k = scenario.policy.alpha_k
        self._period = scenario.policy.period
        self._on_step = on_step
        self.phase = 1.0
        self._next_time = 0.0
        self._last_move = last_move_time(scenario.task)
        time_limit = make_dmp(scenario).duration * MAX_TIME_SCALING + self._last_move
        self._end_time = time_limit if duration is None else duration
        self._goal = goal_at(scenario.task, self._last_move)
        self._latest_end = MAX_NORMALIZED_TIME
        self._hold_start = math.inf
        self.frames: list[EllipsoidSet] = []
        self.frame_times: list[float] = []
        self.out_of_range: list[int] = []
        self.events: list[tuple[float, HoldReason, str]] = []
        self.supervision: list[tuple[float, str, str]] = []
        self._last_supervision, self._last_note = ("run", ""), ""
        self.outcome: MotionOutcome | None = None
        self.motion_end = math.nan
        self.settled = False
        self._rest_since = math.inf
        self.world_end = _last_change(scenario, self._end_time)
        latest_time = max(self._end_time, self.world_end) + MAX_SETTLING_TIME
        self.latest_time = latest_time if duration is None else duration
        self._plant, self.num_positions = None, 0
        if scenario.robot is not None:
            self._plant = diagram.GetSubsystemByName("plant")
            self.num_positions = self._plant.num_positions()
            self._tool_frame = self._plant.GetFrameByName(TOOL_FRAME)
            self._robot = self._tool_frame.model_instance()

    def __call__(self, root: Context) -> EventStatus:
        """Records the present state once per period of the policy (movement primitive), and ends
        the simulation when the motion has terminated and the world is at rest.
        """
        now = root.get_time()
        if now < self._next_time:
            return _CONTINUE
        # The policy steps once a period, and the monitor is evaluated right after each step.
        self._next_time = now + 0.9 * self._period
        policy = self._policy(root)
        supervision = self._supervision(root)
        if policy.hold is HoldReason.SPEED_SCALE and supervision.reason:
            note = f"motion guard: {supervision.reason}"
            policy = replace(policy, hold=HoldReason.SUPERVISOR, note=note)
        self._record(root, now, policy, supervision)
        self.phase = policy.phase
        self._on_step(self, root)
        if self.outcome and self.outcome.may_continue and policy.hold is HoldReason.NONE:
            self.outcome, self.motion_end = None, math.nan
        if not self.outcome:
            self.outcome = self._find_outcome(root, now, policy, supervision)
            self.motion_end = now if self.outcome else math.nan
        self._update_settled(root, now)
        if self.settled:
            return EventStatus.ReachedTermination(
                self._diagram, self.outcome.reason if self.outcome else ""
            )
        return _CONTINUE

    def positions(self, root: Context) -> tuple[FloatArray, FloatArray]:
        """Returns the present positions [rad, m] of the robot, (1, n), and of the whole plant, (1,
        nq). Both are (1, 0) for a scenario without a robot, which has no plant.
        """
        if self._plant is None:
            return np.zeros((1, 0)), np.zeros((1, 0))
        context = self._plant.GetMyContextFromRoot(root)
        q = self._plant.GetPositions(context, self._robot)
        return q[None], self._plant.GetPositions(context)[None]

    def source(self, root: Context) -> float:
        """Returns the source of the present motion: 0 nominal motion, 1 regressor chain, 2 search,
        3 path in joint space; -1: no source.
        """
        return float(self._source(root)[0])

    @property
    def state(self) -> str:
        """State of the motion in words: its termination, the action of the motion guard, the note
        of a hold, or "running".
        """
        if self.outcome:
            return f"terminated: {self.outcome.reason}"
        return motion_state(self._last_supervision, self._last_note)

    def finish(self, root: Context) -> None:
        """Completes the outcome at the end of the simulation: TIME_LIMIT if the motion has not
        terminated, LEFT if the tool has left the goal.
        """
        if not self.outcome:
            self.outcome, self.motion_end = self._time_limit(), self._end_time
        error = self._goal_error(root)
        if self.outcome == GOAL_OUTCOME and error > AT_GOAL:
            self.outcome = MotionOutcome(MotionEnd.LEFT, f"goal left by {1e3 * error:.1f} mm")

    def _time_limit(self) -> MotionOutcome:
        """Returns the outcome of a motion that the time limit terminates."""
        return MotionOutcome(MotionEnd.TIME_LIMIT, f"time limit of {self._end_time:g} s")

    def _find_outcome(
        self, root: Context, now: float, policy: PolicyState, supervision: Supervision
    ) -> MotionOutcome | None:
        """Checks the conditions in the table of `MotionMonitor`, and returns the outcome of the
        motion; None: the motion continues.
        """
        s = normalized_time(policy.phase, self._alpha_k)
        has_arrived = s >= 1.0 - 1e-9 and _has_arrived(policy, self._goal)
        if now <= self._last_move:
            self._latest_end = MAX_NORMALIZED_TIME + max(0.0, s - 1.0)
        elif has_arrived and self._goal_error(root) <= AT_GOAL:
            return GOAL_OUTCOME
        if supervision.action == "stop" and policy.speed == 0.0:
            return MotionOutcome(MotionEnd.STOPPED, f"stopped: {supervision.reason}")
        is_late = now > self._last_move and s >= self._latest_end
        if is_late and s >= self._verified_end(root) + _ARRIVAL_DELAY:
            error = self._goal_error(root)
            if error <= AT_GOAL:
                # The coupling terms of `!Paper` act near the goal, so the motion creeps there.
                return GOAL_OUTCOME
            reason = f"goal missed by {1e3 * error:.1f} mm at s = {s:.3g}"
            return MotionOutcome(MotionEnd.MISSED, reason)
        if now - max(self._hold_start, self._last_move) > MAX_HOLD_TIME:
            reason = f"held for {MAX_HOLD_TIME:g} s: {policy.note}"
            return MotionOutcome(MotionEnd.HELD, reason)
        return self._time_limit() if now >= self._end_time else None

    def _update_settled(self, root: Context, now: float) -> None:
        """Sets `settled` if the motion has terminated and the world has been at rest long enough.

        The required time of rest is `REST_TIME`. It is `MAX_HOLD_TIME` for a stopped or held motion
        that may continue, because a decision may have a compute latency of seconds, and for an arm
        that has left the goal and may return.
        """
        if now < self.world_end or not self.outcome or self._max_speed(root) > AT_REST:
            self._rest_since, self.settled = math.inf, False
            return
        self._rest_since = min(self._rest_since, now)
        has_left = self.outcome == GOAL_OUTCOME and self._goal_error(root) > AT_GOAL
        rest = MAX_HOLD_TIME if has_left or self.outcome.may_continue else REST_TIME
        self.settled = now - self._rest_since >= rest

    def _max_speed(self, root: Context) -> float:
        """Returns the maximum joint speed of the robot [rad/s, m/s]; without a robot, the speed of
        the desired tool point [m/s].
        """
        if self._plant is None:
            policy = self._policy(root)
            return math.hypot(*policy.z_W) * policy.speed
        context = self._plant.GetMyContextFromRoot(root)
        return float(np.abs(self._plant.GetVelocities(context, self._robot)).max())

    def tool_point(self, root: Context) -> FloatArray:
        """Returns the actual position (3,) of the tool point in the world [m]; without a robot, the
        desired position.
        """
        if self._plant is None:
            return self._policy(root).p_WE
        context = self._plant.GetMyContextFromRoot(root)
        return np.asarray(self._tool_frame.CalcPoseInWorld(context).translation())

    def _goal_error(self, root: Context) -> float:
        """Returns the distance of the tool point to the final position of the goal [m]."""
        return math.dist(self.tool_point(root), self._goal)

    def _record(
        self, root: Context, now: float, policy: PolicyState, supervision: Supervision
    ) -> None:
        """Records changes of the policy's note, which explains a hold, and of the motion guard's
        action or reason, the start of a hold, and new observations.
        """
        if policy.note != self._last_note:
            self._last_note = policy.note
            self.events.append((now, policy.hold, policy.note))
        current = supervision.action, supervision.reason
        if current != self._last_supervision:
            self._last_supervision = current
            self.supervision.append((now, *current))
        if policy.hold in (HoldReason.NONE, HoldReason.DECIDING):
            self._hold_start = math.inf
        else:
            self._hold_start = min(self._hold_start, now)
        frame = self._ellipsoids(root)
        if frame.stamp > -math.inf and (not self.frames or frame.stamp != self.frames[-1].stamp):
            self.frames.append(frame)
            self.frame_times.append(now)
            self.out_of_range.append(int((~self._coupling(root).in_range).sum()))

    def _verified_end(self, root: Context) -> float:
        """Returns the normalized time at which the selected motion arrives at the goal in its
        roll-out (simulation); 0: it does not arrive.
        """
        motion = self._motion(root)
        if not len(motion) or math.dist(motion.p_WE[-1], self._goal) > ARRIVAL_TOLERANCE:
            return 0.0
        return float(motion.s[-1])


def _last_change(scenario: Scenario, end_time: float) -> float:
    """Returns the time of the last change of obstacles, goal or temporary faults in a scenario [s].

    Args:
        scenario: scenario of the motion.
        end_time: time limit of the motion [s]; faults that last longer do not count.
    """
    changes = [last_change(scenario.obstacles), last_move_time(scenario.task)]
    for fault in scenario.faults:
        if isinstance(fault, CameraDropout | TorqueSaturation | Push):
            end = fault.start + fault.duration
            # A fault that outlasts the motion does not delay the end of the run.
            changes.append(end if end < end_time else 0.0)
    return max(changes)


def _has_arrived(policy: PolicyState, goal: FloatArray) -> bool:
    """Checks whether the desired position is at the goal (3,) [m] and almost at rest."""
    error, speed = math.dist(policy.p_WE, goal), math.hypot(*policy.z_W)
    return error < ARRIVAL_TOLERANCE and speed < ARRIVAL_SPEED_RATIO * ARRIVAL_TOLERANCE


OnStep = Callable[[MotionMonitor, Context], None]
"""Type of a function that is called once per period of the policy with the monitor of a motion and
the root Context."""


def simulate(
    scenario: Scenario,
    *,
    avoid_obstacles: bool = True,
    duration: float | None = None,
    on_step: OnStep = lambda monitor, root: None,
    layers: Layers | None = None,
    customize: Callable[[SignalBuilder], None] | None = None,
    diagram: Diagram | None = None,
) -> MotionLog:
    """Simulates one motion of a scenario until it has terminated and the world is at rest.

    `MotionMonitor` has the table of terminations. In the log, `motion_end` is the time of the
    termination, `ended` its kind, and `stop_reason` its reason in words.

    Args:
        scenario: configuration of the diagram.
        avoid_obstacles: whether obstacles are avoided; False: the nominal motion.
        duration: simulated time at which the simulation ends in any case [s]; None: the time limit
            of the motion is 6 demonstrated durations after the last move of the goal.
        on_step: function that is called once per period of the policy, with the monitor of the
            motion and the root Context.
        layers: functions that add the layers of the diagram, such as perception and control; None:
            the default layers, `Layers()`.
        customize: function that changes the signals (named connections between systems) of the
            diagram before they are connected.
        diagram: result of `build_avoidance` with these arguments; None: it is built here.

    Returns:
        Log of the motion.

    Raises:
        ScenarioError: if a field of the scenario is wrong; names the field.
        MotionInterruptedError: if the simulation raised or was interrupted, with the log until
            then as `log` and the cause as `__cause__`.
    """
    if diagram is None:
        diagram = build_avoidance(
            scenario, avoid_obstacles=avoid_obstacles, layers=layers, customize=customize
        )
    monitor = MotionMonitor(diagram, scenario, duration, on_step)
    return run_motion(scenario, Simulator(diagram), monitor, avoid_obstacles=avoid_obstacles)


def run_motion(
    scenario: Scenario, simulator: Simulator, monitor: MotionMonitor, *, avoid_obstacles: bool
) -> MotionLog:
    """Simulates a motion until its monitor ends the simulation, and returns the log of the motion.

    Args:
        scenario: configuration of the diagram.
        simulator: simulator of the diagram, with the Context at the start of the motion.
        monitor: monitor of the motion.
        avoid_obstacles: whether the motion avoids obstacles, for the log.

    Raises:
        MotionInterruptedError: if the simulation raised or was interrupted; contains the log until
            then.
    """
    started, failure = time.perf_counter(), None
    try:
        simulator.Initialize()
        simulator.set_monitor(monitor)
        started = time.perf_counter()
        simulator.AdvanceTo(monitor.latest_time)
        monitor.finish(simulator.get_context())
    except (Exception, KeyboardInterrupt) as error:
        failure, name = error, "" if isinstance(error, KeyboardInterrupt) else type(error).__name__
        reason = f"{name}: {error}".strip(": ") or "interrupted"
        monitor.outcome, monitor.motion_end = MotionOutcome(MotionEnd.INTERRUPTED, reason), math.nan
    finally:
        simulator.clear_monitor()
        release_cameras(simulator.get_system())
    log = collect_log(scenario, simulator, monitor, avoid_obstacles, time.perf_counter() - started)
    if failure is not None:
        raise MotionInterruptedError(log) from failure
    return log


def logged_signals(diagram: Diagram, root: Context) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Returns the logged instants (T,) [s], and the logged signals (T, n) by name, from the log
    sinks of a diagram.

    Args:
        diagram: diagram with sinks that are named log_<signal>, at least one.
        root: root Context of the diagram.
    """
    signals = {
        system.get_name().removeprefix("log_"): system.FindLog(root)
        for system in diagram.GetSystems()
        if isinstance(system, VectorLogSink) and system.get_name().startswith("log_")
    }
    t = next(iter(signals.values())).sample_times().copy()
    return t, {name: log.data().T.copy() for name, log in signals.items()}


def collect_log(
    scenario: Scenario,
    simulator: Simulator,
    monitor: MotionMonitor,
    avoid_obstacles: bool,
    wall_time: float,
) -> MotionLog:
    """Creates the log of a motion from the log sinks and the monitor of its simulation.

    Args:
        scenario: configuration of the diagram.
        simulator: simulator of the diagram.
        monitor: monitor of the motion.
        avoid_obstacles: whether the motion avoids obstacles.
        wall_time: wall-clock time of the simulation [s].
    """
    outcome = monitor.outcome or MotionOutcome(MotionEnd.INTERRUPTED, "")
    t, signals = logged_signals(simulator.get_system(), simulator.get_context())
    return make_log(
        scenario,
        t,
        signals,
        q_world=signals.get("plant_state", np.zeros((len(t), 0)))[:, : monitor.num_positions],
        observation_time=np.array(monitor.frame_times),
        **pack_ellipsoids(monitor.frames),
        **pack_decisions(signals),
        out_of_range=np.array(monitor.out_of_range, dtype=np.int64),
        inference=type(scenario.inference).__name__ if avoid_obstacles else "",
        **columns_of(monitor.events, EVENT),
        **columns_of(monitor.supervision, _SUPERVISION),
        stop_reason=outcome.reason,
        ended=outcome.end.value,
        motion_end=monitor.motion_end,
        settled=monitor.settled,
        wall_time=wall_time,
        avoid_obstacles=avoid_obstacles,
    )


def columns_of(rows: Sequence[tuple[Any, ...]], names: Sequence[str]) -> dict[str, Any]:
    """Converts rows, each a time [s] followed by texts, to columns of a log: an array of times, and
    tuples of texts.

    Args:
        rows: tuples that begin with a time; may be empty.
        names: keys of the columns, that of the times first.

    Returns:
        Columns by key.
    """
    times, *texts = zip(*rows, strict=True) if rows else [()] * len(names)
    return dict(zip(names, (np.array(times, dtype=float), *texts), strict=True))


def make_log(
    scenario: Scenario, t: FloatArray, signals: dict[str, FloatArray], **attributes: Any
) -> MotionLog:
    """Creates a log from logged signals; a missing signal gets the values that it has in a nominal
    motion without holds.

    Args:
        scenario: configuration of the run.
        t: (T,) instants [s].
        signals: values (T, n) by name; desired_position is required only without a robot.
        attributes: attributes of `MotionLog` that are no signals; observations, notes on holds and
            changes of the motion guard's action may be omitted if there are none.
    """
    count = len(t)
    none, still = np.zeros((count, 0)), np.zeros((count, 3))
    zero = np.zeros((count, 1))
    q, v = np.hsplit(signals.get("robot_state", none), 2)
    limits, p_WE = RobotLimits(), signals.get("desired_position", still)
    if scenario.robot is not None:
        robot_plant = make_robot_plant(scenario.robot)
        p_WE, limits = robot_plant.tool_path(q), robot_plant.limits
    series: dict[str, Any] = {
        "desired_position": p_WE,
        "desired_velocity": still,
        "desired_acceleration": still,
        "goal": np.tile(np.asarray(scenario.task.goal), (count, 1)),
        "desired_posture": none,
        "phase": zero,
        "speed_scale": zero + 1.0,
        "shortfall": zero,
        "clearance_reduction": zero,
        "motion_source": zero - 1.0,
        "actuation": none,
        "torque_saturation": zero,
        "tracking_error": zero + math.nan,
        **signals,
    }
    keys = {item.name for item in fields(MotionLog)}
    return MotionLog(
        t=t,
        q=q,
        v=v,
        p_WE=p_WE,
        torque=series.pop("actuation"),
        saturated=series.pop("torque_saturation")[:, 0],
        tracking_error=np.linalg.norm(series.pop("tracking_error"), axis=1),
        scenario=scenario_text(scenario),
        seed=scenario.seed,
        versions=tuple(map(" ".join, software_versions().items())),
        **vars(limits),
        **attributes,
        **{
            name: values[:, 0] if values.shape[1] == 1 else values
            for name, values in series.items()
            if name in keys
        },
    )
