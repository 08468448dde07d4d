"""Coverage of an arm's workspace by depth cameras: the fraction of the space near the arm that no
camera observes to be free.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.distance import cdist

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.directions import lattice
from drake_oa.perception.depth_perception import FreeSpace

REACH = 0.4
"""Distance from the surface of the arm within which the unobserved fraction of space is computed
[m]."""
HEIGHT = 0.75
"""Height above the table up to which the unobserved fraction of the space near the arm is computed
[m]."""
_PITCH = 0.08
"""Distance between neighboring points of the grid that samples the space near the arm [m]."""


def unobserved_fraction(points: Sequence[FloatArray], observed: Sequence[FreeSpace]) -> float:
    """Computes the fraction of the space near an arm that no camera observes to be free.

    Args:
        points: for each of T configurations of the arm, points (N, 3) in the world that sample the
            space near the arm [m]; `points_near` computes them.
        observed: for each of these configurations a `FreeSpace`: the space that the cameras observe
            to be free while the arm is in this configuration.

    Returns:
        Mean fraction over the configurations, in [0, 1]: 1 without a camera, 0 without a point.
    """
    unobserved = [~space.contains(near) for near, space in zip(points, observed, strict=True)]
    return float(np.mean([one.sum() / max(len(one), 1) for one in unobserved]))


def points_near(
    p_WS: FloatArray, radius: FloatArray, table_height: float | None
) -> list[FloatArray]:
    """Returns grid points (N, 3) in the world [m] that sample the space near an arm, for each of T
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
