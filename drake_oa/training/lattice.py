"""Roll-outs over a lattice of motions around one ellipse, on two action levels.

From rest at (0, 0) to (1, 0) around an ellipse at (0.5, 0), as in the paper's training set (sec.
V-A). `roll_out` is the action level as the authors' released code integrates it. It differs from
the running system's (`running_lattice`): the coupling term is an explicit push of the true
velocity, tau^2 multiplies the spring instead of scaling time, the forcing term is not scaled, and
the step is semi-implicit Euler::

    a = tau^2 alpha_x (beta_x (g - x) - v) + f + alpha exp(-theta^2/psi^2 - kappa d^2) R v
    v += h a,   x += h v,   tau = sqrt(1 + 4 lambda2'^2) + 0.1

A heading exactly at the centre turns to the left. Motions of neighbouring alpha, which fare much
alike, advance together as a structure of arrays, from the step at which the first of their
coupling terms wakes to that at which the last has touched or arrived.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numba import njit, prange

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.solids import ellipsoid, solids_of
from drake_oa.planning.point_search import path_distances
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.dmp import imitate, minimum_jerk
from drake_oa.policy.rollout import Scene, roll_out_tool
from drake_oa.regulation.lane_math import (
    STRICT,
    TINY,
    angle,
    exponential,
    widest_vectors,
)

STEPS, STEP = 1000, 0.003
"""Number of steps and length of each [s]."""
ALPHA_X, BETA_X = 10.0, 2.5
"""Constants of the spring."""

_ASLEEP = 1e-5
"""A weaker coupling term [1/s] turns the motion by 1e-6 rad in all."""
_ROOT_HALF = math.sqrt(0.5)

_BATCH = 4096
_IN_THE_MIDDLE = np.eye(4)
_IN_THE_MIDDLE[0, 3] = 0.5

_LANES = 64
# Rows of a block's state: position, velocity, direction of the foot point, exponent; the least
# squared distance so far (-1: touched) and where; alpha.
_X, _Y, _VX, _VY, _TX, _TY, _EXPONENT, _LEAST, _LEAST_X, _LEAST_Y, _ALPHA = range(
    0, 11 * _LANES, _LANES
)
_SIZE = 11 * _LANES
_jit = njit(cache=True, error_model="numpy", fastmath=STRICT)


class PaperLattice(NamedTuple):
    """A lattice of motions; by default what the paper explored.

    Attributes:
        lambda1: semi-axes along the baseline [m].
        lambda2: semi-axes across it [m].
        kappa: [1/m^2].
        psi: [rad].
        alpha: [rad/s].
    """

    lambda1: FloatArray = np.linspace(0.025, 0.25, 10)
    lambda2: FloatArray = np.linspace(0.025, 0.25, 10)
    kappa: FloatArray = np.linspace(0.0, 1000.0, 50)
    psi: FloatArray = np.linspace(0.1, 1.0, 50)
    alpha: FloatArray = np.linspace(0.01, 30000.0, 50)


def forcing_term(steps: int = STEPS, step: float = STEP) -> FloatArray:
    """(steps,) force of a straight demonstration at constant speed over 1 m [m/s^2].

    What the released code's 35 basis functions fit, to 2e-4 m/s^2: the demonstration ends with
    the last step.
    """
    duration = step * (steps - 1)
    s = np.arange(steps) / (steps - 1)
    return np.asarray(ALPHA_X / duration - ALPHA_X * BETA_X * (1.0 - s))


def roll_out(
    lattice: PaperLattice, forcing: FloatArray | None = None, step: float = STEP
) -> tuple[FloatArray, FloatArray]:
    """Rolls out every motion of a lattice.

    Args:
        lattice: of A, B, C, D and E values.
        forcing: (steps,) force at the beginning of each step [m/s^2]; None: `forcing_term`.
        step: length of a step [s].

    Returns:
        (A, B, C, D, E), as the lattice's axes go: the least distance to the ellipse at the steps
        [m], 0 where it was touched; and the distance to the goal after the last step [m], inf
        where it was touched or diverged.

    Raises:
        ValueError: if a semi-axis or psi is not positive, alpha or kappa is negative, or one of
            them is not finite.
    """
    for name, axis in lattice._asdict().items():
        low = axis.min() if axis.ndim == 1 and axis.size else math.nan
        positive = name not in ("alpha", "kappa")
        if not (np.isfinite(axis).all() and (low > 0.0 if positive else low >= 0.0)):
            kind = "positive" if positive else "not negative"
            raise ValueError(f"{name} must be a row of finite numbers, {kind}")
    forcing = forcing_term() if forcing is None else np.ascontiguousarray(forcing, dtype=float)
    out = np.empty((2, *map(len, lattice)))
    axes = PaperLattice(*(np.ascontiguousarray(axis, dtype=float) for axis in lattice))
    _roll_out(axes, forcing, step, out)
    return out[0], out[1]


def running_lattice(lattice: PaperLattice) -> tuple[FloatArray, FloatArray]:
    """Rolls out every motion of a lattice by the running system's engine, alpha in 1/T.

    Lengths are in baselines, and time in units of the demonstration's: the path depends on neither.
    With four times as many steps a path that converges keeps 0.4 mm a metre more (median;
    docs/equations.md).

    Returns:
        As `roll_out`, with the clearance to 1e-4.
    """
    kappa, psi, alpha = (axis.ravel() for axis in np.meshgrid(*lattice[2:], indexing="ij"))
    dmp = imitate(*minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0)))
    terms = np.zeros((len(alpha), N_COLUMNS))
    terms[:, 0], terms[:, NORMAL + 2] = 0.5, 1.0
    terms[:, ALPHA], terms[:, PSI], terms[:, KAPPA] = alpha, psi, kappa
    goal, policy = np.array([1.0, 0.0, 0.0]), Policy(period=1.0 / STEPS, fade=0.0)
    still = Scene(np.zeros(3), np.zeros(3), goal, np.eye(3), 1.0)
    shape = [len(axis) for axis in lattice[2:]]
    least, error = np.empty((2, *map(len, lattice[:2]), len(alpha)))
    for rows in np.array_split(np.arange(len(alpha)), -(-len(alpha) // _BATCH)):
        # The motion does not depend on the shape.
        tool = roll_out_tool(still, terms[rows, None], dmp=dmp, policy=policy, latest=1.0)
        for i, lambda1 in enumerate(lattice.lambda1):
            for j, lambda2 in enumerate(lattice.lambda2):
                obstacle = ellipsoid([lambda1, lambda2, max(lambda1, lambda2)])
                solids = solids_of([replace(obstacle, X_WO=_IN_THE_MIDDLE)])
                d = path_distances(solids, tool.path, np.zeros(len(rows)))[:, 0]
                least[i, j, rows] = np.maximum(d, 0.0)
                error[i, j, rows] = np.where(d <= 0.0, np.inf, tool.goal_error)
    found = least.reshape(*least.shape[:2], *shape), error.reshape(*least.shape[:2], *shape)
    return found[0], found[1]


@_jit
def _foot(px: float, py: float, a: float, b: float, tx: float, ty: float) -> tuple[float, float]:
    """One step toward the foot point (a tx, b ty) of (px, py) >= 0 on an ellipse.

    The ellipse is replaced by its osculating circle at the last estimate.
    """
    ex, ey = (a * a - b * b) / a * tx * tx * tx, (b * b - a * a) / b * ty * ty * ty
    rx, ry, qx, qy = a * tx - ex, b * ty - ey, px - ex, py - ey
    scale = math.sqrt((rx * rx + ry * ry) / (qx * qx + qy * qy + TINY))
    tx, ty = (qx * scale + ex) / a, (qy * scale + ey) / b
    tx, ty = tx if tx > 1e-12 else 1e-12, ty if ty > 1e-12 else 1e-12
    tx, ty = tx if tx < 1.0 else 1.0, ty if ty < 1.0 else 1.0
    size = 1.0 / math.sqrt(tx * tx + ty * ty)
    return tx * size, ty * size


@_jit
def _advance(
    n: int, S: FloatArray, a: float, b: float, psi: float, kappa: float, tau2: float,
    force: float, h: float,
) -> int:  # fmt: skip
    """One step of n motions; returns how many have not touched the ellipse."""
    widest_vectors()
    stiffness, damping, inverse2 = tau2 * ALPHA_X * BETA_X, tau2 * ALPHA_X, 1.0 / (psi * psi)
    for i in range(n):
        dx, y, vx, vy = 0.5 - S[_X + i], S[_Y + i], S[_VX + i], S[_VY + i]
        theta = angle(abs(vx * y + vy * dx), vx * dx - vy * y)
        S[_EXPONENT + i] = -theta * theta * inverse2 - kappa * (dx * dx + y * y)
    for i in range(n):
        x, y, vx, vy = S[_X + i], S[_Y + i], S[_VX + i], S[_VY + i]
        push = S[_ALPHA + i] * exponential(S[_EXPONENT + i])
        push = -push if -vx * y - vy * (0.5 - x) > 0.0 else push
        ax = stiffness * (1.0 - x) - damping * vx + force - push * vy
        ay = push * vx - stiffness * y - damping * vy
        vx += h * ax
        vy += h * ay
        S[_X + i], S[_Y + i], S[_VX + i], S[_VY + i] = x + h * vx, y + h * vy, vx, vy
    for i in range(n):
        px, py = abs(S[_X + i] - 0.5), abs(S[_Y + i])
        S[_TX + i], S[_TY + i] = _foot(px, py, a, b, S[_TX + i], S[_TY + i])
    free = np.int64(0)
    for i in range(n):
        x, y, least = S[_X + i], S[_Y + i], S[_LEAST + i]
        px, py = abs(x - 0.5), abs(y)
        ux, uy, hx, hy = px / a, py / b, px - a * S[_TX + i], py - b * S[_TY + i]
        distance = hx * hx + hy * hy
        distance = -1.0 if ux * ux + uy * uy <= 1.0 else distance
        nearer = distance < least
        S[_LEAST + i] = distance if nearer else least
        S[_LEAST_X + i] = x if nearer else S[_LEAST_X + i]
        S[_LEAST_Y + i] = y if nearer else S[_LEAST_Y + i]
        free += np.int64(S[_LEAST + i] >= 0.0)
    return int(free)


@_jit
def _distance(px: float, py: float, a: float, b: float) -> float:
    """Distance of a point outside to the ellipse."""
    tx = ty = _ROOT_HALF
    for _ in range(20):
        tx, ty = _foot(px, py, a, b, tx, ty)
    return math.sqrt((px - a * tx) ** 2 + (py - b * ty) ** 2)


@_jit
def _straight(tau2: float, forcing: FloatArray, h: float) -> FloatArray:
    """(steps + 1, 2) place and velocity along the baseline without coupling."""
    states = np.zeros((len(forcing) + 1, 2))
    for k in range(len(forcing)):
        x, v = states[k]
        v += h * (tau2 * ALPHA_X * (BETA_X * (1.0 - x) - v) + forcing[k])
        states[k + 1, 0], states[k + 1, 1] = x + h * v, v
    return states


@njit(cache=True, parallel=True, error_model="numpy", fastmath=STRICT)
def _roll_out(lattice: PaperLattice, forcing: FloatArray, h: float, out: FloatArray) -> None:
    """See `roll_out`; out (2, A, B, C, D, E)."""
    A, B, C, D, E = out.shape[1:]
    steps = len(forcing)
    for scene in prange(A * B * D):
        # Threads take runs of scenes: psi, on which the work depends least, runs first.
        d, j, i = scene % D, scene // D % B, scene // (D * B)
        a, b, psi = lattice.lambda1[i], lattice.lambda2[j], lattice.psi[d]
        tau2 = (math.sqrt(1.0 + 4.0 * b * b) + 0.1) ** 2
        straight = _straight(tau2, forcing, h)
        S = np.zeros(_SIZE)
        for c in range(C):
            kappa = lattice.kappa[c]
            for e in range(0, E, _LANES):
                alpha = lattice.alpha[e : e + _LANES]
                n, strongest = len(alpha), alpha.max()
                first = 0
                while first < steps:
                    left = 0.5 - straight[first + 1, 0]
                    if left <= a or strongest * math.exp(-kappa * left * left) > _ASLEEP:
                        break
                    first += 1
                for m in range(n):
                    S[_X + m], S[_VX + m] = straight[first]
                    S[_Y + m] = S[_VY + m] = S[_LEAST_Y + m] = 0.0
                    # Before the ellipse, on the baseline, its vertex is the nearest point.
                    S[_TX + m], S[_TY + m] = 1.0, 1e-12
                    gap = 0.5 - a - S[_X + m]
                    S[_LEAST + m] = gap * gap if gap > 0.0 else np.inf
                    S[_LEAST_X + m], S[_ALPHA + m] = S[_X + m], alpha[m]
                for k in range(first, steps):
                    if _advance(n, S, a, b, psi, kappa, tau2, forcing[k], h) == 0:
                        break
                for m in range(n):
                    found = out[:, i, j, c, d, e + m]
                    found[0], found[1] = 0.0, np.inf
                    if S[_LEAST + m] >= 0.0:
                        px, py = abs(S[_LEAST_X + m] - 0.5), abs(S[_LEAST_Y + m])
                        found[0] = _distance(px, py, a, b)
                        error = math.sqrt((S[_X + m] - 1.0) ** 2 + S[_Y + m] ** 2)
                        found[1] = error if error < np.inf else np.inf
