"""The movement primitive's step, readable."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import Dmp


def step(
    dmp: Dmp,
    p: FloatArray,
    z: FloatArray,
    k: float,
    ds: float,
    goal: FloatArray,
    spread: FloatArray,
    turn: Callable[[FloatArray, FloatArray, float], FloatArray],
) -> tuple[FloatArray, FloatArray, float]:
    """One step of the whole action level over ds = dt / (tau T).

    Half a step of the spring, a turn of z by the coupling terms, half a step of the
    spring. Both parts are exact flows: the turn keeps the length of z, and without
    forcing the energy alpha_x beta_x |g - x|^2 / 2 + |z|^2 / 2 never rises, whatever
    the turn. The forcing term is held at its value in the middle of the step.

    Args:
        dmp: the movement primitive, of three dimensions.
        p: (3,) position [m].
        z: (3,) scaled velocity [m].
        k: phase.
        ds: step of normalized time.
        goal: (3,) goal [m].
        spread: (3, 3) baseline of this motion times R_WL, see `local_frame` [m].
        turn: turn (3,) of z over a step, of p_WE [m], z_W [m] and the step [rad].

    Returns:
        p, z and k at the end of the step.
    """
    middle = k * math.exp(-0.5 * dmp.alpha_k * ds)
    basis = np.exp(-dmp.widths * (middle - dmp.centers) ** 2)
    force = dmp.weights @ basis * (middle / basis.sum())
    stiffness = dmp.alpha_x * dmp.beta_x
    rest = goal + spread @ force / stiffness
    half = expm(np.array([[0.0, 1.0], [-stiffness, -dmp.alpha_x]]) * 0.5 * ds)
    e, z = half @ [p - rest, z]
    z = Rotation.from_rotvec(turn(rest + e, z, ds)).apply(z)
    e, z = half @ [e, z]
    return rest + e, z, k * math.exp(-dmp.alpha_k * ds)
