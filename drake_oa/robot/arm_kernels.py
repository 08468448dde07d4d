"""Where the bodies of an arm are and what they come near to, compiled.

`drake_oa.posture.posture_plan` calls them. Every kernel takes C-contiguous float64 and int64
arrays, so that numba compiles each of them once, and caches it on disk.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.points import GuardShapes, PointBlocks
from drake_oa.geometry.primitives import deepest_point, point_distance, posed, to_frame
from drake_oa.geometry.rotation import rotation_vector

_LONGEST_STEP = 0.5
"""By how much a Newton step changes a joint at most [rad]."""
_TINY = 1e-12


class Parts(NamedTuple):
    """What of an arm may touch each other: G parts, each of some capsules.

    Attributes:
        body: (G,) the body that each part is fixed to; -1: the world.
        first: (G + 1,) where its capsules begin, and C.
        sphere: (G, 4) centre, in the body's frame, and radius of a sphere that holds them [m].
        rod: (C, 6) ends of each capsule's segment in the body's frame [m].
        radius: (C,) [m].
        pairs: (P, 2) the parts that may touch.
    """

    body: IntArray
    first: IntArray
    sphere: FloatArray
    rod: FloatArray
    radius: FloatArray
    pairs: IntArray


class Arm(NamedTuple):
    """An arm of n revolute joints, see `drake_oa.robot.arm.ArmModel`."""

    X_PJ: FloatArray
    mass: FloatArray
    lower: FloatArray
    upper: FloatArray
    speed: FloatArray
    shapes: GuardShapes
    parts: Parts


@compiled
def poses(q: FloatArray, X_PJ: FloatArray, X_WB: FloatArray) -> None:
    """Forward kinematics of n revolute joints in a row, each about its z axis.

    Args:
        q: (n,) positions [rad].
        X_PJ: (n + 1, 4, 4) frame of each joint in the body before it, and of the tool in
            the last body.
        X_WB: (n + 1, 4, 4) receives the bodies' poses, and the tool's.
    """
    n = len(q)
    X = np.eye(4)
    for i in range(n + 1):
        c, s = (math.cos(q[i]), math.sin(q[i])) if i < n else (1.0, 0.0)
        Y = X_PJ[i]
        for row in range(3):
            a = X[row, 0] * Y[0, 0] + X[row, 1] * Y[1, 0] + X[row, 2] * Y[2, 0]
            b = X[row, 0] * Y[0, 1] + X[row, 1] * Y[1, 1] + X[row, 2] * Y[2, 1]
            X_WB[i, row, 0], X_WB[i, row, 1] = c * a + s * b, c * b - s * a
            X_WB[i, row, 2] = X[row, 0] * Y[0, 2] + X[row, 1] * Y[1, 2] + X[row, 2] * Y[2, 2]
            X_WB[i, row, 3] = (
                X[row, 0] * Y[0, 3] + X[row, 1] * Y[1, 3] + X[row, 2] * Y[2, 3] + X[row, 3]
            )
            X_WB[i, 3, row] = 0.0
        X_WB[i, 3, 3] = 1.0
        X = X_WB[i]


@compiled
def jacobian(X_WB: FloatArray, J: FloatArray) -> None:
    """The tool's Jacobian, rotation before translation, in the world.

    Args:
        X_WB: (n + 1, 4, 4) as `poses` leaves them.
        J: (6, n) receives it.
    """
    n = len(X_WB) - 1
    tool = X_WB[n]
    for i in range(n):
        ax, ay, az = X_WB[i, 0, 2], X_WB[i, 1, 2], X_WB[i, 2, 2]
        rx = tool[0, 3] - X_WB[i, 0, 3]
        ry = tool[1, 3] - X_WB[i, 1, 3]
        rz = tool[2, 3] - X_WB[i, 2, 3]
        J[0, i], J[1, i], J[2, i] = ax, ay, az
        J[3, i], J[4, i], J[5, i] = ay * rz - az * ry, az * rx - ax * rz, ax * ry - ay * rx


@compiled
def solve_in_place(A: FloatArray, b: FloatArray) -> bool:
    """b becomes A^-1 b by Gaussian elimination with row pivots; False if A is singular."""
    n = len(b)
    for k in range(n):
        pivot = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[pivot, k]):
                pivot = i
        if not abs(A[pivot, k]) > 1e-9:
            return False
        if pivot != k:
            for j in range(k, n):
                A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
            b[k], b[pivot] = b[pivot], b[k]
        for i in range(k + 1, n):
            factor = A[i, k] / A[k, k]
            if factor != 0.0:
                for j in range(k + 1, n):
                    A[i, j] -= factor * A[k, j]
                b[i] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= A[k, j] * b[j]
        b[k] /= A[k, k]
    return True


@compiled
def pose_error(tool: FloatArray, p_WE: FloatArray, R_WE: FloatArray, e: FloatArray) -> float:
    """Sets the first six of e to the turn and the way from a posed tool to where it is asked.

    Args:
        tool: (4, 4) its pose.
        p_WE: (3,) the tool point that is asked [m].
        R_WE: (3, 3) its orientation.
        e: receives the rotation vector [rad] and the way [m].

    Returns:
        The largest of them.
    """
    R = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            R[i, j] = R_WE[i, 0] * tool[j, 0] + R_WE[i, 1] * tool[j, 1] + R_WE[i, 2] * tool[j, 2]
    turn = rotation_vector(R)
    largest = 0.0
    for k in range(3):
        e[k], e[3 + k] = turn[k], p_WE[k] - tool[k, 3]
        largest = max(largest, abs(e[k]), abs(e[3 + k]))
    return largest


@compiled
def reach(
    q: FloatArray,
    p_WE: FloatArray,
    R_WE: FloatArray,
    fixed: int,
    X_PJ: FloatArray,
    X_WB: FloatArray,
    steps: int,
    tolerance: float,
) -> bool:
    """Newton steps of q onto a tool pose, one joint of seven staying where it is.

    Args:
        q: (7,) where to begin [rad]; receives the solution.
        p_WE: (3,) the tool point [m].
        R_WE: (3, 3) its orientation.
        fixed: the joint that stays.
        X_PJ: (8, 4, 4) see `poses`.
        X_WB: (8, 4, 4) receives the poses at the solution.
        steps: at most.
        tolerance: of the position [m], and of the orientation [rad].

    Returns:
        Whether the pose is met.
    """
    n = len(q)
    e = np.empty(n - 1)
    J = np.empty((6, n))
    A = np.empty((n - 1, n - 1))
    for number in range(steps + 1):
        poses(q, X_PJ, X_WB)
        if pose_error(X_WB[n], p_WE, R_WE, e) <= tolerance:
            return True
        if number == steps:
            break
        jacobian(X_WB, J)
        for i in range(n):
            if i != fixed:
                for row in range(6):
                    A[row, i - (i > fixed)] = J[row, i]
        if not solve_in_place(A, e):
            return False
        longest = 0.0
        for i in range(n - 1):
            longest = max(longest, abs(e[i]))
        if not math.isfinite(longest):
            return False
        share = min(1.0, _LONGEST_STEP / longest) if longest > 0.0 else 1.0
        for i in range(n - 1):
            q[i + (i >= fixed)] += share * e[i]
    return False


@compiled
def nearest_point(
    X_WB: FloatArray,
    shapes: GuardShapes,
    blocks: PointBlocks,
    age: float,
    only: int,
    limit: float,
) -> tuple[float, int, int, int]:
    """Least distance of an arm's shapes to the points of obstacles, up to a limit.

    Args:
        X_WB: (B, 4, 4) poses of the bodies, B at least as many as have shapes.
        shapes: what of the arm may touch.
        blocks: points on the obstacles, and the obstacles' velocities.
        age: for how long they have moved so since the points were seen [s].
        only: row of the obstacle that is asked for; -1: all.
        limit: a distance above it need not be known [m].

    Returns:
        The distance [m], rows of the shape, the obstacle and the point; the limit and -1
        where all is farther away.
    """
    body_sphere, shape_body, X_BG, size, bound = shapes
    points, block_start, block_owner, block_sphere, v_WO = blocks
    least, nearest_shape, nearest_owner, nearest_row = limit, -1, -1, -1
    X_WG = np.empty((3, 4))
    near = np.empty(len(block_owner), dtype=np.int64)
    first = 0
    while first < len(shape_body):
        body = shape_body[first]
        last = first
        while last < len(shape_body) and shape_body[last] == body:
            last += 1
        begin, first = first, last
        X = X_WB[body]
        bx, by, bz, radius = body_sphere[body]
        cx = X[0, 0] * bx + X[0, 1] * by + X[0, 2] * bz + X[0, 3]
        cy = X[1, 0] * bx + X[1, 1] * by + X[1, 2] * bz + X[1, 3]
        cz = X[2, 0] * bx + X[2, 1] * by + X[2, 2] * bz + X[2, 3]
        candidates = 0
        for block in range(len(block_owner)):
            owner = block_owner[block]
            if only >= 0 and owner != only:
                continue
            dx = block_sphere[block, 0] + v_WO[owner, 0] * age - cx
            dy = block_sphere[block, 1] + v_WO[owner, 1] * age - cy
            dz = block_sphere[block, 2] + v_WO[owner, 2] * age - cz
            most = radius + block_sphere[block, 3] + least
            if most > 0.0 and dx * dx + dy * dy + dz * dz <= most * most:
                near[candidates] = block
                candidates += 1
        if candidates == 0:
            continue
        for shape in range(begin, last):
            posed(X, X_BG[shape], X_WG)
            for candidate in range(candidates):
                block = near[candidate]
                owner = block_owner[block]
                ox = X_WG[0, 3] - v_WO[owner, 0] * age
                oy = X_WG[1, 3] - v_WO[owner, 1] * age
                oz = X_WG[2, 3] - v_WO[owner, 2] * age
                dx = block_sphere[block, 0] - ox
                dy = block_sphere[block, 1] - oy
                dz = block_sphere[block, 2] - oz
                most = bound[shape] + block_sphere[block, 3] + least
                if most <= 0.0 or dx * dx + dy * dy + dz * dz > most * most:
                    continue
                x, y, z = to_frame(X_WG, dx, dy, dz)
                if point_distance(x, y, z, size[shape])[0] > block_sphere[block, 3] + least:
                    continue
                for row in range(block_start[block], block_start[block + 1]):
                    x, y, z = to_frame(
                        X_WG, points[row, 0] - ox, points[row, 1] - oy, points[row, 2] - oz
                    )
                    d = point_distance(x, y, z, size[shape])[0]
                    if d < least:
                        least, nearest_shape = d, shape
                        nearest_owner, nearest_row = owner, row
    return least, nearest_shape, nearest_owner, nearest_row


@compiled
def lowest_height(X_WB: FloatArray, shapes: GuardShapes, table: FloatArray) -> float:
    """Least height of an arm's shapes above a plane [m]; arguments as of `nearest_point`.

    The first body only turns on its base, and is left out.

    Args:
        table: (4,) unit normal and offset of the plane [m]; NaN: there is none.
    """
    shape_body, X_BG, size = shapes.shape_body, shapes.X_BG, shapes.size
    least = np.inf
    if math.isnan(table[3]):
        return least
    X_WG = np.empty((3, 4))
    for shape in range(len(shape_body)):
        if shape_body[shape] == 0:
            continue
        posed(X_WB[shape_body[shape]], X_BG[shape], X_WG)
        x, y, z = deepest_point(X_WG, size[shape], table[0], table[1], table[2])
        least = min(least, x * table[0] + y * table[1] + z * table[2] - table[3])
    return least


@compiled
def segment_distance(p: FloatArray, q: FloatArray) -> float:
    """Distance of two segments [m], each (6,) both its ends.

    C. Ericson, Real-Time Collision Detection, 2005, section 5.1.9.
    """
    ux, uy, uz = p[3] - p[0], p[4] - p[1], p[5] - p[2]
    vx, vy, vz = q[3] - q[0], q[4] - q[1], q[5] - q[2]
    wx, wy, wz = p[0] - q[0], p[1] - q[1], p[2] - q[2]
    a = ux * ux + uy * uy + uz * uz
    e = vx * vx + vy * vy + vz * vz
    f = vx * wx + vy * wy + vz * wz
    if a <= _TINY and e <= _TINY:
        s, t = 0.0, 0.0
    elif a <= _TINY:
        s, t = 0.0, min(max(f / e, 0.0), 1.0)
    else:
        c = ux * wx + uy * wy + uz * wz
        if e <= _TINY:
            s, t = min(max(-c / a, 0.0), 1.0), 0.0
        else:
            b = ux * vx + uy * vy + uz * vz
            across = a * e - b * b
            s = min(max((b * f - c * e) / across, 0.0), 1.0) if across > _TINY * a * e else 0.0
            t = (b * s + f) / e
            if t < 0.0:
                s, t = min(max(-c / a, 0.0), 1.0), 0.0
            elif t > 1.0:
                s, t = min(max((b - c) / a, 0.0), 1.0), 1.0
    x, y, z = wx + s * ux - t * vx, wy + s * uy - t * vy, wz + s * uz - t * vz
    return math.sqrt(x * x + y * y + z * z)


@compiled
def self_distance(X_WB: FloatArray, parts: Parts, limit: float) -> float:
    """Least distance of an arm's parts, each of some capsules, to each other [m].

    Args:
        X_WB: (B, 4, 4) poses of the bodies.
        parts: which.
        limit: a distance above it need not be known [m].
    """
    part_body, part_first, part_sphere, rod, rod_radius, pairs = parts
    ends = np.empty((len(rod), 6))
    center = np.empty((len(part_body), 3))
    for part in range(len(part_body)):
        X = X_WB[part_body[part]]
        fixed = part_body[part] < 0
        for i in range(3):
            sphere = part_sphere[part]
            center[part, i] = (
                sphere[i]
                if fixed
                else X[i, 0] * sphere[0] + X[i, 1] * sphere[1] + X[i, 2] * sphere[2] + X[i, 3]
            )
            for c in range(part_first[part], part_first[part + 1]):
                for k in (0, 3):
                    p = rod[c]
                    ends[c, k + i] = (
                        p[k + i]
                        if fixed
                        else X[i, 0] * p[k] + X[i, 1] * p[k + 1] + X[i, 2] * p[k + 2] + X[i, 3]
                    )
    least = limit
    for pair in range(len(pairs)):
        one, other = pairs[pair, 0], pairs[pair, 1]
        x = center[one, 0] - center[other, 0]
        y = center[one, 1] - center[other, 1]
        z = center[one, 2] - center[other, 2]
        most = least + part_sphere[one, 3] + part_sphere[other, 3]
        if most <= 0.0 or x * x + y * y + z * z > most * most:
            continue
        for i in range(part_first[one], part_first[one + 1]):
            for j in range(part_first[other], part_first[other + 1]):
                d = segment_distance(ends[i], ends[j]) - rod_radius[i] - rod_radius[j]
                least = min(least, d)
    return least
