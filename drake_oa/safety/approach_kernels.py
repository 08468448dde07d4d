"""How fast a moving robot may go among points, compiled.

`drake_oa.safety.monitors` and `drake_oa.safety.supervisor` call them. Every kernel takes
C-contiguous arrays of one type (float64 and int64), so that numba compiles each of them once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.geometry.points import GuardShapes, PointBlocks
from drake_oa.geometry.primitives import deepest_point, point_distance, posed, to_frame
from drake_oa.geometry.solids import Solids, ball_bound, solid_distance, solid_gradient
from drake_oa.planning.arm_world import Chain, chain_poses, placed
from drake_oa.robot.sphere_kernels import Spheres


class BrakingRules(NamedTuple):
    """What an approach keeps.

    Attributes:
        stop_distance: at which an approach is at rest [m].
        padding: how far an obstacle's surface may lie outside its points [m].
        reaction_time: in which the motion is brought to rest [s].
        leave_scale: share of full speed at which a body that is nearer to what rests may leave.
    """

    stop_distance: float
    padding: float
    reaction_time: float
    leave_scale: float


class SolidRules(NamedTuple):
    """What an approach of the G groups of spheres to the K solids keeps.

    Attributes:
        stop: (G, K) distances at which an approach is at rest [m].
        reaction_time: in which a motion is brought to rest, the controller with it [s].
        step, hold: the policy looks every step, and goes from full speed to rest in this [s].
        leave_scale: see `BrakingRules`.
        verified: whether the motion is known to keep more than `stop` of what rests.
        passing: whether what moves is left to who has looked ahead.
    """

    stop: FloatArray
    reaction_time: float
    step: float
    hold: float
    leave_scale: float
    verified: bool
    passing: bool


TABLE = -1
"""The obstacle's row that stands for the table."""
NOTHING = -2
"""The obstacle's row where nothing limits the motion."""
APPROACH = 1e-3
"""Closing speeds at full speed below this are no approach [m/s], nor are joint speeds [rad/s]."""
AT_REST = 1e-3
"""A body no point of which is faster at full speed does not move [m/s]."""


@compiled
def allowed_scale(distance: float, closing: float, oncoming: float, rules: BrakingRules) -> float:
    """Share of full speed at which a pair can be brought to rest in time.

    While the motion approaches, share * closing + oncoming <= (distance - stop) / reaction;
    so a resting obstacle is approached exponentially and never nearer than the stop distance.

    Args:
        distance: between the two [m].
        closing: speed at which the robot's point approaches at full speed [m/s].
        oncoming: speed at which the obstacle approaches [m/s], at least 0.
        rules: what is kept.
    """
    left = distance - rules.stop_distance
    if closing <= APPROACH:
        # What comes nearer by itself is left as fast as can be.
        return 1.0 if left > 0.0 or oncoming > 0.0 else rules.leave_scale
    return min(1.0, max(0.0, (left / rules.reaction_time - oncoming) / closing))


@compiled
def speed_along(
    X_WB: FloatArray,
    V_WB: FloatArray,
    x: float,
    y: float,
    z: float,
    nx: float,
    ny: float,
    nz: float,
) -> float:
    """Speed along n of a body's point at (x, y, z) in the world [m/s]."""
    x, y, z = x - X_WB[0, 3], y - X_WB[1, 3], z - X_WB[2, 3]
    return (
        nx * (V_WB[3] + V_WB[1] * z - V_WB[2] * y)
        + ny * (V_WB[4] + V_WB[2] * x - V_WB[0] * z)
        + nz * (V_WB[5] + V_WB[0] * y - V_WB[1] * x)
    )


@compiled
def largest_speed(
    X_WB: FloatArray, V_WB: FloatArray, x: float, y: float, z: float, radius: float
) -> float:
    """A bound on the speed of a body's points within a radius of (x, y, z) [m/s]."""
    vx = speed_along(X_WB, V_WB, x, y, z, 1.0, 0.0, 0.0)
    vy = speed_along(X_WB, V_WB, x, y, z, 0.0, 1.0, 0.0)
    vz = speed_along(X_WB, V_WB, x, y, z, 0.0, 0.0, 1.0)
    turning = math.sqrt(V_WB[0] ** 2 + V_WB[1] ** 2 + V_WB[2] ** 2)
    return math.sqrt(vx * vx + vy * vy + vz * vz) + radius * turning


@compiled
def approach_limit(
    X_WB: FloatArray,
    V_WB: FloatArray,
    shapes: GuardShapes,
    blocks: PointBlocks,
    age: float,
    table: FloatArray,
    rules: BrakingRules,
) -> tuple[float, int, int, float, float]:
    """The tightest of `allowed_scale` of any point of the robot and of the obstacles.

    Args:
        X_WB: (B, 4, 4) poses of the bodies.
        V_WB: (B, 6) their angular and linear velocities at full speed [rad/s, m/s].
        shapes: their primitives.
        blocks: points on the obstacles, and the obstacles' velocities.
        age: for how long they have moved so since the points were seen [s].
        table: (4,) unit normal and offset of the plane [m]; NaN: there is none.
        rules: what is kept.

    Returns:
        Share of full speed, the row of the body and that of the obstacle that limit it
        (`TABLE`, or `NOTHING`), their distance [m], and the obstacle's own share of the
        closing speed [m/s].
    """
    body_sphere, shape_body, X_BG, size, bound = shapes
    points, block_start, block_owner, block_sphere, v_WO = blocks
    best, best_body, best_obstacle, best_distance, best_oncoming = 1.0, -1, NOTHING, np.inf, 0.0
    clear = rules.stop_distance + rules.padding
    X_WG, V_G = np.empty((3, 4)), np.empty(6)
    near = np.empty(len(block_owner), dtype=np.int64)
    has_table = not math.isnan(table[3])
    first = 0
    for body in range(len(X_WB)):
        last = first
        while last < len(shape_body) and shape_body[last] == body:
            last += 1
        begin, first = first, last
        X, V = X_WB[body], V_WB[body]
        bx, by, bz, radius = body_sphere[body]
        cx = X[0, 0] * bx + X[0, 1] * by + X[0, 2] * bz + X[0, 3]
        cy = X[1, 0] * bx + X[1, 1] * by + X[1, 2] * bz + X[1, 3]
        cz = X[2, 0] * bx + X[2, 1] * by + X[2, 2] * bz + X[2, 3]
        fastest = largest_speed(X, V, cx, cy, cz, radius)
        if fastest <= AT_REST:
            continue
        candidates = 0
        for block in range(len(block_owner)):
            owner = block_owner[block]
            ux, uy, uz = v_WO[owner, 0], v_WO[owner, 1], v_WO[owner, 2]
            speed = math.sqrt(ux * ux + uy * uy + uz * uz)
            dx = block_sphere[block, 0] + ux * age - cx
            dy = block_sphere[block, 1] + uy * age - cy
            dz = block_sphere[block, 2] + uz * age - cz
            # Nothing farther away than this can be tighter than the best yet.
            reach = clear + rules.reaction_time * (best * fastest + speed)
            most = radius + block_sphere[block, 3] + reach
            if dx * dx + dy * dy + dz * dz <= most * most:
                near[candidates] = block
                candidates += 1
        for shape in range(begin, last):
            posed(X, X_BG[shape], X_WG)
            gx, gy, gz = X_WG[0, 3], X_WG[1, 3], X_WG[2, 3]
            fastest = largest_speed(X, V, gx, gy, gz, bound[shape])
            if has_table:
                px, py, pz = deepest_point(X_WG, size[shape], table[0], table[1], table[2])
                distance = px * table[0] + py * table[1] + pz * table[2] - table[3]
                closing = -speed_along(X, V, px, py, pz, table[0], table[1], table[2])
                scale = allowed_scale(distance, closing, 0.0, rules)
                if scale < best:
                    best, best_body, best_obstacle = scale, body, TABLE
                    best_distance, best_oncoming = distance, 0.0
            # The body's motion about the primitive's origin, and all else, in its frame.
            V_G[:3] = to_frame(X_WG, V[0], V[1], V[2])
            V_G[3] = speed_along(X, V, gx, gy, gz, X_WG[0, 0], X_WG[1, 0], X_WG[2, 0])
            V_G[4] = speed_along(X, V, gx, gy, gz, X_WG[0, 1], X_WG[1, 1], X_WG[2, 1])
            V_G[5] = speed_along(X, V, gx, gy, gz, X_WG[0, 2], X_WG[1, 2], X_WG[2, 2])
            for candidate in range(candidates):
                block = near[candidate]
                owner = block_owner[block]
                ux, uy, uz = v_WO[owner, 0], v_WO[owner, 1], v_WO[owner, 2]
                speed = math.sqrt(ux * ux + uy * uy + uz * uz)
                reach = clear + rules.reaction_time * (best * fastest + speed)
                ox, oy, oz = gx - ux * age, gy - uy * age, gz - uz * age
                dx = block_sphere[block, 0] - ox
                dy = block_sphere[block, 1] - oy
                dz = block_sphere[block, 2] - oz
                most = bound[shape] + block_sphere[block, 3] + reach
                if dx * dx + dy * dy + dz * dz > most * most:
                    continue
                x, y, z = to_frame(X_WG, dx, dy, dz)
                distance, nx, ny, nz = point_distance(x, y, z, size[shape])
                if distance > block_sphere[block, 3] + reach:
                    continue
                ux, uy, uz = to_frame(X_WG, ux, uy, uz)
                for row in range(block_start[block], block_start[block + 1]):
                    dx, dy, dz = points[row, 0] - ox, points[row, 1] - oy, points[row, 2] - oz
                    x, y, z = to_frame(X_WG, dx, dy, dz)
                    distance, nx, ny, nz = point_distance(x, y, z, size[shape])
                    if distance > reach:
                        continue
                    x, y, z = x - distance * nx, y - distance * ny, z - distance * nz
                    closing = (
                        nx * (V_G[3] + V_G[1] * z - V_G[2] * y)
                        + ny * (V_G[4] + V_G[2] * x - V_G[0] * z)
                        + nz * (V_G[5] + V_G[0] * y - V_G[1] * x)
                    )
                    oncoming = max(0.0, -(nx * ux + ny * uy + nz * uz))
                    distance -= rules.padding
                    scale = allowed_scale(distance, closing, oncoming, rules)
                    if scale < best:
                        best, best_body, best_obstacle = scale, body, owner
                        best_distance, best_oncoming = distance, oncoming
    return best, best_body, best_obstacle, best_distance, best_oncoming


@compiled
def braking_scale(left: float, closing: float, rules: SolidRules) -> float:
    """Share of full speed from which the policy's hold ends within what is left [m].

    At a share x a step goes by and the speed falls to zero at the policy's own rate, full speed in
    `hold`: closing * (x step + x^2 hold / 2) <= left.
    """
    if closing <= APPROACH:
        return 1.0 if left > 0.0 else rules.leave_scale
    if left <= 0.0:
        return 0.0
    share = math.sqrt(rules.step**2 + 2.0 * rules.hold * left / closing) - rules.step
    return min(1.0, share / rules.hold)


@compiled
def solid_limit(
    chain: Chain,
    spheres: Spheres,
    solids: Solids,
    q: FloatArray,
    v: FloatArray,
    t: float,
    rules: SolidRules,
) -> tuple[float, int, int, float, float]:
    """The tightest share of full speed for any sphere of the robot and any solid.

    What rests is approached by `braking_scale` where the motion is verified; all else by
    `allowed_scale`.

    Args:
        chain, spheres: the arm.
        solids: what it is among.
        q: (n,) its joints [rad].
        v: (n,) their velocities at full speed [rad/s].
        t: when [s].
        rules: what is kept.

    Returns:
        Share of full speed, the group and the solid that limit it (`NOTHING`: none), their
        distance [m], and the solid's own share of the closing speed [m/s].
    """
    n = len(q)
    X = np.empty((n + 2, 12))
    chain_poses(q, chain.X_PJ, X)
    # The twist of each joint's frame about the world's origin: v(p) = twist[3:] + twist[:3] x p.
    twist = np.zeros((n + 1, 6))
    for j in range(1, n + 1):
        wx, wy, wz = v[j - 1] * X[j, 2], v[j - 1] * X[j, 5], v[j - 1] * X[j, 8]
        x, y, z = X[j, 9], X[j, 10], X[j, 11]
        twist[j] = twist[j - 1]
        twist[j, 0] += wx
        twist[j, 1] += wy
        twist[j, 2] += wz
        twist[j, 3] += y * wz - z * wy
        twist[j, 4] += z * wx - x * wz
        twist[j, 5] += x * wy - y * wx
    best, best_group, best_solid, best_distance, best_oncoming = 1.0, -1, NOTHING, np.inf, 0.0
    for g in range(len(spheres.group_joint)):
        frame = spheres.group_joint[g] + 1
        if frame == 0:
            continue
        x, y, z = placed(X, frame, spheres.bound, g)
        a, b, c, e, f, h = twist[frame]
        vx, vy, vz = e + b * z - c * y, f + c * x - a * z, h + a * y - b * x
        fastest = math.sqrt(vx * vx + vy * vy + vz * vz)
        fastest += spheres.bound[g, 3] * math.sqrt(a * a + b * b + c * c)
        if fastest <= AT_REST:
            continue
        for k in range(len(solids.ball)):
            ux, uy, uz = solids.ball[k, 4], solids.ball[k, 5], solids.ball[k, 6]
            speed = math.sqrt(ux * ux + uy * uy + uz * uz)
            if speed > 0.0 and rules.passing:
                continue
            # Nothing farther away than this limits the motion.
            reach = max(rules.stop[g, k], 0.0) + rules.reaction_time * (fastest + speed)
            far = reach + spheres.bound[g, 3]
            if ball_bound(solids, k, x, y, z, t) > far:
                continue
            if solid_distance(solids, k, x, y, z, t) > far:
                continue
            for m in range(spheres.cluster[g], spheres.cluster[g + 1]):
                px, py, pz = placed(X, frame, spheres.cluster_bound, m)
                if solid_distance(solids, k, px, py, pz, t) > reach + spheres.cluster_bound[m, 3]:
                    continue
                for i in range(spheres.cluster_first[m], spheres.cluster_first[m + 1]):
                    px, py, pz = placed(X, frame, spheres.p_JS, i)
                    d, nx, ny, nz = solid_gradient(solids, k, px, py, pz, t)
                    d -= spheres.radius[i]
                    if d > reach:
                        continue
                    size = math.sqrt(nx * nx + ny * ny + nz * nz)
                    if size > 0.0:
                        nx, ny, nz = nx / size, ny / size, nz / size
                    vx, vy, vz = e + b * pz - c * py, f + c * px - a * pz, h + a * py - b * px
                    closing = -(nx * vx + ny * vy + nz * vz)
                    oncoming = max(0.0, nx * ux + ny * uy + nz * uz)
                    if speed == 0.0 and rules.verified:
                        scale = braking_scale(d - rules.stop[g, k], closing, rules)
                    else:
                        of_pair = BrakingRules(
                            rules.stop[g, k], 0.0, rules.reaction_time, rules.leave_scale
                        )
                        scale = allowed_scale(d, closing, oncoming, of_pair)
                    if scale < best:
                        best, best_group, best_solid = scale, g, k
                        best_distance, best_oncoming = d, oncoming
    return best, best_group, best_solid, best_distance, best_oncoming


@compiled
def kept_along(
    chain: Chain, spheres: Spheres, solids: Solids, q: FloatArray, t: float, most: float
) -> FloatArray:
    """(G, K) what the groups keep of the solids along configurations (T, n), up to `most` [m]."""
    found = np.full((len(spheres.group_joint), len(solids.ball)), most)
    X = np.empty((q.shape[1] + 2, 12))
    for row in range(len(q)):
        chain_poses(q[row], chain.X_PJ, X)
        for g in range(len(spheres.group_joint)):
            frame = spheres.group_joint[g] + 1
            x, y, z = placed(X, frame, spheres.bound, g)
            for k in range(len(solids.ball)):
                far = found[g, k] + spheres.bound[g, 3]
                if ball_bound(solids, k, x, y, z, t) >= far:
                    continue
                if solid_distance(solids, k, x, y, z, t) >= far:
                    continue
                for m in range(spheres.cluster[g], spheres.cluster[g + 1]):
                    u, v, w = placed(X, frame, spheres.cluster_bound, m)
                    near = solid_distance(solids, k, u, v, w, t) - spheres.cluster_bound[m, 3]
                    if near >= found[g, k]:
                        continue
                    for i in range(spheres.cluster_first[m], spheres.cluster_first[m + 1]):
                        u, v, w = placed(X, frame, spheres.p_JS, i)
                        d = solid_distance(solids, k, u, v, w, t) - spheres.radius[i]
                        found[g, k] = min(found[g, k], d)
    return found


@compiled
def planned_rate(s: FloatArray, motion: FloatArray, q: FloatArray) -> FloatArray:
    """(n,) dq/ds of a motion (T, n) at times (T,), T > 1, where it is nearest to q [rad]."""
    least, at = np.inf, 0
    for row in range(len(s) - 1):
        along, square = 0.0, 0.0
        for i in range(len(q)):
            step = motion[row + 1, i] - motion[row, i]
            along += step * (q[i] - motion[row, i])
            square += step * step
        share = min(max(along / square, 0.0), 1.0) if square > 0.0 else 0.0
        apart = 0.0
        for i in range(len(q)):
            there = motion[row, i] + share * (motion[row + 1, i] - motion[row, i])
            apart += (q[i] - there) ** 2
        if apart < least:
            least, at = apart, row
    return (motion[at + 1] - motion[at]) / (s[at + 1] - s[at])


@compiled
def full_speed_motion(
    J: FloatArray,
    v: FloatArray,
    v_WE: FloatArray,
    p_WE: FloatArray,
    X_WB: FloatArray,
    moved: BoolArray,
    damping: float,
) -> tuple[FloatArray, FloatArray]:
    """Velocities of joints and bodies if the policy ran at full speed.

    The tool point moves as the policy wants, without turning; in the null space of the tool
    the arm moves as it does.

    Args:
        J: (6, n) Jacobian of the tool's angular and linear velocity in the world.
        v: (n,) joint velocities [rad/s].
        v_WE: (3,) velocity of the tool point at full speed, in the world [m/s].
        p_WE: (3,) the tool point [m].
        X_WB: (B, 4, 4) poses of the bodies.
        moved: (B, n) whether a joint moves a body.
        damping: of the least-squares solution, against singular postures [m^2].

    Returns:
        (n,) joint velocities [rad/s]; (B, 6) angular and linear velocities of the bodies in
        the world [rad/s, m/s].
    """
    n = len(v)
    lacking = np.zeros(6)
    square = np.zeros((6, 6))
    for i in range(6):
        lacking[i] = v_WE[i - 3] if i >= 3 else 0.0
        for k in range(n):
            lacking[i] -= J[i, k] * v[k]
        for j in range(6):
            for k in range(n):
                square[i, j] += J[i, k] * J[j, k]
        square[i, i] += damping
    share = np.linalg.solve(square, lacking)
    joint = v.copy()
    for k in range(n):
        for i in range(6):
            joint[k] += J[i, k] * share[i]
    V_WB = np.zeros((len(X_WB), 6))
    for body in range(len(X_WB)):
        x = X_WB[body, 0, 3] - p_WE[0]
        y = X_WB[body, 1, 3] - p_WE[1]
        z = X_WB[body, 2, 3] - p_WE[2]
        V = V_WB[body]
        for k in range(n):
            if moved[body, k]:
                wx, wy, wz = J[0, k], J[1, k], J[2, k]
                V[0] += joint[k] * wx
                V[1] += joint[k] * wy
                V[2] += joint[k] * wz
                V[3] += joint[k] * (J[3, k] + wy * z - wz * y)
                V[4] += joint[k] * (J[4, k] + wz * x - wx * z)
                V[5] += joint[k] * (J[5, k] + wx * y - wy * x)
    return joint, V_WB
