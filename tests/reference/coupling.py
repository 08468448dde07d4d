"""The coupling terms of `drake_oa.policy.coupling`, readable: in vectors, a term at a time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import (
    MAX_GUIDANCE_RATE,
    N_COLUMNS,
    PARALLEL,
    dead_zone_free_rate,
)
from tests.reference.dmp import Turn

UP, AHEAD = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
MAX_STIFFNESS = 1e4


def terms(
    p_WO: ArrayLike,
    parameters: ArrayLike,
    heading: ArrayLike = (0.0, 0.0, 0.0),
    normal: ArrayLike = (0.0, 0.0, 0.0),
    guidance_alpha: ArrayLike | None = None,
) -> FloatArray:
    """(M, 13) rows as `turn_step` takes them, of lists; guidance as strong as alpha by default."""
    centers = np.atleast_2d(np.asarray(p_WO, dtype=float))
    rows = np.zeros((len(centers), N_COLUMNS))
    for first, values in ((0, centers), (3, parameters), (6, heading), (9, normal)):
        rows[:, first : first + 3] = values
    rows[:, 12] = rows[:, 3] if guidance_alpha is None else guidance_alpha
    return rows


def turning(
    rows: FloatArray,
    *,
    in_plane: bool = False,
    printed: bool = False,
    max_rate: float = MAX_GUIDANCE_RATE,
) -> Turn:
    """The terms' turn over a step, for `tests.reference.dmp.step`."""

    def turn(p: FloatArray, z: FloatArray, step: float) -> FloatArray:
        # Linearly implicit: each term alone turns as its own exact flow does.
        A, b = np.eye(3), np.zeros(3)
        for axis, rate, angle in active(rows, p, z, step, in_plane, printed, max_rate):
            if angle > 0.0:
                divisor = min(max(rate * step / angle, 1.0), MAX_STIFFNESS)
                A += (divisor - 1.0) * np.outer(axis, axis)
                b += divisor * angle * axis
        w = np.linalg.solve(A, b)
        return np.asarray(w * min(1.0, np.pi / max(float(np.linalg.norm(w)), 1e-300)))

    return turn


def active(
    rows: FloatArray,
    p: FloatArray,
    z: FloatArray,
    step: float,
    in_plane: bool,
    printed: bool,
    max_rate: float,
) -> Iterator[tuple[FloatArray, float, float]]:
    """Axis, rate and, over the step, the exact angle of each term that acts."""
    if not z.any():
        return
    e = z / np.linalg.norm(z)
    for row in rows:
        to_O, (alpha, psi, kappa) = row[:3] - p, row[3:6]
        d = float(np.linalg.norm(to_O))
        v_d, normal, guide = row[6:9], row[9:12], row[12]
        if d > 0.0 and alpha > 0.0:
            seen_along = normal if in_plane else np.zeros(3)
            axis, theta = between(to_O / d, e, seen_along)
            if axis is None and theta == 0.0:
                axis = stand_in(normal, e)
            rate = float(dead_zone_free_rate(theta, d, alpha, psi, kappa))
            if axis is not None:
                yield axis, rate, min(avoidance_angle(rate, theta, psi, step), np.pi - theta)
        if guide > 0.0 and v_d.any():
            axis, theta = between(e, v_d / np.linalg.norm(v_d))
            if axis is None and theta > 0.0:
                axis = stand_in(normal, e)
            closeness = kappa * d * d
            # (eq. 9), in the counterphase or as the paper prints it, saturated.
            gain = guide * (
                np.exp(min(1.0 + closeness, 600.0)) if printed else -np.expm1(-closeness)
            )
            limit = max_rate if printed else np.inf
            if axis is not None and gain > 0.0:
                yield axis, min(gain * theta, limit), guidance_angle(gain, theta, limit, step)


def avoidance_angle(rate: float, theta: float, psi: float, step: float) -> float:
    """Of theta' = A exp(-theta^2 / psi^2), rate at theta; within 2.5 % of the exact one.

    With u = theta / psi and c = rate step / psi the exact u' solves
    int_u^u' exp(x^2 - u^2) dx = c. Here u'^2 = u^2 + log(1 + c g), where
    g = 2 u + asinh(c / sqrt(1 + 2 u c)).
    """
    u, c = theta / psi, rate * step / psi
    if c < 1e-14:
        return rate * step
    grown = np.log1p(c * (2.0 * u + np.arcsinh(c / np.sqrt(1.0 + 2.0 * u * c))))
    return float(psi * grown / (u + np.sqrt(u * u + grown)))


def guidance_angle(gain: float, theta: float, limit: float, step: float) -> float:
    """Of theta' = -min(gain theta, limit)."""
    at_limit = max(theta / limit - 1.0 / gain, 0.0)
    if step < at_limit:
        return limit * step
    left = min(theta, limit / gain)
    return float(theta - left * np.exp(-gain * (step - at_limit)))


def between(
    a: FloatArray, b: FloatArray, normal: FloatArray | None = None
) -> tuple[FloatArray | None, float]:
    """Axis (None: undefined) and angle of the turn from unit a to unit b.

    Seen along a normal that is not zero the axis is the normal or its opposite, and undefined
    where the two are opposite or one of them is seen as a point.
    """
    if normal is None or not normal.any():
        across = np.cross(a, b)
        sine, cosine = float(np.linalg.norm(across)), float(a @ b)
        if sine > PARALLEL:
            return across / sine, float(np.arctan2(sine, cosine))
        return None, 0.0 if cosine > 0.0 else np.pi
    n = normal / np.linalg.norm(normal)
    sine, cosine = float(n @ np.cross(a, b)), float(a @ b - (a @ n) * (b @ n))
    if abs(sine) <= PARALLEL:
        return (n, 0.0) if cosine > PARALLEL else (None, np.pi)
    return np.sign(sine) * n, float(np.arctan2(abs(sine), cosine))


def stand_in(normal: FloatArray, e: FloatArray) -> FloatArray:
    """The normal, the vertical or the world's x axis, the first that is not along e, made
    orthogonal to it."""
    for n in (normal, UP, AHEAD):
        across = n - (n @ e) * e
        if np.linalg.norm(across) > 1e-3 * np.linalg.norm(n):
            return np.asarray(across / np.linalg.norm(across))
    raise ValueError(f"the heading {e} must be a unit vector")
