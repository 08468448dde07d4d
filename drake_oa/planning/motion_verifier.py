"""Verification of proposed motions by roll-outs of the whole arm among the collision geometry."""

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
    """Selection of the whole arm's motion among candidates, which it verifies by roll-outs.

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
    - collision_scene_W: abstract `CollisionScene`: collision geometry of everything but the robot. Solids that
      move are left to `MotionGuard`.
    - ellipsoids_W (optional): abstract `EllipsoidSet`, the descriptors of the obstacles.
    - coupling_parameters (optional, input): abstract `CouplingParameters` of
      `RegressorChain`.
    - route (optional, input): abstract `Route`, the sides that `CostRingSelector` selects.
    - coupling_parameters (output): abstract `CouplingParameters`, the verified terms or none, with
      the temporal scaling, and a note that holds the motion if none was found.
    - route (output): abstract `Route` that guides the verified terms of the regressor chain; empty
      for other motions.
    - demonstration: abstract `Demonstration` that a restarting motion imitates.
    - motion: abstract `PlannedMotion` of the whole arm, from the time of the decision.
    - sides: abstract `Route`: the sides at the obstacle that the motion avoids, with their costs
      and the selected one; for a viewer.
    - shortfall: (1,) shortfall of the requested clearance [m]; 0 where it is achieved.
    - clearance_reduction: (1,) reduction of the requested clearance, as start or goal leave no more [m].
    - decision: (2,) when the last decision began and the time that it takes [s].
    - source: (1,) source of the motion, a row of `drake_oa.planning.search.SOURCES`; -1: nothing
      was selected.
    - candidates: (5,) numbers of candidates that the last search rolled out, by source.

    A decision begins at initialization and every `period`, shortly after it so that an observation
    of the same instant counts; with simulated decision latency it is in force from the first
    `step` of the policy after its end, and no other begins before.
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
        """Declares the ports.

        Args:
            search: selects the motion.
            positions: where the arm's joints are in the robot's state.
            num_states: size of that state.
            period: time between choices [s].
            compute_latency: what choices cost in simulated time; None: none.
            step: of the policy, at which choices come into force then [s].

        Raises:
            ValueError: if a period is not positive.
        """
        super().__init__()
        self._search, self._positions = search, list(positions)
        self._compute_latency = compute_latency
        self._policy = AbstractInput(self, "policy_state", PolicyState)
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._robot = self.DeclareVectorInputPort("robot_state", num_states)
        self._solids = AbstractInput(self, "collision_scene_W", CollisionScene)
        self._ellipsoids = AbstractInput(self, "ellipsoids_W", EllipsoidSet)
        self._proposed = AbstractInput(self, "coupling_parameters", CouplingParameters)
        self._route = AbstractInput(self, "route", Route)
        self._chosen = self.DeclareAbstractState(Value(PendingDecision(SelectedMotion())))
        declare_state_outputs(
            self,
            self._chosen,
            ("coupling_parameters", CouplingParameters, "active.command.coupling"),
            ("route", Route, "active.command.route"),
            ("demonstration", Demonstration, "active.command.demonstration"),
            ("motion", PlannedMotion, "active.prediction.motion"),
            ("sides", Route, "active.prediction.sides"),
            ("shortfall", 1, "active.prediction.shortfall"),
            ("clearance_reduction", 1, "active.prediction.clearance_reduction"),
            ("decision", 2, "last"),
            ("source", 1, "active.command.source"),
            ("candidates", len(SOURCES), "active.counts"),
        )
        period = valid_period(period)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._choose)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, DECISION_OFFSET, self._choose)
        if compute_latency is not None:
            step = valid_period(step)
            # Just before the policy looks.
            self.DeclarePeriodicUnrestrictedUpdateEvent(
                step, step - min(DECISION_OFFSET, 0.5 * step), self._take_effect
            )

    def _read(self, context: Context) -> PendingDecision[SelectedMotion]:
        return context.get_abstract_state(self._chosen).get_value()

    def _choose(self, context: Context, state: State) -> EventStatus:
        # Not the Context's: the other event of the same instant may have come first.
        held = state.get_mutable_abstract_state(self._chosen)
        kept: PendingDecision[SelectedMotion] = held.get_value()
        time = context.get_time()
        policy = self._policy.read(context)
        if policy.baseline == 0.0:
            # There is no motion yet to choose for.
            return EventStatus.DidNothing()
        inputs = self._inputs(context)
        pending = kept.start(
            lambda before: self._search.decide(before, inputs), time, self._compute_latency
        )
        if pending is kept:
            return EventStatus.DidNothing()
        _log_change(kept.active, pending.active, time)
        held.set_value(pending)
        return EventStatus.Succeeded()

    def _inputs(self, context: Context) -> PlanningInputs:
        """Returns the input of a decision now."""
        return PlanningInputs(
            self._policy.read(context),
            np.array(self._goal.Eval(context)),
            np.array(self._robot.Eval(context)[self._positions]),
            self._solids.read(context).at_rest(),
            self._ellipsoids.read_or_empty(context),
            self._proposed.read_or_empty(context),
            self._route.read_or_empty(context),
        )

    def _take_effect(self, context: Context, state: State) -> EventStatus:
        held = state.get_mutable_abstract_state(self._chosen)
        kept: PendingDecision[SelectedMotion] = held.get_value()
        time = context.get_time()
        made = kept.completed(time)
        if made is None:
            return EventStatus.DidNothing()
        policy = self._policy.read(context)
        fits = made.fits(policy, self._goal.Eval(context))
        fits = fits and (policy.speed == 0.0 or not made.command.restart)
        if fits and not self._is_late(made, kept.active, context):
            _log_change(kept.active, made, time)
            held.set_value(kept.activated())
        else:
            _logger.info("t=%.3f s: a decision of t=%.3f s is dropped", time, kept.begun)
            held.set_value(kept.discarded())
        return EventStatus.Succeeded()

    def _is_late(self, made: SelectedMotion, active: SelectedMotion, context: Context) -> bool:
        """Whether a choice no more does from where the motion is now, and the one in force does."""
        is_short = active.prediction.shortfall > 0.0 or active.command.note
        if is_short or not active.scene.same_as(made.scene):
            return False
        inputs, holds = self._inputs(context), self._search.still_holds
        # During a maneuver of MotionGuard neither may.
        return not holds(made, inputs) and holds(active, inputs)


def _log_change(before: SelectedMotion, after: SelectedMotion, time: float) -> None:
    """Logs shortfalls and contacts of a new motion, once."""
    was, now = before.prediction, after.prediction
    if now.touches and now.touches != was.touches:
        _logger.warning("t=%.3f s: the arm touches %s, and may only leave it", time, now.touches)
    if now.shortfall > 0.0 and not after.command.note and not was.shortfall > 0.0:
        _logger.warning(
            "t=%.3f s: %.1f mm of the clearance to %s cannot be kept",
            time,
            1e3 * now.shortfall,
            now.limiting_obstacle,
        )
    if after.command.restart and not before.command.restart:
        _logger.info("t=%.3f s: a path of the whole arm is imitated", time)
