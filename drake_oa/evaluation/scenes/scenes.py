"""Synthetic obstacle-avoidance scenes and motions as structs of arrays.

World and local frame L of a motion are the same: the motion starts at rest in the origin, the goal
is at (baseline, 0, 0), and z points up. Baseline is the distance from start to goal. The
demonstration is a straight minimum-jerk motion of `DURATION`. The tool is a point, because the
obstacles are already dilated by the tool.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.geometry.ellipsoid import signed_distance

DURATION = 3.0
"""Duration T of the demonstrated motion in all synthetic scenes [s]."""


@dataclass(frozen=True, eq=False)
class Batch(Frozen):
    """Base class of dataclasses whose fields are arrays with one row for each of N items."""

    def rows(self, index: ArrayLike | slice) -> Self:
        """Returns a batch of selected items.

        Args:
            index: index array, boolean mask or slice of the items.
        """
        selection = index if isinstance(index, slice) else np.asarray(index)
        return type(self)(*(getattr(self, item.name)[selection] for item in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Concatenates several batches of the same class to one batch."""
        columns = ([getattr(part, item.name) for part in parts] for item in fields(cls))
        return cls(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True, eq=False)
class Scenes(Batch):
    """Batch of N synthetic scenes, each with a start at the origin, a goal and a resting ellipsoid.

    Positions and axes are in the frame of the motion: x points from start to goal, z up.

    Attributes:
        baseline: (N,) distance from start to goal [m].
        center: (N, 3) centers of the ellipsoids [m].
        semi_axes: (N, 3) semi-axes of the ellipsoids [m].
        R: (N, 3, 3) rotations of the ellipsoids, whose columns are the principal axes.
        clearance: (N,) requested clearance Delta [m].
    """

    baseline: FloatArray
    center: FloatArray
    semi_axes: FloatArray
    R: FloatArray
    clearance: FloatArray

    def __len__(self) -> int:
        return len(self.baseline)

    @property
    def goal(self) -> FloatArray:
        """Goal positions (N, 3), at the distance `baseline` from the origin along x [m]."""
        return self.baseline[:, None] * (1.0, 0.0, 0.0)


def make_scenes(
    baseline: float,
    center: ArrayLike,
    semi_axes: ArrayLike,
    *,
    R: FloatArray | None = None,
    clearance: float = 0.15,
) -> Scenes:
    """Makes N scenes with equal distance from start to goal and equal requested clearance.

    Positions and axes are in the frame of the motion: origin at the start, x toward the goal, z up.

    Args:
        baseline: distance from start to goal [m].
        center: (N, 3) centers of the ellipsoids [m].
        semi_axes: (N, 3) semi-axes of the ellipsoids [m].
        R: (N, 3, 3) rotations of the ellipsoids; None: axis-aligned.
        clearance: requested clearance Delta [m].
    """
    center = np.array(center, dtype=float)
    count = len(center)
    return Scenes(
        np.full(count, float(baseline)),
        center,
        np.array(semi_axes, dtype=float),
        np.tile(np.eye(3), (count, 1, 1)) if R is None else R,
        np.full(count, float(clearance)),
    )


def obstacle_distance(scenes: Scenes, points: FloatArray) -> FloatArray:
    """Computes the signed distance of one point per scene to the scene's obstacle.

    Args:
        scenes: N scenes.
        points: (N, 3) points, relative to the start, with x toward the goal and z up [m].

    Returns:
        (N,) distances, negative inside the obstacle [m].
    """
    return signed_distance(points, scenes.center, scenes.R, scenes.semi_axes)


@dataclass(frozen=True)
class Setting:
    """Setting in which an avoidance method is run, as in the experiments of Pairet et al.

    Attributes:
        label: name in the paper's notation, for example "RC(lambda',Delta)".
        constrained: whether a clearance Delta is requested. The paper's method then uses the
            regressor chain RC(lambda', Delta), else RC(lambda'). A chain predicts the parameters of
            the coupling term from the semi-axes lambda' of the obstacle's section.
        scale_time: whether the temporal scaling tau is the avoiding path's length over the nominal
            path's length; else tau = 1.
        clearance: requested clearance Delta in every scene [m]; None: the clearances of the scenes.
    """

    label: str = "RC(lambda',Delta)"
    constrained: bool = True
    scale_time: bool = True
    clearance: float | None = None

    def of(self, scenes: Scenes) -> Scenes:
        """Returns a copy of scenes with the requested clearance of this setting, if it has one."""
        if self.clearance is None:
            return scenes
        return replace(scenes, clearance=np.full(len(scenes), self.clearance))


class Motions(NamedTuple):
    """Motions in N scenes, each sampled at S + 1 equally spaced instants from 0 to its duration.

    Attributes:
        path: (N, S + 1, 3) positions, relative to the start, with x toward the goal and z up [m].
        velocity: (N, S + 1, 3) velocities [m/s].
        duration: (N,) durations of the sampled motions [s].
    """

    path: FloatArray
    velocity: FloatArray
    duration: FloatArray
