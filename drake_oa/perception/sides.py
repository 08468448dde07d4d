"""Where an obstacle is, measured by its sides: so that what hides a part of it does not move it.

The centroid of what is seen shifts when an arm passes before it. A side, the place
beyond which a small fixed area of the obstacle lies, does not, as long as the image
shows free space beyond it. Each side is compared with where it was before.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_oa.common.messages import BoolArray, FloatArray, IntArray, TablePlane
from drake_oa.perception.point_cloud import Segmentation
from drake_oa.perception.surface_kernels import open_sides, owner_rows, surfaces, tail_places

_TAIL = 0.02  # share of an obstacle's area that lies beyond its side
_OPEN = 0.7  # share of a side that must end at free space
_LEAST_AREA = 0.15  # share of an obstacle that must be seen for it to be measured
_PIXELS = 800  # about how many pixels of a cluster are looked at
_HIDDEN_FACTOR = 3.0  # how much wider the deviation is of what is almost all hidden
_GRAIN = 0.7  # standard deviation of a side in pixels
_LEARNING = 0.05  # share of a frame in the remembered distance between two sides


@dataclass(frozen=True, eq=False)
class View:
    """A depth image, and where it was taken from.

    Attributes:
        z: (H, W) depth [m].
        K: (4,) fx, fy, cx, cy [pixel].
        X_WC: (4, 4) pose of the camera.
    """

    z: NDArray[np.float32]
    K: FloatArray
    X_WC: FloatArray


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
    view: View | None,
    voxel: float,
    margin: float,
) -> SeenSides:
    """Finds the sides in a frame.

    Args:
        frame: the frame, segmented.
        cluster_row: (C,) obstacle of each cluster, -1: not to be measured.
        known_area: (M,) largest area seen of each obstacle before [m^2].
        view: its image; None: a cloud, of which every side is taken to be seen.
        voxel: edge of a voxel, for clouds [m].
        margin: depth difference that tells "before" and "behind" from "at" [m].
    """
    count = len(known_area)
    pixels, begin = _joined(frame.pixels)
    if view is None:
        used = np.flatnonzero(cluster_row >= 0)
        clouds = [frame.clouds_W[c] for c in used]
        points = np.concatenate([np.zeros((0, 3)), *clouds])
        row = np.repeat(cluster_row[used], [len(cloud) for cloud in clouds]).astype(np.int64)
        area, weight = np.full(len(points), voxel**2), np.ones(len(points))
        pixel = row
    else:
        points, area, pixel, row, weight = surfaces(
            pixels, begin, cluster_row, view.z, view.K, view.X_WC, _PIXELS
        )
    number = np.bincount(row, minlength=count)
    grain = np.sqrt(np.bincount(row, weights=area, minlength=count) / np.maximum(number, 1))
    area = area * weight
    seen = np.bincount(row, weights=area, minlength=count)
    tail = _TAIL * np.maximum(seen, known_area)
    place = tail_places(points, area, row, tail)
    if view is None:
        ends = np.isfinite(place)
    else:
        owner, top = owner_rows(pixels, begin, cluster_row, view.z.shape[1])
        table = frame.table or TablePlane(offset=-np.inf)
        plane = np.append(table.normal_W, table.offset)
        share = open_sides(
            points, pixel, row, place, view.z, owner, top, view.K, view.X_WC, plane, margin
        )
        ends = share >= _OPEN
    return SeenSides(place, ends, np.asarray(seen, dtype=float), np.asarray(grain, dtype=float))


def _joined(parts: tuple[IntArray, ...]) -> tuple[IntArray, IntArray]:
    """Arrays one after the other, and (C + 1,) where each begins."""
    begin = np.zeros(len(parts) + 1, dtype=np.int64)
    np.cumsum([len(part) for part in parts], out=begin[1:])
    return np.concatenate([np.zeros(0, dtype=np.int64), *parts]), begin


def measured_position(
    seen: SeenSides, sides: FloatArray, known_area: FloatArray, deviation: float
) -> tuple[FloatArray, FloatArray]:
    """Positions (M, 3) of obstacles by their sides [m], and their variances [m^2].

    Args:
        seen: the sides in this frame.
        sides: (M, 3, 2) where they were, from the position [m]; NaN: unknown.
        known_area: (M,) largest area seen of each before [m^2].
        deviation: standard deviation of the place of one side [m]; the grain adds to it.

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
    wide = np.hypot(deviation, _GRAIN * seen.grain)[:, None] * (1.0 + _HIDDEN_FACTOR * hidden)
    variance = wide**2 / np.maximum(count, 1)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), variance


def learned_sides(seen: SeenSides, sides: FloatArray, p_W: FloatArray) -> FloatArray:
    """The sides (M, 3, 2) from the position p_W (M, 3), after this frame [m].

    A side that is seen for the first time is placed; of two that are known only the
    distance is learned: it must not move the position.
    """
    found = np.where(seen.ends, seen.place - p_W[:, :, None], np.nan)
    error = found - sides
    error -= error.mean(axis=2, keepdims=True)
    learned = sides + _LEARNING * np.where(np.isfinite(error), error, 0.0)
    return np.where(np.isnan(sides), found, learned)
