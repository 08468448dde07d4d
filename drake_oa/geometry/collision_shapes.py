"""Collision geometry of Drake models as arrays: primitives and surface samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.geometry import (
    Box,
    Capsule,
    Convex,
    Cylinder,
    Ellipsoid,
    GeometryId,
    Mesh,
    SceneGraphInspector,
    Sphere,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex
from pydrake.systems.framework import Context

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.primitives import PosedShapes, RobotShapes

_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A robot's collision geometry together with the plant that poses it.

    Attributes:
        plant: finalized plant; it is only read.
        model_instance: the robot in it.
        bodies: the bodies that carry geometry, in the order of the shapes' rows.
        shapes: the primitives, fixed to those bodies.
    """

    plant: MultibodyPlant
    model_instance: ModelInstanceIndex
    bodies: tuple[BodyIndex, ...]
    shapes: RobotShapes

    @property
    def num_states(self) -> int:
        """Size of the robot's state [q, v]."""
        return int(self.plant.num_multibody_states(self.model_instance))

    def posed(self, state: FloatArray) -> PosedShapes:
        """The primitives in the world at a state (num_states,) = [q, v].

        Raises:
            ValueError: for a state of the wrong size or one that is not finite.
        """
        values: Any = np.asarray(state, dtype=float)
        if values.shape != (self.num_states,) or not np.isfinite(values).all():
            raise ValueError(
                f"the robot state must be {self.num_states} finite numbers [q, v], not {state}"
            )
        context = self.plant.CreateDefaultContext()
        self.plant.SetPositionsAndVelocities(context, self.model_instance, values)
        return self.shapes.posed(self.body_poses(context))

    def body_poses(self, context: Context) -> FloatArray:
        """(B, 4, 4) poses of the bodies in the world, in a context of the plant."""
        X_WB = np.empty((len(self.bodies), 4, 4))
        for row, index in enumerate(self.bodies):
            body = self.plant.get_body(index)
            X_WB[row] = self.plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4()
        return X_WB


def collect_collision_shapes(
    plant: MultibodyPlant,
    inspector: SceneGraphInspector,
    model_instance: ModelInstanceIndex,
) -> RobotModel:
    """Reads the proximity geometry of a model instance.

    Spheres, capsules, boxes and cylinders are taken as they are; ellipsoids, convex
    shapes and meshes by their bounding box in the geometry's frame.

    Args:
        plant: finalized and registered with the scene graph of ``inspector``.
        inspector: of that scene graph.
        model_instance: the robot.

    Raises:
        ValueError: for an unbounded shape (a half space) on the robot.
    """
    bodies: list[BodyIndex] = []
    boxes: list[tuple[int, Any, Any, float]] = []
    cylinders: list[tuple[int, Any, Any]] = []
    for index in plant.GetBodyIndices(model_instance):
        geometries = plant.GetCollisionGeometriesForBody(plant.get_body(index))
        if not geometries:
            continue
        row = len(bodies)
        bodies.append(index)
        for geometry in geometries:
            shape = inspector.GetShape(geometry)
            X_BG = inspector.GetPoseInFrame(geometry).GetAsMatrix4()
            if isinstance(shape, Cylinder):
                size = np.array([shape.radius(), shape.length() / 2.0])
                cylinders.append((row, X_BG, size))
            else:
                offset, half_extents, radius = _rounded_box(inspector, geometry)
                X_BG[:3, 3] += X_BG[:3, :3] @ offset
                boxes.append((row, X_BG, half_extents, radius))
    shapes = RobotShapes(
        np.array([row for row, *_ in boxes], dtype=np.int64),
        np.array([X for _, X, *_ in boxes]).reshape(-1, 4, 4),
        np.array([h for _, _, h, _ in boxes]).reshape(-1, 3),
        np.array([r for *_, r in boxes]),
        np.array([row for row, *_ in cylinders], dtype=np.int64),
        np.array([X for _, X, _ in cylinders]).reshape(-1, 4, 4),
        np.array([size for *_, size in cylinders]).reshape(-1, 2),
    )
    return RobotModel(plant, model_instance, tuple(bodies), shapes)


def _rounded_box(
    inspector: SceneGraphInspector, geometry: GeometryId
) -> tuple[FloatArray, FloatArray, float]:
    """Centre in the geometry's frame, half extents and radius of its rounded box."""
    shape = inspector.GetShape(geometry)
    origin = np.zeros(3)
    if isinstance(shape, Sphere):
        return origin, np.zeros(3), shape.radius()
    if isinstance(shape, Capsule):
        return origin, np.array([0.0, 0.0, shape.length() / 2.0]), shape.radius()
    if isinstance(shape, Box):
        return origin, np.asarray(shape.size()) / 2.0, 0.0
    if isinstance(shape, Cylinder):
        return origin, np.array([shape.radius(), shape.radius(), shape.length() / 2.0]), 0.0
    if isinstance(shape, Ellipsoid):
        return origin, np.array([shape.a(), shape.b(), shape.c()]), 0.0
    if isinstance(shape, (Convex, Mesh)):
        vertices = hull_vertices(inspector, geometry)
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        return (low + high) / 2.0, (high - low) / 2.0, 0.0
    raise ValueError(
        f"{inspector.GetName(geometry)} is a {type(shape).__name__}; a robot's collision shape "
        "must be a sphere, capsule, box, cylinder, ellipsoid, convex shape or mesh"
    )


def hull_vertices(inspector: SceneGraphInspector, geometry: GeometryId) -> FloatArray:
    """(N, 3) vertices of the convex hull of a convex shape or mesh, in its own frame [m]."""
    hull = inspector.GetConvexHull(geometry)
    return np.array([hull.vertex(i) for i in range(hull.num_vertices())])


def outline_corners(inspector: SceneGraphInspector, geometry: GeometryId) -> FloatArray:
    """Points whose convex hull encloses a geometry.

    They are the vertices of a box, a convex shape or a mesh, and the corners of the
    box round any other shape.

    Args:
        inspector: of the scene graph that holds the geometry.
        geometry: a box, sphere, ellipsoid, cylinder, capsule, convex shape or mesh.

    Returns:
        (K, 3) points in the frame of the body that the geometry is fixed to [m].

    Raises:
        ValueError: for an unbounded shape.
    """
    if isinstance(inspector.GetShape(geometry), (Convex, Mesh)):
        p_GQ = hull_vertices(inspector, geometry)
    else:
        center, half_extents, radius = _rounded_box(inspector, geometry)
        p_GQ = center + _CORNERS * (half_extents + radius)
    return _in_body(inspector, geometry, p_GQ)


def _in_body(inspector: SceneGraphInspector, geometry: GeometryId, p_GQ: FloatArray) -> FloatArray:
    X_BG = inspector.GetPoseInFrame(geometry).GetAsMatrix4()
    return np.asarray(p_GQ @ X_BG[:3, :3].T + X_BG[:3, 3])


def surface_points(
    inspector: SceneGraphInspector, geometry: GeometryId, count: int = 300
) -> FloatArray:
    """About ``count`` points on a geometry's surface, always the same ones.

    Corners, rims and poles are among them, so that their convex hull is the shape's
    (to the sampling for curved ones).

    Args:
        inspector: of the scene graph that holds the geometry.
        geometry: a box, sphere, ellipsoid, cylinder, capsule, convex shape or mesh
            (a mesh counts as its convex hull, as in Drake's proximity queries).
        count: wanted number of points, at least 30.

    Returns:
        (N, 3) points in the frame of the body that the geometry is fixed to [m].

    Raises:
        ValueError: for another shape or too small a count.
    """
    if count < 30:
        raise ValueError(f"count must be at least 30, not {count}")
    shape = inspector.GetShape(geometry)
    if isinstance(shape, Box):
        p_GQ = _box_points(np.asarray(shape.size()) / 2.0, count)
    elif isinstance(shape, Sphere):
        p_GQ = _sphere_points(count) * shape.radius()
    elif isinstance(shape, Ellipsoid):
        p_GQ = _sphere_points(count) * np.array([shape.a(), shape.b(), shape.c()])
    elif isinstance(shape, Capsule):
        p_GQ = _capsule_points(shape.radius(), shape.length() / 2.0, count)
    elif isinstance(shape, Cylinder):
        p_GQ = _cylinder_points(shape.radius(), shape.length() / 2.0, count)
    elif isinstance(shape, (Convex, Mesh)):
        p_GQ = _hull_points(inspector, geometry, count)
    else:
        raise ValueError(
            f"{inspector.GetName(geometry)} is a {type(shape).__name__}; an obstacle must be a "
            "box, sphere, ellipsoid, cylinder, capsule, convex shape or mesh"
        )
    return _in_body(inspector, geometry, p_GQ)


def _box_points(half: FloatArray, count: int) -> FloatArray:
    # As far apart along a long edge as along a short one: nothing slips in between.
    area = 8.0 * (half[0] * half[1] + half[1] * half[2] + half[2] * half[0])
    sides = np.maximum(2, np.round(2.0 * half / np.sqrt(area / count)).astype(int) + 1)
    faces = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        a, b = (
            grid.ravel()
            for grid in np.meshgrid(
                np.linspace(-1.0, 1.0, sides[first]), np.linspace(-1.0, 1.0, sides[second])
            )
        )
        for sign in (-1.0, 1.0):
            face = np.full((len(a), 3), sign)
            face[:, first], face[:, second] = a, b
            faces.append(face)
    return np.asarray(np.unique(np.concatenate(faces), axis=0) * half)


def _sphere_points(count: int) -> FloatArray:
    """Fibonacci points on the unit sphere, and the six ends of its axes."""
    k = np.arange(count) + 0.5
    z = 1.0 - 2.0 * k / count
    radius, angle = np.sqrt(1.0 - z * z), _GOLDEN_ANGLE * k
    spiral = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)
    return np.concatenate([np.eye(3), -np.eye(3), spiral])


def _capsule_points(radius: float, half_length: float, count: int) -> FloatArray:
    """Points on the two caps and on rings of the mantle between them."""
    caps = _sphere_points(count // 2) * radius
    caps[:, 2] += np.where(caps[:, 2] >= 0.0, half_length, -half_length)
    return np.concatenate([caps, _rings(radius, half_length, count // 2)])


def _cylinder_points(radius: float, half_length: float, count: int) -> FloatArray:
    """Rings of the mantle, its rims included, and a spiral on either lid."""
    k = np.arange(max(4, count // 6))
    r, angle = radius * np.sqrt(k / len(k)), _GOLDEN_ANGLE * k
    lid = np.stack([r * np.cos(angle), r * np.sin(angle), np.full(len(k), half_length)], axis=1)
    return np.concatenate(
        [_rings(radius, half_length, 2 * count // 3), lid, lid * np.array([1.0, 1.0, -1.0])]
    )


def _rings(radius: float, half_length: float, count: int) -> FloatArray:
    around = 24 if count >= 48 else count // 2
    angle = np.arange(around) * (2.0 * np.pi / around)
    height = np.linspace(-half_length, half_length, max(2, count // around))
    z, angle = (grid.ravel() for grid in np.meshgrid(height, angle))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def _hull_points(inspector: SceneGraphInspector, geometry: GeometryId, count: int) -> FloatArray:
    """The hull's vertices and points spread over its faces by area."""
    hull = inspector.GetConvexHull(geometry)
    vertices = hull_vertices(inspector, geometry)
    triangles = []
    for i in range(hull.num_elements()):
        face = hull.element(i)
        corners: Sequence[int] = [face.vertex(k) for k in range(face.num_vertices())]
        triangles += [(corners[0], *corners[k : k + 2]) for k in range(1, len(corners) - 1)]
    a, b, c = (vertices[list(column)] for column in zip(*triangles, strict=True))
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    k = np.arange(max(0, count - len(vertices))) + 0.5
    chosen = np.searchsorted(area, k / max(1, len(k)) * area[-1])
    # Low-discrepancy barycentric coordinates, folded into the triangle.
    s, t = np.mod(k * 0.7548776662466927, 1.0), np.mod(k * 0.5698402909980532, 1.0)
    fold = s + t > 1.0
    s, t = np.where(fold, 1.0 - s, s)[:, None], np.where(fold, 1.0 - t, t)[:, None]
    inner = a[chosen] + s * (b - a)[chosen] + t * (c - a)[chosen]
    return np.concatenate([vertices, inner])
