"""The search for a motion that the whole arm can go: candidates by the coupling terms, rolled out.

It goes on as that of `drake_oa.regulation.search` (the motion in use, the unmodulated one, what the
regressor chain proposes, variations of the best), but what decides is what spheres of the whole
arm keep of the solids (`drake_oa.planning.rollout`). Of a candidate the path of the tool is known
before its clearance: it is followed only as far as it may be among the best.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray
from drake_oa.planning.arm_world import FAR, ArmWorld
from drake_oa.planning.rollout import ArmRollouts, ToolPaths, roll_out_arm
from drake_oa.policy.dmp import Dmp, trajectory
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.proposals import ANGLE, N_GENES, TAU, avoidance_terms
from drake_oa.regulation.regressor import ChainWeights
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
"""How much short a candidate is makes no difference beyond this [m]."""
HOPELESS, ROUNDS_OF_HOPE = 0.015, 1
"""A search whose best is short by so much after so many rounds is given up [m]."""
_CYCLE = 24
"""After so many rounds a search varies its candidates as at first: far and wide."""
MISSED = 2e-3
"""The arm follows a path of the tool if it misses it nowhere by more [m, rad]."""


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
        """Orientations (T, 9) and postures (D, T, n) at times (T,), the nearest before."""
        row = np.clip(np.searchsorted(self.s, s + 1e-9) - 1, 0, len(self.s) - 1)
        return self.R_WE[row], self.q[:, row]


@lru_cache(maxsize=4)
def _length(dmp: Dmp) -> float:
    """Of the motion that a primitive makes of a baseline of 1."""
    plan = trajectory(dmp, np.zeros(3), np.array([1.0, 0.0, 0.0])).p
    return float(np.linalg.norm(np.diff(plan, axis=0), axis=1).sum())


class ArmSearch(Search):
    """One search, in one scene; see `drake_oa.regulation.search.Search`.

    With seeds it goes on from the best candidates of another search that has gone through so many
    rounds, and not with what the chain proposes; it ends before it looks at more configurations
    than `most`, as soon as it has candidates.
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
        seeds: FloatArray | None = None,
        begun: int = 0,
        most: float = math.inf,
    ) -> None:
        super().__init__(scene, dmp.duration, dmp, previous[None], parameters, settled=settled)
        self.world, self.q, self.leading = world, q, leading
        self.seeds = np.zeros((0, N_GENES)) if seeds is None else seeds
        self.most, self.configurations, self.latest = most, 0, 0
        self.rounds = begun
        self.world_moves = bool(world.solids.ball[:, 4:7].any())
        # The tool's path is rolled out without the ellipsoids: they propose, and decide nothing.
        self.empty = scene.without_obstacles()
        self.every = max(round(parameters.steps / samples), 1)
        self.planned_length = _length(dmp) * float(scene.baseline[0])

    def evaluate(self, active: IntArray, genes: FloatArray, known: Ranked | None = None) -> Ranked:
        """Rolls out candidates (1, n, 7)."""
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
        may = np.clip(may, self.parameters.slack, math.inf if self.world_moves else DEEP)
        enough = np.where(hopeless, np.inf, -may)
        arms = self.follow(flat, found, enough)
        cost = cost + np.where(hopeless, BAD, self.arm_cost(arms))
        outcome = np.column_stack(
            [
                arms.least,
                arms.excess[:, 0],
                found.goal_error,
                found.path_length,
                found.steps,
                found.world_margin,
            ]
        )
        return Ranked(genes, cost.reshape(1, n), outcome.reshape(1, n, len(OUTCOME)))

    def hopeless(self, ranked: Ranked, number: int) -> BoolArray:
        """(A,) where it is given up: another round would take too long, or a plan is needed.

        A plan is, where the best is still far too near after a few rounds.
        """
        if self.configurations + self.latest > self.most:
            return np.ones(len(ranked.cost), dtype=bool)
        far = PRICE * HOPELESS / float(self.scenes.baseline[0])
        if self.world_moves:
            # No plan waits for what moves to pass.
            far = math.inf
        return np.asarray((number >= ROUNDS_OF_HOPE) & (ranked.cost[:, 0] > BAD + far))

    def proposals(self, weights: ChainWeights) -> tuple[FloatArray, BoolArray]:
        """The chain's candidates; where the search goes on, the best of what it had."""
        if len(self.seeds):
            return self.bounded(np.arange(1), self.seeds[None]), np.ones(1, dtype=bool)
        return super().proposals(weights)

    def children(self, active: IntArray, ranked: Ranked, number: int) -> FloatArray:
        """The candidates of a round; never those of one that has been, soon after it."""
        self.rounds += 1
        return super().children(active, ranked, (self.rounds - 1) % _CYCLE)

    def tool_paths(self, genes: FloatArray) -> SpatialRollouts:
        """The tool's motions of candidates (n, 7)."""
        scene = np.zeros(len(genes), dtype=np.int64)
        self.rollouts += len(genes)
        return roll_out(
            self.empty,
            scene,
            avoidance_terms(self.scenes, scene, genes),
            self.parameters,
            seconds=self.duration * np.exp(genes[:, TAU]),
            dmp=self.dmp,
            keep_path=True,
        )

    def sample_times(self, count: int) -> FloatArray:
        """(count,) normalised times of the samples, from now on."""
        return np.asarray(self.scenes.s + self.every / self.parameters.steps * np.arange(count))

    def terms(self, genes: FloatArray) -> FloatArray:
        """(13,) the avoidance term of a candidate."""
        term = avoidance_terms(self.scenes, np.zeros(1, dtype=np.int64), genes[None])
        return np.asarray(term[0])

    def follow(self, genes: FloatArray, found: SpatialRollouts, enough: FloatArray) -> ArmRollouts:
        """The arm along them."""
        path = found.path[:, :: self.every]
        longest = int(np.isfinite(path[:, :, 0]).sum(axis=1).max(initial=1))
        path = path[:, : max(longest, 2)]
        s = self.sample_times(path.shape[1])
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
        arms = roll_out_arm(self.world, self.q, paths, enough)
        self.latest = int(arms.samples.sum())
        self.configurations += self.latest
        return arms

    def tool_cost(self, genes: FloatArray, found: SpatialRollouts) -> FloatArray:
        """Length over L, and small prices; above `BAD` where the motion does not arrive."""
        p, L = self.parameters, float(self.scenes.baseline[0])
        missed = np.maximum(np.minimum(found.goal_error, L) - p.tolerance, 0.0)
        outside = np.maximum(-found.world_margin, 0.0)
        bad = (GOAL_PRICE * missed + PRICE * outside) / L + MISS * (missed > 0.0)
        late = np.maximum(found.steps / p.steps + self.scenes.s - 1.0, 0.0)
        hurry = np.abs(genes[:, TAU]) if self.moving[0] else 0.0
        flip = 0.5 - 0.5 * np.cos(genes[:, ANGLE] - self.previous[0, ANGLE])
        small = LATE * late + HURRY * hurry + FLIP * np.nan_to_num(flip)
        return np.asarray(np.where(bad > 0.0, BAD + bad, 0.0) + found.path_length / L + small)

    def arm_cost(self, arms: ArmRollouts) -> FloatArray:
        """What is added for a clearance that is not kept, or a path that cannot be followed."""
        L = float(self.scenes.baseline[0])
        short = np.maximum(-arms.least - self.parameters.slack, 0.0)
        lost = np.maximum(arms.error - MISSED, 0.0)
        fast = np.maximum(arms.hurry - 1.0, 0.0)
        bad = PRICE * (short + np.minimum(lost, FAR)) / L + fast
        return np.asarray(np.where(bad > 0.0, BAD + bad, 0.0))
