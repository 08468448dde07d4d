"""Judges motions by float64 geometry of its own, whatever kernel chose them.

A motion is the cubic Hermite interpolant of its positions and velocities, sampled densely, and
more densely around the sample nearest to an obstacle. Only the exact distance to an ellipsoid is
shared with the rest (`drake_oa.geometry.ellipsoid`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.evaluation.scenes.scenes import Batch, Motions, Scenes, obstacle_distance
from drake_oa.geometry.ellipsoid import signed_distance

SUBSTEPS = 4
"""Samples judged in each interval of a motion."""
_REFINEMENTS, _REFINED = 3, 33
"""Number of times that the neighborhood of the nearest sample is sampled again, and how often."""

SLACK = 1e-3
"""By how much a clearance may be short before it counts as short [m]."""


@dataclass(frozen=True, eq=False)
class GroundTruthResult(Batch):
    """Measures of N motions.

    Attributes:
        min_clearance: (N,) minimum signed distance to the obstacle over the whole motion,
            negative inside [m].
        achievable_clearance: (N,) min(Delta, distance of the start, distance of the goal) [m].
        goal_error: (N,) distance to the goal at the end [m].
        path_ratio: (N,) length of the path over that of the planned one, the baseline.
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
        """(N,) whether an obstacle was touched."""
        return self.min_clearance <= 0.0

    @property
    def is_short(self) -> BoolArray:
        """(N,) whether the clearance is more than `SLACK` short of the feasible one."""
        return self.min_clearance < self.achievable_clearance - SLACK


def evaluate_motions(scenes: Scenes, motions: Motions) -> GroundTruthResult:
    """Judges one motion a scene.

    Args:
        scenes: N scenes.
        motions: N motions.
    """
    least, length = np.transpose([_measured(scenes, motions, n) for n in range(len(scenes))])
    goal = scenes.goal
    ends = [obstacle_distance(scenes, end) for end in (0.0 * goal, goal)]
    return GroundTruthResult(
        min_clearance=least,
        achievable_clearance=np.min([scenes.clearance, *ends], axis=0),
        goal_error=np.linalg.norm(motions.path[:, -1] - goal, axis=1),
        path_ratio=length / scenes.baseline,
        baseline=scenes.baseline,
        requested=scenes.clearance,
    )


def _measured(scenes: Scenes, motions: Motions, row: int) -> tuple[float, float]:
    """Returns the minimum signed distance to the obstacle and the length of one path [m]."""
    steps = motions.path.shape[1]
    knots = np.linspace(0.0, motions.duration[row], steps)
    curve = CubicHermiteSpline(knots, motions.path[row], motions.velocity[row])
    body = scenes.center[row], scenes.R[row], scenes.semi_axes[row]
    t = np.linspace(0.0, knots[-1], (steps - 1) * SUBSTEPS + 1)
    points = curve(t)
    sampled = signed_distance(points, *body)
    for _ in range(_REFINEMENTS):
        nearest = int(np.argmin(sampled))
        t = np.linspace(t[max(nearest - 1, 0)], t[min(nearest + 1, len(t) - 1)], _REFINED)
        sampled = signed_distance(curve(t), *body)
    length = np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
    return float(sampled.min()), float(length)
