"""Colors of the viewer's objects, and triangle meshes of cost rings (costs of passing an obstacle
on each side).

The functions depend on arrays only; `drake_oa.viewing.meshcat_overlay` sends their results to
Meshcat.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_oa.common.messages import FloatArray

Color = tuple[float, float, float]
"""Type of a color in the viewer: red, green and blue, each in [0, 1]."""

NOMINAL: Color = (0.0, 128 / 255, 1.0)
"""Color of the nominal path in the viewer: blue."""
EXECUTED: Color = (0.90, 0.07, 0.09)
"""Color of the executed path in the viewer: red."""
ELLIPSOID: Color = (0.93, 0.36, 0.52)
"""Color of the ellipsoids around obstacles in the viewer: rose."""
SELECTED: Color = (0.86, 0.0, 0.78)
"""Color of the line in the viewer that points in the direction in which an obstacle is passed:
magenta."""
CLOUD: Color = (0.0, 0.42, 0.45)
"""Color of the observed point cloud in the viewer: teal."""
COST_COLORS: tuple[Color, ...] = ((0.10, 0.62, 0.28), (0.98, 0.82, 0.18), (0.80, 0.10, 0.12))
"""Colors of the costs 0, 0.5 and 1 on a cost ring, which displays the costs of passing an obstacle
on each side: green, yellow, red."""

INNER_RADIUS, BAND, GAP = 0.17, 0.022, 0.005
"""Dimensions of the drawn cost rings (costs of passing an obstacle on each side): inner radius of
the innermost ring, width of each ring, and gap between rings and between sectors [m]."""


def ring_mesh(
    costs: Mapping[str, ArrayLike], angles: ArrayLike
) -> tuple[FloatArray, NDArray[np.int32], FloatArray]:
    """Computes a triangle mesh of the cost rings of one obstacle, as concentric colored bands.

    A cost ring displays the costs of passing the obstacle in each direction around the baseline,
    the line from start to goal. The bands are centered at the origin of the local frame (x from
    start to goal, z up), in its YZ plane. They are in the order of `costs` from the inside out.
    Each band is divided into K sectors, each with the color of its cost on the scale `COST_COLORS`.

    Args:
        costs: cost (K,) in [0, 1] of each direction, by name of the ring; at least one ring.
        angles: (K,) evenly spaced directions as angles in the YZ plane [rad]: 0 along y, pi/2 along
            z.

    Returns:
        (3, n) vertices [m]; (3, m) vertex indices of the triangles; (3, n) colors of the vertices
        in linear RGB, whereas other colors of Meshcat are in sRGB.
    """
    middle = np.asarray(angles, dtype=float)
    inside = INNER_RADIUS + np.arange(len(costs))[:, None] * (BAND + GAP)
    half = np.pi / len(middle) - 0.25 * GAP / inside
    # Each sector has two quadrangles, so that rings of few sectors still look circular.
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
