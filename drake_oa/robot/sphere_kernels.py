"""Spheres of a robot, compiled: where they are, how near to each other, and which cover what."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, IntArray


class Spheres(NamedTuple):
    """S spheres of a robot in G groups, a body a group, by joint and then by body.

    Attributes:
        joint: (S,) the joint that moves each; -1: fixed to the world.
        p_JS: (S, 3) centres in that joint's frame (`arm_kernels.poses`), or in the world [m].
        radius: (S,) [m].
        of_tool: (S,) whether it is of the tool or of what the tool holds.
        first: (G + 1,) where each group's spheres begin, and S.
        group_joint: (G,) the joint that moves each group.
        bound: (G, 4) centre as `p_JS`, and radius, of a sphere that holds the group's [m].
        cluster: (G + 1,) where each group's clusters of neighbours begin, and C.
        cluster_first: (C + 1,) where each cluster's spheres begin, and S.
        cluster_bound: (C, 4) as `bound`, of a cluster.
        pairs: (P, 2) groups that may touch each other.
        allowance: (P,) what a pair's spheres may overlap before its true shapes come near [m].
    """

    joint: IntArray
    p_JS: FloatArray
    radius: FloatArray
    of_tool: BoolArray
    first: IntArray
    group_joint: IntArray
    bound: FloatArray
    cluster: IntArray
    cluster_first: IntArray
    cluster_bound: FloatArray
    pairs: IntArray
    allowance: FloatArray


@compiled
def _place_rows(
    X_WJ: FloatArray, joint: int, p: FloatArray, begin: int, end: int, out: FloatArray
) -> None:
    """Sets rows of out (S, 3) to rows of p (S, 3 or 4), in one joint's frame, in the world."""
    if joint < 0:
        for s in range(begin, end):
            out[s, 0], out[s, 1], out[s, 2] = p[s, 0], p[s, 1], p[s, 2]
        return
    a, b, c, x = X_WJ[joint, 0, 0], X_WJ[joint, 0, 1], X_WJ[joint, 0, 2], X_WJ[joint, 0, 3]
    d, e, f, y = X_WJ[joint, 1, 0], X_WJ[joint, 1, 1], X_WJ[joint, 1, 2], X_WJ[joint, 1, 3]
    g, h, i, z = X_WJ[joint, 2, 0], X_WJ[joint, 2, 1], X_WJ[joint, 2, 2], X_WJ[joint, 2, 3]
    for s in range(begin, end):
        u, v, w = p[s, 0], p[s, 1], p[s, 2]
        out[s, 0] = a * u + b * v + c * w + x
        out[s, 1] = d * u + e * v + f * w + y
        out[s, 2] = g * u + h * v + i * w + z


@compiled
def place(X_WJ: FloatArray, spheres: Spheres, centers: FloatArray) -> None:
    """Where the spheres are.

    Args:
        X_WJ: (n + 1, 4, 4) poses of the joints' frames, as `arm_kernels.poses` leaves them.
        spheres: which.
        centers: (S, 3) receives their centres in the world [m].
    """
    p, first, joint = spheres.p_JS, spheres.first, spheres.group_joint
    for g in range(len(joint)):
        _place_rows(X_WJ, joint[g], p, first[g], first[g + 1], centers)


@compiled
def place_groups(X_WJ: FloatArray, spheres: Spheres, centers: FloatArray) -> None:
    """Where the groups' bounding spheres are: centres (G, 3) [m]; else as `place`."""
    bound, joint = spheres.bound, spheres.group_joint
    for g in range(len(joint)):
        _place_rows(X_WJ, joint[g], bound, g, g + 1, centers)


@compiled
def _pair_distance(
    rows: tuple[int, int, int, int],
    centers: FloatArray,
    radius: FloatArray,
    ball: tuple[float, float, float, float],
    limit: float,
) -> float:
    """Least distance of two groups' spheres, or the limit; the ball holds the second group's."""
    least = limit
    for i in range(rows[0], rows[1]):
        x, y, z, r = centers[i, 0], centers[i, 1], centers[i, 2], radius[i]
        a, b, c = x - ball[0], y - ball[1], z - ball[2]
        most = least + r + ball[3]
        if most <= 0.0 or a * a + b * b + c * c >= most * most:
            continue
        for j in range(rows[2], rows[3]):
            a, b, c = x - centers[j, 0], y - centers[j, 1], z - centers[j, 2]
            most = least + r + radius[j]
            square = a * a + b * b + c * c
            if most > 0.0 and square < most * most:
                least = math.sqrt(square) - r - radius[j]
    return least


@compiled
def pair_distances(X_WJ: FloatArray, spheres: Spheres, limit: float, out: FloatArray) -> None:
    """The distance of each pair, without its allowance and up to the limit: out (P,) [m]."""
    at = np.empty((len(spheres.bound), 3))
    place_groups(X_WJ, spheres, at)
    centers = np.empty_like(spheres.p_JS)
    place(X_WJ, spheres, centers)
    first, bound = spheres.first, spheres.bound
    for pair in range(len(spheres.pairs)):
        one, other = spheres.pairs[pair, 0], spheres.pairs[pair, 1]
        rows = (first[one], first[one + 1], first[other], first[other + 1])
        ball = (at[other, 0], at[other, 1], at[other, 2], bound[other, 3])
        out[pair] = _pair_distance(rows, centers, spheres.radius, ball, limit)


@compiled
def choose(centers: FloatArray, radii: FloatArray, points: FloatArray) -> IntArray:
    """Rows of a few of K balls that cover N points, every point being in one at least.

    The point that the fewest balls cover is served first, by the ball that covers the most of
    what is left; balls that turn out superfluous go. Greedy set cover from the corners inwards.

    Args:
        centers: (K, 3).
        radii: (K,).
        points: (N, 3).
    """
    balls, count = len(centers), len(points)
    covers = np.zeros((count, balls), dtype=np.bool_)
    options = np.zeros(count, dtype=np.int64)
    gain = np.zeros(balls, dtype=np.int64)
    for n in range(count):
        for k in range(balls):
            x, y, z = (
                points[n, 0] - centers[k, 0],
                points[n, 1] - centers[k, 1],
                points[n, 2] - centers[k, 2],
            )
            if x * x + y * y + z * z <= radii[k] * radii[k]:
                covers[n, k] = True
                options[n] += 1
                gain[k] += 1
    order = np.argsort(options, kind="mergesort")
    times = np.zeros(count, dtype=np.int64)
    chosen = [0 for _ in range(0)]
    for n in order:
        if times[n] > 0 or options[n] == 0:
            continue
        best = -1
        for k in range(balls):
            if covers[n, k] and (best < 0 or gain[k] > gain[best]):
                best = k
        chosen.append(best)
        for m in range(count):
            if covers[m, best]:
                times[m] += 1
                if times[m] == 1:
                    for k in range(balls):
                        gain[k] -= covers[m, k]
    kept = [0 for _ in range(0)]
    for best in chosen:
        superfluous = True
        for m in range(count):
            if covers[m, best] and times[m] == 1:
                superfluous = False
                break
        if superfluous:
            for m in range(count):
                times[m] -= covers[m, best]
        else:
            kept.append(best)
    return np.array(kept, dtype=np.int64)


@compiled
def tighten(centers: FloatArray, radii: FloatArray, points: FloatArray) -> None:
    """Makes each of K balls (K, 3), (K,) in turn as small as the points (N, 3) let it be."""
    count = len(points)
    times = np.zeros(count, dtype=np.int64)
    square = np.empty((len(centers), count))
    for k in range(len(centers)):
        for n in range(count):
            x, y, z = (
                points[n, 0] - centers[k, 0],
                points[n, 1] - centers[k, 1],
                points[n, 2] - centers[k, 2],
            )
            square[k, n] = x * x + y * y + z * z
            times[n] += square[k, n] <= radii[k] * radii[k]
    for k in range(len(centers)):
        need = 0.0
        for n in range(count):
            if square[k, n] <= radii[k] * radii[k] and times[n] == 1:
                need = max(need, square[k, n])
        for n in range(count):
            times[n] -= need < square[k, n] <= radii[k] * radii[k]
        radii[k] = math.sqrt(need)


@compiled
def nearest_balls(points: FloatArray, centers: FloatArray, radii: FloatArray) -> FloatArray:
    """(N,) signed distances of points (N, 3) to the nearest of K balls (K, 3), (K,)."""
    found = np.empty(len(points))
    for n in range(len(points)):
        least = np.inf
        for k in range(len(centers)):
            x, y, z = (
                points[n, 0] - centers[k, 0],
                points[n, 1] - centers[k, 1],
                points[n, 2] - centers[k, 2],
            )
            square, most = x * x + y * y + z * z, least + radii[k]
            if most > 0.0 and square < most * most:
                least = math.sqrt(square) - radii[k]
        found[n] = least
    return found


@compiled
def grow(
    points: FloatArray, reach: float, centers: FloatArray, depth: FloatArray, radii: FloatArray
) -> None:
    """Makes balls larger until the ball of a reach round each of the points is in one of them.

    Args:
        points: (N, 3) [m].
        reach: [m].
        centers: (K, 3) the balls' [m].
        depth: (K,) of the centres in the shape; that which sticks out least by it grows [m].
        radii: (K,) [m]; some become larger.
    """
    for n in range(len(points)):
        best, least, radius = -1, np.inf, 0.0
        for k in range(len(centers)):
            x, y, z = (
                points[n, 0] - centers[k, 0],
                points[n, 1] - centers[k, 1],
                points[n, 2] - centers[k, 2],
            )
            need = math.sqrt(x * x + y * y + z * z) + reach
            if need <= radii[k]:
                best = -1
                break
            if need - depth[k] < least:
                best, least, radius = k, need - depth[k], need
        if best >= 0:
            radii[best] = radius
