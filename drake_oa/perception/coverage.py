"""Coverage of an arm's workspace by depth cameras: the fraction of the space near the arm that no
camera observes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.geometry.directions import lattice
from drake_oa.geometry.pinhole import pixel_at

REACH = 0.4
"""Distance from the surface of the arm within which the unobserved fraction of space is computed
[m]."""
HEIGHT = 0.75
"""Height above the table up to which the unobserved fraction of the space near the arm is computed
[m]."""
_PITCH = 0.08
"""Distance between neighboring points of the grid that samples the space near the arm [m]."""


class ViewVolume(NamedTuple):
    """Volume that a depth camera can observe: the part of its field of view between its minimum and
    maximum depth.

    Attributes:
        X_WC: (4, 4) pose of the camera in the world (x right, y down, z forward).
        K: (4,) intrinsics fx, fy, cx, cy [pixel].
        shape: rows and columns of the image.
        near: minimum depth [m].
        far: maximum depth [m].
    """

    X_WC: FloatArray
    K: FloatArray
    shape: tuple[int, int]
    near: float
    far: float


def unobserved_fraction(
    p_WS: FloatArray, radius: FloatArray, points: Sequence[FloatArray], views: Sequence[ViewVolume]
) -> float:
    """Computes the fraction of the space near an arm that no camera observes.

    A camera does not observe points outside its image or range of depth, or occluded by the arm.

    Args:
        p_WS: (T, S, 3) centers of the arm's spheres in T configurations [m].
        radius: (S,) radii of the spheres [m].
        points: for each of the T configurations, points (N, 3) that sample the space near the arm
            [m]; `points_near` computes them.
        views: view volumes of the cameras.

    Returns:
        Mean fraction over the configurations, in [0, 1]: 1 without a camera, 0 without a point.
    """
    fractions = []
    for centers, near in zip(p_WS, points, strict=True):
        is_observed = np.zeros(len(near), dtype=bool)
        for view in views:
            is_observed |= _is_visible(view, near, centers, radius)
        fractions.append(np.sum(~is_observed) / max(len(near), 1))
    return float(np.mean(fractions))


def points_near(
    p_WS: FloatArray, radius: FloatArray, table_height: float | None
) -> list[FloatArray]:
    """Returns grid points (N, 3) [m] that sample the space near an arm, for each of T
    configurations.

    The points are outside the arm, within `REACH` of its surface, above the table, and at most
    `HEIGHT` above the table.

    Args:
        p_WS: (T, S, 3) centers of the spheres that cover the arm in the world [m].
        radius: (S,) radii of the spheres [m].
        table_height: height of the table in the world [m]; None: no table, and no limit of height.
    """
    points = []
    for centers in p_WS:
        low = (centers - radius[:, None]).min(axis=0) - REACH
        high = (centers + radius[:, None]).max(axis=0) + REACH
        if table_height is not None:
            low[2], high[2] = max(low[2], table_height), min(high[2], table_height + HEIGHT)
        axes = [np.arange(a + 0.5 * _PITCH, b, _PITCH) for a, b in zip(low, high, strict=True)]
        grid = lattice(*axes)
        distance = (cdist(grid, centers) - radius).min(axis=1)
        points.append(grid[(distance > 0.0) & (distance < REACH)])
    return points


def _is_visible(
    view: ViewVolume, points: FloatArray, p_WS: FloatArray, radius: FloatArray
) -> BoolArray:
    """Checks for each point whether a camera observes it, and no sphere of the arm occludes it.

    Args:
        view: view volume of the camera.
        points: (N, 3) points in the world [m].
        p_WS: (S, 3) centers of the arm's spheres [m].
        radius: (S,) radii of the spheres [m].
    """
    R_WC, p_WC = view.X_WC[:3, :3], view.X_WC[:3, 3]
    p_CQ = (points - p_WC) @ R_WC
    is_visible = pixel_at(p_CQ, view.shape, view.K) >= 0
    is_visible &= (p_CQ[:, 2] >= view.near) & (p_CQ[:, 2] <= view.far)
    # Squared distance of each sphere's center from the line segment from camera to point.
    ray, sphere = points[is_visible] - p_WC, p_WS - p_WC
    along = ray @ sphere.T
    squared = (ray**2).sum(axis=1)[:, None]
    fraction = np.clip(along / squared, 0.0, 1.0)
    distance = (sphere**2).sum(axis=1) - fraction * (2.0 * along - fraction * squared)
    is_visible[is_visible] = (distance >= radius**2).all(axis=1)
    return is_visible
