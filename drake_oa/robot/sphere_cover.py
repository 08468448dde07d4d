"""Covers of a body's collision shapes by few spheres, which are proven to enclose the shapes.

`compute_cover` computes a cover, and `load_cover` reads it from a cache. Distances to the spheres
replace distances to the shapes when clearances are computed.
"""

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

_MAX_CENTERS = 3000
"""Maximum number of candidate sphere centers, from which the centers that cover a body are
selected."""
_MAX_SAMPLES = 12000
"""Maximum number of lattice points in a body that the spheres must cover, in addition to sample
points on the surfaces of its shapes."""
_N_SURFACE_POINTS = 600
"""Approximate number of sample points on the surface of each shape of a body, which the spheres
must cover."""
_EDGE_SPACING = 2.7
"""Lattice spacing of candidate sphere centers, relative to the requested protrusion of the spheres
from the body [-]. If this ratio is below 2 sqrt(2), spheres along the edge of a box cover the edge.
Lattices with the spacing divided by 1, 2 and 3 are compared, and the one that needs the fewest
spheres is used. The spacing is larger if there would be more than `_MAX_CENTERS` centers."""
_MAX_ITERATIONS = 4
"""Maximum number of repetitions of the selection of spheres that cover a body. Before each
repetition, uncovered points of the body are added to the sample points. After the last one, the
spheres grow until they cover the body."""
_INITIAL_CELLS = 40
"""Twice the number of initial cubic cells along a body's longest extent [-]. The body is divided
into cells to prove that spheres cover it."""
_MAX_GAPS = 300
"""Maximum number of uncovered points in the proof that spheres enclose a body. If more are found,
the proof ends early, and the spheres are selected again."""
_MIN_CELL_RATIO = 1.0 / 16.0
"""Half the edge of the smallest cubic cells, relative to the requested protrusion of the spheres
from the body [-]. The body is divided into cells to prove that spheres cover it."""
_PROTRUSION_GROWTH = 1.2
"""Factor by which the requested protrusion of the spheres from a body is multiplied, if necessary
several times, until the maximum number of spheres suffices [-]."""
_DIGITS = 9
"""Number of decimals of lengths [m] in the cache key of a body's sphere cover, so that rounding
errors do not change the key."""
_VERSION = 3
"""Version of the algorithm that covers a body by spheres, a part of the cache key of a cover; to
be incremented when covers change."""
SHIPPED = package_file("package://drake_oa/panda/spheres.npz")
"""File with the precomputed sphere covers of the Panda's bodies: cache key of a body's shapes ->
(K, 4) centers in the frame of the body, and radii [m]."""


@dataclass(frozen=True, eq=False)
class Cover:
    """Set of K spheres that enclose a body's collision shapes.

    Attributes:
        centers: (K, 3) centers in the frame of the body [m].
        radii: (K,) radii [m].
        protrusion: maximum protrusion of the spheres from the shapes [m].
    """

    centers: FloatArray
    radii: FloatArray
    protrusion: float


def compute_cover(
    geometries: Sequence[CollisionGeometry], protrusion: float, max_spheres: int = 200
) -> Cover:
    """Computes spheres that enclose the union of a body's shapes.

    1. Candidate spheres are centered on a lattice in the shapes. The radius is the depth of the
       center below the surface plus the requested protrusion. The sphere thus protrudes by this
       distance from a convex shape, and at most by this distance from others.
    2. A greedy set cover selects few candidates that cover sample points in the shapes. Each
       selected sphere shrinks to the points that no other sphere covers.
    3. The space between the points is proven to be covered, by cubic cells: a cell is divided into
       eight unless a sphere contains the ball around the cell. Uncovered cell centers are added to
       the sample points, and step 2 is repeated. Finally the spheres grow until they contain the
       unproven cells of the smallest size.

    If all shapes are spheres, these spheres are the cover.

    Args:
        geometries: shapes of the body, at least one, at their poses in the frame of the body.
        protrusion: requested protrusion of the spheres from the shapes; step 3 may enlarge it [m].
        max_spheres: maximum number of spheres; the protrusion grows if more would be required.

    Raises:
        ValueError: for a shape that is not bounded.
    """
    scene = geometries_of(geometries)
    if all(_is_rod(geometry) and geometry.size[2] == 0.0 for geometry in geometries):
        centers = np.array([geometry.X_WO[:3, 3] for geometry in geometries])
        return _make_cover(scene, centers, np.array([geometry.radius for geometry in geometries]))
    points, iteration, refinement = _sample_shapes(geometries, scene, protrusion), 0, 0
    while True:
        min_half = _MIN_CELL_RATIO * protrusion
        refinements = (refinement,) if refinement else (1, 2, 3)
        candidates = [
            _select_balls(geometries, scene, protrusion, min_half, f, points) for f in refinements
        ]
        counts = [len(chosen) for *_, chosen in candidates]
        refinement = refinements[int(np.argmin(counts))]
        centers, depth, radii, chosen = candidates[int(np.argmin(counts))]
        if len(chosen) > max_spheres:
            protrusion, refinement = protrusion * _PROTRUSION_GROWTH, 0
            continue
        centers, radii, depth = centers[chosen], radii[chosen], depth[chosen]
        _shrink(centers, radii, points)
        # A ball that is not required by any point has shrunk to radius 0.
        centers, depth = centers[radii > 0.0], depth[radii > 0.0]
        radii = radii[radii > 0.0] + math.sqrt(3.0) * min_half
        max_gaps = _MAX_GAPS if iteration < _MAX_ITERATIONS else math.inf
        gaps, half = _find_gaps(
            geometries, scene, _ball_geometries(centers, radii), min_half, max_gaps
        )
        if half <= min_half:
            _enlarge(gaps, math.sqrt(3.0) * half, centers, depth, radii)
            if iteration >= _MAX_ITERATIONS or (radii - depth).max() <= protrusion:
                break
        points, iteration = np.concatenate([points, gaps]), iteration + 1
    return _make_cover(scene, centers, radii)


def _ball_geometries(centers: FloatArray, radii: FloatArray) -> CollisionGeometries:
    """Returns balls with centers (K, 3) in the frame of a body and radii (K,) as collision
    geometries, for distance computations [m].
    """
    X_BO = np.tile(np.eye(4), (len(centers), 1, 1))
    X_BO[:, :3, 3] = centers
    balls = [geometry_of(drake.Sphere(radius)) for radius in radii]
    return geometries_of([replace(ball, X_WO=X) for ball, X in zip(balls, X_BO, strict=True)])


def load_cover(
    geometries: Sequence[CollisionGeometry], protrusion: float, max_spheres: int, message: str
) -> Cover:
    """Loads the sphere cover of a body from a file or from the user's cache, or else computes it by
    `compute_cover` and stores it.

    The file `SHIPPED` contains the covers of the Panda; other covers are in the user's cache folder
    drake_oa/spheres. If the cache is not writable, the cover is computed each time, which takes
    seconds.

    Args:
        geometries: shapes of the body, at least one, at their poses in the frame of the body.
        protrusion: requested protrusion of the spheres from the shapes [m].
        max_spheres: maximum number of spheres.
        message: message that is printed before the first computation, which may last seconds.
    """

    def compute() -> dict[str, FloatArray]:
        announce_first_use(message)
        result = compute_cover(geometries, protrusion, max_spheres)
        return {"spheres": np.column_stack([result.centers, result.radii])}

    key = cover_key(geometries, protrusion, max_spheres)
    spheres = _shipped().get(key)
    if spheres is None:
        spheres = cached_arrays(f"spheres/{key}", compute)["spheres"]
    return _make_cover(geometries_of(geometries), spheres[:, :3], spheres[:, 3])


@cache
def _shipped() -> dict[str, FloatArray]:
    """Reads the precomputed sphere covers of the Panda's bodies from the file `SHIPPED`: cache key
    of a body's shapes -> (K, 4) centers in the frame of the body, and radii [m].
    """
    return read_arrays(SHIPPED)


def cover_key(
    geometries: Sequence[CollisionGeometry], protrusion: float, max_spheres: int = 200
) -> str:
    """Computes the cache key of a sphere cover: a digest (32 hexadecimal digits) of the body's
    shapes, the requested protrusion [m], the maximum number of spheres and the algorithm's version.
    """
    digest = hashlib.sha256(repr((_VERSION, protrusion, max_spheres)).encode())
    for geometry in geometries:
        corners = geometry.placed(outline_corners(geometry))
        for values in (geometry.size, corners):
            # Adding 0.0 removes negative zeros.
            digest.update(repr((np.round(values, _DIGITS) + 0.0).tolist()).encode())
    return digest.hexdigest()[:32]


def _is_rod(geometry: CollisionGeometry) -> bool:
    """Checks whether a shape is a sphere or a capsule, which is covered best by balls with centers
    on the shape's z axis.
    """
    return geometry.kind == PRIMITIVE and not any(geometry.size[:2])


def _make_cover(scene: CollisionGeometries, centers: FloatArray, radii: FloatArray) -> Cover:
    """Creates the cover of a body from its spheres, and computes their maximum protrusion from the
    body's shapes.

    Args:
        scene: shapes of the body, in the frame of the body.
        centers: (K, 3) centers of the spheres in the frame of the body [m].
        radii: (K,) radii of the spheres [m].
    """
    return Cover(centers, radii, max(0.0, float((radii + _distances(scene, centers)).max())))


def _distances(scene: CollisionGeometries, points: FloatArray) -> FloatArray:
    """Computes the signed distance (N,) from each of N points (N, 3), in the frame of a body, to
    the nearest shape of the body, negative inside [m].
    """
    return least_distances(scene, np.ascontiguousarray(points), 0.0, np.inf, -np.inf)


def _lattice(
    geometry: CollisionGeometry, inset: float, step: float, refinement: int = 1
) -> FloatArray:
    """Computes lattice points (K, 3) inside a shape, in the frame of the body, used as candidate
    centers of spheres and as sample points [m].

    Args:
        geometry: shape.
        inset: distance of the outermost points from the bounding box of the shape [m].
        step: maximum spacing of the points along each axis before refinement [m].
        refinement: number of equal parts into which the spacing is divided. The refined lattice
            contains the points of the unrefined one.
    """
    half = np.maximum(geometry.half_extents - inset, 0.0)
    if _is_rod(geometry):
        half, step = np.array([0.0, 0.0, geometry.size[2]]), min(step, 0.005)
    axes = [np.linspace(-h, h, 1 + refinement * math.ceil(2.0 * h / step)) for h in half]
    p_BQ = geometry.placed(lattice(*axes) + geometry.center)
    return np.asarray(p_BQ[_distances(geometries_of([geometry]), p_BQ) <= 1e-9])


def _below_surface(geometry: CollisionGeometry, depth: float, count: int) -> FloatArray:
    """Computes candidate sphere centers (K, 3) below the surface of a shape, in the frame of the
    body: points of the surface, moved by a depth toward the mean of these points [m].

    The result is empty for spheres, capsules and boxes, because lattices in these shapes already
    contain such points.

    Args:
        geometry: shape.
        depth: distance by which the points are moved, at most to the mean [m].
        count: approximate number of points.
    """
    if geometry.kind == PRIMITIVE and not geometry.size[4]:
        return np.zeros((0, 3))
    surface = geometry.placed(surface_points(geometry, count))
    direction = surface.mean(axis=0) - surface
    distance = np.linalg.norm(direction, axis=1, keepdims=True)
    return np.asarray(surface + direction * np.minimum(1.0, depth / np.maximum(distance, 1e-9)))


def _select_balls(
    geometries: Sequence[CollisionGeometry],
    scene: CollisionGeometries,
    protrusion: float,
    min_half: float,
    refinement: int,
    points: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, IntArray]:
    """Computes candidate balls in the shapes of a body, and selects few of them that cover sample
    points.

    Args:
        geometries, scene: shapes of the body, as a sequence and as arrays.
        protrusion: requested protrusion of the balls from the shapes [m].
        min_half: half the edge of the smallest cubic cells by which `compute_cover` later checks
            that the balls cover the shapes [m]. The radii are reduced by half the diagonal of such
            a cell. Afterwards `compute_cover` enlarges the balls by the same length, so that a ball
            that contains a sample point also contains a cell around this point.
        refinement: number of parts into which the spacing of the lattice of candidate centers is
            divided.
        points: (N, 3) sample points in the frame of the body [m].

    Returns:
        Centers (K, 3) in the frame of the body, depths of the centers in the shapes (K,), and radii
        (K,) of candidate balls [m]; and the indices of the selected balls.
    """
    # Balls of radius 2 p at depth p below the edge of a box cover the edge if their spacing along
    # it is at most 2 sqrt(2) p.
    step = max(_EDGE_SPACING * protrusion, refinement * _lattice_step(geometries, _MAX_CENTERS))
    # A lattice of this spacing has the corners of the bounding boxes only.
    coarsest = 2.0 * max(float(geometry.half_extents.max()) for geometry in geometries)
    # At most half of the centers are below the surfaces of the shapes.
    count = min(_N_SURFACE_POINTS, max(30, _MAX_CENTERS // (2 * len(geometries))))
    below = [_below_surface(geometry, protrusion, count) for geometry in geometries]
    while True:
        centers = np.concatenate(
            [_lattice(geometry, protrusion, step, refinement) for geometry in geometries] + below
        )
        if len(centers) <= _MAX_CENTERS or step >= coarsest:
            break
        step *= 1.2
    depth = np.maximum(-_distances(scene, centers), 0.0)
    radii = depth + protrusion - math.sqrt(3.0) * min_half
    return centers, depth, radii, _greedy_cover(cdist(points, centers) <= radii)


def _greedy_cover(covers: BoolArray) -> IntArray:
    """Selects few of K balls that together cover N points, by a greedy set cover that begins at
    points covered by few balls, such as corners.

    For each point that is not covered yet, the ball with the most uncovered points is selected.
    Balls that become unnecessary are removed.

    Args:
        covers: (N, K) whether ball k covers point n; a point that no ball covers is ignored.

    Returns:
        Indices of the selected balls.
    """
    n_options, gain = covers.sum(axis=1), covers.sum(axis=0)
    counts = np.zeros(len(covers), dtype=np.int64)
    chosen = []
    for n in np.argsort(n_options, kind="stable"):
        if counts[n] == 0 < n_options[n]:
            best = int(np.where(covers[n], gain, -1).argmax())
            chosen.append(best)
            gain -= covers[covers[:, best] & (counts == 0)].sum(axis=0)
            counts += covers[:, best]
    necessary = []
    for best in chosen:
        if (counts[covers[:, best]] == 1).any():
            necessary.append(best)
        else:
            counts -= covers[:, best]
    return np.array(necessary, dtype=np.int64)


def _shrink(centers: FloatArray, radii: FloatArray, points: FloatArray) -> None:
    """Shrinks each ball of a cover, one after another, to the points that no other ball covers.

    Args:
        centers: (K, 3) centers of the balls [m].
        radii: (K,) radii, modified in place; 0 for a ball that is not required [m].
        points: (N, 3) points that remain covered [m].
    """
    distance = cdist(centers, points)
    covers = distance <= radii[:, None]
    counts = covers.sum(axis=0)
    for k, is_covered in enumerate(covers):
        radii[k] = distance[k, is_covered & (counts == 1)].max(initial=0.0)
        counts -= is_covered & (distance[k] > radii[k])


def _enlarge(
    points: FloatArray, reach: float, centers: FloatArray, depth: FloatArray, radii: FloatArray
) -> None:
    """Enlarges balls, in place, until each given point, with a neighborhood around it, is inside
    one ball.

    For each point, the ball grows that protrudes least from the shapes afterwards.

    Args:
        points: (N, 3) points [m].
        reach: radius of the neighborhood of each point [m].
        centers: (K, 3) centers of the balls [m].
        depth: (K,) depths of the centers in the shapes [m].
        radii: (K,) radii of the balls, modified in place [m].
    """
    while len(points):
        required_radius = np.linalg.norm(centers - points[0], axis=1) + reach
        best = int((required_radius - depth).argmin())
        radii[best] = max(required_radius[best], radii[best])
        points = points[1:]
        points = points[np.linalg.norm(points - centers[best], axis=1) + reach > radii[best]]


def _sample_shapes(
    geometries: Sequence[CollisionGeometry], scene: CollisionGeometries, protrusion: float
) -> FloatArray:
    """Samples points (N, 3) on the surface and in the interior of a body's shapes, in the frame of
    the body, which the spheres of a cover must contain [m].
    """
    step = max(protrusion / 3.0, _lattice_step(geometries, 7 * _MAX_SAMPLES))
    while True:
        inner = np.concatenate([_lattice(geometry, 0.0, step) for geometry in geometries])
        depth = -_distances(scene, inner)
        outer, inner = inner[depth < 1e-9], inner[depth >= 1e-9][::7]
        if len(outer) + len(inner) <= _MAX_SAMPLES:
            break
        step *= 1.2
    surface = np.concatenate([g.placed(surface_points(g, _N_SURFACE_POINTS)) for g in geometries])
    surface = surface[_distances(scene, surface) > -1e-6]
    return np.concatenate([surface, outer, inner])


def _lattice_step(geometries: Sequence[CollisionGeometry], count: int) -> float:
    """Computes the spacing of a point lattice that has about twice `count` points in the bounding
    boxes of the shapes, not counting spheres and capsules [m].
    """
    volume = sum(
        float(np.prod(2.0 * geometry.half_extents))
        for geometry in geometries
        if not _is_rod(geometry)
    )
    return 0.8 * float(np.cbrt(volume / count))


def _find_gaps(
    geometries: Sequence[CollisionGeometry],
    scene: CollisionGeometries,
    balls: CollisionGeometries,
    min_half: float,
    max_gaps: float,
) -> tuple[FloatArray, float]:
    """Searches the shapes of a body for cells that are not proven to be inside a ball of its cover.

    Cells are cubes; unproven cells are divided into eight until half their edge is at most
    `min_half`.

    Args:
        geometries, scene: shapes of the body, as a sequence and as arrays.
        balls: balls of the cover.
        min_half: half the edge of the smallest cells [m].
        max_gaps: number of uncovered cell centers above which the search stops.

    Returns:
        Centers (M, 3) of the unproven cells in the frame of the body, and half their edge, at most
        `min_half` [m]. If the search stops early: cell centers that no ball contains, and inf.
    """
    corners = np.concatenate(
        [geometry.placed(outline_corners(geometry)) for geometry in geometries]
    )
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = float((high - low).max()) / _INITIAL_CELLS
    cells = lattice(*map(np.arange, low + half, high + half, 3 * [2.0 * half]))
    while True:
        reach = math.sqrt(3.0) * half
        # Distances beyond these bounds do not affect the result.
        shape_distance = least_distances(scene, cells, 0.0, 2.0 * reach, 0.0)
        cells, shape_distance = (
            cells[shape_distance <= reach],
            shape_distance[shape_distance <= reach],
        )
        ball_distance = least_distances(balls, cells, 0.0, 2.0 * reach, -reach)
        cells, shape_distance, ball_distance = (
            array[ball_distance > -reach] for array in (cells, shape_distance, ball_distance)
        )
        uncovered = cells[(shape_distance <= 0.0) & (ball_distance > min_half)]
        if len(uncovered) > max_gaps:
            return uncovered, math.inf
        if half <= min_half or len(cells) == 0:
            return cells, min(half, min_half)
        half /= 2.0
        cells = (cells[:, None] + half * CORNERS).reshape(-1, 3)
