"""Verified regulation: coupling parameters and a side to pass that roll-outs have checked.

The regressor chain proposes; every candidate is rolled out from the present state against
all obstacles with their velocities, the table and the workspace. The shortest motion that
keeps the feasible clearance and arrives is taken; where none does, the one that keeps most.

A candidate is one avoidance term (eq. oa_complete) that acts about a point on or beside the
baseline in the plane of the baseline and a side omega. Its genes, in which the search moves::

    angle of omega in the local YZ plane, place of the point along the baseline / L and
    aside of it toward omega / L (at most 0), ln kappa L^2, ln psi, ln alpha, ln tau

A round rolls out as many candidates a scene as `SearchParameters.candidates`: the chain's
proposals first, then variations of the best so far (`drake_oa.regulation.search`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import Dmp
from drake_oa.regulation.regressor import ChainWeights
from drake_oa.regulation.rollout import SpatialScenes
from drake_oa.regulation.search import (
    ALPHA,
    ANGLE,
    ASIDE,
    KAPPA,
    N_GENES,
    PLACE,
    PSI,
    TAU,
    Search,
    SearchParameters,
    Verified,
    avoidance_terms,
)

__all__ = [
    "ALPHA",
    "ANGLE",
    "ASIDE",
    "KAPPA",
    "N_GENES",
    "PLACE",
    "PSI",
    "TAU",
    "SearchParameters",
    "Verified",
    "avoidance_terms",
    "verify",
]

_SIDES = 8
"""Into how many sides a search of every side is divided."""


def verify(
    scenes: SpatialScenes,
    weights: ChainWeights,
    *,
    duration: float,
    dmp: Dmp | None = None,
    previous: FloatArray | None = None,
    settled: bool = False,
    parameters: SearchParameters | None = None,
) -> Verified:
    """Chooses the motion of each scene, see the module.

    Args:
        scenes: S scenes.
        weights: the chain that proposes, of four inputs.
        duration: T [s].
        dmp: the primitive; None: a straight minimum-jerk motion.
        previous: (S, 7) genes in use, rows of NaN for none. They are tried first, and
            another side has to be shorter by some hysteresis.
        settled: whether a motion in use that will do is kept without a look at others;
            the unmodulated motion is looked at nevertheless.
        parameters: how far the search goes; None: the defaults.

    Returns:
        The choice.

    Raises:
        ValueError: for wrong shapes, or a duration that is not positive.
    """
    if not 0.0 < duration < math.inf:
        raise ValueError(f"duration must be positive and finite [s], not {duration}")
    if previous is not None and previous.shape != (len(scenes), N_GENES):
        raise ValueError(f"previous must be ({len(scenes)}, {N_GENES}), not {previous.shape}")
    previous = np.full((len(scenes), N_GENES), np.nan) if previous is None else previous
    parameters = parameters or SearchParameters()
    found = Search(scenes, duration, dmp, previous, parameters, settled=settled).run(weights)
    finer = replace(parameters, candidates=2 * parameters.candidates, steps=2 * parameters.steps)
    for number in range(parameters.retries):
        left = np.flatnonzero(~found.kept)
        if not len(left):
            break
        sides = 1 if number == 0 else _SIDES
        each = np.repeat(left, sides)
        search = Search(scenes.rows(each), duration, dmp, previous[each], finer, sides)
        again = search.run(weights)
        best = again.cost.reshape(-1, sides).argmin(axis=1) + sides * np.arange(len(left))
        better = again.cost[best] < found.cost[left]
        found = found.replaced(left[better], again.rows(best[better]))
    return found
