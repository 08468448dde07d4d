"""System of the inference layer that computes coupling parameters by the regressor chain."""

from __future__ import annotations

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, PolicyState
from drake_oa.common.ports import AbstractInput, positive
from drake_oa.inference.regressor import ChainWeights, section_extents


class RegressorChain(LeafSystem):
    """Evaluator of a regressor chain, three networks that map ellipsoids to coupling parameters.

    .. pydrake_system::

      name: RegressorChain
      input_ports:
      - ellipsoids_W
      - policy_state
      output_ports:
      - coupling_parameters

    - ellipsoids_W: abstract `EllipsoidSet`, M obstacles dilated by the tool; may be empty.
    - policy_state: abstract `PolicyState` of the movement primitive, from which position and
      velocity of the tool point are read. They and the center of an obstacle define a plane. The
      input of the chain consists of the half-extents of the obstacle's section by this plane and,
      if the chain has three inputs, the requested clearance, all divided by the distance from start
      to goal.
    - coupling_parameters: abstract `CouplingParameters` with M rows: strength alpha [1/T, with the
      demonstrated duration T], angular width psi [rad] and decay kappa [1/m^2] of coupling terms
      (turning rates away from the centers of the obstacles), and whether the input of the chain was
      in the trained range.

    The networks are those of Pairet et al., RA-L 2019 (`drake_oa.inference.regressor`). The system
    has no state. The output is cached until an input or the time changes. While start and goal
    coincide, as before the first motion, alpha is 0 (no coupling) and no row is in the trained
    range.
    """

    def __init__(self, weights: ChainWeights, requested_clearance: float) -> None:
        """Declares the ports.

        Args:
            weights: trained chain, as read by `drake_oa.inference.regressor.load_chain`.
            requested_clearance: requested clearance Delta between tool and obstacles [m].

        Raises:
            ValueError: if the requested clearance is not finite and positive.
        """
        super().__init__()
        self._weights = weights
        self._requested_clearance = positive(requested_clearance, "requested_clearance [m]")
        self._ellipsoids = AbstractInput(self, "ellipsoids_W", EllipsoidSet)
        self._policy = AbstractInput(self, "policy_state", PolicyState)
        self.DeclareAbstractOutputPort(
            "coupling_parameters", lambda: Value(CouplingParameters()), self._calc_parameters
        )

    def _calc_parameters(self, context: Context, output: AbstractValue) -> None:
        ellipsoids = self._ellipsoids.read(context)
        policy = self._policy.read(context)
        if policy.baseline == 0.0:
            zeros = np.zeros(len(ellipsoids))
            output.set_value(CouplingParameters(zeros, zeros + 1.0, zeros, zeros > 0.0))
            return
        extents = section_extents(policy.p_WE, policy.z_W, policy.R_WL, ellipsoids)
        clearance = self._requested_clearance
        output.set_value(self._weights.parameters(extents, clearance, policy.baseline))
