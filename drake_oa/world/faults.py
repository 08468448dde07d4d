"""Systems of the scenario's faults: weak actuators, and external pushes.

    faults: [!CameraDropout {start: 1.0, duration: 0.5}, !TorqueSaturation {start: 2.0}]

A fault is active for start <= t < start + duration. `DelayedCamera` simulates `CameraDropout`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_oa.common.messages import FloatArray
from drake_oa.scenario.faults import CameraDropout, Push, TorqueSaturation

_TIME_TOLERANCE = 1e-6
"""Rounding error of a time [s]."""


def is_active(fault: CameraDropout | Push | TorqueSaturation, context: Context) -> bool:
    """Checks whether a fault is active at the time of a Context."""
    return 0.0 <= context.get_time() + _TIME_TOLERANCE - fault.start < fault.duration


class ExternalPush(LeafSystem):
    """System that applies the wrenches of pushes to bodies of a plant.

    .. pydrake_system::

      name: ExternalPush
      input_ports:
      output_ports:
      - spatial_forces

    - spatial_forces: abstract list of one `ExternallyAppliedSpatialForce` per push, at the origin
      of the body, in the world frame [N, N m]; zero before and after the push. For the port
      `applied_spatial_force` of a `MultibodyPlant`.
    """

    def __init__(self, pushes: Sequence[tuple[Push, BodyIndex]]) -> None:
        """Declares the port.

        Args:
            pushes: pushes, each with the index of its body.
        """
        super().__init__()
        self._pushes = tuple(pushes)
        self.DeclareAbstractOutputPort(
            "spatial_forces",
            lambda: AbstractValue.Make([ExternallyAppliedSpatialForce()]),
            self._calc,
            {self.time_ticket()},
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        """Outputs the wrenches of all pushes."""
        forces = []
        for push, body in self._pushes:
            scale = float(is_active(push, context))
            applied = ExternallyAppliedSpatialForce()
            applied.body_index = body
            applied.p_BoBq_B = np.zeros(3)
            applied.F_Bq_W = SpatialForce(
                tau=scale * np.array(push.torque), f=scale * np.array(push.force)
            )
            forces.append(applied)
        output.set_value(forces)


class WeakActuators(LeafSystem):
    """System that limits the actuation to reduced effort limits while a fault is active.

    .. pydrake_system::

      name: WeakActuators
      input_ports:
      - actuation
      output_ports:
      - actuation

    - actuation (in): (n,) efforts commanded by the controller [N m, N].
    - actuation (out): (n,) efforts of the actuators [N m, N]: clipped to `scale` times the effort
      limits while a `TorqueSaturation` is active, otherwise the commanded efforts.
    """

    def __init__(self, faults: Sequence[TorqueSaturation], effort_limits: FloatArray) -> None:
        """Declares the ports.

        Args:
            faults: times and remaining fractions of the effort limits.
            effort_limits: (n,) effort limits of the actuators, in the plant's order [N m, N].
        """
        super().__init__()
        self._faults, self._limits = tuple(faults), effort_limits
        self._requested = self.DeclareVectorInputPort("actuation", len(effort_limits))
        self.DeclareVectorOutputPort(
            "actuation",
            len(effort_limits),
            self._calc,
            {self.time_ticket(), self._requested.ticket()},
        )

    def _calc(self, context: Context, output: BasicVector) -> None:
        """Outputs the limited efforts."""
        scales = [fault.scale for fault in self._faults if is_active(fault, context)]
        limit = min(scales, default=np.inf) * self._limits
        output.SetFromVector(np.clip(self._requested.Eval(context), -limit, limit))
