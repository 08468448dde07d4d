"""System that selects the motion of the arm by roll-outs (simulations) of candidate motions."""

from __future__ import annotations

import logging

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from drake_oa.common.latency import LatencyModel, PendingDecision
from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    PlannedMotion,
    PolicyState,
    Route,
)
from drake_oa.common.ports import (
    DECISION_OFFSET,
    AbstractInput,
    declare_state_outputs,
    valid_period,
)
from drake_oa.geometry.collision_scene import CollisionScene
from drake_oa.planning.motion_search import MotionSearch, PlanningInputs, SelectedMotion
from drake_oa.planning.search import SOURCES
from drake_oa.policy.dmp import Demonstration

_logger = logging.getLogger("drake_oa")


class MotionVerifier(LeafSystem):
    """System that selects the motion of the whole arm by roll-outs (simulations) of candidates.

    .. pydrake_system::

      name: MotionVerifier
      input_ports:
      - policy_state
      - goal
      - robot_state
      - collision_scene_W
      - ellipsoids_W (optional)
      - coupling_parameters (optional)
      - route (optional)
      output_ports:
      - coupling_parameters
      - route
      - demonstration
      - motion
      - sides
      - shortfall
      - clearance_reduction
      - decision
      - source
      - candidates

    - policy_state: abstract `PolicyState` of the movement primitive.
    - goal: (3,) goal of the motion in the world frame [m].
    - robot_state: (2m,) positions and velocities of the robot [rad, m, rad/s, m/s].
    - collision_scene_W: abstract `CollisionScene`: collision geometry of everything but the robot.
      Moving geometries are ignored; `MotionGuard` reacts to them.
    - ellipsoids_W (optional): abstract `EllipsoidSet`, ellipsoids of the obstacles dilated by the
      tool. Not connected: no candidate of the regressor chain.
    - coupling_parameters (optional, input): abstract `CouplingParameters` of `RegressorChain`, one
      coupling term (turning rate) per obstacle. Not connected: no candidate of the regressor chain.
    - route (optional, input): abstract `Route`: side on which each obstacle is passed, selected by
      `CostRingSelector`. Not connected: all sides have the same cost.
    - coupling_parameters (output): abstract `CouplingParameters`: coupling terms of the selected
      motion, if any, and the temporal scaling. If no candidate can be executed, the message holds
      the motion (stops it on its path), and its note gives the reason.
    - route (output): abstract `Route`: side of each obstacle to which heading guidance turns a
      motion with the coupling terms of the regressor chain; empty for other motions.
    - demonstration: abstract `Demonstration` that the motion imitates after a restart from rest;
      empty: demonstration of the task.
    - motion: abstract `PlannedMotion`: predicted motion of tool and joints, from the time of the
      decision on.
    - sides: abstract `Route`: costs of the sides on which each obstacle can be passed, and the
      side on which the selected motion passes; for a viewer.
    - shortfall: (1,) distance by which the predicted motion falls below the required clearance,
      beyond a tolerance [m]; 0: the motion achieves it. The required clearance is the requested
      one, or less where the current or the goal configuration is nearer to an obstacle.
    - clearance_reduction: (1,) amount by which the required clearance is below the requested one
      [m]: requested clearance of the tool minus the largest required clearance of any pair of body
      and obstacle; 0 without obstacles.
    - decision: (2,) start time and compute latency of the last decision [s].
    - source: (1,) kind of the motion; -1: no motion was selected. 0: nominal (demonstrated) motion;
      1: all coupling terms of the regressor chain together; 2: motion of the evolution strategy; 3:
      imitation of a joint-space path.
    - candidates: (4,) numbers of candidates of these kinds, 0 to 3, in the last search.

    A decision starts at initialization and every `period`, with an offset so that it uses an
    observation of the same instant. With simulated compute latency, a decision becomes active at
    the first `step` of the movement primitive after its completion; meanwhile no other decision
    starts. A completed decision is discarded if start or goal have changed, or if it restarts the
    motion from rest while the movement primitive moves. It is also discarded if, from the current
    state, its motion no longer achieves its predicted clearance, but the active motion still
    achieves its own.
    """

    def __init__(
        self,
        search: MotionSearch,
        positions: tuple[int, ...],
        num_states: int,
        *,
        period: float = 1.0 / 15.0,
        compute_latency: LatencyModel | None = None,
        step: float = 0.008,
    ) -> None:
        """Declares the ports, and the events at which decisions start and become active.

        Args:
            search: planner that selects the motion.
            positions: indices of the arm's joints in the robot state.
            num_states: size of the robot state.
            period: time between decisions [s].
            compute_latency: model that converts the counted work of a decision to its simulated
                compute latency; None: decisions are active at once.
            step: time step of the movement primitive, at which decisions become active [s].

        Raises:
            ValueError: if `period` or, with a latency model, `step` is not positive and finite.
        """
        super().__init__()
        self._search, self._positions = search, list(positions)
        self._compute_latency = compute_latency
        self._policy = AbstractInput(self, "policy_state", PolicyState)
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._robot = self.DeclareVectorInputPort("robot_state", num_states)
        self._collision_scene = AbstractInput(self, "collision_scene_W", CollisionScene)
        self._ellipsoids = AbstractInput(self, "ellipsoids_W", EllipsoidSet)
        self._coupling = AbstractInput(self, "coupling_parameters", CouplingParameters)
        self._route = AbstractInput(self, "route", Route)
        self._decision = self.DeclareAbstractState(Value(PendingDecision(SelectedMotion())))
        declare_state_outputs(
            self,
            self._decision,
            ("coupling_parameters", CouplingParameters, "active.command.coupling"),
            ("route", Route, "active.command.route"),
            ("demonstration", Demonstration, "active.command.demonstration"),
            ("motion", PlannedMotion, "active.prediction.motion"),
            ("sides", Route, "active.prediction.sides"),
            ("shortfall", 1, "active.prediction.shortfall"),
            ("clearance_reduction", 1, "active.prediction.clearance_reduction"),
            ("decision", 2, "timing"),
            ("source", 1, "active.command.source"),
            ("candidates", len(SOURCES), "active.counts"),
        )
        period = valid_period(period)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._decide)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, DECISION_OFFSET, self._decide)
        if compute_latency is not None:
            step = valid_period(step)
            # Just before the policy reads the command.
            self.DeclarePeriodicUnrestrictedUpdateEvent(
                step, step - min(DECISION_OFFSET, 0.5 * step), self._activate
            )

    def _read(self, context: Context) -> PendingDecision[SelectedMotion]:
        return context.get_abstract_state(self._decision).get_value()

    def _decide(self, context: Context, state: State) -> EventStatus:
        # Read `state`, not `context`: the other event of this instant may have updated it.
        value = state.get_mutable_abstract_state(self._decision)
        previous: PendingDecision[SelectedMotion] = value.get_value()
        time = context.get_time()
        policy = self._policy.read(context)
        if policy.baseline == 0.0 or not np.isfinite(self._goal.Eval(context)).all():
            # The policy has no start and goal yet, or is held because the goal is not finite.
            return EventStatus.DidNothing()
        inputs = self._inputs(context)
        decision = previous.start(
            lambda active: self._search.decide(active, inputs), time, self._compute_latency
        )
        if decision is previous:
            return EventStatus.DidNothing()
        _log_change(previous.active, decision.active, time)
        value.set_value(decision)
        return EventStatus.Succeeded()

    def _inputs(self, context: Context) -> PlanningInputs:
        """Reads the inputs of a decision from the input ports, and omits moving geometries."""
        return PlanningInputs(
            self._policy.read(context),
            np.array(self._goal.Eval(context)),
            np.array(self._robot.Eval(context)[self._positions]),
            self._collision_scene.read(context).at_rest(),
            self._ellipsoids.read_or_empty(context),
            self._coupling.read_or_empty(context),
            self._route.read_or_empty(context),
        )

    def _activate(self, context: Context, state: State) -> EventStatus:
        value = state.get_mutable_abstract_state(self._decision)
        previous: PendingDecision[SelectedMotion] = value.get_value()
        time = context.get_time()
        result = previous.result_at(time)
        if result is None:
            return EventStatus.DidNothing()
        policy = self._policy.read(context)
        is_current = result.matches(policy, self._goal.Eval(context))
        is_current = is_current and (policy.speed == 0.0 or not result.command.restart)
        if is_current and not self._is_outdated(result, previous.active, context):
            _log_change(previous.active, result, time)
            value.set_value(previous.activate())
        else:
            message = "t=%.3f s: discarded decision started at t=%.3f s: the motion has changed"
            _logger.info(message, time, previous.start_time)
            value.set_value(previous.discard())
        return EventStatus.Succeeded()

    def _is_outdated(
        self, result: SelectedMotion, active: SelectedMotion, context: Context
    ) -> bool:
        """Checks whether a completed decision is worse than the active one at the current state.

        A decision is valid if its motion still achieves its predicted clearance from the current
        state. The result is True if the completed decision is not valid, but the active one is. The
        result is False without this check if the active motion is held or has a shortfall, if the
        completed decision restarts the motion from rest, or if the two decisions have different
        collision scenes.

        Args:
            result: completed decision.
            active: decision that is executed.
            context: context of the system, from which the current state is read.
        """
        is_infeasible = active.prediction.shortfall > 0.0 or active.command.note
        if is_infeasible or result.command.restart or not active.scene.same_as(result.scene):
            return False
        inputs, is_valid = self._inputs(context), self._search.is_still_valid
        # Both may be invalid during a maneuver of MotionGuard: the new decision is kept then.
        return not is_valid(result, inputs) and is_valid(active, inputs)


def _log_change(previous: SelectedMotion, current: SelectedMotion, time: float) -> None:
    """Logs when a contact, a clearance shortfall or a restart of the motion begins.

    The shortfall of a held motion is not logged.

    Args:
        previous: motion that was executed before.
        current: motion that is executed from now on.
        time: current time [s].
    """
    last, prediction = previous.prediction, current.prediction
    if prediction.contact and prediction.contact != last.contact:
        message = "t=%.3f s: arm in contact with %s; only retreating motions allowed"
        _logger.warning(message, time, prediction.contact)
    if prediction.shortfall > 0.0 and not current.command.note and not last.shortfall > 0.0:
        _logger.warning(
            "t=%.3f s: clearance shortfall of %.1f mm at %s; the motion continues",
            time,
            1e3 * prediction.shortfall,
            prediction.limiting_obstacle,
        )
    if current.command.restart and not previous.command.restart:
        _logger.info("t=%.3f s: motion restarts and imitates a joint-space path", time)
