"""Many obstacle-avoidance scenes as one struct of arrays.

Each is in the local frame L of its motion, which is the world frame: the start at rest
in the origin, the goal at (baseline, 0, 0), z up. The demonstration is a straight
minimum-jerk motion of `DURATION`. The tool is a point: obstacles are dilated already.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import BoolArray, EllipsoidSet, FloatArray, Frozen
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.rollout import Scene

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
        """Returns several batches as one; without any, empty rows (0,)."""
        columns = ([getattr(part, item.name) for part in parts] for item in fields(cls))
        return cls(*(np.concatenate(column) if column else np.zeros(0) for column in columns))


@dataclass(frozen=True, eq=False)
class Scenes(Batch):
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


def posed_scenes(scenes: Scenes, clearance: FloatArray | float) -> list[Scene]:
    """Returns the scenes as roll-outs take them: at rest at the start, L = W.

    Args:
        scenes: N scenes.
        clearance: () or (N,) requested from every obstacle [m].
    """
    posed = []
    for row, asked in enumerate(np.broadcast_to(clearance, (len(scenes),))):
        there = scenes.present[row]
        seen = EllipsoidSet(
            stamp=0.0,
            p_WO=scenes.center[row, there],
            R_WO=scenes.R[row, there],
            semi_axes=scenes.semi_axes[row, there],
            v_WO=scenes.velocity[row, there],
            ids=np.flatnonzero(there),
        )
        posed.append(
            Scene(
                p_WE=np.zeros(3),
                z_W=np.zeros(3),
                p_WG=scenes.goal[row],
                R_WL=np.eye(3),
                baseline=float(scenes.baseline[row]),
                ellipsoids=seen,
                clearance=np.full(len(seen), asked),
            )
        )
    return posed


def scene_distance(scenes: Scenes, points: FloatArray, time: FloatArray) -> FloatArray:
    """Signed distance of a point (N, 3) a scene to its nearest obstacle at a time (N,).

    Returns:
        (N,) [m]; inf without obstacles.
    """
    center = scenes.center + time[:, None, None] * scenes.velocity
    distance = np.full(center.shape[:2], np.inf)
    there = scenes.present
    p = np.broadcast_to(points[:, None, :], center.shape)
    if there.any():
        distance[there] = signed_distance(
            p[there], center[there], scenes.R[there], scenes.semi_axes[there]
        )
    return distance.min(axis=1, initial=np.inf)


@dataclass(frozen=True)
class Setting:
    """How the paper's experiments on familiar scenarios vary the method.

    Attributes:
        constrained: RC(lambda', Delta), else RC(lambda'), which asks for no clearance:
            that of the scenes is then 0.
        scale_time: tau = length of the avoiding path over that of the planned one, else
            tau = 1.
    """

    constrained: bool = True
    scale_time: bool = True


@dataclass(frozen=True, eq=False)
class Motions(Frozen):
    """N motions at S + 1 equally spaced instants from t = 0 to their duration.

    Attributes:
        path: (N, S + 1, 3) positions [m].
        velocity: (N, S + 1, 3) velocities dp/dt at those instants [m/s].
        duration: (N,) tau T, the end of the scaled duration [s].
        seconds: computing time of the whole batch [s], regulation included,
            compilation excluded.
    """

    path: FloatArray
    velocity: FloatArray
    duration: FloatArray
    seconds: float

    def __len__(self) -> int:
        return len(self.path)

    @property
    def steps(self) -> int:
        """Steps of each motion."""
        return self.path.shape[1] - 1
