"""Motions around one ellipse in the plane, rolled out by the running system's engine.

Lengths in baselines, time in units of the demonstration's: the path depends on neither.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, Frozen
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.dmp import ALPHA_X, Dmp, imitate, minimum_jerk
from drake_oa.regulation.rollout import SpatialScenes, spatial_rollouts
from drake_oa.training.released_method import PaperLattice

STEPS = 1000
"""Default number of steps a unit of s; with four times as many a path that converges
keeps 0.4 mm a metre more (median; docs/equations.md)."""


@dataclass(frozen=True, eq=False)
class PlanarRollouts(Frozen):
    """Outcomes of K trajectories in each of N scenes; lengths in baselines.

    Attributes:
        clearance: (N, K) least distance to the ellipse, 0 where it was touched.
        goal_error: (N, K) distance to the goal at the end; inf where it was touched.
    """

    clearance: FloatArray
    goal_error: FloatArray

    @property
    def contact(self) -> BoolArray:
        """(N, K) whether the ellipse was touched (the trajectory ends there)."""
        return np.isinf(self.goal_error)


@lru_cache(maxsize=4)
def straight_dmp(alpha_x: float) -> Dmp:
    """A straight minimum-jerk motion of unit baseline and duration, critically damped."""
    path, t = minimum_jerk(np.zeros(3), (1.0, 0.0, 0.0))
    return imitate(path, t, alpha_x=alpha_x, beta_x=alpha_x / 4.0)


def planar_rollouts(
    extents: FloatArray,
    centers: FloatArray,
    parameters: FloatArray,
    *,
    dmp: Dmp,
    steps: int = STEPS,
) -> PlanarRollouts:
    """Rolls out K trajectories from rest at (0, 0) to (1, 0) in each of N scenes.

    A heading exactly at the centre turns to the left.

    Args:
        extents: (N, 2) semi-axes of the ellipse along and across the baseline, positive.
        centers: (N, 2) its centre.
        parameters: (N, K, 3) alpha, psi, kappa.
        dmp: the primitive, of three dimensions and along the first.
        steps: number of steps a unit of s.

    Returns:
        The outcome of each, its clearance to 1e-4.

    Raises:
        ValueError: as `spatial_rollouts` does.
    """
    N, K, _ = parameters.shape
    terms = np.zeros((N, K, N_COLUMNS))
    terms[:, :, :2] = centers[:, None]
    for column, place in enumerate((ALPHA, PSI, KAPPA)):
        terms[:, :, place] = parameters[:, :, column]
    terms[:, :, NORMAL + 2] = 1.0
    still, eye = np.zeros((N, 3)), np.tile(np.eye(3), (N, 1, 1))
    scenes = SpatialScenes(
        p_WE=still,
        z_W=still,
        p_WG=still + (1.0, 0.0, 0.0),
        R_WL=eye,
        baseline=np.ones(N),
        p_WO=np.column_stack((centers, np.zeros(N)))[:, None],
        R_WO=eye[:, None],
        semi_axes=np.column_stack((extents, extents.max(axis=1)))[:, None],
        v_WO=np.zeros((N, 1, 3)),
        # Nothing is asked: what falls short of that has touched, and ends.
        asked_clearance=np.zeros((N, 1)),
    )
    outcome = spatial_rollouts(
        scenes,
        np.repeat(np.arange(N), K),
        terms.reshape(N * K, N_COLUMNS),
        dmp=dmp,
        steps=steps,
        shortest=0.0,
    )
    touched = outcome.contact
    return PlanarRollouts(
        np.where(touched, 0.0, outcome.kept_clearance).reshape(N, K),
        np.where(touched, np.inf, outcome.goal_error).reshape(N, K),
    )


def running_lattice(lattice: PaperLattice) -> tuple[FloatArray, FloatArray]:
    """Rolls out the motions of a lattice of A, B, C, D and E values, alpha in 1/T.

    Returns:
        (A, B, C, D, E) least distance to the ellipse, 0 where it was touched, and distance to
        the goal at the end, inf where it was touched, in baselines.
    """
    kappa, psi, alpha = np.meshgrid(*lattice[2:], indexing="ij")
    parameters = np.stack([alpha, psi, kappa], axis=-1).reshape(1, -1, 3)
    dmp = straight_dmp(ALPHA_X)
    found = np.empty((2, *map(len, lattice)))
    for i, lambda1 in enumerate(lattice.lambda1):
        for j, lambda2 in enumerate(lattice.lambda2):
            ellipse, center = np.array([[lambda1, lambda2]]), np.array([[0.5, 0.0]])
            outcome = planar_rollouts(ellipse, center, parameters, dmp=dmp)
            found[0, i, j] = outcome.clearance.reshape(alpha.shape)
            found[1, i, j] = outcome.goal_error.reshape(alpha.shape)
    return found[0], found[1]
