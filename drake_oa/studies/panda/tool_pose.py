"""Tool positions as poses, for systems that take a pose."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, LeafSystem


class ToolPose(LeafSystem):
    """The pose that a moving tool has a moment later, with an orientation that stays.

    .. pydrake_system::

      name: ToolPose
      input_ports:
      - desired_position
      - desired_velocity
      output_ports:
      - desired_pose

    - desired_position: (3,) p_WE [m].
    - desired_velocity: (3,) v_WE [m/s].
    - desired_pose: abstract `RigidTransform` X_WE: p_WE + look_ahead v_WE, and the
      orientation given once.

    There is no state.
    """

    def __init__(self, R_WE: RotationMatrix, *, look_ahead: float = 0.0) -> None:
        """Declares the ports.

        Args:
            R_WE: orientation of the tool.
            look_ahead: how much later [s]; finite.

        Raises:
            ValueError: if look_ahead is not finite.
        """
        super().__init__()
        if not np.isfinite(look_ahead):
            raise ValueError(f"look_ahead must be finite [s], not {look_ahead}")
        self._R_WE = R_WE
        self._look_ahead = float(look_ahead)
        self._position = self.DeclareVectorInputPort("desired_position", 3)
        self._velocity = self.DeclareVectorInputPort("desired_velocity", 3)
        self.DeclareAbstractOutputPort(
            "desired_pose",
            lambda: Value(RigidTransform()),
            self._calc_pose,
            prerequisites_of_calc={self._position.ticket(), self._velocity.ticket()},
        )

    def _calc_pose(self, context: Context, output: AbstractValue) -> None:
        ahead = self._position.Eval(context) + self._look_ahead * self._velocity.Eval(context)
        output.set_value(RigidTransform(self._R_WE, ahead))
