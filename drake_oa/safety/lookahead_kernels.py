"""How near an arm and moving obstacles will come to each other, compiled.

`drake_oa.safety.evasion` calls them. The arm is known by its joints' screws and its bodies' poses
now; where it is with other joint positions follows from them by the product of exponentials
(Murray, Li and Sastry, A Mathematical Introduction to Robotic Manipulation, section 3.2),

    X_WB(q + dq) = exp(S_1 dq_1) ... exp(S_k dq_k) X_WB(q),

for a body that the joints 1 to k move. Every kernel takes C-contiguous arrays of one type
(float64 and int64), so that numba compiles each of them once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.points import PointBlocks
from drake_oa.geometry.primitives import deepest_point, point_distance, posed, to_frame
from drake_oa.geometry.rotation import rotation_vector


class Arm(NamedTuple):
    """An arm of n joints as it is posed now.

    Attributes:
        screws: (n, 6) of the joints in the world, from the base on, w first.
        p_WE: (3,) the tool point [m].
        q, lower, upper: (n,) positions of the joints and their limits [rad, m].
        speed: (n,) their greatest speeds [rad/s, m/s].
        free: (n, m) orthonormal velocities of the joints that do not move the tool.
        joint: (S,) how many of the joints move each primitive, at least one.
        X_WG: (S, 4, 4) the primitives' poses.
        size, bound: their sizes, see `drake_oa.geometry.points.GuardShapes`.
    """

    screws: FloatArray
    p_WE: FloatArray
    q: FloatArray
    lower: FloatArray
    upper: FloatArray
    speed: FloatArray
    free: FloatArray
    joint: IntArray
    X_WG: FloatArray
    size: FloatArray
    bound: FloatArray


class Obstacles(NamedTuple):
    """What is looked at: points, time since they were seen [s], table (4,), NaN: none [m]."""

    blocks: PointBlocks
    age: float
    table: FloatArray


class LookaheadRules(NamedTuple):
    """How ways are looked at.

    Attributes:
        damping: of the joints' least squares [m^2].
        miss: how far the tool may be from where it is wanted [m].
        growth: how much less of a distance to a moving obstacle counts a second ahead [m/s].
        table_allowance: how much more of one to the table counts [m].
        most: the distance beyond which all is the same [m].
    """

    damping: float
    miss: float
    growth: float
    table_allowance: float
    most: float


NOTHING = -2
"""The obstacle's row where nothing is nearer than `LookaheadRules.most`; -1 is the table."""
_NEWTON = 2
"""Newton steps from one instant to the next."""


@compiled
def screw_motion(screw: FloatArray, angle: float, T: FloatArray) -> None:
    """T (3, 4) becomes T exp(S angle), the screw S (6,) being w and v of the origin.

    A joint turns with |w| = 1, or slides with w = 0.
    """
    wx, wy, wz = screw[0], screw[1], screw[2]
    E = np.zeros((3, 4))
    if wx * wx + wy * wy + wz * wz < 0.25:
        for i in range(3):
            E[i, i], E[i, 3] = 1.0, screw[3 + i] * angle
    else:
        c, s = math.cos(angle), math.sin(angle)
        u = 1.0 - c
        E[0, 0], E[0, 1], E[0, 2] = c + wx * wx * u, wx * wy * u - wz * s, wx * wz * u + wy * s
        E[1, 0], E[1, 1], E[1, 2] = wx * wy * u + wz * s, c + wy * wy * u, wy * wz * u - wx * s
        E[2, 0], E[2, 1], E[2, 2] = wx * wz * u - wy * s, wy * wz * u + wx * s, c + wz * wz * u
        # A point of the axis is w x v; it stays where it is.
        px = wy * screw[5] - wz * screw[4]
        py = wz * screw[3] - wx * screw[5]
        pz = wx * screw[4] - wy * screw[3]
        for i in range(3):
            E[i, 3] = -(E[i, 0] * px + E[i, 1] * py + E[i, 2] * pz)
        E[0, 3] += px
        E[1, 3] += py
        E[2, 3] += pz
    for i in range(3):
        a, b, d = T[i, 0], T[i, 1], T[i, 2]
        for j in range(4):
            T[i, j] = a * E[0, j] + b * E[1, j] + d * E[2, j] + (T[i, 3] if j == 3 else 0.0)


@compiled
def arm_at(screws: FloatArray, dq: FloatArray, T: FloatArray, moved: FloatArray) -> None:
    """How the arm has moved when its joints have.

    Args:
        screws: (n, 6) of the joints in the world, from the base on, w first.
        dq: (n,) how far the joints have moved [rad, m].
        T: (n + 1, 3, 4) receives the displacement of what the first k joints move.
        moved: (n, 6) receives the screws where the joints are then.
    """
    n = len(dq)
    for i in range(3):
        for j in range(4):
            T[0, i, j] = 1.0 if i == j else 0.0
    for k in range(n):
        R, S = T[k], screws[k]
        w, v = moved[k, :3], moved[k, 3:]
        for i in range(3):
            w[i] = R[i, 0] * S[0] + R[i, 1] * S[1] + R[i, 2] * S[2]
            v[i] = R[i, 0] * S[3] + R[i, 1] * S[4] + R[i, 2] * S[5]
        v[0] += R[1, 3] * w[2] - R[2, 3] * w[1]
        v[1] += R[2, 3] * w[0] - R[0, 3] * w[2]
        v[2] += R[0, 3] * w[1] - R[1, 3] * w[0]
        T[k + 1] = T[k]
        screw_motion(S, dq[k], T[k + 1])


@compiled
def step_to(
    screws: FloatArray,
    p_WE: FloatArray,
    target: FloatArray,
    damping: float,
    turn: FloatArray,
    dq: FloatArray,
    T: FloatArray,
    moved: FloatArray,
) -> None:
    """A damped Newton step of dq that brings the tool to a point, turned as it is at dq = 0.

    Of turn (n,) what does not move the tool comes on top.
    """
    n = len(dq)
    arm_at(screws, dq, T, moved)
    R = T[n]
    e = np.empty(6)
    p = np.empty(3)
    back = np.empty((3, 3))
    for i in range(3):
        p[i] = R[i, 0] * p_WE[0] + R[i, 1] * p_WE[1] + R[i, 2] * p_WE[2] + R[i, 3]
        e[3 + i] = target[i] - p[i]
        for j in range(3):
            back[i, j] = R[j, i]
    e[:3] = rotation_vector(back)
    J = np.empty((6, n))
    for k in range(n):
        w, v = moved[k, :3], moved[k, 3:]
        J[0, k], J[1, k], J[2, k] = w[0], w[1], w[2]
        J[3, k] = v[0] + w[1] * p[2] - w[2] * p[1]
        J[4, k] = v[1] + w[2] * p[0] - w[0] * p[2]
        J[5, k] = v[2] + w[0] * p[1] - w[1] * p[0]
        dq[k] += turn[k]
        for i in range(6):
            e[i] -= J[i, k] * turn[k]
    A = np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            for k in range(n):
                A[i, j] += J[i, k] * J[j, k]
        A[i, i] += damping
    share = np.linalg.solve(A, e)
    for k in range(n):
        for i in range(6):
            dq[k] += J[i, k] * share[i]


@compiled
def _nearest(
    T: FloatArray,
    arm: Arm,
    obstacles: Obstacles,
    ahead: float,
    rules: LookaheadRules,
    limit: float,
) -> tuple[float, int]:
    """What of `clearance_ahead` counts at one instant, below a limit."""
    joint, X_WG, size, bound = arm.joint, arm.X_WG, arm.size, arm.bound
    points, block_start, block_owner, block_sphere, v_WO = obstacles.blocks
    age, table = obstacles.age, obstacles.table
    least, nearest = limit, NOTHING
    X = np.empty((3, 4))
    for shape in range(len(joint)):
        posed(T[joint[shape]], X_WG[shape], X)
        if not math.isnan(table[3]):
            x, y, z = deepest_point(X, size[shape], table[0], table[1], table[2])
            d = x * table[0] + y * table[1] + z * table[2] - table[3] + rules.table_allowance
            if d < least:
                least, nearest = d, -1
        for block in range(len(block_owner)):
            owner = block_owner[block]
            ux, uy, uz = v_WO[owner, 0], v_WO[owner, 1], v_WO[owner, 2]
            moves = ux != 0.0 or uy != 0.0 or uz != 0.0
            less = rules.growth * ahead if moves else 0.0
            time = age + ahead
            ox, oy, oz = X[0, 3] - ux * time, X[1, 3] - uy * time, X[2, 3] - uz * time
            x, y, z = block_sphere[block, 0] - ox, block_sphere[block, 1] - oy, 0.0
            z = block_sphere[block, 2] - oz
            most = bound[shape] + block_sphere[block, 3] + least + less
            if most <= 0.0 or x * x + y * y + z * z > most * most:
                continue
            for row in range(block_start[block], block_start[block + 1]):
                x, y, z = points[row, 0] - ox, points[row, 1] - oy, points[row, 2] - oz
                x, y, z = to_frame(X, x, y, z)
                d = point_distance(x, y, z, size[shape])[0]
                if d - less < least:
                    least, nearest = d - less, owner
    return least, nearest


@compiled
def clearance_ahead(
    shifts: FloatArray,
    turns: FloatArray,
    times: FloatArray,
    arm: Arm,
    obstacles: Obstacles,
    rules: LookaheadRules,
    plenty: float,
    behind: float,
    out: FloatArray,
) -> None:
    """The least distance of the arm and its surroundings on each of some ways of its tool.

    Args:
        shifts: (C, K, 3) how far each way has led the tool at each time, in the world [m].
        turns: (C, K, n) how far the joints have turned besides, of which what does not move
            the tool counts [rad, m].
        times: (K,) increasing [s].
        arm: as it is posed.
        obstacles: what it must not come near to.
        rules: how ways are looked at.
        plenty: a greater distance is no better [m].
        behind: a way that comes nearer than the best one by more than this is looked at no
            further, and is none [m]; inf: each is looked at to its end.
        out: (C, 5) receives the distance [m], at most `LookaheadRules.most`; when it is that [s];
            the obstacle's row, see `NOTHING`; whether the arm can go that way (1 or 0); and how
            many instants were looked at.
    """
    screws, p_WE, q = arm.screws, arm.p_WE, arm.q
    lower, upper, speed = arm.lower, arm.upper, arm.speed
    n, K = len(q), len(times)
    T, moved = np.empty((n + 1, 3, 4)), np.empty((n, 6))
    dq, before, target = np.empty(n), np.empty(n), np.empty(3)
    turn, no_turn = np.empty(n), np.zeros(n)
    best = -np.inf
    for way in range(len(shifts)):
        least, when, row, able = rules.most, 0.0, NOTHING, True
        dq[:] = 0.0
        past, seen = 0.0, 0
        for k in range(K):
            seen += 1
            before[:] = dq
            for i in range(3):
                target[i] = p_WE[i] + shifts[way, k, i]
            for i in range(n):
                turn[i] = turns[way, k, i] - (turns[way, k - 1, i] if k > 0 else 0.0)
            for step in range(_NEWTON):
                first = turn if step == 0 else no_turn
                step_to(screws, p_WE, target, rules.damping, first, dq, T, moved)
            arm_at(screws, dq, T, moved)
            miss = 0.0
            for i in range(3):
                p = T[n, i, 0] * p_WE[0] + T[n, i, 1] * p_WE[1] + T[n, i, 2] * p_WE[2]
                miss += (p + T[n, i, 3] - target[i]) ** 2
            able = able and miss <= rules.miss**2
            for i in range(n):
                at = q[i] + dq[i]
                outside = max(lower[i] - at, at - upper[i])
                already = max(lower[i] - q[i], q[i] - upper[i])
                fast = abs(dq[i] - before[i]) > speed[i] * (times[k] - past)
                if fast or outside > max(already, 0.0) + 1e-9:
                    able = False
            past = times[k]
            d, nearest = _nearest(T, arm, obstacles, times[k], rules, least)
            if d < least:
                least, when, row = d, times[k], nearest
            if least < best - behind:
                able = False
                break
        if able:
            best = max(best, min(least, plenty))
        out[way, 0], out[way, 1], out[way, 2] = least, when, row
        out[way, 3], out[way, 4] = 1.0 if able else 0.0, seen
