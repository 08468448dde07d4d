"""One step of the whole action level, compiled.

`advance` is the integration of `DmpIntegrator` and of every roll-out (`drake_oa.policy.rollout`):
half a step of the spring of `drake_oa.policy.dmp`, the turn of `drake_oa.policy.coupling`, the
spring's other half. `take_step` adds the holds and the temporal scaling.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.ellipsoid_kernels import first_inside
from drake_oa.policy.coupling import ALPHA, GUIDANCE_ALPHA, HEADING, NORMAL, rotate, turn_step
from drake_oa.policy.dmp import Primitive, forcing, spring_flow
from drake_oa.policy.guidance import Obstacles, guide

FREE, UNOBSERVED, OUTDATED, FORBIDDEN, INSIDE = 0, 1, 2, 3, 4
"""Reasons to hold; INSIDE + 2 row: the tool is inside that obstacle, one more: the goal."""
BAD_STEP = -1
"""Why no step was taken."""


class Instant(NamedTuple):
    """The policy at one instant: p_WE (3,) [m], z_W (3,) [m], k, ds/dt [1/s], time [s]."""

    p_WE: FloatArray
    z_W: FloatArray
    phase: float
    speed: float
    stamp: float


class Course(NamedTuple):
    """The position between two instants: at v (3,) first, v_end (3,) last, linear between.

    `drift` (3,) is v, corrected so that the integral ends where the policy says.
    """

    begin: float
    end: float
    p: FloatArray
    v: FloatArray
    v_end: FloatArray
    drift: FloatArray
    acceleration: FloatArray


class Motion(NamedTuple):
    """The motion between two steps: see `PolicyState`; evasion (3,) displaces it besides [m/s]."""

    begin: Instant
    end: Instant
    tau: float
    p_WS: FloatArray
    p_WG: FloatArray
    R_WL: FloatArray
    evasion: FloatArray
    course: Course


class Rules(NamedTuple):
    """How the coupling terms and the holds act: fields of `drake_oa.policy.config.Policy`."""

    guidance_gain: float
    fade: float
    max_age: float
    hold_time: float
    printed: bool
    max_rate: float


class Facts(NamedTuple):
    """What perception and decision say of all obstacles together.

    Whether obstacles are looked for, when they were seen [s], whether no way past them is known,
    the route's length [m] (negative: no route), the asked tau (0: none), whether there are
    coupling terms, whether they act in the planes of their normals, whether they are the
    original ones, and whether they were verified by roll-outs, so that no ellipsoid holds them.
    """

    looked_for: bool
    seen: float
    blocked: bool
    path_length: float
    tau: float
    couples: bool
    in_plane: bool
    original: bool
    verified: bool


@compiled
def goal_fade(distance_squared: float, baseline: float, fade: float) -> float:
    """How much of the coupling is left near the goal: (distance / (fade L))^4, at most 1.

    The coupling would keep turning the motion round the goal; alpha acts by its
    logarithm, hence the steep power.
    """
    reach = fade * baseline
    return min(1.0, distance_squared / (reach * reach)) ** 2 if reach > 0.0 else 1.0


@compiled
def hold_code(
    p_WE: FloatArray,
    p_WG: FloatArray,
    facts: Facts,
    obstacles: Obstacles,
    time: float,
    max_age: float,
) -> int:
    """Why the motion must not go on now, as a number.

    It is held while nothing has been observed yet or the observation is too old; while the tool
    is inside an obstacle's ellipsoid, or the goal is, unless the motion was verified; and while no
    way past them is known.
    """
    if not facts.looked_for:
        return FREE
    if facts.seen == -math.inf:
        return UNOBSERVED
    if time - facts.seen > max_age:
        return OUTDATED
    if facts.blocked:
        return FORBIDDEN
    if facts.verified:
        return FREE
    row = first_inside(p_WE, obstacles.p_WO, obstacles.R_WO, obstacles.semi_axes)
    if row >= 0:
        return INSIDE + 2 * row
    row = first_inside(p_WG, obstacles.p_WO, obstacles.R_WO, obstacles.semi_axes)
    if row >= 0:
        return INSIDE + 2 * row + 1
    return FREE


class Ending(NamedTuple):
    """Conditions under which a roll-out ends before its last step.

    Attributes:
        least: number of steps before which it does not arrive.
        tolerance: distance from the goal at which it arrives, if it is slow [m].
        longest: it ends as soon as its path cannot become shorter than this [m].
    """

    least: int
    tolerance: float
    longest: float


@compiled
def advance(  # noqa: PLR0913
    path: FloatArray,
    velocity: FloatArray,
    every: int,
    rest: FloatArray,
    flow: tuple[float, float, float, float],
    ds: float,
    ending: Ending,
    p_WG: FloatArray,
    R_WL: FloatArray,
    baseline: float,
    rules: Rules,
    facts: Facts,
    obstacles: Obstacles,
    coupling: FloatArray,
) -> tuple[int, float, float]:
    """Advances the position and the scaled velocity by up to T steps of equal length.

    A step is half a step of the spring, the turn by the coupling terms, and the spring's other
    half. `DmpIntegrator` takes one step at a time, a roll-out all.

    Args:
        path: (T // every + 1, 3) positions p_WE [m]; the first row is given, the others are
            written.
        velocity: (T // every + 1, 3) scaled velocities z_W [m], likewise.
        every: number of steps from one row to the next.
        rest: (T, 3) equilibrium of the spring in the middle of each step, displaced from the goal
            by the forcing term [m].
        flow: of the spring over half a step, see `dmp.spring_flow`.
        ds: length of a step in normalised time.
        ending: conditions under which it ends early.
        p_WG, R_WL, baseline: the goal (3,) [m], the local frame (3, 3) and the baseline's length
            [m].
        rules, facts: how the coupling terms act.
        obstacles: the obstacles that lead the headings of the terms.
        coupling: (K, 13) the coupling terms, see `coupling.turn_step`, not faded and without
            guidance alpha; (0, 13): none.

    Returns:
        The number of steps taken, the length of the path [m], and the distance of its end from
        the goal [m].
    """
    a, b, c, d = flow
    x, y, z = path[0, 0], path[0, 1], path[0, 2]
    u, v, w = velocity[0, 0], velocity[0, 1], velocity[0, 2]
    terms = coupling.copy()
    couples, leads = len(terms) > 0, len(obstacles.p_WO) > 0
    length, done, slow = 0.0, 0, 400.0 * ending.tolerance * ending.tolerance
    kept, since = 0, 0
    while True:
        square = (p_WG[0] - x) ** 2 + (p_WG[1] - y) ** 2 + (p_WG[2] - z) ** 2
        left = math.sqrt(square)
        arrived = left < ending.tolerance and u * u + v * v + w * w < slow
        if done == len(rest) or (arrived and done >= ending.least):
            break
        if length + left > ending.longest:
            break
        if couples:
            fade = goal_fade(square, baseline, rules.fade)
            for row in range(len(terms)):
                alpha = fade * coupling[row, ALPHA]
                terms[row, ALPHA] = alpha
                terms[row, GUIDANCE_ALPHA] = min(alpha, rules.guidance_gain)
            if leads:
                terms[:, HEADING:NORMAL] = coupling[:, HEADING:NORMAL]
                guide((x, y, z), (u, v, w), p_WG, R_WL, obstacles, terms)
        p, q, r = rest[done, 0], rest[done, 1], rest[done, 2]
        e, f, g = x - p, y - q, z - r
        e, u = a * e + b * u, c * e + d * u
        f, v = a * f + b * v, c * f + d * v
        g, w = a * g + b * w, c * g + d * w
        if couples:
            turn = turn_step(
                terms,
                facts.in_plane,
                facts.original,
                rules.printed,
                rules.max_rate,
                (p + e, q + f, r + g),
                (u, v, w),
                ds,
            )
            u, v, w = rotate((u, v, w), turn)
        e, u = a * e + b * u, c * e + d * u
        f, v = a * f + b * v, c * f + d * v
        g, w = a * g + b * w, c * g + d * w
        e, f, g = p + e, q + f, r + g
        length += math.sqrt((e - x) ** 2 + (f - y) ** 2 + (g - z) ** 2)
        x, y, z = e, f, g
        done, since = done + 1, since + 1
        if since == every:
            kept, since = kept + 1, 0
            path[kept, 0], path[kept, 1], path[kept, 2] = x, y, z
            velocity[kept, 0], velocity[kept, 1], velocity[kept, 2] = u, v, w
    return done, length, left


@compiled
def take_step(
    before: Motion,
    primitive: Primitive,
    rules: Rules,
    facts: Facts,
    obstacles: Obstacles,
    scale: float,
    evasion: FloatArray,
    time: float,
    step: float,
) -> tuple[Motion, int]:
    """Takes a step of the policy.

    Args:
        before: the motion in the step before; its end is the beginning of this one.
        primitive: of three dimensions.
        rules, facts, obstacles: how coupling terms act, and which.
        scale: fraction of full speed, 1 / (tau T), that the motion approaches.
        evasion: (3,) velocity of an additional displacement at the end of the step [m/s].
        time: now [s].
        step: length of the step [s].

    Returns:
        The motion in this step, and the reason to hold it; or BAD_STEP.
    """
    now, p_WG, R_WL = before.end, before.p_WG, before.R_WL
    code = hold_code(now.p_WE, p_WG, facts, obstacles, time, rules.max_age)
    # What is held before it has begun does not begin.
    at_speed = 0.0 if code != FREE and now.phase == 1.0 else now.speed
    begin = Instant(now.p_WE, now.z_W, now.phase, at_speed, time)
    square = 0.0
    for i in range(3):
        square += (p_WG[i] - before.p_WS[i]) ** 2
    baseline = math.sqrt(square)
    tau = before.tau
    if facts.tau > 0.0:
        tau = facts.tau
    elif facts.path_length >= 0.0:
        tau = max(1.0, facts.path_length / baseline)
    target = 0.0 if code != FREE else scale / (tau * primitive.duration)
    most = step / (primitive.duration * rules.hold_time)
    speed = at_speed + min(max(target - at_speed, -most), most)
    ds = 0.5 * (at_speed + speed) * step
    if not 0.0 <= ds < math.inf:
        return before, BAD_STEP
    p, z, phase = now.p_WE.copy(), now.z_W.copy(), now.phase
    if ds > 0.0:
        alpha_k = primitive.alpha_k
        force, rest = np.empty(3), np.empty((1, 3))
        forcing(primitive.basis, phase * math.exp(-0.5 * alpha_k * ds), force)
        phase *= math.exp(-alpha_k * ds)
        share = baseline / (primitive.alpha_x * primitive.beta_x)
        for i in range(3):
            along = R_WL[i, 0] * force[0] + R_WL[i, 1] * force[1] + R_WL[i, 2] * force[2]
            rest[0, i] = p_WG[i] + along * share
        path, velocity = np.empty((2, 3)), np.empty((2, 3))
        path[0], velocity[0] = p, z
        advance(
            path,
            velocity,
            1,
            rest,
            spring_flow(primitive.alpha_x, primitive.beta_x, 0.5 * ds),
            ds,
            Ending(1, 0.0, math.inf),
            p_WG,
            R_WL,
            baseline,
            rules,
            facts,
            obstacles,
            obstacles.terms if facts.couples else obstacles.terms[:0],
        )
        p, z = path[1].copy(), velocity[1].copy()
    displaced = evasion.copy()
    for i in range(3):
        if before.evasion[i] != 0.0 or evasion[i] != 0.0:
            p[i] += 0.5 * (before.evasion[i] + evasion[i]) * step
    end = Instant(p, z, phase, speed, time + step)
    course = course_between(begin, end, before.evasion, displaced)
    return Motion(begin, end, tau, before.p_WS, p_WG, R_WL, displaced, course), code


@compiled
def course_between(
    begin: Instant, end: Instant, evasion: FloatArray, evasion_end: FloatArray
) -> Course:
    """The course from one instant to the next, displaced (3,) [m/s] besides."""
    length = end.stamp - begin.stamp
    v, v_end = np.empty(3), np.empty(3)
    drift, acceleration = np.empty(3), np.zeros(3)
    for i in range(3):
        v[i] = begin.speed * begin.z_W[i] + evasion[i]
        v_end[i] = end.speed * end.z_W[i] + evasion_end[i]
        drift[i] = v[i]
        if length > 0.0:
            mean = (end.p_WE[i] - begin.p_WE[i]) / length
            drift[i] = v[i] + (mean - 0.5 * (v[i] + v_end[i]))
            acceleration[i] = (v_end[i] - v[i]) / length
    return Course(begin.stamp, end.stamp, begin.p_WE, v, v_end, drift, acceleration)
