"""Many action-level trajectories in space at once, among any number of ellipsoids.

Each row does what the DmpIntegrator does with the coupling terms of that row: half a step
of the spring in closed form, the turn of z by the avoidance terms, the spring's other half
(`drake_oa.policy.dmp.step`, `drake_oa.policy.coupling.CouplingTerms` with `in_plane`). Obstacles
may move at constant velocity; then the motion's duration tau T matters, else it does not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from functools import cache, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.kernel_arrays import kernel_arrays
from drake_oa.common.messages import BoolArray, FloatArray, Frozen
from drake_oa.common.work import count
from drake_oa.policy.coupling_kernels import ALPHA, GUIDANCE_ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.dmp import Dmp, imitate, minimum_jerk, spring_flow
from drake_oa.regulation import spatial_kernels as kernels
from drake_oa.regulation.lane_kernels import lane_kernel

STEPS = 500
"""Default number of steps a unit of normalised time."""


def _no_plane() -> FloatArray:
    return np.zeros((0, 4))


@dataclass(frozen=True, eq=False)
class SpatialScenes(Frozen):
    """S motions under way, each among up to M ellipsoids, in the world frame.

    Attributes:
        p_WE: (S, 3) positions now [m].
        z_W: (S, 3) scaled velocities now [m].
        p_WG: (S, 3) goals [m].
        R_WL: (S, 3, 3) local frames of the whole motions.
        baseline: (S,) their lengths L from start to goal [m].
        p_WO: (S, M, 3) centres now [m]; NaN: no such obstacle.
        R_WO: (S, M, 3, 3) rotations, principal axes in the columns.
        semi_axes: (S, M, 3) [m].
        v_WO: (S, M, 3) velocities of the centres [m/s].
        clearance: (S, M) clearance Delta asked of each [m].
        s: normalised time now, one for all.
        plane: (S, 4) unit normal n_W and the least n . p that is allowed, or (0, 4).
        annulus: (3, n) heights, least and largest distances from the world's z axis that
            are allowed [m]; (3, 0): any.
    """

    p_WE: FloatArray
    z_W: FloatArray
    p_WG: FloatArray
    R_WL: FloatArray
    baseline: FloatArray
    p_WO: FloatArray
    R_WO: FloatArray
    semi_axes: FloatArray
    v_WO: FloatArray
    clearance: FloatArray
    s: float = 0.0
    plane: FloatArray = field(default_factory=_no_plane)
    annulus: FloatArray = field(default_factory=lambda: np.zeros((3, 0)))

    def __len__(self) -> int:
        return len(self.p_WE)

    def rows(self, index: ArrayLike) -> SpatialScenes:
        """Some of the scenes, by indices or a mask."""
        shared = {"s", "annulus"} | ({"plane"} if not len(self.plane) else set())
        chosen = {
            item.name: getattr(self, item.name)[np.asarray(index)]
            for item in fields(self)
            if item.name not in shared
        }
        return replace(self, **chosen)

    @property
    def p_WS(self) -> FloatArray:
        """(S, 3) starts of the motions [m]."""
        return self.p_WG - self.baseline[:, None] * self.R_WL[:, :, 0]


@dataclass(frozen=True, eq=False)
class SpatialRollouts(Frozen):
    """What N trajectories came to.

    Attributes:
        margin: (N,) least excess over the feasible clearance [m]: of each obstacle
            its least distance minus min(asked, distance at the beginning, distance of
            the goal at the end). inf without obstacles.
        clearance: (N,) least distance to any obstacle at the steps [m]; inside one, minus a
            lower bound of the depth. Between the steps it may be less by 1e-4 L, by 5e-4 L
            where an obstacle is all but touched.
        goal_error: (N,) distance to the goal at the end [m].
        path_length: (N,) [m].
        steps: (N,) steps taken until it arrived, or all of them.
        world_margin: (N,) least margin to the plane and the workspace, over what start
            and goal have themselves where that is negative [m]; inf where there are none.
        path: (N, n + 1, 3) positions [m], NaN after the end; (0, 1, 3) unless asked for.
        velocity: (N, n + 1, 3) scaled velocities z there [m].
    """

    margin: FloatArray
    clearance: FloatArray
    goal_error: FloatArray
    path_length: FloatArray
    steps: FloatArray
    world_margin: FloatArray
    path: FloatArray
    velocity: FloatArray

    @property
    def contact(self) -> BoolArray:
        """(N,) whether an obstacle was touched."""
        return self.clearance <= 0.0


@cache
def default_dmp() -> Dmp:
    """A straight minimum-jerk motion of three dimensions, of unit baseline and duration."""
    return imitate(*minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0)))


@lru_cache(maxsize=16)
def _forcing(dmp: Dmp, s: float, count: int, step: float) -> FloatArray:
    """f(k) / (alpha_x beta_x) in the middle of each step from s on, (count, 3)."""
    k = dmp.phase(s + (np.arange(count) + 0.5) * step)
    basis = np.exp(-dmp.widths * (k[:, None] - dmp.centers) ** 2)
    # Beyond the last centre all are small alike; the quotient stays.
    total = np.maximum(basis.sum(axis=1), 1e-300)
    force = (basis @ dmp.weights.T) * (k / total)[:, None]
    return np.ascontiguousarray(force / (dmp.alpha_x * dmp.beta_x))


def spatial_rollouts(
    scenes: SpatialScenes,
    scene: ArrayLike,
    terms: ArrayLike,
    *,
    seconds: ArrayLike = 1.0,
    dmp: Dmp | None = None,
    steps: int = STEPS,
    end: float = 1.0,
    horizon: float | None = None,
    fade: float = 0.0,
    tolerance: float = 0.0,
    longest: ArrayLike = math.inf,
    shortest: ArrayLike = math.inf,
    keep_path: bool = False,
    lanes: bool = True,
) -> SpatialRollouts:
    """Rolls out one trajectory a row.

    Args:
        scenes: S scenes.
        scene: (N,) the scene of each row.
        terms: (N, K, 13) avoidance terms as `coupling_kernels.turn_step` takes them: centre
            (3) [m], alpha, psi, kappa [1/m^2], heading (3), unit normal (3) and guidance
            alpha, which is 0; alpha 0: no such term.
        seconds: () or (N,) tau T, the duration of a unit of s [s].
        dmp: the primitive; None: `default_dmp`.
        steps: number of steps a unit of s.
        end: s at which the motion ends at the earliest.
        horizon: s at which it ends at the latest; None: `end`.
        fade: the terms fade within this many baselines of the goal.
        tolerance: between `end` and `horizon` it ends once the goal is this near [m].
        longest: () or (S,) a row ends as soon as its path is bound to be longer [m].
        shortest: () or (S,) a row ends as soon as it is short of the feasible clearance by
            more than this [m]; for obstacles at rest.
        keep_path: whether to return the paths.
        lanes: whether rows of one term each, whose paths are not asked for, are rolled out
            many at a time: the same to 1e-5 m and one step, and several times faster where
            the rows of a scene are many.

    Returns:
        The outcome of each row.

    Raises:
        ValueError: for wrong shapes or values out of range.
    """
    dmp = default_dmp() if dmp is None else dmp
    index = np.array(scene, dtype=np.int64, order="C")
    table = np.array(terms, dtype=float, order="C")
    N = len(index)
    _check_terms(table, N)
    if N and not 0 <= index.min() <= index.max() < len(scenes):
        raise ValueError(f"scene must hold numbers from 0 to {len(scenes) - 1}")
    horizon = end if horizon is None else horizon
    if steps < 1 or not scenes.s <= end <= horizon < math.inf:
        raise ValueError(
            f"steps must be at least 1 and s <= end <= horizon, not {steps}, {scenes.s}, "
            f"{end} and {horizon}"
        )
    step = 1.0 / steps
    most = max(round((horizon - scenes.s) * steps), 1)
    plane = scenes.plane if len(scenes.plane) else np.zeros((len(scenes), 4))
    out = np.empty((N, kernels.N_OUTCOMES))
    shape = (N if keep_path else 0, most + 1 if keep_path else 1, 3)
    path, velocity = np.empty(shape), np.empty(shape)
    arguments = (
        index,
        *kernel_arrays(scenes.p_WE, scenes.z_W, scenes.p_WG, scenes.R_WL, scenes.baseline),
        *kernel_arrays(scenes.p_WO, scenes.R_WO, scenes.semi_axes, scenes.v_WO, scenes.clearance),
        *kernel_arrays(plane, scenes.annulus),
        table,
        np.array(np.broadcast_to(np.asarray(seconds, dtype=float), (N,))),
        _forcing(dmp, scenes.s, most, step),
        np.array(spring_flow(dmp.alpha_x, dmp.beta_x, 0.5 * step)),
        step,
        round((end - scenes.s) * steps),
        fade,
        tolerance,
        np.array(np.broadcast_to(np.asarray(longest, dtype=float), (len(scenes),))),
        np.array(np.broadcast_to(np.asarray(shortest, dtype=float), (len(scenes),))),
        out,
    )
    if lanes and not keep_path and table.shape[1] == 1:
        lane_kernel(*arguments)
    else:
        kernels.spatial_kernel(*arguments, path, velocity)
    margin, clearance, goal_error, path_length, taken, world = (np.array(c) for c in out.T)
    count(searches=1, steps=int(taken.sum()) * max(scenes.p_WO.shape[1], 1))
    return SpatialRollouts(margin, clearance, goal_error, path_length, taken, world, path, velocity)


def _check_terms(terms: FloatArray, count: int) -> None:
    if terms.ndim != 3 or terms.shape[0] != count or terms.shape[2] != N_COLUMNS:
        raise ValueError(f"terms must be ({count}, K, {N_COLUMNS}), not {terms.shape}")
    acting = terms[:, :, ALPHA] > 0.0
    normal = np.linalg.norm(terms[:, :, NORMAL : NORMAL + 3], axis=2)
    for wrong, what in (
        (~np.isfinite(terms).all(axis=2), "must be finite"),
        (terms[:, :, ALPHA] < 0.0, "must not have a negative alpha"),
        (acting & ~(terms[:, :, PSI] > 0.0), "must have a positive psi"),
        (acting & ~(terms[:, :, KAPPA] >= 0.0), "must not have a negative kappa"),
        (acting & (np.abs(normal - 1.0) > 1e-6), "must have a normal of length 1"),
        (terms[:, :, GUIDANCE_ALPHA] != 0.0, "must not guide: guidance alpha must be 0"),
    ):
        if wrong.any():
            row, term = np.argwhere(wrong)[0]
            raise ValueError(f"terms {what}; term {term} of row {row} is {terms[row, term]}")
