"""Compiled roll-outs in space with one avoidance term a row, many lanes at a time.

The motion, the account and the ends are those of
`drake_oa.regulation.spatial_kernels.spatial_kernel`, which stays the reference. Rows of one scene
are advanced `LANES` together as a structure of arrays by loops without branches and without calls
to the C library, so that the compiler makes them loops over vectors; all in float64.
`drake_oa.regulation.lane_steps` moves a block on, `drake_oa.regulation.lane_distances` keeps its
distances to the obstacles.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.policy.coupling_kernels import ALPHA, KAPPA, NORMAL, PSI
from drake_oa.regulation import lane_distances as distances
from drake_oa.regulation import lane_steps as lanes
from drake_oa.regulation.lane_math import STRICT, widest_vectors
from drake_oa.regulation.spatial_kernels import point_distance, world_margin

_VECTOR = 8
"""A block takes a multiple of this: not a fixed number, else short loops would be unrolled
before they could become loops over vectors."""

FEW_BLOCKS = 4
"""Up to as many are rolled out by the calling thread: to wake others takes longer."""

# --- blocks ----------------------------------------------------------------------------


@lanes.lane_jit
def _block(
    rows: IntArray,
    s: int,
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
) -> None:
    """Rolls out up to `LANES` rows of scene s."""
    widest_vectors()
    n_steps, M, L = len(force), p_WO.shape[1], baseline[s]
    f_xx, f_xz, f_zx, f_zz = flow[0], flow[1], flow[2], flow[3]
    gx, gy, gz = p_WG[s, 0], p_WG[s, 1], p_WG[s, 2]
    x, y, z = p_WE[s, 0], p_WE[s, 1], p_WE[s, 2]
    inverse_reach2 = 1.0 / (fade * L) ** 2 if fade > 0.0 else 0.0
    at_start = world_margin(x, y, z, plane, s, annulus)
    at_goal = world_margin(gx, gy, gz, plane, s, annulus)
    bounded, has_annulus = at_goal < np.inf, annulus.shape[1] > 0
    error = math.sqrt((gx - x) ** 2 + (gy - y) ** 2 + (gz - z) ** 2)
    speed2 = z_W[s, 0] ** 2 + z_W[s, 1] ** 2 + z_W[s, 2] ** 2
    ends = error > longest[s] or (
        least <= 0 and error < tolerance and speed2 < (20.0 * tolerance) ** 2
    )

    n = -(-len(rows) // _VECTOR) * _VECTOR
    S = np.zeros(lanes.N_STATE)
    for i in range(n):
        # A short block repeats its last row.
        row = rows[min(i, len(rows) - 1)]
        S[lanes.X + i], S[lanes.Y + i], S[lanes.Z + i] = x, y, z
        S[lanes.ZX + i], S[lanes.ZY + i], S[lanes.ZZ + i] = z_W[s, 0], z_W[s, 1], z_W[s, 2]
        S[lanes.ALIVE + i], S[lanes.ENDS + i] = 1.0, 1.0 if ends else 0.0
        S[lanes.WORLD + i] = at_start
        S[lanes.CLOSEST + i] = S[lanes.MARGIN + i] = np.inf
        term = terms[row, 0]
        S[lanes.CX + i], S[lanes.CY + i], S[lanes.CZ + i] = term[0], term[1], term[2]
        S[lanes.NX + i], S[lanes.NY + i] = term[NORMAL], term[NORMAL + 1]
        S[lanes.NZ + i] = term[NORMAL + 2]
        S[lanes.PSI + i] = S[lanes.INVERSE_PSI + i] = 1.0
        S[lanes.LOG_GAIN + i] = -1e30
        if term[ALPHA] > 0.0:
            S[lanes.LOG_GAIN + i] = math.log(term[ALPHA] * step)
            psi = min(max(term[PSI], 1.0 / lanes.MOST_PSI), lanes.MOST_PSI)
            S[lanes.PSI + i], S[lanes.INVERSE_PSI + i] = psi, 1.0 / psi
            S[lanes.KAPPA + i] = term[KAPPA]
        S[lanes.SECONDS + i] = seconds[row] * step

    D = np.zeros((M, distances.N_OBSTACLE))
    present = np.zeros(M, np.bool_)
    # A moving one's feasible clearance is known at the end, and with it the least margin.
    moving = False
    start_distance = np.zeros(M)
    for j in range(M):
        cx, cy, cz = p_WO[s, j, 0], p_WO[s, j, 1], p_WO[s, j, 2]
        vx, vy, vz = v_WO[s, j, 0], v_WO[s, j, 1], v_WO[s, j, 2]
        d, _ = point_distance(x - cx, y - cy, z - cz, R_WO, semi_axes, s, j, 0.0)
        start_distance[j] = d
        present[j] = math.isfinite(d)
        if not present[j]:
            continue
        moving = moving or vx != 0.0 or vy != 0.0 or vz != 0.0
        for i in range(n):
            last = S[lanes.SECONDS + i] * n_steps
            goal_distance, _ = point_distance(
                gx - cx - vx * last, gy - cy - vy * last, gz - cz - vz * last,
                R_WO, semi_axes, s, j, 0.0,
            )  # fmt: skip
            feasible = min(clearance[s, j], d, goal_distance)
            D[j, distances.LEAST + i], D[j, distances.FEASIBLE + i] = d, feasible
            D[j, distances.OFFSET + i] = np.inf
            S[lanes.CLOSEST + i] = min(S[lanes.CLOSEST + i], d)
            S[lanes.MARGIN + i] = min(S[lanes.MARGIN + i], d - feasible)
            if d - feasible < -shortest[s]:
                S[lanes.ENDS + i] = 1.0
    going = lanes.end_lanes(n, S)

    for k in range(n_steps):
        if going == 0:
            break
        f0, f1, f2 = L * force[k, 0], L * force[k, 1], L * force[k, 2]
        rx = gx + R_WL[s, 0, 0] * f0 + R_WL[s, 0, 1] * f1 + R_WL[s, 0, 2] * f2
        ry = gy + R_WL[s, 1, 0] * f0 + R_WL[s, 1, 1] * f1 + R_WL[s, 1, 2] * f2
        rz = gz + R_WL[s, 2, 0] * f0 + R_WL[s, 2, 1] * f1 + R_WL[s, 2, 2] * f2
        strong = lanes.first_half(
            n, S, rx, ry, rz, gx, gy, gz, f_xx, f_xz, f_zx, f_zz, inverse_reach2
        )
        if strong > 0:
            lanes.turn_lanes(n, S)
        lanes.second_half(
            n, S, rx, ry, rz, gx, gy, gz, f_xx, f_xz, f_zx, f_zz,
            tolerance if k + 1 >= least else 0.0, longest[s],
        )  # fmt: skip
        number = k + 1.0
        for j in range(M):
            if not present[j]:
                continue
            cx, cy, cz = p_WO[s, j, 0], p_WO[s, j, 1], p_WO[s, j, 2]
            vx, vy, vz = v_WO[s, j, 0], v_WO[s, j, 1], v_WO[s, j, 2]
            if distances.may_come_nearer(n, S, D[j], number, moving, cx, cy, cz, vx, vy, vz) > 0:
                distances.come_nearer(
                    n, S, D[j], number, shortest[s], cx, cy, cz, vx, vy, vz,
                    R_WO[s, j, 0, 0], R_WO[s, j, 0, 1], R_WO[s, j, 0, 2],
                    R_WO[s, j, 1, 0], R_WO[s, j, 1, 1], R_WO[s, j, 1, 2],
                    R_WO[s, j, 2, 0], R_WO[s, j, 2, 1], R_WO[s, j, 2, 2],
                    semi_axes[s, j, 0], semi_axes[s, j, 1], semi_axes[s, j, 2],
                )  # fmt: skip
        if bounded:
            if has_annulus:
                for i in range(n):
                    margin = world_margin(
                        S[lanes.X + i], S[lanes.Y + i], S[lanes.Z + i], plane, s, annulus
                    )
                    S[lanes.WORLD + i] = min(S[lanes.WORLD + i], margin)
            else:
                nx, ny, nz, level = plane[s, 0], plane[s, 1], plane[s, 2], plane[s, 3]
                for i in range(n):
                    margin = nx * S[lanes.X + i] + ny * S[lanes.Y + i] + nz * S[lanes.Z + i] - level
                    S[lanes.WORLD + i] = min(S[lanes.WORLD + i], margin)
        going = lanes.end_lanes(n, S)

    allowed = min(0.0, at_start, at_goal)
    for i in range(len(rows)):
        row = rows[i]
        end = S[lanes.SECONDS + i] * S[lanes.TAKEN + i]
        margin, closest = np.inf, np.inf
        for j in range(M):
            if not present[j]:
                continue
            feasible = D[j, distances.FEASIBLE + i]
            if moving:
                goal_distance, _ = point_distance(
                    gx - p_WO[s, j, 0] - v_WO[s, j, 0] * end,
                    gy - p_WO[s, j, 1] - v_WO[s, j, 1] * end,
                    gz - p_WO[s, j, 2] - v_WO[s, j, 2] * end,
                    R_WO, semi_axes, s, j, 0.0,
                )  # fmt: skip
                feasible = min(clearance[s, j], start_distance[j], goal_distance)
            margin = min(margin, D[j, distances.LEAST + i] - feasible)
            closest = min(closest, D[j, distances.LEAST + i])
        dx, dy, dz = gx - S[lanes.X + i], gy - S[lanes.Y + i], gz - S[lanes.Z + i]
        out[row, 0], out[row, 1] = margin, closest
        out[row, 2] = math.sqrt(dx * dx + dy * dy + dz * dz)
        out[row, 3], out[row, 4] = S[lanes.LENGTH + i], S[lanes.TAKEN + i]
        out[row, 5] = S[lanes.WORLD + i] - allowed if bounded else np.inf


@njit(cache=True, parallel=True, error_model="numpy", fastmath=STRICT)
def _all_blocks(
    first: IntArray,
    order: IntArray,
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
) -> None:
    """Rolls out by all threads; block b has the rows order[first[b] : first[b + 1]]."""
    for b in prange(len(first) - 1):
        rows = order[first[b] : first[b + 1]]
        _block(
            rows, scene[rows[0]], p_WE, z_W, p_WG, R_WL, baseline, p_WO, R_WO, semi_axes, v_WO,
            clearance, plane, annulus, terms, seconds, force, flow, step, least, fade, tolerance,
            longest, shortest, out,
        )  # fmt: skip


@lanes.lane_jit
def lane_kernel(
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
) -> None:
    """Rolls out N rows of one term each.

    The arguments are those of `spatial_kernels.spatial_kernel`, with terms (N, 1, 13). Rows
    of one scene may stand anywhere, but sorting them costs.
    """
    N = len(scene)
    order = np.arange(N)
    for row in range(1, N):
        if scene[row] < scene[row - 1]:
            order = np.argsort(scene, kind="mergesort")
            break
    first = np.empty(N + 1, np.int64)
    blocks = 0
    for k in range(N):
        if k == 0 or scene[order[k]] != scene[order[k - 1]] or k - first[blocks - 1] == lanes.LANES:
            first[blocks] = k
            blocks += 1
    first[blocks] = N
    if blocks > FEW_BLOCKS:
        _all_blocks(
            first[: blocks + 1], order, scene, p_WE, z_W, p_WG, R_WL, baseline, p_WO, R_WO,
            semi_axes, v_WO, clearance, plane, annulus, terms, seconds, force, flow, step, least,
            fade, tolerance, longest, shortest, out,
        )  # fmt: skip
        return
    for b in range(blocks):
        rows = order[first[b] : first[b + 1]]
        _block(
            rows, scene[rows[0]], p_WE, z_W, p_WG, R_WL, baseline, p_WO, R_WO, semi_axes, v_WO,
            clearance, plane, annulus, terms, seconds, force, flow, step, least, fade, tolerance,
            longest, shortest, out,
        )  # fmt: skip
