"""Geometry of what the viewer shows: meshes, poses and thinned clouds.

Everything here is a function of arrays; `drake_oa.viewing.meshcat_overlay` sends
the results to Meshcat.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.ellipsoid import plane_section
from drake_oa.geometry.voxels import first_in_voxels

Color = tuple[float, float, float]

PLANNED: Color = (0.0, 128 / 255, 1.0)
EXECUTED: Color = (0.90, 0.07, 0.09)
ELLIPSOID: Color = (0.93, 0.36, 0.52)
SECTION: Color = (0.78, 0.02, 0.10)
CHOSEN: Color = (0.86, 0.0, 0.78)
CLOUD: Color = (0.0, 0.42, 0.45)
FRUSTUM: Color = (0.42, 0.50, 0.60)
DISTANCE: Color = (0.85, 0.10, 0.45)
COST_COLORS: tuple[Color, ...] = ((0.10, 0.62, 0.28), (0.98, 0.82, 0.18), (0.80, 0.10, 0.12))
"""Colors of costs 0, 0.5 and 1 on a ring."""

_PARALLEL = 1e-6


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh, laid out as Meshcat takes it.

    Attributes:
        vertices: (3, n) vertices [m].
        faces: (3, m) vertices of each triangle, counter-clockwise seen from outside.
        colors: (3, n) linear colours of the vertices in [0, 1], or None.
    """

    vertices: FloatArray
    faces: NDArray[np.int32]
    colors: FloatArray | None = None


def orthonormal_frame(x_axis: ArrayLike) -> FloatArray:
    """R (3, 3) whose first column is along `x_axis` (3,), the others anyhow.

    Raises:
        ValueError: if `x_axis` is zero or not finite.
    """
    x = np.asarray(x_axis, dtype=float)
    size = float(np.linalg.norm(x))
    if not (np.isfinite(size) and size > 0.0):
        raise ValueError(f"x_axis must be a finite, non-zero vector, not {x_axis!r}")
    x = x / size
    helper = np.zeros(3)
    helper[int(np.argmin(np.abs(x)))] = 1.0
    z = np.cross(x, helper)
    z /= np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)


def tube(path: ArrayLike, radius: float, *, sides: int = 12, closed: bool = False) -> TriangleMesh:
    """A round tube along a polyline; WebGL draws a line one pixel wide only.

    The circle is carried along by the least rotation, so that the tube does not
    twist; consecutive equal points count once.

    Args:
        path: (T, 3) points [m].
        radius: radius of the tube [m].
        sides: corners of the circle.
        closed: whether the last point is joined to the first one. An open tube is
            capped.

    Raises:
        ValueError: if fewer than two points differ (three when closed).
    """
    points = np.asarray(path, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"path must have shape (T, 3), not {points.shape}")
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    points = points[np.concatenate([[True], step > 0.0])] if len(points) else points
    if closed and len(points) > 1 and np.array_equal(points[0], points[-1]):
        points = points[:-1]
    count = len(points)
    if count < (3 if closed else 2):
        raise ValueError(f"path must have {3 if closed else 2} different points, not {count}")
    before, after = np.roll(points, 1, axis=0), np.roll(points, -1, axis=0)
    if not closed:
        before[0], after[-1] = 2.0 * points[0] - points[1], 2.0 * points[-1] - points[-2]
    arriving, leaving = _unit_rows(points - before), _unit_rows(after - points)
    tangents = arriving + leaving
    # A path that turns right back has no mean direction there.
    turned = np.linalg.norm(tangents, axis=1) < 1e-9
    tangents[turned] = leaving[turned]
    tangents = _unit_rows(tangents)

    angles = np.arange(sides) * (2.0 * np.pi / sides)
    normal = orthonormal_frame(tangents[0])[:, 1]
    rings = np.empty((count, sides, 3))
    for k, tangent in enumerate(tangents):
        normal = normal - (normal @ tangent) * tangent
        length = float(np.linalg.norm(normal))
        normal = normal / length if length > 1e-9 else orthonormal_frame(tangent)[:, 1]
        binormal = np.cross(tangent, normal)
        rings[k] = points[k] + radius * (
            np.cos(angles)[:, None] * normal + np.sin(angles)[:, None] * binormal
        )
    index = np.arange(count * sides, dtype=np.int32).reshape(count, sides)
    here = index if closed else index[:-1]
    there = np.roll(index, -1, axis=0) if closed else index[1:]
    a, b = here, np.roll(here, -1, axis=1)
    c, d = np.roll(there, -1, axis=1), there
    faces = [np.stack([a, b, c]).reshape(3, -1), np.stack([a, c, d]).reshape(3, -1)]
    if not closed:
        fan = np.arange(1, sides - 1)
        for ring, (i, j) in ((index[0], (fan + 1, fan)), (index[-1], (fan, fan + 1))):
            faces.append(np.stack([np.full(sides - 2, ring[0]), ring[i], ring[j]]))
    return TriangleMesh(rings.reshape(-1, 3).T.copy(), np.concatenate(faces, axis=1))


def _unit_rows(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def unit_sphere(parallels: int = 24, meridians: int = 48) -> TriangleMesh:
    """The unit sphere, fine enough for a smooth silhouette; `parallels` from pole to pole."""
    polar = np.arange(1, parallels)[:, None] * (np.pi / parallels)
    turn = np.arange(meridians) * (2.0 * np.pi / meridians)
    flat = np.stack(
        [
            np.sin(polar) * np.cos(turn),
            np.sin(polar) * np.sin(turn),
            np.broadcast_to(np.cos(polar), (parallels - 1, meridians)),
        ]
    ).reshape(3, -1)
    index = np.arange(flat.shape[1], dtype=np.int32).reshape(parallels - 1, meridians)
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    north, south = (np.full(meridians, flat.shape[1] + k, dtype=np.int32) for k in (0, 1))
    faces = [
        np.stack([a, b, c]).reshape(3, -1),
        np.stack([a, c, d]).reshape(3, -1),
        np.stack([north, index[0], np.roll(index[0], -1)]),
        np.stack([south, np.roll(index[-1], -1), index[-1]]),
    ]
    poles = np.array([[0.0, 0.0], [0.0, 0.0], [1.0, -1.0]])
    return TriangleMesh(np.concatenate([flat, poles], axis=1), np.concatenate(faces, axis=1))


def unit_circle(count: int = 96) -> FloatArray:
    """(count, 3) points of the unit circle in the xy plane."""
    angles = np.arange(count) * (2.0 * np.pi / count)
    return np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=1)


def ring_mesh(
    costs: Mapping[str, ArrayLike],
    angles: ArrayLike,
    *,
    inner_radius: float = 0.17,
    band: float = 0.022,
    gap: float = 0.005,
) -> TriangleMesh:
    """The cost rings of one obstacle as coloured bands, one in the other.

    The bands lie in the local YZ-plane about the origin, in the order of `costs`
    from the inside; a sector has the color of its cost on the scale `COST_COLORS`.

    Args:
        costs: name of a ring -> (K,) its cost in [0, 1].
        angles: (K,) directions [rad], evenly spread, 0 along y, pi/2 along z.
        inner_radius: of the innermost band [m].
        band: width of a band [m].
        gap: between bands, and between sectors [m].

    Raises:
        ValueError: if a ring has not K costs.
    """
    middle = np.asarray(angles, dtype=float)
    count = len(middle)
    vertices, faces, colors = [], [], []
    for number, (name, values) in enumerate(costs.items()):
        cost = np.clip(np.asarray(values, dtype=float), 0.0, 1.0)
        if cost.shape != (count,):
            raise ValueError(f"ring '{name}' has shape {cost.shape}; it must be ({count},)")
        inside = inner_radius + number * (band + gap)
        half = np.pi / count - 0.25 * gap / inside
        # Two quadrangles a sector, so that few sectors still look round.
        sweep = middle[:, None] + half * np.array([-1.0, 0.0, 1.0])
        circle = np.stack([np.zeros_like(sweep), np.cos(sweep), np.sin(sweep)], axis=-1)
        corners = np.stack([inside * circle, (inside + band) * circle], axis=2)
        first = np.int32(6 * count * number) + 6 * np.arange(count, dtype=np.int32)
        pattern = np.array([[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]], dtype=np.int32)
        scale = np.transpose(COST_COLORS)
        color = np.stack([np.interp(cost, (0.0, 0.5, 1.0), part) for part in scale], axis=1)
        vertices.append(corners.reshape(-1, 3))
        faces.append((first[:, None, None] + pattern).reshape(-1, 3))
        # Vertex colours are linear, unlike all the others of the viewer.
        colors.append(np.repeat(color**2.2, 6, axis=0))
    if not vertices:
        return TriangleMesh(np.zeros((3, 0)), np.zeros((3, 0), dtype=np.int32), np.zeros((3, 0)))
    return TriangleMesh(
        np.concatenate(vertices).T.copy(),
        np.concatenate(faces).T.astype(np.int32),
        np.concatenate(colors).T.copy(),
    )


def ring_radius(n_rings: int, *, inner_radius: float, band: float, gap: float) -> float:
    """Outer radius of `ring_mesh` with that many rings [m]."""
    return inner_radius + n_rings * (band + gap) - gap if n_rings else inner_radius


def frustum_edges(
    focal: tuple[float, float],
    center: tuple[float, float],
    size: tuple[int, int],
    depth_range: tuple[float, float],
) -> FloatArray:
    """Edges of what a pinhole camera sees between two depths.

    Args:
        focal: (f_x, f_y) [pixel].
        center: (c_x, c_y) [pixel].
        size: (width, height) [pixel].
        depth_range: nearest and farthest depth [m].

    Returns:
        (12, 2, 3) edges in the camera's frame C (x right, y down, z forward) [m]: 4
        rays from the camera to the far plane, 4 edges of the near one, 4 of the far one.

    Raises:
        ValueError: unless 0 < near < far.
    """
    near, far = depth_range
    if not 0.0 < near < far:
        raise ValueError(f"depth_range must be 0 < near < far [m], not {depth_range}")
    pixels = np.array([[0, 0], [size[0], 0], [size[0], size[1]], [0, size[1]]], dtype=float)
    rays = np.ones((4, 3))
    rays[:, :2] = (pixels - center) / focal
    edges = [np.stack([np.zeros((4, 3)), far * rays], axis=1)]
    for depth in (near, far):
        edges.append(depth * np.stack([rays, np.roll(rays, -1, axis=0)], axis=1))
    return np.concatenate(edges)


def plane_normals(
    p_WE: FloatArray, z_W: FloatArray, p_WO: FloatArray, fallback_W: FloatArray
) -> FloatArray:
    """Unit normals of the P-planes, spanned by the way to the obstacle and the heading.

    Args:
        p_WE: (3,) end effector [m].
        z_W: (3,) its velocity, of any scale.
        p_WO: (M, 3) centres of the obstacles [m].
        fallback_W: (M, 3) unit normals to take where the two do not span a plane.

    Returns:
        (M, 3) unit normals.
    """
    to_O = p_WO - p_WE
    normal = np.cross(to_O, z_W)
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    least = _PARALLEL * np.linalg.norm(to_O, axis=1, keepdims=True) * np.linalg.norm(z_W)
    spanned = size > least
    return np.where(spanned, normal / np.where(spanned, size, 1.0), fallback_W)


def section_transform(
    p_WO: ArrayLike, R_WO: ArrayLike, semi_axes: ArrayLike, normal_W: ArrayLike
) -> FloatArray:
    """Maps the unit circle in the xy plane onto ellipsoids' sections through their centres.

    The sections are the descriptors lambda' of the P-plane (section IV-B of the
    paper) where `normal_W` is that plane's normal.

    Args:
        p_WO: (M, 3) centres [m].
        R_WO: (M, 3, 3) rotations, principal axes in the columns.
        semi_axes: (M, 3) semi-axes [m].
        normal_W: (M, 3) normals of the planes.

    Returns:
        (M, 4, 4) homogeneous transforms with right-handed orthogonal columns: two
        principal semi-axes of the section, and the normal as long as their mean.
    """
    frames = np.array([orthonormal_frame(n) for n in np.asarray(normal_W)]).reshape(-1, 3, 3)
    section = plane_section(R_WO, semi_axes, frames[:, :, 1], frames[:, :, 2])
    first, second = section.axes[..., 0, :], section.axes[..., 1, :]
    lengths = section.semi_axes
    X = np.zeros((len(frames), 4, 4))
    X[:, :3, 0] = first * lengths[:, :1]
    X[:, :3, 1] = second * lengths[:, 1:]
    X[:, :3, 2] = np.cross(first, second) * lengths.mean(axis=1, keepdims=True)
    X[:, :3, 3] = p_WO
    X[:, 3, 3] = 1.0
    return X


def split_transform(X: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Rotation (3, 3), translation (3,) and scales (3,) of X (4, 4) = [R diag(s), p].

    A viewer's animation interpolates these three, not the matrix.
    """
    scale = np.linalg.norm(X[:3, :3], axis=0)
    return X[:3, :3] / scale, X[:3, 3].copy(), scale


def baseline_points(
    p_WS: FloatArray, p_WG: FloatArray, R_WL: FloatArray, p_WO: FloatArray
) -> FloatArray:
    """Points of the baseline nearest to p_WO (M, 3): where each side is decided, (M, 3)."""
    length = float(np.linalg.norm(p_WG - p_WS))
    along = np.clip((p_WO - p_WS) @ R_WL[:, 0], 0.0, length)
    return np.asarray(p_WS + along[:, None] * R_WL[:, 0])


def thin_points(points: ArrayLike, *, most: int, spacing: float) -> IntArray:
    """Chooses points of a cloud to show: evenly spread, and not too many.

    Points that are not finite are left out. Of those in one cube of side `spacing`
    one remains; if there are still too many, an even selection of these.

    Args:
        points: (N, 3) points [m].
        most: how many at most.
        spacing: side of the cubes [m].

    Returns:
        Ascending indices of the chosen rows.

    Raises:
        ValueError: if `most` or `spacing` is not positive.
    """
    if not (most > 0 and spacing > 0.0):
        raise ValueError(f"most and spacing must be positive, not {most} and {spacing}")
    points = np.asarray(points, dtype=float)
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    chosen = rows[first_in_voxels(points[rows], spacing)]
    if chosen.size > most:
        chosen = chosen[np.linspace(0, chosen.size - 1, most).round().astype(np.int64)]
    return chosen


def assign_slots(slots: tuple[int, ...], ids: ArrayLike) -> tuple[int, ...]:
    """Keeps each obstacle in its place of a fixed pool.

    Args:
        slots: the name of the obstacle in each place, -1 where there is none.
        ids: names of the present obstacles, none of them negative.

    Returns:
        The new names in the places: who was there keeps its place, newcomers take the
        first free ones, and when the pool is full the rest are left out.
    """
    present = [int(i) for i in np.asarray(ids).ravel()]
    kept = [name if name in present else -1 for name in slots]
    for name in present:
        if name not in kept and -1 in kept:
            kept[kept.index(-1)] = name
    return tuple(kept)
