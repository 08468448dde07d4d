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


def _directions() -> FloatArray:
    """(26, 3) unit vectors to the faces, edges and corners of a cube."""
    grid = lattice(*[[-1.0, 0.0, 1.0]] * 3)
    grid = grid[np.any(grid != 0.0, axis=1)]
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))


DIRECTIONS = _directions()
"""(26, 3) unit vectors to the faces, edges and corners of a cube."""
