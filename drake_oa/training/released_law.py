"""The action level as the authors' released code integrates it, for tables and training.

It differs from the running system's (`drake_oa.policy`): the coupling terms push the true velocity,
tau^2 multiplies the spring instead of scaling time, the forcing term is not scaled, and the step is
semi-implicit Euler. With the coupling term C::

    a = tau^2 alpha_x (beta_x (g - x) - v) + f + C
    v += h a,   x += h v
    C = alpha exp(-theta^2 / psi^2 - kappa d^2) n x v     (eq. 8)
    C = gamma theta exp(-beta theta) n x v                (eq. 7, Hoffmann's)

theta is the angle from v to the way to the obstacle's center, d the length of that way, and n the
normal of the plane of both. Where they span no plane, the last normal remains, at first z_L: a
heading exactly at the center turns to the left.
"""

from __future__ import annotations

from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from drake_oa.common.messages import FloatArray

ALPHA_X, BETA_X, ALPHA_K, N_BASIS = 10.0, 2.5, 0.5, 35
"""Constants of the released code."""

_PARALLEL = 1e-9
"""Sine of the angle below which two directions span no plane."""
_STILL = 1e-5
"""Speed below which no coupling term acts [m/s]."""
_MIN_PSI = 1e-6
"""Minimum psi [rad]."""
_MAX_SPEED = 1e4
"""Speed at which a motion has diverged and ends [m/s]."""


class Steps(NamedTuple):
    """`number` steps of `length` seconds."""

    number: int
    length: float


STEPS = Steps(1000, 0.003)
"""Time steps of the training set."""


@cache
def released_forcing(steps: Steps) -> FloatArray:
    """Computes the forcing term of a straight demonstration over 1 m, (S,) [m/s^2].

    The demonstration runs at constant speed over all steps. Its force is fitted by a
    quadratic in the phase for each of the basis functions, which are Gaussians of the
    mean and variance of the phase in equal parts of its range.
    """
    k = (1.0 - ALPHA_K * steps.length) ** np.arange(steps.number)
    speed = 1.0 / ((steps.number - 1) * steps.length)
    force = ALPHA_X * (speed - BETA_X * (1.0 - np.linspace(0.0, 1.0, steps.number)))
    edges = np.linspace(k.min(), k.max(), N_BASIS + 1)
    parts = [k[(k >= a) & (k < b)] for a, b in pairwise(edges)]
    mean = np.array([part.mean() for part in parts])[:, None]
    variance = np.array([part.var(ddof=1) + 1e-8 for part in parts])[:, None]
    basis = np.exp(-0.5 * (k - mean) ** 2 / variance) / np.sqrt(variance)
    basis /= basis.sum(axis=0)
    fits = [np.polynomial.Polynomial.fit(k, force, 2, w=np.sqrt(share)) for share in basis]
    return np.sum([share * fit(k) for share, fit in zip(basis, fits, strict=True)], axis=0)


class ReleasedMotions:
    """N motions from rest at the origin to (baseline, 0, 0), past an obstacle each.

    Attributes:
        position, velocity: (N, 3) [m, m/s].
        normal: (N, 3) unit normals n of the planes of motion and obstacle.
        angle: (N,) angles theta [rad].
        distance: (N,) distances d [m]; 0 where no coupling term acts.
        is_over: (N,) whether the motion stays where it is.
        number: number of completed steps.
    """

    def __init__(
        self,
        baseline: FloatArray,
        center: FloatArray,
        tau: FloatArray,
        *,
        steps: Steps = STEPS,
        original: bool = False,
    ) -> None:
        """Stores the constants.

        Args:
            baseline: (N,) [m].
            center: (N, 3) centers of the obstacles [m].
            tau: (N,) time scale.
            steps: time steps; the forcing term ends with them.
            original: whether the coupling terms are those of (eq. 7).
        """
        self._goal = baseline[:, None] * (1.0, 0.0, 0.0)
        self._center = center
        self._stiffness, self._step, self._original = ALPHA_X * tau[:, None] ** 2, steps, original
        self._forcing = released_forcing(steps)
        self.position, self.velocity = np.zeros((2, len(tau), 3))
        self.normal = np.tile((0.0, 0.0, 1.0), (len(tau), 1))
        self.angle, self.distance = np.zeros((2, len(tau)))
        self.is_over, self.number = np.zeros(len(tau), bool), 0

    def advance(self, parameters: FloatArray) -> None:
        """Completes a step.

        Args:
            parameters: (N, 3) alpha [rad/s], psi [rad] and kappa [1/m^2], or gamma [1/s],
                beta [1/rad] and a value without a meaning.
        """
        h, p, v = self._step.length, self.position, self.velocity
        gain, width, decay = np.moveaxis(parameters, -1, 0)
        if self._original:
            rate = gain * self.angle * np.exp(-width * self.angle)
        else:
            narrow = self.angle / np.maximum(np.abs(width), _MIN_PSI)
            near = np.maximum(decay, 0.0) * self.distance**2
            rate = np.maximum(gain, 0.0) * np.exp(-(narrow**2) - near)
        push = np.where(self.distance > 0.0, rate, 0.0)[:, None] * np.cross(self.normal, v)
        if self.number < len(self._forcing):
            push += self._forcing[self.number] * self._goal
        v = v + h * (self._stiffness * (BETA_X * (self._goal - p) - v) + push)
        self.is_over |= ~(np.abs(v).sum(axis=1) < _MAX_SPEED)
        goes, self.number = ~self.is_over[:, None], self.number + 1
        self.velocity = v = np.where(goes, v, 0.0)
        self.position = p = np.where(goes, p + h * v, p)
        to_O, across = self._center - p, np.cross(self._center - p, v)
        d, speed, size = (np.linalg.norm(x, axis=1) for x in (to_O, v, across))
        self.distance = np.where(speed >= _STILL, d, 0.0)
        self.angle = np.arctan2(size, np.einsum("ni,ni->n", to_O, v))
        spans = (size > _PARALLEL * d * speed) & (speed >= _STILL)
        self.normal[spans] = across[spans] / size[spans, None]
