"""Evaluation of motions in synthetic scenes on ground truth, independent of the methods' kernels.

A motion is interpolated from its positions and velocities by cubic Hermite splines and sampled
densely, with refinement around the sample nearest to the obstacle. Only the exact distance to an
ellipsoid (`drake_oa.geometry.ellipsoid`) is shared with the methods.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.evaluation.scenes.scenes import Batch, Motions, Scenes, obstacle_distance
from drake_oa.geometry.ellipsoid import signed_distance

SUBSTEPS = 4
"""Number of intervals into which the interval between two sampled positions of a motion is divided.

The distance to the obstacle is computed at the ends of these intervals."""
_REFINEMENTS = 3
"""Number of successive refinements around the sample of a motion nearest to the obstacle.

A refinement samples the motion more densely between the two neighbors of this sample."""
_REFINEMENT_SAMPLES = 33
"""Number of samples of the obstacle's distance in one refinement around the nearest sample."""

SLACK = 1e-3
"""Tolerance by which a motion's clearance may be below the achievable one without shortfall [m]."""


@dataclass(frozen=True, eq=False)
class GroundTruthResult(Batch):
    """Ground-truth metrics of N motions of a point, each past one obstacle.

    Attributes:
        min_clearance: (N,) minimum signed distance to the obstacle during the motion, negative
            inside it [m].
        achievable_clearance: (N,) minimum of the requested clearance Delta and the obstacle's
            distances from start and goal [m].
        goal_error: (N,) distance to the goal at the end of the motion [m].
        path_ratio: (N,) path length over the distance from start to goal [-].
        baseline: (N,) distance from start to goal [m].
        requested: (N,) requested clearance Delta [m].
    """

    min_clearance: FloatArray
    achievable_clearance: FloatArray
    goal_error: FloatArray
    path_ratio: FloatArray
    baseline: FloatArray
    requested: FloatArray

    def __len__(self) -> int:
        return len(self.min_clearance)

    @property
    def collided(self) -> BoolArray:
        """Boolean mask (N,) of the motions that touch their obstacle."""
        return self.min_clearance <= 0.0

    @property
    def is_short(self) -> BoolArray:
        """Boolean mask (N,) of motions with a clearance more than 1 mm below the achievable one."""
        return self.min_clearance < self.achievable_clearance - SLACK


def evaluate_motions(scenes: Scenes, motions: Motions) -> GroundTruthResult:
    """Computes ground-truth metrics of one motion per scene, from densely sampled splines.

    Args:
        scenes: N scenes.
        motions: N motions.
    """
    clearance, length = np.transpose([_measure(scenes, motions, n) for n in range(len(scenes))])
    goal = scenes.goal
    ends = [obstacle_distance(scenes, end) for end in (0.0 * goal, goal)]
    return GroundTruthResult(
        min_clearance=clearance,
        achievable_clearance=np.min([scenes.clearance, *ends], axis=0),
        goal_error=np.linalg.norm(motions.path[:, -1] - goal, axis=1),
        path_ratio=length / scenes.baseline,
        baseline=scenes.baseline,
        requested=scenes.clearance,
    )


def _measure(scenes: Scenes, motions: Motions, row: int) -> tuple[float, float]:
    """Computes the clearance and the path length of one motion from a cubic Hermite spline.

    Args:
        scenes: N scenes.
        motions: N motions.
        row: index of the motion and its scene.

    Returns:
        Minimum signed distance to the obstacle [m], and length of the path [m].
    """
    steps = motions.path.shape[1]
    knots = np.linspace(0.0, motions.duration[row], steps)
    curve = CubicHermiteSpline(knots, motions.path[row], motions.velocity[row])
    body = scenes.center[row], scenes.R[row], scenes.semi_axes[row]
    t = np.linspace(0.0, knots[-1], (steps - 1) * SUBSTEPS + 1)
    points = curve(t)
    sampled = signed_distance(points, *body)
    for _ in range(_REFINEMENTS):
        nearest = int(np.argmin(sampled))
        ends = t[max(nearest - 1, 0)], t[min(nearest + 1, len(t) - 1)]
        t = np.linspace(*ends, _REFINEMENT_SAMPLES)
        sampled = signed_distance(curve(t), *body)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    return float(sampled.min()), float(length)
