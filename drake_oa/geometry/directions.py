"""Directions in space, and lattices of points."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import FloatArray


def lattice(*axes: ArrayLike) -> FloatArray:
    """Makes the points (N, 3) of a lattice from its coordinates along each axis."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def sphere_points(count: int) -> FloatArray:
    """Returns Fibonacci points (count + 6, 3) on the unit sphere, the ends of its axes first."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    radius, angle = np.sqrt(1.0 - z * z), np.pi * (3.0 - np.sqrt(5.0)) * k
    spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return np.concatenate([np.eye(3), -np.eye(3), spiral])


_GRID = np.delete(lattice(*[[-1.0, 0.0, 1.0]] * 3), 13, axis=0)
DIRECTIONS = _GRID / np.linalg.norm(_GRID, axis=1, keepdims=True)
"""(26, 3) unit vectors to the faces, edges and corners of a cube."""
