"""Compiled roll-outs in the plane, float64, row by row: what the float32 ones answer to.

The project's own motion is settled here where float32 cannot tell for certain. The released
code's rows are settled in `drake_oa.training.released_kernels`, which answers to `released_rows`.
"""

from __future__ import annotations

import math

import numba
import numpy as np

from drake_oa.common.messages import FloatArray

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


@numba.njit(cache=True, fastmath=_FAST)
def _between(before: float, nearest: float, after: float) -> float:
    """Least distance between samples: the vertex of the parabola through three."""
    bend = before - 2.0 * nearest + after
    if bend <= 0.0:
        return nearest
    shift = min(max(0.5 * (before - after) / bend, -1.0), 1.0)
    return min(nearest, nearest + shift * (0.5 * (after - before) + 0.5 * shift * bend))


@numba.njit(cache=True, parallel=True, fastmath=_FAST)
def project_rows(
    extents: FloatArray,
    parameters: FloatArray,
    centers: FloatArray,
    rest: FloatArray,
    flow: FloatArray,
    inverse_fade2: float,
    density: float,
    out: FloatArray,
) -> None:
    """The project's own motion, see `drake_oa.training.planar_rollout.planar_rollouts`.

    Args:
        extents: (N, 2) semi-axes along and across the baseline of 1.
        parameters: (N, 3) alpha, psi, kappa.
        centers: (N, 2).
        rest: (steps,) where the spring rests under each step's forcing term.
        flow: (4,) of the spring over half a step.
        inverse_fade2: 1 / fade^2; inf: no fading.
        density: steps a unit of s.
        out: (3, N) clearance (0: touched), goal error, path length.
    """
    n_steps = len(rest)
    f_xx, f_xz, f_zx, f_zz = flow[0], flow[1], flow[2], flow[3]
    for row in numba.prange(len(extents)):
        a, b = extents[row, 0], extents[row, 1]
        cx, cy = centers[row, 0], centers[row, 1]
        rate = parameters[row, 0] / density
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
                    left = ((x - 1.0) ** 2 + y * y) * inverse_fade2
                    left = left if left < 1.0 else 1.0
                    turn = rate * left * left * math.exp(exponent)
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
            before = _distance(before_x, before_y, a, b)
            nearest = _distance(near_x, near_y, a, b)
            if nearest_step < n_steps - 1:
                nearest = _between(before, nearest, _distance(after_x, after_y, a, b))
            out[0, row] = max(nearest, 0.0)
            out[1, row] = math.sqrt((x - 1.0) ** 2 + y * y)
            out[2, row] = length


@numba.njit(cache=True, parallel=True, fastmath=_FAST)
def released_rows(
    semi_axes: FloatArray,
    parameters: FloatArray,
    drive: FloatArray,
    step_length: float,
    stiffness: float,
    damping: float,
    between: bool,
    out: FloatArray,
) -> None:
    """The released code's motion, see `drake_oa.training.planar_rollout.released_rollouts`.

    Args:
        semi_axes: (N, 2) along and across the baseline of 1, in its middle.
        parameters: (N, 3) alpha, psi, kappa.
        drive: (steps,) forcing term.
        step_length: [s].
        stiffness: alpha_x beta_x.
        damping: alpha_x.
        between: whether clearance is also taken between the samples of the path.
        out: (3, N) clearance (0: touched), goal error, path length.
    """
    n_steps = len(drive)
    for row in numba.prange(len(semi_axes)):
        a, b = semi_axes[row, 0], semi_axes[row, 1]
        alpha, psi, kappa = parameters[row, 0], parameters[row, 1], parameters[row, 2]
        tau = math.sqrt(1.0 + 4.0 * b * b) + 0.1
        spring, brake = tau * tau * stiffness, tau * tau * damping
        x, y, vx, vy, length = 0.0, 0.0, 0.0, 0.0, 0.0
        tx, ty = math.sqrt(0.5), math.sqrt(0.5)
        nearest2, nearest_step = np.inf, 0
        before_x, before_y, near_x, near_y, after_x, after_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        contact = False
        for step in range(n_steps):
            x_before, y_before = x, y
            dx, dy = 0.5 - x, -y
            cross = vx * dy - vy * dx
            theta = math.atan2(abs(cross), vx * dx + vy * dy) / psi
            push = alpha * math.exp(-theta * theta - kappa * (dx * dx + dy * dy))
            # Away from the centre; straight at it counts as it on the right.
            if cross > 0.0:
                push = -push
            ax = spring * (1.0 - x) - brake * vx + drive[step] - push * vy
            ay = -spring * y - brake * vy + push * vx
            vx += step_length * ax
            vy += step_length * ay
            x += step_length * vx
            y += step_length * vy
            length += step_length * math.sqrt(vx * vx + vy * vy)
            px, py = abs(x - 0.5), abs(y)
            if (px / a) ** 2 + (py / b) ** 2 <= 1.0:
                contact = True
                break
            tx, ty = _nearest(px, py, a, b, tx, ty, 1)
            distance2 = (px - a * tx) ** 2 + (py - b * ty) ** 2
            if distance2 < nearest2:
                nearest2, nearest_step = distance2, step
                near_x, near_y = x - 0.5, y
                before_x, before_y = x_before - 0.5, y_before
            elif step == nearest_step + 1:
                after_x, after_y = x - 0.5, y
        if contact:
            out[0, row], out[1, row], out[2, row] = 0.0, np.inf, np.inf
        else:
            nearest = _distance(near_x, near_y, a, b)
            if between and nearest_step < n_steps - 1:
                before = _distance(before_x, before_y, a, b)
                nearest = _between(before, nearest, _distance(after_x, after_y, a, b))
            out[0, row] = max(nearest, 0.0)
            out[1, row] = math.sqrt((x - 1.0) ** 2 + y * y)
            out[2, row] = length
