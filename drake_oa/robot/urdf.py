"""URDFs of other packages as Drake takes them: meshes as .obj, actuators, packages of Python.

Drake takes collision meshes as .obj, .gltf and .vtk, and of a joint without a <transmission> it
makes none that can be driven. Most URDFs of arms have .stl and .dae and no transmissions.
"""

from __future__ import annotations

import copy
import hashlib
from collections.abc import Sequence
from importlib import metadata
from itertools import combinations
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydrake.multibody.parsing import PackageMap
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, QhullError

from drake_oa.common.config import ScenarioError
from drake_oa.common.files import replace_text, user_cache
from drake_oa.common.messages import FloatArray, IntArray

DRAKE_XML = "http://drake.mit.edu"
"""Namespace that a text must have under the name `drake`, or Drake does not know it."""
_DRAKES_OWN = {".obj", ".gltf", ".vtk"}
_VERSION = 1
"""Of what is in the cache."""
_JOINED = 0.1
"""Two parts of a mesh are one hull where that is larger than the two by a smaller share."""
_MOVING = ("revolute", "continuous", "prismatic")


def add_installed_package(packages: PackageMap, url: str) -> None:
    """Tells where the package of a URL is, if an installed distribution has it in share/NAME.

    A package that is known already stays where it is; one that is not found is left to Drake to
    complain about.
    """
    name = url.removeprefix("package://").partition("/")[0]
    if not url.startswith("package://") or packages.Contains(name):
        return
    try:
        files = metadata.distribution(name).files or ()
    except metadata.PackageNotFoundError:
        return
    for file in files:
        row = next((i for i in range(1, len(file.parts)) if file.parts[i] == name), 0)
        if row and file.parts[row - 1] == "share":
            packages.Add(name, str(Path(str(file.locate())).parents[len(file.parts) - row - 2]))
            return


def drake_urdf(file: Path, packages: PackageMap) -> str | None:
    """The text of a URDF as Drake takes it; None: Drake takes the file as it is.

    - Meshes that Drake does not read are converted, see `as_objs`; a visual one that cannot be
      is left out, and the link's collision shapes are shown in its place.
    - Where no joint has a transmission, each that moves by itself has an actuator, with the
      effort limit of the joint.
    - A link `world`, and the joint that fixes the base to it, are left out: the base stands
      where the scenario says.

    Raises:
        ScenarioError: for a collision mesh that cannot be read, or a file that is no XML.
    """
    try:
        root = ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, OSError) as error:
        raise ScenarioError(f"robot.model: '{file}': {error}") from None
    ElementTree.register_namespace("drake", DRAKE_XML)
    changed = _without_world(root)
    for link in root.iter("link"):
        changed |= _with_meshes(link, file, packages)
    moving = [j for j in root.findall("joint") if j.get("type") in _MOVING]
    if not root.findall("transmission"):
        driven = [joint for joint in moving if joint.find("mimic") is None]
        for joint in driven:
            _drive(root, joint.get("name", ""))
        changed |= bool(driven)
    return ElementTree.tostring(root, encoding="unicode") if changed else None


def _without_world(root: ElementTree.Element) -> bool:
    out = [link for link in root.findall("link") if link.get("name") == "world"]
    for joint in root.findall("joint"):
        parent = joint.find("parent")
        if parent is not None and parent.get("link") == "world" and joint.get("type") == "fixed":
            out.append(joint)
    for element in out:
        root.remove(element)
    return bool(out)


def _drive(root: ElementTree.Element, joint: str) -> None:
    transmission = ElementTree.SubElement(root, "transmission", name=f"{joint}_transmission")
    kind = ElementTree.SubElement(transmission, "type")
    kind.text = "transmission_interface/SimpleTransmission"
    ElementTree.SubElement(transmission, "joint", name=joint)
    ElementTree.SubElement(transmission, "actuator", name=f"{joint}_motor")


def _with_meshes(link: ElementTree.Element, file: Path, packages: PackageMap) -> bool:
    """Makes a link's meshes ones that Drake reads; whether any was not."""
    changed = False
    for shape in [*link.findall("collision"), *link.findall("visual")]:
        mesh = shape.find("geometry/mesh")
        if mesh is None:
            continue
        found = [_resolved(mesh.get("filename", ""), file, packages)]
        if found[0].suffix.lower() not in _DRAKES_OWN:
            changed = True
            try:
                found = as_objs(found[0], hulls=shape.tag == "collision")
            except ValueError as error:
                if shape.tag == "collision":
                    name = link.get("name")
                    raise ScenarioError(f"robot.model: <collision> of {name}: {error}") from None
                found = []
            link.remove(shape)
        for part in found:
            mesh.set("filename", part.absolute().as_uri())
            if changed:
                link.append(copy.deepcopy(shape))
    if changed and not link.findall("visual"):
        for shape in link.findall("collision"):
            shown = ElementTree.SubElement(link, "visual")
            shown.extend(part for part in shape if part.tag in ("origin", "geometry"))
    return changed


def _resolved(url: str, file: Path, packages: PackageMap) -> Path:
    """The file of a mesh, which may be named relative to that of its model."""
    if "://" not in url:
        return file.parent / url
    add_installed_package(packages, url)
    try:
        return Path(packages.ResolveUrl(url))
    except RuntimeError as error:
        raise ScenarioError(f"robot.model: '{file}': {error}") from None


def as_objs(mesh: Path, *, hulls: bool) -> list[Path]:
    """A mesh as .obj, in the cache; made once for what is in the file.

    Args:
        mesh: a file that open3d reads.
        hulls: as convex hulls of its closed surfaces, one a file: a hull of them all, which
            Drake would take, fills the side of an arm's link between its joints. A mesh with a
            surface that is not closed has one hull. Else as it is.

    Raises:
        ValueError: if it holds no triangles, or cannot be read or written.
    """
    try:
        digest = hashlib.sha256(mesh.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise ValueError(str(error)) from None
    made = user_cache(f"meshes-{_VERSION}")
    stem = f"{mesh.stem}-{digest}-{'hull' if hulls else 'whole'}"
    found = sorted(made.glob(f"{stem}-*.obj"))
    # The last is written first, and its name says how many there are.
    if found and len(found) == int(found[-1].stem.rpartition("-")[2]):
        return found
    vertices, triangles = _read(mesh)
    pieces = _hulls(vertices, triangles) if hulls else [(vertices, triangles)]
    files = [made / f"{stem}-{row:03d}.obj" for row in range(1, len(pieces) + 1)]
    try:
        made.mkdir(parents=True, exist_ok=True)
        for file, (points, faces) in reversed(list(zip(files, pieces, strict=True))):
            lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in points]
            lines += [f"f {a} {b} {c}" for a, b, c in faces + 1]
            replace_text(file, "\n".join(lines) + "\n")
    except OSError as error:
        raise ValueError(f"'{made}' cannot be written: {error}") from None
    return files


def _read(mesh: Path) -> tuple[FloatArray, IntArray]:
    """Vertices (N, 3), each once, and triangles (M, 3)."""
    import open3d

    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
        read = open3d.io.read_triangle_mesh(str(mesh)).remove_duplicated_vertices()
    vertices, triangles = np.asarray(read.vertices), np.asarray(read.triangles).astype(np.int64)
    if not len(triangles) or not np.isfinite(vertices).all():
        raise ValueError(f"'{mesh}' cannot be read as a mesh of triangles")
    return vertices, triangles


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
