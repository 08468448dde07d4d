"""Compiled arithmetic behind `drake_oa.posture.posture_plan`; call its functions instead.

Every kernel takes C-contiguous float64 and int64 arrays, so that numba compiles each of
them once, and caches it on disk.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.geometry.points import PointBlocks
from drake_oa.robot.arm_kernels import (
    Arm,
    lowest_height,
    nearest_point,
    poses,
    reach,
    self_distance,
)

STEPS = 8
"""Newton steps onto a pose, at most."""
TOLERANCE = 2e-4
"""Of a pose [m, rad]: the control law takes only what lies in the null space."""
DISTANCE, SELF, LIMIT = range(3)
"""Columns of what is measured of a posture."""


class Rules(NamedTuple):
    """What a plan keeps, and its prices: see `drake_oa.posture.posture_plan`.

    Attributes:
        stop, asked: distances of the links to obstacles and table: forbidden below, wanted [m].
        padding: a surface may lie this far outside its points [m].
        self_stop, self_asked: the same of the links to each other [m].
        limit_stop, limit_asked: the same of the joints to their limits [rad].
        speed_share: share of the joints' speed limits that may be used.
        near_weight, self_weight, limit_weight, motion_weight: prices.
        forbidden, slope: price of what is forbidden, and how it rises.
        leap, leap_of_any: how far the given joint, and any, may turn between layers [rad].
        reserve: by how much more than the stop distance the samples keep [m].
    """

    stop: float
    asked: float
    padding: float
    self_stop: float
    self_asked: float
    limit_stop: float
    limit_asked: float
    speed_share: float
    near_weight: float
    self_weight: float
    limit_weight: float
    motion_weight: float
    forbidden: float
    slope: float
    leap: float
    reserve: float
    leap_of_any: float


class Surroundings(NamedTuple):
    """What an arm must not touch: points, and the table (4,), NaN: there is none."""

    blocks: PointBlocks
    table: FloatArray


class ToolPath(NamedTuple):
    """T samples of a motion of the tool.

    Attributes:
        p_WE, R_WE: (T, 3) and (T, 3, 3) of the tool [m].
        s: (T,) normalised times, increasing.
        ages: (T,) for how long the obstacles have moved by then [s].
        rest: (T, n) what the null space rests in [rad].
        seconds: duration of a unit of s [s].
    """

    p_WE: FloatArray
    R_WE: FloatArray
    s: FloatArray
    ages: FloatArray
    rest: FloatArray
    seconds: float


@compiled
def _limit_margin(q: FloatArray, arm: Arm) -> float:
    """Least distance of a joint to its limits [rad]."""
    lower, upper = arm.lower, arm.upper
    least = np.inf
    for i in range(len(q)):
        least = min(least, q[i] - lower[i], upper[i] - q[i])
    return least


@compiled
def _take(
    node: int,
    seed: FloatArray,
    values: FloatArray,
    p_WE: FloatArray,
    R_WE: FloatArray,
    fixed: int,
    arm: Arm,
    margin: float,
    X_WB: FloatArray,
    q: FloatArray,
    found: BoolArray,
) -> None:
    """Solves one node from a seed into q (N, 7) and found (N,)."""
    q[node] = seed
    q[node, fixed] = values[node]
    found[node] = (
        reach(q[node], p_WE, R_WE, fixed, arm.X_PJ, X_WB, STEPS, TOLERANCE)
        and _limit_margin(q[node], arm) >= margin
    )


@compiled
def solve_row(
    p_WE: FloatArray,
    R_WE: FloatArray,
    values: FloatArray,
    seeds: FloatArray,
    seeded: BoolArray,
    fixed: int,
    arm: Arm,
    margin: float,
    X_WB: FloatArray,
    q: FloatArray,
    found: BoolArray,
) -> None:
    """Postures with the tool at a pose, one for each value of a joint.

    Each begins at its seed, those without one at their neighbour's solution, from the
    seeded ones outward: all stay in the branch of the inverse kinematics that these are in.

    Args:
        p_WE, R_WE, fixed: see `arm_kernels.reach`.
        values: (N,) of the joint, increasing [rad].
        seeds: (N, 7) [rad].
        seeded: (N,) whether there is a seed.
        arm: which.
        margin: least distance of a posture to the joints' limits [rad].
        X_WB: (8, 4, 4) to work in.
        q: (N, 7) receives the postures [rad].
        found: (N,) receives which there are.
    """
    N = len(values)
    for j in range(N):
        found[j] = False
    for j in range(N):
        if seeded[j]:
            _take(j, seeds[j], values, p_WE, R_WE, fixed, arm, margin, X_WB, q, found)
    for j in range(1, N):
        if not found[j] and found[j - 1]:
            _take(j, q[j - 1], values, p_WE, R_WE, fixed, arm, margin, X_WB, q, found)
    for j in range(N - 2, -1, -1):
        if not found[j] and found[j + 1]:
            _take(j, q[j + 1], values, p_WE, R_WE, fixed, arm, margin, X_WB, q, found)


@compiled
def measure(
    X_WB: FloatArray, age: float, arm: Arm, around: Surroundings, rules: Rules
) -> tuple[float, int, float]:
    """What a posture keeps, its bodies being posed and the obstacles having moved for `age` [s].

    Returns:
        Distance to obstacles and table [m], the obstacle (-1: none is nearer than the table
        or than what is asked), and the distance of the parts to each other [m].
    """
    far = rules.asked + rules.padding
    distance, _, nearest, _ = nearest_point(X_WB, arm.shapes, around.blocks, age, -1, far)
    distance -= rules.padding
    height = lowest_height(X_WB, arm.shapes, around.table)
    if height < distance:
        distance, nearest = height, -1
    apart = self_distance(X_WB, arm.parts, rules.self_asked)
    return distance, nearest, apart


@compiled
def _lacking(value: float, stop: float, asked: float) -> float:
    """0 where what is asked is kept, 1 at the stop."""
    return max(0.0, (asked - value) / (asked - stop))


@compiled
def price(
    q: FloatArray,
    rest: FloatArray,
    arm: Arm,
    distance: float,
    apart: float,
    ds: float,
    rules: Rules,
) -> float:
    """Cost of being in a posture for ds of normalised time; see `posture_plan`."""
    n = len(q)
    away = 0.0
    for i in range(n):
        for j in range(n):
            away += (q[i] - rest[i]) * arm.mass[i, j] * (q[j] - rest[j])
    near = _lacking(distance, rules.stop + rules.reserve, rules.asked)
    close = _lacking(apart, rules.self_stop, rules.self_asked)
    margin = _limit_margin(q, arm)
    tight = _lacking(margin, rules.limit_stop, rules.limit_asked)
    cost = away + rules.near_weight * near**2 + rules.self_weight * close**2
    cost += rules.limit_weight * tight**2
    cost *= ds
    for lacking in (near, close):
        if lacking > 1.0:
            cost += rules.forbidden + rules.slope * (lacking - 1.0)
    return cost


@compiled
def edge(
    one: FloatArray,
    other: FloatArray,
    ds: float,
    seconds: float,
    fixed: int,
    arm: Arm,
    rules: Rules,
) -> float:
    """Cost of going from one posture to another within ds of normalised time."""
    n = len(one)
    if abs(other[fixed] - one[fixed]) > rules.leap:
        return np.inf
    moved, rate = 0.0, 0.0
    for i in range(n):
        d = other[i] - one[i]
        moved += arm.mass[i, i] * d * d
        rate = max(rate, abs(d) / arm.speed[i])
        if abs(d) > rules.leap_of_any:
            return np.inf
    cost = rules.motion_weight * moved / ds
    rate /= rules.speed_share * seconds * ds
    if rate > 1.0:
        cost += rules.forbidden + rules.slope * (rate - 1.0)
    return cost


@compiled
def best_way(
    start: FloatArray,
    q: FloatArray,
    found: BoolArray,
    cost: FloatArray,
    path: ToolPath,
    window: int,
    first: int,
    fixed: int,
    arm: Arm,
    rules: Rules,
    chosen: IntArray,
) -> float:
    """Viterbi's algorithm over layers of postures.

    Args:
        start: (n,) the posture at s[0] [rad].
        q: (T, N, n) postures of each layer; the first layer is not used [rad].
        found: (T, N) which there are.
        cost: (T, N) of being there.
        path: of the tool.
        window: columns that one layer's posture may differ from that of the last: nothing is
            known of what is between them.
        first: column of the start.
        fixed: the joint that the columns are of.
        arm, rules: which, and what is kept.
        chosen: (T,) receives the column of each layer but the first.

    Returns:
        The cost; inf where no way leads through all layers.
    """
    s, seconds = path.s, path.seconds
    T, N = found.shape
    total = np.full((T, N), np.inf)
    back = np.full((T, N), -1, dtype=np.int64)
    for t in range(1, T):
        ds = s[t] - s[t - 1]
        for j in range(N):
            if not found[t, j]:
                continue
            if t == 1:
                if abs(j - first) <= window:
                    best, came = edge(start, q[t, j], ds, seconds, fixed, arm, rules), 0
                else:
                    best, came = np.inf, -1
            else:
                best, came = np.inf, -1
                for i in range(max(0, j - window), min(N, j + window + 1)):
                    if total[t - 1, i] < best:
                        to = total[t - 1, i] + edge(
                            q[t - 1, i], q[t, j], ds, seconds, fixed, arm, rules
                        )
                        if to < best:
                            best, came = to, i
            total[t, j], back[t, j] = best + cost[t, j], came
    last = 0
    for j in range(N):
        if total[T - 1, j] < total[T - 1, last]:
            last = j
    if not math.isfinite(total[T - 1, last]):
        return np.inf
    answer = total[T - 1, last]
    for t in range(T - 1, 0, -1):
        chosen[t] = last
        last = back[t, last]
    return answer


@compiled
def plan_rows(
    path: ToolPath,
    values: FloatArray,
    start: FloatArray,
    guess: FloatArray,
    window: int,
    fixed: int,
    arm: Arm,
    around: Surroundings,
    rules: Rules,
    way: FloatArray,
) -> tuple[float, int]:
    """The cheapest way of an arm along a path of its tool through a grid of postures.

    Args:
        path: of the tool.
        values: (T, N) of the joint that is given, increasing along the rows [rad].
        start: (n,) where the arm is at the first sample [rad].
        guess: (T, n) postures whose columns are the middle ones; (0, n): there are none, and
            each layer begins at the solutions of the one before it.
        window: see `best_way`.
        fixed: the joint that is given.
        arm, around, rules: which, among what, and what is kept.
        way: (T, n) receives the postures [rad].

    Returns:
        The cost, inf where there is no way, and how many postures were measured.
    """
    T, N = values.shape
    n = len(start)
    q, found = np.zeros((T, N, n)), np.zeros((T, N), dtype=np.bool_)
    cost = np.full((T, N), np.inf)
    X_WB = np.empty((n + 1, 4, 4))
    seeds, seeded = np.zeros((N, n)), np.zeros(N, dtype=np.bool_)
    measured = 0
    first = N // 2 if len(guess) > 0 else np.abs(values[0] - start[fixed]).argmin()
    for t in range(T):
        if len(guess) > 0:
            seeds[N // 2], seeded[N // 2] = guess[t], True
        elif t == 0:
            seeds[first], seeded[first] = start, True
        else:
            seeds[:], seeded[:] = q[t - 1], found[t - 1]
        solve_row(
            path.p_WE[t],
            path.R_WE[t],
            values[t],
            seeds,
            seeded,
            fixed,
            arm,
            rules.limit_stop,
            X_WB,
            q[t],
            found[t],
        )
        if t == 0:
            continue
        for j in range(N):
            if found[t, j]:
                poses(q[t, j], arm.X_PJ, X_WB)
                distance, _, apart = measure(X_WB, path.ages[t], arm, around, rules)
                measured += 1
                ds = path.s[t] - path.s[t - 1]
                cost[t, j] = price(q[t, j], path.rest[t], arm, distance, apart, ds, rules)
    chosen = np.zeros(T, dtype=np.int64)
    answer = best_way(start, q, found, cost, path, window, first, fixed, arm, rules, chosen)
    if math.isfinite(answer):
        way[0] = start
        for t in range(1, T):
            way[t] = q[t, chosen[t]]
    return answer, measured


@compiled
def measure_way(
    way: FloatArray,
    ages: FloatArray,
    arm: Arm,
    around: Surroundings,
    rules: Rules,
    kept: FloatArray,
    nearest: IntArray,
) -> None:
    """What an arm keeps on its way (T, n), the obstacles having moved for `ages` (T,) [s].

    Args:
        kept: (T, 3) receives distance to obstacles and table, of the parts to each other
            [m] and to a joint limit [rad].
        nearest: (T,) receives the obstacle, see `measure`.
    """
    X_WB = np.empty((way.shape[1] + 1, 4, 4))
    for t in range(len(way)):
        poses(way[t], arm.X_PJ, X_WB)
        kept[t, DISTANCE], nearest[t], kept[t, SELF] = measure(X_WB, ages[t], arm, around, rules)
        kept[t, LIMIT] = _limit_margin(way[t], arm)
