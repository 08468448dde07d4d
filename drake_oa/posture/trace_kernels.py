"""Compiled arithmetic behind `drake_oa.posture.posture_plan` for arms that have to swing far.

The nodes of a layer are not values of a joint but places along the null space, equally far
apart in the joints: near the stretched shoulder one joint turns far for little, and further
on it turns back while the elbow goes on. There, too, the curve of the postures that have
the tool at one pose comes apart into several from one layer to the next (J. W. Burdick,
IEEE ICRA 1989, on these self-motion manifolds), so that each layer takes its seeds from all
nodes of the one before it, and follows every curve that one of them is on.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.posture.plan_kernels import (
    STEPS,
    TOLERANCE,
    Rules,
    Surroundings,
    ToolPath,
    edge,
    measure,
    price,
)
from drake_oa.robot.arm_kernels import Arm, jacobian, pose_error, poses, solve_in_place

_LONGEST_STEP = 0.5
"""Of a joint in one Newton step [rad]."""
_SAME = 0.7
"""A posture so near to a node is on its curve, in steps."""
_LEAST = 1e-12


@compiled
def project(
    q: FloatArray,
    p_WE: FloatArray,
    R_WE: FloatArray,
    across: FloatArray,
    X_PJ: FloatArray,
    X_WB: FloatArray,
) -> bool:
    """Newton steps of q (7,) onto a tool pose, none of which goes along `across` (7,).

    Returns:
        Whether the pose is met; X_WB (8, 4, 4) then has the poses of the bodies.
    """
    n = len(q)
    e, J, A = np.empty(n), np.empty((6, n)), np.empty((n, n))
    for number in range(STEPS + 1):
        poses(q, X_PJ, X_WB)
        if pose_error(X_WB[n], p_WE, R_WE, e) <= TOLERANCE:
            return True
        if number == STEPS:
            break
        jacobian(X_WB, J)
        A[:6], A[6], e[6] = J, across, 0.0
        if not solve_in_place(A, e):
            return False
        longest = np.abs(e).max()
        if not math.isfinite(longest):
            return False
        q += min(1.0, _LONGEST_STEP / max(longest, _LEAST)) * e
    return False


@compiled
def null_direction(X_WB: FloatArray, like: FloatArray, direction: FloatArray) -> bool:
    """The unit velocity (7,) of the joints that leaves the tool, on the side of `like` (7,).

    Args:
        X_WB: (8, 4, 4) poses of the bodies.
        like: the direction at a posture nearby.
        direction: receives it.

    Returns:
        Whether there is one, and one only, and it is not across `like`.
    """
    n = len(like)
    J, A = np.empty((6, n)), np.empty((n, n))
    jacobian(X_WB, J)
    A[:6], A[6] = J, like
    direction[:] = 0.0
    direction[6] = 1.0
    if not solve_in_place(A, direction):
        return False
    length = math.sqrt((direction * direction).sum())
    if not math.isfinite(length):
        return False
    direction /= length
    return True


@compiled
def _nearest(q: FloatArray, count: int, one: FloatArray) -> float:
    """Distance of a posture to the first `count` of q (N, 7) [rad]."""
    least = np.inf
    for j in range(count):
        square = 0.0
        for i in range(len(one)):
            square += (q[j, i] - one[i]) ** 2
        least = min(least, square)
    return math.sqrt(least)


@compiled
def trace(
    seed: FloatArray,
    along: FloatArray,
    p_WE: FloatArray,
    R_WE: FloatArray,
    step: float,
    most: int,
    arm: Arm,
    margin: float,
    X_WB: FloatArray,
    q: FloatArray,
    direction: FloatArray,
    count: int,
) -> int:
    """Adds the curve of postures through a seed to a layer, unless it is on one of its curves.

    Args:
        seed: (7,) near the curve [rad].
        along: (7,) about its direction there.
        p_WE, R_WE: pose of the tool.
        step: from one posture to the next, in all joints together [rad].
        most: at most so many to each side.
        arm: which.
        margin: least distance of a posture to the joints' limits [rad].
        X_WB: (8, 4, 4) to work in.
        q: (N, 7) receives the postures after those that there are [rad].
        direction: (N, 7) receives the directions of the curve there.
        count: how many there are.

    Returns:
        How many there are then.
    """
    X_PJ, lower, upper = arm.X_PJ, arm.lower, arm.upper
    middle, tangent, one = seed.copy(), np.empty(len(seed)), np.empty(len(seed))
    if count == len(q) or not project(middle, p_WE, R_WE, along, X_PJ, X_WB):
        return count
    if min((middle - lower).min(), (upper - middle).min()) < margin:
        return count
    if _nearest(q, count, middle) < _SAME * step or not null_direction(X_WB, along, tangent):
        return count
    q[count], direction[count] = middle, tangent
    count += 1
    for sign in (-1, 1):
        going, here = sign * tangent, middle.copy()
        before = count
        for _ in range(most):
            here += step * going
            if count == len(q) or not project(here, p_WE, R_WE, going, X_PJ, X_WB):
                break
            if min((here - lower).min(), (upper - here).min()) < margin:
                break
            # On what is there already: a closed curve has come round.
            known = count - 1 if count > before else before - 1
            if _nearest(q, known, here) < _SAME * step or not null_direction(X_WB, going, one):
                break
            going[:] = one
            q[count], direction[count] = here, sign * going
            count += 1
    return count


@compiled
def _cheapest(
    q: FloatArray,
    total: FloatArray,
    count: int,
    one: FloatArray,
    ds: float,
    seconds: float,
    arm: Arm,
    rules: Rules,
) -> tuple[float, int]:
    """The cheapest cost of coming to a posture from the layer before, and from which node."""
    best, came = np.inf, -1
    for i in range(count):
        if total[i] >= best:
            continue
        far = False
        for k in range(len(one)):
            if abs(q[i, k] - one[k]) > rules.leap_of_any:
                far = True
                break
        if far:
            continue
        cost = total[i] + edge(q[i], one, ds, seconds, 2, arm, rules)
        if cost < best:
            best, came = cost, i
    return best, came


@compiled
def plan_traced(
    path: ToolPath,
    start: FloatArray,
    guess: FloatArray,
    step: float,
    most: int,
    N: int,
    arm: Arm,
    around: Surroundings,
    rules: Rules,
    way: FloatArray,
) -> tuple[float, int]:
    """As `plan_kernels.plan_rows`, with nodes along the null space.

    Args:
        path, start, arm, around, rules: see there.
        guess: (T, 7) postures about which the nodes are; (0, 7): anywhere.
        step, most: see `trace`.
        N: nodes of a layer, at most.
        way: (T, 7) receives the postures [rad].

    Returns:
        The cost, inf where there is no way, and how many postures were measured.
    """
    s, X_PJ = path.s, arm.X_PJ
    T, n = len(s), len(start)
    q, direction = np.zeros((T, N, n)), np.zeros((N, n))
    total, back = np.full((T, N), np.inf), np.zeros((T, N), dtype=np.int64)
    count, known = np.zeros(T, dtype=np.int64), np.zeros((N, n))
    X_WB, along, measured = np.empty((n + 1, 4, 4)), np.zeros(n), 0
    q[0, 0], total[0, 0], count[0], known[0, 2] = start, 0.0, 1, 1.0
    poses(start, X_PJ, X_WB)
    for joint in (2, 0, 6, 4, 1, 3, 5):
        along[:] = 0.0
        along[joint] = 1.0
        if null_direction(X_WB, along, known[0]):
            break
    for t in range(1, T):
        many = 0
        if len(guess) > 0:
            poses(guess[t], X_PJ, X_WB)
            if null_direction(X_WB, known[0].copy(), along):
                known[0] = along
            many = trace(
                guess[t],
                known[0],
                path.p_WE[t],
                path.R_WE[t],
                step,
                most,
                arm,
                rules.limit_stop,
                X_WB,
                q[t],
                direction,
                many,
            )
        else:
            for i in range(count[t - 1]):
                if math.isfinite(total[t - 1, i]):
                    many = trace(
                        q[t - 1, i],
                        known[i],
                        path.p_WE[t],
                        path.R_WE[t],
                        step,
                        most,
                        arm,
                        rules.limit_stop,
                        X_WB,
                        q[t],
                        direction,
                        many,
                    )
            known[:many] = direction[:many]
        count[t] = many
        ds = s[t] - s[t - 1]
        for j in range(many):
            best, back[t, j] = _cheapest(
                q[t - 1], total[t - 1], count[t - 1], q[t, j], ds, path.seconds, arm, rules
            )
            if not math.isfinite(best):
                continue
            poses(q[t, j], X_PJ, X_WB)
            distance, _, apart = measure(X_WB, path.ages[t], arm, around, rules)
            measured += 1
            total[t, j] = best + price(q[t, j], path.rest[t], arm, distance, apart, ds, rules)
    last = total[T - 1].argmin()
    answer = total[T - 1, last]
    if math.isfinite(answer):
        for t in range(T - 1, 0, -1):
            way[t] = q[t, last]
            last = back[t, last]
        way[0] = start
    return answer, measured
