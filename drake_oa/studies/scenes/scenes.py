"""Many obstacle-avoidance scenes as one struct of arrays.

Each is in the local frame L of its motion, which is the world frame: the start at rest
in the origin, the goal at (baseline, 0, 0), z up. The demonstration is a straight
minimum-jerk motion of `DURATION`. The tool is a point: obstacles are dilated already.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import BoolArray, FloatArray, Frozen

DURATION = 3.0
"""Demonstrated duration T [s]."""


@dataclass(frozen=True, eq=False)
class Scenes(Frozen):
    """N scenes of up to M ellipsoids; rows of absent obstacles are NaN.

    Attributes:
        baseline: (N,) distance from start to goal [m].
        center: (N, M, 3) centres at t = 0 [m].
        semi_axes: (N, M, 3) semi-axes [m].
        R: (N, M, 3, 3) rotations; the columns are the principal axes.
        velocity: (N, M, 3) constant velocities of the centres [m/s].
        clearance: (N,) clearance Delta asked for [m].
    """

    baseline: FloatArray
    center: FloatArray
    semi_axes: FloatArray
    R: FloatArray
    velocity: FloatArray
    clearance: FloatArray

    def __len__(self) -> int:
        return len(self.baseline)

    @property
    def present(self) -> BoolArray:
        """(N, M) which obstacles there are."""
        return ~np.isnan(self.center[..., 0])

    @property
    def goal(self) -> FloatArray:
        """(N, 3) goals [m]."""
        goal = np.zeros((len(self), 3))
        goal[:, 0] = self.baseline
        return goal

    def rows(self, index: ArrayLike | slice) -> Scenes:
        """Some of the scenes, by indices, a mask or a slice."""
        chosen = index if isinstance(index, slice) else np.asarray(index)
        return Scenes(*(getattr(self, item.name)[chosen] for item in fields(self)))


def single_obstacle(
    baseline: ArrayLike,
    center: ArrayLike,
    semi_axes: ArrayLike,
    *,
    R: ArrayLike | None = None,
    velocity: ArrayLike | None = None,
    clearance: float = 0.15,
) -> Scenes:
    """Scenes of one ellipsoid each.

    Args:
        baseline: () or (N,) [m].
        center: (N, 3) [m].
        semi_axes: (N, 3) [m].
        R: (N, 3, 3); None: axis-aligned.
        velocity: (N, 3) [m/s]; None: at rest.
        clearance: Delta [m].

    Returns:
        N scenes with M = 1.
    """
    center = np.asarray(center, dtype=float)
    N = len(center)
    turned = np.eye(3) if R is None else np.asarray(R, dtype=float)
    moving = np.zeros(3) if velocity is None else np.asarray(velocity, dtype=float)
    return Scenes(
        baseline=np.broadcast_to(np.asarray(baseline, dtype=float), (N,)).copy(),
        center=center[:, None, :].copy(),
        semi_axes=np.asarray(semi_axes, dtype=float)[:, None, :].copy(),
        R=np.broadcast_to(turned, (N, 3, 3))[:, None].copy(),
        velocity=np.broadcast_to(moving, (N, 3))[:, None].copy(),
        clearance=np.full(N, float(clearance)),
    )
