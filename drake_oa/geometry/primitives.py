"""Rounded boxes and cylinders of a robot: distances to points, and which points lie in them.

A sphere is a rounded box without extent, a capsule one with one extent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import BoolArray, FloatArray, IntArray

_TINY = 1e-12
"""A point this near to a primitive's inner box has no direction away from it [m]."""


@compiled
def point_distance(
    x: float, y: float, z: float, size: FloatArray
) -> tuple[float, float, float, float]:
    """Signed distance of a point to a primitive, and the direction away from it.

    Args:
        x, y, z: the point in the primitive's frame [m].
        size: (5,) half extents of the inner box and rounding radius [m], then 0; or radius,
            0, half length, 0 of a cylinder about z [m], then 1.

    Returns:
        Distance [m], negative inside; unit gradient of it in that frame.
    """
    if size[4] != 0.0:
        rho = math.sqrt(x * x + y * y)
        ux, uy = (x / rho, y / rho) if rho > _TINY else (1.0, 0.0)
        a, c = rho - size[0], abs(z) - size[2]
        sz = 1.0 if z >= 0.0 else -1.0
        if a <= _TINY and c <= _TINY:
            if a > c:
                return a, ux, uy, 0.0
            return c, 0.0, 0.0, sz
        a, c = max(a, 0.0), max(c, 0.0)
        d = math.sqrt(a * a + c * c)
        return d, ux * a / d, uy * a / d, sz * c / d
    sx = 1.0 if x >= 0.0 else -1.0
    sy = 1.0 if y >= 0.0 else -1.0
    sz = 1.0 if z >= 0.0 else -1.0
    a, b, c = abs(x) - size[0], abs(y) - size[1], abs(z) - size[2]
    if a <= _TINY and b <= _TINY and c <= _TINY:
        if a >= b and a >= c:
            return a - size[3], sx, 0.0, 0.0
        if b >= c:
            return b - size[3], 0.0, sy, 0.0
        return c - size[3], 0.0, 0.0, sz
    a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
    d = math.sqrt(a * a + b * b + c * c)
    return d - size[3], sx * a / d, sy * b / d, sz * c / d


@compiled
def to_frame(X_WG: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    """A vector of the world in the frame that X_WG poses."""
    return (
        X_WG[0, 0] * x + X_WG[1, 0] * y + X_WG[2, 0] * z,
        X_WG[0, 1] * x + X_WG[1, 1] * y + X_WG[2, 1] * z,
        X_WG[0, 2] * x + X_WG[1, 2] * y + X_WG[2, 2] * z,
    )


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

    def rows(self) -> tuple[IntArray, FloatArray, FloatArray]:
        """Bodies (S,), poses X_BG (S, 4, 4) and sizes (S, 5), see `point_distance`, of all."""
        boxes = len(self) - len(self.cylinder_body)
        size = np.zeros((len(self), 5))
        size[:boxes, :3], size[:boxes, 3] = self.half_extents, self.radius
        size[boxes:, [0, 2]], size[boxes:, 4] = self.cylinder_size, 1.0
        body = np.concatenate([self.box_body, self.cylinder_body]).astype(np.int64)
        return body, np.concatenate([self.X_BG_box, self.X_BG_cylinder]), size

    def posed(self, X_WB: FloatArray) -> PosedShapes:
        """Places the primitives in the world.

        Args:
            X_WB: (B, 4, 4) poses of the bodies, in the order that ``box_body`` and
                ``cylinder_body`` refer to.

        Raises:
            ValueError: if a shape's body has no pose in ``X_WB``.
        """
        body, X_BG, size = self.rows()
        X_WB, least = np.asarray(X_WB, dtype=float), int(body.max(initial=-1)) + 1
        if X_WB.ndim != 3 or X_WB.shape[1:] != (4, 4) or len(X_WB) < least:
            raise ValueError(
                f"X_WB has shape {X_WB.shape}; the shapes need (B, 4, 4) with B >= {least}"
            )
        return PosedShapes(X_WB[body] @ X_BG, size)


@dataclass(frozen=True, eq=False)
class PosedShapes:
    """Primitives at one instant.

    Attributes:
        X_WG: (S, 4, 4) poses in the world.
        size: (S, 5) see `point_distance`.
    """

    X_WG: FloatArray
    size: FloatArray

    def contains(self, p_WQ: FloatArray, margin: float) -> BoolArray:
        """(N,) which points (N, 3) in W lie in any primitive, or within a margin of it [m]."""
        points = np.require(p_WQ, np.float64, ["C", "W"])
        return in_shapes(points, self.X_WG, self.size, float(margin))


@compiled
def in_shapes(points: FloatArray, X_WG: FloatArray, size: FloatArray, margin: float) -> BoolArray:
    """Which points (N, 3) lie within a margin [m] of posed primitives.

    Args:
        points: (N, 3) points in the world frame [m].
        X_WG: (S, 4, 4) poses of the primitives.
        size: (S, 5) see `point_distance`.
        margin: [m].
    """
    inside = np.zeros(len(points), dtype=np.bool_)
    for s in range(len(size)):
        reach = margin + size[s, 3]
        reach += math.sqrt(size[s, 0] ** 2 + size[s, 1] ** 2 + size[s, 2] ** 2)
        X = X_WG[s]
        for i in range(len(points)):
            x, y, z = points[i, 0] - X[0, 3], points[i, 1] - X[1, 3], points[i, 2] - X[2, 3]
            if inside[i] or x * x + y * y + z * z > reach * reach:
                continue
            a, b, c = to_frame(X, x, y, z)
            inside[i] = point_distance(a, b, c, size[s])[0] <= margin
    return inside
