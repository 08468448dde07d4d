"""Between a camera's perception and what watches the links: the far sides of what moves."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from drake_oa.common.messages import FloatArray, Frozen, ObstacleClouds
from drake_oa.common.ports import read_value, valid_period
from drake_oa.perception.hidden_sides import names_moved, with_hidden_sides


@dataclass(frozen=True, eq=False)
class _Look(Frozen):
    """From where the camera looks, and what has moved before it."""

    viewpoint_W: FloatArray = field(default_factory=lambda: np.zeros(3))
    moved: frozenset[int] = frozenset()


class HiddenSides(LeafSystem):
    """Gives obstacles that move the side that the camera does not see.

    .. pydrake_system::

      name: HiddenSides
      input_ports:
      - obstacles_W
      - camera_pose
      output_ports:
      - obstacles_W

    - obstacles_W (in): abstract `ObstacleClouds`.
    - camera_pose: RigidTransform X_WC of the camera that sees them.
    - obstacles_W (out): abstract `ObstacleClouds`; where nothing has moved that of the input,
      else what moves or has moved has more points, which make it as deep as it is broad, at
      most 15 cm, and solid below its top, see `drake_oa.perception.hidden_sides`.

    The Context holds the camera's place and the names of what has moved, read every `period`:
    the pose depends on time, and the output is to change with an observation only.
    """

    def __init__(self, *, period: float = 1.0 / 15.0) -> None:
        """Declares the ports.

        Args:
            period: time between observations [s].

        Raises:
            ValueError: if it is not positive and finite.
        """
        super().__init__()
        self._obstacles = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self._pose = self.DeclareAbstractInputPort("camera_pose", Value(RigidTransform()))
        self._look = self.DeclareAbstractState(Value(_Look()))
        self.DeclareAbstractOutputPort(
            "obstacles_W",
            lambda: Value(ObstacleClouds()),
            self._calc_obstacles,
            {self._obstacles.ticket(), self.abstract_state_ticket(self._look)},
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(valid_period(period), 0.0, self._update)

    def _read(self, context: Context) -> _Look:
        return context.get_abstract_state(self._look).get_value()

    def _update(self, context: Context, state: State) -> EventStatus:
        before = self._read(context)
        pose = read_value(self, self._pose, context, RigidTransform)
        seen = read_value(self, self._obstacles, context, ObstacleClouds)
        after = _Look(pose.translation(), names_moved(seen, before.moved))
        if after.moved == before.moved and np.array_equal(after.viewpoint_W, before.viewpoint_W):
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(self._look).set_value(after)
        return EventStatus.Succeeded()

    def _calc_obstacles(self, context: Context, output: AbstractValue) -> None:
        seen = read_value(self, self._obstacles, context, ObstacleClouds)
        look = self._read(context)
        output.set_value(with_hidden_sides(seen, look.viewpoint_W, look.moved))
