"""Collision geometries of robots, obstacles and environment, and signed distances from points to
them at a given time.

Spheres, boxes, capsules, cylinders, ellipsoids, half-spaces and convex hulls are exact; a point
cloud is described by a `DistanceField`, a grid of signed distances. Each geometry has a frame O and
a constant velocity. Its position in the world at time t is p_WO + v_WO (t - stamp), where p_WO is
the position at the time `stamp`.

- `CollisionGeometry`: one geometry.
- `CollisionGeometries`: several geometries as arrays for compiled kernels.
- `CollisionScene`: the geometries of one observation, with labels for messages.

`read_geometry` is the only function that reads geometries of Drake.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pydrake.geometry as drake
from numpy.typing import NDArray
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.systems.framework import Context
from scipy.spatial import ConvexHull, QhullError

from drake_oa.common.compiled import compiled, leaf
from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray, TablePlane, zeros
from drake_oa.geometry.directions import lattice, sphere_points
from drake_oa.geometry.distance_field import OFFSET, DistanceField
from drake_oa.geometry.ellipsoid_kernels import to_ellipsoid
from drake_oa.geometry.shapes import Box, Cylinder, Sphere, pose, shape_geometry

PRIMITIVE, ELLIPSOID, HALF_SPACE, HULL, FIELD = range(5)
"""Kinds of collision geometries, which determine the function that computes a distance. A primitive
is a cylinder or a rounded box (spheres and capsules included), a hull is the convex hull of points,
and a field is the distance field of a point cloud."""

ENVIRONMENT = -1
"""Obstacle ID of all geometry of the environment, which is not an obstacle: a table or a stand, for
example."""

CORNERS = lattice(*[(-1.0, 1.0)] * 3)
"""Corners (8, 3) of a cube with its center at the origin and edges of length 2, scaled to obtain
the corners of boxes."""


class CollisionGeometries(NamedTuple):
    """K collision geometries as a few C-contiguous arrays, for compiled kernels.

    O is the frame of a geometry, and its stamp the time of the given pose. W is the world or, for
    geometries of a robot at poses in its bodies, the frame of the body.

    Attributes:
        ball: (K, 8) center in W at the stamp (3), and radius, of a bounding sphere (inf:
            half-space) [m]; then velocity (3) [m/s] and stamp [s] of the geometry.
        X_WO: (K, 3, 4) upper three rows of the poses at the stamp.
        size: (K, 7) dimensions [m], unused ones 0. Rounded box: half extents of its inner box, and
            the radius by which this box is dilated. Cylinder about z: radius, radius, half its
            length, 0, and 1 (no length), which distinguishes it from a rounded box. Ellipsoid:
            semi-axes. Field: edge of a voxel, and low and high corner in O of the bounding box of
            the grid nodes in the obstacle.
        layout: (K, 6) kind (`PRIMITIVE`, `ELLIPSOID`, `HALF_SPACE`, `HULL` or `FIELD`), four
            indices, and obstacle ID. The indices of a hull are its first face in `faces` and one
            past its last; those of a field are its first element in `voxels`, and its numbers of
            nodes nx, ny, nz. The others are 0.
        faces: (F, 13) triangles of the hulls: outer unit normal (3), offset of the plane from the
            origin of O along the normal [m], and corners a, b, c in O (3 each) [m].
        voxels: float32 distances at the nodes of all fields [m], in one array.
    """

    ball: FloatArray
    X_WO: FloatArray
    size: FloatArray
    layout: IntArray
    faces: FloatArray
    voxels: NDArray[np.float32]

    @property
    def moving(self) -> BoolArray:
        """Whether each of the K geometries moves, that is, has a velocity other than zero: booleans
        (K,).
        """
        return np.asarray(self.ball[:, 4:7].any(axis=1))

    def select(self, rows: BoolArray) -> CollisionGeometries:
        """Returns the geometries that a mask of booleans (K,) selects."""
        parts = {name: getattr(self, name)[rows] for name in ("ball", "X_WO", "size", "layout")}
        return self._replace(**parts)


@dataclass(frozen=True, eq=False)
class CollisionGeometry(Frozen):
    """Collision geometry of one shape, with its pose and constant velocity.

    The functions `geometry_of`, `hull` and `cloud_geometry` construct it. `dataclasses.replace`
    changes its pose.

    Attributes:
        kind: `PRIMITIVE` (cylinder or rounded box), `ELLIPSOID`, `HALF_SPACE` (z <= 0 in O), `HULL`
            (convex hull) or `FIELD` (distance field of a point cloud).
        name: obstacle ID, the same for all geometries of one obstacle; -1: environment.
        label: name of the geometry in messages.
        X_WO: (4, 4) pose of the geometry's frame O at the stamp, in the world or, for a geometry
            that `read_geometry` has read, in its body.
        v_WO: (3,) velocity in the world, without rotation [m/s].
        stamp: time of the pose [s].
        size: dimensions [m]. Rounded box: half extents of its inner box, and the radius by which
            this box is dilated. Cylinder about z: radius, radius, half its length, 0, and 1 (no
            length), which distinguishes it from a rounded box. Ellipsoid: semi-axes. Field: edge of
            a voxel, and low and high corner in O of the bounding box of the grid nodes in the
            obstacle.
        center, radius: bounding sphere in O [m]; radius inf: half-space.
        faces: (F, 13) triangles of a hull: outer unit normal (3), offset of the plane from the
            origin of O along the normal [m], and three corners in O (3 each) [m].
        grid: distance field of a cloud; None for other kinds.
    """

    kind: int = PRIMITIVE
    name: int = 0
    label: str = ""
    X_WO: FloatArray = field(default_factory=lambda: np.eye(4))
    v_WO: FloatArray = zeros(3)
    stamp: float = 0.0
    size: tuple[float, ...] = ()
    center: FloatArray = zeros(3)
    radius: float = math.inf
    faces: FloatArray = zeros(0, 13)
    grid: DistanceField | None = None

    def placed(self, p_OQ: FloatArray) -> FloatArray:
        """Transforms points (N, 3) [m] from the geometry's frame O to the frame W of its pose X_WO:
        the world or, for a geometry of a robot, the body.
        """
        return np.asarray(p_OQ @ self.X_WO[:3, :3].T + self.X_WO[:3, 3])

    @property
    def half_extents(self) -> FloatArray:
        """Half extents (3,) of the bounding box of the geometry, about `center` and along the axes
        of its frame O [m].

        Raises:
            ValueError: for a half-space or the distance field of a cloud; the message contains the
                label.
        """
        if self.kind == HULL:
            return np.asarray(np.abs(outline_corners(self) - self.center).max(axis=0))
        if self.kind in (PRIMITIVE, ELLIPSOID):
            return np.array(self.size[:3]) + self.size[3]
        raise ValueError(
            f"{self.label}: shape is not bounded; it must be a sphere, box, capsule, cylinder, "
            "ellipsoid, convex shape or mesh"
        )


def hull(vertices: FloatArray) -> CollisionGeometry:
    """Computes the convex hull of points, which may be coplanar, as a collision geometry in the
    frame of the points.

    Args:
        vertices: (N, 3) points [m].
    """
    points = np.asarray(vertices, dtype=float)
    try:
        qhull = ConvexHull(points)
    except QhullError:
        qhull = ConvexHull(points, qhull_options="QJ")
    # Sorted, so that coplanar triangles are adjacent.
    order = np.lexsort(np.round(qhull.equations, 9).T[::-1])
    planes, corners = qhull.equations[order], points[qhull.simplices[order]]
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    return CollisionGeometry(
        HULL,
        center=center,
        radius=float(np.linalg.norm(points - center, axis=1).max()),
        faces=np.column_stack([planes[:, :3], -planes[:, 3], corners.reshape(-1, 9)]),
    )


def cloud_geometry(grid: DistanceField, **more: Any) -> CollisionGeometry:
    """Returns the collision geometry of an obstacle that is described by the distance field of its
    point cloud.

    Args:
        grid: distance field of the cloud.
        more: other fields of `CollisionGeometry`, such as name, v_WO and stamp.
    """
    X_WO = np.eye(4)
    X_WO[:3, 3] = grid.p_WO
    geometry = CollisionGeometry(
        FIELD,
        X_WO=X_WO,
        size=(grid.voxel, *grid.low, *grid.high),
        center=0.5 * (grid.low + grid.high),
        # A point is at most half a diagonal of a voxel from its node.
        radius=0.5 * float(np.linalg.norm(grid.high - grid.low)) + 0.87 * grid.voxel,
        grid=grid,
    )
    return replace(geometry, **more)


def table_geometry(table: TablePlane) -> CollisionGeometry:
    """Returns the collision geometry of a table: the half-space below its plane, as part of the
    environment.
    """
    z_W = table.normal_W
    X_WO = RigidTransform(RotationMatrix.MakeFromOneVector(z_W, 2), table.offset * z_W)
    return CollisionGeometry(HALF_SPACE, ENVIRONMENT, "the table", X_WO.GetAsMatrix4())


def shape_geometries(
    shapes: Sequence[Box | Cylinder | Sphere], X_WO: FloatArray, **more: Any
) -> list[CollisionGeometry]:
    """Returns the collision geometries of an obstacle of a scenario, one for each of its shapes, at
    a pose of the obstacle.

    Args:
        shapes: shapes of the obstacle, with their poses in its frame.
        X_WO: (4, 4) pose of the obstacle.
        more: other fields of `CollisionGeometry`, such as name, v_WO and stamp.
    """
    X_WG = [np.asarray(X_WO, dtype=float) @ pose(shape).GetAsMatrix4() for shape in shapes]
    return [
        replace(geometry_of(shape_geometry(shape)), X_WO=X, **more)
        for shape, X in zip(shapes, X_WG, strict=True)
    ]


def read_geometry(
    inspector: drake.SceneGraphInspector, geometry_id: drake.GeometryId
) -> CollisionGeometry:
    """Reads a collision geometry from a Drake scene graph, at its pose in its body; a mesh is read
    as its convex hull.

    Args:
        inspector: inspector of the scene graph that contains the geometry.
        geometry_id: Drake's ID; the geometry's name in the scene graph becomes the label.

    Raises:
        ValueError: for a shape that is not supported; the message names the geometry.
    """
    shape, label = inspector.GetShape(geometry_id), inspector.GetName(geometry_id)
    try:
        if isinstance(shape, (drake.Mesh, drake.Convex)):
            drakes = inspector.GetConvexHull(geometry_id)
            geometry = hull(np.array([drakes.vertex(i) for i in range(drakes.num_vertices())]))
        else:
            geometry = geometry_of(shape)
    except ValueError as error:
        raise ValueError(f"{label}: {error}") from error
    return replace(geometry, X_WO=inspector.GetPoseInFrame(geometry_id).GetAsMatrix4(), label=label)


@dataclass(frozen=True, eq=False)
class RobotGeometries:
    """Collision geometries of a robot, with the plant that computes their poses from the robot's
    state.

    Attributes:
        plant: finalized plant; it is only read.
        model_instance: model instance of the robot in the plant.
        bodies: bodies with collision geometry.
        geometries: K geometries at their poses in their bodies; in place of an obstacle ID, each
            has the index of its body in `bodies`.
        context: Context of the plant, for computing poses.
    """

    plant: MultibodyPlant
    model_instance: ModelInstanceIndex
    bodies: tuple[RigidBody, ...]
    geometries: CollisionGeometries
    context: Context

    @property
    def num_states(self) -> int:
        """Number of elements of the robot's state [q, v]: joint positions q and velocities v."""
        return int(self.plant.num_multibody_states(self.model_instance))

    def posed(self, states: Sequence[FloatArray]) -> CollisionGeometries:
        """Computes the robot's collision geometries in the world, without velocities, for each of S
        robot states.

        Args:
            states: S arrays (num_states,) of positions and velocities [q, v].

        Returns:
            S times K geometries: the robot's K geometries at the first state, then at the second
            state, and so on.

        Raises:
            ValueError: for a state of the wrong size, or with an element that is not finite.
        """
        fixed, context = self.geometries, self.context
        in_body = np.dstack([fixed.X_WO, fixed.ball[:, :3]])
        posed = [in_body[:0]]
        for state in states:
            if np.shape(state) != (self.num_states,) or not np.isfinite(state).all():
                raise ValueError(
                    f"robot state: must be {self.num_states} finite numbers [q, v], not {state}"
                )
            self.plant.SetPositionsAndVelocities(context, self.model_instance, state)
            poses = [body.EvalPoseInWorld(context).GetAsMatrix34() for body in self.bodies]
            X_WB = np.reshape(poses, (-1, 3, 4))[fixed.layout[:, 5]]
            posed.append(X_WB[:, :, :3] @ in_body)
            posed[-1][:, :, 3:] += X_WB[:, :, 3:]
        columns = np.concatenate(posed)
        ball = np.tile(fixed.ball, (len(states), 1))
        ball[:, :3] = columns[:, :, 4]
        return fixed._replace(
            ball=ball,
            X_WO=np.ascontiguousarray(columns[:, :, :4]),
            size=np.tile(fixed.size, (len(states), 1)),
            layout=np.tile(fixed.layout, (len(states), 1)),
        )


def robot_geometries(
    plant: MultibodyPlant, inspector: drake.SceneGraphInspector, model_instance: ModelInstanceIndex
) -> RobotGeometries:
    """Reads the collision geometries of a robot, a model instance, from the scene graph of its
    plant.

    Args:
        plant: plant, finalized and registered with the scene graph of `inspector`.
        inspector: inspector of that scene graph.
        model_instance: model instance of the robot.

    Raises:
        ValueError: for a half-space or a shape that is not supported; the message names the
            geometry.
    """
    bodies, geometries = list[RigidBody](), list[CollisionGeometry]()
    for body in map(plant.get_body, plant.GetBodyIndices(model_instance)):
        if geometry_ids := plant.GetCollisionGeometriesForBody(body):
            read = [read_geometry(inspector, geometry_id) for geometry_id in geometry_ids]
            geometries += [replace(geometry, name=len(bodies)) for geometry in read]
            bodies.append(body)
    for geometry in geometries:
        if not math.isfinite(geometry.radius):
            raise ValueError(
                f"{geometry.label}: is a half-space; shapes of a robot must be bounded"
            )
    context = plant.CreateDefaultContext()
    return RobotGeometries(plant, model_instance, tuple(bodies), geometries_of(geometries), context)


def geometry_of(shape: drake.Shape) -> CollisionGeometry:
    """Returns the collision geometry of a Drake shape, with the identity as its pose.

    Meshes and convex shapes are not supported here; `read_geometry` reads them.

    Raises:
        ValueError: for a shape that is not supported.
    """
    if isinstance(shape, drake.Sphere):
        return CollisionGeometry(size=(0.0, 0.0, 0.0, shape.radius(), 0.0), radius=shape.radius())
    if isinstance(shape, drake.Box):
        half = 0.5 * shape.size()
        return CollisionGeometry(size=(*half, 0.0, 0.0), radius=math.hypot(*half))
    if isinstance(shape, drake.Capsule):
        half, radius = 0.5 * shape.length(), shape.radius()
        return CollisionGeometry(size=(0.0, 0.0, half, radius, 0.0), radius=half + radius)
    if isinstance(shape, drake.Cylinder):
        half, radius = 0.5 * shape.length(), shape.radius()
        return CollisionGeometry(
            size=(radius, radius, half, 0.0, 1.0), radius=math.hypot(radius, half)
        )
    if isinstance(shape, drake.Ellipsoid):
        size = shape.a(), shape.b(), shape.c()
        return CollisionGeometry(ELLIPSOID, size=(*size, 0.0, 0.0), radius=max(size))
    if isinstance(shape, drake.HalfSpace):
        return CollisionGeometry(HALF_SPACE)
    raise ValueError(
        f"shape {type(shape).__name__}: not supported; use a sphere, box, capsule, cylinder, "
        "ellipsoid, half-space, convex shape or mesh"
    )


def geometries_of(items: Sequence[CollisionGeometry]) -> CollisionGeometries:
    """Converts collision geometries to arrays for compiled kernels, in the same order.

    Raises:
        ValueError: for a pose or velocity that is not finite.
    """
    count = len(items)
    X_WO, ball = np.empty((count, 3, 4)), np.empty((count, 8))
    size, layout = np.zeros((count, 7)), np.zeros((count, 6), dtype=np.int64)
    count_faces = cells = 0
    grids: list[DistanceField] = []
    for row, item in enumerate(items):
        moves = bool(np.any(item.v_WO))
        if not (np.isfinite(item.X_WO).all() and np.isfinite(item.v_WO).all()):
            raise ValueError(
                f"collision geometry {row} ({item.label}): pose or velocity is not finite"
            )
        X_WO[row] = item.X_WO[:3]
        ball[row, :3] = X_WO[row, :, :3] @ item.center + X_WO[row, :, 3]
        ball[row, 3:] = item.radius, *item.v_WO, item.stamp if moves else 0.0
        size[row, : len(item.size)] = item.size
        layout[row, [0, 5]] = item.kind, item.name
        if item.kind == HULL:
            layout[row, 1:3] = count_faces, count_faces + len(item.faces)
            count_faces += len(item.faces)
        if item.grid is not None:
            layout[row, 1:5] = cells, *item.grid.values.shape
            grids.append(item.grid)
            cells += item.grid.values.size
    faces = np.concatenate([np.zeros((0, 13)), *(item.faces for item in items)])
    return CollisionGeometries(ball, X_WO, size, layout, faces, _voxels(*grids))


@dataclass(frozen=True, eq=False)
class CollisionScene(Frozen):
    """Collision geometries of one observation: obstacles and environment, without the robot.

    Attributes:
        stamp: time of the observation [s]; -inf before the first one.
        geometries: K collision geometries.
        labels: name of each geometry in messages.
        note: empty, or the reason why there is no newer observation.
    """

    stamp: float = -math.inf
    geometries: CollisionGeometries = field(default_factory=lambda: geometries_of([]))
    labels: tuple[str, ...] = ()
    note: str = ""

    @staticmethod
    def of(stamp: float, geometries: Sequence[CollisionGeometry], note: str = "") -> CollisionScene:
        """Builds a collision scene from a sequence of geometries, whose labels become those of the
        scene.

        Args:
            stamp: time of the observation [s].
            geometries: collision geometries of obstacles and environment.
            note: empty, or the reason why there is no newer observation.
        """
        return CollisionScene(
            stamp, geometries_of(geometries), tuple(geometry.label for geometry in geometries), note
        )

    def __post_init__(self) -> None:
        """Leaves the arrays writable, unlike the base class `Frozen`, because the kernels are
        compiled for writable arrays.

        No kernel writes to them.
        """

    def __len__(self) -> int:
        return len(self.labels)

    def at_rest(self) -> CollisionScene:
        """Returns this scene without its moving geometries."""
        if not self.moves:
            return self
        rows = ~self.geometries.moving
        labels = tuple(label for label, rests in zip(self.labels, rows, strict=True) if rests)
        return replace(self, geometries=self.geometries.select(rows), labels=labels)

    @property
    def is_finite(self) -> bool:
        """Whether the poses, velocities and stamps of all geometries of the scene are finite."""
        geometries = self.geometries
        return bool(
            np.isfinite(geometries.X_WO).all() and np.isfinite(geometries.ball[:, 4:]).all()
        )

    @property
    def moves(self) -> bool:
        """Whether any geometry of the scene moves."""
        return bool(self.geometries.moving.any())

    def same_as(self, other: CollisionScene) -> bool:
        """Checks whether another scene is the same object, or has the same geometries and labels.

        Two different objects with a moving geometry always count as different.
        """
        if self is other:
            return True
        if self.moves or other.moves or self.labels != other.labels:
            return False
        if self.geometries is other.geometries:
            return True
        # Resting geometries have the stamp 0.
        pairs = zip(self.geometries, other.geometries, strict=True)
        return all(np.array_equal(np.asarray(one), np.asarray(two)) for one, two in pairs)


@lru_cache(maxsize=2)
def _voxels(*grids: DistanceField) -> NDArray[np.float32]:
    """Concatenates the values of distance fields to one float32 array [m] for compiled kernels.

    The result is cached, since the fields of moving obstacles are constant in their frames.
    """
    none = np.zeros(0, dtype=np.float32)
    return np.concatenate([none, *(grid.values.ravel() for grid in grids)])


def outline_corners(geometry: CollisionGeometry) -> FloatArray:
    """Computes points whose convex hull encloses a collision geometry.

    These are the vertices of a box or a hull, and the corners of the bounding box of other shapes.

    Returns:
        (K, 3) points in the geometry's frame O [m].

    Raises:
        ValueError: for a half-space or the distance field of a cloud; the message contains the
            label.
    """
    if geometry.kind == HULL:
        return np.unique(geometry.faces[:, 4:].reshape(-1, 3), axis=0)
    return np.asarray(CORNERS * geometry.half_extents)


def surface_points(geometry: CollisionGeometry, count: int = 300) -> FloatArray:
    """Samples about `count` points on the surface of a collision geometry, deterministically.

    Corners, rims and poles are included, so that the convex hull of the points is the geometry, up
    to the sampling of curved surfaces.

    Args:
        geometry: a primitive (cylinder or rounded box, spheres and capsules included), an ellipsoid
            or a convex hull.
        count: desired number of points, at least 30.

    Returns:
        (N, 3) points in the geometry's frame O [m].

    Raises:
        ValueError: for a half-space or the distance field of a cloud; the message contains the
            label.
    """
    shell = geometry
    if geometry.kind != HULL:
        half, (*inner, radius, is_cylinder) = geometry.half_extents, geometry.size
        if geometry.kind == ELLIPSOID or not any(inner):
            return np.asarray(sphere_points(count) * half)
        corners = CORNERS * half
        if is_cylinder or radius:
            angle = np.arange(24) * (np.pi / 12.0)
            rim = half[0] * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
            corners = np.concatenate([rim - [0.0, 0.0, inner[2]], rim + [0.0, 0.0, inner[2]]])
        if radius:
            caps = radius * sphere_points(count // 4)
            caps[:, 2] += np.copysign(inner[2], caps[:, 2])
            corners = np.concatenate([corners, caps])
        shell = hull(corners)
    # The vertices, and points spread over the faces by area.
    vertices = outline_corners(shell)
    a, b, c = shell.faces[:, 4:].reshape(-1, 3, 3).swapaxes(0, 1)
    area = np.cumsum(np.linalg.norm(np.cross(b - a, c - a), axis=1))
    k = np.arange(max(0, count - len(vertices))) + 0.5
    face = np.searchsorted(area, k / max(1, len(k)) * area[-1])
    # Low-discrepancy barycentric coordinates, folded into the triangle.
    s, t = np.mod(k * 0.7548776662466927, 1.0), np.mod(k * 0.5698402909980532, 1.0)
    fold = s + t > 1.0
    s, t = np.where(fold, 1.0 - s, s)[:, None], np.where(fold, 1.0 - t, t)[:, None]
    within = a[face] + s * (b - a)[face] + t * (c - a)[face]
    return np.concatenate([vertices, within])


@leaf
def geometry_distance(
    geometries: CollisionGeometries, k: int, x: float, y: float, z: float, t: float
) -> float:
    """Computes the signed distance [m] from a point (x, y, z) in the world to collision geometry k
    at time t [s].

    The distance is exact, also inside, except for the distance field of a cloud: it is interpolated
    between the nodes of a grid and, outside the cloud, at most one voxel too large.
    """
    ball, X = geometries.ball, geometries.X_WO
    since = t - ball[k, 7]
    x -= X[k, 0, 3] + since * ball[k, 4]
    y -= X[k, 1, 3] + since * ball[k, 5]
    z -= X[k, 2, 3] + since * ball[k, 6]
    a = X[k, 0, 0] * x + X[k, 1, 0] * y + X[k, 2, 0] * z
    b = X[k, 0, 1] * x + X[k, 1, 1] * y + X[k, 2, 1] * z
    c = X[k, 0, 2] * x + X[k, 1, 2] * y + X[k, 2, 2] * z
    # Tuples of numbers, since a view of an array is an expensive argument of inlined functions.
    s, layout = geometries.size, geometries.layout
    size = (s[k, 0], s[k, 1], s[k, 2], s[k, 3], s[k, 4], s[k, 5], s[k, 6])
    span = (layout[k, 1], layout[k, 2], layout[k, 3], layout[k, 4])
    kind = layout[k, 0]
    if kind == PRIMITIVE:
        return _to_primitive(a, b, c, size)
    if kind == FIELD:
        return _interpolated(a, b, c, size, span, geometries.voxels)
    if kind == HALF_SPACE:
        return c
    if kind == ELLIPSOID:
        return to_ellipsoid(a, b, c, size)
    return _to_hull(geometries.faces, span, a, b, c)


@leaf
def ball_bound(
    geometries: CollisionGeometries, k: int, x: float, y: float, z: float, t: float
) -> float:
    """Computes a lower bound of the distance [m] from a point (x, y, z) in the world to collision
    geometry k at time t [s].

    The bound is the distance to the geometry's bounding sphere, negative inside; -inf for a
    half-space.
    """
    ball = geometries.ball
    since = t - ball[k, 7]
    x -= ball[k, 0] + since * ball[k, 4]
    y -= ball[k, 1] + since * ball[k, 5]
    z -= ball[k, 2] + since * ball[k, 6]
    return math.sqrt(x * x + y * y + z * z) - ball[k, 3]


@compiled
def least_distances(
    geometries: CollisionGeometries, points: FloatArray, t: float, upper: float, enough: float
) -> FloatArray:
    """Computes the signed distance of each of N points to the nearest of K collision geometries at
    a given time.

    Args:
        geometries: K collision geometries.
        points: (N, 3) points in the world [m]; the distance of a point that is NaN is `upper`.
        t: time [s].
        upper: maximum distance of interest [m]; farther geometries are skipped.
        enough: distance below which the search for a nearer geometry ends [m].

    Returns:
        (N,) distances [m], negative inside; `upper` without a nearer geometry.
    """
    distance, ball = np.full(len(points), upper), geometries.ball
    for k in range(len(ball)):
        since, radius = t - ball[k, 7], ball[k, 3]
        a = ball[k, 0] + since * ball[k, 4]
        b = ball[k, 1] + since * ball[k, 5]
        c = ball[k, 2] + since * ball[k, 6]
        for i in range(len(points)):
            if distance[i] < enough:
                continue
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            reach = distance[i] + radius
            square = (x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2
            if reach > 0.0 and square < reach * reach:
                distance[i] = min(distance[i], geometry_distance(geometries, k, x, y, z, t))
    return distance


@leaf
def _to_primitive(x: float, y: float, z: float, size: FloatArray) -> float:
    """Computes the signed distance [m] from a point to a primitive: a cylinder or a rounded box.

    Args:
        x, y, z: coordinates of the point in the frame of the primitive [m].
        size: for a rounded box, half extents of its inner box, the radius by which this box is
            dilated [m], and 0; for a cylinder about z, radius, radius, half its length, 0 [m], and
            1.
    """
    a, b, c = abs(x) - size[0], abs(y) - size[1], abs(z) - size[2]
    if size[4] != 0.0:
        a = math.sqrt(x * x + y * y) - size[0]
        b = min(a, 0.0)
    largest = max(a, b, c)
    if largest > 0.0:
        a, b, c = max(a, 0.0), max(b, 0.0), max(c, 0.0)
        largest = math.sqrt(a * a + b * b + c * c)
    return largest - size[3]


@leaf
def _to_hull(f: FloatArray, span: IntArray, x: float, y: float, z: float) -> float:
    """Computes the signed distance [m] from a point to a convex hull.

    Args:
        f: (F, 13) triangles of all hulls: outer unit normal (3), offset of the plane from the
            origin along the normal [m], and three corners (3 each) [m].
        span: index of the hull's first triangle, and one past its last.
        x, y, z: coordinates of the point in the frame of the hull [m].
    """
    largest, best = -np.inf, np.inf
    for n in range(span[0], span[1]):
        largest = max(largest, f[n, 0] * x + f[n, 1] * y + f[n, 2] * z - f[n, 3])
    if largest <= 0.0:
        return largest
    # Outside, the nearest triangle is one with the point on its outer side.
    for n in range(span[0], span[1]):
        above = f[n, 0] * x + f[n, 1] * y + f[n, 2] * z - f[n, 3]
        if above <= 0.0 or above * above >= best:
            continue
        ax, ay, az = x - f[n, 4], y - f[n, 5], z - f[n, 6]
        ux, uy, uz = f[n, 7] - f[n, 4], f[n, 8] - f[n, 5], f[n, 9] - f[n, 6]
        vx, vy, vz = f[n, 10] - f[n, 4], f[n, 11] - f[n, 5], f[n, 12] - f[n, 6]
        uu, vv = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz
        uv = ux * vx + uy * vy + uz * vz
        au, av = ax * ux + ay * uy + az * uz, ax * vx + ay * vy + az * vz
        # Barycentric coordinates of the second and third corner, times the determinant.
        det = uu * vv - uv * uv
        s, t = vv * au - uv * av, uu * av - uv * au
        if s >= 0.0 and t >= 0.0 and s + t <= det and det > 0.0:
            best = above * above
            continue
        # Otherwise the nearest point is on one of the three edges.
        first = min(max(au / uu, 0.0), 1.0)
        second = min(max(av / vv, 0.0), 1.0)
        third = min(max((av - au - uv + uu) / (uu + vv - 2.0 * uv), 0.0), 1.0)
        for p, q in ((first, 0.0), (0.0, second), (1.0 - third, third)):
            bx, by, bz = ax - p * ux - q * vx, ay - p * uy - q * vy, az - p * uz - q * vz
            best = min(best, bx * bx + by * by + bz * bz)
    return math.sqrt(best)


@leaf
def _interpolated(
    x: float, y: float, z: float, size: FloatArray, span: IntArray, voxels: NDArray[np.float32]
) -> float:
    """Interpolates a distance field at a point of its frame O [m]; outside the grid, the result is
    a lower bound of the distance.

    For a point q outside the grid, let c be the nearest point of the grid's box, and d(c) the
    interpolated distance at c, at least 0. The bound is sqrt(|q - c|^2 + d(c)^2) or, if larger, the
    distance to the bounding box of the nodes in the obstacle, less `OFFSET` voxels. The first bound
    holds because the grid's box is convex and contains the obstacle:
    |q - s|^2 >= |q - c|^2 + |c - s|^2 for each point s of the obstacle.

    Args:
        x, y, z: coordinates of the point [m].
        size: (7,) edge of a voxel, and low (3) and high corner (3) in O of the bounding box of the
            nodes in the obstacle [m].
        span: (4,) first element of the field in `voxels`, and numbers of nodes nx, ny, nz.
        voxels: concatenated values of all fields [m].
    """
    scale, ny, nz = 1.0 / size[0], span[2], span[3]
    u, v, w = x * scale, y * scale, z * scale
    # NaN becomes 0, so that no index is out of range.
    a = min(u, span[1] - 1.0) if u > 0.0 else 0.0
    b = min(v, ny - 1.0) if v > 0.0 else 0.0
    c = min(w, nz - 1.0) if w > 0.0 else 0.0
    i, j, k = min(int(a), span[1] - 2), min(int(b), ny - 2), min(int(c), nz - 2)
    fa, fb, fc = a - i, b - j, c - k
    at = span[0] + (i * ny + j) * nz + k
    beside = at + ny * nz
    v00, v01 = np.float64(voxels[at]), np.float64(voxels[at + 1])
    v10, v11 = np.float64(voxels[at + nz]), np.float64(voxels[at + nz + 1])
    w00, w01 = np.float64(voxels[beside]), np.float64(voxels[beside + 1])
    w10, w11 = np.float64(voxels[beside + nz]), np.float64(voxels[beside + nz + 1])
    v0, v1 = v00 + fc * (v01 - v00), v10 + fc * (v11 - v10)
    w0, w1 = w00 + fc * (w01 - w00), w10 + fc * (w11 - w10)
    low, high = v0 + fb * (v1 - v0), w0 + fb * (w1 - w0)
    d = low + fa * (high - low)
    if u == a and v == b and w == c:
        return d
    # Outside the grid: |q - c| along the clamped axes, and the field at c.
    away = max(d, 0.0)
    ex, ey, ez = (u - a) * size[0], (v - b) * size[0], (w - c) * size[0]
    far = math.sqrt(away * away + ex * ex + ey * ey + ez * ez)
    # The distance to the box of the occupied nodes is also a lower bound.
    px, py = x - min(max(x, size[1]), size[4]), y - min(max(y, size[2]), size[5])
    pz = z - min(max(z, size[3]), size[6])
    return max(far, math.sqrt(px * px + py * py + pz * pz) - OFFSET * size[0])
