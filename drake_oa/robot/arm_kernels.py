"""Where the bodies of an arm are and what they come near to, compiled.

Every kernel takes C-contiguous float64 and int64 arrays, so that numba compiles each of them once,
and caches it on disk.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.points import GuardShapes, PointBlocks
from drake_oa.geometry.primitives import point_distance, posed, to_frame


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
