"""The movement primitive and its step, readable: arrays of any dimension, one step at a time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import Dmp, Trajectory, local_frame, spring_flow

Turn = Callable[[FloatArray, FloatArray, float], FloatArray]
"""Turn (3,) [rad] of z over a step, of p_WE (3,) [m], z_W (3,) [m] and the step in s."""


def forcing(dmp: Dmp, k: float) -> FloatArray:
    """(D,) forcing term f(k), (eq. 3), in the local frame for a baseline of 1 m [m]."""
    exponent = -dmp.widths * (k - dmp.centers) ** 2
    basis = np.exp(exponent - exponent.max())
    return np.asarray(dmp.weights @ basis * (k / basis.sum()))


def step(
    dmp: Dmp,
    p: FloatArray,
    z: FloatArray,
    k: float,
    ds: float,
    goal: FloatArray,
    *,
    frame: FloatArray,
    baseline: float,
    turn: Turn | None = None,
) -> tuple[FloatArray, FloatArray, float]:
    """One step of the whole action level over ds = dt / (tau T).

    Half a step of the spring, a turn of z by the coupling terms, half a step of the
    spring. Both parts are exact flows: the turn keeps the length of z, and without
    forcing the energy alpha_x beta_x |g - x|^2 / 2 + |z|^2 / 2 never rises, whatever
    the turn. The forcing term is held at its value in the middle of the step.

    Args:
        dmp: the movement primitive, of D dimensions.
        p: (D,) position [m].
        z: (D,) scaled velocity [m].
        k: phase.
        ds: step of normalised time, at least 0.
        goal: (D,) goal [m].
        frame: (3, 3) R_WL of this motion, see `local_frame`.
        baseline: distance from start to goal of this motion [m].
        turn: turn of z over a step, for example `coupling.turning`; D must be 3
            then. None: no coupling.

    Returns:
        p, z and k at the end of the step.

    Raises:
        ValueError: for a step that is negative or not finite.
    """
    if not 0.0 <= ds < math.inf:
        raise ValueError(f"ds must be finite and at least 0, not {ds}")
    if ds == 0.0:
        return p, z, k
    middle = k * math.exp(-0.5 * dmp.alpha_k * ds)
    force = (frame @ forcing(dmp, middle)) * (baseline / (dmp.alpha_x * dmp.beta_x))
    rest = (goal + force).tolist()
    flow = spring_flow(dmp.alpha_x, dmp.beta_x, ds if turn is None else 0.5 * ds)
    position, velocity = _spring(p.tolist(), z.tolist(), rest, flow)
    if turn is not None:
        p_W, z_W = np.array(position), np.array(velocity)
        velocity = Rotation.from_rotvec(turn(p_W, z_W, ds)).apply(z_W).tolist()
        position, velocity = _spring(position, velocity, rest, flow)
    return np.array(position), np.array(velocity), k * math.exp(-dmp.alpha_k * ds)


def _spring(
    x: list[float], z: list[float], rest: list[float], flow: tuple[float, float, float, float]
) -> tuple[list[float], list[float]]:
    a, b, c, d = flow
    position = [r + a * (q - r) + b * v for q, v, r in zip(x, z, rest, strict=True)]
    velocity = [c * (q - r) + d * v for q, v, r in zip(x, z, rest, strict=True)]
    return position, velocity


def trajectory(
    dmp: Dmp,
    start: ArrayLike,
    goal: ArrayLike,
    *,
    steps: int = 500,
    end: float = 1.0,
    turn: Turn | None = None,
) -> Trajectory:
    """As `drake_oa.policy.dmp.trajectory`, with a turn as in `step`."""
    p, g = np.array(start, dtype=float), np.array(goal, dtype=float)
    frame = local_frame(p, g)
    baseline = float(np.linalg.norm(g - p))
    z, k, ds = np.zeros_like(p), 1.0, end / steps
    samples = [(p, z, k)]
    for _ in range(steps):
        p, z, k = step(dmp, p, z, k, ds, g, frame=frame, baseline=baseline, turn=turn)
        samples.append((p, z, k))
    return Trajectory(
        np.linspace(0.0, end, steps + 1),
        *(np.array(column) for column in zip(*samples, strict=True)),
    )
