"""MJCF of an arm as Drake takes it: classes of defaults, motors, a base that can be welded.

Drake's parser knows a default class by itself, not what that inherits; it takes meshes as .obj,
of actuators motors alone, and welds the base to the world where it is.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from drake_oa.common.config import field_errors
from drake_oa.robot.formats.meshes import ModelMeshes

_OF_CLASSES = ("joint", "geom", "mesh")
_DRIVES = ("motor", "general", "position", "velocity", "intvelocity")
_IGNORED = {"light", "site", "camera"}
_OF_MUJOCO = {"option", "size", "visual", "statistic", "keyframe", "sensor"}
"""What is of no matter here, and Drake would warn of."""
Defaults = dict[str, dict[str, dict[str, str]]]


def drake_mjcf(root: ElementTree.Element, meshes: ModelMeshes) -> bool:
    """Makes an MJCF one that Drake takes; always changes it.

    - Attributes of default classes are written where they hold.
    - Each actuator of a joint becomes a motor, limited by its force range.
    - A base without a joint can be welded where the scenario says.
    - Meshes are converted, see `as_objs`: an .obj too, as its colour is that of the model and
      the .mtl that it names often is not there.

    Args:
        root: of the model's file.
        meshes: of the model.

    Raises:
        ScenarioError: for a mesh that cannot be read.
    """
    classes: Defaults = {"main": {}}
    for default in root.findall("default"):
        _inherit(default, {}, default.get("class", "main"), classes)
        root.remove(default)
    for part in root.findall("asset"):
        _with_classes(part, "main", classes)
    compiler = root.find("compiler")
    folder = "" if compiler is None else compiler.attrib.pop("meshdir", "")
    for mesh in root.findall("asset/mesh"):
        _with_mesh(mesh, meshes, folder)
    for world in root.findall("worldbody"):
        _with_classes(world, "main", classes)
        for body in world.findall("body"):
            if not {part.tag for part in body} & {"joint", "freejoint"}:
                body.insert(0, ElementTree.Element("freejoint"))
    for actuator in root.findall("actuator"):
        for drive in [*actuator]:
            actuator.remove(drive)
            if drive.tag in _DRIVES and drive.get("joint"):
                actuator.append(_motor(drive, classes))
    for part in [*root]:
        if part.tag in _OF_MUJOCO:
            root.remove(part)
    return True


def _inherit(
    default: ElementTree.Element, above: dict[str, dict[str, str]], name: str, classes: Defaults
) -> None:
    own = {tag: dict(values) for tag, values in above.items()}
    for part in default:
        if part.tag != "default":
            own[part.tag] = own.get(part.tag, {}) | part.attrib
    classes[name] = own
    for part in default.findall("default"):
        _inherit(part, own, part.get("class", ""), classes)


def _with_classes(body: ElementTree.Element, child_class: str, classes: Defaults) -> None:
    """Writes what the classes say into all below a body."""
    child_class = body.attrib.pop("childclass", child_class)
    for part in [*body]:
        if part.tag in _IGNORED:
            body.remove(part)
        elif part.tag in _OF_CLASSES:
            _write(part, child_class, classes)
        elif part.tag == "body":
            _with_classes(part, child_class, classes)
        else:
            part.attrib.pop("class", None)


def _write(part: ElementTree.Element, otherwise: str, classes: Defaults) -> None:
    of_class = classes.get(part.attrib.pop("class", otherwise), {})
    for key, value in of_class.get(part.tag, {}).items():
        part.attrib.setdefault(key, value)


def _motor(drive: ElementTree.Element, classes: Defaults) -> ElementTree.Element:
    _write(drive, "main", classes)
    joint = drive.get("joint", "")
    motor = ElementTree.Element("motor", name=drive.get("name", joint), joint=joint)
    limit = drive.get("forcerange") or (drive.get("ctrlrange") if drive.tag == "motor" else None)
    if limit:
        motor.attrib |= {"ctrlrange": limit, "ctrllimited": "true"}
    if "gear" in drive.attrib:
        motor.set("gear", drive.get("gear", ""))
    return motor


def _with_mesh(mesh: ElementTree.Element, meshes: ModelMeshes, folder: str) -> None:
    name = mesh.get("file")
    if name is None:
        return
    file = meshes.find(str(Path(folder) / name))
    mesh.attrib.setdefault("name", Path(name).stem)
    with field_errors(f"robot.model: <mesh> {mesh.get('name')}", ValueError):
        (converted,) = meshes.convert(file, hulls=False)
    mesh.set("file", str(converted.absolute()))
