"""Action level (equations of motion) of the paper's released code, for its tables and training.

Differences from the running system's action level (`drake_oa.policy`): the coupling term
accelerates the unscaled velocity, tau^2 multiplies the spring instead of scaling time, the forcing
term is not scaled, and integration is semi-implicit Euler. With the coupling term C::

    a = tau^2 alpha_x (beta_x (g - x) - v) + f + C
    v += h a,   x += h v
    C = alpha exp(-theta^2 / psi^2 - kappa d^2) n x v     (eq. 8)
    C = gamma theta exp(-beta theta) n x v                (eq. 7, Hoffmann's)

theta is the angle from v to the direction of the obstacle's center, d the distance of the center,
and n the normal of the plane of both directions. If they span no plane, the previous normal is
used, initially z_L, so that a motion straight at the center turns to the left.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.policy.coupling import (
    Triple,
    cross,
    dead_zone_free_rate,
    dot,
    mixed,
    norm,
    original_rate,
    scaled,
    triple,
)

ALPHA_X = 10.0
"""Damping gain alpha_x of the spring in the released code [1/s]."""
BETA_X = 2.5
"""Stiffness ratio beta_x of the spring in the released code [1/s]."""
ALPHA_K = 0.5
"""Decay rate of the phase in the released code [1/s]."""
N_BASIS = 35
"""Number of basis functions of the forcing term in the released code."""

_PARALLEL = 1e-9
"""Sine of the angle between two directions below which they span no plane."""
_STILL = 1e-5
"""Speed below which the coupling term is 0 [m/s]."""
_MAX_SPEED = 1e4
"""Speed above which a motion counts as diverged and ends [m/s]."""


class Steps(NamedTuple):
    """Time steps of a roll-out.

    Attributes:
        number: number of steps.
        length: duration of a step [s].
    """

    number: int
    length: float


STEPS = Steps(1000, 0.003)
"""Time steps of the motions in the paper's training set."""


@cache
def released_forcing(steps: Steps) -> FloatArray:
    """Computes the forcing term (S,) of a straight demonstration over 1 m [m/s^2].

    The demonstration has constant speed. Its forcing term is fitted, for each basis function, by a
    quadratic polynomial of the phase. Basis functions are Gaussians with the mean and variance of
    the phase in equal parts of its range.
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
    """Roll-out of N motions from rest at the origin to (baseline, 0, 0), with one obstacle each.

    Attributes:
        position: (N, 3) positions [m].
        velocity: (N, 3) velocities [m/s].
        normal: (N, 3) unit normals n of the planes through velocity and obstacle's center.
        angle: (N,) angles theta between velocity and direction of the obstacle's center [rad].
        distance: (N,) distances d of the obstacle's center [m]; 0 if the coupling term is 0.
        is_over: (N,) whether the motion has ended and stays at rest.
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
        end: Triple = (0.0, 0.0, 0.0),
    ) -> None:
        """Starts the motions at rest at the origin.

        Args:
            baseline: (N,) distances from start to goal [m].
            center: (N, 3) centers of the obstacles [m].
            tau: (N,) temporal scalings.
            steps: time steps of the demonstration; afterwards the forcing term is 0.
            original: whether the coupling term is Hoffmann's (eq. 7).
            end: semi-axes of an ellipsoid around each center, inside which motions end [m].
        """
        goal, stiffness = baseline[:, None] * (1.0, 0.0, 0.0), ALPHA_X * tau**2
        self._constants = goal, center, stiffness, end, original, steps.length
        self._forcing = np.append(released_forcing(steps), 0.0)
        self.position, self.velocity = np.zeros((2, len(tau), 3))
        self.normal = np.tile((0.0, 0.0, 1.0), (len(tau), 1))
        self.angle, self.distance = np.zeros((2, len(tau)))
        self.is_over, self.number = np.zeros(len(tau), bool), 0

    def advance(self, parameters: FloatArray, count: int = 1) -> FloatArray:
        """Integrates all motions over a number of steps.

        Args:
            parameters: (N, 3) alpha [rad/s], psi [rad] and kappa [1/m^2]; for the original term
                gamma [1/s], beta [1/rad] and an unused value.
            count: number of steps.

        Returns:
            (N, count + 1, 3) positions at the start and after each step [m].
        """
        forcing = np.take(self._forcing, self.number + np.arange(count), mode="clip")
        path = np.repeat(self.position[:, None], count + 1, axis=1)
        self.velocity = self.velocity.copy()
        _advance(
            path,
            (self.velocity, self.normal, self.angle, self.distance, self.is_over),
            self._constants,
            parameters,
            forcing,
        )
        self.position, self.number = path[:, -1], self.number + count
        return path


_rate, _original_rate = compiled(dead_zone_free_rate), compiled(original_rate)


@compiled
def _advance(
    path: FloatArray,
    state: tuple[FloatArray, ...],
    constants: tuple[FloatArray, FloatArray, FloatArray, Triple, bool, float],
    parameters: FloatArray,
    forcing: FloatArray,
) -> None:
    """Integrates N motions over S steps and writes positions (N, S + 1, 3) to `path`.

    The first positions are read as the start; the arrays of `state` are updated.
    """
    velocity, normal, angle, distance, is_over = state
    goal, center, stiffness, end, original, h = constants
    for n in range(len(path)):
        p, v, (gain, width, decay) = triple(path[n], 0), triple(velocity, n), triple(parameters, n)
        for s in range(len(forcing)):
            if not is_over[n]:
                rate, d = 0.0, distance[n]
                if d > 0.0 and original:
                    rate = _original_rate(angle[n], gain, width)
                elif d > 0.0:
                    rate = _rate(angle[n], d, gain, width, decay)
                push = mixed(rate, cross(triple(normal, n), v), forcing[s], triple(goal, n))
                pull = mixed(BETA_X, mixed(1.0, triple(goal, n), -1.0, p), -1.0, v)
                v = mixed(1.0, v, h, mixed(stiffness[n], pull, 1.0, push))
                is_over[n] = not norm(v) < _MAX_SPEED
            if is_over[n]:
                v, path[n, s + 1] = (0.0, 0.0, 0.0), p
                continue
            path[n, s + 1] = p = mixed(1.0, p, h, v)
            to_O = mixed(1.0, triple(center, n), -1.0, p)
            across, speed = cross(to_O, v), norm(v)
            size = norm(across)
            distance[n] = norm(to_O) if speed >= _STILL else 0.0
            angle[n] = math.atan2(size, dot(to_O, v))
            if 0.0 < _PARALLEL * distance[n] * speed < size:
                normal[n] = scaled(1.0 / size, across)
            x = to_O[0] / end[0], to_O[1] / end[1], to_O[2] / end[2]
            is_over[n] = dot(x, x) < 1.0
        velocity[n] = v
