"""Local search for a motion that achieves the requested clearance: an evolution strategy.

A candidate is one avoidance term (eq. 8) about a point in the plane of the baseline and a side
direction omega. Its parameters `params` (6,), here and in all modules that use this search, are::

    angle of omega in the local YZ plane, position of the point along the baseline / L,
    offset from the baseline toward omega / L (at most 0), ln kappa L^2, ln psi, ln alpha

The baseline, of length L, connects start and goal. Every candidate is rolled out by the kernel of
the integrator (`drake_oa.policy.rollout`), and then evaluated for the whole arm (`ArmSearch`) or
for a point (`drake_oa.planning.point_search`). The cost to be minimized is

    J = l / L + w_late max(s_end - 1, 0) + c_side
        + [e > 0] (w_inf + w_miss + w_goal e / L)
        + [sigma + eps + r > 0] (w_inf + w_clear (sigma + eps) / L + r)

with path length l, normalized time of arrival s_end, cost of the side c_side, goal error e,
clearance shortfall sigma, pose error eps, and excess r of the joint speed over its limit; each
error beyond its tolerance. A candidate with J < w_inf is feasible. The evolution strategy::

    ranking = best 8 of the seeds and a moderate term on each of 16 sides
    for each generation, at most refinement_generations after the first feasible candidate:
        line    = best candidate with smaller ln alpha if it is feasible, else with larger ln alpha
        mutants = ranking + STEP_SIZES * scale * N(0, I) + {0, 1/2} * difference of two of ranking
        if none is feasible, from generation 6 on: a quarter of the mutants is uniform in the bounds
        ranking = best 8 of ranking, line and mutants

The random numbers of a generation are the same for every scene and call, so that the result for a
scene does not depend on earlier searches.

Whole-arm roll-outs are compiled, and run on all cores. The arm follows the tool's path, an
orientation and a nominal posture by differential inverse kinematics (`drake_oa.robot.arm`). At each
sample, the distances of every robot sphere to all collision geometries, which are at rest, and to
the other links are computed (`drake_oa.planning.collision_model`), and joint limits and speeds are
checked.
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
"""Number of parameters of a candidate."""
ANGLE, ALONG, LATERAL, KAPPA, PSI, ALPHA = range(N_PARAMS)
LOWER = np.array([-np.inf, 0.01, -0.3, math.log(0.1), math.log(0.15), math.log(0.1)])
"""(6,) lower bounds of the candidate parameters."""
UPPER = np.array([np.inf, 0.99, 0.0, math.log(3e3), math.log(5.0), 30.0])
"""(6,) upper bounds of the candidate parameters."""
STEP_SIZES = np.array([0.4, 0.08, 0.03, 0.6, 0.25, 0.8])
"""(6,) standard deviations of the largest mutation of the candidate parameters."""
N_ELITES = 8
"""Number of best candidates that are varied in the next generation."""
INITIAL_SPACING = 0.6
"""Spacing in ln alpha of candidates on a line in the first generation."""
_SPACING_RATIO = 0.4
"""Ratio of the line spacings of two successive generations."""
_MIN_SPACING = 0.02
"""Minimum spacing in ln alpha of candidates on a line."""
NO_SIDE_COST = np.zeros(1)
"""(1,) side cost 0, the same for all sides."""
SAMPLES = 64
"""Number of samples of a whole-arm roll-out from s = 0 to 1, at most 3 cm apart on a 1 m path."""
ABORT_SHORTFALL = 0.06
"""Clearance shortfall beyond which the roll-out of a candidate is aborted [m]."""
_CYCLE_LENGTH = 24
"""Number of generations after which spacing and random numbers restart with those of the first."""
_LATENCY_MODEL = LatencyModel()
"""Model of the search's compute latency, independent of a scenario's `compute_latency`."""
MAX_POSE_ERROR = 2e-3
"""Maximum error of the tool pose with which the arm follows a path [m, rad]."""
MAX_GOAL_ERROR = 0.02
"""Maximum distance of the end of a motion from the goal, as a fraction of the baseline."""
INFEASIBLE_PENALTY = 10.0
"""Cost w_inf of an infeasible candidate: clearance shortfall or goal error beyond tolerance."""
CLEARANCE_WEIGHT = 100.0
"""Cost w_clear of a clearance shortfall, per shortfall over baseline."""
_GOAL_ERROR_WEIGHT = 30.0
"""Cost w_goal of a goal error, per goal error over baseline."""
_GOAL_MISS_PENALTY = 2.0
"""Cost w_miss of any goal error beyond the tolerance."""
_LATENESS_WEIGHT = 0.05
"""Cost w_late of an arrival after s = 1, per normalized time."""
_LINE_FRACTION = 0.2
"""Fraction of the candidates of a generation that differ from the best in alpha only."""
_MIN_LINE_COUNT = 5
"""Minimum number of candidates of a generation that differ from the best in alpha only."""
_FIRST_RANDOM_GENERATION = 6
"""First generation with uniformly random candidates, if none is feasible."""
NOMINAL_PARAMS = np.where(np.arange(N_PARAMS) == ALPHA, -np.inf, 0.0)[None]
"""(1, 6) candidate parameters of the nominal motion, with alpha = 0."""
NO_ELITES = np.zeros((0, N_PARAMS))
"""(0, 6) empty set of candidate parameters."""
SOURCES = ("nominal", "chain", "search", "joint_path")
"""Sources of a motion: nominal motion, all rows of the paper's regressor chain together, evolution
strategy, joint-space path."""
NOMINAL, CHAIN, SEARCH, JOINT_PATH = range(len(SOURCES))
_SIDE_SEEDS = np.tile([0.0, 0.5, -0.05, 1.0, 0.3, 4.0], (16, 1))
_SIDE_SEEDS[:, ANGLE] = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
"""(16, 6) candidate parameters of a moderate term on each of 16 sides of the baseline."""


def avoidance_terms(scene: Scene, params: FloatArray) -> FloatArray:
    """Returns the coupling terms (N, 13), see `turn_step`, of candidate parameters (N, 6)."""
    x, y, z = scene.R_WL.T
    cos, sin = np.cos(params[:, ANGLE, None]), np.sin(params[:, ANGLE, None])
    omega = cos * y + sin * z
    along = (params[:, ALONG, None] - 1.0) * x + params[:, LATERAL, None] * omega
    terms = np.zeros((len(params), N_COLUMNS))
    # The baseline ends at the goal, and begins L before it.
    terms[:, :3] = scene.p_WG + scene.baseline * along
    # x_L x omega: a rotation about this normal turns the baseline toward the side.
    terms[:, NORMAL : NORMAL + 3] = cos * z - sin * y
    terms[:, ALPHA_COLUMN : KAPPA_COLUMN + 1] = np.exp(params[:, [ALPHA, PSI, KAPPA]])
    terms[:, KAPPA_COLUMN] /= scene.baseline**2
    return terms


def params_of(
    scene: Scene, p_WP: FloatArray, normal_W: FloatArray, strength: FloatArray
) -> FloatArray:
    """Returns the candidate parameters (N, 6) of coupling terms: the inverse of `avoidance_terms`.

    Args:
        scene: start, goal and local frame of the motion.
        p_WP: (N, 3) points about which the terms act [m]; components outside the plane of the
            baseline and the side are ignored.
        normal_W: (N, 3) normals of the planes in which the terms turn the motion.
        strength: (N, 3) rows of alpha, psi, kappa.
    """
    x, y, z = scene.R_WL.T
    along = (p_WP - scene.p_WG) / scene.baseline
    params = np.zeros((len(p_WP), N_PARAMS))
    params[:, ANGLE] = np.arctan2(-normal_W @ y, normal_W @ z)
    omega = np.cos(params[:, ANGLE, None]) * y + np.sin(params[:, ANGLE, None]) * z
    params[:, ALONG], params[:, LATERAL] = 1.0 + along @ x, (along * omega).sum(axis=1)
    strength = strength * [1.0, 1.0, scene.baseline**2]
    params[:, [ALPHA, PSI, KAPPA]] = np.log(np.maximum(strength, 1e-300))
    return params


def rows_of(terms: FloatArray) -> CouplingParameters:
    """Converts coupling terms (M, 13), see `turn_step`, to coupling parameters."""
    alpha, psi, kappa = np.ascontiguousarray(terms[:, ALPHA_COLUMN : KAPPA_COLUMN + 1].T)
    return CouplingParameters(
        alpha,
        psi,
        kappa,
        center_W=terms[:, :3],
        normal_W=terms[:, NORMAL : NORMAL + 3],
    )


def strengths(params: FloatArray, is_feasible: bool, spacing: float, count: int) -> FloatArray:
    """Returns candidate parameters (count, 6) that differ from `params` (6,) in alpha only.

    The smallest alpha that achieves the clearance gives the shortest path. Hence alpha is smaller
    than that of a feasible candidate, by less than the spacing, and larger otherwise.

    Args:
        params: (6,) parameters of the candidate.
        is_feasible: whether the candidate is feasible.
        spacing: distance in ln alpha to the next evaluated candidate.
        count: number of candidates.
    """
    fraction = np.arange(1, count + 1) / (count + 1)
    line = np.repeat(params[None], count, axis=0)
    line[:, ALPHA] += spacing * (fraction - 1.0 if is_feasible else 2.5 * fraction)
    return line


class Ranking(NamedTuple):
    """Evaluated candidates, in ascending order of cost.

    Attributes:
        params: (n, 6) candidate parameters; `NOMINAL_PARAMS` where the source is `CHAIN`.
        cost: (n,) costs J.
        length: (n,) path lengths [m].
        source: (n,) rows of `SOURCES`.
    """

    params: FloatArray
    cost: FloatArray
    length: FloatArray
    source: IntArray

    @property
    def is_feasible(self) -> bool:
        """Whether the best candidate achieves the requested clearance and the goal."""
        return bool(self.cost[0] < INFEASIBLE_PENALTY)

    def merge(self, *rankings: Ranking, count: int = 1) -> Ranking:
        """Returns the `count` best candidates of this and other rankings."""
        columns = [np.concatenate(column) for column in zip(self, *rankings, strict=True)]
        order = np.argsort(columns[1], kind="stable")[:count]
        return Ranking(*(column[order] for column in columns))


class Search(ABC):
    """Evolution strategy in one scene; a subclass defines the obstacles.

    Attributes:
        counts: (4,) numbers of rolled-out candidates, by source.
        elites: (k, 6) parameters of the best candidates of the last generation.
        generations: number of generations, including those of earlier searches.
    """

    every = 1
    """Number of integration steps between two samples of a tool path."""

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
        max_latency: float = math.inf,
    ) -> None:
        """Stores the problem.

        Args:
            scene: state, goal and obstacles of the motion.
            dmp: movement primitive.
            policy: configuration of the action level: time step, fade.
            parameters: numbers of candidates and generations, tolerances.
            previous: (1, 6) candidate parameters of the current motion; (0, 6): no term.
            side_cost: (K,) additional costs J of K evenly spaced sides; inf: forbidden side.
            elites: (k, 6) warm start: best candidates of an earlier search.
            generations: number of generations of the earlier search.
            max_latency: modeled compute latency beyond which no generation starts [s].
        """
        self.scene, self.dmp, self.policy, self.parameters = scene, dmp, policy, parameters
        self.previous, self.side_cost, self.max_latency = previous, side_cost, max_latency
        self.elites, self.generations = elites, generations
        self.ds = policy.period / dmp.duration
        self.counts = np.zeros(len(SOURCES), dtype=np.int64)
        self._total_latency = self._last_latency = 0.0

    @abstractmethod
    def clearance_cost(
        self, params: FloatArray, tool: ToolRollouts, cost: FloatArray, max_cost: float
    ) -> FloatArray:
        """Computes the costs (n,) of clearance shortfalls along the tool paths of candidates.

        Args:
            params: (n, 6) candidate parameters.
            tool: roll-outs of the tool.
            cost: (n,) other costs of the candidates.
            max_cost: cost beyond which a candidate is not ranked.
        """

    def run(
        self,
        *,
        guides: Obstacles | None = None,
        seeds: FloatArray = NO_ELITES,
        source: int = SEARCH,
    ) -> Ranking:
        """Searches for the candidate of least cost.

        The nominal motion is the shortest: if it or the current motion is feasible, no other
        candidate is evaluated.

        Args:
            guides: obstacles with the terms of the regressor chain, for the candidate with heading
                guidance; None: no such candidate.
            seeds: (n, 6) first candidates, before the moderate terms on every side.
            source: row of `SOURCES` of the current motion.

        Returns:
            The best candidate, as a ranking of one.
        """
        best = self.evaluate(NOMINAL_PARAMS, NOMINAL)
        if not best.is_feasible and len(self.previous):
            best = best.merge(self.evaluate(self.previous, source))
        if best.is_feasible:
            return best
        if guides is not None:
            chain = self.evaluate(NOMINAL_PARAMS, CHAIN, float(best.cost[0]), guides)
            best = best.merge(chain)
        max_cost = float(best.cost[0]) if best.is_feasible else math.inf
        elites = self.evaluate(self.first_candidates(seeds), SEARCH, max_cost).merge(count=N_ELITES)
        best, feasible_generations = best.merge(elites), 0
        for _ in range(self.parameters.generations):
            feasible_generations += best.is_feasible
            if (
                feasible_generations > self.parameters.refinement_generations
                or self._total_latency + self._last_latency > self.max_latency
            ):
                break
            candidates = self.next_candidates(elites)
            ranking = self.evaluate(candidates, SEARCH, float(elites.cost[-1]))
            elites = elites.merge(ranking, count=N_ELITES)
            best = best.merge(elites)
        self.elites = elites.params
        return best

    def evaluate(
        self,
        params: FloatArray,
        source: int,
        max_cost: float = math.inf,
        guides: Obstacles | None = None,
    ) -> Ranking:
        """Rolls out candidates and computes their costs.

        Args:
            params: (n, 6) candidate parameters.
            source: row of `SOURCES`.
            max_cost: cost beyond which the roll-out of a candidate is aborted.
            guides: obstacles and terms of the candidate with heading guidance, in place of params.
        """
        max_length = max_cost * self.scene.baseline if max_cost < INFEASIBLE_PENALTY else math.inf
        with counted() as work:
            tool = self.tool_paths(params, max_length, guides)
            cost = self.tool_cost(params, tool)
            cost = cost + self.clearance_cost(params, tool, cost, max_cost)
        self._last_latency = _LATENCY_MODEL.seconds(work) - _LATENCY_MODEL.decision
        self._total_latency += self._last_latency
        self.counts[source] += len(params)
        return Ranking(params, cost, tool.path_length, np.full(len(params), source))

    def tool_paths(
        self, params: FloatArray, max_length: float = math.inf, guides: Obstacles | None = None
    ) -> ToolRollouts:
        """Rolls out the tool for candidates (n, 6), or for the candidate with heading guidance."""
        if guides is None:
            terms, obstacles = avoidance_terms(self.scene, params)[:, None], None
        else:
            terms, obstacles = guides.terms[None], guides
        return roll_out_tool(
            self.scene,
            terms,
            dmp=self.dmp,
            policy=self.policy,
            tolerance=self.parameters.tolerance,
            longest=max_length,
            obstacles=obstacles,
            every=self.every,
        )

    def tool_cost(self, params: FloatArray, tool: ToolRollouts) -> FloatArray:
        """Computes the costs (n,) of length, side, lateness and goal error of candidates (n, 6)."""
        L = self.scene.baseline
        goal_error = np.maximum(np.minimum(tool.goal_error, L) - self.parameters.tolerance, 0.0)
        violation = _GOAL_ERROR_WEIGHT * goal_error / L + _GOAL_MISS_PENALTY * (goal_error > 0.0)
        count = len(self.side_cost)
        side = np.rint(params[:, ANGLE] * count / (2.0 * np.pi)).astype(int) % count
        side_cost = np.where(params[:, ALPHA] > -np.inf, self.side_cost[side], 0.0)
        lateness = np.maximum(tool.steps * self.ds + self.scene.s - 1.0, 0.0)
        extra = _LATENESS_WEIGHT * lateness + side_cost
        return np.asarray(
            np.where(violation > 0.0, INFEASIBLE_PENALTY + violation, 0.0)
            + tool.path_length / L
            + extra
        )

    def first_candidates(self, seeds: FloatArray) -> FloatArray:
        """Returns the candidates (n, 6) of the first generation.

        With a warm start they are its elites. Otherwise they are the seeds and a moderate term on
        every side; the current motion, also with larger alpha, replaces the last ones.
        """
        if len(self.elites):
            return self.clip(self.elites)
        count, previous = self.parameters.candidates, NO_ELITES
        if len(self.previous):
            stronger = strengths(self.previous[0], False, INITIAL_SPACING, count // 8)
            previous = np.vstack([self.previous, stronger])
        seeds = np.concatenate([seeds, _SIDE_SEEDS])[: count - len(previous)]
        return self.clip(np.concatenate([seeds, previous]))

    def next_candidates(self, ranked: Ranking) -> FloatArray:
        """Returns the candidates (n, 6) of the next generation, varied from a ranking."""
        count = self.parameters.candidates
        number, self.generations = self.generations % _CYCLE_LENGTH, self.generations + 1
        rng, params = np.random.default_rng((number, count)), ranked.params
        size = max(round(_LINE_FRACTION * count), _MIN_LINE_COUNT)
        spacing = max(INITIAL_SPACING * _SPACING_RATIO**number, _MIN_SPACING)
        line = strengths(params[0], ranked.is_feasible, spacing, size)
        scale = np.exp(rng.uniform(-2.5, 0.0, (count, 1)))
        first, second = rng.integers(0, N_ELITES, (2, count)) % len(params)
        mixing = 0.5 * (rng.uniform(size=(count, 1)) < 0.5)
        mutants = params[np.arange(count) % len(params)]
        mutants = mutants + STEP_SIZES * scale * rng.standard_normal(mutants.shape)
        mutants += mixing * np.nan_to_num(params[first] - params[second])
        candidates = np.concatenate([line, mutants[: count - size]])
        if number >= _FIRST_RANDOM_GENERATION and not ranked.is_feasible:
            low, high = np.nan_to_num(LOWER, neginf=0.0), np.nan_to_num(UPPER, posinf=2.0 * np.pi)
            # The last quarter of the candidates is uniform in the bounds.
            candidates[-(count // 4) :] = rng.uniform(low, high, (count // 4, N_PARAMS))
        return self.clip(candidates)

    def clip(self, params: FloatArray) -> FloatArray:
        """Returns candidate parameters (n, 6) clipped to their bounds."""
        return np.clip(params, LOWER, UPPER)


def references(s: FloatArray, R_WE: FloatArray, q: FloatArray) -> BSpline:
    """Interpolates tool orientation and nominal posture over normalized time, 9 + n columns.

    Interpolated rotation matrices are not orthonormal. With samples a degree apart the error is
    negligible, since `arm.pose_error` uses only the rotation angle.

    Args:
        s: (T,) normalized times from 0 to 1.
        R_WE: (T, 3, 3) orientations of the tool.
        q: (T, n) nominal postures of the null space [rad].
    """
    return make_interp_spline(s, np.hstack([np.reshape(R_WE, (len(s), 9)), q]), k=1)


@lru_cache(maxsize=4)
def _length(dmp: Dmp) -> float:
    """Computes the path length of a primitive's nominal motion over a baseline of 1 m [m]."""
    path = trajectory(dmp, np.zeros(3), np.array([1.0, 0.0, 0.0])).p
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


class ArmSearch(Search):
    """Evolution strategy for the motion of a whole arm among collision geometry."""

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
            world: collision model of the arm, with the required clearances.
            q: (n,) current configuration [rad].
            reference: orientation and nominal posture over normalized time, see `references`.
            samples: number of samples of a whole-arm roll-out from s = 0 to 1.
            scene, more: arguments of `Search`.
        """
        super().__init__(scene, **more)
        self.world, self.q, self.reference = world, q, reference
        self.every = max(round(1.0 / (self.ds * samples)), 1)
        self.planned_length = _length(self.dmp) * scene.baseline

    def clearance_cost(
        self, params: FloatArray, tool: ToolRollouts, cost: FloatArray, max_cost: float
    ) -> FloatArray:
        """Computes the costs (n,) of clearance shortfall, pose error and joint speed excess."""
        L, slack = self.scene.baseline, self.parameters.slack
        abort_shortfall = slack if max_cost < INFEASIBLE_PENALTY else ABORT_SHORTFALL
        arms = self.follow(params, tool, np.where(cost < max_cost, -abort_shortfall, np.inf))
        shortfall = np.maximum(-arms.min_margin - slack, 0.0)
        pose_error = np.maximum(arms.error - MAX_POSE_ERROR, 0.0)
        speed_excess = np.maximum(arms.max_joint_speed_ratio - 1.0, 0.0)
        violation = CLEARANCE_WEIGHT * (shortfall + np.minimum(pose_error, FAR)) / L + speed_excess
        return np.asarray(
            np.where((violation > 0.0) | (cost >= max_cost), INFEASIBLE_PENALTY + violation, 0.0)
        )

    def sample_times(self, count: int) -> FloatArray:
        """Returns the normalized times (count,) of samples from the current time on."""
        return np.asarray(self.scene.s + self.every * self.ds * np.arange(count))

    def follow(self, params: FloatArray, tool: ToolRollouts, abort_below: ArrayLike) -> ArmRollouts:
        """Rolls out the whole arm along tool paths of candidates (n, 6).

        Args:
            params: (n, 6) candidate parameters.
            tool: roll-outs of the tool.
            abort_below: () or (n,) clearance margin below which a roll-out is aborted [m].
        """
        T = max(int(np.isfinite(tool.path[:, :, 0]).sum(axis=1).max(initial=1)), 2)
        s = self.sample_times(T)
        samples = np.tile(self.reference(np.clip(s, 0.0, 1.0)), (len(params), 1, 1))
        paths = ToolPaths(
            s, tool.path[:, :T], samples[..., :9], samples[..., 9:], self.dmp.duration
        )
        return roll_out_arm(self.world, self.q, paths, abort_below)


ERROR, SPEED_RATIO, SAMPLE_COUNT = 3, 4, 5
_N_RESULTS = 6
"""Number of columns of results: `TOOL`, `LINKS`, `SELF` of `collision_model`, and the above."""
_MIN_CANDIDATES_PER_THREAD = 8
"""Minimum number of candidates per additional thread."""


class ToolPaths(NamedTuple):
    """N motions of the tool at T normalized times.

    Attributes:
        s: (T,) normalized times, ascending, from the current time on.
        p_WE: (N, T, 3) positions [m]; NaN after the end of a motion.
        R_WE: (N, T, 9) orientations, row by row.
        posture: (N, T, n) nominal postures of the null space [rad].
        seconds: duration from s = 0 to 1 [s].
    """

    s: FloatArray
    p_WE: FloatArray
    R_WE: FloatArray
    posture: FloatArray
    seconds: float


class ArmRollouts(NamedTuple):
    """Results of the roll-outs of N candidates.

    Attributes:
        clearance_margin: (N, 3) minimum clearance margins of tool, links and self-distance: minimum
            distance minus required clearance, at most `FAR` [m].
        error: (N,) maximum error of the tool pose [m, rad].
        max_joint_speed_ratio: (N,) maximum ratio of joint speed to its limit.
        samples: (N,) numbers of checked samples; fewer than T for an aborted roll-out.
        q: (N, T, n) configurations [rad].
    """

    clearance_margin: FloatArray
    error: FloatArray
    max_joint_speed_ratio: FloatArray
    samples: IntArray
    q: FloatArray

    @property
    def min_margin(self) -> FloatArray:
        """(N,) minimum of `clearance_margin` over tool, links and self-distance [m]."""
        return np.asarray(self.clearance_margin.min(axis=1))


def roll_out_arm(
    world: ArmCollisionModel, q: FloatArray, paths: ToolPaths, abort_below: ArrayLike = -math.inf
) -> ArmRollouts:
    """Rolls out the whole arm along N tool paths.

    Args:
        world: collision model of the arm, with the required clearances.
        q: (n,) current configuration [rad].
        paths: motions of the tool.
        abort_below: () or (N,) clearance margin below which a roll-out is aborted [m].
    """
    N, T, _ = paths.p_WE.shape
    table, joints = np.empty((N, _N_RESULTS)), np.empty((N, T, len(q)))
    thresholds = np.array(np.broadcast_to(np.asarray(abort_below, dtype=float), (N,)))
    s, p_WE, R_WE, posture = kernel_arrays(*paths[:4])
    packed = ToolPaths(s, p_WE, R_WE, posture, float(paths.seconds))
    threads = min(CORES, N // _MIN_CANDIDATES_PER_THREAD + 1)
    on_cores(_roll_some, threads, *world, *kernel_arrays(q), packed, thresholds, table, joints)
    samples = table[:, SAMPLE_COUNT].astype(np.int64)
    count(configurations=int(samples.sum()))
    return ArmRollouts(table[:, :3], table[:, ERROR], table[:, SPEED_RATIO], samples, joints)


@parted
def _roll_some(
    part: int, parts: int, chain: Chain, spheres: Spheres, geometries: CollisionGeometries,
    required: ClearanceRequirements,
    now: float, q0: FloatArray, paths: ToolPaths, abort_below: FloatArray, out: FloatArray,
    Q: FloatArray,
) -> None:  # fmt: skip
    """Rolls out candidates part, part + parts, ... (one thread's share).

    Writes results into out (N, 6), columns as of `_N_RESULTS`, and configurations into Q (N, T, n).
    """
    T, n = Q.shape[1:]
    s, workspace, target = paths.s, scratch(n), np.empty(12)
    center = np.empty((len(spheres.group_joint), 3))
    for i in range(part, len(Q), parts):
        p, margins, q = paths.p_WE[i], np.full(3, FAR), q0.copy()
        error, max_joint_speed_ratio, n_samples = 0.0, 0.0, 0
        for row in range(T):
            if math.isnan(p[row, 0]):
                break
            target[:9], target[9:] = paths.R_WE[i, row], p[row]
            pull = 1.0 - math.exp(PULL * (s[row - 1] - s[row])) if row > 0 else 0.0
            pose_error = follow(q, target, paths.posture[i], row, pull, chain, workspace)
            Q[i, row] = q
            n_samples = row + 1
            if row > 0:
                # The first sample is the current configuration: it has no error or speed.
                error = max(error, pose_error)
                dt = paths.seconds * (s[row] - s[row - 1])
                for joint in range(n):
                    joint_motion = abs(q[joint] - Q[i, row - 1, joint])
                    max_joint_speed_ratio = max(
                        max_joint_speed_ratio, joint_motion / (chain.speed[joint] * dt)
                    )
            lower_clearance_margins(
                workspace.X, now, spheres, geometries, required, center, margins, abort_below[i]
            )
            if min(margins[0], min(margins[1], margins[2])) < abort_below[i]:
                break
        for row in range(n_samples, T):
            Q[i, row] = q
        out[i, :3], out[i, ERROR], out[i, SPEED_RATIO], out[i, SAMPLE_COUNT] = (
            margins,
            error,
            max_joint_speed_ratio,
            n_samples,
        )
