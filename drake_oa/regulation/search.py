"""The search behind `drake_oa.regulation.verification`: rounds of candidates, the best of them
varied.

A plain evolution strategy. Its random numbers are the same for every scene and call, so a
scene gets the same choice whatever else is asked for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.kernel_arrays import kernel_arrays
from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray
from drake_oa.policy.coupling_kernels import ALPHA as ALPHA_COLUMN
from drake_oa.policy.coupling_kernels import KAPPA as KAPPA_COLUMN
from drake_oa.policy.coupling_kernels import N_COLUMNS, NORMAL
from drake_oa.policy.coupling_kernels import PSI as PSI_COLUMN
from drake_oa.policy.dmp import Dmp
from drake_oa.regulation.regressor import ChainWeights
from drake_oa.regulation.rollout import SpatialRollouts, SpatialScenes, spatial_rollouts
from drake_oa.regulation.verification_kernels import ACROSS, ALONG, ASKED, CENTER, shadows

N_GENES = 7
ANGLE, PLACE, ASIDE, KAPPA, PSI, ALPHA, TAU = range(N_GENES)
_LOWER = np.array(
    [-np.inf, 0.01, -0.3, math.log(0.1), math.log(0.15), math.log(0.1), math.log(0.6)]
)
_UPPER = np.array([np.inf, 0.99, 0.0, math.log(3e3), math.log(5.0), 30.0, math.log(2.5)])
GENE_RANGE = np.stack([_LOWER, _UPPER], axis=1)
"""(7, 2) least and largest value of each gene."""
_STRIDE = np.array([0.4, 0.08, 0.03, 0.6, 0.25, 0.8, 0.15])
"""Standard deviation of a full step of the search, gene by gene."""

_ELITES = 8
_LINE = 12
"""Candidates of a round that differ from the best one in alpha only."""
_FRESH = 16
"""Candidates of a round that are drawn anew while the clearance is not kept."""
_FIRST_FRESH = 6
"""Round from which they are."""

_WINDOW = 1.2 * np.pi
"""Half the angle in which a side is looked for, times the number of sides."""
_SPREAD = 1024
"""Candidates all over the ranges that such a search begins with, on each side."""
_N_ANGLES = 24
_OFFSETS = np.array([0, 1, -1, 3, -3, 6, -6, 12])
"""Sides that proposals are made for, of `_N_ANGLES`, counted from the lowest one."""
_GAINS = np.array([-3.0, -1.5, -0.5, 0.5, 1.5, 3.0, 5.0, 8.0])
"""What the proposals add to the chain's ln alpha."""

_BAD = 10.0
"""Added to the cost of a motion that does not keep the clearance or does not arrive."""
_PRICE = 100.0
"""Cost of what is short of the clearance or the world's margin, a baseline's length."""
_GOAL_PRICE = 30.0
_MISS, _TOUCH = 2.0, 50.0
"""Cost of not arriving, and of touching an obstacle."""
_LATE = 0.05
"""Cost of a unit of normalised time after s = 1."""
_HURRY = 0.02
"""Cost of |ln tau| = 1 among moving obstacles."""
_FLIP = 0.06
"""Cost of the opposite of the side in use: hysteresis."""
_BRIEF = 1
"""Rounds after the first motion that will do, where one is in use."""
_MUCH = 0.02
"""By how much another motion has to cost less than one in use that will do."""


@dataclass(frozen=True)
class SearchParameters:
    """How far the search goes.

    Attributes:
        candidates: roll-outs a round and scene, at least 32.
        rounds: rounds at most.
        polish: rounds after the first motion that keeps the clearance.
        retries: how often scenes whose clearance is not kept are searched again, with twice
            as many candidates and steps: once as before, then on every side by itself, from
            candidates all over the ranges (seconds a scene).
        slack: a motion keeps the clearance when it is short by no more than this [m].
        tolerance: a motion has arrived when it is this near to the goal [m].
        horizon: normalised time by which it has to arrive, counted from s = 0, or one
            more than the present one.
        steps: steps a unit of normalised time.
        fade: of the coupling near the goal, in baselines, see `action.goal_fade`.

    Raises:
        ValueError: for a value out of range.
    """

    candidates: int = 64
    rounds: int = 60
    polish: int = 6
    retries: int = 0
    slack: float = 2e-4
    tolerance: float = 6e-4
    horizon: float = 2.0
    steps: int = 500
    fade: float = 0.3

    def __post_init__(self) -> None:
        for name, least in (("candidates", 32), ("rounds", 0), ("polish", 0), ("retries", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, not {getattr(self, name)}")
        if self.steps < 50:
            raise ValueError(f"steps must be at least 50, not {self.steps}")
        for name in ("slack", "tolerance", "fade"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name} must be finite and not negative, not {getattr(self, name)}"
                )
        if not 1.0 <= self.horizon < math.inf:
            raise ValueError(f"horizon must be finite and at least 1, not {self.horizon}")


@dataclass(frozen=True, eq=False)
class Verified(Frozen):
    """What was chosen in S scenes.

    Attributes:
        genes: (S, 7) of the chosen candidates; ln alpha is -inf where the unmodulated
            motion was chosen.
        terms: (S, 13) their avoidance terms, rows as `spatial_rollouts` takes them.
        tau: (S,) temporal scaling: path length over the baseline, at least 1; among
            moving obstacles the one that was verified.
        end: (S,) normalised time at which the motion arrives.
        clearance: (S,) least distance to any obstacle on the way [m].
        shortfall: (S,) what is missing of the feasible clearance [m]; 0 where it is kept.
        kept: (S,) whether it is kept, the world's limits too, and the goal reached.
        goal_error: (S,) distance to the goal at the end [m].
        path_length: (S,) [m].
        in_range: (S,) whether the chain was asked within its trained range.
        cost: (S,) path length over the baseline and small prices; 10 and more where not kept.
        steps: (S,) steps a unit of normalised time that it was verified with.
        rollouts: number of trajectories that it took.
    """

    genes: FloatArray
    terms: FloatArray
    tau: FloatArray
    end: FloatArray
    clearance: FloatArray
    shortfall: FloatArray
    kept: BoolArray
    goal_error: FloatArray
    path_length: FloatArray
    in_range: BoolArray
    cost: FloatArray
    steps: IntArray
    rollouts: int

    def rows(self, index: BoolArray | IntArray) -> Verified:
        """Some of the scenes, by a mask or indices."""
        columns: dict[str, Any] = {"rollouts": self.rollouts}
        for item in fields(self):
            if item.name not in columns:
                columns[item.name] = getattr(self, item.name)[index]
        return Verified(**columns)

    def replaced(self, index: IntArray, other: Verified) -> Verified:
        """With the scenes of an index (n,) as the other one (n scenes) has them."""
        columns: dict[str, Any] = {"rollouts": self.rollouts + other.rollouts}
        for item in fields(self):
            if item.name not in columns:
                column = np.array(getattr(self, item.name))
                column[index] = getattr(other, item.name)
                columns[item.name] = column
        return Verified(**columns)


def avoidance_terms(scenes: SpatialScenes, scene: IntArray, genes: FloatArray) -> FloatArray:
    """The terms (N, 1, 13) of candidates (N, 7) in their scenes (N,)."""
    R, L = scenes.R_WL[scene], scenes.baseline[scene]
    cos, sin = np.cos(genes[:, ANGLE])[:, None], np.sin(genes[:, ANGLE])[:, None]
    terms = np.zeros((len(genes), 1, N_COLUMNS))
    omega = cos * R[:, :, 1] + sin * R[:, :, 2]
    terms[:, 0, :3] = scenes.p_WS[scene] + L[:, None] * (
        genes[:, PLACE, None] * R[:, :, 0] + genes[:, ASIDE, None] * omega
    )
    # x_L x omega: a turn about it goes from the baseline to the side.
    terms[:, 0, NORMAL : NORMAL + 3] = cos * R[:, :, 2] - sin * R[:, :, 1]
    terms[:, 0, ALPHA_COLUMN] = np.exp(genes[:, ALPHA])
    terms[:, 0, PSI_COLUMN] = np.exp(genes[:, PSI])
    terms[:, 0, KAPPA_COLUMN] = np.exp(genes[:, KAPPA]) / L**2
    return terms


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
        horizon=max(parameters.horizon, scenes.s + 1.0),
        fade=parameters.fade,
        tolerance=parameters.tolerance,
        longest=longest,
        shortest=shortest,
        keep_path=keep_path,
    )


@dataclass(frozen=True, eq=False)
class _Ranked:
    """The best candidates of A scenes, best first."""

    genes: FloatArray  # (A, n, 7)
    cost: FloatArray  # (A, n)
    outcome: FloatArray  # (A, n, len(OUTCOME))

    @property
    def solved(self) -> BoolArray:
        return np.asarray(self.cost[:, 0] < _BAD)

    def best(self, count: int) -> _Ranked:
        order = np.argsort(self.cost, axis=1, kind="stable")[:, :count]
        return _Ranked(
            np.take_along_axis(self.genes, order[:, :, None], axis=1),
            np.take_along_axis(self.cost, order, axis=1),
            np.take_along_axis(self.outcome, order[:, :, None], axis=1),
        )

    def rows(self, mask: BoolArray) -> _Ranked:
        return _Ranked(self.genes[mask], self.cost[mask], self.outcome[mask])

    def joined(self, other: _Ranked) -> _Ranked:
        return _Ranked(
            np.concatenate([self.genes, other.genes], axis=1),
            np.concatenate([self.cost, other.cost], axis=1),
            np.concatenate([self.outcome, other.outcome], axis=1),
        )


OUTCOME = ("margin", "clearance", "goal_error", "path_length", "steps", "world_margin")
"""What is kept of a roll-out, see `SpatialRollouts`."""


class Search:
    """One search, of the motions of all scenes at once; see
    `drake_oa.regulation.verification.verify`."""

    def __init__(
        self,
        scenes: SpatialScenes,
        duration: float,
        dmp: Dmp | None,
        previous: FloatArray,
        parameters: SearchParameters,
        sides: int = 1,
        *,
        settled: bool = False,
    ) -> None:
        self.settled = settled
        # With n sides, n consecutive scenes are one, each searched on one of them.
        self.sides = sides
        count = len(scenes)
        self.window = (np.arange(count) % sides) * (2.0 * np.pi / sides)
        self.scenes, self.duration, self.dmp = scenes, duration, dmp
        self.parameters = parameters
        self.moving = (np.nan_to_num(scenes.v_WO) != 0.0).any(axis=(1, 2))
        self.previous = previous
        self.rollouts = 0

    def run(self, weights: ChainWeights) -> Verified:
        """The unmodulated motion where it will do, else rounds of candidates."""
        count = len(self.scenes)
        # Nothing is shorter than the unmodulated motion.
        free = np.zeros((count, 1, N_GENES))
        free[:, :, ALPHA] = -np.inf
        chosen = self.evaluate(np.arange(count), free)
        proposed, in_range = self.proposals(weights)
        active = self.keep_previous(chosen, np.flatnonzero(~chosen.solved), proposed)
        first = proposed[active]
        if self.sides > 1:
            first = np.concatenate([first, self.spread(active, _SPREAD)], axis=1)
        ranked = self.evaluate(active, first).best(_ELITES)
        since = np.zeros(len(active), dtype=int)
        # Where a motion is in use its genes are near the best already.
        polish = np.where(np.isfinite(self.previous).all(axis=1), _BRIEF, self.parameters.polish)
        polish = np.minimum(polish, self.parameters.polish)
        for number in range(self.parameters.rounds + 1):
            self.keep_best(chosen, active, ranked)
            since += ranked.solved
            through = np.bincount(active // self.sides, since > polish[active])
            go_on = through[active // self.sides] == 0.0
            active, ranked, since = active[go_on], ranked.rows(go_on), since[go_on]
            if not len(active) or number == self.parameters.rounds:
                break
            trial = self.evaluate(active, self.children(active, ranked, number), ranked)
            ranked = ranked.joined(trial).best(_ELITES)
        return self.answer(chosen, in_range)

    def keep_previous(self, chosen: _Ranked, active: IntArray, proposed: FloatArray) -> IntArray:
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
    def keep_best(chosen: _Ranked, active: IntArray, ranked: _Ranked) -> None:
        better = ranked.cost[:, 0] < chosen.cost[active, 0]
        at = active[better]
        chosen.genes[at, 0] = ranked.genes[better, 0]
        chosen.cost[at, 0] = ranked.cost[better, 0]
        chosen.outcome[at, 0] = ranked.outcome[better, 0]

    def evaluate(
        self, active: IntArray, genes: FloatArray, known: _Ranked | None = None
    ) -> _Ranked:
        """Rolls out candidates (A, n, 7); those that cannot be among the known ones in part."""
        A, n = genes.shape[:2]
        scene, flat = np.repeat(active, n), genes.reshape(-1, N_GENES)
        L = self.scenes.baseline
        longest, shortest = np.full(len(L), np.inf), np.full(len(L), np.inf)
        if known is not None:
            worst, length = known.cost[:, -1], L[active]
            kept = worst < _BAD
            longest[active] = np.where(kept, worst * length, np.inf)
            short = np.where(kept, 1e-3, (worst - _BAD) * length / _PRICE)
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
        self.rollouts += len(scene)
        outcome = np.column_stack([getattr(found, name) for name in OUTCOME])
        return _Ranked(
            genes, self.cost(scene, flat, found).reshape(A, n), outcome.reshape(A, n, len(OUTCOME))
        )

    def cost(self, scene: IntArray, genes: FloatArray, found: SpatialRollouts) -> FloatArray:
        """Length over L, and small prices; above `_BAD` where the clearance is not kept."""
        p, L = self.parameters, self.scenes.baseline[scene]
        short = np.maximum(-found.margin - p.slack, 0.0) + np.maximum(-found.world_margin, 0.0)
        missed = np.maximum(np.minimum(found.goal_error, L) - p.tolerance, 0.0)
        bad = (_PRICE * short + _GOAL_PRICE * missed) / L
        touched = (short > 0.0) & (found.clearance <= 0.0)
        bad += _MISS * (missed > 0.0) + _TOUCH * touched
        late = np.maximum(found.steps / p.steps + self.scenes.s - 1.0, 0.0)
        hurry = np.where(self.moving[scene], np.abs(genes[:, TAU]), 0.0)
        # 0 for the side in use, 1 for its opposite; no side is in use before the first choice.
        flip = 0.5 - 0.5 * np.cos(genes[:, ANGLE] - self.previous[scene, ANGLE])
        return np.asarray(
            np.where(bad > 0.0, _BAD + bad, 0.0)
            + found.path_length / L
            + _LATE * late
            + _HURRY * hurry
            + _FLIP * np.nan_to_num(flip)
        )

    def proposals(self, weights: ChainWeights) -> tuple[FloatArray, BoolArray]:
        """The chain's candidates (S, n, 7), and whether it was asked in range (S,).

        Where there are genes in use, they take the place of the last one.
        """
        scenes, count = self.scenes, len(self.scenes)
        angles = np.arange(_N_ANGLES) * (2.0 * np.pi / _N_ANGLES)
        found = np.empty((count, _N_ANGLES, 4))
        shadows(
            *kernel_arrays(scenes.p_WG, scenes.R_WL, scenes.baseline),
            scenes.s,
            *kernel_arrays(
                scenes.p_WO, scenes.R_WO, scenes.semi_axes, scenes.v_WO, scenes.clearance
            ),
            self.duration,
            angles,
            found,
        )
        side = (found[:, :, ACROSS].argmin(axis=1)[:, None] + _OFFSETS) % _N_ANGLES
        shadow = np.take_along_axis(found, side[:, :, None], axis=1).reshape(-1, 4)
        answer = weights.parameters(
            shadow[:, [ALONG, ACROSS]], np.maximum(shadow[:, ASKED], 1e-6), 1.0, shadow[:, CENTER]
        )
        genes = np.zeros((len(shadow), len(_GAINS), N_GENES))
        genes[:, :, ANGLE] = angles[side].reshape(-1, 1)
        genes[:, :, PLACE] = shadow[:, CENTER, None]
        genes[:, :, KAPPA] = np.log(np.maximum(answer.kappa, 1e-9))[:, None]
        genes[:, :, PSI] = np.log(answer.psi)[:, None]
        genes[:, :, ALPHA] = np.log(np.maximum(answer.alpha, 1e-9))[:, None] + _GAINS
        genes = self.bounded(np.arange(count), genes.reshape(count, -1, N_GENES))
        in_use = np.isfinite(self.previous).all(axis=1)
        genes[in_use, -1] = self.previous[in_use]
        # The lowest side's.
        in_range = answer.in_range.reshape(count, -1)[:, 0] | (found[:, 0, ASKED] == 0.0)
        return genes, in_range

    def children(self, active: IntArray, ranked: _Ranked, number: int) -> FloatArray:
        """The candidates of a round, (A, n, 7)."""
        random = _draws(number, self.parameters.candidates)
        n_kin = self.parameters.candidates - _LINE
        genes = ranked.genes
        kin = genes[:, np.arange(n_kin) % _ELITES] + _STRIDE * random.step[:n_kin]
        apart = genes[:, random.first[:n_kin]] - genes[:, random.second[:n_kin]]
        kin += random.mixing[:n_kin, None] * np.nan_to_num(apart)
        # Along alpha from the best one: the least that keeps the clearance is shortest.
        line = np.repeat(genes[:, :1], _LINE, axis=1)
        line[:, :, ALPHA] += random.line
        trial = np.concatenate([line, kin], axis=1)
        if number >= _FIRST_FRESH:
            fresh = ~ranked.solved[:, None, None] & random.is_fresh[:, None]
            trial = np.where(fresh, random.fresh, trial)
        trial[~self.moving[active], :, TAU] = 0.0
        return self.bounded(active, trial)

    def spread(self, active: IntArray, count: int) -> FloatArray:
        """Candidates (A, count, 7) all over the ranges, the same in every search."""
        fresh = np.repeat(_draws(0, count).fresh[None], len(active), axis=0)
        fresh[~self.moving[active], :, TAU] = 0.0
        return self.bounded(active, fresh)

    def bounded(self, active: IntArray, genes: FloatArray) -> FloatArray:
        """Genes (A, n, 7) moved into their ranges."""
        genes = np.clip(genes, _LOWER, _UPPER)
        if self.sides > 1:
            middle = self.window[active, None]
            off = np.remainder(genes[:, :, ANGLE] - middle + np.pi, 2.0 * np.pi) - np.pi
            genes[:, :, ANGLE] = middle + np.clip(off, -_WINDOW / self.sides, _WINDOW / self.sides)
        return genes

    def answer(self, chosen: _Ranked, in_range: BoolArray) -> Verified:
        genes = chosen.genes[:, 0]
        margin, clearance, goal_error, length, steps, _ = chosen.outcome[:, 0].T
        tau = np.maximum(1.0, length / self.scenes.baseline)
        return Verified(
            genes=genes,
            terms=avoidance_terms(self.scenes, np.arange(len(genes)), genes)[:, 0],
            tau=np.where(self.moving, np.exp(genes[:, TAU]), tau),
            end=self.scenes.s + steps / self.parameters.steps,
            clearance=clearance,
            shortfall=np.where(-margin > self.parameters.slack, -margin, 0.0),
            kept=chosen.solved,
            goal_error=goal_error,
            path_length=length,
            in_range=in_range,
            cost=chosen.cost[:, 0],
            steps=np.full(len(genes), self.parameters.steps),
            rollouts=self.rollouts,
        )


@dataclass(frozen=True, eq=False)
class _Draws:
    """The random numbers of a round of n candidates."""

    step: FloatArray  # (n, 7)
    first: IntArray  # (n,)
    second: IntArray  # (n,)
    mixing: FloatArray  # (n,)
    line: FloatArray  # (_LINE,)
    fresh: FloatArray  # (n, 7)
    is_fresh: BoolArray  # (n,)


@lru_cache(maxsize=256)
def _draws(number: int, n: int) -> _Draws:
    rng = np.random.default_rng((number, n))
    low = np.where(np.isfinite(_LOWER), _LOWER, 0.0)
    high = np.where(np.isfinite(_UPPER), _UPPER, 2.0 * np.pi)
    return _Draws(
        step=rng.standard_normal((n, N_GENES)) * np.exp(rng.uniform(-2.5, 0.0, (n, 1))),
        first=rng.integers(0, _ELITES, n),
        second=rng.integers(0, _ELITES, n),
        mixing=np.where(rng.uniform(size=n) < 0.5, 0.5, 0.0),
        line=np.linspace(-2.5, 1.5, _LINE) * max(0.5 ** (number // 2), 0.02),
        fresh=low + (high - low) * rng.uniform(size=(n, N_GENES)),
        is_fresh=np.arange(n) >= n - _FRESH,
    )
