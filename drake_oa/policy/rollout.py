"""Roll-outs of the tool point: paths of many candidate motions from the current state.

A candidate is a set of coupling terms. Roll-outs use the kernel and the time step of
`DmpIntegrator` (`drake_oa.policy.action_kernels.advance`).
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
"""Latest end of a roll-out in normalized time; at least 1 after the current normalized time."""
ARRIVED = 6e-4
"""Distance from the goal at which a motion counts as arrived [m]."""
_EACH = 8
"""Minimum number of rolled-out candidates per additional thread."""


@dataclass(frozen=True, eq=False)
class Scene(Frozen):
    """Current motion of the tool point among M ellipsoids, in the world frame.

    Attributes:
        p_WE: (3,) current position [m].
        z_W: (3,) current scaled velocity [m].
        p_WG: (3,) goal [m].
        R_WL: (3, 3) local frame of the motion, x from start to goal.
        baseline: distance L from start to goal [m].
        ellipsoids: obstacles at their current positions.
        clearance: (M,) requested clearance of each obstacle [m].
        s: current normalized time.
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
        """Start of the motion, (3,) [m]."""
        return self.p_WG - self.baseline * self.R_WL[:, 0]


def scene_under_way(
    policy: PolicyState,
    p_WG: FloatArray,
    ellipsoids: EllipsoidSet,
    *,
    clearance: float,
    alpha_k: float,
) -> Scene:
    """Returns the scene of the current motion, with obstacles extrapolated to the current time.

    Args:
        policy: state of the motion.
        p_WG: (3,) goal [m].
        ellipsoids: observed obstacles, which move at constant velocity since their stamp.
        clearance: requested clearance [m].
        alpha_k: decay rate of the phase.
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
    """Roll-outs of N candidates over at most T steps, sampled at each `every`-th step.

    Attributes:
        ds: length of a step in normalized time.
        path: (N, T // every + 1, 3) positions [m], NaN after the end.
        velocity: (N, T // every + 1, 3) scaled velocities z at these positions [m].
        path_length: (N,) lengths of the paths [m].
        goal_error: (N,) distances from the goal at the end [m].
        steps: (N,) numbers of steps until the end.
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
    """Rolls out N candidates from the current state of a motion.

    Args:
        scene: current motion; its ellipsoids have no effect.
        terms: (N, K, 12) coupling terms of each candidate before fading, see `coupling.turn_step`.
        dmp: movement primitive.
        policy: time step and fade; the step in normalized time is `period / duration`.
        end: earliest end in normalized time; at least the current one.
        latest: latest end in normalized time; at least the current one plus 1.
        tolerance: distance from the goal at which a slow motion ends between both times [m].
        longest: () or (N,) path length bound at which a candidate ends early, see `advance` [m].
        obstacles: K obstacles that determine the guidance headings of the terms; None: no guidance.
        every: number of steps between the samples of the paths.

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
    """Computes the constants of the integration; arguments are those of `roll_out_tool`."""
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
    """Rolls out candidates part, part + parts, ..., the share of one thread.

    Writes path length [m], goal error [m] and number of steps of each candidate to `out` (N, 3).
    """
    for i in range(part, len(terms), parts):
        acts = len(terms[i]) * int((terms[i, :, ALPHA] > 0.0).any())
        out[i, 0], out[i, 1], out[i, 2] = advance(
            setup, obstacles, terms[i, :acts], longest[i], path[i], velocity[i]
        )
