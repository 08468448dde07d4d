"""Directions in space, and velocities that change no faster than they may."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import FloatArray


def lattice(*axes: ArrayLike) -> FloatArray:
    """Makes the points (N, 3) of a lattice from its coordinates along each axis."""
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _directions() -> FloatArray:
    """(26, 3) unit vectors to the faces, edges and corners of a cube."""
    grid = lattice(*[[-1.0, 0.0, 1.0]] * 3)
    grid = grid[np.any(grid != 0.0, axis=1)]
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))


DIRECTIONS = _directions()
"""(26, 3) unit vectors to the faces, edges and corners of a cube."""
