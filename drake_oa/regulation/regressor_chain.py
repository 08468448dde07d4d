"""The regulation layer: coupling parameters from the obstacles' descriptors, by two networks."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Protocol

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem

from drake_oa.common.messages import (
    CHAIN,
    ROW_COLUMNS,
    CouplingParameters,
    EllipsoidSet,
    PolicyState,
)
from drake_oa.common.ports import read_value
from drake_oa.policy.dmp import Dmp
from drake_oa.policy.rollout import Scene, scene_under_way
from drake_oa.regulation.regressor import ChainWeights, section_extents


class Proposals(Protocol):
    """Source of candidate sides, for example `ProposalNetwork`."""

    def rows(self, scene: Scene, duration: float) -> CouplingParameters:
        """Returns a row a side, see `CouplingParameters`; T [s]."""


class RegressorChain(LeafSystem):
    """Computation of coupling parameters by the paper's chain and by the proposal network.

    .. pydrake_system::

      name: RegressorChain
      input_ports:
      - ellipsoids_W
      - policy_state
      - goal (optional)
      output_ports:
      - coupling_parameters

    - ellipsoids_W: abstract `EllipsoidSet`, M dilated obstacles; may be empty.
    - policy_state: abstract `PolicyState` of the movement primitive. The P-plane through it
      cuts the obstacles: lambda'.
    - goal (optional): (3,) goal of the motion in the world frame [m]; without it that of the
      policy state.
    - coupling_parameters: abstract `CouplingParameters`. First M rows of the kind `CHAIN`: alpha,
      psi, kappa about the obstacles' centres, and whether the query lay in the range that the
      chain was trained for; they act together. Then 16 rows of the kind `SIDE`: one candidate
      motion a side of the baseline, with its expected length and the probability that it achieves
      the clearance; at most one acts. A network that is None has no rows.

    There is no state. The output is computed when it is asked for, once for each
    change of the inputs. While start and goal coincide (no motion has been set yet)
    alpha is 0 and no row is in range.
    """

    def __init__(
        self,
        weights: ChainWeights | None,
        asked_clearance: float,
        *,
        proposals: Proposals | None = None,
        dmp: Dmp | None = None,
    ) -> None:
        """Declares the ports.

        Args:
            weights: the trained chain, see `drake_oa.regulation.regressor.load_chain`; None: no
                rows of the chain.
            asked_clearance: asked distance Delta between tool and obstacle [m].
            proposals: the network or another source of candidate sides; None: no rows of sides.
            dmp: the movement primitive, for the proposals.
        Raises:
            ValueError: if the clearance is not finite and positive, or proposals are without a
                primitive.
        """
        super().__init__()
        if not 0.0 < asked_clearance < np.inf:
            raise ValueError(
                f"asked_clearance must be finite and positive [m], not {asked_clearance}"
            )
        if proposals is not None and dmp is None:
            raise ValueError("proposals need the movement primitive: dmp")
        self._weights, self._proposals, self._dmp = weights, proposals, dmp
        self._asked_clearance = float(asked_clearance)
        self._ellipsoids = self.DeclareAbstractInputPort("ellipsoids_W", Value(EllipsoidSet()))
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._goal = self.DeclareVectorInputPort("goal", 3)
        self.DeclareAbstractOutputPort(
            "coupling_parameters",
            lambda: Value(CouplingParameters()),
            self._calc_parameters,
            # Not the goal: a constant source counts as new at every instant.
            prerequisites_of_calc={self._ellipsoids.ticket(), self._policy.ticket()},
        )

    def _calc_parameters(self, context: Context, output: AbstractValue) -> None:
        ellipsoids = read_value(self, self._ellipsoids, context, EllipsoidSet)
        policy = read_value(self, self._policy, context, PolicyState)
        found = self._chain_rows(policy, ellipsoids)
        if self._proposals is not None and self._dmp is not None and policy.baseline > 0.0:
            has_goal = self._goal.HasValue(context)
            p_WG = np.array(self._goal.Eval(context)) if has_goal else policy.p_WG
            scene = scene_under_way(
                policy,
                p_WG,
                ellipsoids,
                clearance=self._asked_clearance,
                alpha_k=self._dmp.alpha_k,
            )
            if scene.baseline > 0.0:
                sides = self._proposals.rows(scene, self._dmp.duration)
                found = joined_rows(found, ellipsoids, sides)
        output.set_value(found)

    def _chain_rows(self, policy: PolicyState, ellipsoids: EllipsoidSet) -> CouplingParameters:
        """Returns a row an obstacle by the paper's chain, or none."""
        if self._weights is None:
            return CouplingParameters()
        if policy.baseline == 0.0:
            zeros = np.zeros(len(ellipsoids))
            return CouplingParameters(zeros, zeros + 1.0, zeros, zeros > 0.0)
        extents = section_extents(policy.p_WE, policy.z_W, policy.R_WL, ellipsoids)
        return self._weights.parameters(extents, self._asked_clearance, policy.baseline)


def joined_rows(
    chain: CouplingParameters, ellipsoids: EllipsoidSet, sides: CouplingParameters
) -> CouplingParameters:
    """Returns rows of the chain (M or none), about the centres of M obstacles, and of N sides."""
    count = len(chain)
    unknown = np.full(count, np.nan)
    own: dict[str, Any] = {
        "center_W": ellipsoids.p_WO[:count],
        "normal_W": np.zeros((count, 3)),
        "kind": np.full(count, CHAIN),
        "length": unknown,
        "likely": unknown,
        "scaling": np.ones(count),
    }
    chain = replace(chain, **own)
    rows: dict[str, Any] = {
        name: np.concatenate([getattr(chain, name), getattr(sides, name)]) for name in ROW_COLUMNS
    }
    return replace(chain, **rows)
