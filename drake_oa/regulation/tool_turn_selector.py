"""The decision level of the tool's orientation: which turn to pass in."""

from __future__ import annotations

import logging
import math

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from drake_oa.common.messages import ObstacleClouds, PolicyState
from drake_oa.common.ports import DECISION_OFFSET, read_value, valid_period
from drake_oa.common.thinking import ForMotion, Thinking, Thoughts
from drake_oa.regulation.tool_turn import ToolTurner, TurnChoice

_logger = logging.getLogger("drake_oa")


class ToolTurnSelector(LeafSystem):
    """Chooses how far the tool is turned to pass where it would not fit otherwise.

    .. pydrake_system::

      name: ToolTurnSelector
      input_ports:
      - obstacles_W
      - policy_state
      - goal
      - tool_turn (optional)
      output_ports:
      - turn
      - planned_turn
      - speed_scale
      - decision

    - obstacles_W: abstract `ObstacleClouds`; may be empty.
    - policy_state: abstract `PolicyState` of the movement primitive.
    - goal: (3,) goal of the motion in the world frame [m].
    - tool_turn (optional): (1,) turn that the tool has now [rad], as an
      `OrientationIntegrator` gives it; without it the tool has what was asked of it.
    - turn: (1,) turn that the tool is to take now [rad]: as far towards the planned one as
      it sweeps nothing where it is.
    - planned_turn: (1,) turn in which it is to pass [rad], by which an `EllipsoidDescriptor`
      dilates the obstacles.
    - speed_scale: (1,) share of full speed at which the motion may go, in [0, 1]: less than 1
      only while the tool turns and is near to where a turn in between would touch.
    - decision: (2,) when the last choice began (NaN: none has) and the time that it takes [s];
      NaN and 0 where thinking costs none.

    The choice is abstract state. It is made every `period`, between observations and the
    regulation of the same instant; other turns are looked at when obstacles or goal change
    by more than noise does, and whether it can be turned back every
    `TurnParameters.period`. Where thinking costs time, a choice is in force from the first
    `step` after that, and no other begins before; one for a goal or a start that are others by
    then is dropped. See `drake_oa.regulation.tool_turn`. A new choice is logged.
    """

    def __init__(
        self,
        turner: ToolTurner,
        *,
        period: float = 1.0 / 30.0,
        thinking: Thinking | None = None,
        step: float = 0.008,
    ) -> None:
        """Declares the ports.

        Args:
            turner: what chooses.
            period: time between choices [s].
            thinking: what choices cost in simulated time; None: none.
            step: time between looks at whether one is in force [s].

        Raises:
            ValueError: if period or step are not finite and positive.
        """
        super().__init__()
        self._turner = turner
        self._obstacles = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._now = self.DeclareVectorInputPort("tool_turn", 1)
        self._thinking = thinking
        self._chosen = self.DeclareAbstractState(Value(Thoughts(ForMotion(TurnChoice()))))
        chosen = {self.abstract_state_ticket(self._chosen)}
        for name, field in (
            ("turn", "turn"),
            ("planned_turn", "planned"),
            ("speed_scale", "speed_scale"),
        ):
            self.DeclareVectorOutputPort(
                name,
                1,
                lambda context, output, field=field: self._calc(context, output, field),
                chosen,
            )
        # The regulation decides later in the same period, among what is dilated so.
        self.DeclarePeriodicUnrestrictedUpdateEvent(
            valid_period(period), 0.5 * DECISION_OFFSET, self._choose
        )
        self.DeclareVectorOutputPort("decision", 2, self._calc_decision, chosen)
        if thinking is not None:
            self.DeclarePeriodicUnrestrictedUpdateEvent(valid_period(step), 0.0, self._take_effect)

    def _read(self, context: Context) -> Thoughts[ForMotion[TurnChoice]]:
        return context.get_abstract_state(self._chosen).get_value()

    def _calc(self, context: Context, output: BasicVector, field: str) -> None:
        output.SetAtIndex(0, getattr(self._read(context).in_force.decision, field))

    def _calc_decision(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._read(context).last)

    def _choose(self, context: Context, state: State) -> EventStatus:
        # Not the Context's: the other event of the same instant may have come first.
        held = state.get_mutable_abstract_state(self._chosen)
        before: Thoughts[ForMotion[TurnChoice]] = held.get_value()
        after = before.thought(
            lambda choice: self._decide(context, choice.decision),
            context.get_time(),
            self._thinking,
        )
        if after is before:
            return EventStatus.DidNothing()
        self._log_change(before.in_force.decision, after.in_force.decision, context.get_time())
        held.set_value(after)
        return EventStatus.Succeeded()

    def _take_effect(self, context: Context, state: State) -> EventStatus:
        held = state.get_mutable_abstract_state(self._chosen)
        before: Thoughts[ForMotion[TurnChoice]] = held.get_value()
        made = before.made(context.get_time())
        if made is None:
            return EventStatus.DidNothing()
        policy = read_value(self, self._policy, context, PolicyState)
        if made.fits(policy, self._goal.Eval(context)):
            self._log_change(before.in_force.decision, made.decision, context.get_time())
            held.set_value(before.taken())
        else:
            held.set_value(before.dropped())
        return EventStatus.Succeeded()

    def _decide(self, context: Context, before: TurnChoice) -> ForMotion[TurnChoice]:
        policy, goal = (
            read_value(self, self._policy, context, PolicyState),
            self._goal.Eval(context),
        )
        now = float(self._now.Eval(context)[0]) if self._now.HasValue(context) else before.turn
        after = self._turner.update(
            before,
            policy,
            goal,
            read_value(self, self._obstacles, context, ObstacleClouds),
            now,
        )
        return ForMotion(after, policy.p_WS, np.array(goal))

    def _log_change(self, before: TurnChoice, after: TurnChoice, time: float) -> None:
        if after.planned != before.planned:
            degrees = math.degrees(after.planned)
            _logger.info("t=%.3f s: passes with the tool turned by %.0f degrees", time, degrees)
        if after.blocked and not before.blocked:
            limit = math.degrees(self._turner.largest)
            _logger.warning(
                "t=%.3f s: no turn of the tool within %.0f degrees lets it pass", time, limit
            )
