"""Obstacles as the arm's clearance is asked to them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drake_oa.common.messages import FloatArray, Frozen, ObstacleClouds, TablePlane
from drake_oa.geometry.points import ObstaclePoints
from drake_oa.geometry.voxels import VOXEL, thinned
from drake_oa.perception.hidden_sides import deepened


@dataclass(frozen=True, eq=False)
class ArmSurroundings(Frozen):
    """Obstacles as the arm's clearance is asked to them.

    Attributes:
        points: the obstacles' points, thinned out, in blocks.
        table: (4,) unit normal and offset of the table [m]; NaN: there is none.
        padding: a surface may lie this far outside the points that are left [m].
    """

    points: ObstaclePoints = field(default_factory=ObstaclePoints)
    table: FloatArray = field(default_factory=lambda: np.full(4, np.nan))
    padding: float = 0.0

    def __post_init__(self) -> None:
        """Leaves the arrays unlocked: the kernels are compiled for such, and change none."""

    @staticmethod
    def of(
        obstacles: ObstacleClouds,
        table: TablePlane | None = None,
        viewpoint_W: FloatArray | None = None,
    ) -> ArmSurroundings:
        """Thins the clouds out to one point a voxel of 2 cm.

        Seen from one side, a thing is taken to be as deep as it is broad, up to 8 cm: links
        go behind what they go round, where a tool that passes in front does not.

        Args:
            obstacles: what is seen.
            table: the supporting plane; None: the one that came with it.
            viewpoint_W: (3,) the camera [m]; None or (0,): the clouds are seen from all sides.

        Raises:
            ValueError: if a point or a velocity is not finite.
        """
        view = np.zeros(0) if viewpoint_W is None else viewpoint_W
        thin = ObstacleClouds(
            stamp=obstacles.stamp,
            clouds_W=tuple(deepened(thinned(cloud), view) for cloud in obstacles.clouds_W),
            ids=obstacles.ids,
            v_WO=obstacles.v_WO,
        )
        plane = obstacles.table if table is None else table
        row = np.full(4, np.nan) if plane is None else np.append(plane.normal_W, plane.offset)
        # Of a sheet of points the surface is nearer by this in the middle of four of them,
        # for a link that touches it in a point of the rounding of 6 cm.
        return ArmSurroundings(ObstaclePoints.of(thin), row, padding=0.25 * VOXEL)

    def lag(self, time: float) -> float:
        """Time since the points were seen [s]."""
        stamp = self.points.stamp
        return max(time - stamp, 0.0) if math.isfinite(stamp) else 0.0
