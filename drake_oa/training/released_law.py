"""The action level as the authors' released code integrates it, for tables and training.

It differs from the running system's (`drake_oa.policy`): the coupling terms push the true velocity,
tau^2 multiplies the spring instead of scaling time, the forcing term is not scaled, and the step is
semi-implicit Euler. With the coupling terms C, summed over the obstacles::

    a = tau^2 alpha_x (beta_x (g - x) - v) + f + C
    v += h a,   x += h v
    C = alpha exp(-theta^2 / psi^2 - kappa d^2) n x v     (eq. 8)
    C = gamma theta exp(-beta theta) n x v                (eq. 7, Hoffmann's)

theta is the angle from v to the way to the obstacle's center, d the length of that way, and n the
normal of the plane of both. Where they span no plane, the last normal remains, at first z_L: a
heading exactly at the center turns to the left.
"""

from __future__ import annotations

import math
from functools import cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import parted
from drake_oa.common.messages import BoolArray, FloatArray

ALPHA_X, BETA_X, ALPHA_K, N_BASIS = 10.0, 2.5, 0.5, 35
"""Constants of the released code."""

_PARALLEL = 1e-9
"""Sine of the angle below which two directions span no plane."""
_STILL = 1e-5
"""Speed below which no coupling term acts [m/s]."""
_NARROWEST = 1e-6
"""Least psi [rad]."""
_LOST = 1e4
"""Speed at which a motion has diverged [m/s]: it stops where it is."""


class Steps(NamedTuple):
    """`number` steps of `length` seconds."""

    number: int
    length: float


STEPS = {"training": Steps(1000, 0.003), "demo": Steps(500, 0.005)}
"""Time steps of the training set, and of the released demo program."""


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
    powers = np.column_stack((np.ones(steps.number), k, k * k))
    fitted = np.zeros(steps.number)
    for share in basis:
        root = np.sqrt(share)
        fit = np.linalg.lstsq(powers * root[:, None], force * root, rcond=None)[0]
        fitted += share * (powers @ fit)
    return fitted


class Law(NamedTuple):
    """Constants of N motions from the origin to (baseline, 0, 0), among M obstacles each.

    Attributes:
        baseline: (N,) [m].
        center: (N, M, 3) centers at time 0 [m]; NaN for an obstacle that does not exist.
        drift: (N, M, 3) velocities of the centers [m/s].
        stiffness: (N,) factor on g - x [1/s^2].
        damping: (N,) factor on v [1/s].
        outside: (N,) factor on the forcing and coupling terms.
        step: (N,) time step [s].
        original: whether the coupling terms are those of (eq. 7).
    """

    baseline: FloatArray
    center: FloatArray
    drift: FloatArray
    stiffness: FloatArray
    damping: FloatArray
    outside: FloatArray
    step: FloatArray
    original: bool


class Motion(NamedTuple):
    """State of N motions.

    Attributes:
        path: (N, S + 1, 3) positions at the steps [m].
        velocity: (N, S + 1, 3) velocities there [m/s].
        normal: (N, M, 3) unit normals n of the planes of motion and obstacles.
        angle: (N, M) angles theta [rad].
        distance: (N, M) distances d [m]; 0 where no coupling term acts.
        over: (N,) whether the motion stays where it is.
    """

    path: FloatArray
    velocity: FloatArray
    normal: FloatArray
    angle: FloatArray
    distance: FloatArray
    over: BoolArray

    @staticmethod
    def at_rest(count: int, obstacles: int, steps: int) -> Motion:
        """Returns motions that have not begun."""
        normal = np.zeros((count, obstacles, 3))
        normal[..., 2] = 1.0
        path, velocity = np.zeros((2, count, steps + 1, 3))
        angle, distance = np.zeros((2, count, obstacles))
        return Motion(path, velocity, normal, angle, distance, np.zeros(count, bool))


@parted
def advance(
    part: int, parts: int, first: int, forcing: FloatArray, law: Law, parameters: FloatArray,
    motion: Motion,
) -> None:  # fmt: skip
    """Advances the motions part, part + parts, ... from the step `first` on.

    Args:
        part: number of the part.
        parts: number of parts.
        first: number of the steps before.
        forcing: (K,) forcing term of each step over 1 m [m/s^2].
        law: constants.
        parameters: (N, M, 3) alpha [rad/s], psi [rad] and kappa [1/m^2], or gamma [1/s] and
            beta [1/rad].
        motion: state, advanced by K steps.
    """
    path, velocity, normal = motion.path, motion.velocity, motion.normal
    for n in range(part, len(path), parts):
        h, stiffness, damping, outside = (
            law.step[n],
            law.stiffness[n],
            law.damping[n],
            law.outside[n],
        )
        for k in range(first, first + len(forcing)):
            for i in range(3):
                path[n, k + 1, i], velocity[n, k + 1, i] = path[n, k, i], 0.0
            if motion.over[n]:
                continue
            x, y, z = path[n, k, 0], path[n, k, 1], path[n, k, 2]
            vx, vy, vz = velocity[n, k, 0], velocity[n, k, 1], velocity[n, k, 2]
            px, py, pz = law.baseline[n] * forcing[k - first], 0.0, 0.0
            for m in range(parameters.shape[1]):
                if motion.distance[n, m] > 0.0:
                    strength, width = parameters[n, m, 0], parameters[n, m, 1]
                    theta = motion.angle[n, m]
                    if law.original:
                        rate = strength * theta * math.exp(-width * theta)
                    else:
                        narrow = theta / max(abs(width), _NARROWEST)
                        near = max(parameters[n, m, 2], 0.0) * motion.distance[n, m] ** 2
                        rate = max(strength, 0.0) * math.exp(-narrow * narrow - near)
                    nx, ny, nz = normal[n, m, 0], normal[n, m, 1], normal[n, m, 2]
                    px += rate * (ny * vz - nz * vy)
                    py += rate * (nz * vx - nx * vz)
                    pz += rate * (nx * vy - ny * vx)
            vx += h * (stiffness * (law.baseline[n] - x) - damping * vx + outside * px)
            vy += h * (outside * py - stiffness * y - damping * vy)
            vz += h * (outside * pz - stiffness * z - damping * vz)
            if not abs(vx) + abs(vy) + abs(vz) < _LOST:
                motion.over[n] = True
                continue
            x, y, z = x + h * vx, y + h * vy, z + h * vz
            path[n, k + 1, 0], path[n, k + 1, 1], path[n, k + 1, 2] = x, y, z
            velocity[n, k + 1, 0], velocity[n, k + 1, 1], velocity[n, k + 1, 2] = vx, vy, vz
            speed, t = math.sqrt(vx * vx + vy * vy + vz * vz), (k + 1) * h
            for m in range(parameters.shape[1]):
                ox = law.center[n, m, 0] + t * law.drift[n, m, 0] - x
                oy = law.center[n, m, 1] + t * law.drift[n, m, 1] - y
                oz = law.center[n, m, 2] + t * law.drift[n, m, 2] - z
                d = math.sqrt(ox * ox + oy * oy + oz * oz)
                motion.distance[n, m] = d if speed >= _STILL and d > 0.0 else 0.0
                nx, ny, nz = oy * vz - oz * vy, oz * vx - ox * vz, ox * vy - oy * vx
                size = math.sqrt(nx * nx + ny * ny + nz * nz)
                motion.angle[n, m] = math.atan2(size, ox * vx + oy * vy + oz * vz)
                if size > _PARALLEL * d * speed and speed >= _STILL:
                    normal[n, m, 0], normal[n, m, 1], normal[n, m, 2] = (
                        nx / size,
                        ny / size,
                        nz / size,
                    )
