"""Compiled loops behind the memory of obstacles.

Call the functions of `tracking`, `occlusion` and `sides` instead. Every kernel takes
C-contiguous arrays of float64 and int64 (images: float32), so that numba compiles each
of them once, and caches it on disk.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from drake_oa.values import BoolArray, FloatArray, IntArray

HIDDEN, AT, FREE, OUT = 0, 1, 2, 3
"""What an image shows where a point should be: something before it, something at its
depth, only what is behind it, or nothing at all."""

_SLOTS = 1 << 13
_BINS = 256
_WALK = 24  # how far from an obstacle's side its surroundings are looked at [pixel]
_TAIL = 48  # pixels of a side that are looked at


@njit(cache=True, error_model="numpy")
def _slot(a: int, b: int, c: int) -> int:
    return ((a * 73856093) ^ (b * 19349663) ^ (c * 83492791)) & (_SLOTS - 1)


@njit(cache=True, error_model="numpy")
def mutual_nearest(
    query: FloatArray, points: FloatArray, radius: float, near: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """The nearest point to each query in reach, and how near any query is to each point.

    Args:
        query: (Q, 3) [m].
        points: (N, 3) [m].
        radius: a point is in reach of a query when it is nearer than this [m].
        near: a query is in reach of a point when it is nearer than this, <= radius [m].

    Returns:
        (Q,) index of the nearest point, -1 where none is in reach; (Q,) its distance and
        (N,) the distance of the nearest query, ``radius`` where there is none [m].
    """
    head = np.full(_SLOTS, -1, dtype=np.int64)
    link = np.empty(len(points), dtype=np.int64)
    scale = 1.0 / radius
    for i in range(len(points)):
        slot = _slot(
            np.int64(np.floor(points[i, 0] * scale)),
            np.int64(np.floor(points[i, 1] * scale)),
            np.int64(np.floor(points[i, 2] * scale)),
        )
        link[i] = head[slot]
        head[slot] = i
    nearest = np.full(len(query), -1, dtype=np.int64)
    from_query = np.full(len(query), radius * radius)
    from_point = np.full(len(points), radius * radius)
    cell, gap = np.empty(3, dtype=np.int64), np.empty((3, 3))
    # The own cell first: what it holds mostly rules out the others.
    steps = (0, -1, 1)
    for q in range(len(query)):
        x, y, z = query[q, 0], query[q, 1], query[q, 2]
        for k in range(3):
            at = query[q, k] * scale
            cell[k] = np.int64(np.floor(at))
            below = (at - cell[k]) * radius
            gap[k, 0], gap[k, 1], gap[k, 2] = 0.0, below * below, (radius - below) ** 2
        best, least = radius * radius, near * near
        for a in range(3):
            for b in range(3):
                for c in range(3):
                    if gap[0, a] + gap[1, b] + gap[2, c] >= max(best, least):
                        continue
                    i = head[_slot(cell[0] + steps[a], cell[1] + steps[b], cell[2] + steps[c])]
                    while i >= 0:
                        d2 = (points[i, 0] - x) ** 2
                        d2 += (points[i, 1] - y) ** 2
                        d2 += (points[i, 2] - z) ** 2
                        if d2 < from_point[i]:
                            from_point[i] = d2
                        if d2 < best:
                            best = d2
                            nearest[q] = i
                        i = link[i]
        from_query[q] = best
    return nearest, np.sqrt(from_query), np.sqrt(from_point)


@njit(cache=True, error_model="numpy")
def shown(
    points: FloatArray,
    X_WC: FloatArray,
    K: FloatArray,
    z: NDArray[np.float32],
    margin: float,
    pixel: IntArray,
) -> IntArray:
    """What a depth image shows where points should be.

    Nine pixels are asked about each point, so that one that is missing, or flies,
    decides nothing.

    Args:
        points: (N, 3) in the world frame [m].
        X_WC: (4, 4) pose of the camera.
        K: (4,) fx, fy, cx, cy [pixel].
        z: (H, W) float32 depth [m].
        margin: depth difference that tells "before" and "behind" from "at" [m].
        pixel: (N,) written: flat index of each point's pixel, -1 outside the image.

    Returns:
        (N,) HIDDEN, AT, FREE or OUT.
    """
    rows, columns = z.shape[0], z.shape[1]
    seen = np.full(len(points), OUT, dtype=np.int64)
    p = np.empty(3)
    for i in range(len(points)):
        pixel[i] = -1
        for k in range(3):
            p[k] = 0.0
            for m in range(3):
                p[k] += X_WC[m, k] * (points[i, m] - X_WC[m, 3])
        if p[2] < 1e-6:
            continue
        u = int(np.floor(K[0] * p[0] / p[2] + K[2] + 0.5))
        v = int(np.floor(K[1] * p[1] / p[2] + K[3] + 0.5))
        if u < 0 or u >= columns or v < 0 or v >= rows:
            continue
        pixel[i] = v * columns + u
        at, before, behind = 0, 0, 0
        for row in range(max(0, v - 1), min(rows, v + 2)):
            for column in range(max(0, u - 1), min(columns, u + 2)):
                depth = z[row, column]
                if not depth > 0.0:
                    continue
                beyond = depth - p[2]
                if beyond > margin:
                    behind += 1
                elif beyond < -margin:
                    before += 1
                else:
                    at += 1
        if at > 0:
            seen[i] = AT
        elif before > 0:
            seen[i] = HIDDEN
        elif behind > 2:
            seen[i] = FREE
    return seen


@njit(cache=True, error_model="numpy")
def pixel_points(
    z: NDArray[np.float32], pixel: IntArray, K: FloatArray, X_WC: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The points (P, 3) in the world frame that pixels (P,) show [m].

    Returns:
        The points, and the area (P,) that each pixel covers at its depth [m^2].
    """
    points, area = np.empty((len(pixel), 3)), np.empty(len(pixel))
    for i in range(len(pixel)):
        row = pixel[i] // z.shape[1]
        column = pixel[i] - row * z.shape[1]
        depth = z[row, column]
        x = (column - K[2]) * (depth / K[0])
        y = (row - K[3]) * (depth / K[1])
        for k in range(3):
            points[i, k] = X_WC[k, 0] * x + X_WC[k, 1] * y + X_WC[k, 2] * depth + X_WC[k, 3]
        area[i] = depth * depth / (K[0] * K[1])
    return points, area


@njit(cache=True, error_model="numpy")
def tail_places(
    points: FloatArray, area: FloatArray, row: IntArray, tail: FloatArray
) -> FloatArray:
    """Where the obstacles' sides are: beyond it lies a given area of what is seen of them.

    Args:
        points: (P, 3) [m].
        area: (P,) that each stands for [m^2].
        row: (P,) obstacle of each, -1: none.
        tail: (M,) that area [m^2].

    Returns:
        (M, 3, 2) lowest and highest place along each axis [m]; NaN for an obstacle of
        which nothing is seen.
    """
    count = len(tail)
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    for i in range(len(points)):
        if row[i] >= 0:
            for k in range(3):
                low[row[i], k] = min(low[row[i], k], points[i, k])
                high[row[i], k] = max(high[row[i], k], points[i, k])
    histogram = np.zeros((count, 3, _BINS))
    scale = np.zeros((count, 3))
    for m in range(count):
        for k in range(3):
            if high[m, k] > low[m, k]:
                scale[m, k] = (_BINS - 1) / (high[m, k] - low[m, k])
    for i in range(len(points)):
        m = row[i]
        if m >= 0:
            for k in range(3):
                place = np.int64((points[i, k] - low[m, k]) * scale[m, k])
                histogram[m, k, place] += area[i]
    sides = np.full((count, 3, 2), np.nan)
    for m in range(count):
        for k in range(3):
            if not high[m, k] >= low[m, k]:
                continue
            if scale[m, k] == 0.0:
                sides[m, k, 0] = sides[m, k, 1] = low[m, k]
                continue
            total, n = 0.0, 0
            while n < _BINS - 1 and total + histogram[m, k, n] < tail[m]:
                total += histogram[m, k, n]
                n += 1
            part = (tail[m] - total) / max(histogram[m, k, n], 1e-12)
            sides[m, k, 0] = low[m, k] + (n + min(part, 1.0)) / scale[m, k]
            total, n = 0.0, _BINS - 1
            while n > 0 and total + histogram[m, k, n] < tail[m]:
                total += histogram[m, k, n]
                n -= 1
            part = (tail[m] - total) / max(histogram[m, k, n], 1e-12)
            sides[m, k, 1] = low[m, k] + (n + 1 - min(part, 1.0)) / scale[m, k]
    return sides


@njit(cache=True, error_model="numpy")
def open_sides(
    points: FloatArray,
    pixel: IntArray,
    row: IntArray,
    sides: FloatArray,
    z: NDArray[np.float32],
    owner: NDArray[np.int16],
    K: FloatArray,
    X_WC: FloatArray,
    plane: FloatArray,
    margin: float,
) -> FloatArray:
    """How much of each side ends at free space, not at what hides the rest of it.

    From each pixel of a side the image is followed outward until it shows something
    else: what lies behind shows where the obstacle ends; what lies before it, what stands
    beside it (the robot, another obstacle), or the image's border, does not.

    Args:
        points: (P, 3) in the world frame [m].
        pixel: (P,) their pixels (flat indices).
        row: (P,) obstacle of each, -1: none.
        sides: (M, 3, 2) from `tail_places` [m].
        z: (H, W) float32 depth [m].
        owner: (H, W) int16 obstacle that each pixel shows, -1: none.
        K: (4,) fx, fy, cx, cy [pixel].
        X_WC: (4, 4) pose of the camera.
        plane: (4,) the table's normal and offset in the world.
        margin: depth difference that tells "before" and "behind" from "at", and height of
            what stands on the table [m].

    Returns:
        (M, 3, 2) shares in [0, 1].
    """
    asked, free = np.zeros(sides.shape), np.zeros(sides.shape)
    rows, columns = z.shape
    for i in range(len(points)):
        m = row[i]
        if m < 0:
            continue
        for k in range(3):
            for side in range(2):
                if side == 0:
                    beyond = points[i, k] <= sides[m, k, 0]
                else:
                    beyond = points[i, k] >= sides[m, k, 1]
                if not beyond or asked[m, k, side] >= _TAIL:
                    continue
                v0 = pixel[i] // columns
                u0 = pixel[i] - v0 * columns
                depth = z[v0, u0]
                # The image of the axis, outward.
                sign = 1.0 if side == 1 else -1.0
                x, y = (u0 - K[2]) / K[0], (v0 - K[3]) / K[1]
                du = sign * K[0] * (X_WC[k, 0] - x * X_WC[k, 2])
                dv = sign * K[1] * (X_WC[k, 1] - y * X_WC[k, 2])
                length = np.sqrt(du * du + dv * dv)
                asked[m, k, side] += 1.0
                if length < 0.3 * K[0]:
                    # Along the line of sight: nothing beside it tells.
                    free[m, k, side] += 1.0
                    continue
                du, dv = du / length, dv / length
                for step in range(1, _WALK):
                    u, v = np.int64(np.rint(u0 + step * du)), np.int64(np.rint(v0 + step * dv))
                    if u < 0 or u >= columns or v < 0 or v >= rows:
                        break
                    other = z[v, u]
                    if owner[v, u] == m or not other > 0.0:
                        continue
                    if other > depth + margin:
                        free[m, k, side] += 1.0
                        break
                    if other < depth - margin:
                        break
                    a, b = other * (u - K[2]) / K[0], other * (v - K[3]) / K[1]
                    height = -plane[3]
                    for c in range(3):
                        at = X_WC[c, 0] * a + X_WC[c, 1] * b + X_WC[c, 2] * other + X_WC[c, 3]
                        height += plane[c] * at
                    if height > margin:
                        break
    return free / np.maximum(asked, 1.0)


@njit(cache=True, error_model="numpy")
def hidden_beyond(
    points: FloatArray, owner: IntArray, hidden: BoolArray, sides: FloatArray, slack: float
) -> FloatArray:
    """How much of what is remembered beyond each side is hidden in the frame.

    Args:
        points: (N, 3) remembered points in the world [m].
        owner: (N,) their obstacles.
        hidden: (N,) which of them the frame does not show.
        sides: (M, 3, 2) from `tail_places` [m].
        slack: points no farther beyond a side belong to it [m].

    Returns:
        (M, 3, 2) shares in [0, 1]; 0 where nothing is remembered.
    """
    beyond, unseen = np.zeros(sides.shape), np.zeros(sides.shape)
    for i in range(len(points)):
        m = owner[i]
        for k in range(3):
            if points[i, k] < sides[m, k, 0] - slack:
                beyond[m, k, 0] += 1.0
                unseen[m, k, 0] += hidden[i]
            elif points[i, k] > sides[m, k, 1] + slack:
                beyond[m, k, 1] += 1.0
                unseen[m, k, 1] += hidden[i]
    return unseen / np.maximum(beyond, 1.0)


@njit(cache=True, error_model="numpy")
def absorb(
    points: FloatArray,
    weight: IntArray,
    query: FloatArray,
    nearest: IntArray,
    distance: FloatArray,
    reach: float,
    most: int,
) -> None:
    """Moves remembered points to the mean of what was seen of them.

    Args:
        points: (N, 3) remembered points, changed [m].
        weight: (N,) how many frames each is the mean of, changed.
        query: (Q, 3) points of the frame [m].
        nearest: (Q,) the remembered point nearest to each, -1: none.
        distance: (Q,) and how far it is [m].
        reach: farther ones are other points [m].
        most: a mean never weighs more frames than this.
    """
    total, count = np.zeros(points.shape), np.zeros(len(points), dtype=np.int64)
    for q in range(len(query)):
        i = nearest[q]
        if i >= 0 and distance[q] <= reach:
            count[i] += 1
            for k in range(3):
                total[i, k] += query[q, k]
    for i in range(len(points)):
        if count[i] > 0:
            weight[i] = min(weight[i] + 1, most)
            for k in range(3):
                points[i, k] += (total[i, k] / count[i] - points[i, k]) / weight[i]


@njit(cache=True, error_model="numpy")
def supports(points: FloatArray, row: IntArray, count: int, directions: FloatArray) -> FloatArray:
    """(M, D) how far the points (N, 3) of each of M obstacles reach along directions (D, 3)."""
    out = np.full((count, len(directions)), -np.inf)
    for i in range(len(points)):
        if row[i] >= 0:
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            for d in range(len(directions)):
                reach = directions[d, 0] * x + directions[d, 1] * y + directions[d, 2] * z
                if reach > out[row[i], d]:
                    out[row[i], d] = reach
    return out
