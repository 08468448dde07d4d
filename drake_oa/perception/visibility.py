"""Nearest points of two clouds, and extension of obstacles that the border of an image truncates.

Parts of obstacles beyond the border of an image are not observed. The upper end of a post that
extends above the image, or its foot nearer than the minimum depth, is unknown. No motion may pass
there. A cloud that ends at the upper or lower border, or at the minimum depth, is therefore
extended vertically by its visible height, at most by 0.5 m. Left and right borders do not extend
it.
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
    """Finds the nearest point to each query point within a radius, and the distance from each point
    to its nearest query point.

    Args:
        query: (Q, 3) query points [m].
        points: (N, 3) points in the same frame [m].
        radius: maximum distance [m].

    Returns:
        Three arrays: (Q,) index of the point nearest to each query point, -1 without one in the
        radius; (Q,) the distance to that point [m]; and (N,) the distance from each point to the
        nearest query point [m]. Distances are ``radius`` without a neighbor.
    """
    from_query, nearest = cKDTree(points).query(query, distance_upper_bound=radius)
    from_point, _ = cKDTree(query).query(points, distance_upper_bound=radius)
    nearest = np.where(np.isfinite(from_query), nearest, -1)
    return nearest, np.minimum(from_query, radius), np.minimum(from_point, radius)


_MAX_EXTENSION = 0.5
"""Maximum height by which an obstacle that the border of an image truncates is extended vertically
[m]."""
_BORDER_DISTANCE = 1.5 * VOXEL
"""Maximum distance of a point from the border of the image, or from the minimum depth, at which an
obstacle counts as truncated there [m]."""


class ImageRange(NamedTuple):
    """Vertical range of a pinhole camera's image, and the camera's minimum depth: the limits at
    which obstacles may be truncated.

    Attributes:
        fy, cy, height: focal length, principal point and height of the image along its columns
            [pixel].
        near: minimum depth that the camera measures [m].
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
    """Extends the clouds of truncated obstacles vertically by their visible height.

    An obstacle is truncated if its cloud ends at the upper or lower border of an image, or at the
    minimum depth. The extension is at most 0.5 m high (`_MAX_EXTENSION`).

    Args:
        obstacles: observed obstacles.
        cameras: for each camera its pose X_WC (4, 4) (x right, y down, z forward) and image range.
        seen_free: function from points (N, 3) in the world [m] to (N,) booleans, True for a point
            that a camera observes to be free; such points are not added. None: all points are
            added.

    Returns:
        The extended obstacles; `obstacles` itself if none is truncated.
    """
    clouds = []
    for cloud in obstacles.clouds_W:
        extents = [points for X_WC, image in cameras for points in _extents(cloud, X_WC, image)]
        if seen_free is not None:
            extents = [points[~seen_free(points)] for points in extents]
        clouds.append(np.concatenate([cloud, *extents]) if any(map(len, extents)) else cloud)
    if all(one is other for one, other in zip(clouds, obstacles.clouds_W, strict=True)):
        return obstacles
    return replace(obstacles, clouds_W=tuple(clouds))


def _extents(cloud: FloatArray, X_WC: FloatArray, image: ImageRange) -> Iterator[FloatArray]:
    """Yields points (M, 3) in the world [m] that extend a truncated obstacle's cloud vertically.

    There is one array for each limit at which the cloud ends: the upper border of the image, its
    lower border, and the minimum depth of the camera.

    Args:
        cloud: (N, 3) points of the obstacle in the world [m].
        X_WC: (4, 4) pose of the camera in the world.
        image: vertical range and minimum depth of the camera.
    """
    _, y, z = ((cloud - X_WC[:3, 3]) @ X_WC[:3, :3]).T
    # Distances of the points from the upper and lower border at their depth. Each border extends
    # the cloud up or down in the world, whichever its outward direction is closer to.
    top, bottom = y + z * image.cy / image.fy, z * (image.height - image.cy) / image.fy - y
    vertical = np.array([0.0, 0.0, 1.0])
    up = vertical * math.copysign(1.0, -X_WC[2, 1])
    nearer = vertical * math.copysign(1.0, -X_WC[2, 2])
    for gap, direction in ((top, up), (bottom, -up), (z - image.near, nearer)):
        border_points = cloud[(np.abs(gap) <= _BORDER_DISTANCE) & (z > 0.0)]
        if not len(border_points):
            continue
        along = cloud @ direction
        length = min(float(np.ptp(along)), _MAX_EXTENSION)
        steps = VOXEL * np.arange(1, 1 + math.floor(length / VOXEL))
        yield (border_points[:, None] + steps[:, None] * direction).reshape(-1, 3)
