"""Share of the space near an arm that depth cameras do not measure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.geometry.pinhole import pixel_at

REACH = 0.4
"""Maximum distance of the space from the surface of the arm [m]."""
HEIGHT = 0.75
"""Maximum height of the space above the table, where there is one [m]."""
_PITCH = 0.08
"""Distance between the points of the space [m]."""


class ViewVolume(NamedTuple):
    """Volume in which a depth camera measures.

    Attributes:
        X_WC: (4, 4) pose of the camera (x right, y down, z forward).
        K: (4,) fx, fy, cx, cy [pixel].
        shape: rows and columns of the image.
        near: minimum depth [m].
        far: maximum depth [m].
    """

    X_WC: FloatArray
    K: FloatArray
    shape: tuple[int, int]
    near: float
    far: float


def unseen_share(
    p_WS: FloatArray,
    radius: FloatArray,
    points: Sequence[FloatArray],
    views: Sequence[ViewVolume],
) -> float:
    """Computes the share of the space near an arm that none of some cameras sees.

    A camera does not see a point outside its image or its range of depths, nor one that the arm
    hides.

    Args:
        p_WS: (T, S, 3) centers of the arm's spheres in T configurations [m].
        radius: (S,) radii of the spheres [m].
        points: (N, 3) points of the space near each configuration, see `points_near` [m].
        views: of the cameras.

    Returns:
        Mean over the configurations, in [0, 1]: 1 without a camera.
    """
    shares = []
    for centers, near in zip(p_WS, points, strict=True):
        seen = np.zeros(len(near), dtype=bool)
        for view in views:
            seen |= _sees(view, near, centers, radius)
        shares.append(np.mean(~seen))
    return float(np.mean(shares))


def points_near(
    p_WS: FloatArray, radius: FloatArray, table_height: float | None
) -> list[FloatArray]:
    """Lists the points (N, 3) of a grid near each of T configurations of an arm [m].

    They are within `REACH` of the arm, above the table and below `HEIGHT`.

    Args:
        p_WS: (T, S, 3) centers of the arm's spheres [m].
        radius: (S,) radii of the spheres [m].
        table_height: height of the table in the world [m]; None: there is none.
    """
    found = []
    for centers in p_WS:
        low = (centers - radius[:, None]).min(axis=0) - REACH
        high = (centers + radius[:, None]).max(axis=0) + REACH
        if table_height is not None:
            low[2], high[2] = max(low[2], table_height), min(high[2], table_height + HEIGHT)
        axes = [np.arange(a + 0.5 * _PITCH, b, _PITCH) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        distance = (cdist(grid, centers) - radius).min(axis=1)
        found.append(grid[(distance > 0.0) & (distance < REACH)])
    return found


def _sees(view: ViewVolume, points: FloatArray, p_WS: FloatArray, radius: FloatArray) -> BoolArray:
    """Computes for points (N, 3) whether a camera sees them past spheres p_WS (S, 3)."""
    R_WC, p_WC = view.X_WC[:3, :3], view.X_WC[:3, 3]
    p_CQ = (points - p_WC) @ R_WC
    seen = pixel_at(p_CQ, view.shape, view.K) >= 0
    seen &= (p_CQ[:, 2] >= view.near) & (p_CQ[:, 2] <= view.far)
    # Distance of each sphere's center from the ray between camera and point.
    ray, sphere = points[seen] - p_WC, p_WS - p_WC
    along = ray @ sphere.T
    squared = (ray**2).sum(axis=1)[:, None]
    share = np.clip(along / squared, 0.0, 1.0)
    apart = (sphere**2).sum(axis=1) - share * (2.0 * along - share * squared)
    seen[seen] = (apart >= radius**2).all(axis=1)
    return seen
