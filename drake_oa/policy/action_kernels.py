"""Compiled integration of a dynamic movement primitive (DMP) whose coupling terms turn its motion.

`DmpIntegrator` integrates one step per update; a roll-out (simulation) integrates a whole motion.
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
"""Coefficients a, b, c, d of a step of the movement primitive's spring and damper.

The step is e <- a e + b z and z <- c e + d z, with the position e relative to the equilibrium and
the scaled velocity z."""


def spring_flow(alpha_x: float, beta_x: float, step: float) -> Flow:
    """Computes the coefficients of the exact solution of a movement primitive's spring over a step.

    The equations are dz/ds = -alpha_x (beta_x e + z), de/ds = z, with the position e relative to
    the equilibrium, the scaled velocity z and the normalized time s.

    Args:
        alpha_x: gain of spring and damper, per normalized time.
        beta_x: gain of the spring, per normalized time; alpha_x / 4 for critical damping, other
            values are allowed.
        step: length of the step in normalized time, at least 0.

    Returns:
        Coefficients a, b, c, d with e <- a e + b z and z <- c e + d z over the step.
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
    """Constants of the integration of a movement primitive over T steps of equal length.

    Positions are those of the tool point in the world frame. In a primitive of the orientation,
    they are rotation vectors [rad].

    Attributes:
        rest: (T, 3) equilibrium of the spring in the middle of each step, displaced from the goal
            by the forcing term [m].
        flow: coefficients a, b, c, d of half a step of the spring, e <- a e + b z, z <- c e + d z,
            with the position e relative to the equilibrium and the scaled velocity z.
        ds: length of a step in normalized time.
        p_WG: (3,) goal [m].
        x_L: (3,) vector from start to goal [m].
        fade: distance from the goal within which the coupling terms, which turn the motion away
            from obstacles, fade to zero [m]; 0: no fading.
        every: number of steps between the rows of the output path.
        min_steps: minimum number of steps before the integration may end at the goal.
        tolerance: distance from the goal below which the integration ends, if the scaled velocity
            is below 20 times this value [m]; 0: it never ends early for this reason.
    """

    rest: FloatArray
    flow: Flow
    ds: float
    p_WG: Triple
    x_L: Triple
    fade: float = 0.0
    every: int = 1
    min_steps: int = 0
    tolerance: float = 0.0


@compiled
def spring(p: Triple, z: Triple, rest: Triple, flow: Flow) -> tuple[Triple, Triple]:
    """Computes position and scaled velocity after a step of a movement primitive's spring alone.

    Args:
        p: position p_WE before the step [m].
        z: scaled velocity before the step, the derivative of the position by normalized time [m].
        rest: equilibrium of the spring in the world frame [m].
        flow: coefficients a, b, c, d of the step, e <- a e + b z and z <- c e + d z, with
            e = p - rest.

    Returns:
        Position [m] and scaled velocity [m] after the step.
    """
    a, b, c, d = flow
    e = mixed(1.0, p, -1.0, rest)
    return mixed(1.0, rest, 1.0, mixed(a, e, b, z)), mixed(c, e, d, z)


@compiled
def advance(
    setup: MotionSetup,
    obstacles: Obstacles,
    coupling: FloatArray,
    longest: float,
    path: FloatArray,
    velocity: FloatArray,
) -> tuple[float, float, int]:
    """Integrates position and scaled velocity of a motion with coupling terms over up to T steps.

    A step consists of half a step of the spring, the rotation of the scaled velocity by the
    coupling terms, and the other half step of the spring. At a distance from the goal below
    `setup.fade`, the strengths alpha of the coupling terms fade as (distance / fade)^4. Without
    fading the coupling terms would keep the motion circling around the goal. With a power below 4
    they would fade too slowly, because their effect depends on the logarithm of alpha.

    Args:
        setup: constants of the motion.
        obstacles: obstacles from which the guidance headings of the coupling terms, directions past
            the obstacles on their selected sides, are computed in each step; `NO_OBSTACLES`: the
            headings in `coupling` remain.
        coupling: (K, 12) coupling terms without fading, with the columns obstacle's center p_WO
            (3), alpha, psi, kappa, guidance heading (3) and normal of the plane of rotation (3).
        longest: maximum path length [m]; the integration ends as soon as the length so far plus
            the distance from the goal exceeds it.
        path: (T // every + 1, 3) positions p_WE, one for each `every` steps [m]; the first row is
            input, the others output.
        velocity: (T // every + 1, 3) scaled velocities z_W at these positions [m]; the first row is
            input, the others output.

    Returns:
        Length of the path [m], distance of its end from the goal [m], and number of steps.
    """
    p, z, terms = triple(path, 0), triple(velocity, 0), coupling.copy()
    length, step = 0.0, 0
    while True:
        distance = norm(mixed(1.0, setup.p_WG, -1.0, p))
        arrived = distance < setup.tolerance and norm(z) < 20.0 * setup.tolerance
        if step == len(setup.rest) or (arrived and step >= setup.min_steps):
            break
        if length + distance > longest:
            break
        rest = triple(setup.rest, step)
        if len(obstacles.p_WO) > 0 and len(terms) > 0:
            guide(p, z, setup.p_WG, setup.x_L, obstacles, terms)
        after, z = spring(p, z, rest, setup.flow)
        if len(terms) > 0:
            fade = min(1.0, distance / setup.fade) ** 4 if setup.fade > 0.0 else 1.0
            z = rotate(z, turn_step(terms, fade, after, z, setup.ds))
        after, z = spring(after, z, rest, setup.flow)
        length += norm(mixed(1.0, after, -1.0, p))
        p, step = after, step + 1
        if step % setup.every == 0:
            for i in range(3):
                path[step // setup.every, i], velocity[step // setup.every, i] = p[i], z[i]
    return length, distance, step
