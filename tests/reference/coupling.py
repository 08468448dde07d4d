"""Reference form of the coupling terms of `drake_oa.policy.coupling`, with NumPy vectors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import PARALLEL, dead_zone_free_rate

MAX_STIFFNESS = 1e4
"""Upper bound of the ratio of initial rate times step to exact rotation of a term [1]."""


def turning(rows: FloatArray, p: FloatArray, z: FloatArray, step: float) -> FloatArray:
    """Computes the rotation vector (3,) [rad] of z by terms (M, 12), as `coupling.turn_step`."""
    # Linearly implicit: a term that acts alone rotates by its exact flow.
    A, b = np.eye(3), np.zeros(3)
    for axis, rate, angle in active(rows, p, z, step):
        if angle > 0.0:
            divisor = min(max(rate * step / angle, 1.0), MAX_STIFFNESS)
            A += (divisor - 1.0) * np.outer(axis, axis)
            b += divisor * angle * axis
    w = np.linalg.solve(A, b)
    return np.asarray(w * min(1.0, np.pi / max(float(np.linalg.norm(w)), 1e-300)))


def active(
    rows: FloatArray, p: FloatArray, z: FloatArray, step: float
) -> Iterator[tuple[FloatArray, float, float]]:
    """Yields axis, rate [rad per normalized time] and exact rotation over the step of each term."""
    if not z.any():
        return
    e = z / np.linalg.norm(z)
    for row in rows:
        to_O, (alpha, psi, kappa) = row[:3] - p, row[3:6]
        d = float(np.linalg.norm(to_O))
        v_d, normal = row[6:9], row[9:12]
        if not alpha > 0.0:
            continue
        if d > 0.0:
            axis, theta = between(to_O / d, e, normal)
            if axis is None and theta == 0.0:
                axis = stand_in(normal, e)
            rate = float(dead_zone_free_rate(theta, d, alpha, psi, kappa))
            if axis is not None:
                yield axis, rate, min(avoidance_angle(rate, theta, psi, step), np.pi - theta)
        if v_d.any():
            axis, theta = between(e, v_d, np.zeros(3))
            if axis is None and theta > 0.0:
                axis = stand_in(normal, e)
            # This gain replaces that of (eq. 9).
            gain = -alpha * np.expm1(-kappa * d * d)
            if axis is not None and gain > 0.0:
                yield axis, gain * theta, -theta * np.expm1(-gain * step)


def avoidance_angle(rate: float, theta: float, psi: float, step: float) -> float:
    """Computes the rotation [rad] over a step of d theta/ds = A exp(-theta^2 / psi^2).

    `rate` is d theta/ds at the initial theta. With u = theta / psi and c = rate step / psi the
    exact u' solves int_u^u' exp(x^2 - u^2) dx = c. The approximation u'^2 = u^2 + log(1 + c g),
    where g = 2 u + asinh(c / sqrt(1 + 2 u c)), has an error of at most 2.5 %.
    """
    u, c = theta / psi, rate * step / psi
    if c < 1e-14:
        return rate * step
    growth = np.log1p(c * (2.0 * u + np.arcsinh(c / np.sqrt(1.0 + 2.0 * u * c))))
    return float(psi * growth / (u + np.sqrt(u * u + growth)))


def between(a: FloatArray, b: FloatArray, normal: FloatArray) -> tuple[FloatArray | None, float]:
    """Computes axis (None: undefined) and angle [rad] of the rotation from unit a to unit b.

    With a nonzero normal, a and b are projected along it: the axis is the normal or its opposite,
    and undefined if the projections are opposite or one of them vanishes.
    """
    if not normal.any():
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
    """Returns a unit vector orthogonal to the unit vector e.

    It is the component of the normal orthogonal to e; for a normal that is zero or parallel to e
    that of the world's z axis, or of its x axis.
    """
    for n in (normal, *np.eye(3)[[2, 0]]):
        across = n - (n @ e) * e
        if np.linalg.norm(across) > 1e-3 * np.linalg.norm(n):
            return np.asarray(across / np.linalg.norm(across))
    raise ValueError(f"the heading {e} must be a unit vector")
