"""Reference form of one step of the movement primitive, with NumPy and SciPy."""

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
    """Computes one step of the policy over normalized time ds = dt / (tau T).

    The step is half a step of the spring, the rotation of z by the coupling terms, and the other
    half step of the spring. Both parts are exact flows: the rotation preserves the length of z, and
    without forcing term the energy alpha_x beta_x |g - x|^2 / 2 + |z|^2 / 2 never increases. The
    forcing term is constant at its value in the middle of the step.

    Args:
        dmp: movement primitive of three dimensions.
        p: (3,) position [m].
        z: (3,) scaled velocity [m].
        k: phase.
        ds: step in normalized time.
        goal: (3,) goal [m].
        spread: (3, 3) baseline of the motion times R_WL, see `local_frame` [m].
        turn: function of p_WE [m], z_W [m] and the step that returns the rotation vector (3,) of z
            over the step [rad].

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
