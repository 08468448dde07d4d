"""The search for a motion that the whole arm can go: candidates by the coupling terms, rolled out.

It goes on as that of `drake_oa.regulation.search` (the motion in use, the unmodulated one, what a
network proposes, variations of the best), but what decides is what spheres of the whole
arm keep of the solids (`drake_oa.planning.rollout`). Of a candidate the path of the tool is known
before its clearance: it is followed only as far as it may be among the best.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray
from drake_oa.common.thinking import Thinking, counted
from drake_oa.planning.arm_world import FAR, ArmWorld
from drake_oa.planning.rollout import ArmRollouts, ToolPaths, roll_out_arm
from drake_oa.policy.dmp import Dmp, trajectory
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.proposals import (
    ALPHA,
    ANGLE,
    N_GENES,
    NO_PRICE,
    TAU,
    Proposer,
    avoidance_terms,
    price_at,
)
from drake_oa.regulation.rollout import SpatialRollouts, SpatialScenes
from drake_oa.regulation.search import (
    BAD,
    FLIP,
    GOAL_PRICE,
    HURRY,
    LATE,
    MISS,
    OUTCOME,
    PRICE,
    Ranked,
    Search,
    roll_out,
)

SAMPLES = 64
"""Of a motion from s = 0 to 1 that are looked at: 3 cm apart at most on a way of 1 m."""
DEEP = 0.06
"""How much short a candidate is makes no difference beyond this [m],"""
_ROUGH = 6
"""Where no round follows the first motion that will do, the arm is looked at every so many samples
first, and on the way of those that clear there at all of them."""
HOPELESS, ROUNDS_OF_HOPE = 0.015, 1
"""A search whose best is short by so much after so many rounds is given up [m]."""
_CYCLE = 24
"""After so many rounds a search varies its candidates as at first: far and wide."""
_COSTS = Thinking()
"""Whatever decisions cost in a scenario: what is decided does not depend on it."""
MISSED = 2e-3
"""The arm follows a path of the tool if it misses it nowhere by more [m, rad]."""
ASTRAY = 0.1
"""Distance from the goal beyond which the end of a motion is no arrival, in baselines."""
FORBIDDEN = 1e3
"""Added to the cost of a motion on a side of infinite price."""
_HELD = 0.1
"""What the arm cannot follow is held: among what moves no better than what is short by so much
more [m]."""
_PACES = np.log([0.7, 1.4, 1.8, 2.3])
"""Logarithms of tau at which the unmodulated motion is proposed too, where something moves."""


@dataclass(frozen=True, eq=False)
class Leading(Frozen):
    """How the arm is led along its tool's path, as functions of normalised time.

    Attributes:
        s: (T,) times; beyond them all is as at the ends.
        R_WE: (T, 9) orientations of the tool, row by row.
        q: (D, T, n) postures that the null space is drawn to [rad].
    """

    s: FloatArray
    R_WE: FloatArray
    q: FloatArray

    def at(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Orientations (T, 9) and postures (D, T, n) at times (T,), linear in between.

        Between rows that are a degree apart the chord of two rotations turns as they do, and
        `tracking.pose_error` takes only its turn: it need not be made orthonormal.
        """
        row = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2)
        share = np.clip((s - self.s[row]) / np.diff(self.s)[row], 0.0, 1.0)[:, None]
        R_WE, q = self.R_WE, self.q
        return (
            R_WE[row] + share * (R_WE[row + 1] - R_WE[row]),
            q[:, row] + share * (q[:, row + 1] - q[:, row]),
        )


@lru_cache(maxsize=4)
def _length(dmp: Dmp) -> float:
    """Of the motion that a primitive makes of a baseline of 1."""
    plan = trajectory(dmp, np.zeros(3), np.array([1.0, 0.0, 0.0])).p
    return float(np.linalg.norm(np.diff(plan, axis=0), axis=1).sum())


class Earlier(NamedTuple):
    """A search that another one goes on from.

    Attributes:
        elites: (k, 7) its best candidates.
        rounds: that it has gone through.
        afresh: whether there are proposals for the other one too.
    """

    elites: FloatArray = np.zeros((0, N_GENES))
    rounds: int = 0
    afresh: bool = False


class ArmSearch(Search):
    """One search, in one scene; see `drake_oa.regulation.search.Search`.

    It may go on from an earlier one; it ends before it costs more than `most`, by what thinking
    costs [s], as soon as it has candidates. Sides may have a price besides, in baselines, see
    `drake_oa.regulation.proposals.price_at`; inf: no motion goes there.
    """

    def __init__(
        self,
        scene: SpatialScenes,
        world: ArmWorld,
        q: FloatArray,
        leading: Leading,
        *,
        dmp: Dmp,
        previous: FloatArray,
        parameters: SearchParameters,
        settled: bool = False,
        samples: int = SAMPLES,
        earlier: Earlier | None = None,
        most: float = math.inf,
        price: FloatArray = NO_PRICE,
    ) -> None:
        super().__init__(scene, dmp.duration, dmp, previous[None], parameters, settled=settled)
        self.world, self.q, self.leading = world, q, leading
        self.most, self.spent, self.latest = most, 0.0, 0.0
        self.price = price
        self.seeds, self.rounds, self.afresh = earlier or Earlier()
        self.world_moves = bool(world.solids.ball[:, 4:7].any())
        # No round follows the first motion that will do.
        self.hasty = parameters.polish == 0
        # The tool's path is rolled out without the ellipsoids: they propose, and decide nothing.
        self.empty = scene.without_obstacles()
        self.every = max(round(parameters.steps / samples), 1)
        self.planned_length = _length(dmp) * float(scene.baseline[0])

    def evaluate(self, active: IntArray, genes: FloatArray, known: Ranked | None = None) -> Ranked:
        """Rolls out candidates (1, n, 7)."""
        with counted() as work:
            ranked = self._evaluated(active, genes, known)
        self.latest = _COSTS.seconds(work) - _COSTS.decision
        self.spent += self.latest
        return ranked

    def _evaluated(self, active: IntArray, genes: FloatArray, known: Ranked | None) -> Ranked:
        n = genes.shape[1]
        if not len(active):
            return Ranked(genes, np.zeros((0, n)), np.zeros((0, n, len(OUTCOME))))
        flat = genes[0]
        found = self.tool_paths(flat)
        cost = self.tool_cost(flat, found)
        worst = math.inf if known is None or not len(known.cost) else float(known.cost[0, -1])
        # What may be short and still be among the best.
        may = (worst - BAD - cost) * self.scenes.baseline[0] / PRICE
        may = np.where(worst < BAD, np.where(cost < worst, self.parameters.slack, -np.inf), may)
        hopeless = np.isneginf(may)
        deep = math.inf if self.world_moves else 0.0 if self.hasty else DEEP
        may = np.maximum(np.minimum(may, deep), self.parameters.slack)
        enough = np.where(hopeless, np.inf, -may)
        screened = np.zeros(n)
        if self.hasty and not self.world_moves:
            rough = self.follow(flat, found, enough, every=_ROUGH * self.every)
            screened = np.where(~hopeless & (rough.least < enough), self.arm_cost(rough), 0.0)
            enough = np.where(screened > 0.0, np.inf, enough)
        arms = self.follow(flat, found, enough)
        kept = np.where(screened > 0.0, screened, self.arm_cost(arms))
        cost = cost + np.where(hopeless, BAD, kept)
        outcome = np.column_stack(
            [
                arms.least,
                arms.excess[:, 0],
                found.goal_error,
                found.path_length,
                found.steps,
            ]
        )
        return Ranked(genes, cost.reshape(1, n), outcome.reshape(1, n, len(OUTCOME)))

    def hopeless(self, ranked: Ranked, number: int) -> BoolArray:
        """(A,) where it is given up: another round would take too long, or a plan is needed.

        A plan is, where the best is still far too near after a few rounds.
        """
        if self.spent + self.latest > self.most:
            return np.ones(len(ranked.cost), dtype=bool)
        far = PRICE * HOPELESS / float(self.scenes.baseline[0])
        if self.world_moves:
            # No plan waits for what moves to pass.
            far = math.inf
        elif self.hasty:
            # How short they are is not looked at.
            far = 0.0
        return np.asarray((number >= ROUNDS_OF_HOPE) & (ranked.cost[:, 0] > BAD + far))

    def proposals(self, proposer: Proposer) -> tuple[FloatArray, BoolArray]:
        """What is proposed; where the search goes on, the best of what it had, or both.

        Where something moves, the unmodulated motion at other paces besides: to wait is a way.
        """
        seeds = self.bounded(self.seeds[None])
        if self.world_moves:
            paced = np.zeros((1, len(_PACES), N_GENES))
            paced[:, :, ALPHA], paced[:, :, TAU] = -np.inf, _PACES
            seeds = np.concatenate([seeds, self.bounded(paced)], axis=1)
        if len(self.seeds) and not self.afresh:
            return seeds, np.ones(1, dtype=bool)
        genes, in_range = super().proposals(proposer)
        kept = genes.shape[1] - seeds.shape[1]
        return np.concatenate([seeds, genes[:, :kept]], axis=1), in_range

    def children(self, active: IntArray, ranked: Ranked, number: int) -> FloatArray:
        """The candidates of a round; never those of one that has been, soon after it."""
        self.rounds += 1
        return super().children(active, ranked, (self.rounds - 1) % _CYCLE)

    def tool_paths(self, genes: FloatArray) -> SpatialRollouts:
        """The tool's motions of candidates (n, 7)."""
        scene = np.zeros(len(genes), dtype=np.int64)
        return roll_out(
            self.empty,
            scene,
            avoidance_terms(self.scenes, scene, genes),
            self.parameters,
            seconds=self.duration * np.exp(genes[:, TAU]),
            dmp=self.dmp,
            keep_path=True,
        )

    def sample_times(self, count: int, every: int = 0) -> FloatArray:
        """(count,) normalised times of the samples, from now on, or of every so many steps."""
        step = (every or self.every) / self.parameters.steps
        return np.asarray(self.scenes.s + step * np.arange(count))

    def terms(self, genes: FloatArray) -> FloatArray:
        """(13,) the avoidance term of a candidate."""
        term = avoidance_terms(self.scenes, np.zeros(1, dtype=np.int64), genes[None])
        return np.asarray(term[0])

    def follow(
        self, genes: FloatArray, found: SpatialRollouts, enough: FloatArray, *, every: int = 0
    ) -> ArmRollouts:
        """The arm along them, looked at after so many steps, or at the samples."""
        path = found.path[:, :: every or self.every]
        longest = int(np.isfinite(path[:, :, 0]).sum(axis=1).max(initial=1))
        path = path[:, : max(longest, 2)]
        s = self.sample_times(path.shape[1], every)
        R_WE, q = self.leading.at(s)
        paths = ToolPaths(
            s,
            path,
            R_WE[None],
            np.zeros(len(path), dtype=np.int64),
            q[:1],
            np.zeros(len(path), dtype=np.int64),
            self.duration * np.exp(genes[:, TAU]),
        )
        return roll_out_arm(self.world, self.q, paths, enough)

    def tool_cost(self, genes: FloatArray, found: SpatialRollouts) -> FloatArray:
        """Length over L, and small prices; above `BAD` where the motion does not arrive."""
        p, L = self.parameters, float(self.scenes.baseline[0])
        missed = np.maximum(np.minimum(found.goal_error, L) - p.tolerance, 0.0)
        bad = GOAL_PRICE * missed / L + MISS * (missed > 0.0)
        price = np.where(genes[:, ALPHA] > -np.inf, price_at(self.price, genes[:, ANGLE]), 0.0)
        bad += np.where(np.isinf(price), FORBIDDEN, 0.0)
        price = np.where(np.isinf(price), 0.0, price)
        late = np.maximum(found.steps / p.steps + self.scenes.s - 1.0, 0.0)
        hurry = np.abs(genes[:, TAU]) if self.moving[0] else 0.0
        flip = 0.5 - 0.5 * np.cos(genes[:, ANGLE] - self.previous[0, ANGLE])
        small = LATE * late + HURRY * hurry + FLIP * np.nan_to_num(flip) + price
        return np.asarray(np.where(bad > 0.0, BAD + bad, 0.0) + found.path_length / L + small)

    def arm_cost(self, arms: ArmRollouts) -> FloatArray:
        """What is added for a clearance that is not kept, or a path that cannot be followed."""
        L = float(self.scenes.baseline[0])
        short = np.maximum(-arms.least - self.parameters.slack, 0.0)
        lost = np.maximum(arms.error - MISSED, 0.0)
        fast = np.maximum(arms.hurry - 1.0, 0.0)
        held = _HELD * ((lost > 0.0) | (fast > 0.0)) * self.world_moves
        bad = PRICE * (short + np.minimum(lost, FAR) + held) / L + fast
        return np.asarray(np.where(bad > 0.0, BAD + bad, 0.0))
