"""The peer on the Panda: differential inverse kinematics with collision constraints.

It knows the world exactly (ground truth), follows the same pre-planned motion as the
project's methods, and is logged in the same form.
"""

from __future__ import annotations

import contextlib
import logging
import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, Diagram

from drake_oa.common.messages import FloatArray, PolicyState
from drake_oa.common.schema_check import ScenarioError
from drake_oa.diagrams.policy import make_dmp
from drake_oa.policy.dmp import normalised_time
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.simulation import (
    ARRIVED,
    LATEST_END,
    LONGEST_SCALING,
    STILL,
    MotionWatcher,
    run_motion,
)
from drake_oa.safety.supervision import Supervision
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task_joints import start_positions
from drake_oa.studies.panda.differential_ik import PeerParameters
from drake_oa.studies.panda.differential_ik_diagram import build_differential_ik

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
        self._note(root, now, math.dist(policy.p_WE, self._tool_point(root, policy)))

    def _why_ended(
        self, root: Context, now: float, policy: PolicyState, supervision: Supervision
    ) -> tuple[str, bool]:
        p_WE = self._tool_point(root, policy)
        s = normalised_time(policy.phase, self._alpha_k)
        error = math.dist(p_WE, policy.p_WG)
        if s >= 1.0 - 1e-9:
            if error < ARRIVED and self._speed(now, p_WE) * self._duration < STILL * ARRIVED:
                return "goal", False
            if now >= self.world_end and self._stands_still(now, p_WE):
                why = f" ({self.events[-1][1]})" if self.events and self.events[-1][1] else ""
                return f"stuck {1e3 * error:.1f} mm short of the goal{why}", False
        self._remember(now, p_WE)
        if s >= LATEST_END and now >= self.world_end:
            return f"goal missed by {1e3 * error:.1f} mm at s = {LATEST_END:g}", False
        return (f"time limit of {self._end_time:g} s" if now >= self._end_time else ""), False

    def _note(self, root: Context, now: float, lag: float) -> None:
        command = self._command.get_output_port().Eval(self._command.GetMyContextFromRoot(root))
        note = NO_VELOCITY if lag > _AT_REST and not command.any() else ""
        if note != (self.events[-1][1] if self.events else ""):
            self.events.append((now, note))

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
