"""The action level as the authors' released code integrates it, for comparison."""

from __future__ import annotations

import math
from typing import Literal

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import dead_zone_free_rate, original_rate


def euler_trajectory(
    center: FloatArray,
    goal: FloatArray,
    forcing: FloatArray,
    parameters: tuple[float, ...],
    *,
    term: Literal["dead_zone_free", "original"] = "dead_zone_free",
    tau: float = 1.0,
    alpha_x: float = 10.0,
    beta_x: float = 2.5,
    step: float = 0.005,
    start: FloatArray | None = None,
) -> FloatArray:
    """Path as the paper's released code integrates it, for comparison.

    It differs from the project's own integration: the coupling term is an explicit
    push of the true velocity, tau squared multiplies the spring instead of scaling
    time, the forcing term is not scaled, and the step is semi-implicit Euler:
    a = tau^2 (alpha_x beta_x (g - x) - alpha_x v) + f + R v theta', then v, then x.

    Args:
        center: (3,) centre of the obstacle [m].
        goal: (3,) goal [m].
        forcing: (N, 3) forcing term at each step [m/s^2].
        parameters: (alpha, psi, kappa) of the dead-zone free term, or (gamma, beta)
            of the original one.
        term: which avoidance term.
        tau: their temporal scaling.
        alpha_x: spring constant.
        beta_x: spring constant.
        step: [s].
        start: (3,) start [m], at rest; None: the origin.

    Returns:
        (N, 3) positions after each step [m].

    Raises:
        ValueError: for an unknown term or the wrong number of parameters.
    """
    needed = {"dead_zone_free": 3, "original": 2}
    if needed.get(term) != len(parameters):
        raise ValueError(
            f'term must be "dead_zone_free" with 3 parameters or "original" with 2, '
            f"not {term!r} with {len(parameters)}"
        )
    x = np.zeros(3) if start is None else np.array(start, dtype=float)
    v = np.zeros(3)
    path = np.empty((len(forcing), 3))
    for row, push in enumerate(forcing):
        to_O = center - x
        force = np.zeros(3)
        distance, speed = float(np.linalg.norm(to_O)), float(np.linalg.norm(v))
        if distance > 0.0 and speed > 0.0:
            axis = np.cross(to_O, v)
            size = float(np.linalg.norm(axis))
            theta = math.acos(min(1.0, max(-1.0, float(to_O @ v) / (distance * speed))))
            if size > 0.0:
                if term == "original":
                    rate = original_rate(theta, *parameters)
                else:
                    rate = dead_zone_free_rate(theta, distance, *parameters)
                force = np.cross(axis / size, v) * rate
        acceleration = tau**2 * (alpha_x * beta_x * (goal - x) - alpha_x * v) + push + force
        v = v + step * acceleration
        x = x + step * v
        path[row] = x
    return path
