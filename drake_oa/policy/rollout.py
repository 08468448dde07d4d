"""Roll-outs of the tool: the paths of many candidates from the present state.

They advance by the kernel and at the time step of `DmpIntegrator`
(`drake_oa.policy.action_kernels.advance`), with any number of coupling terms each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.compiled import CORES, compiled, kernel_arrays, on_cores, parted
from drake_oa.common.messages import EllipsoidSet, FloatArray, Frozen, PolicyState, zeros
from drake_oa.common.thinking import count
from drake_oa.policy.action import NO_OBSTACLES, rules_of
from drake_oa.policy.action_kernels import Ending, Facts, Rules, advance
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA
from drake_oa.policy.dmp import Dmp, Primitive, forcing, local_frame, normalised_time, spring_flow
from drake_oa.policy.guidance import Obstacles

LATEST = 2.0
"""Normalised time by which a motion arrives, from s = 0, or one more than the present one."""
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
        s: normalised time now.
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

    @property
    def moves(self) -> bool:
        """Whether an obstacle moves."""
        return bool(self.ellipsoids.v_WO.any())


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
        s=max(0.0, normalised_time(policy.phase, alpha_k)),
    )


@dataclass(frozen=True, eq=False)
class ToolRollouts(Frozen):
    """Paths of N candidates at the steps, or at every so many steps.

    Attributes:
        ds: length of a step in normalised time.
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
        terms: (N, K, 13) coupling terms of each, see `coupling.turn_step`, not faded and without
            guidance alpha.
        dmp: the movement primitive.
        policy: time step, fade and guidance; the step of normalised time is `period / duration`.
        end: normalised time before which no motion ends, or the present one.
        latest: normalised time at which it ends at the latest, or one more than the present one.
        tolerance: between these it ends as soon as the goal is this near and it is slow [m].
        longest: () or (N,) a candidate ends as soon as its path cannot become shorter [m].
        obstacles: K obstacles that lead the headings of the terms; None: nothing does.
        every: number of steps between the samples of the paths.

    Raises:
        ValueError: for terms of another shape, or an end that is no number.
    """
    N = len(terms)
    if terms.shape[2:] != (13,) or not max(end, latest) < math.inf:
        raise ValueError(f"terms must be (N, K, 13) and the end finite, not {terms.shape}, {end}")
    course = _course(scene, dmp, policy.period, end, latest, tolerance, every)
    lengths = np.array(np.broadcast_to(np.asarray(longest, dtype=float), (N,)))
    samples = len(course.rest) // every + 1
    table, (path, velocity) = np.empty((N, 3)), np.full((2, N, samples, 3), np.nan)
    led = NO_OBSTACLES if obstacles is None else obstacles
    facts = Facts(True, 0.0, False, -1.0, 0.0, True, True, False, True)
    (given,) = kernel_arrays(terms)
    threads = min(CORES, N // _EACH + 1)
    arguments = course, dmp.kernel, rules_of(policy), facts, led, given, lengths, table
    on_cores(_roll_some, threads, *arguments, path, velocity)
    count(searches=1, steps=int(table[:, 2].sum()))
    return ToolRollouts(course.ds, path, velocity, *np.ascontiguousarray(table.T))


class _Course(NamedTuple):
    """The motion of a scene as the kernel takes it; rest (T, 3) of the spring in each step."""

    p_WE: FloatArray
    z_W: FloatArray
    p_WG: FloatArray
    R_WL: FloatArray
    baseline: float
    rest: FloatArray
    ds: float
    every: int
    least: int
    tolerance: float


@lru_cache(maxsize=4)
def _course(
    scene: Scene,
    dmp: Dmp,
    period: float,
    end: float,
    latest: float,
    tolerance: float,
    every: int,
) -> _Course:
    """Returns the motion of a scene; arguments as of `roll_out_tool`."""
    ds = period / dmp.duration
    most = max(round((max(latest, scene.s + 1.0) - scene.s) / ds), 1)
    p_WE, z_W, p_WG, R_WL = kernel_arrays(scene.p_WE, scene.z_W, scene.p_WG, scene.R_WL)
    rest = p_WG + float(scene.baseline) * _forcing(dmp, float(scene.s), most, ds) @ R_WL.T
    least = round((max(end, scene.s) - scene.s) / ds)
    return _Course(
        p_WE, z_W, p_WG, R_WL, float(scene.baseline), rest, ds, every, least, float(tolerance)
    )


@lru_cache(maxsize=16)
def _forcing(dmp: Dmp, s: float, steps: int, ds: float) -> FloatArray:
    """Returns f(k) / (alpha_x beta_x) (steps, 3) in the middle of each step from s on."""
    force = np.empty((steps, 3))
    _sample_forcing(dmp.kernel, dmp.phase(s + (np.arange(steps) + 0.5) * ds), force)
    return force / (dmp.alpha_x * dmp.beta_x)


@compiled
def _sample_forcing(primitive: Primitive, k: FloatArray, force: FloatArray) -> None:
    """Writes the forcing term (T, D) at phases (T,)."""
    for row in range(len(k)):
        forcing(primitive.basis, k[row], force[row])


@parted
def _roll_some(
    part: int, parts: int, course: _Course, primitive: Primitive, rules: Rules, facts: Facts,
    led: Obstacles, terms: FloatArray, longest: FloatArray, out: FloatArray, path: FloatArray,
    velocity: FloatArray,
) -> None:  # fmt: skip
    """Rolls out candidates part, part + parts, ...; out (N, 3): length, goal error, steps."""
    flow = spring_flow(primitive.alpha_x, primitive.beta_x, 0.5 * course.ds)
    for i in range(part, len(terms), parts):
        acts = 0
        for row in range(terms.shape[1]):
            if terms[i, row, ALPHA] > 0.0:
                acts = terms.shape[1]
        path[i, 0], velocity[i, 0] = course.p_WE, course.z_W
        ending = Ending(course.least, course.tolerance, longest[i])
        out[i, 2], out[i, 0], out[i, 1] = advance(
            path[i], velocity[i], course.every, course.rest, flow, course.ds, ending, course.p_WG,
            course.R_WL, course.baseline, rules, facts, led, terms[i, :acts],
        )  # fmt: skip
