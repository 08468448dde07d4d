"""Signed distance functions of smooth solids, and triangle meshes of their surfaces.

A solid is a function from points (N, 3) [m] to signed distances (N,) [m], negative inside. Solids
are blended with fillets, as in the shells of a modern arm.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import open3d as o3d

Solid = Callable[[np.ndarray], np.ndarray]
"""Type of a solid: function from points (N, 3) to signed distances (N,) [m]."""
Point = Sequence[float]
"""Type of a point: x, y, z [m]."""


@dataclass(frozen=True)
class Mesh:
    """Triangle mesh.

    Attributes:
        vertices: (V, 3) positions [m].
        normals: (V, 3) unit normals.
        triangles: (T, 3) vertex indices.
    """

    vertices: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray


def tube(path: Sequence[Point], radii: Sequence[float], segments: int = 14) -> Solid:
    """Returns a round tube along a Bezier curve; its radii are interpolated like control points."""
    control = np.column_stack([np.asarray(path, float), np.asarray(radii, float)])
    s = np.linspace(0.0, 1.0, segments + 1)[:, None]
    while len(control) > 1:  # De Casteljau on the whole parameter range at once.
        if control.ndim == 2:
            control = np.repeat(control[:, None, :], len(s), axis=1)
        control = (1.0 - s) * control[:-1] + s * control[1:]
    knots = control[0]

    def distance(p: np.ndarray) -> np.ndarray:
        """Returns the signed distances of points to the tube."""
        best = np.full(len(p), np.inf)
        for a, b in pairwise(knots):
            axis = b[:3] - a[:3]
            t = np.clip((p - a[:3]) @ axis / (axis @ axis), 0.0, 1.0)
            nearest = a[:3] + t[:, None] * axis
            radius = a[3] + t * (b[3] - a[3])
            best = np.minimum(best, np.linalg.norm(p - nearest, axis=1) - radius)
        return best

    return distance


def drum(start: Point, end: Point, radius: float, rounding: tuple[float, float]) -> Solid:
    """Returns a cylinder between two points; `rounding` has the edge radii at start and end [m]."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length

    def distance(p: np.ndarray) -> np.ndarray:
        """Returns the signed distances of points to the cylinder."""
        along = (p - a) @ axis
        across = np.linalg.norm(p - a - along[:, None] * axis, axis=1)
        edge = np.where(along < 0.5 * length, rounding[0], rounding[1])
        u = across - (radius - edge)
        v = np.abs(along - 0.5 * length) - (0.5 * length - edge)
        outside = np.hypot(np.maximum(u, 0.0), np.maximum(v, 0.0))
        return outside + np.minimum(np.maximum(u, v), 0.0) - edge

    return distance


def block(center: Point, size: Point, rounding: float, R: np.ndarray | None = None) -> Solid:
    """Returns a box of full size `size` with rounded edges; its axes are the columns of `R`."""
    c, half = np.asarray(center, float), 0.5 * np.asarray(size, float) - rounding
    axes = np.eye(3) if R is None else R

    def distance(p: np.ndarray) -> np.ndarray:
        """Returns the signed distances of points to the box."""
        q = np.abs((p - c) @ axes) - half
        outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
        return outside + np.minimum(q.max(axis=1), 0.0) - rounding

    return distance


def half_space(point: Point, outward: Point) -> Solid:
    """Returns the half space behind the plane through `point` with normal `outward`."""
    c, n = np.asarray(point, float), np.asarray(outward, float)
    n = n / np.linalg.norm(n)
    return lambda p: (p - c) @ n


def _smooth_minimum(a: np.ndarray, b: np.ndarray, fillet: float) -> np.ndarray:
    """Returns the elementwise minimum, smooth where the difference is below `fillet` [m]."""
    if fillet == 0.0:
        return np.minimum(a, b)
    h = np.maximum(fillet - np.abs(a - b), 0.0) / fillet
    return np.minimum(a, b) - h * h * fillet * 0.25


def union(*solids: Solid, fillet: float = 0.0) -> Solid:
    """Returns the union of solids, with fillets of about the given radius at their seams [m]."""

    def distance(p: np.ndarray) -> np.ndarray:
        """Returns the signed distances of points to the union."""
        result = solids[0](p)
        for solid in solids[1:]:
            result = _smooth_minimum(result, solid(p), fillet)
        return result

    return distance


def intersection(*solids: Solid, fillet: float = 0.0) -> Solid:
    """Returns the intersection of solids, with rounded new edges."""

    def distance(p: np.ndarray) -> np.ndarray:
        """Returns the signed distances of points to the intersection."""
        result = solids[0](p)
        for solid in solids[1:]:
            result = -_smooth_minimum(-result, -solid(p), fillet)
        return result

    return distance


def without(solid: Solid, *cuts: Solid, fillet: float = 0.0) -> Solid:
    """Returns a solid minus other solids, with rounded new edges."""
    return intersection(solid, *[lambda p, cut=cut: -cut(p) for cut in cuts], fillet=fillet)


def grown(solid: Solid, offset: float) -> Solid:
    """Returns a solid offset outward by a distance, inward if negative [m]."""
    return lambda p: solid(p) - offset


def _gradient(solid: Solid, p: np.ndarray, step: float = 2e-4) -> np.ndarray:
    """Returns the gradients (N, 3) of a signed distance, by central differences."""
    columns = [solid(p + step * e) - solid(p - step * e) for e in np.eye(3)]
    return np.column_stack(columns) / (2.0 * step)


def _surface_net(solid: Solid, low: np.ndarray, high: np.ndarray, cell: float) -> Mesh:
    """Computes a surface mesh by naive surface nets.

    Each grid cell that the surface crosses has a vertex, each crossed grid edge a quad.
    """
    axes = [np.arange(a, b + cell, cell) for a, b in zip(low, high, strict=True)]
    shape = tuple(len(axis) for axis in axes)
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    inside = (solid(grid.reshape(-1, 3)) < 0.0).reshape(shape)

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


def _onto_surface(solid: Solid, p: np.ndarray, cell: float) -> np.ndarray:
    """Projects points (N, 3) onto the surface, by steps of at most `cell` per axis [m]."""
    for _ in range(6):
        g = _gradient(solid, p)
        step = (solid(p) / np.maximum((g * g).sum(axis=1), 0.1))[:, None] * g
        p = p - np.clip(step, -cell, cell)
    return p


def mesh(solid: Solid, low: Point, high: Point, triangles: int, cell: float = 0.004) -> Mesh:
    """Computes the surface mesh of a solid within a box, with smooth normals.

    Args:
        solid: solid.
        low, high: corners of the box [m].
        triangles: approximate number of triangles.
        cell: edge length of the grid cells [m].
    """
    net = _surface_net(solid, np.asarray(low, float), np.asarray(high, float), cell)
    fine = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(_onto_surface(solid, net.vertices, cell)),
        o3d.utility.Vector3iVector(net.triangles),
    )
    coarse = fine.simplify_quadric_decimation(triangles)
    coarse.remove_degenerate_triangles()
    coarse.remove_unreferenced_vertices()
    vertices = _onto_surface(solid, np.asarray(coarse.vertices), 0.001)
    normals = _gradient(solid, vertices)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return Mesh(vertices, normals, np.asarray(coarse.triangles))


def coarsened(parts: list[Mesh], triangles: int) -> Mesh:
    """Merges meshes, and decimates the result to about the given number of triangles."""
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
