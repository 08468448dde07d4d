"""Action level (equations of motion) in the released code of Pairet et al., RA-L 2019.

It simulates the motions of the paper's training set and tables.

Differences from this project's action level (`drake_oa.policy`): the coupling term C, which turns
the motion away from an obstacle, is an acceleration that depends on the velocity, instead of an
exact rotation of the scaled velocity tau T v (temporal scaling tau, demonstrated duration T);
spring and damper are multiplied by tau^2, instead of scaling time; the forcing term f does not
depend on tau; and integration is semi-implicit Euler. With the position x, velocity v, goal g and
time step h::

    a = tau^2 alpha_x (beta_x (g - x) - v) + f + C
    v += h a,   x += h v
    C = alpha exp(-theta^2 / psi^2 - kappa d^2) n x v     (eq. 8)
    C = gamma theta exp(-beta theta) n x v                (eq. 7, Hoffmann's)

theta is the angle between v and the direction o from x to the obstacle's center, d the distance of
the center, and n the unit normal of the plane of both directions, along o x v. If they span no
plane, the previous normal is used, initially z (up), so that a motion straight at the center turns
to the left.
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
"""Gain alpha_x of the movement primitive's spring and damper in the code of Pairet et al. [1/s]."""
BETA_X = 2.5
"""Gain beta_x of the movement primitive's spring in the released code of Pairet et al. [1/s]."""
ALPHA_K = 0.5
"""Decay rate of the movement primitive's phase in the released code of Pairet et al. [1/s]."""
N_BASIS = 35
"""Number of basis functions of the forcing term in the released code of Pairet et al. [-].

The forcing term makes a movement primitive reproduce its demonstration."""

_PARALLEL = 1e-9
"""Sine of the angle between velocity and obstacle direction below which they span no plane [-]."""
_STILL = 1e-5
"""Speed below which the coupling term, which turns the motion away from an obstacle, is 0 [m/s]."""
_MAX_SPEED = 1e4
"""Speed above which a simulated motion counts as diverged and ends [m/s]."""


class Steps(NamedTuple):
    """Number and length of the time steps of a roll-out (simulation of a motion).

    Attributes:
        number: number of steps.
        length: duration of a step [s].
    """

    number: int
    length: float


STEPS = Steps(1000, 0.003)
"""Time steps of the motions in the training set of Pairet et al.: 1000 steps of 3 ms each."""


@cache
def released_forcing(steps: Steps) -> FloatArray:
    """Computes the forcing term in the code of Pairet et al. for a straight demonstration of 1 m.

    The forcing term makes a movement primitive reproduce its demonstration, here one of constant
    speed. The range of the phase is divided into `N_BASIS` equal parts. Each part gives a basis
    function: a Gaussian with the mean and variance of the phase's samples in this part, normalized
    by the sum of all Gaussians. A quadratic polynomial of the phase is fitted to the
    demonstration's forcing term for each basis function, with this function as weight. The result
    is the sum of the polynomials times their basis functions.

    Args:
        steps: S time steps of the demonstration.

    Returns:
        (S,) forcing term along the line from start to goal [m/s^2].
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
    """Roll-out (simulation) of N motions by the equations in the released code of Pairet et al.

    Each motion has one obstacle. The motions go from rest at the origin to the goal (baseline, 0,
    0). The coupling term of each motion turns its velocity away from the center of its obstacle.

    Attributes:
        position: (N, 3) positions [m].
        velocity: (N, 3) velocities [m/s].
        normal: (N, 3) unit normals n of the planes spanned by velocity and direction of the
            obstacle's center.
        angle: (N,) angles theta between velocity and direction of the obstacle's center [rad].
        distance: (N,) distances d of the obstacle's center [m]; 0 if the speed is too low for a
            coupling term.
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
        """Initializes N motions at rest at the origin, before their first time step.

        Args:
            baseline: (N,) distances from start to goal [m].
            center: (N, 3) centers of the obstacles [m].
            tau: (N,) temporal scalings, whose squares multiply spring and damper.
            steps: time steps of the demonstration; afterwards the forcing term is 0.
            original: whether the coupling term is that of Hoffmann et al., (7) of Pairet et al.,
                RA-L 2019, instead of (8).
            end: semi-axes along x, y and z of an ellipsoid around each center, inside which motions
                end [m]; zero: motions do not end there.
        """
        goal, stiffness = baseline[:, None] * (1.0, 0.0, 0.0), ALPHA_X * tau**2
        self._constants = goal, center, stiffness, end, original, steps.length
        self._forcing = np.append(released_forcing(steps), 0.0)
        self.position, self.velocity = np.zeros((2, len(tau), 3))
        self.normal = np.tile((0.0, 0.0, 1.0), (len(tau), 1))
        self.angle, self.distance = np.zeros((2, len(tau)))
        self.is_over, self.number = np.zeros(len(tau), bool), 0

    def advance(self, parameters: FloatArray, count: int = 1) -> FloatArray:
        """Integrates all N motions past their obstacles over the next time steps.

        Args:
            parameters: (N, 3) parameters alpha [rad/s], psi [rad] and kappa [1/m^2] of the coupling
                terms; for the original term gamma [1/s], beta [1/rad] and an unused value.
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
    """Integrates N motions past their obstacles over S steps, for `ReleasedMotions.advance`.

    Args:
        path: (N, S + 1, 3) positions [m]; the first is input, the others output.
        state: velocity, normal, angle, distance and is_over of `ReleasedMotions`; updated.
        constants: goals (N, 3) [m], centers of the obstacles (N, 3) [m], tau^2 alpha_x (N,) [1/s],
            semi-axes along x, y and z of the ellipsoid in which motions end [m], whether the
            coupling term is that of Hoffmann et al., and time step [s].
        parameters: (N, 3) parameters of the coupling terms, see `ReleasedMotions.advance`.
        forcing: (S,) forcing term for a distance of 1 m from start to goal [m/s^2].
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
