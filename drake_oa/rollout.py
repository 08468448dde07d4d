"""Many action-level trajectories at once, compiled and on all cores.

The kernel does what `drake_oa.dmp.step` does with one `drake_oa.coupling` term, in the
plane of actuation and in normalised units: lengths in baselines L, time in
s = t / (tau T). With z = tau T dx/dt in the coupling term the path does not depend on
tau, so one roll-out stands for every duration::

    dz/ds = alpha_x (beta_x (g - x) - z) + f(k) + R z dtheta       (eq. oa_complete)
    dx/ds = z

One step is half a step of the spring in closed form, an exact rotation of z by the
turn of `drake_oa.coupling` (linearly implicit), and the spring's other half.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import ArrayLike

from drake_oa.dmp import Dmp, imitate, minimum_jerk, spring_flow
from drake_oa.values import BoolArray, FloatArray, Frozen

STEPS = 1000
"""Default number of steps a demonstrated duration; with four times as many a path that
converges keeps 0.2 mm a metre more (median; docs/equations.md)."""


@dataclass(frozen=True, eq=False)
class PlanarRollouts(Frozen):
    """What N trajectories from s = 0 to s = 1 came to; lengths in baselines.

    Attributes:
        clearance: (N,) least distance to the ellipse, 0 where it was touched.
        goal_error: (N,) distance to the goal at s = 1; inf where it was touched.
        path_length: (N,) length of the path; inf where it was touched.
        contact: (N,) whether the ellipse was touched (the trajectory ends there).
    """

    clearance: FloatArray
    goal_error: FloatArray
    path_length: FloatArray
    contact: BoolArray


def default_dmp() -> Dmp:
    """The primitive of a straight minimum-jerk motion over a unit baseline and time."""
    return imitate(*minimum_jerk(0.0, 1.0))


def forcing_table(dmp: Dmp, steps: int = STEPS) -> FloatArray:
    """Forcing term along the baseline at the middle of each step of s in [0, 1].

    Args:
        dmp: the primitive.
        steps: number of steps.

    Returns:
        (steps,) forcing for a unit baseline.
    """
    middles = dmp.phase((np.arange(steps) + 0.5) / steps)
    return np.array([dmp.forcing(k)[0] for k in middles.tolist()])


def planar_rollouts(
    extents: ArrayLike,
    parameters: ArrayLike,
    *,
    centers: ArrayLike | None = None,
    dmp: Dmp | None = None,
    steps: int = STEPS,
) -> PlanarRollouts:
    """Rolls out one trajectory a row, from rest at (0, 0) to (1, 0).

    A heading exactly at the centre turns to the left.

    Args:
        extents: (N, 2) semi-axes of the ellipse along and across the baseline, in L.
        parameters: (N, 3) alpha, psi, kappa L^2.
        centers: (N, 2) centre of the ellipse in L; None: (0.5, 0).
        dmp: the primitive, straight along its first dimension; None: `default_dmp`.
        steps: number of steps.

    Returns:
        Clearance (to 1e-4 of a baseline), goal error and path length a row.

    Raises:
        ValueError: if shapes disagree, a value is not finite, a semi-axis or psi is
            not positive, alpha or kappa is negative, or steps is not positive.
    """
    extents = _rows("extents", extents, 2)
    parameters = _rows("parameters", parameters, 3)
    if centers is None:
        centers = np.tile((0.5, 0.0), (len(extents), 1))
    centers = _rows("centers", centers, 2)
    if not len(extents) == len(parameters) == len(centers):
        raise ValueError(
            f"extents, parameters and centers have {len(extents)}, {len(parameters)} and "
            f"{len(centers)} rows; they must have as many"
        )
    if steps < 1:
        raise ValueError(f"steps must be at least 1, not {steps}")
    if not (extents > 0.0).all():
        raise ValueError("extents must be positive")
    if not ((parameters[:, 1] > 0.0).all() and (parameters >= 0.0).all()):
        raise ValueError("parameters: psi must be positive, alpha and kappa not negative")
    out = np.empty((3, len(extents)))
    dmp = default_dmp() if dmp is None else dmp
    rest = 1.0 + forcing_table(dmp, steps) / (dmp.alpha_x * dmp.beta_x)
    flow = np.array(spring_flow(dmp.alpha_x, dmp.beta_x, 0.5 / steps))
    _planar_kernel(extents, parameters, centers, rest, flow, out)
    return PlanarRollouts(out[0], out[1], out[2], np.isinf(out[1]))


def _rows(name: str, value: ArrayLike, width: int) -> FloatArray:
    array = np.ascontiguousarray(value, dtype=float)
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"{name} must have the shape (N, {width}), not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must hold finite numbers")
    return array


_FAST = {"contract", "reassoc", "nsz", "arcp"}


@numba.njit(cache=True, fastmath=_FAST)
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
        radius, distance = math.sqrt(rx * rx + ry * ry), math.sqrt(qx * qx + qy * qy)
        if distance == 0.0:
            break
        tx = min(1.0, max(0.0, (qx * radius / distance + ex) / a))
        ty = min(1.0, max(0.0, (qy * radius / distance + ey) / b))
        norm = math.sqrt(tx * tx + ty * ty)
        tx, ty = tx / norm, ty / norm
    return tx, ty


@numba.njit(cache=True, fastmath=_FAST)
def _distance(px: float, py: float, a: float, b: float) -> float:
    """Distance of a point outside to the ellipse x^2/a^2 + y^2/b^2 = 1."""
    px, py = abs(px), abs(py)
    tx, ty = _nearest(px, py, a, b, math.sqrt(0.5), math.sqrt(0.5), 20)
    return math.sqrt((px - a * tx) ** 2 + (py - b * ty) ** 2)


@numba.njit(cache=True, parallel=True, fastmath=_FAST)
def _planar_kernel(
    extents: FloatArray,
    parameters: FloatArray,
    centers: FloatArray,
    rest: FloatArray,
    flow: FloatArray,
    out: FloatArray,
) -> None:
    # rest: where the spring would rest under each step's forcing term, held over it.
    n_steps = len(rest)
    f_xx, f_xz, f_zx, f_zz = flow[0], flow[1], flow[2], flow[3]
    for row in numba.prange(len(extents)):
        a, b = extents[row, 0], extents[row, 1]
        cx, cy = centers[row, 0], centers[row, 1]
        rate = parameters[row, 0] / n_steps
        inverse_psi = 1.0 / parameters[row, 1]
        kappa = parameters[row, 2]
        x, y, zx, zy = 0.0, 0.0, 0.0, 0.0
        tx, ty = math.sqrt(0.5), math.sqrt(0.5)
        nearest2, nearest_step = np.inf, 0
        before_x, before_y, near_x, near_y, after_x, after_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        length = 0.0
        contact = False
        for step in range(n_steps):
            x_before, y_before = x, y
            for part in range(2):
                ex, ey = x - rest[step], y
                x, y = rest[step] + f_xx * ex + f_xz * zx, f_xx * ey + f_xz * zy
                zx, zy = f_zx * ex + f_zz * zx, f_zx * ey + f_zz * zy
                if part == 1:
                    break
                dx, dy = cx - x, cy - y
                cross = zx * dy - zy * dx
                theta = math.atan2(abs(cross), zx * dx + zy * dy)
                u = theta * inverse_psi
                exponent = -u * u - kappa * (dx * dx + dy * dy)
                if exponent > -40.0:
                    turn = rate * math.exp(exponent)
                    c = turn * inverse_psi
                    if c >= 1e-14:
                        grown = math.log1p(
                            c * (2.0 * u + math.asinh(c / math.sqrt(1.0 + 2.0 * u * c)))
                        )
                        turn = grown / (inverse_psi * (u + math.sqrt(u * u + grown)))
                    turn = min(turn, math.pi - theta)
                    # Away from the centre; straight at it counts as it on the right.
                    if cross > 0.0:
                        turn = -turn
                    cos, sin = math.cos(turn), math.sin(turn)
                    zx, zy = cos * zx - sin * zy, sin * zx + cos * zy
            sx, sy = x - x_before, y - y_before
            length += math.sqrt(sx * sx + sy * sy)
            px, py = abs(x - cx), abs(y - cy)
            if (px / a) ** 2 + (py / b) ** 2 <= 1.0:
                contact = True
                break
            # One iteration a step, started from the last foot point, keeps track of it.
            tx, ty = _nearest(px, py, a, b, tx, ty, 1)
            distance2 = (px - a * tx) ** 2 + (py - b * ty) ** 2
            if distance2 < nearest2:
                nearest2 = distance2
                nearest_step = step
                near_x, near_y = x - cx, y - cy
                before_x, before_y = x_before - cx, y_before - cy
                after_x, after_y = near_x, near_y
            elif step == nearest_step + 1:
                after_x, after_y = x - cx, y - cy
        if contact:
            out[0, row], out[1, row], out[2, row] = 0.0, np.inf, np.inf
        else:
            # Between the samples: the vertex of the parabola through three distances.
            before = _distance(before_x, before_y, a, b)
            nearest = _distance(near_x, near_y, a, b)
            after = _distance(after_x, after_y, a, b)
            bend = before - 2.0 * nearest + after
            if bend > 0.0 and nearest_step < n_steps - 1:
                shift = min(max(0.5 * (before - after) / bend, -1.0), 1.0)
                nearest = min(
                    nearest, nearest + shift * (0.5 * (after - before) + 0.5 * shift * bend)
                )
            out[0, row] = max(nearest, 0.0)
            out[1, row] = math.sqrt((x - 1.0) ** 2 + y * y)
            out[2, row] = length
