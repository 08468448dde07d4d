"""Systems that simulate two faults of a scenario: actuators with reduced torque (`WeakActuators`),
and external pushes of the robot (`ExternalPush`).

A scenario defines faults as follows:

    faults: [!CameraDropout {start: 1.0, duration: 0.5}, !TorqueSaturation {start: 2.0}]

A fault is active for start <= t < start + duration. `DelayedCamera` simulates the fault
`CameraDropout`.
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
"""Tolerance for rounding errors of the simulated time, when the time is compared with the start and
end of a fault [s]."""


def is_active(fault: CameraDropout | Push | TorqueSaturation, context: Context) -> bool:
    """Checks whether a fault is active at the simulated time of a Context."""
    return 0.0 <= context.get_time() + _TIME_TOLERANCE - fault.start < fault.duration


class ExternalPush(LeafSystem):
    """System that simulates external pushes of the robot: it outputs a wrench on a link for each
    push.

    .. pydrake_system::

      name: ExternalPush
      input_ports:
      output_ports:
      - spatial_forces

    - spatial_forces: abstract list of one `ExternallyAppliedSpatialForce` per push, with torque
      [N m] and force [N] in the world frame. The wrench acts at the origin of the link's frame, and
      is zero before and after the push. The port is connected to the input port
      `applied_spatial_force` of a `MultibodyPlant`.
    """

    def __init__(self, pushes: Sequence[tuple[Push, BodyIndex]]) -> None:
        """Declares the output port `spatial_forces`.

        Args:
            pushes: push faults, each with the index of the body on which it acts.
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
        """Sets the output port `spatial_forces` to one wrench per push, which is zero while the
        push is not active.
        """
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
    """System that clips the actuation of a plant to reduced effort limits while a fault is active.

    .. pydrake_system::

      name: WeakActuators
      input_ports:
      - actuation
      output_ports:
      - actuation

    - actuation (in): (n,) efforts commanded by the controller [N m, N].
    - actuation (out): (n,) efforts of the actuators [N m, N]. While a `TorqueSaturation` is active,
      the commanded efforts are clipped to `scale` times the effort limits. Otherwise the output is
      equal to the commanded efforts.
    """

    def __init__(self, faults: Sequence[TorqueSaturation], effort_limits: FloatArray) -> None:
        """Declares the input and output ports `actuation`.

        Args:
            faults: faults, each with its times and the fraction `scale` of the effort limits that
                remains.
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
        """Sets the output port `actuation` to the commanded efforts, clipped to the effort limits
        that active faults reduce.
        """
        scales = [fault.scale for fault in self._faults if is_active(fault, context)]
        limit = min(scales, default=np.inf) * self._limits
        output.SetFromVector(np.clip(self._requested.Eval(context), -limit, limit))
