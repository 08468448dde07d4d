"""A few spheres that enclose a body's collision shapes, proven, and how far they stick out."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

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

from drake_oa.common.files import read_arrays, replace_arrays, user_cache
from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.collision_shapes import surface_points
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.robot import sphere_kernels as kernels
from drake_oa.robot.sphere_kernels import choose, grow, nearest_balls, tighten

_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_MOST_CENTERS, _MOST_SAMPLES = 3000, 12000
"""Of a body: where spheres may be, and points that must be in one."""
_ALONG_EDGE = 2.7
"""Distance of balls along an edge, over the overshoot."""
_ROUNDS = 4
"""How often points that were found bare are added at most."""
_CELLS = 40
"""Cells along half of a body's longest extent that the proof begins with."""
_MANY = 300
"""So many points that were found bare are enough to begin anew."""
_CERTAIN = 1.0 / 16.0
"""Half the edge of a cell that is split no more, over the overshoot."""
_WIDER = 1.2
"""By how much more the spheres may stick out where they would be too many."""


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex collision shape G in the frame of its body.

    Attributes:
        X_BG: (4, 4) its pose.
        half: (3,) half extents of a box round it, about its middle [m].
        middle: (3,) of that box, in the shape's frame [m].
        is_rod: whether balls about points of its z axis are as deep as can be.
        is_curved: whether its surface is not along the box's faces.
        signed: from points (N, 3) in the shape's frame to (N,) a lower bound of the signed
            distance, exact inside [m].
        surface: (K, 3) points on it, in the body's frame [m].
    """

    X_BG: FloatArray
    half: FloatArray
    middle: FloatArray
    is_rod: bool
    is_curved: bool
    signed: Callable[[FloatArray], FloatArray]
    surface: FloatArray

    def distance(self, p_BQ: FloatArray) -> FloatArray:
        """(N,) of points (N, 3) in the body's frame, see `signed` [m]."""
        # From the left: many times faster for many points.
        R_GB = self.X_BG[:3, :3].T.copy()
        return self.signed((R_GB @ p_BQ.T - (R_GB @ self.X_BG[:3, 3])[:, None]).T)

    def lattice(self, inset: float, step: float, finer: int = 1) -> FloatArray:
        """Points inside, in the body's frame, (K, 3).

        Args:
            inset: how deep in the box round the shape the outermost are [m].
            step: how far apart they are at most [m].
            finer: into how many parts that is divided.
        """
        half = np.maximum(self.half - inset, 0.0)
        if self.is_rod:
            half, step = self.half * [0.0, 0.0, 1.0], min(step, 0.005)
        axes = [np.linspace(-h, h, 1 + finer * math.ceil(2.0 * h / step)) for h in half]
        p_GQ = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + self.middle
        inside = p_GQ[self.signed(p_GQ) <= 1e-9]
        return np.asarray(inside @ self.X_BG[:3, :3].T + self.X_BG[:3, 3])

    def below_surface(self, depth: float) -> FloatArray:
        """Points (K, 3) that far from those of the surface, towards their mean [m]."""
        inwards = self.surface.mean(axis=0) - self.surface
        away = np.linalg.norm(inwards, axis=1, keepdims=True)
        return np.asarray(self.surface + inwards * np.minimum(1.0, depth / np.maximum(away, 1e-9)))


@dataclass(frozen=True, eq=False)
class Cover:
    """Spheres that enclose a body's shapes.

    Attributes:
        centers: (K, 3) in the body's frame [m].
        radii: (K,) [m].
        overshoot: how far they stick out of the shapes at most [m].
    """

    centers: FloatArray
    radii: FloatArray
    overshoot: float


def read_solid(inspector: SceneGraphInspector, geometry: GeometryId) -> Solid:
    """A geometry of a robot; a mesh counts as its convex hull, as in proximity queries.

    Raises:
        ValueError: for a shape that is not bounded.
    """
    shape = inspector.GetShape(geometry)
    X_BG = inspector.GetPoseInFrame(geometry).GetAsMatrix4()
    middle, is_rod = np.zeros(3), False
    if isinstance(shape, (Sphere, Capsule)):
        r, h = shape.radius(), shape.length() / 2.0 if isinstance(shape, Capsule) else 0.0
        # Middles of balls lie on the segment: nothing is gained beyond its ends.
        half, is_rod = np.array([r, r, h]), True

        def signed(p: FloatArray) -> FloatArray:
            z = p[:, 2] - np.clip(p[:, 2], -h, h)
            return np.asarray(np.sqrt(p[:, 0] ** 2 + p[:, 1] ** 2 + z * z) - r)
    elif isinstance(shape, Cylinder):
        r, h = shape.radius(), shape.length() / 2.0
        half = np.array([r, r, h])

        def signed(p: FloatArray) -> FloatArray:
            return np.maximum(np.hypot(p[:, 0], p[:, 1]) - r, np.abs(p[:, 2]) - h)
    elif isinstance(shape, Box):
        half = np.asarray(shape.size()) / 2.0

        def signed(p: FloatArray) -> FloatArray:
            return np.asarray((np.abs(p) - half).max(axis=1))
    elif isinstance(shape, Ellipsoid):
        half = np.array([shape.a(), shape.b(), shape.c()])

        def signed(p: FloatArray) -> FloatArray:
            return np.asarray(signed_distance(p, np.zeros(3), np.eye(3), half))
    elif isinstance(shape, (Convex, Mesh)):
        corners, planes = _hull(inspector, geometry)
        low, high = corners.min(axis=0), corners.max(axis=0)
        half, middle = (high - low) / 2.0, (high + low) / 2.0

        def signed(p: FloatArray) -> FloatArray:
            return np.asarray((p @ planes[:, :3].T - planes[:, 3]).max(axis=1))
    else:
        raise ValueError(
            f"{inspector.GetName(geometry)} is a {type(shape).__name__}; a robot's collision shape "
            "must be a sphere, capsule, box, cylinder, ellipsoid, convex shape or mesh"
        )
    surface = surface_points(inspector, geometry, 600)
    is_curved = not is_rod and not isinstance(shape, Box)
    return Solid(X_BG, half, middle, is_rod, is_curved, signed, surface)


def _hull(inspector: SceneGraphInspector, geometry: GeometryId) -> tuple[FloatArray, FloatArray]:
    """Corners (K, 3) of a convex hull, and its faces (F, 4): outward normal and offset."""
    mesh = inspector.GetConvexHull(geometry)
    corners = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
    inside, planes = corners.mean(axis=0), []
    for i in range(mesh.num_elements()):
        face = mesh.element(i)
        p = corners[[face.vertex(k) for k in range(face.num_vertices())]]
        normal = np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0)
        size = float(np.linalg.norm(normal))
        if size > 0.0:
            normal = normal / size * (1.0 if (p.mean(axis=0) - inside) @ normal >= 0.0 else -1.0)
            # The farthest corner: a face is flat to rounding only.
            planes.append(np.append(normal, (corners @ normal).max()))
    return corners, np.array(planes)


def cover(solids: Sequence[Solid], overshoot: float, most: int = 200) -> Cover:
    """Spheres that enclose the union of a body's shapes.

    Balls stand on a lattice in the shapes, each as large as sticks out by the asked overshoot: by
    its radius less the depth of its centre, in a convex shape. A greedy set cover of points in
    the shapes takes few of them, and each becomes as small as these points let it. What lies
    between the points is proven by cells, halved where no ball holds the ball round the cell:
    what is found bare joins the points, and the last open cells have balls grow. Spheres stay.

    Args:
        solids: the body's shapes, one at least.
        overshoot: by how much the spheres may stick out, but for the proof's growth [m].
        most: spheres at most; where more were needed the overshoot grows.

    Raises:
        ValueError: for a limit that is not positive.
    """
    if not (overshoot > 0.0 and most >= len(solids)):
        raise ValueError(
            f"overshoot must be positive, and most at least {len(solids)}, a sphere a shape: "
            f"not {overshoot} and {most}"
        )

    def distance(p_BQ: FloatArray) -> FloatArray:
        return np.asarray(np.min([solid.distance(p_BQ) for solid in solids], axis=0))

    if all(solid.is_rod and solid.half[2] == 0.0 for solid in solids):
        centers = np.array([solid.X_BG[:3, 3] for solid in solids])
        return _measured(distance, centers, np.array([s.half[0] for s in solids]))
    points, rounds, finer = _samples(solids, distance, overshoot), 0, 0
    while True:
        certain = _CERTAIN * overshoot
        tried = (finer,) if finer else (1, 2, 3)
        found = [_chosen(solids, distance, overshoot, certain, f, points) for f in tried]
        counts = [len(chosen) for *_, chosen in found]
        finer = tried[int(np.argmin(counts))]
        centers, depth, radii, chosen = found[int(np.argmin(counts))]
        if len(chosen) > most:
            overshoot, finer = overshoot * _WIDER, 0
            continue
        centers, radii, depth = centers[chosen], radii[chosen], depth[chosen]
        tighten(centers, radii, points)
        # A ball that is not needed for any point has become one of no size.
        centers, depth = centers[radii > 0.0], depth[radii > 0.0]
        radii = radii[radii > 0.0] + math.sqrt(3.0) * certain
        many = _MANY if rounds < _ROUNDS else math.inf
        gaps, half = _gaps(solids, distance, centers, radii, certain, many)
        if half <= certain:
            grow(gaps, math.sqrt(3.0) * half, centers, depth, radii)
            if rounds >= _ROUNDS or (radii - depth).max() <= overshoot:
                break
        points, rounds = np.concatenate([points, gaps]), rounds + 1
    return _measured(distance, centers, radii)


def known_cover(solids: Sequence[Solid], overshoot: float, most: int = 200) -> Cover:
    """As `cover`; what has been found before is read from the user's cache, drake_oa/spheres.

    It takes seconds. Where the folder cannot be written, it takes them each time.
    """
    made = user_cache("spheres") / f"{_digest(solids, overshoot, most)}.npz"
    try:
        known = read_arrays(made)
        return Cover(known["centers"], known["radii"], float(known["overshoot"]))
    except (OSError, ValueError, KeyError):
        found = cover(solids, overshoot, most)
    with suppress(OSError):
        replace_arrays(made, vars(found))
    return found


def _digest(solids: Sequence[Solid], overshoot: float, most: int) -> str:
    """Of all that a cover depends on, this program included."""
    found = hashlib.sha256(repr((overshoot, most, np.__version__)).encode())
    for module in (__file__, kernels.__file__):
        found.update(Path(module).read_bytes())
    for solid in solids:
        found.update(repr((solid.is_rod, solid.is_curved)).encode())
        for array in (solid.X_BG, solid.half, solid.middle, solid.surface):
            found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()[:32]


def _measured(
    distance: Callable[[FloatArray], FloatArray], centers: FloatArray, radii: FloatArray
) -> Cover:
    """Balls that enclose shapes, with how near they fit."""
    return Cover(centers, radii, max(0.0, float((radii + distance(centers)).max())))


def _chosen(
    solids: Sequence[Solid],
    distance: Callable[[FloatArray], FloatArray],
    overshoot: float,
    certain: float,
    finer: int,
    points: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Balls (K, 3), their centres' depths and radii (K,), and which of them cover the points."""
    # In a row along a box's edge, each a step from the next and as deep as they stick out, balls
    # of twice the overshoot cover the edge with steps of up to 2 sqrt(2) of it.
    step = max(_ALONG_EDGE * overshoot, finer * _least_step(solids, _MOST_CENTERS))
    while True:
        centers = np.concatenate(
            [solid.lattice(overshoot, step, finer) for solid in solids]
            + [solid.below_surface(overshoot) for solid in solids if solid.is_curved]
        )
        if len(centers) <= _MOST_CENTERS:
            break
        step *= 1.2
    depth = np.maximum(-distance(centers), 0.0)
    radii = depth + overshoot - math.sqrt(3.0) * certain
    return centers, depth, radii, choose(centers, radii, points)


def _samples(
    solids: Sequence[Solid], distance: Callable[[FloatArray], FloatArray], overshoot: float
) -> FloatArray:
    """Points on the outside of the shapes' union, and some in it, that are to be covered."""
    step = max(overshoot / 3.0, _least_step(solids, 7 * _MOST_SAMPLES))
    while True:
        inner = np.concatenate([solid.lattice(0.0, step) for solid in solids])
        depth = -distance(inner)
        outer, inner = inner[depth < 1e-9], inner[depth >= 1e-9][::7]
        if len(outer) + len(inner) <= _MOST_SAMPLES:
            break
        step *= 1.2
    surface = np.concatenate([solid.surface for solid in solids])
    surface = surface[distance(surface) > -1e-6]
    return np.ascontiguousarray(np.concatenate([surface, outer, inner]))


def _least_step(solids: Sequence[Solid], count: int) -> float:
    """Of a lattice in the boxes round the shapes that has about so many points, or a few more."""
    volume = sum(float(np.prod(2.0 * solid.half)) for solid in solids if not solid.is_rod)
    return 0.8 * float(np.cbrt(volume / count))


def _gaps(
    solids: Sequence[Solid],
    distance: Callable[[FloatArray], FloatArray],
    centers: FloatArray,
    radii: FloatArray,
    certain: float,
    many: float,
) -> tuple[FloatArray, float]:
    """Middles (M, 3) of cells of the shapes that are not proven to be in a ball, and half an edge.

    The half edge is at most `certain`; or else the middles, more than many, are bare themselves.
    """
    low, high = _box(solids)
    half = float((high - low).max()) / _CELLS
    axes = [np.arange(a + half, b + half, 2.0 * half) for a, b in zip(low, high, strict=True)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    while True:
        reach = math.sqrt(3.0) * half
        apart = distance(cells)
        cells, apart = cells[apart <= reach], apart[apart <= reach]
        short = nearest_balls(cells, centers, radii)
        cells, apart, short = (array[short > -reach] for array in (cells, apart, short))
        bare = cells[(apart <= 0.0) & (short > certain)]
        if half <= certain or len(bare) > many or len(cells) == 0:
            return (cells, min(half, certain)) if len(bare) <= many else (bare, half)
        half /= 2.0
        cells = (cells[:, None] + half * _CORNERS).reshape(-1, 3)


def _box(solids: Sequence[Solid]) -> tuple[FloatArray, FloatArray]:
    """Least and largest coordinates of the shapes, in the body's frame, (3,) each [m]."""
    corners = []
    for solid in solids:
        half = solid.half + ([0.0, 0.0, solid.half[0]] if solid.is_rod else [0.0, 0.0, 0.0])
        corners.append((solid.middle + _CORNERS * half) @ solid.X_BG[:3, :3].T + solid.X_BG[:3, 3])
    points = np.concatenate(corners)
    return points.min(axis=0), points.max(axis=0)
