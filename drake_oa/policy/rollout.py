"""Roll-outs of the tool point: simulations of many candidate motions from the current state.

A candidate is a set of coupling terms (turning rates of the motion). Roll-outs predict the path of
`DmpIntegrator`, the system that generates the motion: they use its time step and its integration
kernel (`drake_oa.policy.action_kernels.advance`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.compiled import CORES, kernel_arrays, on_cores, parted
from drake_oa.common.latency import count
from drake_oa.common.messages import EllipsoidSet, FloatArray, Frozen, PolicyState, zeros
from drake_oa.policy.action_kernels import MotionSetup, advance
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, N_COLUMNS
from drake_oa.policy.dmp import Dmp, local_frame, normalized_time
from drake_oa.policy.guidance import NO_OBSTACLES, Obstacles

LATEST = 2.0
"""Default normalized time at which the simulation of a candidate motion ends at the latest [-].

Normalized time is time over the planned duration: 1 is the planned end of the motion."""
ARRIVED = 6e-4
"""Default distance from the goal below which a simulated motion counts as arrived and ends [m].

Its scaled velocity must also be below 20 times this value."""
_EACH = 8
"""Number of candidate motions per additional thread that simulates them [-]."""


@dataclass(frozen=True, eq=False)
class Scene(Frozen):
    """Initial state of simulated motions of the tool point among M obstacles, in the world frame.

    Attributes:
        p_WE: (3,) current position of the tool point [m].
        z_W: (3,) current scaled velocity, the derivative of p_WE by normalized time [m].
        p_WG: (3,) goal [m].
        R_WL: (3, 3) local frame of the motion, x from start to goal, z up.
        baseline: distance L from start to goal [m].
        ellipsoids: ellipsoids of the obstacles at their current positions.
        clearance: (M,) requested clearance from each obstacle [m].
        s: current normalized time t / (tau T), with demonstrated duration T and temporal scaling
            tau.
    """

    p_WE: FloatArray
    z_W: FloatArray
    p_WG: FloatArray
    R_WL: FloatArray
    baseline: float
    ellipsoids: EllipsoidSet = field(default_factory=EllipsoidSet)
    clearance: FloatArray = zeros(0)
    s: float = 0.0

    @property
    def p_WS(self) -> FloatArray:
        """Position of the tool point at the start of the motion in the world frame, (3,) [m]."""
        return self.p_WG - self.baseline * self.R_WL[:, 0]


def scene_under_way(
    policy: PolicyState,
    p_WG: FloatArray,
    ellipsoids: EllipsoidSet,
    *,
    clearance: float,
    alpha_k: float,
) -> Scene:
    """Returns the initial state of simulations that continue the current motion of the tool point.

    The obstacles are extrapolated at constant velocity from their observation to the current time.

    Args:
        policy: current state of the motion.
        p_WG: (3,) goal in the world frame [m].
        ellipsoids: observed obstacles in the world frame, with velocities and the stamp of the
            observation.
        clearance: requested clearance from each obstacle [m].
        alpha_k: decay rate of the movement primitive's phase, per normalized time.
    """
    lag = policy.stamp - ellipsoids.stamp if math.isfinite(ellipsoids.stamp) else 0.0
    return Scene(
        p_WE=policy.p_WE,
        z_W=policy.z_W,
        p_WG=np.asarray(p_WG, dtype=float),
        R_WL=local_frame(policy.p_WS, p_WG),
        baseline=math.dist(p_WG, policy.p_WS),
        ellipsoids=replace(ellipsoids, p_WO=ellipsoids.p_WO + lag * ellipsoids.v_WO),
        clearance=np.full(len(ellipsoids), clearance),
        s=max(0.0, normalized_time(policy.phase, alpha_k)),
    )


@dataclass(frozen=True, eq=False)
class ToolRollouts(Frozen):
    """Simulated motions of the tool point for N candidates, over at most T steps.

    Paths are sampled at the start and then once in `every` steps of the integration, an argument of
    `roll_out_tool`.

    Attributes:
        ds: length of a step in normalized time.
        path: (N, T // every + 1, 3) positions in the world frame [m], NaN after the end of a
            motion.
        velocity: (N, T // every + 1, 3) scaled velocities at these positions, the derivatives of
            the positions by normalized time [m].
        path_length: (N,) lengths of the paths [m].
        goal_error: (N,) distances from the goal at the end of the motions [m].
        steps: (N,) numbers of steps until the end of the motions.
    """

    ds: float
    path: FloatArray
    velocity: FloatArray
    path_length: FloatArray
    goal_error: FloatArray
    steps: FloatArray


def roll_out_tool(
    scene: Scene,
    terms: FloatArray,
    *,
    dmp: Dmp,
    policy: Policy,
    end: float = 1.0,
    latest: float = LATEST,
    tolerance: float = ARRIVED,
    longest: ArrayLike = math.inf,
    obstacles: Obstacles | None = None,
    every: int = 1,
) -> ToolRollouts:
    """Simulates the motions of the tool point for N candidates, from the current state of a motion.

    Args:
        scene: current state of the motion; its ellipsoids have no effect.
        terms: (N, K, 12) coupling terms (turning rates) of each candidate at full strength, without
            the fading near the goal. The columns are the center p_WO (3), alpha, psi, kappa, the
            guidance heading (3) and the normal of the plane of rotation (3).
        dmp: movement primitive of the nominal motion, which has no coupling terms.
        policy: configuration, of which `period` (time step [s]) and `fade` (distance from the goal
            within which the terms fade, over the distance from start to goal) are used. The step in
            normalized time is `period` over the duration of the primitive.
        end: earliest normalized time at which a motion may end; a value below the current
            normalized time s is replaced by s.
        latest: latest normalized time at which a motion ends; a value below s + 1 is replaced by
            s + 1.
        tolerance: distance from the goal below which a motion ends between `end` and `latest`, if
            the length of its scaled velocity is below 20 times this value [m].
        longest: () or (N,) maximum path lengths [m]; a simulation ends as soon as the length so far
            plus the distance from the goal exceeds it.
        obstacles: K obstacles with selected sides, past which the guidance term turns the motions;
            None: no guidance.
        every: number of steps between the samples of the paths.

    Returns:
        Sampled motions with their lengths and goal errors.

    Raises:
        ValueError: for terms of another shape, or an end that is not finite.
    """
    N = len(terms)
    if terms.shape[2:] != (N_COLUMNS,) or not max(end, latest) < math.inf:
        raise ValueError(f"terms must be (N, K, 12) and the end finite, not {terms.shape}, {end}")
    setup = _setup(scene, dmp, policy.period, policy.fade, end, latest, tolerance, every)
    lengths = np.array(np.broadcast_to(np.asarray(longest, dtype=float), (N,)))
    table, motion = np.empty((N, 3)), np.full((2, N, len(setup.rest) // every + 1, 3), np.nan)
    motion[0, :, 0], motion[1, :, 0] = scene.p_WE, scene.z_W
    (rows,) = kernel_arrays(terms)
    threads = min(CORES, N // _EACH + 1)
    on_cores(_roll_some, threads, setup, obstacles or NO_OBSTACLES, rows, lengths, table, *motion)
    count(searches=1, steps=int(table[:, 2].sum()))
    return ToolRollouts(setup.ds, *motion, *np.ascontiguousarray(table.T))


@lru_cache(maxsize=4)
def _setup(
    scene: Scene,
    dmp: Dmp,
    period: float,
    fade: float,
    end: float,
    latest: float,
    tolerance: float,
    every: int,
) -> MotionSetup:
    """Computes the integration constants that all simulations in a call of `roll_out_tool` share.

    The result is cached, because a search calls `roll_out_tool` repeatedly from the same state.

    Args:
        scene: current state of the motion.
        dmp: movement primitive of the nominal motion.
        period: time step [s].
        fade: distance from the goal within which the coupling terms fade, over the distance from
            start to goal [-].
        end: earliest normalized time at which a motion may end.
        latest: latest normalized time at which a motion ends.
        tolerance: distance from the goal below which a slow motion ends [m].
        every: number of steps between the samples of the paths.
    """
    ds = period / dmp.duration
    max_steps = max(round((max(latest, scene.s + 1.0) - scene.s) / ds), 1)
    return dmp.setup(
        dmp.phase(scene.s + (np.arange(max_steps) + 0.5) * ds),
        ds,
        scene.p_WG,
        scene.baseline * scene.R_WL,
        fade=fade * scene.baseline,
        every=every,
        min_steps=round((max(end, scene.s) - scene.s) / ds),
        tolerance=tolerance,
    )


@parted
def _roll_some(
    part: int,
    parts: int,
    setup: MotionSetup,
    obstacles: Obstacles,
    terms: FloatArray,
    longest: FloatArray,
    out: FloatArray,
    path: FloatArray,
    velocity: FloatArray,
) -> None:
    """Simulates the candidates with numbers part, part + parts, ..., the work of one thread.

    Args:
        part: number of the thread, from 0.
        parts: number of threads.
        setup: constants of the integration.
        obstacles: K obstacles with selected sides, past which the guidance term turns the motions.
        terms: (N, K, 12) coupling terms (turning rates) of all candidates, with the columns center
            p_WO (3), alpha, psi, kappa, guidance heading (3) and normal of the plane of rotation
            (3).
        longest: (N,) maximum path lengths [m].
        out: (N, 3) path length [m], distance from the goal at the end [m] and number of steps;
            output.
        path: (N, T // every + 1, 3) positions in the world frame, one for each `every` of T steps
            [m]; the first of each motion is input, the others output.
        velocity: (N, T // every + 1, 3) scaled velocities at these positions, the derivatives by
            normalized time [m]; the first of each motion is input, the others output.
    """
    for i in range(part, len(terms), parts):
        acts = len(terms[i]) * int((terms[i, :, ALPHA] > 0.0).any())
        out[i, 0], out[i, 1], out[i, 2] = advance(
            setup, obstacles, terms[i, :acts], longest[i], path[i], velocity[i]
        )
