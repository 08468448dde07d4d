"""Conversion of meshes that Drake cannot read to .obj files, which are stored in the user's cache
folder.
"""

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
"""Maximum additional volume at which a mesh has one convex hull, instead of one hull per closed
surface [-]. The additional volume is the increase from the total volume of the separate hulls to
that of the one hull, relative to the former."""


def convert_to_objs(mesh: Path, *, hulls: bool) -> list[Path]:
    """Converts a mesh to .obj files in the user's cache folder, once per content of the mesh file.

    Args:
        mesh: mesh file in a format that open3d reads, or COLLADA (.dae).
        hulls: whether to write the convex hulls of the mesh's closed surfaces, one per file, for
            collision geometry. A single hull, as Drake would compute it, fills concave parts of a
            link. A mesh with an open surface has one hull. If False, one mesh with vertex normals
            is written, for cameras.

    Returns:
        Paths of the .obj files, sorted by name.

    Raises:
        ValueError: if the mesh has no triangles, or cannot be read or written.
    """
    import open3d

    try:
        digest = hashlib.sha256(mesh.read_bytes()).hexdigest()[:16]
        kind = "hulls" if hulls else "whole"
        target = user_cache("meshes-4") / f"{mesh.stem}-{digest}-{kind}"
        if not target.is_dir():
            announce_first_use(f"converting meshes of {mesh.parent}")
            with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
                full_mesh = _read(mesh)
                pieces = _hulls(full_mesh) if hulls else [full_mesh.compute_vertex_normals()]
                target.parent.mkdir(parents=True, exist_ok=True)
                # The complete folder is renamed, as another process may convert the same mesh.
                folder = tempfile.mkdtemp(dir=target.parent)
                for row, piece in enumerate(pieces):
                    if not open3d.io.write_triangle_mesh(f"{folder}/{row:03d}.obj", piece):
                        raise OSError(f"cannot write meshes to {folder}")
                try:
                    Path(folder).rename(target)
                except OSError:
                    if not target.is_dir():
                        raise
                    shutil.rmtree(folder)
    except OSError as error:
        raise ValueError(f"{error}; set XDG_CACHE_HOME to use another folder for meshes") from None
    return sorted(target.glob("*.obj"))


def _read(mesh: Path) -> TriangleMesh:
    """Reads the triangle mesh of a file, without duplicate vertices.

    Raises:
        ValueError: if the file cannot be read as a mesh of triangles.
    """
    import open3d

    if mesh.suffix.lower() == ".dae":
        corners = _read_collada(mesh)
        result = open3d.geometry.TriangleMesh(
            open3d.utility.Vector3dVector(corners),
            open3d.utility.Vector3iVector(np.arange(len(corners)).reshape(-1, 3)),
        )
    else:
        result = open3d.io.read_triangle_mesh(str(mesh))
    result = result.remove_duplicated_vertices()
    if not len(result.triangles) or not np.isfinite(result.vertices).all():
        raise ValueError(f"'{mesh}' cannot be read as a mesh of triangles")
    return result


def _read_collada(mesh: Path) -> FloatArray:
    """Reads the corners (3 M, 3) of the M triangles in a COLLADA (.dae) file [m].

    Corners are scaled by the length unit of the file. The up axis of the file is ignored, as in
    common viewers of URDFs.

    Raises:
        ValueError: if pycollada is not installed, or the file cannot be read as a mesh of
            triangles.
    """
    try:
        import collada
    except ImportError:
        raise ValueError(
            f"'{mesh}': .dae requires the package pycollada: pip install 'drake_oa[robots]'"
        ) from None
    unread = [collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
    try:
        document = collada.Collada(str(mesh), ignore=unread)
        corners = [np.zeros((0, 3))]
        for geometry in document.scene.objects("geometry"):
            for part in geometry.primitives():
                faces = part.triangleset() if hasattr(part, "triangleset") else part
                if isinstance(faces, collada.triangleset.BoundTriangleSet) and len(faces):
                    corners.append(faces.vertex[faces.vertex_index].reshape(-1, 3))
    except (collada.common.DaeError, AttributeError, IndexError, ValueError) as error:
        raise ValueError(f"'{mesh}' cannot be read as a mesh of triangles: {error}") from None
    unit = document.assetInfo.unitmeter
    return np.concatenate(corners) * (1.0 if unit is None or math.isnan(unit) else unit)


def _hulls(mesh: TriangleMesh) -> list[TriangleMesh]:
    """Computes the convex hulls of a mesh's closed surfaces, as collision geometry of a link.

    The result is one hull of the whole mesh if the volume of this hull exceeds that of the hulls of
    the surfaces by at most 10 %, or if a surface of the mesh is open.

    Raises:
        ValueError: if the vertices of a closed surface, or of an open mesh, are in one plane.
    """
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
        raise ValueError("a collision mesh must enclose a volume; a part of it is flat") from None
    clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(part)) for part in parts]
    return [cloud.compute_convex_hull()[0] for cloud in clouds]
