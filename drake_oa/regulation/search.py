"""Verified regulation: coupling parameters and a side to pass that roll-outs have checked.

A network proposes (`drake_oa.regulation.proposal_network`); every candidate is rolled out from
the present state against all obstacles with their velocities, the table and the workspace. The
shortest motion that keeps the feasible clearance and arrives is taken; where none does, the one
that keeps most. A round rolls out as many candidates a scene as `SearchParameters.candidates`: the
proposals first, then variations of the best so far, a plain evolution strategy. Its
random numbers are the same for every scene and call, so a scene gets the same choice whatever
else is asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray
from drake_oa.policy.dmp import Dmp
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.proposals import (
    ALPHA,
    ANGLE,
    ELITES,
    LOWER,
    N_GENES,
    NO_PRICE,
    STRIDE,
    TAU,
    UPPER,
    Proposer,
    avoidance_terms,
    closer,
    draws,
    strengths,
)
from drake_oa.regulation.rollout import SpatialRollouts, SpatialScenes, spatial_rollouts

_FIRST_FRESH = 6
"""Round from which they are."""

_LINES = ((0.2, 5), (0.1, 1))
"""Of the best and the second best of a round: share of the candidates, and least number of them,
that differ from it in alpha only."""
BAD = 10.0
"""Added to the cost of a motion that does not keep the clearance or does not arrive."""
PRICE = 100.0
"""Cost of what is short of the clearance or the world's margin, a baseline's length."""
GOAL_PRICE = 30.0
MISS, TOUCH = 2.0, 50.0
"""Cost of not arriving, and of touching an obstacle."""
_HORIZON = 2.0
"""Normalised time by which a motion arrives, from s = 0, or one more than the present one."""
LATE = 0.05
"""Cost of a unit of normalised time after s = 1."""
HURRY = 0.02
"""Cost of |ln tau| = 1 among moving obstacles."""
FLIP = 0.06
"""Cost of the opposite of the side in use: hysteresis."""
_BRIEF = 1
"""Rounds after the first motion that will do, where one is in use."""
_MUCH = 0.02
"""By how much another motion has to cost less than one in use that will do."""


@dataclass(frozen=True, eq=False)
class SearchResult(Frozen):
    """What was chosen in S scenes.

    Attributes:
        genes: (S, 7) of the chosen candidates; ln alpha is -inf where the unmodulated
            motion was chosen.
        terms: (S, 13) their avoidance terms, rows as `spatial_rollouts` takes them.
        tau: (S,) temporal scaling: path length over the baseline, at least 1; among
            moving obstacles the one that was verified.
        kept_clearance: (S,) least distance to any obstacle on the way [m].
        shortfall: (S,) what is missing of the feasible clearance [m]; 0 where it is kept.
        kept: (S,) whether it is kept and the goal reached.
        path_length: (S,) [m].
        in_range: (S,) whether the proposer was asked for what it was trained for.
    """

    genes: FloatArray
    terms: FloatArray
    tau: FloatArray
    kept_clearance: FloatArray
    shortfall: FloatArray
    kept: BoolArray
    path_length: FloatArray
    in_range: BoolArray


def roll_out(
    scenes: SpatialScenes,
    scene: IntArray,
    terms: FloatArray,
    parameters: SearchParameters,
    *,
    seconds: ArrayLike,
    dmp: Dmp | None = None,
    longest: ArrayLike = math.inf,
    shortest: ArrayLike = math.inf,
    keep_path: bool = False,
) -> SpatialRollouts:
    """Motions until they arrive, as they are verified; arguments as of `spatial_rollouts`."""
    return spatial_rollouts(
        scenes,
        scene,
        terms,
        seconds=seconds,
        dmp=dmp,
        steps=parameters.steps,
        end=max(1.0, scenes.s),
        horizon=max(_HORIZON, scenes.s + 1.0),
        fade=parameters.fade,
        tolerance=parameters.tolerance,
        longest=longest,
        shortest=shortest,
        keep_path=keep_path,
    )


@dataclass(frozen=True, eq=False)
class Ranked:
    """The best candidates of A scenes, best first."""

    genes: FloatArray  # (A, n, 7)
    cost: FloatArray  # (A, n)
    outcome: FloatArray  # (A, n, len(OUTCOME))

    @property
    def solved(self) -> BoolArray:
        return np.asarray(self.cost[:, 0] < BAD)

    def best(self, count: int) -> Ranked:
        order = np.argsort(self.cost, axis=1, kind="stable")[:, :count]
        return Ranked(
            np.take_along_axis(self.genes, order[:, :, None], axis=1),
            np.take_along_axis(self.cost, order, axis=1),
            np.take_along_axis(self.outcome, order[:, :, None], axis=1),
        )

    def rows(self, mask: BoolArray) -> Ranked:
        return Ranked(self.genes[mask], self.cost[mask], self.outcome[mask])

    def joined(self, other: Ranked) -> Ranked:
        return Ranked(
            np.concatenate([self.genes, other.genes], axis=1),
            np.concatenate([self.cost, other.cost], axis=1),
            np.concatenate([self.outcome, other.outcome], axis=1),
        )


OUTCOME = ("margin", "kept_clearance", "goal_error", "path_length", "steps")
"""What is kept of a roll-out, see `SpatialRollouts`."""


class _Tolerances(NamedTuple):
    """What is short of the clearance and of the goal without a price [m]; s - 1, ds."""

    slack: float
    tolerance: float
    s: float
    step: float


@compiled
def _costs(
    scene: IntArray,
    baseline: FloatArray,
    genes: FloatArray,
    outcome: FloatArray,
    moving: BoolArray,
    previous: FloatArray,
    allowed: _Tolerances,
    out: FloatArray,
) -> None:
    """Writes the costs of N candidates, see `Search.cost`; outcome: the columns of `OUTCOME`."""
    for row in range(len(scene)):
        k, L = scene[row], baseline[scene[row]]
        margin, kept, goal_error, length, steps = outcome[row]
        short = max(-margin - allowed.slack, 0.0)
        missed = max(min(goal_error, L) - allowed.tolerance, 0.0)
        bad = (PRICE * short + GOAL_PRICE * missed) / L
        if missed > 0.0:
            bad += MISS
        if short > 0.0 and kept <= 0.0:
            bad += TOUCH
        cost = length / L + LATE * max(steps * allowed.step + allowed.s, 0.0)
        if moving[k]:
            cost += HURRY * abs(genes[row, TAU])
        # 0 for the side in use, 1 for its opposite; no side is in use before the first choice.
        flip = 0.5 - 0.5 * math.cos(genes[row, ANGLE] - previous[k, ANGLE])
        if not math.isnan(flip):
            cost += FLIP * flip
        out[row] = cost + (BAD + bad if bad > 0.0 else 0.0)


class Search:
    """One search, of the motions of all scenes at once; see `verify`."""

    def __init__(
        self,
        scenes: SpatialScenes,
        duration: float,
        dmp: Dmp | None,
        previous: FloatArray,
        parameters: SearchParameters,
        *,
        settled: bool = False,
    ) -> None:
        self.settled = settled
        self.scenes, self.duration, self.dmp = scenes, duration, dmp
        self.parameters = parameters
        self.moving = (np.nan_to_num(scenes.v_WO) != 0.0).any(axis=(1, 2))
        self.previous = previous
        self.elites = np.zeros((len(scenes), 0, N_GENES))
        self.spacing = 1.0
        self.price = NO_PRICE

    def run(self, proposer: Proposer) -> SearchResult:
        """The unmodulated motion where it will do, else rounds of candidates."""
        count = len(self.scenes)
        # Nothing is shorter than the unmodulated motion.
        free = np.zeros((count, 1, N_GENES))
        free[:, :, ALPHA] = -np.inf
        chosen = self.evaluate(np.arange(count), free)
        proposed, in_range = self.proposals(proposer)
        active = self.keep_previous(chosen, np.flatnonzero(~chosen.solved), proposed)
        ranked = self.evaluate(active, proposed[active]).best(ELITES)
        since = np.zeros(len(active), dtype=int)
        # Where a motion is in use its genes are near the best already.
        polish = np.where(np.isfinite(self.previous).all(axis=1), _BRIEF, self.parameters.polish)
        polish = np.minimum(polish, self.parameters.polish)
        for number in range(self.parameters.rounds + 1):
            self.keep_best(chosen, active, ranked)
            self.elites = ranked.genes
            since += ranked.solved
            go_on = (since <= polish[active]) & ~self.hopeless(ranked, number)
            active, ranked, since = active[go_on], ranked.rows(go_on), since[go_on]
            if not len(active) or number == self.parameters.rounds:
                break
            trial = self.evaluate(active, self.children(active, ranked, number), ranked)
            ranked = ranked.joined(trial).best(ELITES)
        return self.answer(chosen, in_range)

    def hopeless(self, ranked: Ranked, number: int) -> BoolArray:
        """(A,) whether a search is given up after so many rounds; never, where nothing else is."""
        return np.zeros(len(ranked.cost), dtype=bool)

    def keep_previous(self, chosen: Ranked, active: IntArray, proposed: FloatArray) -> IntArray:
        """Stays with what is in use where it will do and no proposal is much better.

        Returns:
            The scenes that are left.
        """
        in_use = active[np.isfinite(self.previous[active]).all(axis=1)]
        if not len(in_use):
            return active
        same = self.evaluate(in_use, self.previous[in_use][:, None])
        in_use, same = in_use[same.solved], same.rows(same.solved)
        stays = np.full(len(in_use), self.settled)
        if not self.settled and len(in_use):
            other = self.evaluate(in_use, proposed[in_use], same).best(1)
            stays = same.cost[:, 0] <= other.cost[:, 0] + _MUCH
        self.keep_best(chosen, in_use[stays], same.rows(stays))
        return np.setdiff1d(active, in_use[stays])

    @staticmethod
    def keep_best(chosen: Ranked, active: IntArray, ranked: Ranked) -> None:
        better = ranked.cost[:, 0] < chosen.cost[active, 0]
        at = active[better]
        chosen.genes[at, 0] = ranked.genes[better, 0]
        chosen.cost[at, 0] = ranked.cost[better, 0]
        chosen.outcome[at, 0] = ranked.outcome[better, 0]

    def evaluate(self, active: IntArray, genes: FloatArray, known: Ranked | None = None) -> Ranked:
        """Rolls out candidates (A, n, 7); those that cannot be among the known ones in part."""
        A, n = genes.shape[:2]
        scene, flat = np.repeat(active, n), genes.reshape(-1, N_GENES)
        L = self.scenes.baseline
        longest, shortest = np.full(len(L), np.inf), np.full(len(L), np.inf)
        if known is not None:
            worst, length = known.cost[:, -1], L[active]
            kept = worst < BAD
            longest[active] = np.where(kept, worst * length, np.inf)
            short = np.where(kept, 1e-3, (worst - BAD) * length / PRICE)
            # The goal's distance from a moving obstacle is not known before the end.
            shortest[active] = np.where(self.moving[active], np.inf, short)
            shortest += self.parameters.slack
        found = roll_out(
            self.scenes,
            scene,
            avoidance_terms(self.scenes, scene, flat),
            self.parameters,
            seconds=self.duration * np.exp(flat[:, TAU]),
            dmp=self.dmp,
            longest=longest,
            shortest=shortest,
        )
        outcome = np.column_stack([getattr(found, name) for name in OUTCOME])
        cost = self.cost(scene, flat, outcome)
        return Ranked(genes, cost.reshape(A, n), outcome.reshape(A, n, len(OUTCOME)))

    def cost(self, scene: IntArray, genes: FloatArray, outcome: FloatArray) -> FloatArray:
        """Length over L, and small prices; above `BAD` where the clearance is not kept."""
        p, cost = self.parameters, np.empty(len(scene))
        _costs(
            scene,
            self.scenes.baseline,
            genes,
            outcome,
            self.moving,
            self.previous,
            _Tolerances(p.slack, p.tolerance, self.scenes.s - 1.0, 1.0 / p.steps),
            cost,
        )
        return cost

    def proposals(self, proposer: Proposer) -> tuple[FloatArray, BoolArray]:
        """What is proposed (S, n, 7), and whether for what the proposer was trained for (S,).

        Where there are genes in use, they and stronger ones take the place of the last of them.
        """
        self.spacing = proposer.spacing
        genes, in_range = proposer.propose(
            self.scenes, self.duration, self.parameters.candidates, self.price
        )
        genes = self.bounded(genes)
        in_use = np.isfinite(self.previous).all(axis=1)
        stays = max(self.parameters.candidates // 8, 2)
        stronger = strengths(
            self.previous[in_use], np.zeros(in_use.sum(), dtype=bool), self.spacing, stays - 1
        )
        genes[in_use, -stays:-1] = stronger
        genes[in_use, -1] = self.previous[in_use]
        return genes, in_range

    def children(self, active: IntArray, ranked: Ranked, number: int) -> FloatArray:
        """The candidates of a round, (A, n, 7)."""
        count = self.parameters.candidates
        random, genes, spacing = draws(number, count), ranked.genes, closer(self.spacing, number)
        kept = ranked.cost < BAD
        lines = [
            strengths(genes[:, rank], kept[:, rank], spacing, max(round(share * count), least))
            for rank, (share, least) in enumerate(_LINES)
            if rank < genes.shape[1]
        ]
        n_kin = count - sum(line.shape[1] for line in lines)
        kin = genes[:, np.arange(n_kin) % genes.shape[1]] + STRIDE * random.step[:n_kin]
        of = random.first[:n_kin] % genes.shape[1], random.second[:n_kin] % genes.shape[1]
        kin += random.mixing[:n_kin, None] * np.nan_to_num(genes[:, of[0]] - genes[:, of[1]])
        trial = np.concatenate([*lines, kin], axis=1)
        if number >= _FIRST_FRESH:
            fresh = ~ranked.solved[:, None, None] & random.is_fresh[:, None]
            trial = np.where(fresh, random.fresh, trial)
        trial[~self.moving[active], :, TAU] = 0.0
        return self.bounded(trial)

    def bounded(self, genes: FloatArray) -> FloatArray:
        """Returns genes (A, n, 7) moved into their ranges."""
        return np.clip(genes, LOWER, UPPER)

    def answer(self, chosen: Ranked, in_range: BoolArray) -> SearchResult:
        genes = chosen.genes[:, 0]
        margin, kept, _, length, _ = chosen.outcome[:, 0].T
        tau = np.maximum(1.0, length / self.scenes.baseline)
        return SearchResult(
            genes=genes,
            terms=avoidance_terms(self.scenes, np.arange(len(genes)), genes),
            tau=np.where(self.moving, np.exp(genes[:, TAU]), tau),
            kept_clearance=kept,
            shortfall=np.where(-margin > self.parameters.slack, -margin, 0.0),
            kept=chosen.solved,
            path_length=length,
            in_range=in_range,
        )


def verify(
    scenes: SpatialScenes,
    proposer: Proposer,
    *,
    duration: float,
    parameters: SearchParameters | None = None,
) -> SearchResult:
    """Chooses the motion of each scene, see the module.

    Args:
        scenes: S scenes.
        proposer: what proposes the first candidates.
        duration: T [s].
        parameters: how far the search goes; None: the defaults.

    Returns:
        The choice.

    Raises:
        ValueError: for a duration that is not positive.
    """
    if not 0.0 < duration < math.inf:
        raise ValueError(f"duration must be positive and finite [s], not {duration}")
    previous = np.full((len(scenes), N_GENES), np.nan)
    return Search(scenes, duration, None, previous, parameters or SearchParameters()).run(proposer)
