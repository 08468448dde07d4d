"""The regulation layer as the paper has it: coupling parameters from the obstacles' sections."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem

from drake_oa.common.messages import CouplingParameters, EllipsoidSet, PolicyState
from drake_oa.common.ports import read_value
from drake_oa.regulation.regressor import ChainWeights, section_extents

GAMMA, BETA = 1000.0, 20.0 / math.pi
"""Hoffmann's published gains [1/s] and [1/rad]."""

Scaling = Literal["route", "sections", "none"]


class RegressorChain(LeafSystem):
    """Regulates the coupling terms: a chain of three networks, one row an obstacle.

    .. pydrake_system::

      name: RegressorChain
      input_ports:
      - ellipsoids_W
      - policy_state
      output_ports:
      - coupling_parameters

    - ellipsoids_W: abstract `EllipsoidSet`, M dilated obstacles; may be empty.
    - policy_state: abstract `PolicyState` of the movement primitive. The P-plane through it
      cuts the obstacles: lambda'.
    - coupling_parameters: abstract `CouplingParameters`, M rows of alpha, psi, kappa about the
      obstacles' centres, and whether the query lay in the range that the chain was trained for.

    There is no state. The output is computed when it is asked for, once for each
    change of the inputs. While start and goal coincide (no motion has been set yet)
    alpha is 0 and no row is in range.
    """

    def __init__(
        self,
        weights: ChainWeights,
        asked_clearance: float,
        *,
        original: float | None = None,
        scaling: Scaling = "route",
    ) -> None:
        """Declares the ports.

        Args:
            weights: the trained chain, see `drake_oa.regulation.regressor.load_chain`.
            asked_clearance: asked distance Delta between tool and obstacle [m].
            original: the original term at its published gains in place of the chain's, for a
                demonstrated duration of so long [s]; None: the dead-zone free one.
            scaling: what tau comes from: "route", the length of the chosen route; "sections", the
                way through the extreme points of the obstacles' sections (sec. IV-E); "none": 1.

        Raises:
            TypeError: if weights are no `ChainWeights`.
            ValueError: if clearance or duration are not finite and positive, or the scaling is
                unknown.
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
        if original is not None and not 0.0 < original < np.inf:
            raise ValueError(f"original must be finite and positive [s], not {original}")
        if scaling not in get_args(Scaling):
            raise ValueError(
                f"scaling '{scaling}'; it must be one of {', '.join(get_args(Scaling))}"
            )
        self._weights = weights
        self._asked_clearance = float(asked_clearance)
        self._original = original
        self._scaling = scaling
        self._ellipsoids = self.DeclareAbstractInputPort("ellipsoids_W", Value(EllipsoidSet()))
        self._policy = self.DeclareAbstractInputPort("policy_state", Value(PolicyState()))
        self.DeclareAbstractOutputPort(
            "coupling_parameters",
            lambda: Value(CouplingParameters()),
            self._calc_parameters,
            prerequisites_of_calc={self._ellipsoids.ticket(), self._policy.ticket()},
        )

    def _calc_parameters(self, context: Context, output: AbstractValue) -> None:
        ellipsoids = read_value(self, self._ellipsoids, context, EllipsoidSet)
        policy = read_value(self, self._policy, context, PolicyState)
        output.set_value(self._parameters(policy, ellipsoids))

    def _parameters(self, policy: PolicyState, ellipsoids: EllipsoidSet) -> CouplingParameters:
        count, baseline = len(ellipsoids), policy.baseline
        if baseline == 0.0:
            zeros = np.zeros(count)
            return CouplingParameters(zeros, np.ones(count), zeros, np.zeros(count, dtype=bool))
        if self._original is not None:
            found = CouplingParameters(
                np.full(count, GAMMA * self._original),
                np.full(count, 1.0 / BETA),
                np.zeros(count),
                np.ones(count, dtype=bool),
                original=True,
            )
        else:
            extents = section_extents(policy.p_WE, policy.z_W, policy.R_WL, ellipsoids)
            found = self._weights.parameters(extents, self._asked_clearance, baseline)
        if self._scaling == "route":
            return found
        tau = 1.0
        if self._scaling == "sections":
            tau = max(1.0, way_past(policy, ellipsoids, self._asked_clearance) / baseline)
        return replace(found, tau=tau)


def way_past(policy: PolicyState, ellipsoids: EllipsoidSet, asked_clearance: float) -> float:
    """length(pi-hat) of section IV-E: start, extreme points of the sections, goal [m].

    The sections are those of the P-planes in which the motion sets out along its baseline. Their
    extreme points are those toward the baseline; of an obstacle that leaves it the clearance
    there is none.

    Args:
        policy: start, goal and local frame of the motion.
        ellipsoids: the M obstacles.
        asked_clearance: asked clearance Delta [m].
    """
    R_WL, p_SO = policy.R_WL, ellipsoids.p_WO - policy.p_WS
    x = R_WL[:, 0]
    extents = section_extents(policy.p_WS, x, R_WL, ellipsoids)
    along = p_SO @ x
    aside = p_SO - along[:, None] * x
    offset = np.linalg.norm(aside, axis=1)
    # Over what is straight ahead.
    up = np.broadcast_to(-R_WL[:, 2], aside.shape)
    ahead = offset <= 1e-9 * policy.baseline
    outward = np.where(ahead[:, None], up, aside / np.where(ahead, 1.0, offset)[:, None])
    rows = np.flatnonzero(
        (offset - extents[:, 1] < asked_clearance) & (along > 0.0) & (along < policy.baseline)
    )
    rows = rows[np.argsort(along[rows], kind="stable")]
    extreme = ellipsoids.p_WO[rows] - extents[rows, 1:] * outward[rows]
    way = np.concatenate([policy.p_WS[None], extreme, policy.p_WG[None]])
    return float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum())
