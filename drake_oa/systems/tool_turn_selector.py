"""The decision level of the tool's orientation: which turn to pass in."""

from __future__ import annotations

import logging
import math

from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from drake_oa.systems.ports import DECISION_OFFSET, read_value, valid_period
from drake_oa.tool_turn import ToolTurner, TurnChoice
from drake_oa.values import ObstacleClouds, PolicyState

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

    The choice is abstract state. It is made every `period`, between observations and the
    regulation of the same instant; other turns are looked at when obstacles or goal change
    by more than noise does, and whether it can be turned back every
    `TurnParameters.period`. See `drake_oa.tool_turn`. A new choice is logged.
    """

    def __init__(self, turner: ToolTurner, *, period: float = 1.0 / 30.0) -> None:
        """Declares the ports.

        Args:
            turner: what chooses.
            period: time between choices [s].

        Raises:
            ValueError: if the period is not finite and positive.
        """
        super().__init__()
        self._turner = turner
        self._obstacles = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self._now = self.DeclareVectorInputPort("tool_turn", 1)
        self._chosen = self.DeclareAbstractState(Value(TurnChoice()))
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

    def _read(self, context: Context) -> TurnChoice:
        return context.get_abstract_state(self._chosen).get_value()

    def _calc(self, context: Context, output: BasicVector, field: str) -> None:
        output.SetAtIndex(0, getattr(self._read(context), field))

    def _choose(self, context: Context, state: State) -> EventStatus:
        before = self._read(context)
        now = float(self._now.Eval(context)[0]) if self._now.HasValue(context) else before.turn
        after = self._turner.update(
            before,
            read_value(self, self._policy, context, PolicyState),
            self._goal.Eval(context),
            read_value(self, self._obstacles, context, ObstacleClouds),
            now,
        )
        _log_change(before, after, context.get_time())
        state.get_mutable_abstract_state(self._chosen).set_value(after)
        return EventStatus.Succeeded()


def _log_change(before: TurnChoice, after: TurnChoice, time: float) -> None:
    if after.planned != before.planned:
        degrees = math.degrees(after.planned)
        _logger.info("t=%.3f s: passes with the tool turned by %.0f degrees", time, degrees)
    if after.note and after.note != before.note:
        _logger.warning("t=%.3f s: %s", time, after.note)
