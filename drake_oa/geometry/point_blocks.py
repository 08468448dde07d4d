"""What the supervisor measures: the points of obstacles in blocks, the robot's primitives."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from drake_oa.common.messages import FloatArray, Frozen, IntArray, ObstacleClouds, TablePlane
from drake_oa.geometry.point_block_kernels import group_points
from drake_oa.geometry.self_filter import RobotShapes

_BLOCK = 0.05
"""Side of the cells in which an obstacle's points are grouped [m]."""
_MOST_BLOCKS = 4096
"""Cells that one obstacle may have."""


@dataclass(frozen=True, eq=False)
class ObstaclePoints(Frozen):
    """The points of the M obstacles of an observation, in blocks of neighbours.

    Attributes:
        stamp: of the observation [s].
        ids: (M,) the obstacles' names.
        v_WO: (M, 3) their velocities in the world [m/s].
        points: (N, 3) in the world [m].
        start: (K + 1,) where each block begins, and N.
        owner: (K,) the obstacle's row.
        sphere: (K, 4) centre, in the world, and radius of a sphere that holds the block [m].
        table: the supporting plane, or None.
    """

    stamp: float = -math.inf
    ids: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    v_WO: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    start: IntArray = field(default_factory=lambda: np.zeros(1, dtype=np.int64))
    owner: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    sphere: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    table: TablePlane | None = None

    def __post_init__(self) -> None:
        """Leaves the arrays unlocked: the kernel is compiled for such, and changes none."""

    @staticmethod
    def of(seen: ObstacleClouds) -> ObstaclePoints:
        """Groups the points of an observation.

        Raises:
            ValueError: if a point or a velocity is not finite.
        """
        v_WO = np.array(seen.v_WO, dtype=float)
        sizes = [len(cloud) for cloud in seen.clouds_W]
        empty = ObstaclePoints(
            stamp=seen.stamp, ids=np.array(seen.ids), v_WO=v_WO, table=seen.table
        )
        if sum(sizes) == 0:
            return empty
        points = np.concatenate(seen.clouds_W, dtype=float)
        if not (math.isfinite(points.sum()) and math.isfinite(v_WO.sum())):
            raise ValueError("the obstacles' points or velocities are not finite")
        begin = np.concatenate([[0], np.cumsum(sizes)])
        points, start, owner, sphere = group_points(points, begin, _BLOCK, _MOST_BLOCKS)
        return replace(empty, points=points, start=start, owner=owner, sphere=sphere)

    def resting(self) -> ObstaclePoints:
        """Without the points of what moves; the obstacles' rows stay."""
        rests = np.asarray(~self.v_WO.any(axis=1))
        if rests.all():
            return self
        blocks = np.flatnonzero(rests[self.owner])
        size = np.diff(self.start)
        taken = np.concatenate(
            [np.zeros(0, dtype=np.int64)]
            + [np.arange(self.start[b], self.start[b + 1]) for b in blocks]
        )
        return replace(
            self,
            points=np.ascontiguousarray(self.points[taken]),
            start=np.concatenate([[0], np.cumsum(size[blocks])]).astype(np.int64),
            owner=np.ascontiguousarray(self.owner[blocks]),
            sphere=np.ascontiguousarray(self.sphere[blocks]),
        )


@dataclass(frozen=True, eq=False)
class GuardShapes:
    """A robot's primitives laid out for `supervision_kernels.approach_limit`.

    Attributes:
        body_sphere, shape_body, X_BG, size, bound: as that function takes them.
    """

    body_sphere: FloatArray
    shape_body: IntArray
    X_BG: FloatArray
    size: FloatArray
    bound: FloatArray

    @staticmethod
    def of(shapes: RobotShapes, count: int) -> GuardShapes:
        """Lays out the primitives of a robot with `count` bodies."""
        boxes, cylinders = len(shapes.box_body), len(shapes.cylinder_body)
        body = np.concatenate([shapes.box_body, shapes.cylinder_body]).astype(np.int64)
        X_BG = np.concatenate([shapes.X_BG_box, shapes.X_BG_cylinder])
        size = np.zeros((boxes + cylinders, 5))
        size[:boxes, :3] = shapes.half_extents
        size[:boxes, 3] = shapes.radius
        size[boxes:, [0, 2]] = shapes.cylinder_size
        size[boxes:, 4] = 1.0
        bound = np.linalg.norm(size[:, :3], axis=1) + size[:, 3]
        order = np.argsort(body, kind="stable")
        body, X_BG, size, bound = body[order], X_BG[order], size[order], bound[order]
        sphere = np.zeros((count, 4))
        for row in np.unique(body):
            mine = body == row
            sphere[row, :3] = X_BG[mine, :3, 3].mean(axis=0)
            away = np.linalg.norm(X_BG[mine, :3, 3] - sphere[row, :3], axis=1)
            sphere[row, 3] = (away + bound[mine]).max()
        return GuardShapes(sphere, body, np.ascontiguousarray(X_BG), size, bound)
