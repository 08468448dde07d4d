"""Runs a scenario's diagram to its end and keeps the log."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram, EventStatus
from pydrake.systems.primitives import VectorLogSink

from drake_oa.common.files import software_versions
from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    HoldCause,
    PlannedMotion,
    PolicyState,
)
from drake_oa.common.wires import Wires
from drake_oa.diagrams.avoidance import Layers, build_avoidance
from drake_oa.diagrams.policy import make_dmp
from drake_oa.policy.dmp import normalised_time
from drake_oa.regulation.config import SearchParameters
from drake_oa.robot.plant import TOOL_FRAME, RobotLimits, make_robot_plant
from drake_oa.runs.decision_costs import logged_decisions
from drake_oa.runs.motion_log import MotionEnd, MotionLog, pack_ellipsoids
from drake_oa.safety.supervision import Supervision
from drake_oa.scenario.faults import CameraDropout, Push, TorqueSaturation
from drake_oa.scenario.loading import scenario_text
from drake_oa.scenario.obstacles import last_change
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task import goal_at, last_move
from drake_oa.world.station import release_cameras

LONGEST_HOLD = 5.0
"""A motion that is held for longer than this, and after the last move of the goal, is ended [s]."""
LONGEST_SCALING = 6.0
"""A motion that takes more than this many demonstrated durations is ended."""
LATEST_END = 2.2
"""Normalised time s at which a motion that has not arrived is ended; counted from s = 1 at
the latest move of the goal, where that comes after it. One that has been verified to arrive
later may do so."""
_NOTHING, _UNSUPERVISED = EventStatus.DidNothing(), Supervision()
_GRACE = 0.2
"""How much later than verified a motion may arrive, in normalised time."""
ARRIVED = SearchParameters().tolerance
"""A motion has arrived when s = 1 is over and it is this near to the goal [m], at a scaled
velocity at which it would go no further than `STILL` times as far in a unit of s."""
STILL = 20.0
AT_GOAL = 5e-3
"""The tool is at the goal when its point is nearer than this [m]."""
AT_REST = 0.01
"""A robot whose joints are all slower than this rests [rad/s, m/s]."""
REST_TIME = 1.0
"""A run is over when all has been at rest for so long [s]."""
LONGEST_SETTLING = 5.0
"""One that never comes to rest is over so long after its end and that of all courses [s]."""


class MotionInterruptedError(RuntimeError):
    """A simulation that did not end by itself; `log` holds what happened until then."""

    def __init__(self, log: MotionLog) -> None:
        super().__init__(log.stop_reason)
        self.log = log


class Ending(NamedTuple):
    """How a motion ended, in words as well, and whether it may yet go on."""

    end: MotionEnd
    reason: str
    may_go_on: bool = False


AT_THE_GOAL = Ending(MotionEnd.GOAL, "goal")


def motion_state(supervision: tuple[str, str], note: str) -> str:
    """Says what the supervisor does and why, else what holds the motion, else that it runs."""
    action, reason = supervision
    return note or "running" if action == "run" else f"supervisor: {action}, {reason}"


class MotionWatcher:
    """Looks at the motion after each step: records, reports progress, ends the run.

    The motion's end is not the run's: the world goes on until all obstacles have ended
    their courses and everything has been at rest for `REST_TIME`, so that what is touched
    then counts. A motion that was stopped or held, and goes on meanwhile, has not ended.

    Attributes:
        frames: the observations, as they arrived.
        frame_times: when each arrived [s].
        out_of_range: of each, how many obstacles the regressor chain was not trained for.
        events: (time [s], what holds the motion, note) whenever the policy's note changed.
        supervision: (time [s], action, reason) whenever the supervisor's decision changed.
        ending: what ended the motion; None until then.
        motion_end: when it did [s]; NaN until then.
        settled: whether all has come to rest since.
    """

    def __init__(
        self,
        diagram: Diagram,
        scenario: Scenario,
        end_time: float,
        on_progress: Callable[[float, float], None] | None,
        *,
        latest_time: float | None = None,
        on_look: Callable[[MotionWatcher, Context], None] | None = None,
    ) -> None:
        """Finds what it looks at.

        Args:
            diagram: with a `dmp_integrator`; the other systems of `build_avoidance` are
                looked at where they are there.
            scenario: what the diagram was made from.
            end_time: time limit of the motion [s].
            on_progress: called with time [s] and phase, or None.
            latest_time: when the run is over, whatever moves then [s]; None:
                `LONGEST_SETTLING` after the time limit and all that is to happen.
            on_look: called after each look with this and the diagram's Context, or None.
        """
        self._diagram = diagram
        self._policy_system = diagram.GetSubsystemByName("dmp_integrator")
        self._policy_port = self._policy_system.GetOutputPort("policy_state")
        self._ellipsoid_port = None
        if diagram.HasSubsystemNamed("ellipsoid_descriptor"):
            self._ellipsoid_system = diagram.GetSubsystemByName("ellipsoid_descriptor")
            self._ellipsoid_port = self._ellipsoid_system.GetOutputPort("ellipsoids_W")
        elif diagram.HasSubsystemNamed("perception"):
            self._ellipsoid_system = diagram.GetSubsystemByName("perception")
            self._ellipsoid_port = self._ellipsoid_system.get_output_port()
        self._alpha_k = scenario.policy.alpha_k
        self._period = scenario.policy.period
        self._end_time = end_time
        self._on_progress, self._on_look = on_progress, on_look
        self._next_time = 0.0
        self._last_move = last_move(scenario.task)
        self._goal = goal_at(scenario.task, self._last_move)
        self._latest_end = LATEST_END
        self._held_since: float | None = None
        self._chain = None
        if diagram.HasSubsystemNamed("regressor_chain"):
            self._chain = diagram.GetSubsystemByName("regressor_chain")
        self._selector = None
        if diagram.HasSubsystemNamed("motion_selector"):
            self._selector = diagram.GetSubsystemByName("motion_selector")
        self._supervisor = None
        if diagram.HasSubsystemNamed("supervisor"):
            self._supervisor = diagram.GetSubsystemByName("supervisor")
            self._said = self._supervisor.GetOutputPort("supervision")
        self.frames: list[EllipsoidSet] = []
        self.frame_times: list[float] = []
        self.out_of_range: list[int] = []
        self.events: list[tuple[float, HoldCause, str]] = []
        self.supervision: list[tuple[float, str, str]] = []
        self.ending: Ending | None = None
        self.motion_end = math.nan
        self.settled = False
        self._rest_since = math.inf
        self.world_end = _last_change(scenario, end_time)
        self.latest_time = latest_time
        if latest_time is None:
            self.latest_time = max(end_time, self.world_end) + LONGEST_SETTLING
        self._plant = None
        if scenario.robot is not None:
            self._plant = diagram.GetSubsystemByName("plant")
            self._tool_frame = self._plant.GetFrameByName(TOOL_FRAME)
            self._robot = self._tool_frame.model_instance()

    def __call__(self, root: Context) -> EventStatus:
        now = root.get_time()
        if now < self._next_time:
            return _NOTHING
        # Policy and supervisor step once a period, and the look comes right after.
        self._next_time = now + 0.9 * self._period
        policy: PolicyState = self._policy_port.Eval(self._policy_system.GetMyContextFromRoot(root))
        supervision = self._supervision(root)
        if policy.hold is HoldCause.SPEED_SCALE and supervision.reason:
            note = f"supervisor: {supervision.reason}"
            policy = replace(policy, hold=HoldCause.SUPERVISOR, note=note)
        self._record(root, now, policy, supervision)
        if self._on_progress is not None:
            self._on_progress(now, policy.phase)
        if self._on_look is not None:
            self._on_look(self, root)
        if self.ending and self.ending.may_go_on and policy.hold is HoldCause.NONE:
            self._end(math.nan, None)
        if not self.ending:
            self._end(now, self._why_ended(root, now, policy, supervision))
        self._look_for_rest(root, now, policy)
        if self.settled:
            return EventStatus.ReachedTermination(
                self._diagram, self.ending.reason if self.ending else ""
            )
        return _NOTHING

    def positions(self, root: Context) -> tuple[FloatArray, FloatArray]:
        """Returns (1, nq) positions of the robot and (1, n) of the world; without a robot n = 0."""
        if self._plant is None:
            return np.zeros((1, 0)), np.zeros((1, 0))
        context = self._plant.GetMyContextFromRoot(root)
        q = self._plant.GetPositions(context, self._robot)
        return q[None], self._plant.GetPositions(context)[None]

    @property
    def state(self) -> str:
        """What has ended the motion, else what holds it, else that it runs."""
        if self.ending:
            return f"ended: {self.ending.reason}"
        said = self.supervision[-1][1:] if self.supervision else ("run", "")
        return motion_state(said, self.events[-1][2] if self.events else "")

    def finish(self, root: Context) -> None:
        """Says what the end of the run makes of the motion's."""
        if not self.ending:
            self._end(self._end_time, self._time_limit())
        policy: PolicyState = self._policy_port.Eval(self._policy_system.GetMyContextFromRoot(root))
        error = self._goal_error(root, policy)
        if self.ending == AT_THE_GOAL and error > AT_GOAL:
            self.ending = Ending(MotionEnd.LEFT, f"goal left by {1e3 * error:.1f} mm")

    def _end(self, now: float, ending: Ending | None) -> None:
        """Takes down that the motion has ended, if it has, or that it goes on."""
        self.ending, self.motion_end = ending, now if ending else math.nan

    def _time_limit(self) -> Ending:
        return Ending(MotionEnd.TIME_LIMIT, f"time limit of {self._end_time:g} s")

    def _why_ended(
        self, root: Context, now: float, policy: PolicyState, supervision: Supervision
    ) -> Ending | None:
        """How the motion has ended, if it has."""
        s = normalised_time(policy.phase, self._alpha_k)
        if now <= self._last_move:
            self._latest_end = LATEST_END + max(0.0, s - 1.0)
        elif (
            s >= 1.0 - 1e-9
            and _has_arrived(policy, self._goal)
            and self._goal_error(root, policy) <= AT_GOAL
        ):
            return AT_THE_GOAL
        if supervision.action == "stop" and policy.speed == 0.0:
            return Ending(MotionEnd.STOPPED, f"stopped: {supervision.reason}", may_go_on=True)
        if now > self._last_move and s >= self._latest_end:
            self._latest_end = max(self._latest_end, self._verified_end(root) + _GRACE)
        if now > self._last_move and s >= self._latest_end:
            error = self._goal_error(root, policy)
            if error <= AT_GOAL:
                # The paper's terms act on there, and let it creep.
                return AT_THE_GOAL
            why = f"goal missed by {1e3 * error:.1f} mm at s = {self._latest_end:.3g}"
            return Ending(MotionEnd.MISSED, why)
        if (
            self._held_since is not None
            and now - max(self._held_since, self._last_move) > LONGEST_HOLD
        ):
            why = f"held for {LONGEST_HOLD:g} s: {policy.note}"
            return Ending(MotionEnd.HELD, why, may_go_on=True)
        return self._time_limit() if now >= self._end_time else None

    def _look_for_rest(self, root: Context, now: float, policy: PolicyState) -> None:
        """Whether nothing has moved for `REST_TIME`, nor anything will.

        One that may yet go on is given `LONGEST_HOLD`: a decision may take seconds.
        """
        if now < self.world_end or not self.ending or self._fastest(root, policy) > AT_REST:
            self._rest_since, self.settled = math.inf, False
            return
        self._rest_since = min(self._rest_since, now)
        rest = LONGEST_HOLD if self.ending and self.ending.may_go_on else REST_TIME
        self.settled = now - self._rest_since >= rest

    def _fastest(self, root: Context, policy: PolicyState) -> float:
        """Speed of the fastest joint [rad/s, m/s]; without a robot that of the policy [m/s]."""
        if self._plant is None:
            return math.hypot(*policy.z_W) * policy.speed
        context = self._plant.GetMyContextFromRoot(root)
        return float(np.abs(self._plant.GetVelocities(context, self._robot)).max())

    def _tool_point(self, root: Context, policy: PolicyState) -> FloatArray:
        """(3,) the actual tool point; without a robot the desired one [m]."""
        if self._plant is None:
            return policy.p_WE
        context = self._plant.GetMyContextFromRoot(root)
        p_WE: FloatArray = self._tool_frame.CalcPoseInWorld(context).translation()
        return p_WE

    def _goal_error(self, root: Context, policy: PolicyState) -> float:
        return math.dist(self._tool_point(root, policy), self._goal)

    def _record(
        self, root: Context, now: float, policy: PolicyState, supervision: Supervision
    ) -> None:
        self._note(now, policy.hold, policy.note)
        self._record_supervision(now, supervision)
        if policy.hold in (HoldCause.NONE, HoldCause.DECIDING):
            self._held_since = None
        elif self._held_since is None:
            self._held_since = now
        if self._ellipsoid_port is not None:
            seen: EllipsoidSet = self._ellipsoid_port.Eval(
                self._ellipsoid_system.GetMyContextFromRoot(root)
            )
            if seen.stamp > -math.inf and (not self.frames or seen.stamp != self.frames[-1].stamp):
                self.frames.append(seen)
                self.frame_times.append(now)
                coupling = self._asked_of_chain(root)
                self.out_of_range.append(int((~coupling.in_range).sum()))

    def _note(self, now: float, hold: HoldCause, note: str) -> None:
        if note != (self.events[-1][2] if self.events else ""):
            self.events.append((now, hold, note))

    def _supervision(self, root: Context) -> Supervision:
        if self._supervisor is None:
            return _UNSUPERVISED
        said: Supervision = self._said.Eval(self._supervisor.GetMyContextFromRoot(root))
        return said

    def _record_supervision(self, now: float, said: Supervision) -> None:
        before = self.supervision[-1][1:] if self.supervision else ("run", "")
        if (said.action, said.reason) != before:
            self.supervision.append((now, said.action, said.reason))

    def _asked_of_chain(self, root: Context) -> CouplingParameters:
        if self._chain is None:
            return CouplingParameters()
        port = self._chain.GetOutputPort("coupling_parameters")
        coupling: CouplingParameters = port.Eval(self._chain.GetMyContextFromRoot(root))
        return coupling

    def _verified_end(self, root: Context) -> float:
        """Normalised time at which the motion has been verified to arrive; 0: it has not."""
        if self._selector is None:
            return 0.0
        port = self._selector.GetOutputPort("motion")
        motion: PlannedMotion = port.Eval(self._selector.GetMyContextFromRoot(root))
        if not len(motion) or math.dist(motion.p_WE[-1], self._goal) > ARRIVED:
            return 0.0
        return float(motion.s[-1])


def _last_change(scenario: Scenario, end_time: float) -> float:
    """When all courses, pushes, moves of the goal and passing faults are over [s]."""
    changes = [last_change(scenario.obstacles), last_move(scenario.task)]
    for fault in scenario.faults:
        if isinstance(fault, Push):
            changes.append(fault.start + fault.duration)
        elif isinstance(fault, CameraDropout | TorqueSaturation):
            end = fault.start + fault.duration
            # What outlasts the motion's time is no reason to wait.
            changes.append(end if end < end_time else 0.0)
    return max(changes)


def _has_arrived(policy: PolicyState, goal: FloatArray) -> bool:
    error, speed = math.dist(policy.p_WE, goal), math.hypot(*policy.z_W)
    return error < ARRIVED and speed < STILL * ARRIVED


def simulate(
    scenario: Scenario,
    *,
    modulated: bool = True,
    duration: float | None = None,
    meshcat: Meshcat | None = None,
    on_progress: Callable[[float, float], None] | None = None,
    on_look: Callable[[MotionWatcher, Context], None] | None = None,
    layers: Layers | None = None,
    customize: Callable[[Wires], None] | None = None,
    diagram: Diagram | None = None,
) -> MotionLog:
    """Runs one motion of a scenario until nothing moves any more, nor will.

    The motion ends at the goal, with a stop, a lasting hold or at its time limit; the log's
    `motion_end` is when. The world then goes on until all obstacles have ended their courses
    and all has been at rest for `REST_TIME`; a motion that was stopped or held, and can go
    on meanwhile, does.

    The goal is reached when the phase has passed s = 1, the desired motion has arrived where
    the goal is at last, and the tool is within `AT_GOAL` of it; before its last move it goes on.
    One that has not by `LATEST_END` is ended there; at the goal, if the tool is. The log's
    `stop_reason` is "goal", "stopped: ..." (by the supervisor), "held for ...", "goal missed by
    ...", "goal left by ..." (where it had to evade there, and did not come back), "at the goal,
    but the tool cannot be turned back there", "time limit of ..." or, in what a
    `MotionInterruptedError` carries, "interrupted" or what was raised.

    Args:
        scenario: what to run.
        modulated: False runs the pre-planned motion, blind to obstacles.
        duration: time limit of the motion, at which the run is over, whatever moves then [s];
            None: `LONGEST_SCALING` demonstrated durations, from the last move of the goal on, and
            the run goes on.
        meshcat: viewer, or None.
        on_progress: called with time [s] and phase, a few hundred times a second.
        on_look: called as often, see `MotionWatcher`.
        layers: as for `build_avoidance`.
        customize: likewise.
        diagram: what `build_avoidance` made of all that; None: it is asked to.

    Raises:
        ScenarioError: naming the field that does not fit.
        MotionInterruptedError: if the simulation raised or was interrupted; it
            carries the log until then, and the cause.
    """
    if diagram is None:
        diagram = build_avoidance(
            scenario, modulated=modulated, layers=layers, customize=customize, meshcat=meshcat
        )
    simulator = Simulator(diagram)
    end_time = duration
    if end_time is None:
        end_time = make_dmp(scenario).duration * LONGEST_SCALING + last_move(scenario.task)
    watcher = MotionWatcher(
        diagram, scenario, end_time, on_progress, latest_time=duration, on_look=on_look
    )
    return run_motion(scenario, simulator, watcher, modulated=modulated)


def run_motion(
    scenario: Scenario,
    simulator: Simulator,
    watcher: MotionWatcher,
    *,
    modulated: bool,
) -> MotionLog:
    """Runs a diagram with a `dmp_integrator` until the watcher ends it.

    Args:
        scenario: what the diagram was made from.
        simulator: of the diagram, its Context as the motion starts.
        watcher: the monitor.
        modulated: for the log.

    Raises:
        MotionInterruptedError: as `simulate` does.
    """
    started = time.perf_counter()
    try:
        simulator.Initialize()
        simulator.set_monitor(watcher)
        started = time.perf_counter()
        simulator.AdvanceTo(watcher.latest_time)
    except (Exception, KeyboardInterrupt) as error:
        if isinstance(error, KeyboardInterrupt):
            why = str(error) or "interrupted"
        else:
            why = f"{type(error).__name__}: {error}".rstrip(": ")
        watcher.ending, watcher.motion_end = Ending(MotionEnd.CUT_SHORT, why), math.nan
        log = collect_log(scenario, simulator, watcher, modulated, time.perf_counter() - started)
        raise MotionInterruptedError(log) from error
    finally:
        simulator.clear_monitor()
        release_cameras(simulator.get_system())
    watcher.finish(simulator.get_context())
    return collect_log(scenario, simulator, watcher, modulated, time.perf_counter() - started)


def collect_log(
    scenario: Scenario,
    simulator: Simulator,
    watcher: MotionWatcher,
    modulated: bool,
    wall_time: float,
) -> MotionLog:
    """What a diagram of a scenario has logged until now; see `run_motion`."""
    root = simulator.get_context()
    diagram = simulator.get_system()
    ending = watcher.ending or Ending(MotionEnd.CUT_SHORT, "")
    signals: dict[str, FloatArray] = {}
    t = np.zeros(0)
    for system in diagram.GetSystems():
        if isinstance(system, VectorLogSink):
            log = system.FindLog(root)
            t = log.sample_times().copy()
            signals[system.get_name().removeprefix("log_")] = log.data().T.copy()
    count = len(t)
    empty = np.zeros((count, 0))

    def scalar(name: str, otherwise: float) -> FloatArray:
        return signals.get(name, np.full((count, 1), otherwise))[:, 0]

    state = signals.get("robot_state", empty)
    half = state.shape[1] // 2
    q, q_world = state[:, :half], empty
    p_WE, limits = signals["desired_position"], RobotLimits()
    if scenario.robot is not None:
        plant, robot_plant = diagram.GetSubsystemByName("plant"), make_robot_plant(scenario.robot)
        p_WE, limits = robot_plant.tool_path(q), robot_plant.limits
        q_world = signals.get("plant_state", empty)[:, : plant.num_positions()]
    seen = pack_ellipsoids(watcher.frames)
    return MotionLog(
        t=t,
        q=q,
        v=state[:, half:],
        torque=signals.get("actuation", empty),
        saturated=scalar("torque_saturation", 0.0),
        p_WE=p_WE,
        desired_position=signals["desired_position"],
        desired_velocity=signals["desired_velocity"],
        desired_acceleration=signals["desired_acceleration"],
        phase=signals["phase"][:, 0],
        speed_scale=scalar("speed_scale", 1.0),
        tracking_error=np.linalg.norm(
            signals.get("tracking_error", np.full((count, 1), math.nan)), axis=1
        ),
        q_world=q_world,
        observation_time=np.array(watcher.frame_times),
        **seen,
        **logged_decisions(signals),
        out_of_range=np.array(watcher.out_of_range, dtype=np.int64),
        regulation=type(scenario.regulation).__name__ if modulated else "",
        shortfall=scalar("shortfall", 0.0),
        lowered=scalar("lowered", 0.0),
        event_time=np.array([when for when, _, _ in watcher.events]),
        event_hold=tuple(hold.value for _, hold, _ in watcher.events),
        event=tuple(note for _, _, note in watcher.events),
        supervision_time=np.array([when for when, _, _ in watcher.supervision]),
        supervision_action=tuple(action for _, action, _ in watcher.supervision),
        supervision_reason=tuple(reason for _, _, reason in watcher.supervision),
        **vars(limits),
        stop_reason=ending.reason,
        ended=ending.end.value,
        motion_end=watcher.motion_end,
        settled=watcher.settled,
        wall_time=wall_time,
        modulated=modulated,
        scenario=scenario_text(scenario),
        seed=scenario.seed,
        versions=software_versions(),
        goal=signals.get("goal", np.tile(np.asarray(scenario.task.goal), (count, 1))),
        desired_orientation=signals.get("desired_orientation", np.zeros((0, 4))),
        orientation_error=signals.get("orientation_error", np.zeros((0, 3))),
        desired_posture=signals.get("desired_posture", empty),
        evasion=signals.get("evasion", np.zeros((0, 3))),
    )
