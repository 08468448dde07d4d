"""The regulation layer: coupling parameters from the obstacles' shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, PolicyState, Route
from drake_oa.common.ports import read_value
from drake_oa.regulation.regressor import ChainWeights, section_extents


class RegressorChain(LeafSystem):
    """Regulates the coupling terms: a chain of three networks, one row an obstacle.

    .. pydrake_system::

      name: RegressorChain
      input_ports:
      - ellipsoids_W
      - policy_state (optional)
      - route (optional)
      output_ports:
      - coupling_parameters

    - ellipsoids_W: abstract `EllipsoidSet`, M dilated obstacles; may be empty.
    - policy_state (optional): abstract `PolicyState` of the movement primitive; needed
      without a route. Then lambda' is the section of the P-plane, as in the paper, and
      the terms act about the obstacle's centre.
    - route (optional): abstract `Route`, M rows: `CostRingSelector`'s decision. With it
      lambda' is the obstacle as the chosen route meets it, each with the clearance that
      it needs, and the terms act about a point on the baseline.
    - coupling_parameters: abstract `CouplingParameters`, M rows of alpha, psi, kappa, and
      whether the query lay in the range that the chain was trained for.

    There is no state. The output is computed when it is asked for, once for each
    change of the inputs. While start and goal coincide (no motion has been set yet)
    alpha is 0 and no row is in range.
    """

    def __init__(self, weights: ChainWeights, asked_clearance: float) -> None:
        """Declares the ports.

        Args:
            weights: the trained chain, see `drake_oa.regulation.regressor.load_chain`.
            asked_clearance: asked distance Delta between tool and obstacle [m].

        Raises:
            TypeError: if weights are no `ChainWeights`.
            ValueError: if the clearance is not finite and positive.
        """
        super().__init__()
        if not isinstance(weights, ChainWeights):
            raise TypeError(
                f"weights must be ChainWeights (see load_chain), not {type(weights).__name__}"
            )
        if not 0.0 < asked_clearance < np.inf:
            raise ValueError(
                f"asked_clearance must be finite and positive [m], not {asked_clearance}"
            )
        self._weights = weights
        self._asked_clearance = float(asked_clearance)
        self._ellipsoids = self.DeclareAbstractInputPort("ellipsoids_W", Value(EllipsoidSet()))
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self._route = self.DeclareAbstractInputPort("route", Value(Route()))
        self.DeclareAbstractOutputPort(
            "coupling_parameters",
            lambda: Value(CouplingParameters()),
            self._calc_parameters,
            prerequisites_of_calc={
                self._ellipsoids.ticket(),
                self._policy.ticket(),
                self._route.ticket(),
            },
        )

    def _calc_parameters(self, context: Context, output: AbstractValue) -> None:
        ellipsoids = read_value(self, self._ellipsoids, context, EllipsoidSet)
        if self._route.HasValue(context):
            route = read_value(self, self._route, context, Route)
            output.set_value(self._as_route_meets(route, len(ellipsoids)))
        else:
            policy = read_value(self, self._policy, context, PolicyState)
            output.set_value(self._as_plane_cuts(policy, ellipsoids))

    def _as_route_meets(self, route: Route, count: int) -> CouplingParameters:
        if len(route.extents) != count:
            raise ValueError(
                f"RegressorChain: route has {len(route.extents)} rows; there are {count} ellipsoids"
            )
        if route.baseline == 0.0:
            return _no_coupling(count)
        place = (route.center_W - route.p_WS) @ route.R_WL[:, 0]
        found = self._weights.parameters(
            route.extents, route.remaining_clearance, route.baseline, place
        )
        return replace(found, alpha=found.alpha * route.weight, center_W=route.center_W)

    def _as_plane_cuts(self, policy: PolicyState, ellipsoids: EllipsoidSet) -> CouplingParameters:
        baseline = policy.baseline
        if baseline == 0.0:
            return _no_coupling(len(ellipsoids))
        extents = section_extents(
            policy.p_WE,
            policy.z_W,
            policy.R_WL,
            ellipsoids.p_WO,
            ellipsoids.R_WO,
            ellipsoids.semi_axes,
        )
        place = (ellipsoids.p_WO - policy.p_WS) @ policy.R_WL[:, 0]
        return self._weights.parameters(extents, self._asked_clearance, baseline, place)


def _no_coupling(count: int) -> CouplingParameters:
    zeros = np.zeros(count)
    return CouplingParameters(zeros, np.ones(count), zeros, np.zeros(count, dtype=bool))
