"""How fast a moving robot may go among solids, compiled.

`drake_oa.safety.monitors` and `drake_oa.safety.supervisor` call them. Every kernel takes
C-contiguous arrays of one type (float64 and int64), so that numba compiles each of them once.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.solids import Solids, ball_bound, solid_distance, solid_gradient
from drake_oa.planning.arm_world import (
    placed,
)
from drake_oa.robot.arm import Chain, Spheres, chain_poses


class SolidRules(NamedTuple):
    """What an approach of the G groups of spheres to the K solids keeps.

    Attributes:
        stop: (G, K) distances at which an approach is at rest [m].
        reaction_time: in which a motion is brought to rest, the controller with it [s].
        step, hold: the policy looks every step, and goes from full speed to rest in this [s].
        leave_scale: share of full speed at which what is nearer to what rests may leave.
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


NOTHING = -2
"""The obstacle's row where nothing limits the motion."""
APPROACH = 1e-3
"""Closing speeds at full speed below this are no approach [m/s], nor are joint speeds [rad/s]."""
AT_REST = 1e-3
"""A body no point of which is faster at full speed does not move [m/s]."""


@compiled
def allowed_scale(left: float, closing: float, oncoming: float, rules: SolidRules) -> float:
    """Share of full speed at which a pair can be brought to rest in time.

    While the motion approaches, share * closing + oncoming <= left / reaction; so a resting
    obstacle is approached exponentially and never nearer than the stop distance.

    Args:
        left: distance between the two beyond that at which an approach is at rest [m].
        closing: speed at which the robot's point approaches at full speed [m/s].
        oncoming: speed at which the obstacle approaches [m/s], at least 0.
        rules: what is kept.
    """
    if closing <= APPROACH:
        # What comes nearer by itself is left as fast as can be.
        return 1.0 if left > 0.0 or oncoming > 0.0 else rules.leave_scale
    return min(1.0, max(0.0, (left / rules.reaction_time - oncoming) / closing))


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
                        scale = allowed_scale(d - rules.stop[g, k], closing, oncoming, rules)
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
