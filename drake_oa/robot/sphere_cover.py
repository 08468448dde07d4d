"""A few spheres that enclose a body's collision shapes, proven, and how far they stick out."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pydrake.geometry as drake
from scipy.spatial.distance import cdist

from drake_oa.common.console import announce_first_use
from drake_oa.common.files import cached_arrays, package_file, read_arrays
from drake_oa.common.messages import BoolArray, FloatArray, IntArray
from drake_oa.geometry.collision_scene import (
    CORNERS,
    PRIMITIVE,
    CollisionGeometries,
    CollisionGeometry,
    geometries_of,
    geometry_of,
    least_distances,
    outline_corners,
    surface_points,
)
from drake_oa.geometry.directions import lattice

_MOST_CENTERS, _MOST_SAMPLES = 3000, 12000
"""Maximum numbers of candidate centers, and of points that must be covered, of a body."""
_SURFACE = 600
"""Points on the surface of a shape, about."""
_ALONG_EDGE = 2.7
"""Distance of balls along an edge, over the protrusion."""
_ROUNDS = 4
"""Maximum number of additions of bare points."""
_CELLS = 40
"""Cells along half of a body's longest extent that the proof begins with."""
_MANY = 300
"""Number of bare points from which the search restarts."""
_CERTAIN = 1.0 / 16.0
"""Half the edge of the smallest cells, over the protrusion."""
_WIDER = 1.2
"""Factor of the protrusion while the spheres are too many."""
_DIGITS = 9
"""Decimals of lengths [m] that tell shapes apart: those of one model differ less by rounding."""
_VERSION = 2
"""Version of the algorithm, to be raised when covers change: earlier ones are computed again."""
SHIPPED = package_file("package://drake_oa/panda/spheres.npz")
"""Covers of the Panda's bodies by `cover_key`: (K, 4) centers in the body's frame and radii [m]."""


@dataclass(frozen=True, eq=False)
class Cover:
    """Spheres that enclose a body's shapes.

    Attributes:
        centers: (K, 3) in the body's frame [m].
        radii: (K,) [m].
        protrusion: how far they stick out of the shapes at most [m].
    """

    centers: FloatArray
    radii: FloatArray
    protrusion: float


def cover(geometries: Sequence[CollisionGeometry], protrusion: float, most: int = 200) -> Cover:
    """Spheres that enclose the union of a body's shapes.

    Balls stand on a lattice in the shapes, each as large as sticks out by the asked protrusion: by
    its radius less the depth of its center, in a convex shape. A greedy set cover of points in
    the shapes takes few of them, and each becomes as small as these points let it. What lies
    between the points is proven by cells, halved where no ball holds the ball round the cell:
    what is found bare joins the points, and the last open cells have balls grow. Spheres stay.

    Args:
        geometries: the body's shapes, one at least, at their poses in the body.
        protrusion: by how much the spheres may stick out, but for the proof's growth [m].
        most: spheres at most; where more were needed the protrusion grows.

    Raises:
        ValueError: for a shape that is not bounded.
    """
    scene = geometries_of(geometries)
    if all(_is_rod(geometry) and geometry.size[2] == 0.0 for geometry in geometries):
        centers = np.array([geometry.X_WO[:3, 3] for geometry in geometries])
        return _measured(scene, centers, np.array([geometry.radius for geometry in geometries]))
    points, rounds, finer = _samples(geometries, scene, protrusion), 0, 0
    while True:
        certain = _CERTAIN * protrusion
        tried = (finer,) if finer else (1, 2, 3)
        found = [_chosen(geometries, scene, protrusion, certain, f, points) for f in tried]
        counts = [len(chosen) for *_, chosen in found]
        finer = tried[int(np.argmin(counts))]
        centers, depth, radii, chosen = found[int(np.argmin(counts))]
        if len(chosen) > most:
            protrusion, finer = protrusion * _WIDER, 0
            continue
        centers, radii, depth = centers[chosen], radii[chosen], depth[chosen]
        _tighten(centers, radii, points)
        # A ball that is not needed for any point has become one of no size.
        centers, depth = centers[radii > 0.0], depth[radii > 0.0]
        radii = radii[radii > 0.0] + math.sqrt(3.0) * certain
        many = _MANY if rounds < _ROUNDS else math.inf
        gaps, half = _gaps(geometries, scene, _balls_of(centers, radii), certain, many)
        if half <= certain:
            _grow(gaps, math.sqrt(3.0) * half, centers, depth, radii)
            if rounds >= _ROUNDS or (radii - depth).max() <= protrusion:
                break
        points, rounds = np.concatenate([points, gaps]), rounds + 1
    return _measured(scene, centers, radii)


def _balls_of(centers: FloatArray, radii: FloatArray) -> CollisionGeometries:
    """Makes the scene of balls with centers (K, 3) and radii (K,) [m]."""
    X_BO = np.tile(np.eye(4), (len(centers), 1, 1))
    X_BO[:, :3, 3] = centers
    balls = [geometry_of(drake.Sphere(radius)) for radius in radii]
    return geometries_of([replace(ball, X_WO=X) for ball, X in zip(balls, X_BO, strict=True)])


def known_cover(
    geometries: Sequence[CollisionGeometry], protrusion: float, most: int, announce: str
) -> Cover:
    """Reads a cover that is shipped or in the user's cache; else computes it, see `cover`.

    The Panda's bodies are in `SHIPPED`. The cache is the folder drake_oa/spheres; where it cannot
    be written, the cover is computed each time, which takes seconds.
    """

    def compute() -> dict[str, FloatArray]:
        announce_first_use(announce)
        found = cover(geometries, protrusion, most)
        return {"spheres": np.column_stack([found.centers, found.radii])}

    key = cover_key(geometries, protrusion, most)
    spheres = _shipped().get(key)
    if spheres is None:
        spheres = cached_arrays(f"spheres/{key}", compute)["spheres"]
    return _measured(geometries_of(geometries), spheres[:, :3], spheres[:, 3])


@cache
def _shipped() -> dict[str, FloatArray]:
    return read_arrays(SHIPPED)


def cover_key(geometries: Sequence[CollisionGeometry], protrusion: float, most: int = 200) -> str:
    """Computes a digest of a body's shapes and of the requested cover; arguments as of `cover`."""
    found = hashlib.sha256(repr((_VERSION, protrusion, most)).encode())
    for geometry in geometries:
        corners = geometry.placed(outline_corners(geometry))
        for values in (geometry.size, corners):
            # Without negative zeros.
            found.update(repr((np.round(values, _DIGITS) + 0.0).tolist()).encode())
    return found.hexdigest()[:32]


def _is_rod(geometry: CollisionGeometry) -> bool:
    """Returns whether it is a sphere or a capsule: balls on its z axis are the deepest."""
    return geometry.kind == PRIMITIVE and not any(geometry.size[:2])


def _measured(scene: CollisionGeometries, centers: FloatArray, radii: FloatArray) -> Cover:
    """Balls that enclose shapes, with how near they fit."""
    return Cover(centers, radii, max(0.0, float((radii + _distances(scene, centers)).max())))


def _distances(scene: CollisionGeometries, points: FloatArray) -> FloatArray:
    """Computes the signed distances (N,) of points (N, 3) to the nearest solid [m]."""
    return least_distances(scene, np.ascontiguousarray(points), 0.0, np.inf, -np.inf)


def _lattice(geometry: CollisionGeometry, inset: float, step: float, finer: int = 1) -> FloatArray:
    """Points in a shape, in the body's frame, (K, 3).

    Args:
        geometry: the shape.
        inset: how deep in the box round the shape the outermost are [m].
        step: how far apart they are at most [m].
        finer: into how many parts that is divided.
    """
    half = np.maximum(geometry.half_extents - inset, 0.0)
    if _is_rod(geometry):
        half, step = np.array([0.0, 0.0, geometry.size[2]]), min(step, 0.005)
    axes = [np.linspace(-h, h, 1 + finer * math.ceil(2.0 * h / step)) for h in half]
    p_BQ = geometry.placed(lattice(*axes) + geometry.center)
    return np.asarray(p_BQ[_distances(geometries_of([geometry]), p_BQ) <= 1e-9])


def _surface(geometry: CollisionGeometry) -> FloatArray:
    """Points (K, 3) on a shape, in the body's frame [m]."""
    return geometry.placed(surface_points(geometry, _SURFACE))


def _below_surface(geometry: CollisionGeometry, depth: float) -> FloatArray:
    """Points (K, 3) that far from those of the surface, towards their mean [m].

    Of a rod and of a box, the lattices of which have such points, there are none.
    """
    if geometry.kind == PRIMITIVE and not geometry.size[4]:
        return np.zeros((0, 3))
    surface = _surface(geometry)
    inwards = surface.mean(axis=0) - surface
    away = np.linalg.norm(inwards, axis=1, keepdims=True)
    return np.asarray(surface + inwards * np.minimum(1.0, depth / np.maximum(away, 1e-9)))


def _chosen(
    geometries: Sequence[CollisionGeometry],
    scene: CollisionGeometries,
    protrusion: float,
    certain: float,
    finer: int,
    points: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Balls (K, 3), their centers' depths and radii (K,), and which of them cover the points."""
    # In a row along a box's edge, each a step from the next and as deep as they stick out, balls
    # of twice the protrusion cover the edge with steps of up to 2 sqrt(2) of it.
    step = max(_ALONG_EDGE * protrusion, finer * _least_step(geometries, _MOST_CENTERS))
    while True:
        centers = np.concatenate(
            [_lattice(geometry, protrusion, step, finer) for geometry in geometries]
            + [_below_surface(geometry, protrusion) for geometry in geometries]
        )
        if len(centers) <= _MOST_CENTERS:
            break
        step *= 1.2
    depth = np.maximum(-_distances(scene, centers), 0.0)
    radii = depth + protrusion - math.sqrt(3.0) * certain
    return centers, depth, radii, _choose(cdist(points, centers) <= radii)


def _choose(covers: BoolArray) -> IntArray:
    """Rows of a few of K balls that cover N points, every point being in one at least.

    The point that the fewest balls cover is served first, by the ball that covers the most of
    what is left; balls that turn out superfluous go. Greedy set cover from the corners inwards.

    Args:
        covers: (N, K) which ball covers which point.
    """
    options, gain = covers.sum(axis=1), covers.sum(axis=0)
    times = np.zeros(len(covers), dtype=np.int64)
    chosen = []
    for n in np.argsort(options, kind="stable"):
        if times[n] == 0 < options[n]:
            best = int(np.where(covers[n], gain, -1).argmax())
            chosen.append(best)
            gain -= covers[covers[:, best] & (times == 0)].sum(axis=0)
            times += covers[:, best]
    kept = []
    for best in chosen:
        if (times[covers[:, best]] == 1).any():
            kept.append(best)
        else:
            times -= covers[:, best]
    return np.array(kept, dtype=np.int64)


def _tighten(centers: FloatArray, radii: FloatArray, points: FloatArray) -> None:
    """Makes each of K balls (K, 3), (K,) in turn as small as the points (N, 3) let it be."""
    away = cdist(centers, points)
    covers = away <= radii[:, None]
    times = covers.sum(axis=0)
    for k, mine in enumerate(covers):
        radii[k] = away[k, mine & (times == 1)].max(initial=0.0)
        times -= mine & (away[k] > radii[k])


def _grow(
    points: FloatArray, reach: float, centers: FloatArray, depth: FloatArray, radii: FloatArray
) -> None:
    """Makes balls larger until the ball of a reach round each of the points is in one of them.

    Args:
        points: (N, 3) [m].
        reach: [m].
        centers: (K, 3) the balls' [m].
        depth: (K,) of the centers in the shape; that which sticks out least by it grows [m].
        radii: (K,) [m]; some become larger.
    """
    while len(points):
        need = np.linalg.norm(centers - points[0], axis=1) + reach
        best = int((need - depth).argmin())
        radii[best] = max(need[best], radii[best])
        points = points[1:]
        points = points[np.linalg.norm(points - centers[best], axis=1) + reach > radii[best]]


def _samples(
    geometries: Sequence[CollisionGeometry], scene: CollisionGeometries, protrusion: float
) -> FloatArray:
    """Points on the outside of the shapes' union, and some in it, that are to be covered."""
    step = max(protrusion / 3.0, _least_step(geometries, 7 * _MOST_SAMPLES))
    while True:
        inner = np.concatenate([_lattice(geometry, 0.0, step) for geometry in geometries])
        depth = -_distances(scene, inner)
        outer, inner = inner[depth < 1e-9], inner[depth >= 1e-9][::7]
        if len(outer) + len(inner) <= _MOST_SAMPLES:
            break
        step *= 1.2
    surface = np.concatenate([_surface(geometry) for geometry in geometries])
    surface = surface[_distances(scene, surface) > -1e-6]
    return np.concatenate([surface, outer, inner])


def _least_step(geometries: Sequence[CollisionGeometry], count: int) -> float:
    """Returns the step of a lattice of about so many points in the boxes around the shapes."""
    volume = sum(
        float(np.prod(2.0 * geometry.half_extents))
        for geometry in geometries
        if not _is_rod(geometry)
    )
    return 0.8 * float(np.cbrt(volume / count))


def _gaps(
    geometries: Sequence[CollisionGeometry],
    scene: CollisionGeometries,
    balls: CollisionGeometries,
    certain: float,
    many: float,
) -> tuple[FloatArray, float]:
    """Middles (M, 3) of cells of the shapes that are not proven to be in a ball, and half an edge.

    The half edge is at most `certain`; or it is inf, and the middles, more than many, are bare
    themselves, and not all that are not proven.
    """
    corners = np.concatenate(
        [geometry.placed(outline_corners(geometry)) for geometry in geometries]
    )
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = float((high - low).max()) / _CELLS
    cells = lattice(*map(np.arange, low + half, high + half, 3 * [2.0 * half]))
    while True:
        reach = math.sqrt(3.0) * half
        # No farther, and no deeper, than decides.
        apart = least_distances(scene, cells, 0.0, 2.0 * reach, 0.0)
        cells, apart = cells[apart <= reach], apart[apart <= reach]
        short = least_distances(balls, cells, 0.0, 2.0 * reach, -reach)
        cells, apart, short = (array[short > -reach] for array in (cells, apart, short))
        bare = cells[(apart <= 0.0) & (short > certain)]
        if len(bare) > many:
            return bare, math.inf
        if half <= certain or len(cells) == 0:
            return cells, min(half, certain)
        half /= 2.0
        cells = (cells[:, None] + half * CORNERS).reshape(-1, 3)
