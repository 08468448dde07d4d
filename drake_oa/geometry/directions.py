"""Directions in space, and velocities that change no faster than they may."""

from __future__ import annotations

import numpy as np

from drake_oa.common.messages import FloatArray


def _directions() -> FloatArray:
    """(26, 3) unit vectors to the faces, edges and corners of a cube."""
    grid = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij")).reshape(3, -1).T
    grid = grid[np.any(grid != 0.0, axis=1)]
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))


DIRECTIONS = _directions()
"""(26, 3) unit vectors to the faces, edges and corners of a cube."""


def ramped(velocity: FloatArray, wanted: FloatArray, most: float) -> FloatArray:
    """(m,) a velocity on its way to the wanted one, changed by a norm of `most` or less."""
    change = wanted - velocity
    size = float(np.linalg.norm(change))
    return np.array(wanted if size <= most else velocity + change * (most / size))
