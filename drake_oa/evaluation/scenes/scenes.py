"""Many obstacle-avoidance scenes as one struct of arrays.

Each is in the local frame L of its motion, which is the world frame: the start at rest
in the origin, the goal at (baseline, 0, 0), z up. The demonstration is a straight
minimum-jerk motion of `DURATION`. The tool is a point: obstacles are dilated already.
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
"""Demonstrated duration T [s]."""


@dataclass(frozen=True, eq=False)
class Batch(Frozen):
    """Arrays with a row for each of N items."""

    def rows(self, index: ArrayLike | slice) -> Self:
        """Returns some of the items, by indices, a mask or a slice."""
        chosen = index if isinstance(index, slice) else np.asarray(index)
        return type(self)(*(getattr(self, item.name)[chosen] for item in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Returns several batches as one."""
        columns = ([getattr(part, item.name) for part in parts] for item in fields(cls))
        return cls(*(np.concatenate(column) for column in columns))


@dataclass(frozen=True, eq=False)
class Scenes(Batch):
    """N scenes of an ellipsoid at rest each.

    Attributes:
        baseline: (N,) distance from start to goal [m].
        center: (N, 3) centers [m].
        semi_axes: (N, 3) semi-axes [m].
        R: (N, 3, 3) rotations; the columns are the principal axes.
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
        """(N, 3) goals [m]."""
        return self.baseline[:, None] * (1.0, 0.0, 0.0)


def make_scenes(
    baseline: float,
    center: ArrayLike,
    semi_axes: ArrayLike,
    *,
    R: FloatArray | None = None,
    clearance: float = 0.15,
) -> Scenes:
    """Makes scenes of one baseline [m] and clearance [m].

    Args:
        baseline: [m].
        center: (N, 3) [m].
        semi_axes: (N, 3) [m].
        R: (N, 3, 3); None: axis-aligned.
        clearance: Delta [m].
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
    """Computes signed distances (N,) of a point (N, 3) in each scene to its obstacle [m]."""
    return signed_distance(points, scenes.center, scenes.R, scenes.semi_axes)


@dataclass(frozen=True)
class Setting:
    """Variant of a method in the paper's experiments.

    Attributes:
        label: name in the paper's notation.
        constrained: RC(lambda', Delta), else RC(lambda'), which asks for no clearance:
            that of the scenes is then 0.
        scale_time: tau = length of the avoiding path over that of the planned one, else
            tau = 1.
        clearance: Delta requested in every scene [m]; None: that of the scenes.
    """

    label: str = "RC(lambda',Delta)"
    constrained: bool = True
    scale_time: bool = True
    clearance: float | None = None

    def of(self, scenes: Scenes) -> Scenes:
        """Returns the scenes with the requested clearance."""
        if self.clearance is None:
            return scenes
        return replace(scenes, clearance=np.full(len(scenes), self.clearance))


class Motions(NamedTuple):
    """N motions at S + 1 equally spaced instants from t = 0 to their duration.

    Attributes:
        path: (N, S + 1, 3) positions [m].
        velocity: (N, S + 1, 3) velocities dp/dt at those instants [m/s].
        duration: (N,) tau T, the end of the scaled duration [s].
    """

    path: FloatArray
    velocity: FloatArray
    duration: FloatArray
