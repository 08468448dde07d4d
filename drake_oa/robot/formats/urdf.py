"""URDF and SDF of other packages as Drake takes them: meshes as .obj, actuators, no linkages.

Drake takes collision meshes as .obj, .gltf and .vtk, of a URDF's joint without a <transmission>
it makes none that can be driven, and of a gripper's linkage one that nothing holds together. Most
models of arms have .stl and .dae, no transmissions and a linkage.
"""

from __future__ import annotations

import copy
import logging
from xml.etree import ElementTree

from drake_oa.common.config import ScenarioError
from drake_oa.robot.formats.meshes import DRAKES_OWN, ModelMeshes

DRAKE_XML = "http://drake.mit.edu"
"""Namespace that a text must have under the name `drake`, or Drake does not know it."""
_log = logging.getLogger(__name__)
_TURNING = ("revolute", "continuous")
_MOVING = (*_TURNING, "prismatic")


def drake_links(root: ElementTree.Element, meshes: ModelMeshes) -> bool:
    """Makes a URDF, or an SDF, one that Drake takes; whether anything was changed.

    - Meshes that Drake does not read are converted, see `as_objs`; a visual one that cannot be
      is left out, and the link's collision shapes are shown in its place.
    - Where no joint of a URDF has a transmission, each that moves by itself has an actuator, with
      the effort limit of the joint. An SDF's joints have them by their own limits.
    - Turning joints that mimic another, and the one that they do, are fixed at zero: a
      gripper's linkage, as the arm's controller holds each joint of a hand by itself.
    - A link `world`, and the joint that fixes the base to it, are left out: the base stands
      where the scenario says.

    Args:
        root: of the model's file.
        meshes: of the model.

    Raises:
        ScenarioError: for a collision mesh that cannot be read.
    """
    ElementTree.register_namespace("drake", DRAKE_XML)
    changed = False
    for model in [root] if root.tag == "robot" else root.iter("model"):
        changed |= _without_world(model)
        for link in model.findall("link"):
            changed |= _with_meshes(link, meshes)
        if model is root:
            changed |= _without_linkage(model)
            changed |= _driven(model)
    return changed


def _without_world(model: ElementTree.Element) -> bool:
    out = [link for link in model.findall("link") if link.get("name") == "world"]
    for joint in model.findall("joint"):
        parent = joint.find("parent")
        if parent is not None and joint.get("type") == "fixed":
            out += [joint] * ("world" in (parent.get("link"), (parent.text or "").strip()))
    for element in out:
        model.remove(element)
    return bool(out)


def _without_linkage(model: ElementTree.Element) -> bool:
    joints = {joint.get("name"): joint for joint in model.findall("joint")}
    fixed = set()
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is not None and joint.get("type") in _TURNING:
            fixed |= {name, mimic.get("joint")}
    for name in sorted(fixed & joints.keys(), key=str):
        joints[name].set("type", "fixed")
        for part in [*joints[name]]:
            if part.tag not in ("origin", "parent", "child"):
                joints[name].remove(part)
    for transmission in model.findall("transmission"):
        if {joint.get("name") for joint in transmission.findall("joint")} & fixed:
            model.remove(transmission)
    return bool(fixed)


def _driven(model: ElementTree.Element) -> bool:
    if model.findall("transmission"):
        return False
    moving = [j for j in model.findall("joint") if j.get("type") in _MOVING]
    names = [joint.get("name", "") for joint in moving if joint.find("mimic") is None]
    for joint in names:
        transmission = ElementTree.SubElement(model, "transmission", name=f"{joint}_transmission")
        kind = ElementTree.SubElement(transmission, "type")
        kind.text = "transmission_interface/SimpleTransmission"
        ElementTree.SubElement(transmission, "joint", name=joint)
        ElementTree.SubElement(transmission, "actuator", name=f"{joint}_motor")
    return bool(names)


def _with_meshes(link: ElementTree.Element, meshes: ModelMeshes) -> bool:
    """Makes a link's meshes ones that Drake reads; whether any was not."""
    changed = False
    for shape in [*link.findall("collision"), *link.findall("visual")]:
        mesh = shape.find("geometry/mesh")
        if mesh is None:
            continue
        uri, converted = mesh.find("uri"), False
        found = [meshes.find(mesh.get("filename", "") if uri is None else (uri.text or "").strip())]
        if found[0].suffix.lower() not in DRAKES_OWN:
            changed = converted = True
            try:
                found = meshes.convert(found[0], hulls=shape.tag == "collision")
            except ValueError as error:
                name = link.get("name")
                if shape.tag == "collision":
                    raise ScenarioError(f"robot.model: <collision> of {name}: {error}") from None
                _log.info("<visual> of %s is not shown: %s", name, error)
                found = []
            link.remove(shape)
        for row, part in enumerate(found):
            if uri is None:
                mesh.set("filename", part.absolute().as_uri())
            else:
                uri.text = part.absolute().as_uri()
            if converted:
                each = copy.deepcopy(shape)
                # An SDF's have names of their own.
                if "name" in each.attrib and row:
                    each.set("name", f"{each.get('name')}-{row}")
                link.append(each)
    if changed and not link.findall("visual"):
        for row, shape in enumerate(link.findall("collision")):
            shown = ElementTree.SubElement(link, "visual", name=f"shown-{row}")
            shown.extend(part for part in shape if part.tag in ("origin", "pose", "geometry"))
    return changed
