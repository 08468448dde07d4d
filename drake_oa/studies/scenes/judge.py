"""Judges motions by float64 geometry of its own, whatever kernel chose them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, Frozen
from drake_oa.common.numba_tools import kernel_arrays
from drake_oa.geometry.ellipsoid_kernels import feasible_clearance
from drake_oa.studies.scenes.judge_kernels import Bodies, Curves, judge_motions
from drake_oa.studies.scenes.methods import Motions
from drake_oa.studies.scenes.scenes import DURATION, Scenes, scene_distance

SUBSTEPS = 4
"""Samples judged in each interval of a motion."""

SLACK = 1e-3
"""By how much a clearance may be short before it counts as short [m]."""


@dataclass(frozen=True, eq=False)
class Judgement(Frozen):
    """What N motions came to.

    Attributes:
        kept_clearance: (N,) least signed distance to any obstacle over the whole motion,
            negative inside; inf in a scene without obstacles [m].
        feasible: (N,) min(Delta, distance of the start at t = 0, distance of the goal at
            the end of the motion) [m].
        goal_error: (N,) distance to the goal at the end [m].
        path_length: (N,) [m].
        baseline: (N,) distance from start to goal: the planned path's length [m].
        asked: (N,) the clearance Delta asked for [m].
        duration: (N,) how long the motion lasts [s].
        out_of_range: (N,) 1 where the regressor chain was asked outside its trained range.
    """

    kept_clearance: FloatArray
    feasible: FloatArray
    goal_error: FloatArray
    path_length: FloatArray
    baseline: FloatArray
    asked: FloatArray
    duration: FloatArray
    out_of_range: FloatArray

    def __len__(self) -> int:
        return len(self.kept_clearance)

    @property
    def collided(self) -> BoolArray:
        """(N,) whether an obstacle was touched."""
        return self.kept_clearance <= 0.0

    @property
    def short(self) -> BoolArray:
        """(N,) whether the clearance is more than `SLACK` short of the feasible one."""
        return self.kept_clearance < self.feasible - SLACK

    @property
    def path_ratio(self) -> FloatArray:
        """(N,) length of the path over that of the planned one."""
        return self.path_length / self.baseline

    @property
    def arrival(self) -> FloatArray:
        """(N,) duration over tau T, tau = path ratio, at least 1."""
        return self.duration / (DURATION * np.maximum(self.path_ratio, 1.0))

    def rows(self, index: BoolArray | slice) -> Judgement:
        """Some of the motions, by a mask or a slice."""
        return Judgement(*(getattr(self, item.name)[index] for item in fields(self)))


def joined(parts: Sequence[Judgement]) -> Judgement:
    """Several batches as one; an empty one for none."""
    columns = [
        np.concatenate([np.zeros(0), *(getattr(part, item.name) for part in parts)])
        for item in fields(Judgement)
    ]
    return Judgement(*columns)


def judge(scenes: Scenes, motions: Motions, substeps: int = SUBSTEPS) -> Judgement:
    """Judges one motion a scene.

    The path is a cubic Hermite interpolant of positions and velocities, looked at
    `substeps` times an interval, and to convergence round the nearest of these samples.

    Args:
        scenes: N scenes.
        motions: N motions.
        substeps: samples an interval, at least 1.

    Returns:
        The judgement.

    Raises:
        ValueError: if shapes disagree, or a motion is not finite or has no duration.
    """
    N = len(scenes)
    _check(motions, N)
    if substeps < 1:
        raise ValueError(f"substeps must be at least 1, not {substeps}")
    out = np.empty((N, 2))
    judge_motions(
        Curves(*kernel_arrays(motions.path, motions.velocity, motions.duration / motions.steps)),
        Bodies(*kernel_arrays(scenes.center, scenes.R, scenes.semi_axes, scenes.velocity)),
        substeps,
        out,
    )
    goal = scenes.goal
    ends = (
        scene_distance(scenes, np.zeros_like(goal), np.zeros(N)),
        scene_distance(scenes, goal, motions.duration),
    )
    return Judgement(
        kept_clearance=out[:, 0].copy(),
        feasible=feasible_clearance(scenes.clearance, *ends),
        goal_error=np.linalg.norm(motions.path[:, -1] - goal, axis=1),
        path_length=out[:, 1].copy(),
        baseline=np.array(scenes.baseline),
        asked=np.array(scenes.clearance),
        duration=np.array(motions.duration),
        out_of_range=np.zeros(N) if motions.in_range is None else (~motions.in_range).astype(float),
    )


def _check(motions: Motions, count: int) -> None:
    shape = motions.path.shape
    if len(shape) != 3 or shape[0] != count or shape[1] < 2 or shape[2] != 3:
        raise ValueError(f"path must be ({count}, S + 1, 3) with S >= 1, not {shape}")
    if motions.velocity.shape != shape:
        raise ValueError(f"velocity must be {shape} as path is, not {motions.velocity.shape}")
    if motions.duration.shape != (count,):
        raise ValueError(f"duration must be ({count},), not {motions.duration.shape}")
    for name, values in (("path", motions.path), ("velocity", motions.velocity)):
        finite = np.isfinite(values).all(axis=(1, 2))
        if not finite.all():
            row = int(np.argmin(finite))
            raise ValueError(f"{name} must be finite: that of scene {row} is not")
    lasting = np.isfinite(motions.duration) & (motions.duration > 0.0)
    if not lasting.all():
        row = int(np.argmin(lasting))
        raise ValueError(
            f"duration must be positive and finite: scene {row} has {motions.duration[row]} s"
        )
