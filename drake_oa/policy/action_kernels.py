"""Integration of the action level, compiled: steps of the spring, turned by the coupling terms.

`DmpIntegrator` advances by one step at a time, a roll-out by all of them.
"""

from __future__ import annotations

import cmath
import math
from typing import NamedTuple

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import Triple, mixed, norm, rotate, triple, turn_step
from drake_oa.policy.guidance import Obstacles, guide

Flow = tuple[float, float, float, float]


def spring_flow(alpha_x: float, beta_x: float, step: float) -> Flow:
    """Exact flow of the spring dz/ds = -alpha_x (beta_x e + z), de/ds = z over a step.

    Args:
        alpha_x: spring constant.
        beta_x: spring constant; any damping.
        step: length of the step, at least 0.

    Returns:
        a, b, c, d with e <- a e + b z and z <- c e + d z.
    """
    stiffness, half = alpha_x * beta_x, 0.5 * alpha_x
    omega = cmath.sqrt(half * half - stiffness)
    if abs(omega) <= 1e-7 * half:
        cosine = math.exp(-half * step)
        sine = cosine * step
    else:
        slow, fast = cmath.exp((omega - half) * step), cmath.exp(-(omega + half) * step)
        cosine, sine = 0.5 * (slow + fast).real, 0.5 * ((slow - fast) / omega).real
    return cosine + half * sine, sine, -stiffness * sine, cosine - half * sine


class MotionSetup(NamedTuple):
    """Constants of steps of equal length.

    Attributes:
        rest: (T, 3) equilibrium of the spring in the middle of each step, displaced from the goal
            by the forcing term [m].
        flow: of the spring over half a step, see `spring_flow`.
        ds: length of a step in normalized time.
        p_WG: (3,) goal [m].
        x_L: (3,) vector from start to goal.
        fade: distance from the goal within which the coupling fades [m]; 0: it does not.
        every: number of steps from one row of the path to the next.
        least: number of steps before which it does not arrive.
        tolerance: distance from the goal at which it arrives, if it is slow [m].
    """

    rest: FloatArray
    flow: Flow
    ds: float
    p_WG: Triple
    x_L: Triple
    fade: float = 0.0
    every: int = 1
    least: int = 0
    tolerance: float = 0.0


@compiled
def spring(p: Triple, z: Triple, rest: Triple, flow: Flow) -> tuple[Triple, Triple]:
    """Position and scaled velocity after a step of the spring, see `spring_flow`."""
    a, b, c, d = flow
    e = mixed(1.0, p, -1.0, rest)
    return mixed(1.0, rest, 1.0, mixed(a, e, b, z)), mixed(c, e, d, z)


@compiled
def advance(
    course: MotionSetup,
    obstacles: Obstacles,
    coupling: FloatArray,
    longest: float,
    path: FloatArray,
    velocity: FloatArray,
) -> tuple[float, float, int]:
    """Advances the position and the scaled velocity by up to T steps.

    A step is half a step of the spring, the turn by the coupling terms, and the spring's other
    half. The coupling would keep turning the motion around the goal: near it alpha fades by the
    power (distance / fade)^4, which is steep, as alpha acts by its logarithm.

    Args:
        course: the motion.
        obstacles: the obstacles that lead the headings of the terms.
        coupling: (K, 12) the coupling terms, not faded; (0, 12): none.
        longest: it ends as soon as its path cannot become shorter than this [m].
        path: (T // every + 1, 3) positions p_WE [m]; the first row is given, the others are
            written.
        velocity: (T // every + 1, 3) scaled velocities z_W [m], likewise.

    Returns:
        The length of the path [m], the distance of its end from the goal [m], and the number of
        steps.
    """
    p, z, terms = triple(path, 0), triple(velocity, 0), coupling.copy()
    length, done = 0.0, 0
    while True:
        left = norm(mixed(1.0, course.p_WG, -1.0, p))
        arrived = left < course.tolerance and norm(z) < 20.0 * course.tolerance
        if done == len(course.rest) or (arrived and done >= course.least):
            break
        if length + left > longest:
            break
        rest = triple(course.rest, done)
        if len(obstacles.p_WO) > 0 and len(terms) > 0:
            guide(p, z, course.p_WG, course.x_L, obstacles, terms)
        after, z = spring(p, z, rest, course.flow)
        if len(terms) > 0:
            fade = min(1.0, left / course.fade) ** 4 if course.fade > 0.0 else 1.0
            z = rotate(z, turn_step(terms, fade, after, z, course.ds))
        after, z = spring(after, z, rest, course.flow)
        length += norm(mixed(1.0, after, -1.0, p))
        p, done = after, done + 1
        if done % course.every == 0:
            for i in range(3):
                path[done // course.every, i], velocity[done // course.every, i] = p[i], z[i]
    return length, left, done
