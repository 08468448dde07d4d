"""What pushes the robot from outside."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context, LeafSystem

from drake_oa.scenario.faults import Push
from drake_oa.world.faults import push_wrench


class ExternalPush(LeafSystem):
    """Applies the wrenches of pushes to bodies of a plant.

    .. pydrake_system::

      name: ExternalPush
      input_ports:
      output_ports:
      - spatial_forces

    - spatial_forces: abstract list of `ExternallyAppliedSpatialForce`, one a push, at the
      origin of its body, in the world frame [N, N m]; zero before and after it. For the port
      `applied_spatial_force` of a `MultibodyPlant`.
    """

    def __init__(self, pushes: Sequence[tuple[Push, BodyIndex]]) -> None:
        """Declares the port.

        Args:
            pushes: each with the body that it acts on.

        Raises:
            ValueError: if there is none.
        """
        super().__init__()
        if not pushes:
            raise ValueError("pushes is empty; there must be at least one")
        self._pushes = tuple(pushes)
        self.DeclareAbstractOutputPort(
            "spatial_forces",
            lambda: AbstractValue.Make([ExternallyAppliedSpatialForce()]),
            self._calc,
            {self.time_ticket()},
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        forces = []
        for push, body in self._pushes:
            wrench = push_wrench(push, context.get_time())
            applied = ExternallyAppliedSpatialForce()
            applied.body_index = body
            applied.p_BoBq_B = np.zeros(3)
            applied.F_Bq_W = SpatialForce(tau=wrench[:3], f=wrench[3:])
            forces.append(applied)
        output.set_value(forces)
