"""Evolution strategy that searches for the shortest motion with the requested clearance.

A candidate motion has one avoidance term, (8) of Pairet et al., RA-L 2019: a turning rate that
steers the motion away from a point, with strength alpha, angular width psi, and decay kappa with
the squared distance. The baseline is the line of length L from start to goal. The motion passes on
one side of it: the direction omega, orthogonal to the baseline, toward which the motion turns. The
point lies in the plane of baseline and omega. The parameters `params` (6,) of a candidate, here and
in all modules that use this search, are::

    angle of omega in the YZ plane of the local frame (x along the baseline, z up),
    position of the point along the baseline / L,
    offset from the baseline toward omega / L (at most 0), ln kappa L^2, ln psi, ln alpha

Every candidate is rolled out (simulated) by the kernel of the integrator
(`drake_oa.policy.rollout`), and then evaluated for the whole arm (`ArmSearch`) or for a point
(`drake_oa.planning.point_search`). The cost J to be minimized is the path length l over L, plus
costs of lateness and side, plus penalties for errors. [x > 0] is 1 if x > 0, else 0::

    J = l / L + w_late max(s_end - 1, 0) + c_side
        + [e > 0] (w_inf + w_miss + w_goal e / L)
        + [sigma + eps + r > 0] (w_inf + w_clear (sigma + eps) / L + r)

s_end is the normalized time of arrival (1 at the end of the demonstrated duration), c_side the cost
that user-supplied cost rings give to the side, e the goal error, sigma the clearance shortfall, eps
the pose error, and r the excess of the joint speed over its limit. Of each error, only the part
beyond the tolerance counts. The weights and penalties w are constants of this module. A candidate
with J < w_inf is feasible.

N(0, I) is a random vector, scale a random factor of at most 1, and `candidates` the number of
candidates of a generation (iteration). The evolution strategy is::

    ranking = best 8 of the seeds and a moderate term on each of 16 sides
    for each generation, at most refinement_generations after the first feasible candidate:
        line    = best candidate with smaller ln alpha if it is feasible, else with larger ln alpha
        mutants = ranking + STEP_SIZES * scale * N(0, I) + {0, 1/2} * difference of two of ranking
        if none is feasible, from generation 6 on: candidates / 4 of the mutants are replaced by
                  uniformly random ones within the bounds
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
"""Number of parameters of a candidate motion of the search."""
ANGLE, ALONG, LATERAL, KAPPA, PSI, ALPHA = range(N_PARAMS)
LOWER = np.array([-np.inf, 0.01, -0.3, math.log(0.1), math.log(0.15), math.log(0.1)])
"""(6,) lower bounds of the parameters of a candidate motion, which has one avoidance term.

The parameters are the angle of the side on which the motion passes [rad]; the position of the
term's center along the baseline (line of length L from start to goal), and the offset of the center
toward this side, both over L; and the logarithms of the decay kappa L^2, the angular width psi
[rad] and the strength alpha."""
UPPER = np.array([np.inf, 0.99, 0.0, math.log(3e3), math.log(5.0), 30.0])
"""(6,) upper bounds of the parameters of a candidate motion, which has one avoidance term.

The parameters are the angle of the side on which the motion passes [rad]; the position of the
term's center along the baseline (line of length L from start to goal), and the offset of the center
toward this side, both over L; and the logarithms of the decay kappa L^2, the angular width psi
[rad] and the strength alpha."""
STEP_SIZES = np.array([0.4, 0.08, 0.03, 0.6, 0.25, 0.8])
"""(6,) largest standard deviations with which a candidate's parameters vary at random (mutation).

The parameters are the angle of the side on which the motion passes [rad]; the position of the
avoidance term's center along the baseline (line of length L from start to goal), and the offset of
the center toward this side, both over L; and the logarithms of the decay kappa L^2, the angular
width psi [rad] and the strength alpha."""
N_ELITES = 8
"""Number of best candidate motions that the evolution strategy varies in the next generation."""
INITIAL_SPACING = 0.6
"""Range of ln alpha over which the search varies the best candidate in the first generation [-].

alpha is the strength of the candidate's avoidance term. A part of each generation (iteration)
differs from the best candidate in alpha only; the other candidates vary in all parameters."""
_SPACING_RATIO = 0.4
"""Factor by which the range of ln alpha shrinks from one generation of the search to the next [-].

Over this range, a part of the generation varies the best candidate's strength alpha, without
variation of the other parameters."""
_MIN_SPACING = 0.02
"""Minimum of the range of ln alpha, which shrinks with each generation of the search [-].

Over this range, a part of the generation varies the best candidate's strength alpha, without
variation of the other parameters."""
NO_SIDE_COST = np.zeros(1)
"""(1,) side cost of a search that prefers no side of the obstacles: 0 in every direction [-]."""
SAMPLES = 64
"""Number of samples of a whole-arm roll-out (simulation) over the normalized times 0 to 1.

On a path of 1 m, consecutive positions of the tool are at most 3 cm apart."""
ABORT_SHORTFALL = 0.06
"""Clearance shortfall beyond which the whole-arm roll-out of a candidate motion is aborted [m].

It applies while infeasible candidates are still of use, because there are not enough feasible ones
(`max_cost` is at least `INFEASIBLE_PENALTY`). Otherwise any shortfall beyond the tolerance `slack`
aborts a roll-out."""
_CYCLE_LENGTH = 24
"""Number of generations (iterations) after which the search uses the same random numbers again.

The range of ln alpha, which shrinks with each generation, also starts again from its maximum."""
_LATENCY_MODEL = LatencyModel()
"""Model of the compute latency by which a search decides whether another generation may start.

It does not depend on the block `compute_latency` of a scenario."""
MAX_POSE_ERROR = 5e-4
"""Maximum pose error of the tool at which the arm counts as following a tool path.

It applies to each component of the position error [m] and of the rotation vector [rad]."""
MAX_GOAL_ERROR = 0.02
"""Maximum distance from the goal at the end of an executed motion, as a fraction of the distance
from start to goal.

A motion that is predicted to end farther away is held."""
INFEASIBLE_PENALTY = 10.0
"""Cost w_inf that is added for an infeasible candidate motion; feasible ones thus rank first [-].

A motion is infeasible if its clearance, goal, pose or joint speed error exceeds the tolerance."""
CLEARANCE_WEIGHT = 100.0
"""Weight w_clear of clearance shortfall and pose error in the cost of a candidate motion [-].

Both errors are divided by the distance from start to goal."""
_GOAL_ERROR_WEIGHT = 30.0
"""Weight w_goal of the goal error in the cost of a candidate motion [-].

The error is divided by the distance from start to goal."""
_GOAL_MISS_PENALTY = 2.0
"""Cost w_miss of a candidate motion that ends farther from the goal than the tolerance [-]."""
_LATENESS_WEIGHT = 0.05
"""Weight w_late of a late arrival in the cost of a candidate motion [-].

It is multiplied by the delay of the arrival after the planned end of the motion, over the planned
duration."""
_LINE_FRACTION = 0.2
"""Fraction of a generation's candidates that differ from the best in strength alpha only [-]."""
_MIN_LINE_COUNT = 5
"""Minimum number of a generation's candidates that differ from the best in strength alpha only."""
_FIRST_RANDOM_GENERATION = 6
"""Index of the first generation with uniformly random candidates, if none of the evolution
strategy's best candidates is feasible so far.

Generations are iterations of the search. They are counted from 0, over successive searches of a
motion, and again from 0 after 24 generations (`_CYCLE_LENGTH`)."""
NOMINAL_PARAMS = np.where(np.arange(N_PARAMS) == ALPHA, -np.inf, 0.0)[None]
"""(1, 6) candidate parameters of the nominal motion, whose avoidance term has the strength 0."""
NO_ELITES = np.zeros((0, N_PARAMS))
"""(0, 6) empty array of candidate parameters, for a search without warm start or seeds."""
SOURCES = ("nominal", "chain", "search", "joint_path")
"""Names of the sources of a selected motion; ports and log files contain their indices.

The sources are the nominal (demonstrated) motion; "chain", the regressor chain's coupling terms for
all obstacles together; "search", the evolution strategy; and a joint-space path."""
NOMINAL, CHAIN, SEARCH, JOINT_PATH = range(len(SOURCES))
_SIDE_SEEDS = np.tile([0.0, 0.5, -0.05, 1.0, 0.3, 4.0], (16, 1))
_SIDE_SEEDS[:, ANGLE] = np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False)
"""(16, 6) seeds of the search: a moderate avoidance term on each of 16 sides of the baseline."""


def avoidance_terms(scene: Scene, params: FloatArray) -> FloatArray:
    """Converts the parameters of N candidate motions to coupling terms in the world frame.

    A coupling term is a turning rate that steers the motion away from a point.

    Args:
        scene: start, goal and local frame of the motions.
        params: (N, 6) candidate parameters: angle of the side on which the motion passes [rad];
            position of the point along the baseline (line of length L from start to goal), and
            offset of the point toward this side, both over L; logarithms of the decay kappa L^2,
            the angular width psi [rad] and the strength alpha.

    Returns:
        (N, 12) coupling terms in the world frame: point (3) [m], alpha in units of 1/T with the
        demonstrated duration T, psi [rad], kappa [1/m^2], guidance heading (3), which is zero (no
        guidance), and normal of the plane of rotation (3).
    """
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
    """Converts coupling terms to candidate parameters (N, 6), the inverse of `avoidance_terms`.

    A coupling term is a turning rate that steers the motion away from a point. The candidate
    parameters are the angle of the side on which the motion passes [rad]; the position of the point
    along the baseline (line of length L from start to goal), and the offset of the point toward
    this side, both over L; and the logarithms of the decay kappa L^2, the angular width psi and the
    strength alpha.

    Args:
        scene: start, goal and local frame of the motion.
        p_WP: (N, 3) points from which the terms turn the motion, in the world frame [m]; components
            outside the plane of the baseline and the side are ignored.
        normal_W: (N, 3) normals of the planes in which the terms turn the motion, in the world.
        strength: (N, 3) parameters of the terms: alpha in units of 1/T with the demonstrated
            duration T, psi [rad], kappa [1/m^2].
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
    """Converts an array of M coupling terms to the message `CouplingParameters`.

    Args:
        terms: (M, 12) coupling terms in the world frame: center (3) [m], alpha, psi, kappa,
            guidance heading (3), which is ignored, and normal of the plane of rotation (3).
    """
    alpha, psi, kappa = np.ascontiguousarray(terms[:, ALPHA_COLUMN : KAPPA_COLUMN + 1].T)
    return CouplingParameters(
        alpha, psi, kappa, center_W=terms[:, :3], normal_W=terms[:, NORMAL : NORMAL + 3]
    )


def strengths(params: FloatArray, is_feasible: bool, spacing: float, count: int) -> FloatArray:
    """Returns variations of a candidate motion that differ from it in the strength alpha only.

    The smallest alpha that achieves the clearance gives the shortest path. The variations of a
    feasible candidate therefore have a smaller alpha, those of an infeasible one a larger alpha.

    Args:
        params: (6,) parameters of the candidate, of which the last is ln alpha.
        is_feasible: whether the candidate is feasible (achieves the clearance, arrives, and the arm
            can follow it).
        spacing: range of ln alpha over which the variations are spread [-]. A feasible candidate is
            varied downward by less than this range, an infeasible one upward by less than 2.5 times
            this range.
        count: number of variations.

    Returns:
        (count, 6) candidate parameters.
    """
    fraction = np.arange(1, count + 1) / (count + 1)
    line = np.repeat(params[None], count, axis=0)
    line[:, ALPHA] += spacing * (fraction - 1.0 if is_feasible else 2.5 * fraction)
    return line


class Ranking(NamedTuple):
    """Evaluated candidate motions with their costs.

    The result of `merge` is sorted by ascending cost; that of `Search.evaluate` is not.

    Attributes:
        params: (n, 6) candidate parameters: angle of the side on which the motion passes [rad];
            position of the avoidance term's center along the line of length L from start to goal,
            and offset of the center toward this side, both over L; logarithms of the decay
            kappa L^2, the angular width psi [rad] and the strength alpha. The motion with the
            regressor chain's terms (source 1) has `NOMINAL_PARAMS` instead.
        cost: (n,) costs J [-]: path length over the distance from start to goal, plus penalties; 10
            (`INFEASIBLE_PENALTY`) or more for an infeasible candidate.
        length: (n,) lengths of the tool's paths [m].
        source: (n,) kinds of the candidates: 0 nominal motion, 1 coupling terms of the regressor
            chain, 2 evolution strategy, 3 joint-space path.
    """

    params: FloatArray
    cost: FloatArray
    length: FloatArray
    source: IntArray

    @property
    def is_feasible(self) -> bool:
        """Whether the best candidate achieves clearance and goal, and the arm can follow it."""
        return bool(self.cost[0] < INFEASIBLE_PENALTY)

    def merge(self, *rankings: Ranking, count: int = 1) -> Ranking:
        """Returns a ranking of the `count` best candidates of this and other rankings."""
        columns = [np.concatenate(column) for column in zip(self, *rankings, strict=True)]
        order = np.argsort(columns[1], kind="stable")[:count]
        return Ranking(*(column[order] for column in columns))


class Search(ABC):
    """Evolution strategy that searches for the best motion from one state; base class.

    A subclass defines the obstacles, by the method that computes the cost of clearance shortfalls.
    The six parameters of a candidate are the angle of the side on which the motion passes [rad];
    the position of the coupling term's center along the line of length L from start to goal, and
    the offset of the center toward this side, both over L; and the logarithms of the decay
    kappa L^2, the angular width psi [rad] and the strength alpha.

    Attributes:
        counts: (4,) numbers of rolled-out candidates of each kind: nominal motion, coupling terms
            of the regressor chain, evolution strategy, joint-space path.
        elites: (k, 6) parameters of the best candidates after the last generation.
        generations: number of generations (iterations), including those of earlier searches.
    """

    every = 1
    """Number of integration steps between two samples of a simulated tool path."""

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
        """Stores the initial state, the parameters and the warm start of the search.

        Args:
            scene: initial state, goal and obstacles of the motion.
            dmp: movement primitive of the nominal motion.
            policy: configuration of the movement primitive, of which `period` (time step) and
                `fade` (distance from the goal at which coupling terms fade) are used.
            parameters: numbers of candidates and generations, and tolerances.
            previous: (1, 6) candidate parameters of the current motion; (0, 6): the current motion
                has no coupling term of the search.
            side_cost: (K,) additional costs of passing on K evenly spaced sides around the line
                from start to goal, as path length over the length of this line [-]; inf: forbidden
                side.
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
        """Computes the costs (n,) of clearance shortfalls along the tool paths of n candidates [-].

        Args:
            params: (n, 6) candidate parameters.
            tool: simulated motions of the tool point.
            cost: (n,) other costs of the candidates [-].
            max_cost: cost at or above which a candidate is of no use, so that its clearance is not
                computed [-].
        """

    def run(
        self,
        *,
        guides: Obstacles | None = None,
        seeds: FloatArray = NO_ELITES,
        source: int = SEARCH,
    ) -> Ranking:
        """Searches for the candidate motion of least cost.

        The nominal motion is evaluated first and, if it is infeasible, the current motion, if that
        has a coupling term of the search. If one of them is feasible, the search returns it without
        evaluating other candidates.

        Args:
            guides: obstacles with the coupling terms of the regressor chain, which are evaluated
                together as one candidate with heading guidance; None: no such candidate.
            seeds: (n, 6) parameters of first candidates, followed by a moderate avoidance term on
                each of 16 sides, up to the number of candidates. A search that continues an earlier
                one starts from the best candidates of that search instead.
            source: kind of the current motion, an index of `SOURCES` ("nominal", "chain", "search",
                "joint_path").

        Returns:
            Ranking that contains the best candidate only.
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
        """Rolls out (simulates) candidates and computes their costs.

        Args:
            params: (n, 6) candidate parameters.
            source: kind of the candidates, an index of `SOURCES` ("nominal", "chain", "search",
                "joint_path").
            max_cost: cost above which the roll-out of a candidate is aborted [-].
            guides: obstacles with the coupling terms of the regressor chain, for one candidate with
                heading guidance; these terms replace those of `params`.

        Returns:
            Candidates in the given order, with their costs.
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
        """Simulates the motions of the tool point for candidates.

        Args:
            params: (n, 6) candidate parameters.
            max_length: path length above which the simulation of a candidate ends [m].
            guides: obstacles with the coupling terms of the regressor chain, for one candidate with
                heading guidance; these terms replace those of `params`.
        """
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
        """Computes the costs of path length, side, late arrival and goal error of n candidates.

        Args:
            params: (n, 6) candidate parameters.
            tool: simulated motions of the tool point.

        Returns:
            (n,) costs [-].
        """
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
        """Returns the parameters (n, 6) of the search's first candidates.

        With a warm start, they are the best candidates of the earlier search. Otherwise they are
        the seeds, a moderate avoidance term on each of 16 sides, and the current motion, also with
        larger strengths alpha.

        Args:
            seeds: (m, 6) parameters of the seeds.
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
        """Returns the parameters (n, 6) of the next generation, variations of the best candidates.

        Args:
            ranked: best candidates so far, in ascending order of cost.
        """
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
        """Returns candidate parameters (n, 6) clipped to the bounds `LOWER` and `UPPER`."""
        return np.clip(params, LOWER, UPPER)


def references(s: FloatArray, R_WE: FloatArray, q: FloatArray) -> BSpline:
    """Interpolates the desired tool orientation and the nominal posture over normalized time.

    Interpolated rotation matrices are not orthonormal. With samples a degree apart the error is
    negligible, since the inverse kinematics computes only rotation vectors from them.

    Args:
        s: (T,) normalized times (time over the duration of the motion) from 0 to 1.
        R_WE: (T, 3, 3) desired orientations of the tool in the world frame.
        q: (T, n) nominal postures, which the null space of the arm tracks [rad].

    Returns:
        Linear spline with 9 + n columns: rotation matrix, row by row, and posture [rad].
    """
    return make_interp_spline(s, np.hstack([np.reshape(R_WE, (len(s), 9)), q]), k=1)


@lru_cache(maxsize=4)
def _length(dmp: Dmp) -> float:
    """Computes the path length of a nominal motion whose start and goal are 1 m apart [m].

    Args:
        dmp: movement primitive of the motion.
    """
    path = trajectory(dmp, np.zeros(3), np.array([1.0, 0.0, 0.0])).p
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())


class ArmSearch(Search):
    """Evolution strategy that searches for a motion of the whole arm among collision geometry."""

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
        """Stores the collision model, the current configuration, and the arguments of `Search`.

        Args:
            scene: initial state and goal of the motion.
            world: collision model of the arm, with the required clearances.
            q: (n,) current configuration [rad].
            reference: spline over normalized time with 9 + n columns: desired tool orientation
                R_WE, row by row, and nominal posture of the null space [rad].
            samples: number of samples of a whole-arm roll-out over the normalized times 0 to 1.
            more: further arguments of `Search`: movement primitive, parameters, warm start.
        """
        super().__init__(scene, **more)
        self.world, self.q, self.reference = world, q, reference
        self.every = max(round(1.0 / (self.ds * samples)), 1)
        self.planned_length = _length(self.dmp) * scene.baseline

    def clearance_cost(
        self, params: FloatArray, tool: ToolRollouts, cost: FloatArray, max_cost: float
    ) -> FloatArray:
        """Computes the costs (n,) of clearance shortfall, pose error and excessive joint speed [-].

        The whole arm is rolled out for this.

        Args:
            params: (n, 6) candidate parameters.
            tool: simulated motions of the tool point.
            cost: (n,) other costs of the candidates [-].
            max_cost: cost at or above which a candidate is of no use, so that its roll-out is
                aborted [-].
        """
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
        """Returns the normalized times (count,) of a roll-out's samples.

        The first is the current normalized time s of the motion in progress; `every` integration
        steps are between two samples. Normalized time is time since the start of the motion over
        tau T, with the demonstrated duration T and the temporal scaling tau.
        """
        return np.asarray(self.scene.s + self.every * self.ds * np.arange(count))

    def follow(self, params: FloatArray, tool: ToolRollouts, abort_below: ArrayLike) -> ArmRollouts:
        """Rolls out the whole arm along the tool paths of n candidates, by inverse kinematics.

        Args:
            params: (n, 6) candidate parameters.
            tool: simulated motions of the tool point.
            abort_below: () or (n,) clearance margin (distance minus required clearance) below which
                a roll-out is aborted [m].
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
"""Number of columns of the results of a whole-arm roll-out in the compiled kernel.

The columns are the clearance margins (distance minus required clearance) of tool, links and
self-distance [m], the maximum pose error of the tool [m, rad], the maximum ratio of a joint's speed
to its limit [-], and the number of checked samples. A pose error is the largest absolute component
of the position error [m] and of the rotation vector [rad]."""
_MIN_CANDIDATES_PER_THREAD = 8
"""Minimum number of candidates per additional thread of the whole-arm roll-outs."""


class ToolPaths(NamedTuple):
    """Motions of the tool for N candidates at T normalized times, with postures of the null space.

    Normalized time is time over tau T, with the demonstrated duration T and the temporal scaling
    tau.

    Attributes:
        s: (T,) normalized times, ascending, from the current time on.
        p_WE: (N, T, 3) positions in the world frame [m]; NaN after the end of a motion.
        R_WE: (N, T, 9) orientations in the world frame: rotation matrices, row by row.
        posture: (N, T, n) nominal postures of the null space [rad].
        seconds: time that corresponds to a difference of 1 in normalized time [s]; the demonstrated
            duration T, so that joint speeds are computed for tau = 1.
    """

    s: FloatArray
    p_WE: FloatArray
    R_WE: FloatArray
    posture: FloatArray
    seconds: float


class ArmRollouts(NamedTuple):
    """Results of the whole-arm roll-outs (simulations) of N candidate motions at T samples.

    Attributes:
        clearance_margin: (N, 3) minimum clearance margins (distance minus required clearance) of
            tool, links and self-distance, at most `FAR` [m].
        error: (N,) maximum pose error of the tool over the samples, where a pose error is the
            largest absolute component of position error [m] and rotation vector [rad].
        max_joint_speed_ratio: (N,) maximum ratio of a joint's speed to the speed limit [-].
        samples: (N,) numbers of checked samples; fewer than T for an aborted roll-out, or for a
            tool path that ends earlier.
        q: (N, T, n) configurations; after the last checked sample, that of this sample [rad].
    """

    clearance_margin: FloatArray
    error: FloatArray
    max_joint_speed_ratio: FloatArray
    samples: IntArray
    q: FloatArray

    @property
    def min_margin(self) -> FloatArray:
        """(N,) minimum clearance margins of candidates over tool, links and self-distance [m]."""
        return np.asarray(self.clearance_margin.min(axis=1))


def roll_out_arm(
    world: ArmCollisionModel, q: FloatArray, paths: ToolPaths, abort_below: ArrayLike = -math.inf
) -> ArmRollouts:
    """Rolls out (simulates) the whole arm along N tool paths, and computes clearance margins.

    The arm follows each path by differential inverse kinematics.

    Args:
        world: collision model of the arm, with the required clearances.
        q: (n,) configuration at the start of all paths [rad].
        paths: motions of the tool.
        abort_below: () or (N,) clearance margin (distance minus required clearance) below which a
            roll-out is aborted [m].
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
    """Rolls out the whole arm for candidates part, part + parts, ..., the work of one thread.

    Args:
        part: index of the thread.
        parts: number of threads.
        chain: kinematic chain of the arm.
        spheres: spheres that cover the arm.
        geometries: collision geometries of environment and obstacles.
        required: required clearances between the arm's bodies and geometries, and between bodies.
        now: time at which the positions of the geometries are evaluated [s].
        q0: (n,) configuration at the start of all paths [rad].
        paths: motions of the tool for N candidates at T normalized times.
        abort_below: (N,) clearance margins (distance minus required clearance) below which a
            roll-out is aborted [m].
        out: (N, 6) results, set in place: clearance margins of tool, links and self-distance [m],
            largest absolute element of the tool's position error [m] and rotation error [rad],
            maximum ratio of a joint's speed to its limit, and number of checked samples. That
            number is below T if the roll-out is aborted, or if the tool's path ends earlier (its
            later samples are NaN).
        Q: (N, T, n) configurations, set in place [rad].
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
