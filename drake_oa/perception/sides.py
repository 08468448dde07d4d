"""Where an obstacle is, measured by its sides: so that what hides a part of it does not move it.

The centroid of what is seen shifts when an arm passes before it. A side, the place
beyond which a small fixed area of the obstacle lies, does not, as long as the image
shows free space beyond it. Each side is compared with where it was before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, IntArray, TablePlane
from drake_oa.geometry.pinhole import View
from drake_oa.perception.segmentation import Segmentation

_BINS = 256
_BEHIND = 0.01  # an obstacle's own surface is behind what would stand before it, at 1 m [m]
_WALK = 24  # how far from an obstacle's side its surroundings are looked at [pixel]
_EMPTY = 12  # so many pixels in a row without depth show that nothing is beside it
_SIDE_PIXELS = 48  # pixels of a side that are looked at


@compiled
def surfaces(
    pixel: IntArray,
    begin: IntArray,
    cluster_row: IntArray,
    view: View,
    most: int,
) -> tuple[FloatArray, FloatArray, IntArray, IntArray, FloatArray]:
    """What a frame shows of obstacles, by some of their pixels.

    Args:
        pixel: (P,) pixels of C clusters, one after the other, ascending in each.
        begin: (C + 1,) where each of them begins.
        cluster_row: (C,) obstacle of each, -1: not asked for.
        view: the depth image.
        most: about how many pixels of a cluster are taken.

    Returns:
        The points (S, 3) in the world frame [m]; the area (S,) that a pixel covers at
        each of them [m^2]; their pixels (S,) and obstacles (S,); for how many pixels
        each stands (S,).
    """
    z, K, X_WC = view
    count = 0
    for c in range(len(cluster_row)):
        size = begin[c + 1] - begin[c]
        if cluster_row[c] >= 0:
            step = max(1, size // most)
            count += (size + step - 1) // step
    points, area = np.empty((count, 3)), np.empty(count)
    taken, owner = np.empty(count, dtype=np.int64), np.empty(count, dtype=np.int64)
    weight, n = np.empty(count), 0
    for c in range(len(cluster_row)):
        if cluster_row[c] < 0:
            continue
        step, row = max(1, (begin[c + 1] - begin[c]) // most), 0
        for i in range(begin[c], begin[c + 1], step):
            while pixel[i] >= (row + 1) * z.shape[1]:
                row += 1
            column = pixel[i] - row * z.shape[1]
            depth = z[row, column]
            x = (column - K[2]) * (depth / K[0])
            y = (row - K[3]) * (depth / K[1])
            for k in range(3):
                points[n, k] = X_WC[k, 0] * x + X_WC[k, 1] * y + X_WC[k, 2] * depth + X_WC[k, 3]
            area[n] = depth * depth / (K[0] * K[1])
            taken[n], owner[n], weight[n] = pixel[i], cluster_row[c], step
            n += 1
    return points, area, taken, owner, weight


@compiled
def owner_rows(
    pixel: IntArray, begin: IntArray, cluster_row: IntArray, columns: int
) -> tuple[NDArray[np.int16], int]:
    """The obstacles (R, W) in the rows of an image that show any, and the first such row.

    Args:
        pixel: (P,) as in `surfaces`.
        begin: (C + 1,)
        cluster_row: (C,)
        columns: W.
    """
    low, high = 1 << 60, -1
    for c in range(len(cluster_row)):
        if cluster_row[c] >= 0 and begin[c + 1] > begin[c]:
            low, high = min(low, pixel[begin[c]]), max(high, pixel[begin[c + 1] - 1])
    if high < 0:
        return np.empty((0, columns), dtype=np.int16), 0
    top, bottom = low // columns, high // columns + 1
    owner = np.full((bottom - top) * columns, -1, dtype=np.int16)
    for c in range(len(cluster_row)):
        if cluster_row[c] >= 0:
            for i in range(begin[c], begin[c + 1]):
                owner[pixel[i] - top * columns] = cluster_row[c]
    return owner.reshape(bottom - top, columns), top


@compiled
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


@compiled
def open_sides(
    points: FloatArray,
    pixel: IntArray,
    row: IntArray,
    sides: FloatArray,
    view: View,
    owner: NDArray[np.int16],
    top: int,
    plane: FloatArray,
    margin: float,
) -> tuple[FloatArray, FloatArray]:
    """How many pixels of each side end at free space, not at what hides the rest of it.

    From each pixel of a side the image is followed outward until it shows something
    else: what lies behind shows where the obstacle ends; what lies before it, what stands
    beside it (the robot, another obstacle), or the image's border, does not. Where nothing
    at all is shown for long, the background is too far away to be measured. The obstacle itself
    shows its end too, where it lies behind what it would have beyond the side.

    Args:
        points: (P, 3) in the world frame [m].
        pixel: (P,) their pixels (flat indices).
        row: (P,) obstacle of each, -1: none.
        sides: (M, 3, 2) from `tail_places` [m].
        view: the depth image.
        owner: (R, W) int16 obstacle that each pixel of some rows shows, -1: none. The
            other rows show none.
        top: the first of those rows.
        plane: (4,) the table's normal and offset in the world.
        margin: depth difference that tells "before" and "behind" from "at", and height of
            what stands on the table [m].

    Returns:
        (M, 3, 2) how many do, and of how many.
    """
    z, K, X_WC = view
    asked, free = np.zeros(sides.shape), np.zeros(sides.shape)
    rows, columns = z.shape
    bottom = top + len(owner)
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
                if not beyond or asked[m, k, side] >= _SIDE_PIXELS:
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
                # By how much nearer the obstacle would be if it went on beyond the side [m/pixel].
                nearer = -sign * X_WC[k, 2] * depth / length
                empty = 0
                for step in range(1, _WALK):
                    u, v = np.int64(np.rint(u0 + step * du)), np.int64(np.rint(v0 + step * dv))
                    if u < 0 or u >= columns or v < 0 or v >= rows:
                        break
                    other = z[v, u]
                    if not other > 0.0:
                        empty += 1
                        if empty < _EMPTY:
                            continue
                        free[m, k, side] += 1.0
                        break
                    empty = 0
                    if v >= top and v < bottom and owner[v - top, u] == m:
                        # The noise of a depth grows with its square.
                        if other > depth - step * nearer + _BEHIND * depth * depth:
                            free[m, k, side] += 1.0
                            break
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
    return free, asked


_PIXELS = 800  # about how many pixels of a cluster are looked at
DEPTH_MARGIN = 0.03
"""Depth difference that tells what is before or behind a surface from what is on it [m]."""
SIDE_DEVIATION = 0.0015
"""Standard deviation of the measured place of a side, or of a surface point [m]."""
_SIDE_TAIL = 0.02
"""Share of an obstacle's area that lies beyond its side."""
_OPEN_SHARE = 0.7
"""Share of the surroundings of a side that must be free for the obstacle to end there."""
_LEAST_AREA = 0.15
"""Share of the known area that must be seen for an obstacle to be measured by its sides."""
_WIDENED = 1.1
"""Ratio of seen to known area above which an obstacle is coming into view."""
_WIDENED_FACTOR = 6.0
"""Factor of the deviation of sides of an obstacle that is coming into view."""
_SIDE_GRAIN = 0.7
"""Standard deviation of a side [pixel]."""
_HIDDEN_FACTOR = 3.0
"""Relative growth of the deviation of a side of an obstacle that is all occluded."""
_SIDE_LEARNING = 0.05
"""Share of a frame in the remembered distance between two sides."""


@dataclass(frozen=True, eq=False)
class SeenSides:
    """Sides of M obstacles in one frame.

    Attributes:
        place: (M, 3, 2) lowest and highest along each axis of the world [m]; NaN where
            nothing of an obstacle is seen.
        ends: (M, 3, 2) whether the obstacle ends there.
        area: (M,) what is seen of it, across the line of sight [m^2].
        grain: (M,) width of a pixel, or a voxel, there [m]; 0 where nothing is seen.
    """

    place: FloatArray
    ends: BoolArray
    area: FloatArray
    grain: FloatArray


def seen_sides(
    frame: Segmentation,
    cluster_row: IntArray,
    known_area: FloatArray,
    voxel: float,
) -> SeenSides:
    """Finds the sides in a frame: those of all that its images show.

    Args:
        frame: the frame, segmented; of a cloud every side is taken to be seen.
        cluster_row: (C,) obstacle of each cluster, -1: not to be measured.
        known_area: (M,) largest area seen of each obstacle before [m^2].
        voxel: edge of a voxel, for clouds [m].
    """
    count = len(known_area)
    images = [_joined(frame.pixels_in(row)) for row in range(len(frame.views))]
    if not images:
        used = np.flatnonzero(cluster_row >= 0)
        clouds = [frame.clouds_W[c] for c in used]
        points = np.concatenate([np.zeros((0, 3)), *clouds])
        row = np.repeat(cluster_row[used], [len(cloud) for cloud in clouds]).astype(np.int64)
        area, weight = np.full(len(points), voxel**2), np.ones(len(points))
        parts = []
    else:
        parts = [
            surfaces(*image, cluster_row, view, _PIXELS)
            for image, view in zip(images, frame.views, strict=True)
        ]
        points, area, _, row, weight = (
            np.concatenate(column) for column in zip(*parts, strict=True)
        )
    number = np.bincount(row, minlength=count)
    grain = np.sqrt(np.bincount(row, weights=area, minlength=count) / np.maximum(number, 1))
    area = area * weight
    seen = np.bincount(row, weights=area, minlength=count)
    tail = _SIDE_TAIL * np.maximum(seen, known_area)
    place = tail_places(points, area, row, tail)
    ends = np.isfinite(place)
    if parts:
        table = frame.table or TablePlane(offset=-np.inf)
        plane = np.append(table.normal_W, table.offset)
        free, asked = np.zeros(place.shape), np.zeros(place.shape)
        for part, image, view in zip(parts, images, frame.views, strict=True):
            owner, top = owner_rows(*image, cluster_row, view.z.shape[1])
            found = open_sides(part[0], *part[2:4], place, view, owner, top, plane, DEPTH_MARGIN)
            free, asked = free + found[0], asked + found[1]
        ends = free / np.maximum(asked, 1.0) >= _OPEN_SHARE
    return SeenSides(place, ends, np.asarray(seen, dtype=float), np.asarray(grain, dtype=float))


def _joined(parts: tuple[IntArray, ...]) -> tuple[IntArray, IntArray]:
    """Arrays one after the other, and (C + 1,) where each begins."""
    begin = np.zeros(len(parts) + 1, dtype=np.int64)
    np.cumsum([len(part) for part in parts], out=begin[1:])
    return np.concatenate([np.zeros(0, dtype=np.int64), *parts]), begin


def measured_position(
    seen: SeenSides, sides: FloatArray, known_area: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Positions (M, 3) of obstacles by their sides [m], and their variances [m^2].

    Args:
        seen: the sides in this frame.
        sides: (M, 3, 2) where they were, from the position [m]; NaN: unknown.
        known_area: (M,) largest area seen of each before [m^2].

    Returns:
        The positions, NaN along an axis of which no known side is seen.
    """
    position = seen.place - sides
    usable = seen.ends & np.isfinite(position)
    share = seen.area / np.maximum(known_area, 1e-12)
    usable &= (share >= _LEAST_AREA)[:, None, None]
    count = usable.sum(axis=2)
    total = np.where(usable, position, 0.0).sum(axis=2)
    hidden = np.clip(1.0 - share, 0.0, 1.0)[:, None]
    wide = np.hypot(SIDE_DEVIATION, _SIDE_GRAIN * seen.grain)[:, None]
    wide = wide * (1.0 + _HIDDEN_FACTOR * hidden)
    wide = np.where((share > _WIDENED)[:, None], _WIDENED_FACTOR * wide, wide)
    variance = wide**2 / np.maximum(count, 1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), variance


def learned_sides(seen: SeenSides, sides: FloatArray, p_W: FloatArray) -> FloatArray:
    """The sides (M, 3, 2) from the position p_W (M, 3), after this frame [m].

    A side that is seen for the first time is placed; of two that are known only the
    distance is learned, a share of it a frame: it must not move the position.
    """
    found = np.where(seen.ends, seen.place - p_W[:, :, None], np.nan)
    error = found - sides
    error -= error.mean(axis=2, keepdims=True)
    learned = sides + _SIDE_LEARNING * np.where(np.isfinite(error), error, 0.0)
    return np.where(np.isnan(sides), found, learned)
