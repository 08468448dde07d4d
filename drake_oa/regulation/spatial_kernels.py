"""Compiled roll-outs of the whole action level in space, behind `drake_oa.training.planar_rollout`.

One row is one trajectory: the steps of `drake_oa.policy.dmp.step` with the avoidance terms of
`drake_oa.policy.coupling_kernels`, and what it keeps from ellipsoids that move at constant
velocity, from the table and from the workspace's limits.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.policy.coupling_kernels import ALPHA, KAPPA, NORMAL, PSI, rotate, turn_step

MARGIN, CLEARANCE, GOAL_ERROR, PATH_LENGTH, STEPS, WORLD_MARGIN = range(6)
"""Columns of the outcome of a row, see `drake_oa.training.planar_rollout.SpatialRollouts`."""
N_OUTCOMES = 6

_MATH = {"contract", "nsz", "arcp"}
_LEAST_TURN = 1e-11
"""Turns below this in a step are left out [rad]."""
_LOG_LEAST = math.log(_LEAST_TURN)


@njit(cache=True, error_model="numpy", fastmath=_MATH)
def outside_distance(
    y0: float, y1: float, y2: float, a0: float, a1: float, a2: float, t: float
) -> tuple[float, float]:
    """Distance of a point outside to an ellipsoid, in its axes, and the multiplier t.

    The foot point is x_i = a_i^2 y_i / (a_i^2 + t) with t > 0 the root of
    sum (a_i y_i / (a_i^2 + t))^2 = 1; Newton's method on the inverse square root of that
    sum starts from the given t, the last point's.
    """
    q0, q1, q2 = a0 * a0, a1 * a1, a2 * a2
    for _ in range(30):
        i0, i1, i2 = 1.0 / (q0 + t), 1.0 / (q1 + t), 1.0 / (q2 + t)
        u0, u1, u2 = a0 * y0 * i0, a1 * y1 * i1, a2 * y2 * i2
        total = u0 * u0 + u1 * u1 + u2 * u2
        slope = u0 * u0 * i0 + u1 * u1 * i1 + u2 * u2 * i2
        change = total * (math.sqrt(total) - 1.0) / slope
        t = max(t + change, 0.0)
        if abs(change) <= 1e-5 * t:
            break
    d0, d1, d2 = y0 / (q0 + t), y1 / (q1 + t), y2 / (q2 + t)
    return t * math.sqrt(d0 * d0 + d1 * d1 + d2 * d2), t


@njit(cache=True, error_model="numpy", fastmath=_MATH)
def point_distance(
    x: float,
    y: float,
    z: float,
    R: FloatArray,
    semi_axes: FloatArray,
    s: int,
    j: int,
    t: float,
) -> tuple[float, float]:
    """Distance to ellipsoid j of scene s of a point given from its centre, and the multiplier.

    Inside, minus a lower bound of the depth. (Views of the arrays would be counted
    references in the innermost loop: hence the indices.)
    """
    y0 = abs(R[s, j, 0, 0] * x + R[s, j, 1, 0] * y + R[s, j, 2, 0] * z)
    y1 = abs(R[s, j, 0, 1] * x + R[s, j, 1, 1] * y + R[s, j, 2, 1] * z)
    y2 = abs(R[s, j, 0, 2] * x + R[s, j, 1, 2] * y + R[s, j, 2, 2] * z)
    a0, a1, a2 = semi_axes[s, j, 0], semi_axes[s, j, 1], semi_axes[s, j, 2]
    gauge2 = (y0 / a0) ** 2 + (y1 / a1) ** 2 + (y2 / a2) ** 2
    if gauge2 <= 1.0:
        return (math.sqrt(gauge2) - 1.0) * min(a0, a1, a2), t
    return outside_distance(y0, y1, y2, a0, a1, a2, t)


@njit(cache=True, error_model="numpy", fastmath=_MATH)
def world_margin(
    x: float, y: float, z: float, plane: FloatArray, s: int, annulus: FloatArray
) -> float:
    """Signed margin of a point to the plane and the workspace; inf where there are neither."""
    margin = np.inf
    if plane[s, 0] != 0.0 or plane[s, 1] != 0.0 or plane[s, 2] != 0.0:
        margin = plane[s, 0] * x + plane[s, 1] * y + plane[s, 2] * z - plane[s, 3]
    n = annulus.shape[1]
    if n == 0:
        return margin
    radius = math.sqrt(x * x + y * y)
    heights = annulus[0]
    i = min(max(int(np.searchsorted(heights, z)) - 1, 0), n - 2)
    share = min(max((z - heights[i]) / (heights[i + 1] - heights[i]), 0.0), 1.0)
    inner = annulus[1, i] + share * (annulus[1, i + 1] - annulus[1, i])
    outer = annulus[2, i] + share * (annulus[2, i + 1] - annulus[2, i])
    beyond = min(z - heights[0], heights[n - 1] - z)
    return min(margin, radius - inner, outer - radius, beyond)


@njit(cache=True, error_model="numpy", fastmath=_MATH)
def single_turn(
    cx: float,
    cy: float,
    cz: float,
    nx: float,
    ny: float,
    nz: float,
    psi: float,
    kappa: float,
    log_gain: float,
    px: float,
    py: float,
    pz: float,
    zx: float,
    zy: float,
    zz: float,
) -> tuple[float, float, float]:
    """z turned by one in-plane avoidance term: `turn_step` and `rotate` for a unit normal.

    `log_gain` is ln(alpha step).
    """
    ox, oy, oz = cx - px, cy - py, cz - pz
    o_n, z_n = ox * nx + oy * ny + oz * nz, zx * nx + zy * ny + zz * nz
    sine = nx * (oy * zz - oz * zy) + ny * (oz * zx - ox * zz) + nz * (ox * zy - oy * zx)
    cosine = ox * zx + oy * zy + oz * zz - o_n * z_n
    square = ox * ox + oy * oy + oz * oz
    # Logarithm of rate times step, first without the heading's part.
    strength = log_gain - kappa * square
    if strength < _LOG_LEAST:
        return zx, zy, zz
    if sine * sine <= 1e-18 * square * (zx * zx + zy * zy + zz * zz):
        if cosine <= 0.0:
            return zx, zy, zz
        sine = 0.0
    if cosine < 0.0 and strength - (0.5 * math.pi / psi) ** 2 < _LOG_LEAST:
        return zx, zy, zz
    theta = math.atan2(abs(sine), cosine)
    u = theta / psi
    strength -= u * u
    if strength < _LOG_LEAST:
        return zx, zy, zz
    turn = math.exp(strength)
    c = min(turn / psi, 1e150)
    if c < 1e-14:
        angle = turn
    else:
        grown = math.log1p(c * (2.0 * u + math.asinh(c / math.sqrt(1.0 + 2.0 * u * c))))
        angle = psi * grown / (u + math.sqrt(u * u + grown))
    angle = min(angle, math.pi - theta)
    if sine < 0.0:
        angle = -angle
    half = math.sin(0.5 * angle)
    versine = 2.0 * half * half
    cos, sin = 1.0 - versine, 2.0 * half * math.sqrt(1.0 - half * half)
    along = z_n * versine
    return (
        cos * zx + sin * (ny * zz - nz * zy) + along * nx,
        cos * zy + sin * (nz * zx - nx * zz) + along * ny,
        cos * zz + sin * (nx * zy - ny * zx) + along * nz,
    )


@njit(cache=True, parallel=True, error_model="numpy", fastmath=_MATH)
def spatial_kernel(
    scene: IntArray,
    p_WE: FloatArray,
    z_W: FloatArray,
    p_WG: FloatArray,
    R_WL: FloatArray,
    baseline: FloatArray,
    p_WO: FloatArray,
    R_WO: FloatArray,
    semi_axes: FloatArray,
    v_WO: FloatArray,
    clearance: FloatArray,
    plane: FloatArray,
    annulus: FloatArray,
    terms: FloatArray,
    seconds: FloatArray,
    force: FloatArray,
    flow: FloatArray,
    step: float,
    least: int,
    fade: float,
    tolerance: float,
    longest: FloatArray,
    shortest: FloatArray,
    out: FloatArray,
    path: FloatArray,
    velocity: FloatArray,
) -> None:
    """Rolls out N rows in S scenes.

    Args:
        scene: (N,) scene of each row.
        p_WE, z_W: (S, 3) state now.
        p_WG: (S, 3) goals.
        R_WL: (S, 3, 3) local frames of the whole motion.
        baseline: (S,) its length L.
        p_WO, R_WO, semi_axes, v_WO: (S, M, ...) obstacles now; NaN centres are absent.
        clearance: (S, M) asked clearance.
        plane: (S, 4) n_W and the least value of n . p; n = 0: no plane.
        annulus: (3, n) workspace about the world's z axis; n = 0: no limits.
        terms: (N, K, 13) rows as in `coupling_kernels.turn_step`, normals of length 1.
        seconds: (N,) tau T, seconds a unit of s.
        force: (n, 3) f(k) / (alpha_x beta_x) in L in the middle of each step, a unit baseline.
        flow: (4,) half a step of the spring.
        step: ds.
        least: steps before which the motion does not end.
        fade: of the coupling near the goal, in baselines.
        tolerance: the motion ends once the goal is this near and it is slow [m].
        longest: (S,) a row ends once its path cannot become shorter than this [m].
        shortest: (S,) a row ends once it is short of the clearance that is asked, and that
            obstacle and start have, by more than this [m]; such obstacles are at rest.
        out: (N, 6) takes the outcomes.
        path, velocity: (N, n + 1, 3), or empty: positions and z, NaN after the end.
    """
    n_steps = len(force)
    f_xx, f_xz, f_zx, f_zz = flow[0], flow[1], flow[2], flow[3]
    M, K = p_WO.shape[1], terms.shape[1]
    keep = len(path) > 0
    for row in prange(len(scene)):
        s = scene[row]
        L = baseline[s]
        reach2 = (fade * L) ** 2
        x, y, z = p_WE[s, 0], p_WE[s, 1], p_WE[s, 2]
        zx, zy, zz = z_W[s, 0], z_W[s, 1], z_W[s, 2]
        gx, gy, gz = p_WG[s, 0], p_WG[s, 1], p_WG[s, 2]
        least_distance = np.full(M, np.inf)
        start_distance = np.full(M, np.inf)
        multiplier = np.zeros(M)
        limit = np.full(M, -np.inf)
        faded = terms[row].copy()
        log_gain = -np.inf
        cx = cy = cz = nx = ny = nz = kappa = 0.0
        psi = 1.0
        if K == 1 and terms[row, 0, ALPHA] > 0.0:
            log_gain = math.log(terms[row, 0, ALPHA] * step)
            cx, cy, cz = terms[row, 0, 0], terms[row, 0, 1], terms[row, 0, 2]
            psi, kappa = terms[row, 0, PSI], terms[row, 0, KAPPA]
            nx, ny = terms[row, 0, NORMAL], terms[row, 0, NORMAL + 1]
            nz = terms[row, 0, NORMAL + 2]
        length, world, error = 0.0, np.inf, np.inf
        hopeless = False
        taken = 0
        last = seconds[row] * step * n_steps
        allowed = min(
            0.0,
            world_margin(x, y, z, plane, s, annulus),
            world_margin(gx, gy, gz, plane, s, annulus),
        )
        bounded = world_margin(gx, gy, gz, plane, s, annulus) < np.inf
        for i in range(n_steps + 1):
            time = seconds[row] * step * i
            for j in range(M):
                ex = x - p_WO[s, j, 0] - v_WO[s, j, 0] * time
                ey = y - p_WO[s, j, 1] - v_WO[s, j, 1] * time
                ez = z - p_WO[s, j, 2] - v_WO[s, j, 2] * time
                # Not a number where there is no obstacle: then nothing is less.
                far = math.sqrt(ex * ex + ey * ey + ez * ez) - max(
                    semi_axes[s, j, 0], semi_axes[s, j, 1], semi_axes[s, j, 2]
                )
                if i == 0 or far < least_distance[j]:
                    d, multiplier[j] = point_distance(
                        ex, ey, ez, R_WO, semi_axes, s, j, multiplier[j]
                    )
                    if d < least_distance[j]:
                        least_distance[j] = d
                    if i == 0 and not math.isnan(ex):
                        start_distance[j] = d
                        limit[j] = min(clearance[s, j], d) - shortest[s]
                        if shortest[s] < np.inf:
                            at_goal, _ = point_distance(
                                gx - p_WO[s, j, 0] - v_WO[s, j, 0] * last,
                                gy - p_WO[s, j, 1] - v_WO[s, j, 1] * last,
                                gz - p_WO[s, j, 2] - v_WO[s, j, 2] * last,
                                R_WO,
                                semi_axes,
                                s,
                                j,
                                0.0,
                            )
                            limit[j] = min(limit[j], at_goal - shortest[s])
                    hopeless = hopeless or d < limit[j]
            if bounded:
                world = min(world, world_margin(x, y, z, plane, s, annulus))
            if keep:
                path[row, i, 0], path[row, i, 1], path[row, i, 2] = x, y, z
                velocity[row, i, 0], velocity[row, i, 1], velocity[row, i, 2] = zx, zy, zz
            left2 = (gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2
            error = math.sqrt(left2)
            speed2 = zx * zx + zy * zy + zz * zz
            arrived = i >= least and error < tolerance and speed2 < (20.0 * tolerance) ** 2
            hopeless = hopeless or length + error > longest[s]
            if i == n_steps or arrived or hopeless:
                break
            taken += 1
            x_before, y_before, z_before = x, y, z
            rx = gx + L * (
                R_WL[s, 0, 0] * force[i, 0]
                + R_WL[s, 0, 1] * force[i, 1]
                + R_WL[s, 0, 2] * force[i, 2]
            )
            ry = gy + L * (
                R_WL[s, 1, 0] * force[i, 0]
                + R_WL[s, 1, 1] * force[i, 1]
                + R_WL[s, 1, 2] * force[i, 2]
            )
            rz = gz + L * (
                R_WL[s, 2, 0] * force[i, 0]
                + R_WL[s, 2, 1] * force[i, 1]
                + R_WL[s, 2, 2] * force[i, 2]
            )
            qx, qy, qz = x - rx, y - ry, z - rz
            x, zx = rx + f_xx * qx + f_xz * zx, f_zx * qx + f_zz * zx
            y, zy = ry + f_xx * qy + f_xz * zy, f_zx * qy + f_zz * zy
            z, zz = rz + f_xx * qz + f_xz * zz, f_zx * qz + f_zz * zz
            weight = 1.0
            if reach2 > 0.0 and left2 < reach2:
                weight = (left2 / reach2) ** 2
            if K == 1:
                if log_gain > -np.inf and weight > 0.0:
                    gain = log_gain if weight == 1.0 else log_gain + math.log(weight)
                    zx, zy, zz = single_turn(
                        cx, cy, cz, nx, ny, nz, psi, kappa, gain, x, y, z, zx, zy, zz
                    )
            elif K > 1:
                for k in range(K):
                    faded[k, ALPHA] = weight * terms[row, k, ALPHA]
                wx, wy, wz = turn_step(faded, True, False, 1000.0, x, y, z, zx, zy, zz, step)
                zx, zy, zz = rotate(zx, zy, zz, wx, wy, wz)
            qx, qy, qz = x - rx, y - ry, z - rz
            x, zx = rx + f_xx * qx + f_xz * zx, f_zx * qx + f_zz * zx
            y, zy = ry + f_xx * qy + f_xz * zy, f_zx * qy + f_zz * zy
            z, zz = rz + f_xx * qz + f_xz * zz, f_zx * qz + f_zz * zz
            length += math.sqrt((x - x_before) ** 2 + (y - y_before) ** 2 + (z - z_before) ** 2)
        if keep:
            path[row, taken + 1 :] = np.nan
            velocity[row, taken + 1 :] = np.nan
        margin, closest = np.inf, np.inf
        end = seconds[row] * step * taken
        for j in range(M):
            if not math.isfinite(start_distance[j]):
                continue
            at_goal, _ = point_distance(
                gx - p_WO[s, j, 0] - v_WO[s, j, 0] * end,
                gy - p_WO[s, j, 1] - v_WO[s, j, 1] * end,
                gz - p_WO[s, j, 2] - v_WO[s, j, 2] * end,
                R_WO,
                semi_axes,
                s,
                j,
                0.0,
            )
            feasible = min(clearance[s, j], start_distance[j], at_goal)
            margin = min(margin, least_distance[j] - feasible)
            closest = min(closest, least_distance[j])
        out[row, 0], out[row, 1], out[row, 2] = margin, closest, error
        out[row, 3], out[row, 4], out[row, 5] = length, taken, world - allowed
