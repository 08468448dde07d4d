"""The local search for a motion that achieves the requested clearance: an evolution strategy.

Candidates are the nominal motion, the motion in use, proposals, and variations of the best so far.
Each is rolled out by the integrator's kernel (`drake_oa.policy.rollout`) and followed among the
obstacles: by the whole arm (`ArmSearch`, `roll_out_arm`) or by a point
(`drake_oa.planning.point_search`). The random numbers of a round are the same for every scene and
call, so a scene gets the same motion whatever else is searched for. Of a candidate the path of the
tool is known before its clearance: it is followed only as far as it may be among the best.

Whole-arm roll-outs: from motions of the tool to the least clearance of everything, compiled.

A candidate is a path of the tool point, an orientation along it and a posture that its null space
is drawn to. Its joints follow (`drake_oa.robot.arm`); at each sample, at its time, every
sphere of the robot is measured against every solid and the other spheres
(`drake_oa.planning.arm_world`), and the joints against their limits and speeds. Candidates are
rolled out on all cores.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.compiled import CORES, kernel_arrays, on_cores, parted
from drake_oa.common.messages import FloatArray, Frozen, IntArray
from drake_oa.common.thinking import Thinking, Work, count, counted
from drake_oa.geometry.solids import Solids
from drake_oa.planning.arm_world import FAR, ArmWorld, Asked, lower_excess
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA as TERM_ALPHA
from drake_oa.policy.coupling import NORMAL
from drake_oa.policy.dmp import Dmp, trajectory
from drake_oa.policy.guidance import Obstacles
from drake_oa.policy.rollout import Scene, ToolRollouts, roll_out_tool
from drake_oa.regulation.config import Verified
from drake_oa.regulation.proposals import (
    ALPHA,
    ANGLE,
    ELITES,
    LOWER,
    N_GENES,
    NO_PRICE,
    SPACING,
    STRIDE,
    TAU,
    UPPER,
    avoidance_terms,
    closer,
    draws,
    genes_of,
    price_at,
    strengths,
    tried,
)
from drake_oa.robot.arm import PULL, Chain, Spheres, follow, scratch

SAMPLES = 64
"""Number of samples of a motion from s = 0 to 1 at which the arm is placed: 3 cm apart at most on a
path of 1 m."""
DEEP = 0.06
"""Shortfall of a candidate beyond which a larger one makes no difference [m]."""
_ROUGH = 6
"""Where no round follows the first feasible motion, the arm is placed at every so many samples
first, and then at all samples of the candidates that are clear there."""
HOPELESS, ROUNDS_OF_HOPE = 0.015, 1
"""A search with a shortfall of its best candidate by so much after so many rounds is given up
[m]."""
_CYCLE = 24
"""Number of rounds after which the candidates vary as in the first round: far and wide."""
_COSTS = Thinking()
"""Cost of the work of a search; the decision does not depend on a scenario's `thinking`."""
MISSED = 2e-3
"""Largest error of the tool's pose with which the arm follows a path [m, rad]."""
ASTRAY = 0.1
"""Distance from the goal beyond which the end of a motion is no arrival, in baselines."""
FORBIDDEN = 1e3
"""Additional cost of a motion on a side with an infinite price."""
BAD = 10.0
"""Additional cost of a motion that does not achieve the clearance or does not arrive."""
PRICE = 100.0
"""Cost of a shortfall of the clearance by the length of the baseline."""
_GOAL_PRICE, _MISS = 30.0, 2.0
"""Costs of an end that is a baseline away from the goal, and of any end beyond the tolerance."""
_LATE = 0.05
"""Cost of a unit of normalised time after s = 1."""
_HURRY = 0.02
"""Cost of |ln tau| = 1 among moving obstacles."""
_FLIP = 0.06
"""Cost of the side opposite to the one in use: hysteresis."""
_BRIEF = 1
"""Number of rounds after the first feasible motion, if one is in use."""
_MUCH = 0.02
"""Least difference in cost for which another motion replaces a feasible one in use."""
_LINES = ((0.2, 5), (0.1, 1))
"""Of the best and the second best of a round: share of the candidates, and least number of them,
that differ from it in alpha only."""
_FIRST_FRESH = 6
"""First round with random candidates."""
NONE_IN_USE = np.full(N_GENES, np.nan)
"""Genes if no motion is in use."""
SOURCES = ("nominal", "chain", "sides", "search", "joint_path")
"""Sources of a motion: the nominal motion, the rows of the paper's chain together, a proposed side,
the local search, and a path in the joints."""
NOMINAL, CHAIN, SIDES, SEARCH, JOINT_PATH = range(len(SOURCES))
_EVEN = np.tile([0.0, 0.5, -0.05, 1.0, 0.3, 4.0, 0.0], (16, 1))
_EVEN[:, ANGLE] = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
"""First candidates of a search without proposals: a moderate term on every side."""


class Ranked(NamedTuple):
    """Candidates, the best first.

    Attributes:
        genes: (n, 7) genes; those of the nominal motion where the source is `CHAIN`.
        cost: (n,) costs.
        length: (n,) path lengths [m].
        source: (n,) rows of `SOURCES`.
    """

    genes: FloatArray
    cost: FloatArray
    length: FloatArray
    source: IntArray

    @property
    def solved(self) -> bool:
        """Whether the best achieves the clearance and arrives."""
        return bool(self.cost[0] < BAD)

    def joined(self, *others: Ranked) -> Ranked:
        """Returns the best of these and of others, at most `ELITES`."""
        columns = [np.concatenate(column) for column in zip(self, *others, strict=True)]
        order = np.argsort(columns[1], kind="stable")[:ELITES]
        return Ranked(*(column[order] for column in columns))


def nominal_genes() -> FloatArray:
    """Returns the genes (1, 7) of the nominal motion."""
    genes = np.zeros((1, N_GENES))
    genes[:, ALPHA] = -np.inf
    return genes


def _first(ranked: Ranked) -> Ranked:
    """Returns the best candidate alone."""
    return Ranked(ranked.genes[:1], ranked.cost[:1], ranked.length[:1], ranked.source[:1])


class Search(ABC):
    """Search in one scene; the obstacles are the subclass's."""

    def __init__(
        self,
        scene: Scene,
        *,
        dmp: Dmp,
        policy: Policy,
        parameters: Verified,
        previous: FloatArray = NONE_IN_USE,
        settled: bool = False,
        price: FloatArray = NO_PRICE,
    ) -> None:
        """Stores the problem.

        Args:
            scene: the motion under way.
            dmp: the movement primitive.
            policy: time step and fade of the action level.
            parameters: effort and tolerances.
            previous: (7,) genes of the motion in use; NaN: none is.
            settled: whether a motion in use that is feasible stays without a look at others.
            price: (K,) additional costs of the sides, in baselines, see `proposals.price_at`; inf:
                no motion passes there.
        """
        self.scene, self.dmp, self.policy, self.parameters = scene, dmp, policy, parameters
        self.previous, self.settled, self.price = previous, settled, price
        self.moves = scene.moves
        self.ds = policy.period / dmp.duration
        self.every = 1
        self.counts = np.zeros(len(SOURCES), dtype=np.int64)
        self.elites, self.stays = np.zeros((0, N_GENES)), False

    @abstractmethod
    def world_cost(
        self, genes: FloatArray, tool: ToolRollouts, cost: FloatArray, worst: float
    ) -> FloatArray:
        """Returns the costs (n,) of the clearance along the paths of the tool.

        Args:
            genes: (n, 7) the candidates.
            tool: their paths.
            cost: (n,) their costs so far.
            worst: cost beyond which a candidate is not among the best.
        """

    def run(
        self,
        sides: FloatArray,
        *,
        guided: Obstacles | None = None,
        in_use: Obstacles | None = None,
        source: int = SEARCH,
    ) -> Ranked:
        """Searches.

        Args:
            sides: (n, 7) genes of proposed sides, the best first.
            guided: candidate by the rows of the paper's chain: the obstacles with their terms, past
                which guidance leads.
            in_use: the motion in use, if it is such a one.
            source: of the motion in use, if it has genes.

        Returns:
            The best candidate, alone. Nothing is shorter than the nominal motion: where that is
            feasible, nothing else is looked at.
        """
        genes, had = nominal_genes(), bool(np.isfinite(self.previous).all())
        nominal = self.evaluate(genes, [NOMINAL])
        if nominal.solved:
            return nominal
        best = nominal
        if in_use is not None:
            best = self.evaluate(genes, [CHAIN], guided=in_use)
        elif had:
            best = self.evaluate(self.previous[None], [source])
        held = best.solved
        if held and self.settled:
            self.stays = True
            return best
        same, best = best, best.joined(nominal)
        if guided is not None:
            ranked = self.evaluate(genes, [CHAIN], _first(best), guided)
            best = best.joined(ranked)
        genes, sources = self.seeded(sides, guided)
        ranked = self.evaluate(genes, sources, _first(best) if best.solved else None)
        best = _first(best.joined(ranked))
        if held and same.cost[0] <= best.cost[0] + _MUCH:
            self.stays = True
            return same
        since, ranked = 0, ranked.joined()
        polish = min(_BRIEF, self.parameters.polish) if had else self.parameters.polish
        for number in range(self.parameters.rounds + 1):
            self.elites = ranked.genes
            since += best.solved
            last = since > polish or number == self.parameters.rounds
            if last or self.hopeless(best, number):
                break
            trial = self.children(ranked, number)
            ranked = ranked.joined(self.evaluate(trial, [SEARCH] * len(trial), ranked))
            best = _first(best.joined(ranked))
        self.stays = held and not best.cost[0] < same.cost[0]
        return same if self.stays else best

    def hopeless(self, ranked: Ranked, number: int) -> bool:
        """Returns whether the search is given up after so many rounds."""
        return False

    def evaluate(
        self,
        genes: FloatArray,
        source: Sequence[int] | IntArray,
        known: Ranked | None = None,
        guided: Obstacles | None = None,
    ) -> Ranked:
        """Rolls out candidates (n, 7) of sources (n,), or the guided one.

        Those that cannot be among the known ones are rolled out only in part.
        """
        worst = math.inf if known is None else float(known.cost[-1])
        longest = worst * self.scene.baseline if worst < BAD else math.inf
        with counted() as work:
            tool = self.tool_paths(genes, longest, guided)
            cost = self.tool_cost(genes, tool)
            cost = cost + self.world_cost(genes, tool, cost, worst)
        ranked = Ranked(genes, cost, tool.path_length, np.asarray(source, dtype=np.int64))
        self.evaluated(ranked, work, guided)
        return ranked

    def evaluated(self, ranked: Ranked, work: Work, guided: Obstacles | None) -> None:
        """Counts the candidates by source; `work` is the work of their roll-outs."""
        self.counts += np.bincount(ranked.source, minlength=len(SOURCES))

    def tool_paths(
        self, genes: FloatArray, longest: float = math.inf, guided: Obstacles | None = None
    ) -> ToolRollouts:
        """Rolls out the tool along candidates (n, 7), or the guided one."""
        if guided is None:
            terms, obstacles = avoidance_terms(self.scene, genes)[:, None], None
        else:
            terms, obstacles = guided.terms[None], guided
        return roll_out_tool(
            self.scene,
            terms,
            dmp=self.dmp,
            policy=self.policy,
            tolerance=self.parameters.tolerance,
            longest=longest,
            obstacles=obstacles,
            every=self.every,
        )

    def seconds(self, genes: FloatArray) -> FloatArray:
        """Returns tau T (n,) of candidates [s]."""
        return np.asarray(self.dmp.duration * np.exp(genes[:, TAU]))

    def tool_cost(self, genes: FloatArray, tool: ToolRollouts) -> FloatArray:
        """Returns length over L, and small prices; above `BAD` where the motion does not arrive."""
        L = self.scene.baseline
        missed = np.maximum(np.minimum(tool.goal_error, L) - self.parameters.tolerance, 0.0)
        bad = _GOAL_PRICE * missed / L + _MISS * (missed > 0.0)
        price = np.where(genes[:, ALPHA] > -np.inf, price_at(self.price, genes[:, ANGLE]), 0.0)
        bad += np.where(np.isinf(price), FORBIDDEN, 0.0)
        price = np.where(np.isinf(price), 0.0, price)
        late = np.maximum(tool.steps * self.ds + self.scene.s - 1.0, 0.0)
        hurry = np.abs(genes[:, TAU]) if self.moves else 0.0
        # 0 for the side in use, 1 for its opposite; no side is in use before the first choice.
        flip = np.nan_to_num(0.5 - 0.5 * np.cos(genes[:, ANGLE] - self.previous[ANGLE]))
        small = _LATE * late + _HURRY * hurry + _FLIP * flip + price
        return np.asarray(np.where(bad > 0.0, BAD + bad, 0.0) + tool.path_length / L + small)

    def seeded(self, sides: FloatArray, guided: Obstacles | None) -> tuple[FloatArray, IntArray]:
        """Returns the first candidates (n, 7) and their sources (n,).

        Proposed sides with several strengths each; in place of the last of them single terms of
        the guided candidate, and the motion in use with stronger ones. Without any of these, a
        moderate term on every side.
        """
        count = self.parameters.candidates
        genes, more = tried(sides, count), [np.zeros((0, N_GENES))]
        if guided is not None:
            acts = (guided.terms[:, TERM_ALPHA] > 0.0) & guided.terms[:, NORMAL:].any(axis=1)
            more.append(genes_of(self.scene, guided.terms[acts])[: count // 8])
        if np.isfinite(self.previous).all():
            stays = max(count // 8, 2)
            more += [strengths(self.previous, False, SPACING, stays - 1), self.previous[None]]
        others = np.concatenate(more)
        genes = genes[: max(count - len(others), 0)]
        if not len(genes) and not len(others):
            others = _EVEN
        source = np.repeat([SIDES, SEARCH], [len(genes), len(others)])
        return self.bounded(np.concatenate([genes, others])), source

    def children(self, ranked: Ranked, number: int) -> FloatArray:
        """Returns the candidates of a round, (n, 7)."""
        count = self.parameters.candidates
        random, genes = draws(number, count), ranked.genes
        lines = [
            strengths(one, cost < BAD, closer(number), max(round(share * count), least))
            for one, cost, (share, least) in zip(genes, ranked.cost, _LINES, strict=False)
        ]
        n_kin = count - sum(map(len, lines))
        kin = genes[np.arange(n_kin) % len(genes)] + STRIDE * random.step[:n_kin]
        first, second = random.first[:n_kin] % len(genes), random.second[:n_kin] % len(genes)
        kin += random.mixing[:n_kin, None] * np.nan_to_num(genes[first] - genes[second])
        trial = np.concatenate([*lines, kin])
        if number >= _FIRST_FRESH and not ranked.solved:
            trial = np.where(random.is_fresh[:, None], random.fresh, trial)
        if not self.moves:
            trial[:, TAU] = 0.0
        return self.bounded(trial)

    def bounded(self, genes: FloatArray) -> FloatArray:
        """Returns genes (n, 7) moved into their ranges."""
        return np.clip(genes, LOWER, UPPER)


@dataclass(frozen=True, eq=False)
class Leading(Frozen):
    """How the arm is led along its tool's path, as functions of normalised time.

    Attributes:
        s: (T,) times; beyond them all is as at the ends.
        R_WE: (T, 9) orientations of the tool, row by row.
        q: (T, n) postures to which the null space is attracted [rad].
    """

    s: FloatArray
    R_WE: FloatArray
    q: FloatArray

    def at(self, s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Interpolates orientations (T, 9) and postures (T, n) at times (T,).

        Between rows that are a degree apart the chord of two rotations turns as they do, and
        `arm.pose_error` takes only its turn: it need not be made orthonormal.
        """
        row = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2)
        share = np.clip((s - self.s[row]) / np.diff(self.s)[row], 0.0, 1.0)[:, None]
        R_WE, q = self.R_WE, self.q
        return (
            R_WE[row] + share * (R_WE[row + 1] - R_WE[row]),
            q[row] + share * (q[row + 1] - q[row]),
        )


@lru_cache(maxsize=4)
def _length(dmp: Dmp) -> float:
    """Of the motion that a primitive makes of a baseline of 1."""
    plan = trajectory(dmp, np.zeros(3), np.array([1.0, 0.0, 0.0])).p
    return float(np.linalg.norm(np.diff(plan, axis=0), axis=1).sum())


class Earlier(NamedTuple):
    """Search from which another one continues.

    Attributes:
        elites: (k, 7) its best candidates.
        rounds: number of its rounds.
    """

    elites: FloatArray = np.zeros((0, N_GENES))
    rounds: int = 0


class ArmSearch(Search):
    """Search for the motion of a whole arm among solids.

    It may continue an earlier one, and ends before it costs more than `most` by `thinking` [s], as
    soon as it has candidates.
    """

    def __init__(
        self,
        scene: Scene,
        world: ArmWorld,
        q: FloatArray,
        leading: Leading,
        *,
        samples: int = SAMPLES,
        earlier: Earlier | None = None,
        most: float = math.inf,
        **more: Any,
    ) -> None:
        """Stores the problem.

        Args:
            world: the arm among the solids.
            q: (n,) its joints [rad].
            leading: orientations and postures along the path.
            samples: number of samples from s = 0 to 1 at which the arm is placed.
            earlier: search from which this one continues.
            most: largest cost [s].
            scene, more: arguments of `Search`.
        """
        super().__init__(scene, **more)
        self.world, self.q, self.leading = world, q, leading
        self.most, self.spent, self.latest = most, 0.0, 0.0
        self.seeds, self.rounds = earlier or Earlier()
        # MotionGuard is responsible for moving obstacles.
        self.moves = False
        # No round follows the first feasible motion.
        self.hasty = self.parameters.polish == 0
        self.every = max(round(1.0 / (self.ds * samples)), 1)
        self.planned_length = _length(self.dmp) * scene.baseline
        self._led: dict[int, tuple[FloatArray, FloatArray, FloatArray]] = {}
        self._feasible: dict[bytes, tuple[ToolRollouts, ArmRollouts]] = {}

    def evaluated(self, ranked: Ranked, work: Work, guided: Obstacles | None) -> None:
        """Adds up the cost, and stores the roll-outs of the best candidate."""
        super().evaluated(ranked, work, guided)
        self.latest = _COSTS.seconds(work) - _COSTS.decision
        self.spent += self.latest
        best = int(ranked.cost.argmin())
        if ranked.cost[best] < BAD and guided is None:
            tool, arms = self._last
            self._feasible[ranked.genes[best].tobytes()] = _row(tool, best), _row(arms, best)

    def world_cost(
        self, genes: FloatArray, tool: ToolRollouts, cost: FloatArray, worst: float
    ) -> FloatArray:
        """Returns the costs of the whole arm's clearance; see `Search`."""
        # Shortfalls with which a candidate may still be among the best.
        may = (worst - BAD - cost) * self.scene.baseline / PRICE
        may = np.where(worst < BAD, np.where(cost < worst, self.parameters.slack, -np.inf), may)
        hopeless = np.isneginf(may)
        deep = 0.0 if self.hasty else DEEP
        may = np.maximum(np.minimum(may, deep), self.parameters.slack)
        enough = np.where(hopeless, np.inf, -may)
        screened = np.zeros(len(genes))
        if self.hasty:
            rough = self.follow(genes, tool, enough, stride=_ROUGH)
            screened = np.where(~hopeless & (rough.least < enough), self.arm_cost(rough), 0.0)
            enough = np.where(screened > 0.0, np.inf, enough)
        arms = self.follow(genes, tool, enough)
        self._last, kept = (tool, arms), self.arm_cost(arms)
        return np.where(hopeless, BAD, np.where(screened > 0.0, screened, kept))

    def hopeless(self, ranked: Ranked, number: int) -> bool:
        """Returns whether another round would take too long, or a path in the joints is needed.

        It is, where the best is still far too near after a few rounds.
        """
        if self.spent + self.latest > self.most:
            return True
        # The shortfalls of a hasty search are not computed.
        far = 0.0 if self.hasty else PRICE * HOPELESS / self.scene.baseline
        return bool(number >= ROUNDS_OF_HOPE and ranked.cost[0] > BAD + far)

    def seeded(self, sides: FloatArray, guided: Obstacles | None) -> tuple[FloatArray, IntArray]:
        """Returns the best candidates of the earlier search, or the first ones; see `Search`."""
        if len(self.seeds):
            return self.bounded(self.seeds), np.full(len(self.seeds), SEARCH)
        return super().seeded(sides, guided)

    def children(self, ranked: Ranked, number: int) -> FloatArray:
        """Returns the candidates of a round; never those of a recent one."""
        self.rounds += 1
        return super().children(ranked, (self.rounds - 1) % _CYCLE)

    def sample_times(self, count: int, stride: int = 1) -> FloatArray:
        """Returns normalised times (count,) of the samples from now on, or of every few."""
        return np.asarray(self.scene.s + stride * self.every * self.ds * np.arange(count))

    def follow(
        self, genes: FloatArray, tool: ToolRollouts, enough: FloatArray, *, stride: int = 1
    ) -> ArmRollouts:
        """Lets the arm follow the tool, placed at the samples of its path, or at every few."""
        path = tool.path[:, ::stride]
        T = max(int(np.isfinite(path[:, :, 0]).sum(axis=1).max(initial=1)), 2)
        if stride not in self._led:
            s = self.sample_times(path.shape[1], stride)
            self._led[stride] = s, *self.leading.at(s)
        s, R_WE, q = self._led[stride]
        R_WE, q = (np.broadcast_to(of[:T], (len(path), T, of.shape[1])) for of in (R_WE, q))
        paths = ToolPaths(s[:T], path[:, :T], R_WE, q, self.seconds(genes))
        return roll_out_arm(self.world, self.q, paths, enough)

    def rollout(
        self, genes: FloatArray, guided: Obstacles | None
    ) -> tuple[ToolRollouts, ArmRollouts]:
        """Returns tool and arm along one candidate (7,), or the guided one, to its end."""
        known = None if guided else self._feasible.get(genes.tobytes())
        if known is not None:
            return known
        tool = self.tool_paths(genes[None], guided=guided)
        return tool, self.follow(genes[None], tool, np.full(1, -np.inf))

    def arm_cost(self, arms: ArmRollouts) -> FloatArray:
        """Returns the costs of a shortfall of the clearance, and of a path that is not followed."""
        L = self.scene.baseline
        short = np.maximum(-arms.least - self.parameters.slack, 0.0)
        lost = np.maximum(arms.error - MISSED, 0.0)
        fast = np.maximum(arms.hurry - 1.0, 0.0)
        bad = PRICE * (short + np.minimum(lost, FAR)) / L + fast
        return np.asarray(np.where(bad > 0.0, BAD + bad, 0.0))


_Rollouts = TypeVar("_Rollouts", ToolRollouts, "ArmRollouts")


def _row(rollouts: _Rollouts, row: int) -> _Rollouts:
    """Returns the roll-outs of one candidate."""
    values = {item.name: getattr(rollouts, item.name) for item in fields(rollouts)}
    rows: dict[str, Any] = {
        name: value[row : row + 1]
        for name, value in values.items()
        if isinstance(value, np.ndarray)
    }
    return replace(rollouts, **rows)


ERROR, HURRY, ENDED, WHEN = 3, 4, 5, 6
N_COLUMNS = 7
"""Of what a candidate comes to: after `TOOL`, `LINKS` and `SELF` of `arm_world`."""
_EACH = 8
"""Candidates for which another thread pays."""


class ToolPaths(NamedTuple):
    """N motions of the tool at T normalised times.

    Attributes:
        s: (T,) times, ascending; the first one is now.
        p_WE: (N, T, 3) positions [m]; NaN after the arrival of a motion.
        R_WE: (N, T, 9) orientations, row by row.
        posture: (N, T, n) postures to which the null space is attracted [rad].
        seconds: (N,) duration of a unit of s [s].
    """

    s: FloatArray
    p_WE: FloatArray
    R_WE: FloatArray
    posture: FloatArray
    seconds: FloatArray


@dataclass(frozen=True, eq=False)
class ArmRollouts(Frozen):
    """What N candidates come to.

    Attributes:
        excess: (N, 3) what the tool, the links, and all among each other keep beyond what is
            asked at least, at most `FAR` [m].
        error: (N,) by how much the arm misses the tool's pose at most [m, rad].
        hurry: (N,) greatest speed of a joint, in shares of what it can do.
        samples: (N,) how many samples were looked at; fewer than there are where it was enough.
        when: (N,) at which sample they keep least.
        q: (N, T, n) the joints [rad].
    """

    excess: FloatArray
    error: FloatArray
    hurry: FloatArray
    samples: IntArray
    when: IntArray
    q: FloatArray

    @property
    def least(self) -> FloatArray:
        """(N,) the least of `excess`."""
        return np.asarray(self.excess.min(axis=1))


def roll_out_arm(
    world: ArmWorld, q: FloatArray, paths: ToolPaths, enough: ArrayLike = -math.inf
) -> ArmRollouts:
    """Rolls out N candidates.

    Args:
        world: the arm among what.
        q: (n,) its joints now [rad].
        paths: the candidates.
        enough: () or (N,) one that keeps less than this beyond what is asked is not followed
            further [m].
    """
    N, T, _ = paths.p_WE.shape
    table, joints = np.empty((N, N_COLUMNS)), np.empty((N, T, len(q)))
    stop = np.array(np.broadcast_to(np.asarray(enough, dtype=float), (N,)))
    bundle = ToolPaths(*kernel_arrays(*paths))
    threads = min(CORES, N // _EACH + 1)
    on_cores(_roll_some, threads, *world, *kernel_arrays(q), bundle, stop, table, joints)
    samples, when = table[:, ENDED].astype(np.int64), table[:, WHEN].astype(np.int64)
    count(configurations=int(samples.sum()))
    return ArmRollouts(table[:, :3], table[:, ERROR], table[:, HURRY], samples, when, joints)


@parted
def _roll_some(
    part: int, parts: int, chain: Chain, spheres: Spheres, solids: Solids, asked: Asked,
    now: float, q0: FloatArray, paths: ToolPaths, enough: FloatArray, out: FloatArray,
    Q: FloatArray,
) -> None:  # fmt: skip
    """Rolls out candidates part, part + parts, ... into out (N, N_COLUMNS) and Q (N, T, n)."""
    T, n = Q.shape[1:]
    s, room, target = paths.s, scratch(n), np.empty(12)
    center = np.empty((len(spheres.group_joint), 3))
    for i in range(part, len(Q), parts):
        p, least, q = paths.p_WE[i], np.full(3, FAR), q0.copy()
        error, hurry, done, when, kept = 0.0, 0.0, 0, 0, FAR
        for row in range(T):
            if math.isnan(p[row, 0]):
                break
            target[:9], target[9:] = paths.R_WE[i, row], p[row]
            pull = 1.0 - math.exp(PULL * (s[row - 1] - s[row])) if row > 0 else 0.0
            missed = follow(q, target, paths.posture[i], row, pull, chain, room)
            Q[i, row] = q
            done = row + 1
            if row > 0:
                # The first sample is the present configuration.
                error = max(error, missed)
                dt = paths.seconds[i] * (s[row] - s[row - 1])
                for joint in range(n):
                    moved = abs(q[joint] - Q[i, row - 1, joint])
                    hurry = max(hurry, moved / (chain.speed[joint] * dt))
            t = now + paths.seconds[i] * (s[row] - s[0])
            lower_excess(room.X, t, spheres, solids, asked, center, least, enough[i])
            if min(least[0], min(least[1], least[2])) < kept:
                kept, when = min(least[0], min(least[1], least[2])), row
                if kept < enough[i]:
                    break
        for row in range(done, T):
            Q[i, row] = q
        out[i, :3], out[i, ERROR], out[i, HURRY], out[i, ENDED] = least, error, hurry, done
        out[i, WHEN] = when
