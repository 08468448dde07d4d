"""Geometry of the pictures in the viewer: meshes, poses and thinned clouds.

Everything here is a function of arrays; `drake_oa.viewing.meshcat_overlay` sends
the results to Meshcat.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.math import RotationMatrix
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.geometry.ellipsoid import plane_section
from drake_oa.geometry.pinhole import pinhole
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

INNER_RADIUS, BAND, GAP = 0.17, 0.022, 0.005
"""Radius of the innermost cost ring, width of a ring, gap between rings and sectors [m]."""
_PARALLEL = 1e-6
_FRUSTUM_DEPTH = 1.1
"""Drawn part of a camera's range [m]: a frustum of full depth hides more than it shows."""


class TriangleMesh(NamedTuple):
    """A triangle mesh in Meshcat's layout.

    Attributes:
        vertices: (3, n) vertices [m].
        faces: (3, m) vertices of each triangle, counter-clockwise seen from outside.
    """

    vertices: FloatArray
    faces: NDArray[np.int32]


def _surface(points: FloatArray) -> TriangleMesh:
    """Meshes a grid of points (rows, columns, 3) whose last column is joined to the first."""
    rows, columns = points.shape[:2]
    index = np.arange(rows * columns, dtype=np.int32).reshape(rows, columns)
    a, b = index[:-1], index[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    faces = np.concatenate([np.stack([a, b, c]), np.stack([a, c, d])], axis=1)
    return TriangleMesh(points.reshape(-1, 3).T.copy(), faces.reshape(3, -1))


def tube(path: ArrayLike, radius: float, sides: int = 12) -> TriangleMesh:
    """Meshes a round tube along a polyline; WebGL draws a line one pixel wide only.

    The corners of all circles begin at the direction that the path is least along, so that the
    tube does not twist. Consecutive equal points count once; two must differ.

    Args:
        path: (T, 3) points [m].
        radius: radius of the tube [m].
        sides: corners of the circle.
    """
    points = np.asarray(path, dtype=float)
    points = points[np.diff(points, axis=0, prepend=np.inf).any(axis=1)]
    steps = np.diff(points, axis=0)
    tangents = np.append(steps, steps[-1:], axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    across = np.linalg.svd(tangents)[2][-1]
    normals = across - (tangents @ across)[:, None] * tangents
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    binormals = np.cross(tangents, normals)
    angles = np.linspace(2.0 * np.pi, 0.0, sides, endpoint=False)[:, None]
    circles = np.cos(angles) * normals[:, None] + np.sin(angles) * binormals[:, None]
    rings = points[:, None] + radius * circles
    # The ends are closed by circles of no radius.
    caps = np.repeat(points[[0, -1], None], sides, axis=1)
    return _surface(np.concatenate([caps[:1], rings, caps[1:]]))


def unit_sphere(parallels: int = 24, meridians: int = 48) -> TriangleMesh:
    """Meshes the unit sphere, with a smooth silhouette; `parallels` from pole to pole."""
    polar = np.linspace(0.0, np.pi, parallels + 1)[:, None]
    turn = np.arange(meridians) * (2.0 * np.pi / meridians)
    xyz = np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar) + 0.0 * turn
    return _surface(np.stack(xyz, axis=-1))


def unit_circle(count: int = 96) -> FloatArray:
    """Returns `count` points of the unit circle in the xy plane, and the first two again.

    A tube along them overlaps itself, so that its seam is not to be seen.
    """
    angles = np.arange(count + 2) * (2.0 * np.pi / count)
    return np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)


def ring_mesh(costs: Mapping[str, ArrayLike], angles: ArrayLike) -> tuple[TriangleMesh, FloatArray]:
    """Meshes the cost rings of one obstacle as colored bands, one in the other.

    The bands lie in the local YZ-plane about the origin, in the order of `costs`
    from the inside; a sector has the color of its cost on the scale `COST_COLORS`.

    Args:
        costs: name of a ring -> (K,) its cost in [0, 1]; at least one.
        angles: (K,) directions [rad], evenly spread, 0 along y, pi/2 along z.

    Returns:
        The mesh, and (3, n) linear colors of its vertices, unlike all others of the viewer.
    """
    middle = np.asarray(angles, dtype=float)
    inside = INNER_RADIUS + np.arange(len(costs))[:, None] * (BAND + GAP)
    half = np.pi / len(middle) - 0.25 * GAP / inside
    # Two quadrangles a sector, so that few sectors still look round.
    sweep = middle[:, None] + half[..., None] * [-1.0, 0.0, 1.0]
    circle = np.stack([0.0 * sweep, np.cos(sweep), np.sin(sweep)], axis=-1)
    radii = np.stack([inside, inside + BAND], axis=1)
    vertices = radii[:, None, None, :] * circle[..., None, :]
    pattern = np.array([[0, 1, 3], [0, 3, 2], [2, 3, 5], [2, 5, 4]], dtype=np.int32)
    first = 6 * np.arange(len(costs) * len(middle), dtype=np.int32)
    faces = (first[:, None, None] + pattern).reshape(-1, 3).T
    cost = np.stack([np.asarray(values, dtype=float) for values in costs.values()]).ravel()
    scale = np.transpose(COST_COLORS)
    color = np.stack([np.interp(cost, (0.0, 0.5, 1.0), part) for part in scale])
    return TriangleMesh(vertices.reshape(-1, 3).T.copy(), faces.copy()), np.repeat(color**2.2, 6, 1)


def ring_radius(n_rings: int) -> float:
    """Returns the outer radius of `ring_mesh` with that many rings [m]."""
    return INNER_RADIUS + n_rings * (BAND + GAP) - GAP


def frustum_edges(camera: CameraInfo, near: float, far: float) -> FloatArray:
    """Returns edges of the space that a pinhole camera sees between two depths [m].

    Returns:
        (12, 2, 3) edges in the camera's frame C (x right, y down, z forward) [m]: 4
        rays from the camera to the far plane, 4 edges of the near one, 4 of the far one.
    """
    far = min(far, max(_FRUSTUM_DEPTH, 1.1 * near))
    fx, fy, cx, cy = pinhole(camera)
    width, height = camera.width(), camera.height()
    pixels = np.array([[0, 0], [width, 0], [width, height], [0, height]], dtype=float)
    rays = np.column_stack([(pixels - (cx, cy)) / (fx, fy), np.ones(4)])
    sides = np.stack([rays, np.roll(rays, -1, axis=0)], axis=1)
    return np.concatenate([np.stack([0.0 * rays, far * rays], axis=1), near * sides, far * sides])


def plane_normals(
    p_WE: FloatArray, z_W: FloatArray, p_WO: FloatArray, fallback_W: FloatArray
) -> FloatArray:
    """Computes normals of the P-planes, spanned by the way to the obstacle and the heading.

    Args:
        p_WE: (3,) end effector [m].
        z_W: (3,) its velocity, of any scale.
        p_WO: (M, 3) centers of the obstacles [m].
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


def section_frames(
    R_WO: ArrayLike, semi_axes: ArrayLike, normal_W: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Computes frames of ellipsoids' sections by planes through their centers.

    The sections are the descriptors lambda' of the P-plane (section IV-B of the
    paper) where `normal_W` is that plane's normal.

    Args:
        R_WO: (M, 3, 3) rotations, principal axes in the columns.
        semi_axes: (M, 3) semi-axes [m].
        normal_W: (M, 3) normals of the planes.

    Returns:
        (M, 3, 3) rotations with the section's principal axes and the normal in their columns,
        and (M, 3) scales that stretch the unit circle in the xy plane to the section: its
        semi-axes, and their mean [m].
    """
    planes = [RotationMatrix.MakeFromOneVector(normal, 2).matrix() for normal in normal_W]
    frames = np.array(planes).reshape(-1, 3, 3)
    section = plane_section(R_WO, semi_axes, frames[:, :, 0], frames[:, :, 1])
    first, second = section.axes[:, 0], section.axes[:, 1]
    lengths = section.semi_axes
    scale = np.column_stack([lengths, lengths.mean(axis=1)])
    return np.stack([first, second, np.cross(first, second)], axis=2), scale


def baseline_points(
    p_WS: FloatArray, p_WG: FloatArray, R_WL: FloatArray, p_WO: FloatArray
) -> FloatArray:
    """Returns the points (M, 3) of the baseline nearest to p_WO (M, 3), where sides are decided."""
    length = float(np.linalg.norm(p_WG - p_WS))
    along = np.clip((p_WO - p_WS) @ R_WL[:, 0], 0.0, length)
    return np.asarray(p_WS + along[:, None] * R_WL[:, 0])


def thin_points(points: FloatArray, *, most: int, spacing: float) -> IntArray:
    """Chooses points of a cloud to show: evenly spread, and not too many.

    Of those in one cube one remains; if there are still too many, an even selection of these.

    Args:
        points: (N, 3) finite points [m].
        most: greatest number of chosen points, at least 1.
        spacing: side of the cubes [m].

    Returns:
        Ascending indices of the chosen rows.
    """
    chosen = first_in_voxels(points, spacing)
    if chosen.size > most:
        chosen = chosen[np.linspace(0, chosen.size - 1, most).round().astype(np.int64)]
    return chosen


def assign_slots(slots: tuple[int, ...], ids: ArrayLike) -> tuple[int, ...]:
    """Keeps each obstacle in its place of a fixed pool.

    Args:
        slots: ID of the obstacle in each place, -1 where there is none.
        ids: IDs of the present obstacles, none of them negative.

    Returns:
        The new IDs in the places: an obstacle that was there keeps its place, new ones take the
        first free places, and when the pool is full the rest are left out.
    """
    present = [int(i) for i in np.asarray(ids).ravel()]
    kept = [name if name in present else -1 for name in slots]
    for name in present:
        if name not in kept and -1 in kept:
            kept[kept.index(-1)] = name
    return tuple(kept)
