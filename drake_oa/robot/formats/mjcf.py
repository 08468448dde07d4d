"""MJCF of an arm as Drake reads it: complete classes, motors, a base without weld.

Drake's parser knows what a default class states itself, not what it inherits; it reads meshes as
.obj, of actuators motors alone, and welds the base to the world where it is.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from xml.etree.ElementTree import Element

from drake_oa.common.config import field_errors
from drake_oa.robot.formats.meshes import as_objs

_DRIVES = ("motor", "general", "position", "velocity", "intvelocity")
_IGNORED = {
    *("light", "site", "camera"),
    *("option", "size", "visual", "statistic", "keyframe", "sensor"),
}
"""Elements that no motion depends on, and that Drake would warn of."""


def change_mjcf(root: Element, find: Callable[[str], Path]) -> None:
    """Makes an MJCF one that Drake reads.

    - Default classes state what they inherit.
    - Each actuator of a joint becomes a motor, limited by its force range.
    - A base without a joint can be welded where the scenario says.
    - Meshes are converted, see `as_objs`: an .obj too, as its color is that of the model and
      the .mtl that it names is often missing.

    Args:
        root: of the model's file, to be changed.
        find: returns the file of a mesh by its name relative to the model's file.

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
                (converted,) = as_objs(find(str(Path(folder) / name)), hulls=False)
            mesh.set("file", str(converted.absolute()))
    for body in root.findall("worldbody/body"):
        if not {part.tag for part in body} & {"joint", "freejoint"}:
            body.insert(0, Element("freejoint"))
    for actuator in root.findall("actuator"):
        for drive in [*actuator]:
            actuator.remove(drive)
            if drive.tag in _DRIVES and drive.get("joint"):
                actuator.append(_motor(drive, root))


def _inherit(default: Element, above: dict[str, dict[str, str]]) -> None:
    """Writes inherited attributes, by tag, into a default class and those inside it."""
    for tag, inherited in above.items():
        part = default.find(tag)
        if part is None:
            default.append(part := Element(tag))
        part.attrib = inherited | part.attrib
    own = {part.tag: dict(part.attrib) for part in default if part.tag != "default"}
    for part in default.findall("default"):
        _inherit(part, own)


def _motor(drive: Element, root: Element) -> Element:
    """Returns a motor with the limit and the gear of a drive, or of its class."""
    of_class = root.find(f".//default[@class='{drive.get('class', 'main')}']/{drive.tag}")
    values = (of_class.attrib if of_class is not None else {}) | drive.attrib
    motor = Element("motor", name=values.get("name", values["joint"]), joint=values["joint"])
    limit = values.get("forcerange") or (values.get("ctrlrange") if drive.tag == "motor" else None)
    if limit:
        motor.attrib |= {"ctrlrange": limit, "ctrllimited": "true"}
    if "gear" in values:
        motor.set("gear", values["gear"])
    return motor
