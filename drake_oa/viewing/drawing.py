"""Geometry of the pictures in the viewer: cost rings.

Everything here is a function of arrays; `drake_oa.viewing.meshcat_overlay` sends
the results to Meshcat.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_oa.common.messages import FloatArray

Color = tuple[float, float, float]

PLANNED: Color = (0.0, 128 / 255, 1.0)
EXECUTED: Color = (0.90, 0.07, 0.09)
ELLIPSOID: Color = (0.93, 0.36, 0.52)
CHOSEN: Color = (0.86, 0.0, 0.78)
CLOUD: Color = (0.0, 0.42, 0.45)
COST_COLORS: tuple[Color, ...] = ((0.10, 0.62, 0.28), (0.98, 0.82, 0.18), (0.80, 0.10, 0.12))
"""Colors of costs 0, 0.5 and 1 on a ring."""

INNER_RADIUS, BAND, GAP = 0.17, 0.022, 0.005
"""Radius of the innermost cost ring, width of a ring, gap between rings and sectors [m]."""


def ring_mesh(
    costs: Mapping[str, ArrayLike], angles: ArrayLike
) -> tuple[FloatArray, NDArray[np.int32], FloatArray]:
    """Meshes the cost rings of one obstacle as colored bands, one in the other.

    The bands lie in the local YZ-plane about the origin, in the order of `costs`
    from the inside; a sector has the color of its cost on the scale `COST_COLORS`.

    Args:
        costs: name of a ring -> (K,) its cost in [0, 1]; at least one.
        angles: (K,) directions [rad], evenly spread, 0 along y, pi/2 along z.

    Returns:
        (3, n) vertices [m]; (3, m) vertices of each triangle; and (3, n) linear colors of the
        vertices, unlike all others of the viewer.
    """
    middle = np.asarray(angles, dtype=float)
    inside = INNER_RADIUS + np.arange(len(costs))[:, None] * (BAND + GAP)
    half = np.pi / len(middle) - 0.25 * GAP / inside
    # Two quadrangles a sector, so that few sectors still look round.
    sweep = middle[:, None] + half[..., None] * [-1.0, 0.0, 1.0]
    circle = np.stack([0.0 * sweep, np.cos(sweep), np.sin(sweep)], axis=-1)
    radii = np.stack([inside, inside + BAND], axis=1)
    vertices = radii[:, None, None, :] * circle[..., None, :]
    pattern = np.array([[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]], dtype=np.int32)
    first = 6 * np.arange(len(costs) * len(middle), dtype=np.int32)
    faces = (first[:, None, None] + pattern).reshape(-1, 3).T
    cost = np.stack([np.asarray(values, dtype=float) for values in costs.values()]).ravel()
    scale = np.transpose(COST_COLORS)
    color = np.stack([np.interp(cost, (0.0, 0.5, 1.0), part) for part in scale])
    return vertices.reshape(-1, 3).T.copy(), faces.copy(), np.repeat(color**2.2, 6, 1)


def ring_radius(n_rings: int) -> float:
    """Returns the outer radius of `ring_mesh` with that many rings [m]."""
    return INNER_RADIUS + n_rings * (BAND + GAP) - GAP
