"""Between a camera's perception and what watches the links: the far sides of what moves."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from drake_oa.hidden_sides import with_hidden_sides
from drake_oa.systems.ports import read_value, valid_period
from drake_oa.values import ObstacleClouds


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
    - obstacles_W (out): abstract `ObstacleClouds`; where nothing moves that of the input, else
      what moves has as many points more as make it as deep as it is broad, see
      `drake_oa.hidden_sides`.

    The Context holds the camera's place, read every `period`: its pose depends on time, and
    the output is to change with an observation only.
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
        self._viewpoint = self.DeclareDiscreteState(3)
        self.DeclareAbstractOutputPort(
            "obstacles_W",
            lambda: Value(ObstacleClouds()),
            self._calc_obstacles,
            {self._obstacles.ticket(), self.discrete_state_ticket(self._viewpoint)},
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._look)
        self.DeclarePeriodicDiscreteUpdateEvent(valid_period(period), 0.0, self._look)

    def _look(self, context: Context, state: DiscreteValues) -> None:
        pose = read_value(self, self._pose, context, RigidTransform)
        state.get_mutable_vector(self._viewpoint).SetFromVector(pose.translation())

    def _calc_obstacles(self, context: Context, output: AbstractValue) -> None:
        seen = read_value(self, self._obstacles, context, ObstacleClouds)
        viewpoint = np.array(context.get_discrete_state(self._viewpoint).value())
        output.set_value(with_hidden_sides(seen, viewpoint))
