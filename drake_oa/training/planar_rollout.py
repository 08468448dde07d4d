"""Trajectories of the action level past one ellipse in the plane: a row each, on all cores.

Two motions, both from rest at (0, 0) to the goal (1, 0):

`planar_rollouts` is the project's own, the step of `drake_oa.policy.action_kernels` with one
avoidance term, in normalised units: lengths in baselines L, time s = t / (tau T). With
z = tau T dx/dt the
path does not depend on tau, so one roll-out stands for every duration::

    dz/ds = alpha_x (beta_x (g - x) - z) + f(k) + R z dtheta       (eq. oa_complete)
    dx/ds = z

A step is half a step of the spring in closed form, an exact rotation of z by the linearly
implicit turn, and the spring's other half.

`released_rollouts` is that of the authors' released code, which made the paper's training set:
tau^2 scales the spring within a fixed time, the forcing term is unscaled, the coupling term is
an explicit push, and the step is semi-implicit Euler.

A row ends where it touches the ellipse. The readable forms are in `tests/reference`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import BoolArray, FloatArray, Frozen
from drake_oa.policy.coupling import limited_avoidance
from drake_oa.policy.dmp import ALPHA_X, Dmp, imitate, minimum_jerk, spring_flow

STEPS = 1000
"""Default number of steps a unit of s; with four times as many a path that converges
keeps 0.4 mm a metre more (median; docs/equations.md)."""

_FAST = {"contract", "reassoc", "nsz", "arcp"}
_jit = numba.njit(cache=True, error_model="numpy", fastmath=_FAST)
_ASLEEP = 40.0
"""Beyond this exponent (theta / psi)^2 + kappa d^2 the term is left out: exp(-40) is 4e-18."""


@dataclass(frozen=True, eq=False)
class PlanarRollouts(Frozen):
    """What N trajectories came to; lengths in baselines.

    Attributes:
        clearance: (N,) least distance to the ellipse, 0 where it was touched.
        goal_error: (N,) distance to the goal at the end; inf where it was touched.
        path_length: (N,) length of the path; inf where it was touched.
        contact: (N,) whether the ellipse was touched (the trajectory ends there).
    """

    clearance: FloatArray
    goal_error: FloatArray
    path_length: FloatArray
    contact: BoolArray


class _Motion(NamedTuple):
    """What all rows of a call share.

    Attributes:
        released: whether it is the released code's motion.
        drive: (steps,) forcing term of each step; for the project's motion where the spring
            rests under it.
        flow: (4,) of the spring over half a step (project).
        step: length of a step.
        inverse_fade2: 1 / fade^2 (project).
        stiffness: alpha_x beta_x (released).
        damping: alpha_x (released).
        between: whether clearance is also taken between the samples of the path.
    """

    released: bool
    drive: FloatArray
    flow: FloatArray
    step: float
    inverse_fade2: float = 0.0
    stiffness: float = 0.0
    damping: float = 0.0
    between: bool = True


class _Scene(NamedTuple):
    """One row: semi-axes and centre of the ellipse, coupling parameters, tau^2 (released)."""

    a: float
    b: float
    cx: float
    cy: float
    alpha: float
    psi: float
    kappa: float
    tau2: float


_State = tuple[float, float, float, float]
"""Position, and z or the velocity."""


@_jit
def _step_project(s: _State, w: _Scene, rest: float, m: _Motion) -> _State:
    """Half the spring, the turn, the spring's other half."""
    x, y, zx, zy = s
    f_xx, f_xz, f_zx, f_zz = m.flow[0], m.flow[1], m.flow[2], m.flow[3]
    ex, ey = x - rest, y
    x, y = rest + f_xx * ex + f_xz * zx, f_xx * ey + f_xz * zy
    zx, zy = f_zx * ex + f_zz * zx, f_zx * ey + f_zz * zy
    dx, dy = w.cx - x, w.cy - y
    nearness = w.kappa * (dx * dx + dy * dy)
    if nearness < _ASLEEP:
        cross = zx * dy - zy * dx
        theta = math.atan2(abs(cross), zx * dx + zy * dy)
        exponent = (theta / w.psi) ** 2 + nearness
        if exponent < _ASLEEP:
            left = min(((x - 1.0) ** 2 + y * y) * m.inverse_fade2, 1.0)
            rate = w.alpha * left * left * math.exp(-exponent)
            explicit, divisor = limited_avoidance(rate, theta, w.psi, m.step)
            turn = explicit / divisor
            # Away from the centre; straight at it counts as it on the right.
            if cross > 0.0:
                turn = -turn
            cos, sin = math.cos(turn), math.sin(turn)
            zx, zy = cos * zx - sin * zy, sin * zx + cos * zy
    ex, ey = x - rest, y
    return (
        rest + f_xx * ex + f_xz * zx,
        f_xx * ey + f_xz * zy,
        f_zx * ex + f_zz * zx,
        f_zx * ey + f_zz * zy,
    )


@_jit
def _step_released(s: _State, w: _Scene, forcing: float, m: _Motion) -> _State:
    """a = tau^2 (K (g - x) - D v) + f + R v theta', then v, then x."""
    x, y, vx, vy = s
    dx, dy = w.cx - x, w.cy - y
    nearness = w.kappa * (dx * dx + dy * dy)
    push = 0.0
    if nearness < _ASLEEP:
        cross = vx * dy - vy * dx
        u = math.atan2(abs(cross), vx * dx + vy * dy) / w.psi
        push = w.alpha * math.exp(-u * u - nearness)
        if cross > 0.0:
            push = -push
    ax = w.tau2 * (m.stiffness * (1.0 - x) - m.damping * vx) + forcing - push * vy
    ay = w.tau2 * (-m.stiffness * y - m.damping * vy) + push * vx
    vx += m.step * ax
    vy += m.step * ay
    return x + m.step * vx, y + m.step * vy, vx, vy


@_jit
def _nearest(
    px: float, py: float, a: float, b: float, tx: float, ty: float, iterations: int
) -> tuple[float, float]:
    """Foot point (a tx, b ty) on the first quadrant of an ellipse, by curvature.

    Each iteration replaces the ellipse by its osculating circle at the last estimate.
    """
    for _ in range(iterations):
        # Centre of curvature (evolute) and the radius there.
        ex = (a * a - b * b) * tx * tx * tx / a
        ey = (b * b - a * a) * ty * ty * ty / b
        rx, ry = a * tx - ex, b * ty - ey
        qx, qy = px - ex, py - ey
        distance2 = qx * qx + qy * qy
        if distance2 == 0.0:
            break
        scale = math.sqrt((rx * rx + ry * ry) / distance2)
        tx = min(1.0, max(0.0, (qx * scale + ex) / a))
        ty = min(1.0, max(0.0, (qy * scale + ey) / b))
        norm = math.sqrt(tx * tx + ty * ty)
        tx, ty = tx / norm, ty / norm
    return tx, ty


@_jit
def _distance(x: float, y: float, w: _Scene) -> float:
    """Distance of a point outside to the ellipse."""
    px, py = abs(x - w.cx), abs(y - w.cy)
    tx, ty = _nearest(px, py, w.a, w.b, math.sqrt(0.5), math.sqrt(0.5), 20)
    return math.sqrt((px - w.a * tx) ** 2 + (py - w.b * ty) ** 2)


@_jit
def _roll_out(w: _Scene, m: _Motion) -> tuple[float, float, float]:
    """Clearance, goal error and path length of a row; 0, inf, inf where it touches."""
    s = (0.0, 0.0, 0.0, 0.0)
    before, nearest, after = s, s, s
    least, least_step = np.inf, 0
    reach = max(w.a, w.b)
    tx, ty, looked = math.sqrt(0.5), math.sqrt(0.5), -1
    length = 0.0
    for step in range(len(m.drive)):
        last = s
        if m.released:
            s = _step_released(s, w, m.drive[step], m)
        else:
            s = _step_project(s, w, m.drive[step], m)
        length += math.sqrt((s[0] - last[0]) ** 2 + (s[1] - last[1]) ** 2)
        if step == least_step + 1:
            after = s
        px, py = abs(s[0] - w.cx), abs(s[1] - w.cy)
        if px * px + py * py > (reach + least) ** 2:
            continue
        if (px / w.a) ** 2 + (py / w.b) ** 2 <= 1.0:
            return 0.0, np.inf, np.inf
        # One iteration a step, started from the last foot point, keeps track of it.
        tx, ty = _nearest(px, py, w.a, w.b, tx, ty, 1 if step == looked + 1 else 5)
        looked = step
        distance2 = (px - w.a * tx) ** 2 + (py - w.b * ty) ** 2
        if distance2 < least * least:
            least, least_step = math.sqrt(distance2), step
            before, nearest, after = last, s, s
    clearance = _distance(nearest[0], nearest[1], w)
    if m.between and least_step < len(m.drive) - 1:
        # The vertex of the parabola through three samples.
        d0, d2 = _distance(before[0], before[1], w), _distance(after[0], after[1], w)
        bend = d0 - 2.0 * clearance + d2
        if bend > 0.0:
            shift = min(max(0.5 * (d0 - d2) / bend, -1.0), 1.0)
            vertex = clearance + shift * (0.5 * (d2 - d0) + 0.5 * shift * bend)
            clearance = max(min(clearance, vertex), 0.0)
    return clearance, math.sqrt((s[0] - 1.0) ** 2 + s[1] ** 2), length


@numba.njit(cache=True, parallel=True, error_model="numpy", fastmath=_FAST)
def _roll_out_rows(
    extents: FloatArray, parameters: FloatArray, centers: FloatArray, m: _Motion, out: FloatArray
) -> None:
    """Rows (N, 2), (N, 3) alpha psi kappa, (N, 2) -> out (3, N), as `_roll_out`."""
    for row in numba.prange(len(extents)):
        b = extents[row, 1]
        tau = math.sqrt(1.0 + 4.0 * b * b) + 0.1
        w = _Scene(
            extents[row, 0], b, centers[row, 0], centers[row, 1],
            parameters[row, 0], parameters[row, 1], parameters[row, 2], tau * tau,
        )  # fmt: skip
        out[0, row], out[1, row], out[2, row] = _roll_out(w, m)


@lru_cache(maxsize=8)
def straight_dmp(alpha_x: float = ALPHA_X) -> Dmp:
    """The critically damped primitive of a straight minimum-jerk motion of length and time 1."""
    return imitate(*minimum_jerk(0.0, 1.0), alpha_x=alpha_x, beta_x=alpha_x / 4.0)


@lru_cache(maxsize=8)
def forcing_table(dmp: Dmp, steps: int = STEPS, end: float = 1.0) -> FloatArray:
    """Forcing term along the baseline at the middle of each step of s in [0, end].

    Args:
        dmp: the primitive.
        steps: number of steps in all.
        end: s after the last step.

    Returns:
        (steps,) forcing for a unit baseline.
    """
    middles = dmp.phase((np.arange(steps) + 0.5) * (end / steps))
    return np.array([dmp.forcing(k)[0] for k in middles.tolist()])


def planar_rollouts(
    extents: ArrayLike,
    parameters: ArrayLike,
    *,
    centers: ArrayLike | None = None,
    dmp: Dmp | None = None,
    steps: int = STEPS,
    end: float = 1.0,
    fade: float = 0.0,
) -> PlanarRollouts:
    """Rolls out the project's motion, one trajectory a row.

    A heading exactly at the centre turns to the left.

    Args:
        extents: (N, 2) semi-axes of the ellipse along and across the baseline, in L.
        parameters: (N, 3) alpha, psi, kappa L^2.
        centers: (N, 2) centre of the ellipse in L; None: (0.5, 0).
        dmp: the primitive, straight along its first dimension; None: `straight_dmp`.
        steps: number of steps a unit of s; where end is no whole number of them, all are
            a little shorter.
        end: s at the end of the motion.
        fade: alpha fades within this many baselines of the goal, by the fourth power of
            the distance left (`drake_oa.policy.action_kernels.goal_fade`); 0: it does not.

    Returns:
        Clearance, goal error at s = end and path length a row.

    Raises:
        ValueError: if shapes disagree, a value is not finite, a semi-axis or psi is
            not positive, alpha, kappa or fade is negative, or steps or end is not positive.
    """
    if steps < 1:
        raise ValueError(f"steps must be at least 1, not {steps}")
    if not 0.0 <= fade < math.inf:
        raise ValueError(f"fade must be finite and not negative, not {fade}")
    if not 0.0 < end < math.inf:
        raise ValueError(f"end must be finite and positive, not {end}")
    dmp = straight_dmp() if dmp is None else dmp
    # 0.07 x 100 is a little more than 7 in floating point.
    n_steps = math.ceil(steps * end * (1.0 - 1e-12))
    motion = _Motion(
        released=False,
        drive=1.0 + forcing_table(dmp, n_steps, end) / (dmp.alpha_x * dmp.beta_x),
        flow=np.array(spring_flow(dmp.alpha_x, dmp.beta_x, 0.5 * end / n_steps)),
        step=end / n_steps,
        inverse_fade2=1.0 / fade**2 if fade > 0.0 else 1e30,
    )
    return _rolled_out(extents, parameters, centers, motion)


def released_rollouts(
    extents: ArrayLike, parameters: ArrayLike, *, steps: int = STEPS, between: bool = False
) -> PlanarRollouts:
    """Rolls out the released code's motion of 3 s, as in the paper's training set.

    Past an ellipse at (0.5, 0), with tau = sqrt(1 + 4 lambda2'^2) + 0.1, alpha_x = 10 and
    beta_x = 2.5. The demonstration is straight and of constant speed: the forcing term
    is what the released code's 35 basis functions fit to it, to 2e-4 m/s^2. A heading exactly at
    the centre turns to the left.

    Where a strong push acts all the way (kappa below about 10), the explicit step amplifies
    rounding: in some rows the last bit of alpha moves the clearance by 5e-4 m, and the
    goal error without bound.

    Args:
        extents: (N, 2) lambda1', lambda2' along and across the baseline of 1 m [m].
        parameters: (N, 3) alpha [1/s], psi [rad], kappa [1/m^2].
        steps: number of steps, at least 2.
        between: whether the clearance is also taken between the samples of the path. The
            paper's set has it at the samples: then, and only then, as many of its 12.5
            million rows keep 0.01 m as the paper's set has.

    Returns:
        Clearance, goal error after the last step and path length a row [m].

    Raises:
        ValueError: as `planar_rollouts` does.
    """
    motion = _Motion(
        released=True,
        drive=released_forcing(steps),
        flow=np.zeros(4),
        step=_RELEASED_TIME / steps,
        stiffness=25.0,
        damping=10.0,
        between=between,
    )
    return _rolled_out(extents, parameters, None, motion)


_RELEASED_TIME = 3.0


def released_forcing(steps: int = STEPS, time: float = _RELEASED_TIME) -> FloatArray:
    """(steps,) forcing term of `released_rollouts` at the beginning of each step [m/s^2].

    Args:
        steps: number of steps.
        time: that they take in all [s].

    Raises:
        ValueError: if there are fewer than two steps.
    """
    if steps < 2:
        raise ValueError(f"steps must be at least 2, not {steps}")
    # The demonstration ends with the last step.
    duration = time / steps * (steps - 1)
    return np.asarray(10.0 / duration - 25.0 * (1.0 - np.arange(steps) / (steps - 1)))


def _rolled_out(
    extents: ArrayLike, parameters: ArrayLike, centers: ArrayLike | None, motion: _Motion
) -> PlanarRollouts:
    extents, parameters = _rows("extents", extents, 2), _rows("parameters", parameters, 3)
    if centers is None:
        centers = np.tile((0.5, 0.0), (len(extents), 1))
    centers = _rows("centers", centers, 2)
    if not len(extents) == len(parameters) == len(centers):
        raise ValueError(
            f"extents, parameters and centers have {len(extents)}, {len(parameters)} and "
            f"{len(centers)} rows; they must have as many"
        )
    if not (extents > 0.0).all():
        raise ValueError("extents must be positive")
    if not ((parameters[:, 1] > 0.0).all() and (parameters >= 0.0).all()):
        raise ValueError("parameters: psi must be positive, alpha and kappa not negative")
    out = np.empty((3, len(extents)))
    _roll_out_rows(extents, parameters, centers, motion, out)
    return PlanarRollouts(out[0], out[1], out[2], np.isinf(out[1]))


def _rows(name: str, value: ArrayLike, width: int) -> FloatArray:
    array = np.ascontiguousarray(value, dtype=float)
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"{name} must have the shape (N, {width}), not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must hold finite numbers")
    return array
