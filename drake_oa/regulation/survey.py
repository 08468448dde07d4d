"""Motions all round a scene: what else the tool may do where the cheapest motion will not.

`drake_oa.regulation.verification.verify` finds the shortest motion of the tool. Where the arm that
holds it cannot follow, longer ones are wanted that differ: on every side, with detours of
every size. They are drawn from all over the ranges of the genes, the same ones in every
scene, rolled out with coarse steps, and of each side and size of detour the cheapest is
verified as any other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.dmp import Dmp
from drake_oa.regulation.rollout import SpatialScenes
from drake_oa.regulation.search import (
    ALPHA,
    GENE_RANGE,
    N_GENES,
    OUTCOME,
    Search,
    SearchParameters,
    Verified,
)

_SIDES = 8
_SPREAD = 512
"""Candidates a side."""
_COARSE = 250
"""Steps a unit of normalised time that they are rolled out with."""
_GENTLE = 8.0
"""Largest ln alpha that is drawn: a stronger term holds the motion back before it lets it go."""
_DETOURS = np.array([1.05, 1.15, 1.3, 1.6])
"""Lengths over the distance that is left, between which detours are of one size."""
_LATER = 0.5
"""Cost of a unit of normalised time after s = 1: among the cheapest of all sides and sizes of
detour there are some that creep."""
_SHARE = 0.8
"""Share that is to be kept of what start and goal have, where that is less."""
_MISSED = 0.1
"""A motion arrives when it ends this near to the goal, in baselines."""


def assessed(
    scene: SpatialScenes,
    genes: FloatArray,
    *,
    duration: float,
    dmp: Dmp | None = None,
    previous: FloatArray | None = None,
    parameters: SearchParameters | None = None,
) -> Verified:
    """What given candidates come to in one scene.

    Args:
        scene: a single one.
        genes: (n, 7) of the candidates.
        duration: T [s].
        dmp: the primitive; None: a straight minimum-jerk motion.
        previous: (7,) genes in use, for the price of another side; None: none are.
        parameters: the roll-outs' steps and tolerances; None: the defaults.

    Returns:
        n rows.

    Raises:
        ValueError: for more than one scene.
    """
    count = len(genes)
    search = _search(scene, count, duration, dmp, previous, parameters or SearchParameters())
    ranked = search.evaluate(np.arange(count), genes[:, None])
    return search.answer(ranked, np.ones(count, dtype=bool))


def survey(
    scene: SpatialScenes,
    *,
    duration: float,
    clearance: float,
    dmp: Dmp | None = None,
    previous: FloatArray | None = None,
    parameters: SearchParameters | None = None,
) -> Verified:
    """The cheapest motion of every side and size of detour.

    Args:
        scene: a single one.
        duration: T [s].
        clearance: what a motion has to keep of every obstacle, be it less than the feasible
            clearance; where it is, or its goal, nearer to one as it is now, most of that [m].
        dmp, previous, parameters: as of `assessed`.

    Returns:
        A row each, the cheapest first; none where no motion keeps that and arrives.

    Raises:
        ValueError: for more than one scene.
    """
    parameters = parameters or SearchParameters()
    coarse = replace(parameters, steps=min(_COARSE, parameters.steps))
    search = _search(scene, _SIDES, duration, dmp, previous, coarse, sides=_SIDES)
    sides = np.arange(_SIDES)
    fresh = search.spread(sides, _SPREAD)
    fresh[:, :, ALPHA] = np.interp(
        fresh[:, :, ALPHA], GENE_RANGE[ALPHA], [GENE_RANGE[ALPHA, 0], _GENTLE]
    )
    ranked = search.evaluate(sides, fresh)
    outcome = dict(zip(OUTCOME, np.moveaxis(ranked.outcome, 2, 0), strict=True))
    L = float(scene.baseline[0])
    least = min(clearance, _SHARE * _ends_clearance(scene))
    will_do = (outcome["clearance"] > max(least, 0.0)) & (outcome["goal_error"] < _MISSED * L)
    will_do &= outcome["world_margin"] >= 0.0
    left = float(np.linalg.norm(scene.p_WG[0] - scene.p_WE[0]))
    size = np.searchsorted(_DETOURS, outcome["path_length"] / max(left, 1e-6))
    end = scene.s + outcome["steps"] / search.parameters.steps
    price = _price(ranked.cost, end, scene.s)
    chosen = []
    for side in sides:
        for detour in range(len(_DETOURS) + 1):
            cost = np.where(will_do[side] & (size[side] == detour), price[side], np.inf)
            if np.isfinite(cost.min()):
                chosen.append(ranked.genes[side, cost.argmin()])
    found = assessed(
        scene,
        np.array(chosen).reshape(-1, N_GENES),
        duration=duration,
        dmp=dmp,
        previous=previous,
        parameters=parameters,
    )
    return found.rows(np.argsort(_price(found.cost, found.end, scene.s), kind="stable"))


def _price(cost: FloatArray, end: FloatArray, s: float) -> FloatArray:
    """The cost, and what arriving late adds to it."""
    return np.asarray(cost + _LATER * np.maximum(end - max(s, 1.0), 0.0))


def _ends_clearance(scene: SpatialScenes) -> float:
    """Least distance of where it is, and of the goal, to any obstacle as it is now [m]."""
    ends = np.concatenate([scene.p_WE, scene.p_WG])
    among = scene.p_WO[0], scene.R_WO[0], scene.semi_axes[0]
    return float(np.nanmin(signed_distance(ends[:, None], *among), initial=np.inf))


def _search(
    scene: SpatialScenes,
    count: int,
    duration: float,
    dmp: Dmp | None,
    previous: FloatArray | None,
    parameters: SearchParameters,
    sides: int = 1,
) -> Search:
    """A search in so many copies of one scene."""
    if len(scene) != 1:
        raise ValueError(f"scene must be a single one, not {len(scene)}")
    in_use = np.full(N_GENES, np.nan) if previous is None else previous
    copies = scene.rows(np.zeros(count, dtype=np.int64))
    return Search(copies, duration, dmp, np.tile(in_use, (count, 1)), parameters, sides)
