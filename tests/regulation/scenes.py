"""Random scenes of the roll-outs in space."""

import numpy as np
from scipy.spatial.transform import Rotation

from drake_oa.regulation.rollout import SpatialScenes


def random_scenes(
    seed: int, M: int, speed: float = 0.0, *, count: int = 6, size: float = 1.0, pace: float = 0.05
) -> SpatialScenes:
    """Random frames, goals and flat ellipsoids about the baselines, some hit, some grazed."""
    rng = np.random.default_rng(seed)
    L = size * rng.uniform(0.5, 2.0, count)
    R_WL = Rotation.random(count, random_state=seed).as_matrix()
    start = size * rng.normal(size=(count, 3))
    along, across = rng.uniform(0.25, 0.75, (count, M)), rng.normal(0.0, 0.08, (2, count, M))
    place = L[:, None, None] * np.stack([along, *across], axis=2)
    center = start[:, None] + np.einsum("sij,smj->smi", R_WL, place)
    if M > 1:
        center[rng.random((count, M)) < 0.2] = np.nan
    R_WO = Rotation.random(count * M, random_state=seed).as_matrix()
    return SpatialScenes(
        p_WE=start,
        z_W=pace * rng.normal(size=(count, 3)),
        p_WG=start + L[:, None] * R_WL[:, :, 0],
        R_WL=R_WL,
        baseline=L,
        p_WO=center,
        R_WO=R_WO.reshape(count, M, 3, 3),
        semi_axes=size * rng.uniform(0.025, 0.25, (count, M, 3)),
        v_WO=speed * rng.normal(size=(count, M, 3)),
        asked_clearance=np.full((count, M), 0.15 * size),
    )
