"""Meshes that Drake does not read, as .obj in the user's cache folder."""

from __future__ import annotations

import hashlib
import math
import re
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from drake_oa.common.console import ProgressLines
from drake_oa.common.files import replace_text, user_cache
from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.common.numba_tools import is_writable

DRAKES_OWN = {".obj", ".gltf", ".vtk"}
_VERSION = 2
"""Of what is in the cache."""
_NOT_FINITE = re.compile(rb"^v[ \t].*(?:nan|inf).*$", re.IGNORECASE | re.MULTILINE)
"""Line of a vertex of an .obj file that is not finite."""
_JOINED = 0.1
"""Two parts of a mesh are one hull where that is larger than the two by a smaller share."""


def check_vertices(mesh: Path) -> None:
    """Raises ValueError for a vertex of an .obj that is NaN or infinite, which Drake reads as 0."""
    found = _NOT_FINITE.search(mesh.read_bytes()) if mesh.suffix.lower() == ".obj" else None
    if found:
        raise ValueError(f"'{mesh}': a vertex must be finite, not '{found[0].decode().strip()}'")


class ModelMeshes:
    """Files of the meshes of one model, and their conversion, announced on stderr."""

    def __init__(self, model: str, count: int, resolve: Callable[[str], Path]) -> None:
        """Keeps what to find meshes by.

        Args:
            model: name of the model.
            count: number of its meshes.
            resolve: returns the file of a mesh's URL, or name relative to the model's file.
        """
        self._resolve, self._row = resolve, 0
        self._progress = ProgressLines(f"converting meshes of {model}", count)

    def find(self, url: str) -> Path:
        """Returns the file of the next mesh."""
        self._row += 1
        return self._resolve(url)

    def convert(self, mesh: Path, *, hulls: bool) -> list[Path]:
        """Converts the mesh that was found last, see `as_objs`."""
        return as_objs(mesh, hulls=hulls, announce=lambda: self._progress.update(self._row))


def as_objs(mesh: Path, *, hulls: bool, announce: Callable[[], None] | None = None) -> list[Path]:
    """Converts a mesh to .obj files in the cache, once for each content of the file.

    Where the user's cache cannot be written, they are in a temporary folder of this process.

    Args:
        mesh: a file that open3d reads, or COLLADA, .dae.
        hulls: as convex hulls of its closed surfaces, one a file: a hull of them all, which
            Drake would take, fills the side of an arm's link between its joints. A mesh with a
            surface that is not closed has one hull. Else as it is.
        announce: called before a conversion, which can take seconds.

    Raises:
        ValueError: if it holds no triangles, or cannot be read or written.
    """
    try:
        digest = hashlib.sha256(mesh.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise ValueError(str(error)) from None
    made = user_cache(f"meshes-{_VERSION}")
    stem = f"{mesh.stem}-{digest}-{'hull' if hulls else 'whole'}"
    found = _complete(made, stem)
    if not found and not is_writable(made):
        made = Path(_temporary_cache(made).name)
        found = _complete(made, stem)
    if found:
        return found
    if announce is not None:
        announce()
    vertices, triangles = _read(mesh)
    pieces = _hulls(vertices, triangles) if hulls else [(vertices, triangles)]
    files = [made / f"{stem}-{row:03d}.obj" for row in range(1, len(pieces) + 1)]
    try:
        for file, (points, faces) in reversed(list(zip(files, pieces, strict=True))):
            replace_text(file, _obj(points, faces))
    except OSError as error:
        raise ValueError(f"'{made}' cannot be written: {error}") from None
    return files


def _complete(folder: Path, stem: str) -> list[Path]:
    """All files of a converted mesh; empty if one is missing."""
    found = sorted(folder.glob(f"{stem}-*.obj"))
    # The last is written first, and its name says how many there are.
    return found if found and len(found) == int(found[-1].stem.rpartition("-")[2]) else []


@cache
def _temporary_cache(folder: Path) -> tempfile.TemporaryDirectory[str]:
    """Temporary folder of this process in place of one that cannot be written."""
    print(
        f"meshes are converted for this run only, as {folder} cannot be written: "
        "XDG_CACHE_HOME names another",
        file=sys.stderr,
    )
    return tempfile.TemporaryDirectory(prefix="drake_oa-meshes-")


def _obj(points: FloatArray, faces: IntArray) -> str:
    """With a normal for each face, as cameras refuse a mesh that has none."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 0.0, normals / np.where(length > 0.0, length, 1.0), [0.0, 0.0, 1.0])
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points.tolist()]
    lines += [f"vn {x:.6g} {y:.6g} {z:.6g}" for x, y, z in normals.tolist()]
    rows = enumerate((faces + 1).tolist(), start=1)
    lines += [f"f {i}//{n} {j}//{n} {k}//{n}" for n, (i, j, k) in rows]
    return "\n".join(lines) + "\n"


def _read(mesh: Path) -> tuple[FloatArray, IntArray]:
    """Vertices (N, 3), each once, and triangles (M, 3) [m]."""
    import open3d

    check_vertices(mesh)
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        if mesh.suffix.lower() == ".dae":
            corners = _read_collada(mesh)
            read = open3d.geometry.TriangleMesh(
                open3d.utility.Vector3dVector(corners),
                open3d.utility.Vector3iVector(np.arange(len(corners)).reshape(-1, 3)),
            )
        else:
            read = open3d.io.read_triangle_mesh(str(mesh))
        read = read.remove_duplicated_vertices()
    vertices, triangles = np.asarray(read.vertices), np.asarray(read.triangles).astype(np.int64)
    if not len(triangles) or not np.isfinite(vertices).all():
        raise ValueError(f"'{mesh}' cannot be read as a mesh of triangles")
    return vertices, triangles


def _read_collada(mesh: Path) -> FloatArray:
    """The corners of the triangles of a .dae's scene, (3 M, 3) [m].

    Its unit counts, its up axis does not, as where URDFs are usually shown.
    """
    try:
        import collada
    except ImportError:
        raise ValueError(
            f"'{mesh}': .dae takes the package pycollada: pip install 'drake_oa[robots]'"
        ) from None
    unread = [collada.common.DaeUnsupportedError, collada.common.DaeBrokenRefError]
    try:
        read = collada.Collada(str(mesh), ignore=unread)
        found = [np.zeros((0, 3))]
        for geometry in read.scene.objects("geometry") if read.scene else ():
            for part in geometry.primitives():
                faces = part.triangleset() if hasattr(part, "triangleset") else part
                if isinstance(faces, collada.triangleset.BoundTriangleSet) and len(faces):
                    found.append(faces.vertex[faces.vertex_index].reshape(-1, 3))
    except (collada.common.DaeError, AttributeError, IndexError, ValueError) as error:
        raise ValueError(f"'{mesh}' cannot be read as a mesh of triangles: {error}") from None
    unit = read.assetInfo.unitmeter
    return np.concatenate(found) * (1.0 if unit is None or math.isnan(unit) else unit)


def _hulls(vertices: FloatArray, triangles: IntArray) -> list[tuple[FloatArray, IntArray]]:
    """Few convex hulls that hold the closed surfaces of a mesh, and little else."""
    one, other = triangles.ravel(), np.roll(triangles, -1, axis=1).ravel()
    links = coo_array((np.ones(len(one)), (one, other)), shape=2 * (len(vertices),))
    _, part = connected_components(links, directed=False)
    _, times = np.unique(np.sort([one, other], axis=0), axis=1, return_counts=True)
    if (times % 2).any():
        part[:] = 0
    try:
        hulls = [ConvexHull(vertices[part == row]) for row in np.unique(part[triangles])]
        while len(hulls) > 1:
            joined = {
                (i, j): ConvexHull(np.concatenate([_corners(hulls[i]), _corners(hulls[j])]))
                for i, j in combinations(range(len(hulls)), 2)
            }
            (i, j), least = min(joined.items(), key=lambda of: _added(hulls, *of))
            if _added(hulls, (i, j), least) > _JOINED:
                break
            hulls = [hull for row, hull in enumerate(hulls) if row not in (i, j)] + [least]
    except QhullError:
        raise ValueError("a collision mesh must enclose a volume, and a part is flat") from None
    found = []
    for hull in hulls:
        rows = np.full(len(hull.points), -1)
        rows[hull.vertices] = np.arange(len(hull.vertices))
        found.append((_corners(hull), rows[hull.simplices]))
    return found


def _corners(hull: ConvexHull) -> FloatArray:
    return np.asarray(hull.points[hull.vertices])


def _added(hulls: Sequence[ConvexHull], pair: tuple[int, int], joined: ConvexHull) -> float:
    """By which share two hulls become larger when they are joined."""
    return float(joined.volume / sum(hulls[row].volume for row in pair) - 1.0)
