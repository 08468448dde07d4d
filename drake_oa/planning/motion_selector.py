"""The regulation layer for the whole arm: the motion that is gone, chosen among true shapes."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from drake_oa.common.messages import (
    DECIDING,
    CouplingParameters,
    EllipsoidSet,
    Frozen,
    HoldCause,
    PlannedMotion,
    PolicyState,
    Route,
)
from drake_oa.common.ports import DECISION_OFFSET, read_optional, read_value, valid_period
from drake_oa.common.thinking import Thinking, Thoughts
from drake_oa.planning.motion_search import Choice, MotionSearch, Sight
from drake_oa.planning.solid_scene import SolidScene
from drake_oa.policy.demonstration import Demonstration

_logger = logging.getLogger("drake_oa")


@dataclass(frozen=True, eq=False)
class _State(Frozen):
    thoughts: Thoughts[Choice] = field(default_factory=lambda: Thoughts(Choice()))

    @property
    def choice(self) -> Choice:
        """What is in force."""
        return self.thoughts.in_force


class MotionSelector(LeafSystem):
    """Chooses the motion of the whole arm, and regulates the coupling terms by it.

    .. pydrake_system::

      name: MotionSelector
      input_ports:
      - policy_state
      - goal
      - robot_state
      - solids_W
      - ellipsoids_W (optional)
      output_ports:
      - coupling_parameters
      - demonstration
      - motion
      - sides
      - shortfall
      - lowered
      - decision

    - policy_state: abstract `PolicyState` of the movement primitive.
    - goal: (3,) goal of the motion in the world frame [m].
    - robot_state: (2m,) positions and velocities of the robot [rad, m, rad/s, m/s].
    - solids_W: abstract `SolidScene`: all that is not the robot.
    - ellipsoids_W (optional): abstract `EllipsoidSet`, which the regressor chain proposes by.
    - coupling_parameters: abstract `CouplingParameters`, a term of its own or none, with the
      temporal scaling, and a note that holds the motion where none was found.
    - demonstration: abstract `Demonstration` that a motion that begins anew imitates.
    - motion: abstract `PlannedMotion` of the whole arm, from the instant of the choice.
    - sides: abstract `Route`: the sides that were weighed at the last choice, with their costs, and
      the one that was taken; for a viewer.
    - shortfall: (1,) what the motion lacks of what is asked [m]; 0 where it is kept.
    - lowered: (1,) by how much less than the asked clearance is asked [m].
    - decision: (2,) when the last choice began and the time that it takes [s].

    A choice is made at initialization and every `period`, shortly after it so that an observation
    of the same instant counts; where thinking costs time it is in force from the first `step` of
    the policy after that, and no other begins before.
    """

    def __init__(
        self,
        search: MotionSearch,
        positions: tuple[int, ...],
        num_states: int,
        *,
        period: float = 1.0 / 15.0,
        thinking: Thinking | None = None,
        step: float = 0.008,
    ) -> None:
        """Declares the ports.

        Args:
            search: what chooses.
            positions: where the arm's joints are in the robot's state.
            num_states: size of that state.
            period: time between choices [s].
            thinking: what choices cost in simulated time; None: none.
            step: of the policy, at which choices come into force then [s].

        Raises:
            ValueError: if a period is not positive.
        """
        super().__init__()
        self._search, self._positions = search, list(positions)
        self._thinking = thinking
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._robot = self.DeclareVectorInputPort("robot_state", num_states)
        self._solids = self.DeclareAbstractInputPort("solids_W", Value(SolidScene()))
        self._ellipsoids = self.DeclareAbstractInputPort("ellipsoids_W", Value(EllipsoidSet()))
        self._chosen = self.DeclareAbstractState(Value(_State()))
        chosen = {self.abstract_state_ticket(self._chosen)}
        for name, kind, of in (
            ("coupling_parameters", CouplingParameters, self._coupling),
            ("demonstration", Demonstration, lambda state: state.choice.demonstration),
            ("motion", PlannedMotion, lambda state: state.choice.motion),
            ("sides", Route, lambda state: state.choice.route),
        ):
            self.DeclareAbstractOutputPort(
                name,
                lambda kind=kind: Value(kind()),
                lambda context, output, of=of: output.set_value(of(self._read(context))),
                chosen,
            )
        self.DeclareVectorOutputPort("shortfall", 1, self._calc_shortfall, chosen)
        self.DeclareVectorOutputPort("lowered", 1, self._calc_lowered, chosen)
        self.DeclareVectorOutputPort("decision", 2, self._calc_decision, chosen)
        period = valid_period(period)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._choose)
        self.DeclarePeriodicUnrestrictedUpdateEvent(period, DECISION_OFFSET, self._choose)
        if thinking is not None:
            step = valid_period(step)
            # Just before the policy looks.
            self.DeclarePeriodicUnrestrictedUpdateEvent(
                step, step - min(DECISION_OFFSET, 0.5 * step), self._take_effect
            )

    def _read(self, context: Context) -> _State:
        return context.get_abstract_state(self._chosen).get_value()

    def _choose(self, context: Context, state: State) -> EventStatus:
        # Not the Context's: the other event of the same instant may have come first.
        held = state.get_mutable_abstract_state(self._chosen)
        kept: _State = held.get_value()
        time = context.get_time()
        policy = read_value(self, self._policy, context, PolicyState)
        if policy.baseline == 0.0:
            # There is no motion yet to choose for.
            return EventStatus.DidNothing()
        sight = self.sight(context)
        thoughts = kept.thoughts.thought(
            lambda before: self._search.decide(before, sight), time, self._thinking
        )
        if thoughts is kept.thoughts:
            return EventStatus.DidNothing()
        _log_change(kept.choice, thoughts.in_force, time)
        held.set_value(_State(thoughts))
        return EventStatus.Succeeded()

    @property
    def search(self) -> MotionSearch:
        """What chooses."""
        return self._search

    def sight(self, context: Context) -> Sight:
        """What a motion would be chosen by now."""
        return Sight(
            read_value(self, self._policy, context, PolicyState),
            np.array(self._goal.Eval(context)),
            np.array(self._robot.Eval(context)[self._positions]),
            read_value(self, self._solids, context, SolidScene),
            read_optional(self, self._ellipsoids, context, EllipsoidSet) or EllipsoidSet(),
        )

    def _take_effect(self, context: Context, state: State) -> EventStatus:
        held = state.get_mutable_abstract_state(self._chosen)
        kept: _State = held.get_value()
        time = context.get_time()
        made = kept.thoughts.made(time)
        if made is None:
            return EventStatus.DidNothing()
        policy = read_value(self, self._policy, context, PolicyState)
        other = not made.fits(policy, self._goal.Eval(context))
        if other or (made.anew and policy.speed > 0.0) or self._is_late(made, kept.choice, context):
            _logger.info("t=%.3f s: a decision of t=%.3f s is dropped", time, kept.thoughts.begun)
            held.set_value(_State(kept.thoughts.dropped()))
            return EventStatus.Succeeded()
        _log_change(kept.choice, made, time)
        held.set_value(_State(kept.thoughts.taken()))
        return EventStatus.Succeeded()

    def _is_late(self, made: Choice, in_force: Choice, context: Context) -> bool:
        """Whether a choice no more does from where the motion is now, and the one in force does."""
        if in_force.short > 0.0 or in_force.note or not in_force.scene.same_as(made.scene):
            return False
        return not self._search.still_holds(made, self.sight(context))

    def _coupling(self, state: _State) -> CouplingParameters:
        coupling = state.choice.coupling()
        if state.choice.tau == 0.0 and self._thinking is not None:
            return replace(coupling, hold=HoldCause.DECIDING, note=DECIDING)
        return coupling

    def _calc_shortfall(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._read(context).choice.short)

    def _calc_lowered(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._read(context).choice.lowered)

    def _calc_decision(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._read(context).thoughts.last)


def _log_change(before: Choice, after: Choice, time: float) -> None:
    """Says once what a new choice does not do; why it holds, who holds says."""
    if after.touches and after.touches != before.touches:
        _logger.warning("t=%.3f s: the arm touches %s, and may only leave it", time, after.touches)
    if after.short > 0.0 and not after.note and not before.short > 0.0:
        _logger.warning(
            "t=%.3f s: %.1f mm of the clearance to %s cannot be kept",
            time,
            1e3 * after.short,
            after.short_of,
        )
    if after.anew and not before.anew:
        _logger.info("t=%.3f s: a path of the whole arm is imitated", time)
    if math.isfinite(after.tau) and before.short > 0.0 and after.short == 0.0:
        _logger.info("t=%.3f s: the clearance is kept again", time)
