"""Synthetic obstacle-avoidance scenes and motions as structs of arrays.

World and local frame L of a motion are the same: the motion starts at rest in the origin, the goal
is at (baseline, 0, 0), and z points up. The demonstration is a straight minimum-jerk motion of
`DURATION`. The tool is a point, as obstacles are already dilated.
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
"""Duration T of the demonstrated motion [s]."""


@dataclass(frozen=True, eq=False)
class Batch(Frozen):
    """Struct of arrays with one row per item, for N items."""

    def rows(self, index: ArrayLike | slice) -> Self:
        """Returns the items at an index array, mask or slice."""
        selection = index if isinstance(index, slice) else np.asarray(index)
        return type(self)(*(getattr(self, item.name)[selection] for item in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Concatenates several batches."""
        columns = ([getattr(part, item.name) for part in parts] for item in fields(cls))
        return cls(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True, eq=False)
class Scenes(Batch):
    """Batch of N scenes, each with one resting ellipsoid.

    Attributes:
        baseline: (N,) distance from start to goal [m].
        center: (N, 3) centers of the ellipsoids [m].
        semi_axes: (N, 3) semi-axes of the ellipsoids [m].
        R: (N, 3, 3) rotations, whose columns are the principal axes.
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
        """Goal positions (N, 3) [m]."""
        return self.baseline[:, None] * (1.0, 0.0, 0.0)


def make_scenes(
    baseline: float,
    center: ArrayLike,
    semi_axes: ArrayLike,
    *,
    R: FloatArray | None = None,
    clearance: float = 0.15,
) -> Scenes:
    """Makes N scenes with the same baseline and requested clearance.

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
    """Computes signed distances (N,) of one point per scene (N, 3) to the obstacle [m]."""
    return signed_distance(points, scenes.center, scenes.R, scenes.semi_axes)


@dataclass(frozen=True)
class Setting:
    """Setting of a method in the paper's experiments.

    Attributes:
        label: name in the paper's notation.
        constrained: whether the regressor chain is RC(lambda', Delta); else it is RC(lambda'),
            without a requested clearance.
        scale_time: whether the temporal scaling tau is the avoiding path's length over the nominal
            path's length; else tau = 1.
        clearance: requested clearance Delta in every scene [m]; None: that of the scenes.
    """

    label: str = "RC(lambda',Delta)"
    constrained: bool = True
    scale_time: bool = True
    clearance: float | None = None

    def of(self, scenes: Scenes) -> Scenes:
        """Returns the scenes with the requested clearance of this setting."""
        if self.clearance is None:
            return scenes
        return replace(scenes, clearance=np.full(len(scenes), self.clearance))


class Motions(NamedTuple):
    """Batch of N motions, sampled at S + 1 equally spaced instants from t = 0 to their duration.

    Attributes:
        path: (N, S + 1, 3) positions [m].
        velocity: (N, S + 1, 3) velocities [m/s].
        duration: (N,) durations of the sampled motions [s].
    """

    path: FloatArray
    velocity: FloatArray
    duration: FloatArray
