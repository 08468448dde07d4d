"""The local search for a motion that achieves the requested clearance: an evolution strategy.

Candidates are the nominal motion, the motion in use, the rows of the regressor chain together,
seeds, a moderate term on each side of the baseline, and variations of the best so far.
Each is rolled out by the integrator's kernel (`drake_oa.policy.rollout`) and followed among the
obstacles: by the whole arm (`ArmSearch`, `roll_out_arm`) or by a point
(`drake_oa.planning.point_search`). The random numbers of a round are the same for every scene and
call, so a scene gets the same motion whatever else is searched for.

A candidate is one avoidance term (eq. 8) that acts about a point on or beside the
baseline in the plane of the baseline and a side omega. Its genes, in which the search moves::

    angle of omega in the local YZ plane, place of the point along the baseline / L and
    aside of it toward omega / L (at most 0), ln kappa L^2, ln psi, ln alpha

Whole-arm roll-outs are compiled, and run on all cores. A candidate is a path of the tool point, an
orientation along it and a posture that its null space is drawn to. Its joints follow
(`drake_oa.robot.arm`); at each sample every sphere of the robot is measured against every solid,
which rests, and the other spheres (`drake_oa.planning.collision_model`), and the joints against their
limits and speeds.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline

from drake_oa.common.compiled import CORES, kernel_arrays, on_cores, parted
from drake_oa.common.latency import LatencyModel, count, counted
from drake_oa.common.messages import CouplingParameters, FloatArray, IntArray
from drake_oa.geometry.collision_scene import CollisionGeometries
from drake_oa.inference.config import Verified
from drake_oa.planning.collision_model import (
    FAR,
    ArmCollisionModel,
    ClearanceRequirements,
    lower_clearance_margins,
)
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA as ALPHA_COLUMN
from drake_oa.policy.coupling import KAPPA as KAPPA_COLUMN
from drake_oa.policy.coupling import N_COLUMNS, NORMAL
from drake_oa.policy.dmp import Dmp, trajectory
from drake_oa.policy.guidance import Obstacles
from drake_oa.policy.rollout import Scene, ToolRollouts, roll_out_tool
from drake_oa.robot.arm import PULL, Chain, Spheres, follow, scratch

N_PARAMS = 6
ANGLE, PLACE, ASIDE, KAPPA, PSI, ALPHA = range(N_PARAMS)
LOWER = np.array([-np.inf, 0.01, -0.3, math.log(0.1), math.log(0.15), math.log(0.1)])
UPPER = np.array([np.inf, 0.99, 0.0, math.log(3e3), math.log(5.0), 30.0])
STRIDE = np.array([0.4, 0.08, 0.03, 0.6, 0.25, 0.8])
"""Standard deviation of a full step of the search, gene by gene."""
ELITES = 8
SPACING = 0.6
"""Spacing of the strengths of a first candidate, in ln alpha."""
_CLOSER = 0.4
"""Ratio of the spacings of two successive rounds."""
_CLOSEST = 0.02
"""Minimum spacing, in ln alpha."""
NO_SIDE_COST = np.zeros(1)
SAMPLES = 64
"""Number of samples of a motion from s = 0 to 1 at which the arm is placed: 3 cm apart at most on a
path of 1 m."""
DEEP = 0.06
"""Shortfall of a candidate beyond which a larger one makes no difference [m]."""
_CYCLE = 24
"""Number of rounds after which the candidates vary as in the first round: far and wide."""
_COSTS = LatencyModel()
"""Cost of the work of a search; the decision does not depend on a scenario's `compute_latency`."""
MAX_POSE_ERROR = 2e-3
"""Largest error of the tool's pose with which the arm follows a path [m, rad]."""
MAX_GOAL_ERROR = 0.02
"""Distance from the goal beyond which the end of a motion is no arrival, in baselines."""
INFEASIBLE_PENALTY = 10.0
"""Additional cost of a motion that does not achieve the clearance or does not arrive."""
CLEARANCE_WEIGHT = 100.0
"""Cost of a shortfall of the clearance by the length of the baseline."""
_GOAL_PRICE, _MISS = 30.0, 2.0
"""Costs of an end that is a baseline away from the goal, and of any end beyond the tolerance."""
_LATE = 0.05
"""Cost of a unit of normalized time after s = 1."""
_LINE, _LEAST = 0.2, 5
"""Share of the candidates of a round, and least number, that differ from the best in alpha only."""
_FIRST_FRESH = 6
"""First round with random candidates."""
NOMINAL_PARAMS = np.where(np.arange(N_PARAMS) == ALPHA, -np.inf, 0.0)[None]
"""(1, 6) genes of the nominal motion."""
NO_ELITES = np.zeros((0, N_PARAMS))
"""Elites of a search that continues none, and genes if no motion is in use."""
SOURCES = ("nominal", "chain", "search", "joint_path")
"""Sources of a motion: the nominal motion, the rows of the paper's chain together, the local
search, and a path in the joints."""
NOMINAL, CHAIN, SEARCH, JOINT_PATH = range(len(SOURCES))
_EVEN = np.tile(
    [
        [0.0, 0.25, -0.05, 3.5, -0.3, 7.0],
        [0.0, 0.5, -0.05, 2.5, 0.0, 5.5],
        [0.0, 0.75, -0.05, 3.5, -0.3, 7.0],
    ],
    (6, 1),
)[:16]
_EVEN[:, ANGLE] = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
"""(16, 6) first candidates: a moderate term on every side, in turn near the start, the middle and
the goal."""


def avoidance_terms(scene: Scene, params: FloatArray) -> FloatArray:
    """Returns the coupling terms (N, 13) of candidates (N, 6) in a scene, see `turn_step`."""
    x, y, z = scene.R_WL.T
    cos, sin = np.cos(params[:, ANGLE, None]), np.sin(params[:, ANGLE, None])
    omega = cos * y + sin * z
    along = (params[:, PLACE, None] - 1.0) * x + params[:, ASIDE, None] * omega
    terms = np.zeros((len(params), N_COLUMNS))
    # The baseline ends at the goal, and begins L before it.
    terms[:, :3] = scene.p_WG + scene.baseline * along
    # x_L x omega: a turn about it goes from the baseline to the side.
    terms[:, NORMAL : NORMAL + 3] = cos * z - sin * y
    terms[:, ALPHA_COLUMN : KAPPA_COLUMN + 1] = np.exp(params[:, [ALPHA, PSI, KAPPA]])
    terms[:, KAPPA_COLUMN] /= scene.baseline**2
    return terms


def params_of(
    scene: Scene, p_WP: FloatArray, normal_W: FloatArray, strength: FloatArray
) -> FloatArray:
    """Returns the candidates (N, 6) of coupling terms: the inverse of `avoidance_terms`.

    Args:
        scene: the scene.
        p_WP: (N, 3) points about which the terms act [m]; the part that is not in the plane of the
            normal and the baseline is lost.
        normal_W: (N, 3) normals of their planes.
        strength: (N, 3) rows of alpha, psi, kappa.
    """
    x, y, z = scene.R_WL.T
    along = (p_WP - scene.p_WG) / scene.baseline
    params = np.zeros((len(p_WP), N_PARAMS))
    params[:, ANGLE] = np.arctan2(-normal_W @ y, normal_W @ z)
    omega = np.cos(params[:, ANGLE, None]) * y + np.sin(params[:, ANGLE, None]) * z
    params[:, PLACE], params[:, ASIDE] = 1.0 + along @ x, (along * omega).sum(axis=1)
    strength = strength * [1.0, 1.0, scene.baseline**2]
    params[:, [ALPHA, PSI, KAPPA]] = np.log(np.maximum(strength, 1e-300))
    return params


def rows_of(terms: FloatArray) -> CouplingParameters:
    """Returns the rows of coupling terms (M, 13), see `turn_step`."""
    alpha, psi, kappa = np.ascontiguousarray(terms[:, ALPHA_COLUMN : KAPPA_COLUMN + 1].T)
    return CouplingParameters(
        alpha,
        psi,
        kappa,
        center_W=terms[:, :3],
        normal_W=terms[:, NORMAL : NORMAL + 3],
    )


def strengths(params: FloatArray, kept: bool, spacing: float, count: int) -> FloatArray:
    """Returns candidates (count, 6) that differ from one (6,) in alpha only.

    The least alpha that keeps the clearance gives the shortest path: they are weaker, as far as
    the next weaker one that may not keep it, if the candidate keeps it, else stronger.
    """
    share = np.arange(1, count + 1) / (count + 1)
    line = np.repeat(params[None], count, axis=0)
    line[:, ALPHA] += spacing * (share - 1.0 if kept else 2.5 * share)
    return line


class Ranked(NamedTuple):
    """Candidates, the best first.

    Attributes:
        params: (n, 6) genes; those of the nominal motion where the source is `CHAIN`.
        cost: (n,) costs.
        length: (n,) path lengths [m].
        source: (n,) rows of `SOURCES`.
    """

    params: FloatArray
    cost: FloatArray
    length: FloatArray
    source: IntArray

    @property
    def solved(self) -> bool:
        """Whether the best achieves the clearance and arrives."""
        return bool(self.cost[0] < INFEASIBLE_PENALTY)

    def joined(self, *others: Ranked, count: int = 1) -> Ranked:
        """Returns the best of these and of others, at most `count`."""
        columns = [np.concatenate(column) for column in zip(self, *others, strict=True)]
        order = np.argsort(columns[1], kind="stable")[:count]
        return Ranked(*(column[order] for column in columns))


class Search(ABC):
    """Search in one scene; the obstacles are the subclass's.

    Attributes:
        counts: (4,) numbers of candidates that were rolled out, by source.
        elites: (k, 6) genes of the best candidates of the last round.
        generations: number of rounds, those of earlier searches included.
    """

    every = 1
    """Number of steps between the samples of the tool's paths."""

    def __init__(
        self,
        scene: Scene,
        *,
        dmp: Dmp,
        policy: Policy,
        parameters: Verified,
        previous: FloatArray = NO_ELITES,
        side_cost: FloatArray = NO_SIDE_COST,
        elites: FloatArray = NO_ELITES,
        generations: int = 0,
        most: float = math.inf,
    ) -> None:
        """Stores the problem.

        Args:
            scene: the motion under way.
            dmp: the movement primitive.
            policy: time step and fade of the action level.
            parameters: effort and tolerances.
            previous: (1, 6) genes of the motion in use; (0, 6): none is.
            side_cost: (K,) additional costs of K evenly spread sides, in baselines; inf: no motion
                passes there.
            elites: (k, 6) best candidates of an earlier search that this one continues.
            generations: number of rounds of that.
            most: largest cost by `compute_latency`, beyond which no round begins [s].
        """
        self.scene, self.dmp, self.policy, self.parameters = scene, dmp, policy, parameters
        self.previous, self.side_cost, self.most = previous, side_cost, most
        self.elites, self.generations = elites, generations
        self.ds = policy.period / dmp.duration
        self.counts = np.zeros(len(SOURCES), dtype=np.int64)
        self._spent = self._latest = 0.0

    @abstractmethod
    def world_cost(
        self, params: FloatArray, tool: ToolRollouts, cost: FloatArray, worst: float
    ) -> FloatArray:
        """Returns the costs (n,) of the clearance along the paths of the tool.

        Args:
            params: (n, 6) the candidates.
            tool: their paths.
            cost: (n,) their costs so far.
            worst: cost beyond which a candidate is not among the best.
        """

    def run(
        self,
        *,
        guided: Obstacles | None = None,
        seeds: FloatArray = NO_ELITES,
        source: int = SEARCH,
    ) -> Ranked:
        """Searches.

        Args:
            guided: candidate by the rows of the paper's chain: the obstacles with their terms, past
                which guidance leads.
            seeds: (n, 6) first candidates; a moderate term on every side follows them.
            source: of the motion in use.

        Returns:
            The best candidate, alone. Nothing is shorter than the nominal motion: where that is
            feasible, nothing else is evaluated, nor where the motion in use is.
        """
        best = self.evaluate(NOMINAL_PARAMS, NOMINAL)
        if not best.solved and len(self.previous):
            best = best.joined(self.evaluate(self.previous, source))
        if best.solved:
            return best
        if guided is not None:
            chain = self.evaluate(NOMINAL_PARAMS, CHAIN, float(best.cost[0]), guided)
            best = best.joined(chain)
        worst = float(best.cost[0]) if best.solved else math.inf
        ranked = self.evaluate(self.first(seeds), SEARCH, worst).joined(count=ELITES)
        best, since = best.joined(ranked), 0
        for _ in range(self.parameters.generations):
            since += best.solved
            if (
                since > self.parameters.refinement_generations
                or self._spent + self._latest > self.most
            ):
                break
            trial = self.children(ranked)
            found = self.evaluate(trial, SEARCH, float(ranked.cost[-1]))
            ranked = ranked.joined(found, count=ELITES)
            best = best.joined(ranked)
        self.elites = ranked.params
        return best

    def evaluate(
        self,
        params: FloatArray,
        source: int,
        worst: float = math.inf,
        guided: Obstacles | None = None,
    ) -> Ranked:
        """Rolls out candidates (n, 6) of a source, or the guided one.

        Those of a cost above the worst are rolled out only in part.
        """
        longest = worst * self.scene.baseline if worst < INFEASIBLE_PENALTY else math.inf
        with counted() as work:
            tool = self.tool_paths(params, longest, guided)
            cost = self.tool_cost(params, tool)
            cost = cost + self.world_cost(params, tool, cost, worst)
        self._latest = _COSTS.seconds(work) - _COSTS.decision
        self._spent += self._latest
        self.counts[source] += len(params)
        return Ranked(params, cost, tool.path_length, np.full(len(params), source))

    def tool_paths(
        self, params: FloatArray, longest: float = math.inf, guided: Obstacles | None = None
    ) -> ToolRollouts:
        """Rolls out the tool along candidates (n, 6), or the guided one."""
        if guided is None:
            terms, obstacles = avoidance_terms(self.scene, params)[:, None], None
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

    def tool_cost(self, params: FloatArray, tool: ToolRollouts) -> FloatArray:
        """Returns length over L, and small prices; above `INFEASIBLE_PENALTY` where the motion does not arrive."""
        L = self.scene.baseline
        missed = np.maximum(np.minimum(tool.goal_error, L) - self.parameters.tolerance, 0.0)
        bad = _GOAL_PRICE * missed / L + _MISS * (missed > 0.0)
        count = len(self.side_cost)
        side = np.rint(params[:, ANGLE] * count / (2.0 * np.pi)).astype(int) % count
        side_cost = np.where(params[:, ALPHA] > -np.inf, self.side_cost[side], 0.0)
        late = np.maximum(tool.steps * self.ds + self.scene.s - 1.0, 0.0)
        small = _LATE * late + side_cost
        return np.asarray(
            np.where(bad > 0.0, INFEASIBLE_PENALTY + bad, 0.0) + tool.path_length / L + small
        )

    def first(self, seeds: FloatArray) -> FloatArray:
        """Returns the first candidates (n, 6).

        Those are the best of the earlier search, if there was one. Otherwise the seeds and a
        moderate term on every side; in place of the last of them the motion in use, also with
        larger strengths.
        """
        if len(self.elites):
            return self.bounded(self.elites)
        count, others = self.parameters.candidates, NO_ELITES
        if len(self.previous):
            stronger = strengths(self.previous[0], False, SPACING, count // 8)
            others = np.vstack([self.previous, stronger])
        seeds = np.concatenate([seeds, _EVEN])[: count - len(others)]
        return self.bounded(np.concatenate([seeds, others]))

    def children(self, ranked: Ranked) -> FloatArray:
        """Returns the candidates of a round, (n, 6)."""
        count = self.parameters.candidates
        number, self.generations = self.generations % _CYCLE, self.generations + 1
        random, params = np.random.default_rng((number, count)), ranked.params
        size = max(round(_LINE * count), _LEAST)
        spacing = max(SPACING * _CLOSER**number, _CLOSEST)
        line = strengths(params[0], ranked.solved, spacing, size)
        scale = np.exp(random.uniform(-2.5, 0.0, (count, 1)))
        first, second = random.integers(0, ELITES, (2, count)) % len(params)
        mixing = 0.5 * (random.uniform(size=(count, 1)) < 0.5)
        kin = params[np.arange(count) % len(params)]
        kin = kin + STRIDE * scale * random.standard_normal(kin.shape)
        kin += mixing * np.nan_to_num(params[first] - params[second])
        trial = np.concatenate([line, kin[: count - size]])
        if number >= _FIRST_FRESH and not ranked.solved:
            low, high = np.nan_to_num(LOWER, neginf=0.0), np.nan_to_num(UPPER, posinf=2.0 * np.pi)
            # A quarter of them.
            trial[-(count // 4) :] = random.uniform(low, high, (count // 4, N_PARAMS))
        return self.bounded(trial)

    def bounded(self, params: FloatArray) -> FloatArray:
        """Returns genes (n, 6) moved into their ranges."""
        return np.clip(params, LOWER, UPPER)


def references(s: FloatArray, R_WE: FloatArray, q: FloatArray) -> BSpline:
    """Interpolates references of the arm along its tool's path over normalized time, 9 + n columns.

    Between rows that are a degree apart the chord of two rotations turns as they do, and
    `arm.pose_error` takes only its turn: it need not be made orthonormal.

    Args:
        s: (T,) times from 0 to 1.
        R_WE: (T, 3, 3) orientations of the tool.
        q: (T, n) postures to which the null space is attracted [rad].
    """
    return make_interp_spline(s, np.hstack([np.reshape(R_WE, (len(s), 9)), q]), k=1)


@lru_cache(maxsize=4)
def _length(dmp: Dmp) -> float:
    """Computes the length of the motion that a primitive makes of a baseline of 1."""
    plan = trajectory(dmp, np.zeros(3), np.array([1.0, 0.0, 0.0])).p
    return float(np.linalg.norm(np.diff(plan, axis=0), axis=1).sum())


class ArmSearch(Search):
    """Search for the motion of a whole arm among solids."""

    def __init__(
        self,
        scene: Scene,
        world: ArmCollisionModel,
        q: FloatArray,
        reference: BSpline,
        *,
        samples: int = SAMPLES,
        **more: Any,
    ) -> None:
        """Stores the problem.

        Args:
            world: the arm among the solids.
            q: (n,) its joints [rad].
            reference: orientations and postures along the path, see `references`.
            samples: number of samples from s = 0 to 1 at which the arm is placed.
            scene, more: arguments of `Search`.
        """
        super().__init__(scene, **more)
        self.world, self.q, self.reference = world, q, reference
        self.every = max(round(1.0 / (self.ds * samples)), 1)
        self.planned_length = _length(self.dmp) * scene.baseline

    def world_cost(
        self, params: FloatArray, tool: ToolRollouts, cost: FloatArray, worst: float
    ) -> FloatArray:
        """Returns the costs of the whole arm's clearance, and of a path that is not followed."""
        L, slack = self.scene.baseline, self.parameters.slack
        deep = slack if worst < INFEASIBLE_PENALTY else DEEP
        arms = self.follow(params, tool, np.where(cost < worst, -deep, np.inf))
        short = np.maximum(-arms.least - slack, 0.0)
        lost = np.maximum(arms.error - MAX_POSE_ERROR, 0.0)
        fast = np.maximum(arms.max_joint_speed_ratio - 1.0, 0.0)
        bad = CLEARANCE_WEIGHT * (short + np.minimum(lost, FAR)) / L + fast
        return np.asarray(np.where((bad > 0.0) | (cost >= worst), INFEASIBLE_PENALTY + bad, 0.0))

    def sample_times(self, count: int) -> FloatArray:
        """Returns normalized times (count,) of the samples from now on."""
        return np.asarray(self.scene.s + self.every * self.ds * np.arange(count))

    def follow(self, params: FloatArray, tool: ToolRollouts, enough: ArrayLike) -> ArmRollouts:
        """Lets the arm follow the tool, placed at the samples of its path."""
        T = max(int(np.isfinite(tool.path[:, :, 0]).sum(axis=1).max(initial=1)), 2)
        s = self.sample_times(T)
        led = np.tile(self.reference(np.clip(s, 0.0, 1.0)), (len(params), 1, 1))
        paths = ToolPaths(s, tool.path[:, :T], led[..., :9], led[..., 9:], self.dmp.duration)
        return roll_out_arm(self.world, self.q, paths, enough)


ERROR, TIME_SCALING_WEIGHT, ENDED = 3, 4, 5
_N_RESULTS = 6
"""Columns of the results of candidates, after `TOOL`, `LINKS` and `SELF` of `collision_model`."""
_EACH = 8
"""Candidates for which another thread pays."""


class ToolPaths(NamedTuple):
    """N motions of the tool at T normalized times.

    Attributes:
        s: (T,) times, ascending; the first one is now.
        p_WE: (N, T, 3) positions [m]; NaN after the arrival of a motion.
        R_WE: (N, T, 9) orientations, row by row.
        posture: (N, T, n) postures to which the null space is attracted [rad].
        seconds: duration of a unit of s [s].
    """

    s: FloatArray
    p_WE: FloatArray
    R_WE: FloatArray
    posture: FloatArray
    seconds: float


class ArmRollouts(NamedTuple):
    """Results of the roll-outs of N candidates.

    Attributes:
        clearance_margin: (N, 3) least distances of the tool, the links, and all among each other beyond the
            requested ones, at most `FAR` [m].
        error: (N,) largest error of the tool's pose [m, rad].
        max_joint_speed_ratio: (N,) greatest speed of a joint, over its limit.
        samples: (N,) number of checked samples; not all where it was enough.
        q: (N, T, n) the joints [rad].
    """

    clearance_margin: FloatArray
    error: FloatArray
    max_joint_speed_ratio: FloatArray
    samples: IntArray
    q: FloatArray

    @property
    def least(self) -> FloatArray:
        """(N,) the least of `clearance_margin`."""
        return np.asarray(self.clearance_margin.min(axis=1))


def roll_out_arm(
    world: ArmCollisionModel, q: FloatArray, paths: ToolPaths, enough: ArrayLike = -math.inf
) -> ArmRollouts:
    """Rolls out N candidates.

    Args:
        world: the arm among the solids.
        q: (n,) its joints now [rad].
        paths: the candidates.
        enough: () or (N,) clearance_margin below which a candidate is not followed further [m].
    """
    N, T, _ = paths.p_WE.shape
    table, joints = np.empty((N, _N_RESULTS)), np.empty((N, T, len(q)))
    stop = np.array(np.broadcast_to(np.asarray(enough, dtype=float), (N,)))
    s, p_WE, R_WE, posture = kernel_arrays(*paths[:4])
    bundle = ToolPaths(s, p_WE, R_WE, posture, float(paths.seconds))
    threads = min(CORES, N // _EACH + 1)
    on_cores(_roll_some, threads, *world, *kernel_arrays(q), bundle, stop, table, joints)
    samples = table[:, ENDED].astype(np.int64)
    count(configurations=int(samples.sum()))
    return ArmRollouts(
        table[:, :3], table[:, ERROR], table[:, TIME_SCALING_WEIGHT], samples, joints
    )


@parted
def _roll_some(
    part: int, parts: int, chain: Chain, spheres: Spheres, geometries: CollisionGeometries, required: ClearanceRequirements,
    now: float, q0: FloatArray, paths: ToolPaths, enough: FloatArray, out: FloatArray,
    Q: FloatArray,
) -> None:  # fmt: skip
    """Rolls out candidates part, part + parts, ... into out (N, 6) and Q (N, T, n)."""
    T, n = Q.shape[1:]
    s, room, target = paths.s, scratch(n), np.empty(12)
    center = np.empty((len(spheres.group_joint), 3))
    for i in range(part, len(Q), parts):
        p, least, q = paths.p_WE[i], np.full(3, FAR), q0.copy()
        error, max_joint_speed_ratio, done = 0.0, 0.0, 0
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
                dt = paths.seconds * (s[row] - s[row - 1])
                for joint in range(n):
                    moved = abs(q[joint] - Q[i, row - 1, joint])
                    max_joint_speed_ratio = max(
                        max_joint_speed_ratio, moved / (chain.speed[joint] * dt)
                    )
            lower_clearance_margins(
                room.X, now, spheres, geometries, required, center, least, enough[i]
            )
            if min(least[0], min(least[1], least[2])) < enough[i]:
                break
        for row in range(done, T):
            Q[i, row] = q
        out[i, :3], out[i, ERROR], out[i, TIME_SCALING_WEIGHT], out[i, ENDED] = (
            least,
            error,
            max_joint_speed_ratio,
            done,
        )
