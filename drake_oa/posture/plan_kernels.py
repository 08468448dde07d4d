"""Compiled arithmetic behind `drake_oa.posture.posture_plan`; call its functions instead.

Every kernel takes C-contiguous float64 and int64 arrays, so that numba compiles each of
them once, and caches it on disk.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.robot.arm_kernels import lowest_height, nearest_point, poses, reach, self_distance

STEPS = 8
"""Newton steps onto a pose, at most."""
TOLERANCE = 2e-4
"""Of a pose [m, rad]: the control law takes only what lies in the null space."""
(
    STOP,
    ASKED,
    PADDING,
    SELF_STOP,
    SELF_ASKED,
    LIMIT_STOP,
    LIMIT_ASKED,
    SPEED_SHARE,
    NEAR_WEIGHT,
    SELF_WEIGHT,
    LIMIT_WEIGHT,
    MOTION_WEIGHT,
    FORBIDDEN,
    SLOPE,
    LEAP,
    RESERVE,
    LEAP_OF_ANY,
) = range(17)
"""Where the rules of a plan are."""
N_RULES = 17
DISTANCE, SELF, LIMIT = range(3)
"""Columns of what is measured of a posture."""


@njit(cache=True, error_model="numpy")
def _limit_margin(q: FloatArray, lower: FloatArray, upper: FloatArray) -> float:
    least = np.inf
    for i in range(len(q)):
        least = min(least, q[i] - lower[i], upper[i] - q[i])
    return least


@njit(cache=True, error_model="numpy")
def _take(
    node: int,
    seed: FloatArray,
    values: FloatArray,
    p_WE: FloatArray,
    R_WE: FloatArray,
    fixed: int,
    X_PJ: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    margin: float,
    X_WB: FloatArray,
    q: FloatArray,
    found: BoolArray,
) -> None:
    """Solves one node from a seed into q (N, 7) and found (N,)."""
    q[node] = seed
    q[node, fixed] = values[node]
    found[node] = (
        reach(q[node], p_WE, R_WE, fixed, X_PJ, X_WB, STEPS, TOLERANCE)
        and _limit_margin(q[node], lower, upper) >= margin
    )


@njit(cache=True, error_model="numpy")
def solve_row(
    p_WE: FloatArray,
    R_WE: FloatArray,
    values: FloatArray,
    seeds: FloatArray,
    seeded: BoolArray,
    fixed: int,
    X_PJ: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    margin: float,
    X_WB: FloatArray,
    q: FloatArray,
    found: BoolArray,
) -> None:
    """Postures with the tool at a pose, one for each value of a joint.

    Each begins at its seed, those without one at their neighbour's solution, from the
    seeded ones outward: all stay in the branch of the inverse kinematics that these are in.

    Args:
        p_WE, R_WE, fixed, X_PJ: see `arm_kernels.reach`.
        values: (N,) of the joint, increasing [rad].
        seeds: (N, 7) [rad].
        seeded: (N,) whether there is a seed.
        lower, upper: (7,) joint limits [rad].
        margin: least distance of a posture to them [rad].
        X_WB: (8, 4, 4) to work in.
        q: (N, 7) receives the postures [rad].
        found: (N,) receives which there are.
    """
    N = len(values)
    for j in range(N):
        found[j] = False
    for j in range(N):
        if seeded[j]:
            _take(
                j, seeds[j], values, p_WE, R_WE, fixed, X_PJ, lower, upper, margin, X_WB, q, found
            )
    for j in range(1, N):
        if not found[j] and found[j - 1]:
            _take(
                j, q[j - 1], values, p_WE, R_WE, fixed, X_PJ, lower, upper, margin, X_WB, q, found
            )
    for j in range(N - 2, -1, -1):
        if not found[j] and found[j + 1]:
            _take(
                j, q[j + 1], values, p_WE, R_WE, fixed, X_PJ, lower, upper, margin, X_WB, q, found
            )


@njit(cache=True, error_model="numpy")
def measure(
    X_WB: FloatArray,
    age: float,
    body_sphere: FloatArray,
    shape_body: IntArray,
    X_BG: FloatArray,
    size: FloatArray,
    bound: FloatArray,
    part_body: IntArray,
    part_first: IntArray,
    part_sphere: FloatArray,
    rod: FloatArray,
    rod_radius: FloatArray,
    pairs: IntArray,
    points: FloatArray,
    block_start: IntArray,
    block_owner: IntArray,
    block_sphere: FloatArray,
    v_WO: FloatArray,
    table: FloatArray,
    rules: FloatArray,
) -> tuple[float, int, float]:
    """What a posture keeps; arguments as of `arm_kernels`.

    Returns:
        Distance to obstacles and table [m], the obstacle (-1: none is nearer than the table
        or than what is asked), and the distance of the parts to each other [m].
    """
    far = rules[ASKED] + rules[PADDING]
    distance, _, nearest, _ = nearest_point(
        X_WB, body_sphere, shape_body, X_BG, size, bound,
        points, block_start, block_owner, block_sphere, v_WO, age, -1, far,
    )  # fmt: skip
    distance -= rules[PADDING]
    height = lowest_height(X_WB, shape_body, X_BG, size, table)
    if height < distance:
        distance, nearest = height, -1
    apart = self_distance(
        X_WB, part_body, part_first, part_sphere, rod, rod_radius, pairs, rules[SELF_ASKED]
    )
    return distance, nearest, apart


@njit(cache=True, error_model="numpy")
def _lacking(value: float, stop: float, asked: float) -> float:
    """0 where what is asked is kept, 1 at the stop."""
    return max(0.0, (asked - value) / (asked - stop))


@njit(cache=True, error_model="numpy")
def price(
    q: FloatArray,
    posture: FloatArray,
    mass: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    distance: float,
    apart: float,
    ds: float,
    rules: FloatArray,
) -> float:
    """Cost of being in a posture for ds of normalised time; see `posture_plan`."""
    n = len(q)
    away = 0.0
    for i in range(n):
        for j in range(n):
            away += (q[i] - posture[i]) * mass[i, j] * (q[j] - posture[j])
    near = _lacking(distance, rules[STOP] + rules[RESERVE], rules[ASKED])
    close = _lacking(apart, rules[SELF_STOP], rules[SELF_ASKED])
    margin = _limit_margin(q, lower, upper)
    tight = _lacking(margin, rules[LIMIT_STOP], rules[LIMIT_ASKED])
    cost = away + rules[NEAR_WEIGHT] * near**2 + rules[SELF_WEIGHT] * close**2
    cost += rules[LIMIT_WEIGHT] * tight**2
    cost *= ds
    for lacking in (near, close):
        if lacking > 1.0:
            cost += rules[FORBIDDEN] + rules[SLOPE] * (lacking - 1.0)
    return cost


@njit(cache=True, error_model="numpy")
def edge(
    one: FloatArray, other: FloatArray, ds: float, seconds: float, fixed: int,
    speed: FloatArray, mass: FloatArray, rules: FloatArray,
) -> float:  # fmt: skip
    """Cost of going from one posture to another within ds of normalised time."""
    n = len(one)
    if abs(other[fixed] - one[fixed]) > rules[LEAP]:
        return np.inf
    moved, rate = 0.0, 0.0
    for i in range(n):
        d = other[i] - one[i]
        moved += mass[i, i] * d * d
        rate = max(rate, abs(d) / speed[i])
        if abs(d) > rules[LEAP_OF_ANY]:
            return np.inf
    cost = rules[MOTION_WEIGHT] * moved / ds
    rate /= rules[SPEED_SHARE] * seconds * ds
    if rate > 1.0:
        cost += rules[FORBIDDEN] + rules[SLOPE] * (rate - 1.0)
    return cost


@njit(cache=True, error_model="numpy")
def best_way(
    start: FloatArray, q: FloatArray, found: BoolArray, cost: FloatArray, s: FloatArray,
    seconds: float, window: int, first: int, fixed: int, speed: FloatArray, mass: FloatArray,
    rules: FloatArray, chosen: IntArray,
) -> float:  # fmt: skip
    """Viterbi's algorithm over layers of postures.

    Args:
        start: (n,) the posture at s[0] [rad].
        q: (T, N, n) postures of each layer; the first layer is not used [rad].
        found: (T, N) which there are.
        cost: (T, N) of being there.
        s: (T,) normalised times.
        seconds: duration of a unit of s [s].
        window: columns that one layer's posture may differ from that of the last: nothing is
            known of what is between them.
        first: column of the start.
        fixed: the joint that the columns are of.
        speed: (n,) velocity limits [rad/s].
        mass: (n, n) metric.
        rules: see `STOP`.
        chosen: (T,) receives the column of each layer but the first.

    Returns:
        The cost; inf where no way leads through all layers.
    """
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
                    best, came = edge(start, q[t, j], ds, seconds, fixed, speed, mass, rules), 0
                else:
                    best, came = np.inf, -1
            else:
                best, came = np.inf, -1
                for i in range(max(0, j - window), min(N, j + window + 1)):
                    if total[t - 1, i] < best:
                        to = total[t - 1, i] + edge(
                            q[t - 1, i], q[t, j], ds, seconds, fixed, speed, mass, rules
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


@njit(cache=True, error_model="numpy")
def plan_rows(
    path: FloatArray, R_WE: FloatArray, s: FloatArray, ages: FloatArray, values: FloatArray,
    start: FloatArray, guess: FloatArray, seconds: float, window: int, fixed: int,
    X_PJ: FloatArray, posture: FloatArray, mass: FloatArray, lower: FloatArray, upper: FloatArray,
    speed: FloatArray, body_sphere: FloatArray, shape_body: IntArray, X_BG: FloatArray,
    size: FloatArray, bound: FloatArray, part_body: IntArray, part_first: IntArray,
    part_sphere: FloatArray, rod: FloatArray, rod_radius: FloatArray, pairs: IntArray,
    points: FloatArray, block_start: IntArray, block_owner: IntArray, block_sphere: FloatArray,
    v_WO: FloatArray, table: FloatArray, rules: FloatArray, way: FloatArray,
) -> tuple[float, int]:  # fmt: skip
    """The cheapest way of an arm along a path of its tool through a grid of postures.

    Args:
        path: (T, 3) the tool point [m].
        R_WE: (T, 3, 3) its orientation.
        s: (T,) normalised times, increasing.
        ages: (T,) for how long the obstacles have moved by then [s].
        values: (T, N) of the joint that is given, increasing along the rows [rad].
        start: (n,) where the arm is at the first sample [rad].
        guess: (T, n) postures whose columns are the middle ones; (0, n): there are none, and
            each layer begins at the solutions of the one before it.
        seconds, window: see `best_way`.
        fixed: the joint that is given.
        posture: (T, n) what the null space rests in [rad].
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
            path[t], R_WE[t], values[t], seeds, seeded, fixed, X_PJ, lower, upper,
            rules[LIMIT_STOP], X_WB, q[t], found[t],
        )  # fmt: skip
        if t == 0:
            continue
        for j in range(N):
            if found[t, j]:
                poses(q[t, j], X_PJ, X_WB)
                distance, _, apart = measure(
                    X_WB, ages[t], body_sphere, shape_body, X_BG, size, bound, part_body,
                    part_first, part_sphere, rod, rod_radius, pairs, points, block_start,
                    block_owner, block_sphere, v_WO, table, rules,
                )  # fmt: skip
                measured += 1
                cost[t, j] = price(
                    q[t, j], posture[t], mass, lower, upper, distance, apart, s[t] - s[t - 1], rules
                )
    chosen = np.zeros(T, dtype=np.int64)
    answer = best_way(
        start, q, found, cost, s, seconds, window, first, fixed, speed, mass, rules, chosen
    )
    if math.isfinite(answer):
        way[0] = start
        for t in range(1, T):
            way[t] = q[t, chosen[t]]
    return answer, measured


@njit(cache=True, error_model="numpy")
def measure_way(
    way: FloatArray, ages: FloatArray, X_PJ: FloatArray, lower: FloatArray, upper: FloatArray,
    body_sphere: FloatArray, shape_body: IntArray, X_BG: FloatArray,
    size: FloatArray, bound: FloatArray, part_body: IntArray, part_first: IntArray,
    part_sphere: FloatArray, rod: FloatArray, rod_radius: FloatArray, pairs: IntArray,
    points: FloatArray, block_start: IntArray, block_owner: IntArray, block_sphere: FloatArray,
    v_WO: FloatArray, table: FloatArray, rules: FloatArray, kept: FloatArray, nearest: IntArray,
) -> None:  # fmt: skip
    """What an arm keeps on its way (T, n); arguments as above.

    Args:
        kept: (T, 3) receives distance to obstacles and table, of the parts to each other
            [m] and to a joint limit [rad].
        nearest: (T,) receives the obstacle, see `measure`.
    """
    X_WB = np.empty((way.shape[1] + 1, 4, 4))
    for t in range(len(way)):
        poses(way[t], X_PJ, X_WB)
        kept[t, DISTANCE], nearest[t], kept[t, SELF] = measure(
            X_WB, ages[t], body_sphere, shape_body, X_BG, size, bound, part_body, part_first,
            part_sphere, rod, rod_radius, pairs, points, block_start, block_owner, block_sphere,
            v_WO, table, rules,
        )  # fmt: skip
        kept[t, LIMIT] = _limit_margin(way[t], lower, upper)
