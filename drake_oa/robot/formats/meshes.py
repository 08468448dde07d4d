"""Meshes that Drake does not read, converted to .obj files in the user's cache folder."""

from __future__ import annotations

import hashlib
import math
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from drake_oa.common.console import announce_first_use
from drake_oa.common.files import user_cache
from drake_oa.common.messages import FloatArray

if TYPE_CHECKING:
    from open3d.geometry import TriangleMesh

_ADDED_VOLUME = 0.1
"""Added share of volume up to which one hull replaces those of all closed surfaces [1]."""


def as_objs(mesh: Path, *, hulls: bool) -> list[Path]:
    """Converts a mesh to .obj files in the cache, once for each content of the file.

    Args:
        mesh: a file that open3d reads, or COLLADA, .dae.
        hulls: as convex hulls of its closed surfaces, one a file: one hull of them all, which
            Drake would use, fills the side of an arm's link between its joints. A mesh with a
            surface that is not closed has one hull. Else as it is, with normals, which cameras
            need.

    Raises:
        ValueError: if it holds no triangles, or cannot be read or written.
    """
    import open3d

    try:
        digest = hashlib.sha256(mesh.read_bytes()).hexdigest()[:16]
        kind = "hulls" if hulls else "whole"
        made = user_cache("meshes-4") / f"{mesh.stem}-{digest}-{kind}"
        if not made.is_dir():
            announce_first_use(f"converting meshes of {mesh.parent}")
            with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
                whole = _read(mesh)
                pieces = _hulls(whole) if hulls else [whole.compute_vertex_normals()]
                made.parent.mkdir(parents=True, exist_ok=True)
                # Renamed when it is complete: another process may be converting the same mesh.
                folder = tempfile.mkdtemp(dir=made.parent)
                for row, piece in enumerate(pieces):
                    open3d.io.write_triangle_mesh(f"{folder}/{row:03d}.obj", piece)
                try:
                    Path(folder).rename(made)
                except OSError:
                    if not made.is_dir():
                        raise
                    shutil.rmtree(folder)
    except OSError as error:
        raise ValueError(f"{error}; XDG_CACHE_HOME names another folder for meshes") from None
    return sorted(made.glob("*.obj"))


def _read(mesh: Path) -> TriangleMesh:
    """Returns the mesh of a file, each vertex once."""
    import open3d

    if mesh.suffix.lower() == ".dae":
        corners = _read_collada(mesh)
        read = open3d.geometry.TriangleMesh(
            open3d.utility.Vector3dVector(corners),
            open3d.utility.Vector3iVector(np.arange(len(corners)).reshape(-1, 3)),
        )
    else:
        read = open3d.io.read_triangle_mesh(str(mesh))
    read = read.remove_duplicated_vertices()
    if not len(read.triangles) or not np.isfinite(read.vertices).all():
        raise ValueError(f"'{mesh}' cannot be read as a mesh of triangles")
    return read


def _read_collada(mesh: Path) -> FloatArray:
    """Returns the corners of the triangles of a .dae's scene, (3 M, 3) [m].

    Its unit counts, its up axis does not, as where URDFs are usually shown.
    """
    try:
        import collada
    except ImportError:
        raise ValueError(
            f"'{mesh}': .dae requires the package pycollada: pip install 'drake_oa[robots]'"
        ) from None
    unread = [collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
    try:
        read = collada.Collada(str(mesh), ignore=unread)
        found = [np.zeros((0, 3))]
        for geometry in read.scene.objects("geometry"):
            for part in geometry.primitives():
                faces = part.triangleset() if hasattr(part, "triangleset") else part
                if isinstance(faces, collada.triangleset.BoundTriangleSet) and len(faces):
                    found.append(faces.vertex[faces.vertex_index].reshape(-1, 3))
    except (collada.common.DaeError, AttributeError, IndexError, ValueError) as error:
        raise ValueError(f"'{mesh}' cannot be read as a mesh of triangles: {error}") from None
    unit = read.assetInfo.unitmeter
    return np.concatenate(found) * (1.0 if unit is None or math.isnan(unit) else unit)


def _hulls(mesh: TriangleMesh) -> list[TriangleMesh]:
    """Computes the convex hull of a mesh, or those of its closed surfaces if it would fill much."""
    import open3d

    vertices, triangles = np.asarray(mesh.vertices), np.asarray(mesh.triangles)
    surface = np.asarray(mesh.cluster_connected_triangles()[0])
    edges = np.sort([triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()], axis=0)
    if (np.unique(edges, axis=1, return_counts=True)[1] % 2).any():
        surface = np.zeros_like(surface)
    parts = [vertices[np.unique(triangles[surface == row])] for row in np.unique(surface)]
    try:
        volume = sum(ConvexHull(part).volume for part in parts)
        if ConvexHull(vertices).volume <= (1.0 + _ADDED_VOLUME) * volume:
            parts = [vertices]
    except QhullError:
        raise ValueError("a collision mesh must enclose a volume, and a part is flat") from None
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(part)) for part in parts]
    return [cloud.compute_convex_hull()[0] for cloud in clouds]
