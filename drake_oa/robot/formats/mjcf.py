"""Conversion of an arm's MJCF model (MuJoCo's format) for Drake: inherited defaults, motors, and a
base that can be welded to the world.

Drake's parser ignores attributes that a default class inherits from another class. It reads only
.obj meshes, supports only motors as actuators, and welds the base to the world at the pose in the
file.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from xml.etree.ElementTree import Element

from drake_oa.common.config import field_errors
from drake_oa.robot.formats.meshes import convert_to_objs

_DRIVES = ("motor", "general", "position", "velocity", "intvelocity")
"""Tags of the MuJoCo actuators in an MJCF model that are converted to motors, the only actuators
that Drake supports."""
_IGNORED = {
    *("light", "site", "camera"),
    *("option", "size", "visual", "statistic", "keyframe", "sensor"),
}
"""Tags of MJCF elements that do not influence the motion. They are removed from the model, because
Drake warns about them."""


def convert_mjcf(root: Element, find: Callable[[str], Path]) -> None:
    """Converts an MJCF model in place so that Drake can read it.

    - Each default class receives the attributes that it inherits from other classes.
    - Each actuator of a joint becomes a motor, limited by the force range of the actuator.
    - A base without a joint gets a free joint, so that the scenario can weld the base.
    - All meshes are converted by `convert_to_objs`, including .obj files. The color of a mesh is
      then the color in the model, because .mtl files of .obj meshes are often missing.

    Args:
        root: root element of the model's file.
        find: function that returns the file of a mesh, given its name relative to the model's file.

    Raises:
        ScenarioError: for a mesh that cannot be read.
    """
    for element in root.iter():
        for part in [*element]:
            if part.tag in _IGNORED:
                element.remove(part)
    for default in root.findall("default"):
        _inherit(default, {})
    compiler = root.find("compiler")
    folder = "" if compiler is None else compiler.get("meshdir", "")
    for mesh in root.findall("asset/mesh"):
        if name := mesh.get("file"):
            mesh.attrib.setdefault("name", Path(name).stem)
            with field_errors(f"robot.model: <mesh> {mesh.get('name')}", ValueError):
                (converted,) = convert_to_objs(find(str(Path(folder) / name)), hulls=False)
            mesh.set("file", str(converted.absolute()))
    for body in root.findall("worldbody/body"):
        if not {part.tag for part in body} & {"joint", "freejoint"}:
            body.insert(0, Element("freejoint"))
    for actuator in root.findall("actuator"):
        for drive in [*actuator]:
            actuator.remove(drive)
            if drive.tag in _DRIVES and drive.get("joint"):
                actuator.append(_motor(drive, root))


def _inherit(default: Element, parent_attributes: dict[str, dict[str, str]]) -> None:
    """Adds the attributes of the parent class to a default class of an MJCF model and, recursively,
    to the classes nested in it.

    Args:
        default: element of the default class, modified in place.
        parent_attributes: attributes of the parent class, by tag and attribute name.
    """
    for tag, inherited in parent_attributes.items():
        part = default.find(tag)
        if part is None:
            default.append(part := Element(tag))
        part.attrib = inherited | part.attrib
    attributes = {part.tag: dict(part.attrib) for part in default if part.tag != "default"}
    for part in default.findall("default"):
        _inherit(part, attributes)


def _motor(drive: Element, root: Element) -> Element:
    """Returns an MJCF motor that replaces an actuator, with the force limit and gear ratio of the
    actuator or of its default class.

    Args:
        drive: element of the actuator.
        root: root element of the MJCF model, which contains the default classes.
    """
    where, values = "default", dict[str, str]()
    if name := drive.get("class"):
        where = f".//default[@class='{name}']"
    # The tag <general> has the defaults of all kinds of actuators.
    for part in [*root.findall(f"{where}/general"), *root.findall(f"{where}/{drive.tag}"), drive]:
        values |= part.attrib
    motor = Element("motor", name=values.get("name", values["joint"]), joint=values["joint"])
    limit = values.get("forcerange") or (values.get("ctrlrange") if drive.tag == "motor" else None)
    if limit:
        motor.attrib |= {"ctrlrange": limit, "ctrllimited": "true"}
    if "gear" in values:
        motor.set("gear", values["gear"])
    return motor
