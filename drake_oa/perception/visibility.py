"""Points of a frame near remembered ones, and obstacles that the image cuts off.

A post that the image shows the lower half of, or the upper half of which is too near, has no end
there, and nothing may pass over it. What is cut off is taken to go on upright for as far as it is
seen; what is cut off at the sides ends where it is seen to.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from drake_oa.common.messages import BoolArray, FloatArray, IntArray, ObstacleClouds
from drake_oa.geometry.distance_field import VOXEL


def mutual_nearest(
    query: FloatArray, points: FloatArray, radius: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Finds the nearest point to each query within a radius, and the nearest query to each point.

    Args:
        query: (Q, 3) [m].
        points: (N, 3) [m].
        radius: maximum distance [m].

    Returns:
        (Q,) index of the nearest point, -1 without one in the radius; (Q,) its distance and
        (N,) the distance of the nearest query, ``radius`` without one [m].
    """
    from_query, nearest = cKDTree(points).query(query, distance_upper_bound=radius)
    from_point, _ = cKDTree(query).query(points, distance_upper_bound=radius)
    nearest = np.where(np.isfinite(from_query), nearest, -1)
    return nearest, np.minimum(from_query, radius), np.minimum(from_point, radius)


_LONGEST = 0.5
"""What is cut off goes on for no more [m]."""
_NEAR = 1.5 * VOXEL
"""A point so near to the border of the image may be the last that it shows [m]."""


class ImageRange(NamedTuple):
    """Upright extent of what a pinhole camera sees.

    Attributes:
        fy, cy, height: focal length, center and height of the image along its columns [pixel].
        near: what has less depth is not seen [m].
    """

    fy: float
    cy: float
    height: int
    near: float = 0.0


def with_occluded_extents(
    obstacles: ObstacleClouds,
    cameras: Sequence[tuple[FloatArray, ImageRange]],
    seen_free: Callable[[FloatArray], BoolArray] | None = None,
) -> ObstacleClouds:
    """The obstacles, with more points where the image cuts them off.

    Args:
        obstacles: what is seen.
        cameras: of each the pose X_WC (4, 4) (x right, y down, z forward), and its image.
        seen_free: tells of points (N, 3) [m] which of them another camera sees through: they are
            not there. None: nobody knows.

    Returns:
        `obstacles` itself where none is cut off.
    """
    clouds = []
    for cloud in obstacles.clouds_W:
        ends = [end for X_WC, image in cameras for end in _ends(cloud, X_WC, image)]
        if seen_free is not None:
            ends = [end[~seen_free(end)] for end in ends]
        clouds.append(np.concatenate([cloud, *ends]) if any(map(len, ends)) else cloud)
    if all(one is other for one, other in zip(clouds, obstacles.clouds_W, strict=True)):
        return obstacles
    return replace(obstacles, clouds_W=tuple(clouds))


def _ends(cloud: FloatArray, X_WC: FloatArray, image: ImageRange) -> Iterator[FloatArray]:
    """What goes on beyond each border (M, 3) of an image that cuts off a cloud (N, 3)."""
    _, y, z = ((cloud - X_WC[:3, 3]) @ X_WC[:3, :3]).T
    # How far the points are from the borders, at their depth; up and down in the image, and
    # nearer, is so in the world.
    top, bottom = y + z * image.cy / image.fy, z * (image.height - image.cy) / image.fy - y
    vertical = np.array([0.0, 0.0, 1.0])
    up = vertical * math.copysign(1.0, -X_WC[2, 1])
    nearer = vertical * math.copysign(1.0, -X_WC[2, 2])
    for gap, way in ((top, up), (bottom, -up), (z - image.near, nearer)):
        last = cloud[(np.abs(gap) <= _NEAR) & (z > 0.0)]
        if not len(last):
            continue
        along = cloud @ way
        length = min(float(np.ptp(along)), _LONGEST)
        steps = VOXEL * np.arange(1, 1 + math.floor(length / VOXEL))
        yield (last[:, None] + steps[:, None] * way).reshape(-1, 3)
