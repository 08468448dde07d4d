"""Signed distance functions of smooth solids, and triangle meshes of their surfaces.

A solid is a function from points (N, 3) in meters to signed distances (N,), negative inside. Solids
blend into one another with fillets, which is how the shells of a modern arm look.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import open3d as o3d

CollisionGeometry = Callable[[np.ndarray], np.ndarray]
Point = Sequence[float]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh: vertices (V, 3), unit normals (V, 3), triangles (T, 3) of vertex indices."""

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray


def tube(path: Sequence[Point], radii: Sequence[float], segments: int = 14) -> CollisionGeometry:
    """A round tube along the Bezier curve of the control points, its radius blended likewise."""
    control = np.column_stack([np.asarray(path, float), np.asarray(radii, float)])
    s = np.linspace(0.0, 1.0, segments + 1)[:, None]
    while len(control) > 1:  # De Casteljau on the whole parameter range at once.
        if control.ndim == 2:
            control = np.repeat(control[:, None, :], len(s), axis=1)
        control = (1.0 - s) * control[:-1] + s * control[1:]
    knots = control[0]

    def distance(p: np.ndarray) -> np.ndarray:
        best = np.full(len(p), np.inf)
        for a, b in pairwise(knots):
            axis = b[:3] - a[:3]
            t = np.clip((p - a[:3]) @ axis / (axis @ axis), 0.0, 1.0)
            nearest = a[:3] + t[:, None] * axis
            radius = a[3] + t * (b[3] - a[3])
            best = np.minimum(best, np.linalg.norm(p - nearest, axis=1) - radius)
        return best

    return distance


def drum(
    start: Point, end: Point, radius: float, rounding: tuple[float, float]
) -> CollisionGeometry:
    """A cylinder between two points; `rounding` is the edge radius at the start and at the end."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length

    def distance(p: np.ndarray) -> np.ndarray:
        along = (p - a) @ axis
        across = np.linalg.norm(p - a - along[:, None] * axis, axis=1)
        edge = np.where(along < 0.5 * length, rounding[0], rounding[1])
        u = across - (radius - edge)
        v = np.abs(along - 0.5 * length) - (0.5 * length - edge)
        outside = np.hypot(np.maximum(u, 0.0), np.maximum(v, 0.0))
        return outside + np.minimum(np.maximum(u, v), 0.0) - edge

    return distance


def block(
    center: Point, size: Point, rounding: float, R: np.ndarray | None = None
) -> CollisionGeometry:
    """A box of full size `size` with rounded edges, its axes the columns of `R`."""
    c, half = np.asarray(center, float), 0.5 * np.asarray(size, float) - rounding
    axes = np.eye(3) if R is None else R

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.abs((p - c) @ axes) - half
        outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
        return outside + np.minimum(q.max(axis=1), 0.0) - rounding

    return distance


def half_space(point: Point, outward: Point) -> CollisionGeometry:
    """Everything behind the plane through `point` whose normal is `outward`."""
    c, n = np.asarray(point, float), np.asarray(outward, float)
    n = n / np.linalg.norm(n)
    return lambda p: (p - c) @ n


def _smooth_minimum(a: np.ndarray, b: np.ndarray, fillet: float) -> np.ndarray:
    if fillet == 0.0:
        return np.minimum(a, b)
    h = np.maximum(fillet - np.abs(a - b), 0.0) / fillet
    return np.minimum(a, b) - h * h * fillet * 0.25


def union(*geometries: CollisionGeometry, fillet: float = 0.0) -> CollisionGeometry:
    """All solids together, with a fillet of about this radius where they meet."""

    def distance(p: np.ndarray) -> np.ndarray:
        result = geometries[0](p)
        for geometry in geometries[1:]:
            result = _smooth_minimum(result, geometry(p), fillet)
        return result

    return distance


def intersection(*geometries: CollisionGeometry, fillet: float = 0.0) -> CollisionGeometry:
    """What all solids share, the new edges rounded."""

    def distance(p: np.ndarray) -> np.ndarray:
        result = geometries[0](p)
        for geometry in geometries[1:]:
            result = -_smooth_minimum(-result, -geometry(p), fillet)
        return result

    return distance


def without(
    geometry: CollisionGeometry, *cuts: CollisionGeometry, fillet: float = 0.0
) -> CollisionGeometry:
    """A solid with others cut away, the new edges rounded."""
    return intersection(geometry, *[lambda p, cut=cut: -cut(p) for cut in cuts], fillet=fillet)


def grown(geometry: CollisionGeometry, offset: float) -> CollisionGeometry:
    """A solid grown outward by a distance (shrunk where negative)."""
    return lambda p: geometry(p) - offset


def _gradient(geometry: CollisionGeometry, p: np.ndarray, step: float = 2e-4) -> np.ndarray:
    columns = [geometry(p + step * e) - geometry(p - step * e) for e in np.eye(3)]
    return np.column_stack(columns) / (2.0 * step)


def _surface_net(
    geometry: CollisionGeometry, low: np.ndarray, high: np.ndarray, cell: float
) -> Mesh:
    """Naive surface nets: a vertex in each cell that the surface crosses, a quad at each edge."""
    axes = [np.arange(a, b + cell, cell) for a, b in zip(low, high, strict=True)]
    shape = tuple(len(axis) for axis in axes)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = (geometry(grid.reshape(-1, 3)) < 0.0).reshape(shape)

    corner_count = sum(
        inside[i : shape[0] - 1 + i, j : shape[1] - 1 + j, k : shape[2] - 1 + k].astype(int)
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    )
    crossed = np.argwhere((corner_count > 0) & (corner_count < 8))
    index = np.full(tuple(n - 1 for n in shape), -1)
    index[tuple(crossed.T)] = np.arange(len(crossed))
    vertices = low + (crossed + 0.5) * cell

    quads = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        ahead = np.roll(inside, -1, axis=axis)
        for leaves in (True, False):
            edges = np.argwhere((inside == leaves) & (ahead != leaves))
            edges = edges[
                (edges[:, axis] < shape[axis] - 1) & (edges[:, u] > 0) & (edges[:, v] > 0)
            ]
            du, dv = np.eye(3, dtype=int)[u], np.eye(3, dtype=int)[v]
            ring = [index[tuple((edges - s).T)] for s in (0 * du, du, du + dv, dv)]
            quads.append(np.column_stack(ring if leaves else ring[::-1]))
    quad = np.vstack(quads)
    triangles = np.vstack([quad[:, [0, 1, 2]], quad[:, [0, 2, 3]]])
    return Mesh(vertices, np.zeros_like(vertices), triangles)


def _onto_surface(geometry: CollisionGeometry, p: np.ndarray, cell: float) -> np.ndarray:
    for _ in range(6):
        g = _gradient(geometry, p)
        step = (geometry(p) / np.maximum((g * g).sum(axis=1), 0.1))[:, None] * g
        p = p - np.clip(step, -cell, cell)
    return p


def mesh(
    geometry: CollisionGeometry, low: Point, high: Point, triangles: int, cell: float = 0.004
) -> Mesh:
    """The surface of a solid within a box, with about that many triangles and smooth normals."""
    net = _surface_net(geometry, np.asarray(low, float), np.asarray(high, float), cell)
    fine = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(_onto_surface(geometry, net.vertices, cell)),
        o3d.utility.Vector3iVector(net.triangles),
    )
    coarse = fine.simplify_quadric_decimation(triangles)
    coarse.remove_degenerate_triangles()
    coarse.remove_unreferenced_vertices()
    vertices = _onto_surface(geometry, np.asarray(coarse.vertices), 0.001)
    normals = _gradient(geometry, vertices)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return Mesh(vertices, normals, np.asarray(coarse.triangles))


def coarsened(parts: list[Mesh], triangles: int) -> Mesh:
    """Meshes as one, decimated to about that many triangles."""
    whole = o3d.geometry.TriangleMesh()
    for part in parts:
        whole += o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(part.vertices), o3d.utility.Vector3iVector(part.triangles)
        )
    coarse = whole.merge_close_vertices(1e-4).simplify_quadric_decimation(triangles)
    coarse.remove_degenerate_triangles()
    coarse.remove_unreferenced_vertices()
    coarse.compute_vertex_normals()
    return Mesh(
        np.asarray(coarse.vertices), np.asarray(coarse.vertex_normals), np.asarray(coarse.triangles)
    )
