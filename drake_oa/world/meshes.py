"""Normals for meshes that have none, which cameras refuse and simple exporters write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Role, SceneGraph, SourceId


def give_normals(scene_graph: SceneGraph, source: SourceId) -> None:
    """Gives what cameras see the normals of its faces, where an OBJ file has none.

    Its material and texture are left out: the colour is that of the model file.

    Args:
        scene_graph: with all geometry, without a renderer yet.
        source: whose geometry it is.

    Raises:
        ValueError: for a file whose faces name vertices that it does not have.
    """
    inspector = scene_graph.model_inspector()
    for geometry in inspector.GetAllGeometryIds(role=Role.kPerception):
        shape = inspector.GetShape(geometry)
        if not isinstance(shape, Mesh) or shape.extension() != ".obj":
            continue
        found = shape.source()
        file = Path(found.path()) if found.is_path() else None
        if file is None or (text := with_normals(file.read_text("utf-8"), file.name)) is None:
            continue
        mesh = InMemoryMesh(mesh_file=MemoryFile(text, ".obj", file.name))
        scene_graph.ChangeShape(source, geometry, Mesh(mesh, scale3=shape.scale3()))


def with_normals(text: str, name: str = "mesh") -> str | None:
    """An OBJ text with a normal for each face; None: it has normals.

    Args:
        text: of the file.
        name: for errors.

    Raises:
        ValueError: if a face names a vertex that is not there.
    """
    lines = text.splitlines()
    if any(line.startswith("vn ") for line in lines):
        return None
    vertices: list[list[float]] = []
    out: list[str] = []
    faces = 0
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0] in ("mtllib", "usemtl", "vt"):
            continue
        if words[0] == "v":
            vertices.append([float(word) for word in words[1:4]])
        if words[0] != "f":
            out.append(line)
            continue
        rows = [int(word.split("/")[0]) for word in words[1:]]
        rows = [row - 1 if row > 0 else row + len(vertices) for row in rows]
        if len(rows) < 3 or min(rows) < 0 or max(rows) >= len(vertices):
            raise ValueError(
                f"'{name}', line {number}: a face needs at least 3 of the {len(vertices)} vertices "
                f"above it, not '{line.strip()}'"
            )
        p = np.array([vertices[row] for row in rows])
        # Newell's sum: right for any polygon, zero for one without area.
        normal = np.cross(p, np.roll(p, -1, axis=0)).sum(axis=0)
        length = np.linalg.norm(normal)
        x, y, z = normal / length if length > 0.0 else (0.0, 0.0, 1.0)
        faces += 1
        out.append(f"vn {x:.9g} {y:.9g} {z:.9g}")
        out.append("f " + " ".join(f"{row + 1}//{faces}" for row in rows))
    return "\n".join(out) + "\n"
