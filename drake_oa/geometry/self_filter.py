"""Which points belong to the robot itself: distance tests against primitives.

Spheres, capsules and boxes are one family, the rounded box (the points within
``radius`` of a box with half extents h: a capsule's box is a segment, a sphere's
a point); cylinders are the other.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numba import njit

from drake_oa.common.messages import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class RobotShapes:
    """Primitives G fixed to the bodies B of a robot.

    Attributes:
        box_body: (S,) row, in the array of body poses, of each rounded box's body.
        X_BG_box: (S, 4, 4) poses of the rounded boxes in their bodies.
        half_extents: (S, 3) half extents of the inner boxes [m], zeros allowed.
        radius: (S,) rounding radii [m], zeros allowed.
        cylinder_body: (T,) as ``box_body``, for the cylinders.
        X_BG_cylinder: (T, 4, 4) poses of the cylinders (axis z) in their bodies.
        cylinder_size: (T, 2) radius and half length [m].
    """

    box_body: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    X_BG_box: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    half_extents: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    radius: FloatArray = field(default_factory=lambda: np.zeros(0))
    cylinder_body: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    X_BG_cylinder: FloatArray = field(default_factory=lambda: np.zeros((0, 4, 4)))
    cylinder_size: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))

    def __post_init__(self) -> None:
        boxes, cylinders = len(self.box_body), len(self.cylinder_body)
        expected = {
            "X_BG_box": (boxes, 4, 4),
            "half_extents": (boxes, 3),
            "radius": (boxes,),
            "X_BG_cylinder": (cylinders, 4, 4),
            "cylinder_size": (cylinders, 2),
        }
        for name, shape in expected.items():
            if getattr(self, name).shape != shape:
                raise ValueError(
                    f"RobotShapes.{name} has shape {getattr(self, name).shape}; "
                    f"{boxes} rounded boxes and {cylinders} cylinders need {shape}"
                )

    def __len__(self) -> int:
        return len(self.box_body) + len(self.cylinder_body)

    def posed(self, X_WB: FloatArray) -> PosedShapes:
        """Places the primitives in the world.

        Args:
            X_WB: (B, 4, 4) poses of the bodies, in the order that ``box_body`` and
                ``cylinder_body`` refer to.

        Raises:
            ValueError: if a shape's body has no pose in ``X_WB``.
        """
        X_WB = np.asarray(X_WB, dtype=float)
        rows = max(self.box_body.max(initial=-1).item(), self.cylinder_body.max(initial=-1).item())
        if X_WB.ndim != 3 or X_WB.shape[1:] != (4, 4) or len(X_WB) <= rows:
            raise ValueError(
                f"X_WB has shape {X_WB.shape}; the shapes need (B, 4, 4) with B >= {rows + 1}"
            )
        return PosedShapes(
            X_WB[self.box_body] @ self.X_BG_box,
            self.half_extents,
            self.radius,
            X_WB[self.cylinder_body] @ self.X_BG_cylinder,
            self.cylinder_size,
        )


@dataclass(frozen=True, eq=False)
class PosedShapes:
    """RobotShapes at one instant; the poses X_WG are in the world frame."""

    X_WG_box: FloatArray
    half_extents: FloatArray
    radius: FloatArray
    X_WG_cylinder: FloatArray
    cylinder_size: FloatArray

    def contains(self, p_WQ: FloatArray, margin: float) -> BoolArray:
        """Tells which points lie in or within ``margin`` of any primitive.

        Args:
            p_WQ: (N, 3) points in the world frame [m].
            margin: distance that still counts as the robot [m], not negative.

        Returns:
            (N,) booleans.
        """
        points = np.require(p_WQ, np.float64, ["C", "W"])
        inside = np.zeros(len(points), dtype=bool)
        if len(self.radius):
            size = np.column_stack([self.half_extents, self.radius])
            poses = np.require(self.X_WG_box, np.float64, ["C", "W"])
            inside |= in_shapes(points, poses, size, float(margin), False)
        if len(self.cylinder_size):
            size = np.zeros((len(self.cylinder_size), 4))
            size[:, [0, 2]] = self.cylinder_size
            poses = np.require(self.X_WG_cylinder, np.float64, ["C", "W"])
            inside |= in_shapes(points, poses, size, float(margin), True)
        return inside


@njit(cache=True, error_model="numpy")
def in_shapes(
    points: FloatArray, X_WG: FloatArray, size: FloatArray, margin: float, round_section: bool
) -> BoolArray:
    """Which points (N, 3) lie within a margin of rounded boxes, or of cylinders.

    Args:
        points: (N, 3) points in the world frame [m].
        X_WG: (S, 4, 4) poses of the shapes.
        size: (S, 4) half extents and rounding radius [m]; of a cylinder along z the
            first is its radius, the second is unused.
        margin: [m].
        round_section: whether the shapes are cylinders.
    """
    inside = np.zeros(len(points), dtype=np.bool_)
    p = np.empty(3)
    for s in range(len(size)):
        side = 0.0 if round_section else size[s, 1]
        reach = size[s, 3] + margin
        bound = reach + np.sqrt(size[s, 0] ** 2 + side * side + size[s, 2] ** 2)
        X = X_WG[s]
        for i in range(len(points)):
            x, y, z = points[i, 0] - X[0, 3], points[i, 1] - X[1, 3], points[i, 2] - X[2, 3]
            if inside[i] or x * x + y * y + z * z > bound * bound:
                continue
            for k in range(3):
                p[k] = abs(X[0, k] * x + X[1, k] * y + X[2, k] * z)
            if round_section:
                p[0], p[1] = np.sqrt(p[0] * p[0] + p[1] * p[1]), 0.0
            beyond = 0.0
            for k in range(3):
                half = side if k == 1 else size[s, k]
                beyond += max(p[k] - half, 0.0) ** 2
            inside[i] = beyond <= reach * reach
    return inside
