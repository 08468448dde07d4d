"""Many action-level trajectories in space at once, among any number of ellipsoids.

Each row does what the DmpIntegrator does with one avoidance term (eq. 8, in its plane):
half a step of the spring in closed form, the turn of z, the spring's other half. Obstacles may
move at constant velocity; then the motion's duration tau T matters, else it does not.

Rows of one scene are advanced `LANES` together as a structure of arrays
(`drake_oa.regulation.rollout_kernels`). Distances to an obstacle are asked for only where the
motion may have come nearer.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import ArrayLike

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray
from drake_oa.common.numba_tools import kernel_arrays
from drake_oa.common.thinking import count
from drake_oa.geometry.ellipsoid_kernels import feasible_clearance
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.dmp import Dmp, imitate, minimum_jerk, spring_flow
from drake_oa.regulation.lane_math import STRICT, widest_vectors
from drake_oa.regulation.rollout_kernels import (
    ALIVE,
    CLOSEST,
    CX,
    CY,
    CZ,
    ENDS,
    FEASIBLE,
    INVERSE_PSI,
    LANES,
    LEAST,
    LENGTH,
    LOG_GAIN,
    MARGIN,
    MOST_PSI,
    N_OBSTACLE,
    N_STATE,
    NX,
    NY,
    NZ,
    OFFSET,
    SECONDS,
    TAKEN,
    TERM_KAPPA,
    TERM_PSI,
    WRONG_TERMS,
    ZX,
    ZY,
    ZZ,
    X,
    Y,
    Z,
    come_nearer,
    end_lanes,
    first_half,
    first_wrong_term,
    lane_jit,
    may_come_nearer,
    point_distance,
    second_half,
    turn_lanes,
)

STEPS = 500
"""Default number of steps a unit of normalised time."""
N_OUTCOMES = 5
"""Columns of what a row came to: margin, clearance, goal error, path length, steps; see
`drake_oa.regulation.rollout.SpatialRollouts`."""
FEW_BLOCKS = 4
"""Up to as many are rolled out by the calling thread: to wake others takes longer."""
_VECTOR = 8
"""A block takes a multiple of this: not a fixed number, else short loops would be unrolled
before they could become loops over vectors."""


class SceneArrays(NamedTuple):
    """S scenes, see `drake_oa.regulation.rollout.SpatialScenes`."""

    p_WE: FloatArray
    z_W: FloatArray
    p_WG: FloatArray
    R_WL: FloatArray
    baseline: FloatArray
    p_WO: FloatArray
    R_WO: FloatArray
    semi_axes: FloatArray
    v_WO: FloatArray
    asked_clearance: FloatArray


class Course(NamedTuple):
    """How motions go on, and when they end.

    Attributes:
        force: (n, 3) f(k) / (alpha_x beta_x) in L in the middle of each step, a unit baseline.
        flow: (4,) half a step of the spring, xx, xz, zx, zz.
        step: ds.
        least: steps before which a motion does not end.
        fade: of the coupling near the goal, in baselines.
        tolerance: it ends once the goal is this near and it is slow [m].
        longest: (S,) a row ends once its path cannot become shorter than this [m].
        shortest: (S,) a row ends once it is short of the feasible clearance by more than
            this [m]; obstacles are at rest then.
    """

    force: FloatArray
    flow: FloatArray
    step: float
    least: int
    fade: float
    tolerance: float
    longest: FloatArray
    shortest: FloatArray


class Outcomes(NamedTuple):
    """What N rows came to: (N, 5); positions and z, (N, n + 1, 3) or, not asked for, (0, 1, 3)."""

    table: FloatArray
    path: FloatArray
    velocity: FloatArray


@dataclass(frozen=True, eq=False)
class SpatialScenes(Frozen):
    """S motions under way, each among up to M ellipsoids, in the world frame.

    Attributes:
        p_WE: (S, 3) positions now [m].
        z_W: (S, 3) scaled velocities now [m].
        p_WG: (S, 3) goals [m].
        R_WL: (S, 3, 3) local frames of the whole motions.
        baseline: (S,) their lengths L from start to goal [m].
        p_WO: (S, M, 3) centres now [m]; NaN: no such obstacle.
        R_WO: (S, M, 3, 3) rotations, principal axes in the columns.
        semi_axes: (S, M, 3) [m].
        v_WO: (S, M, 3) velocities of the centres [m/s].
        asked_clearance: (S, M) clearance Delta asked of each [m].
        s: normalised time now, one for all.
    """

    p_WE: FloatArray
    z_W: FloatArray
    p_WG: FloatArray
    R_WL: FloatArray
    baseline: FloatArray
    p_WO: FloatArray
    R_WO: FloatArray
    semi_axes: FloatArray
    v_WO: FloatArray
    asked_clearance: FloatArray
    s: float = 0.0

    def __len__(self) -> int:
        return len(self.p_WE)

    def rows(self, index: ArrayLike) -> SpatialScenes:
        """Some of the scenes, by indices or a mask."""
        chosen = {
            item.name: getattr(self, item.name)[np.asarray(index)]
            for item in fields(self)
            if item.name != "s"
        }
        return replace(self, **chosen)

    def without_obstacles(self) -> SpatialScenes:
        """The same motions among nothing."""
        S = len(self)
        none = np.zeros((S, 0, 3))
        return replace(
            self,
            p_WO=none,
            R_WO=np.zeros((S, 0, 3, 3)),
            semi_axes=none,
            v_WO=none,
            asked_clearance=np.zeros((S, 0)),
        )

    @cached_property
    def arrays(self) -> SceneArrays:
        """As the kernels take them."""
        return SceneArrays(*kernel_arrays(*(getattr(self, n) for n in SceneArrays._fields)))

    @property
    def p_WS(self) -> FloatArray:
        """(S, 3) starts of the motions [m]."""
        return self.p_WG - self.baseline[:, None] * self.R_WL[:, :, 0]


@dataclass(frozen=True, eq=False)
class SpatialRollouts(Frozen):
    """What N trajectories came to.

    Attributes:
        margin: (N,) least excess over the feasible clearance [m]: of each obstacle
            its least distance minus min(asked, distance at the beginning, distance of
            the goal at the end). inf without obstacles.
        kept_clearance: (N,) least distance to any obstacle at the steps [m]; inside one, minus a
            lower bound of the depth. Between the steps it may be less by 1e-4 L, by 5e-4 L
            where an obstacle is all but touched.
        goal_error: (N,) distance to the goal at the end [m].
        path_length: (N,) [m].
        steps: (N,) steps taken until it arrived, or all of them.
        path: (N, n + 1, 3) positions [m], NaN after the end; (0, 1, 3) unless asked for.
        velocity: (N, n + 1, 3) scaled velocities z there [m].
    """

    margin: FloatArray
    kept_clearance: FloatArray
    goal_error: FloatArray
    path_length: FloatArray
    steps: FloatArray
    path: FloatArray
    velocity: FloatArray

    @property
    def contact(self) -> BoolArray:
        """(N,) whether an obstacle was touched."""
        return self.kept_clearance <= 0.0


@cache
def default_dmp() -> Dmp:
    """A straight minimum-jerk motion of three dimensions, of unit baseline and duration."""
    return imitate(*minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0)))


@lru_cache(maxsize=16)
def _forcing(dmp: Dmp, s: float, count: int, step: float) -> FloatArray:
    """f(k) / (alpha_x beta_x) in the middle of each step from s on, (count, 3)."""
    k = dmp.phase(s + (np.arange(count) + 0.5) * step)
    basis = np.exp(-dmp.widths * (k[:, None] - dmp.centers) ** 2)
    # Beyond the last centre all are small alike; the quotient stays.
    total = np.maximum(basis.sum(axis=1), 1e-300)
    force = (basis @ dmp.weights.T) * (k / total)[:, None]
    return np.ascontiguousarray(force / (dmp.alpha_x * dmp.beta_x))


def spatial_rollouts(  # noqa: PLR0913
    scenes: SpatialScenes,
    scene: ArrayLike,
    terms: ArrayLike,
    *,
    seconds: ArrayLike = 1.0,
    dmp: Dmp | None = None,
    steps: int = STEPS,
    end: float = 1.0,
    horizon: float | None = None,
    fade: float = 0.0,
    tolerance: float = 0.0,
    longest: ArrayLike = math.inf,
    shortest: ArrayLike = math.inf,
    keep_path: bool = False,
) -> SpatialRollouts:
    """Rolls out one trajectory a row.

    Args:
        scenes: S scenes.
        scene: (N,) the scene of each row.
        terms: (N, 13) avoidance terms as `coupling.turn_step` takes them: centre
            (3) [m], alpha, psi, kappa [1/m^2], heading (3), unit normal (3) and guidance
            alpha, which is 0; alpha 0: no term.
        seconds: () or (N,) tau T, the duration of a unit of s [s].
        dmp: the primitive; None: `default_dmp`.
        steps: number of steps a unit of s.
        end: s at which the motion ends at the earliest.
        horizon: s at which it ends at the latest; None: `end`.
        fade: the terms fade within this many baselines of the goal.
        tolerance: between `end` and `horizon` it ends once the goal is this near [m].
        longest: () or (S,) a row ends as soon as its path is bound to be longer [m].
        shortest: () or (S,) a row ends as soon as it is short of the feasible clearance by
            more than this [m]; for obstacles at rest.
        keep_path: whether to return the paths.

    Returns:
        The outcome of each row.

    Raises:
        ValueError: for wrong shapes or values out of range.
    """
    dmp = default_dmp() if dmp is None else dmp
    index = np.array(scene, dtype=np.int64, order="C")
    table = np.array(terms, dtype=float, order="C")
    N = len(index)
    _check_terms(table, N)
    if N and not 0 <= index.min() <= index.max() < len(scenes):
        raise ValueError(f"scene must hold numbers from 0 to {len(scenes) - 1}")
    horizon = end if horizon is None else horizon
    if steps < 1 or not scenes.s <= end <= horizon < math.inf:
        raise ValueError(
            f"steps must be at least 1 and s <= end <= horizon, not {steps}, {scenes.s}, "
            f"{end} and {horizon}"
        )
    step = 1.0 / steps
    most = max(round((horizon - scenes.s) * steps), 1)
    shape = (N if keep_path else 0, most + 1 if keep_path else 1, 3)
    out = Outcomes(np.empty((N, N_OUTCOMES)), np.empty(shape), np.empty(shape))
    course = Course(
        _forcing(dmp, scenes.s, most, step),
        np.array(spring_flow(dmp.alpha_x, dmp.beta_x, 0.5 * step)),
        step,
        round((end - scenes.s) * steps),
        float(fade),
        float(tolerance),
        np.array(np.broadcast_to(np.asarray(longest, dtype=float), (len(scenes),))),
        np.array(np.broadcast_to(np.asarray(shortest, dtype=float), (len(scenes),))),
    )
    per_row = np.array(np.broadcast_to(np.asarray(seconds, dtype=float), (N,)))
    lane_kernel(index, table, per_row, scenes.arrays, course, out)
    margin, kept, goal_error, path_length, taken = (np.array(c) for c in out.table.T)
    count(searches=1, steps=int(taken.sum()) * max(scenes.p_WO.shape[1], 1))
    return SpatialRollouts(margin, kept, goal_error, path_length, taken, out.path, out.velocity)


def _check_terms(terms: FloatArray, count: int) -> None:
    if terms.shape != (count, N_COLUMNS):
        raise ValueError(f"terms must be ({count}, {N_COLUMNS}), not {terms.shape}")
    row, what = first_wrong_term(terms)
    if what:
        raise ValueError(f"terms {WRONG_TERMS[what]}; that of row {row} is {terms[row]}")


# --- blocks ------------------------------------------------------------------------------


@lane_jit
def _laid_out(
    rows: IntArray, s: int, terms: FloatArray, seconds: FloatArray, scenes: SceneArrays,
    course: Course, S: FloatArray,
) -> int:  # fmt: skip
    """Puts up to `LANES` rows of scene s into a block; returns how many lanes it takes."""
    x, y, z = scenes.p_WE[s, 0], scenes.p_WE[s, 1], scenes.p_WE[s, 2]
    zx, zy, zz = scenes.z_W[s, 0], scenes.z_W[s, 1], scenes.z_W[s, 2]
    error = math.sqrt(
        (scenes.p_WG[s, 0] - x) ** 2 + (scenes.p_WG[s, 1] - y) ** 2 + (scenes.p_WG[s, 2] - z) ** 2
    )
    slow = zx**2 + zy**2 + zz**2 < (20.0 * course.tolerance) ** 2
    ends = error > course.longest[s] or (course.least <= 0 and error < course.tolerance and slow)
    n = -(-len(rows) // _VECTOR) * _VECTOR
    for i in range(n):
        # A short block repeats its last row.
        row = rows[min(i, len(rows) - 1)]
        term = terms[row]
        S[X + i], S[Y + i], S[Z + i] = x, y, z
        S[ZX + i], S[ZY + i], S[ZZ + i] = zx, zy, zz
        S[ALIVE + i], S[ENDS + i] = 1.0, 1.0 if ends else 0.0
        S[CLOSEST + i] = S[MARGIN + i] = np.inf
        S[CX + i], S[CY + i], S[CZ + i] = term[0], term[1], term[2]
        S[NX + i], S[NY + i], S[NZ + i] = term[NORMAL], term[NORMAL + 1], term[NORMAL + 2]
        S[TERM_PSI + i] = S[INVERSE_PSI + i] = 1.0
        S[LOG_GAIN + i] = -1e30
        if term[ALPHA] > 0.0:
            S[LOG_GAIN + i] = math.log(term[ALPHA] * course.step)
            psi = min(max(term[PSI], 1.0 / MOST_PSI), MOST_PSI)
            S[TERM_PSI + i], S[INVERSE_PSI + i] = psi, 1.0 / psi
            S[TERM_KAPPA + i] = term[KAPPA]
        S[SECONDS + i] = seconds[row] * course.step
    return n


@lane_jit
def _keep(rows: IntArray, k: int, S: FloatArray, out: Outcomes) -> None:
    """Writes down where the lanes that go on are after k steps."""
    for i in range(len(rows)):
        if S[ALIVE + i] > 0.0:
            path, velocity = out.path[rows[i]], out.velocity[rows[i]]
            path[k, 0], path[k, 1], path[k, 2] = S[X + i], S[Y + i], S[Z + i]
            velocity[k, 0], velocity[k, 1], velocity[k, 2] = S[ZX + i], S[ZY + i], S[ZZ + i]


@lane_jit
def _goal_distance(scenes: SceneArrays, s: int, j: int, time: float) -> float:
    """Distance of the goal of scene s to its ellipsoid j after a time [m]."""
    d, _ = point_distance(
        scenes.p_WG[s, 0] - scenes.p_WO[s, j, 0] - scenes.v_WO[s, j, 0] * time,
        scenes.p_WG[s, 1] - scenes.p_WO[s, j, 1] - scenes.v_WO[s, j, 1] * time,
        scenes.p_WG[s, 2] - scenes.p_WO[s, j, 2] - scenes.v_WO[s, j, 2] * time,
        scenes.R_WO, scenes.semi_axes, s, j, 0.0,
    )  # fmt: skip
    return d


@lane_jit
def _block(
    rows: IntArray, terms: FloatArray, seconds: FloatArray, scene: IntArray, scenes: SceneArrays,
    course: Course, out: Outcomes,
) -> None:  # fmt: skip
    """Rolls out up to `LANES` rows of one scene."""
    widest_vectors()
    s = scene[rows[0]]
    n_steps, M, L = len(course.force), scenes.p_WO.shape[1], scenes.baseline[s]
    R_WL = scenes.R_WL
    flow = (course.flow[0], course.flow[1], course.flow[2], course.flow[3])
    longest, shortest = course.longest[s], course.shortest[s]
    gx, gy, gz = scenes.p_WG[s, 0], scenes.p_WG[s, 1], scenes.p_WG[s, 2]
    goal = (gx, gy, gz)
    x, y, z = scenes.p_WE[s, 0], scenes.p_WE[s, 1], scenes.p_WE[s, 2]
    inverse_reach2 = 1.0 / (course.fade * L) ** 2 if course.fade > 0.0 else 0.0
    S = np.zeros(N_STATE)
    n = _laid_out(rows, s, terms, seconds, scenes, course, S)
    keeps = len(out.path) > 0
    if keeps:
        for row in rows:
            out.path[row], out.velocity[row] = np.nan, np.nan
        _keep(rows, 0, S, out)

    D = np.zeros((M, N_OBSTACLE))
    present = np.zeros(M, np.bool_)
    # A moving one's feasible clearance is known at the end, and with it the least margin.
    moving = False
    start_distance = np.zeros(M)
    for j in range(M):
        d, _ = point_distance(
            x - scenes.p_WO[s, j, 0], y - scenes.p_WO[s, j, 1], z - scenes.p_WO[s, j, 2],
            scenes.R_WO, scenes.semi_axes, s, j, 0.0,
        )  # fmt: skip
        start_distance[j] = d
        present[j] = math.isfinite(d)
        if not present[j]:
            continue
        for i in range(3):
            moving = moving or scenes.v_WO[s, j, i] != 0.0
        for i in range(n):
            at_end = _goal_distance(scenes, s, j, S[SECONDS + i] * n_steps)
            feasible = feasible_clearance(scenes.asked_clearance[s, j], d, at_end)
            D[j, LEAST + i], D[j, FEASIBLE + i] = d, feasible
            D[j, OFFSET + i] = np.inf
            S[CLOSEST + i] = min(S[CLOSEST + i], d)
            S[MARGIN + i] = min(S[MARGIN + i], d - feasible)
            if d - feasible < -shortest:
                S[ENDS + i] = 1.0
    going = end_lanes(n, S)

    for k in range(n_steps):
        if going == 0:
            break
        f0, f1, f2 = L * course.force[k, 0], L * course.force[k, 1], L * course.force[k, 2]
        rest = (
            gx + R_WL[s, 0, 0] * f0 + R_WL[s, 0, 1] * f1 + R_WL[s, 0, 2] * f2,
            gy + R_WL[s, 1, 0] * f0 + R_WL[s, 1, 1] * f1 + R_WL[s, 1, 2] * f2,
            gz + R_WL[s, 2, 0] * f0 + R_WL[s, 2, 1] * f1 + R_WL[s, 2, 2] * f2,
        )
        if first_half(n, S, rest, goal, flow, inverse_reach2) > 0:
            turn_lanes(n, S)
        tolerance = course.tolerance if k + 1 >= course.least else 0.0
        second_half(n, S, rest, goal, flow, tolerance, longest)
        if keeps:
            _keep(rows, k + 1, S, out)
        for j in range(M):
            if not present[j]:
                continue
            c, v, R, a = (
                scenes.p_WO[s, j],
                scenes.v_WO[s, j],
                scenes.R_WO[s, j],
                scenes.semi_axes[s, j],
            )
            center, velocity = (c[0], c[1], c[2]), (v[0], v[1], v[2])
            if may_come_nearer(n, S, D[j], k + 1.0, moving, center, velocity) > 0:
                turned = (
                    R[0, 0], R[0, 1], R[0, 2], R[1, 0], R[1, 1], R[1, 2], R[2, 0], R[2, 1], R[2, 2]
                )  # fmt: skip
                come_nearer(
                    n, S, D[j], k + 1.0, center, velocity, turned, (a[0], a[1], a[2]), shortest
                )
        going = end_lanes(n, S)

    for i in range(len(rows)):
        margin, closest = np.inf, np.inf
        for j in range(M):
            if not present[j]:
                continue
            feasible = D[j, FEASIBLE + i]
            if moving:
                at_end = _goal_distance(scenes, s, j, S[SECONDS + i] * S[TAKEN + i])
                feasible = feasible_clearance(
                    scenes.asked_clearance[s, j], start_distance[j], at_end
                )
            margin = min(margin, D[j, LEAST + i] - feasible)
            closest = min(closest, D[j, LEAST + i])
        dx, dy, dz = gx - S[X + i], gy - S[Y + i], gz - S[Z + i]
        found = out.table[rows[i]]
        found[0], found[1] = margin, closest
        found[2] = math.sqrt(dx * dx + dy * dy + dz * dz)
        found[3], found[4] = S[LENGTH + i], S[TAKEN + i]


@njit(cache=True, parallel=True, error_model="numpy", fastmath=STRICT)
def _all_blocks(
    first: IntArray, order: IntArray, terms: FloatArray, seconds: FloatArray, scene: IntArray,
    scenes: SceneArrays, course: Course, out: Outcomes,
) -> None:  # fmt: skip
    """Rolls out by all threads; block b has the rows order[first[b] : first[b + 1]]."""
    for b in prange(len(first) - 1):
        _block(order[first[b] : first[b + 1]], terms, seconds, scene, scenes, course, out)


@lane_jit
def lane_kernel(
    scene: IntArray, terms: FloatArray, seconds: FloatArray, scenes: SceneArrays, course: Course,
    out: Outcomes,
) -> None:  # fmt: skip
    """Rolls out N rows.

    Args:
        scene: (N,) scene of each row; rows of one scene may stand anywhere, but sorting costs.
        terms: (N, 13) rows as in `coupling.turn_step`, normals of length 1.
        seconds: (N,) tau T, seconds a unit of s.
        scenes, course: among what, and how.
        out: takes the outcomes.
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
        if k == 0 or scene[order[k]] != scene[order[k - 1]] or k - first[blocks - 1] == LANES:
            first[blocks] = k
            blocks += 1
    first[blocks] = N
    if blocks > FEW_BLOCKS:
        _all_blocks(first[: blocks + 1], order, terms, seconds, scene, scenes, course, out)
        return
    for b in range(blocks):
        _block(order[first[b] : first[b + 1]], terms, seconds, scene, scenes, course, out)
