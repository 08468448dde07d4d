"""Unit vectors in evenly distributed directions, and lattices of points, which other modules use as
samples.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import FloatArray


def lattice(*axes: ArrayLike) -> FloatArray:
    """Returns all N points (N, n) of a rectangular lattice in n dimensions, from n arrays of its
    coordinates along each axis.
    """
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def sphere_points(count: int) -> FloatArray:
    """Returns points (count + 6, 3) on the unit sphere: 6 on the coordinate axes, then `count` on a
    Fibonacci spiral.
    """
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    radius, angle = np.sqrt(1.0 - z * z), np.pi * (3.0 - np.sqrt(5.0)) * k
    spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return np.concatenate([np.eye(3), -np.eye(3), spiral])


_GRID = np.delete(lattice(*[[-1.0, 0.0, 1.0]] * 3), 13, axis=0)
"""Points (26, 3) with coordinates -1, 0 and 1 along each axis, without the origin, from which
`DIRECTIONS` is computed."""
DIRECTIONS = _GRID / np.linalg.norm(_GRID, axis=1, keepdims=True)
"""Unit vectors (26, 3) from the center of a cube to the centers of its 6 faces and 12 edges, and to
its 8 corners."""
