"""What is looked at of obstacles and a robot: points in blocks, primitives body by body."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, Frozen, IntArray, ObstacleClouds, TablePlane
from drake_oa.geometry.primitives import RobotShapes


@compiled
def group_points(
    points: FloatArray, begin: IntArray, side: float, most: int
) -> tuple[FloatArray, IntArray, IntArray, FloatArray]:
    """Groups the points of each obstacle by cells of a grid.

    Args:
        points: (N, 3) of all obstacles, one after the other [m].
        begin: (M + 1,) where each obstacle begins, and N.
        side: of a cell [m]; cells are larger where there would be too many of them.
        most: how many cells an obstacle may have.

    Returns:
        The points in order of their blocks, where each of the K blocks begins, and N; the
        row of its obstacle; (K, 4) centre and radius of a sphere that holds it [m].
    """
    total = len(points)
    ordered = np.empty((total, 3))
    start, owner = np.empty(total + 1, dtype=np.int64), np.empty(total, dtype=np.int64)
    sphere = np.empty((total, 4))
    cell = np.empty(total, dtype=np.int64)
    place = np.empty(most + 1, dtype=np.int64)
    blocks = 0
    across = np.ones(3, dtype=np.int64)
    low, high = np.empty(3), np.empty(3)
    for row in range(len(begin) - 1):
        first, last = begin[row], begin[row + 1]
        if first == last:
            continue
        low[:], high[:] = points[first], points[first]
        for i in range(first, last):
            for j in range(3):
                low[j] = min(low[j], points[i, j])
                high[j] = max(high[j], points[i, j])
        edge = side
        for j in range(3):
            # So that the product of the three counts stays below the limit.
            edge = max(edge, 1.01 * (high[j] - low[j]) / (most ** (1.0 / 3.0) - 1.0))
        for j in range(3):
            across[j] = int((high[j] - low[j]) / edge) + 1
        count = across[0] * across[1] * across[2]
        place[: count + 1] = 0
        for i in range(first, last):
            index = 0
            for j in range(3):
                index = index * across[j] + int((points[i, j] - low[j]) / edge)
            cell[i] = index
            place[index + 1] += 1
        for index in range(count):
            if place[index + 1] > 0:
                start[blocks], owner[blocks] = first + place[index], row
                blocks += 1
            place[index + 1] += place[index]
        for i in range(first, last):
            ordered[first + place[cell[i]]] = points[i]
            place[cell[i]] += 1
    start[blocks] = total
    for block in range(blocks):
        first, last = start[block], start[block + 1]
        low[:], high[:] = ordered[first], ordered[first]
        for i in range(first, last):
            for j in range(3):
                low[j] = min(low[j], ordered[i, j])
                high[j] = max(high[j], ordered[i, j])
        square = 0.0
        for i in range(first, last):
            away = 0.0
            for j in range(3):
                away += (ordered[i, j] - 0.5 * (low[j] + high[j])) ** 2
            square = max(square, away)
        for j in range(3):
            sphere[block, j] = 0.5 * (low[j] + high[j])
        sphere[block, 3] = math.sqrt(square)
    return ordered, start[: blocks + 1].copy(), owner[:blocks].copy(), sphere[:blocks].copy()


_BLOCK = 0.05
"""Side of the cells in which an obstacle's points are grouped [m]."""
_MOST_BLOCKS = 4096
"""Cells that one obstacle may have."""


class PointBlocks(NamedTuple):
    """The points of M obstacles as kernels take them.

    Attributes:
        points: (N, 3) on the obstacles [m].
        start: (K + 1,) where each block of points begins, and N.
        owner: (K,) the obstacle's row.
        sphere: (K, 4) centre and radius of a sphere that holds the block's points [m].
        v_WO: (M, 3) velocities of the obstacles [m/s].
    """

    points: FloatArray
    start: IntArray
    owner: IntArray
    sphere: FloatArray
    v_WO: FloatArray


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

    @property
    def blocks(self) -> PointBlocks:
        """As the kernels take them."""
        return PointBlocks(self.points, self.start, self.owner, self.sphere, self.v_WO)


class GuardShapes(NamedTuple):
    """A robot's primitives, those of a body one after the other.

    Attributes:
        body_sphere: (B, 4) centre, in the body, and radius of a sphere that holds its
            primitives [m].
        shape_body: (S,) the body of each primitive, ascending.
        X_BG: (S, 4, 4) poses of the primitives in their bodies.
        size: (S, 5) see `primitives.point_distance`.
        bound: (S,) radii of spheres about the primitives' centres that hold them [m].
    """

    body_sphere: FloatArray
    shape_body: IntArray
    X_BG: FloatArray
    size: FloatArray
    bound: FloatArray

    @staticmethod
    def of(shapes: RobotShapes, count: int) -> GuardShapes:
        """Lays out the primitives of a robot with `count` bodies."""
        body, X_BG, size = shapes.rows()
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
