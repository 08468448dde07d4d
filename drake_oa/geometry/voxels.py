"""Clouds of points thinned out to one a voxel."""

from __future__ import annotations

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.clusters import voxel_keys

VOXEL = 0.02
"""Edge of the voxels that points are thinned to [m]."""


def thinned(cloud: FloatArray) -> FloatArray:
    """One point of each voxel of 2 cm of a cloud (N, 3) [m]."""
    if len(cloud) < 2:
        return np.array(cloud, dtype=float)
    _, first = np.unique(voxel_keys(cloud, VOXEL), return_index=True)
    return np.asarray(cloud[np.sort(first)], dtype=float)
