"""What turns the links away from obstacles in the null space of the tool's task."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, EventStatus, LeafSystem, State

from drake_oa.common.messages import FloatArray, Frozen, ObstacleClouds, TablePlane
from drake_oa.common.ports import DECISION_OFFSET, read_value, valid_period
from drake_oa.posture.arm_surroundings import ArmSurroundings
from drake_oa.posture.null_space_coupling import (
    NullSpaceCouplingParameters,
    null_space_acceleration,
)
from drake_oa.robot.arm_motion import ArmModel


@dataclass(frozen=True, eq=False)
class _Held(Frozen):
    """What is kept from step to step: the obstacles, laid out, and the answer [rad/s^2]."""

    acceleration: FloatArray
    seen: ObstacleClouds | None = None
    around: ArmSurroundings = field(default_factory=ArmSurroundings)


class NullSpaceCoupling(LeafSystem):
    """Applies the coupling law to the links, as `drake_oa.posture.null_space_coupling` describes
    it.

    .. pydrake_system::

      name: NullSpaceCoupling
      input_ports:
      - robot_state
      - obstacles_W
      output_ports:
      - null_space_acceleration

    - robot_state: positions and velocities of the robot, (2m,) [rad, m, rad/s, m/s].
    - obstacles_W: abstract `ObstacleClouds`, with their velocities.
    - null_space_acceleration: (n,) of the arm's n joints, for `CartesianInverseDynamics`
      [rad/s^2]; 0 where nothing is near or approached, or the state is not finite.

    It is decided every `period` and held in between. What is held is abstract state.
    """

    def __init__(
        self,
        arm: ArmModel,
        num_states: int,
        parameters: NullSpaceCouplingParameters,
        *,
        period: float = 0.008,
        table: TablePlane | None = None,
    ) -> None:
        """Declares the ports.

        Args:
            arm: whose links.
            num_states: 2m, size of the robot's state; velocities are in the order of the
                positions.
            parameters: of the law.
            period: time between decisions [s].
            table: the supporting plane, where it is known.

        Raises:
            ValueError: if the state does not hold the arm's joints, or the period is not
                positive.
        """
        super().__init__()
        if num_states % 2 or num_states < 2 * (int(arm.index.max()) + 1):
            raise ValueError(f"num_states must hold the arm's joints, not {num_states}")
        self._period = valid_period(period)
        self._arm, self._parameters, self._table = arm, parameters, table
        self._index: Sequence[int] = arm.index.tolist()
        self._count = num_states // 2
        n = len(self._index)
        self._robot = self.DeclareVectorInputPort("robot_state", num_states)
        self._obstacles = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self._held = self.DeclareAbstractState(Value(_Held(np.zeros(n))))
        self.DeclareVectorOutputPort(
            "null_space_acceleration", n, self._calc, {self.abstract_state_ticket(self._held)}
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._decide)
        self.DeclarePeriodicUnrestrictedUpdateEvent(self._period, DECISION_OFFSET, self._decide)

    def _decide(self, context: Context, state: State) -> EventStatus:
        held: _Held = context.get_abstract_state(self._held).get_value()
        seen = read_value(self, self._obstacles, context, ObstacleClouds)
        around = held.around
        if seen is not held.seen:
            around = ArmSurroundings.of(seen, self._table)
        x = self._robot.Eval(context)
        acceleration = np.zeros(len(self._index))
        if np.isfinite(x).all():
            acceleration = null_space_acceleration(
                self._arm,
                around,
                x[self._index],
                x[self._count :][self._index],
                self._parameters,
                time=context.get_time(),
                step=self._period,
            )
        state.get_mutable_abstract_state(self._held).set_value(_Held(acceleration, seen, around))
        return EventStatus.Succeeded()

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_abstract_state(self._held).get_value().acceleration)
