"""What a camera does not see: the far side of a thing, and what is below its top.

A thing is taken to be as deep as it is broad, up to a bound. What is not finite stays as it is:
who watches the links says so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, EventStatus, LeafSystem, State

from drake_oa.common.messages import FloatArray, Frozen, ObstacleClouds
from drake_oa.common.ports import read_value, valid_period
from drake_oa.geometry.voxels import VOXEL, first_in_voxels, thinned

_DEEPEST = 0.08
"""A thing that is seen from one side is taken to be at most so deep [m]."""
_DEEPEST_MOVED = 0.15
"""The same of what has moved [m]: it stands free, and no link has to pass close behind it."""
_TOO_NEAR = 0.05
"""A viewpoint so near above a thing says nothing of its depth [m]."""


def with_hidden_sides(
    obstacles: ObstacleClouds, viewpoint_W: FloatArray, moved: frozenset[int] = frozenset()
) -> ObstacleClouds:
    """The obstacles, those that move or have moved solid, with a far side and a lower one.

    What moves toward a link from behind is nearer than the side of it that is seen, and is so
    still when it has come to rest beside the link. What has always rested is left as it is: a
    link may pass behind it.

    Args:
        obstacles: what is seen.
        viewpoint_W: (3,) from where [m].
        moved: names of those that have moved.

    Returns:
        `obstacles` itself where none has.
    """
    deep = [
        (_moves(v_WO) or int(name) in moved) and bool(np.isfinite(cloud).all())
        for name, v_WO, cloud in zip(obstacles.ids, obstacles.v_WO, obstacles.clouds_W, strict=True)
    ]
    if not any(deep):
        return obstacles
    clouds = tuple(
        np.concatenate([cloud, solid(deepened(thinned(cloud), viewpoint_W, _DEEPEST_MOVED))])
        if is_deep
        else cloud
        for cloud, is_deep in zip(obstacles.clouds_W, deep, strict=True)
    )
    return replace(obstacles, clouds_W=clouds)


def names_moved(obstacles: ObstacleClouds, before: frozenset[int]) -> frozenset[int]:
    """The names of the obstacles that move now, or did before and are still there."""
    return frozenset(
        int(name)
        for name, v_WO in zip(obstacles.ids, obstacles.v_WO, strict=True)
        if _moves(v_WO) or int(name) in before
    )


def _moves(v_WO: FloatArray) -> bool:
    return bool(np.isfinite(v_WO).all() and v_WO.any())


def deepened(cloud: FloatArray, viewpoint_W: FloatArray, deepest: float = _DEEPEST) -> FloatArray:
    """The points, and behind them, horizontally, more layers of them.

    Args:
        cloud: (N, 3) points of a thing [m].
        viewpoint_W: (3,) from where they were seen [m]; (0,): from all sides.
        deepest: the most that it is taken to be [m].

    Returns:
        (N', 3) points, so deep along the view as they are broad across it, or `deepest`.
    """
    if not len(viewpoint_W) or not len(cloud):
        return cloud
    away = cloud.mean(axis=0)[:2] - viewpoint_W[:2]
    distance = float(np.linalg.norm(away))
    if distance < _TOO_NEAR:
        return cloud
    away /= distance
    across = cloud[:, :2] @ np.array([-away[1], away[0]])
    along = cloud[:, :2] @ away
    depth = min(float(np.ptp(across)), deepest) - float(np.ptp(along))
    if depth <= 0.0:
        return cloud
    layers = np.linspace(0.0, depth, 1 + math.ceil(depth / VOXEL))
    moved = cloud + layers[:, None, None] * np.append(away, 0.0)
    return thinned(moved.reshape(-1, 3))


def solid(cloud: FloatArray) -> FloatArray:
    """The points, and below them more, down to the lowest.

    Of a top only the near edge shows the side below it.

    Args:
        cloud: (N, 3) points of a thing [m].

    Returns:
        (N', 3) points.
    """
    if not len(cloud):
        return cloud
    steps = np.floor((cloud[:, 2] - cloud[:, 2].min()) / VOXEL).astype(np.int64)
    # Of each column the highest point stands for all.
    order = np.argsort(-cloud[:, 2], kind="stable")
    top = order[first_in_voxels(cloud[order] * [1.0, 1.0, 0.0], VOXEL)]
    below = np.repeat(cloud[top], steps[top], axis=0)
    number = np.concatenate([np.arange(1, count + 1) for count in steps[top]] + [np.zeros(0)])
    below[:, 2] -= VOXEL * number
    return np.concatenate([cloud, below])


@dataclass(frozen=True, eq=False)
class _Look(Frozen):
    """From where the camera looks, and what has moved before it."""

    viewpoint_W: FloatArray = field(default_factory=lambda: np.zeros(3))
    moved: frozenset[int] = frozenset()


class HiddenSides(LeafSystem):
    """Gives obstacles that move the side that the camera does not see.

    .. pydrake_system::

      name: HiddenSides
      input_ports:
      - obstacles_W
      - camera_pose
      output_ports:
      - obstacles_W

    - obstacles_W (in): abstract `ObstacleClouds`.
    - camera_pose: RigidTransform X_WC of the camera that sees them.
    - obstacles_W (out): abstract `ObstacleClouds`; where nothing has moved that of the input,
      else what moves or has moved has more points, which make it as deep as it is broad, at
      most 15 cm, and solid below its top, see `drake_oa.perception.hidden_sides`.

    The Context holds the camera's place and the names of what has moved, read every `period`:
    the pose depends on time, and the output is to change with an observation only.
    """

    def __init__(self, *, period: float = 1.0 / 15.0) -> None:
        """Declares the ports.

        Args:
            period: time between observations [s].

        Raises:
            ValueError: if it is not positive and finite.
        """
        super().__init__()
        self._obstacles = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self._pose = self.DeclareAbstractInputPort("camera_pose", Value(RigidTransform()))
        self._look = self.DeclareAbstractState(Value(_Look()))
        self.DeclareAbstractOutputPort(
            "obstacles_W",
            lambda: Value(ObstacleClouds()),
            self._calc_obstacles,
            {self._obstacles.ticket(), self.abstract_state_ticket(self._look)},
        )
        self.DeclareInitializationUnrestrictedUpdateEvent(self._update)
        self.DeclarePeriodicUnrestrictedUpdateEvent(valid_period(period), 0.0, self._update)

    def _read(self, context: Context) -> _Look:
        return context.get_abstract_state(self._look).get_value()

    def _update(self, context: Context, state: State) -> EventStatus:
        before = self._read(context)
        pose = read_value(self, self._pose, context, RigidTransform)
        seen = read_value(self, self._obstacles, context, ObstacleClouds)
        after = _Look(pose.translation(), names_moved(seen, before.moved))
        if after.moved == before.moved and np.array_equal(after.viewpoint_W, before.viewpoint_W):
            return EventStatus.DidNothing()
        state.get_mutable_abstract_state(self._look).set_value(after)
        return EventStatus.Succeeded()

    def _calc_obstacles(self, context: Context, output: AbstractValue) -> None:
        seen = read_value(self, self._obstacles, context, ObstacleClouds)
        look = self._read(context)
        output.set_value(with_hidden_sides(seen, look.viewpoint_W, look.moved))
