"""Roll-outs of the tool: the paths of many candidates from the present state.

They advance by the kernel and at the time step of `DmpIntegrator`
(`drake_oa.policy.action_kernels.advance`), with any number of coupling terms each.
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
"""Normalized time by which a motion arrives, from s = 0, or one more than the present one."""
ARRIVED = 6e-4
"""Distance from the goal at which a motion has arrived [m]."""
_EACH = 8
"""Candidates for which another thread pays."""


@dataclass(frozen=True, eq=False)
class Scene(Frozen):
    """A motion under way among M ellipsoids, in the world frame.

    Attributes:
        p_WE: (3,) position now [m].
        z_W: (3,) scaled velocity now [m].
        p_WG: (3,) goal [m].
        R_WL: (3, 3) local frame of the whole motion.
        baseline: its length L from start to goal [m].
        ellipsoids: the obstacles, where they are now.
        clearance: (M,) requested clearance of each [m].
        s: normalized time now.
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
        """(3,) start of the motion [m]."""
        return self.p_WG - self.baseline * self.R_WL[:, 0]


def scene_under_way(
    policy: PolicyState,
    p_WG: FloatArray,
    ellipsoids: EllipsoidSet,
    *,
    clearance: float,
    alpha_k: float,
) -> Scene:
    """Returns the scene of a motion under way among obstacles where they are now.

    Args:
        policy: the motion.
        p_WG: (3,) its goal [m].
        ellipsoids: the obstacles, moved on since their stamp.
        clearance: requested clearance [m].
        alpha_k: decay of the phase.
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
    """Paths of N candidates at the steps, or at every so many steps.

    Attributes:
        ds: length of a step in normalized time.
        path: (N, T // every + 1, 3) positions [m], NaN after the end.
        velocity: (N, T // every + 1, 3) scaled velocities z there [m].
        path_length: (N,) [m].
        goal_error: (N,) distance to the goal at the end [m].
        steps: (N,) number of steps until it arrived, or until it was ended.
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
    """Rolls out N candidates from the present state of a motion.

    Args:
        scene: the motion; its ellipsoids are not considered.
        terms: (N, K, 12) coupling terms of each, see `coupling.turn_step`, not faded.
        dmp: the movement primitive.
        policy: time step and fade; the step of normalized time is `period / duration`.
        end: normalized time before which no motion ends, or the present one.
        latest: normalized time at which it ends at the latest, or one more than the present one.
        tolerance: between these it ends as soon as the goal is this near and it is slow [m].
        longest: () or (N,) a candidate ends as soon as its path cannot become shorter [m].
        obstacles: K obstacles that lead the headings of the terms; None: nothing does.
        every: number of steps between the samples of the paths.

    Raises:
        ValueError: for terms of another shape, or an end that is no number.
    """
    N = len(terms)
    if terms.shape[2:] != (N_COLUMNS,) or not max(end, latest) < math.inf:
        raise ValueError(f"terms must be (N, K, 12) and the end finite, not {terms.shape}, {end}")
    course = _course(scene, dmp, policy.period, policy.fade, end, latest, tolerance, every)
    lengths = np.array(np.broadcast_to(np.asarray(longest, dtype=float), (N,)))
    table, motion = np.empty((N, 3)), np.full((2, N, len(course.rest) // every + 1, 3), np.nan)
    motion[0, :, 0], motion[1, :, 0] = scene.p_WE, scene.z_W
    (given,) = kernel_arrays(terms)
    threads = min(CORES, N // _EACH + 1)
    on_cores(_roll_some, threads, course, obstacles or NO_OBSTACLES, given, lengths, table, *motion)
    count(searches=1, steps=int(table[:, 2].sum()))
    return ToolRollouts(course.ds, *motion, *np.ascontiguousarray(table.T))


@lru_cache(maxsize=4)
def _course(
    scene: Scene,
    dmp: Dmp,
    period: float,
    fade: float,
    end: float,
    latest: float,
    tolerance: float,
    every: int,
) -> MotionSetup:
    """Returns the motion of a scene; arguments as of `roll_out_tool`."""
    ds = period / dmp.duration
    most = max(round((max(latest, scene.s + 1.0) - scene.s) / ds), 1)
    return dmp.course(
        dmp.phase(scene.s + (np.arange(most) + 0.5) * ds),
        ds,
        scene.p_WG,
        scene.baseline * scene.R_WL,
        fade=fade * scene.baseline,
        every=every,
        least=round((max(end, scene.s) - scene.s) / ds),
        tolerance=tolerance,
    )


@parted
def _roll_some(
    part: int,
    parts: int,
    course: MotionSetup,
    obstacles: Obstacles,
    terms: FloatArray,
    longest: FloatArray,
    out: FloatArray,
    path: FloatArray,
    velocity: FloatArray,
) -> None:
    """Rolls out candidates part, part + parts, ...; out (N, 3): length, goal error, steps."""
    for i in range(part, len(terms), parts):
        acts = len(terms[i]) * int((terms[i, :, ALPHA] > 0.0).any())
        out[i, 0], out[i, 1], out[i, 2] = advance(
            course, obstacles, terms[i, :acts], longest[i], path[i], velocity[i]
        )
