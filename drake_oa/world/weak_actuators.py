"""Actuators that give less than they should, between controller and plant."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_oa.common.messages import FloatArray
from drake_oa.scenario.faults import Fault
from drake_oa.world.faults import torque_scale


class WeakActuators(LeafSystem):
    """Cuts the actuation off at shrunken effort limits while a fault says so.

    .. pydrake_system::

      name: WeakActuators
      input_ports:
      - actuation
      output_ports:
      - actuation

    - actuation (in): (n,) what the controller asks for [N m, N].
    - actuation (out): (n,) what the actuators give: not more than `scale` of the effort
      limits while a `TorqueSaturation` lasts, else all of it.
    """

    def __init__(self, faults: Sequence[Fault], effort_limits: FloatArray) -> None:
        """Declares the ports.

        Args:
            faults: see `drake_oa.world.faults`.
            effort_limits: (n,) of the actuators, in the plant's order [N m, N].

        Raises:
            ValueError: for limits that are not positive numbers.
        """
        super().__init__()
        limits = np.array(effort_limits, dtype=float)
        if limits.ndim != 1 or not (limits > 0.0).all():
            raise ValueError(f"effort_limits must be (n,) and positive, not {effort_limits}")
        self._faults, self._limits = tuple(faults), limits
        self._asked = self.DeclareVectorInputPort("actuation", len(limits))
        self.DeclareVectorOutputPort(
            "actuation", len(limits), self._calc, {self.time_ticket(), self._asked.ticket()}
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        asked = self._asked.Eval(context)
        scale = torque_scale(self._faults, context.get_time())
        most = scale * self._limits
        output.SetFromVector(asked if scale >= 1.0 else np.clip(asked, -most, most))
