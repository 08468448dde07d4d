"""URDFs of other packages as Drake reads them: meshes as .obj, actuators, no linkages.

Drake reads meshes as .obj, .gltf and .vtk, of a URDF's joint without a <transmission> it makes
none that can be driven, and of a gripper's linkage one that nothing holds together. Most models
of arms have .stl and .dae, no transmissions and a linkage.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from drake_oa.common.config import field_errors
from drake_oa.robot.formats.meshes import as_objs

_READ_BY_DRAKE = {".obj", ".gltf", ".vtk"}
_TURNING = ("revolute", "continuous")


def change_urdf(model: Element, find: Callable[[str], Path]) -> None:
    """Makes a URDF one that Drake reads.

    - Meshes that Drake does not read are converted, see `as_objs`.
    - Where no joint has a transmission, each that moves by itself has an actuator, with the effort
      limit of the joint.
    - Turning joints that mimic another, and the one that they do, are fixed at zero: a
      gripper's linkage, as the arm's controller holds each joint of a hand by itself.
    - A link `world`, and the joint that fixes the base to it, are left out: the base stands
      where the scenario says.

    Args:
        model: root of the file, to be changed.
        find: returns the file of a mesh's URL.

    Raises:
        ScenarioError: for a mesh that cannot be read.
    """
    for link in model.findall("link[@name='world']"):
        model.remove(link)
    for joint in model.findall("joint[@type='fixed']"):
        if joint.find("parent[@link='world']") is not None:
            model.remove(joint)
    for link in model.findall("link"):
        _convert_meshes(link, find)
    _fix_linkage(model)
    if model.find("transmission") is None:
        for joint in model.findall("joint"):
            if joint.get("type") in (*_TURNING, "prismatic") and joint.find("mimic") is None:
                _add_transmission(model, joint.get("name", ""))


def _convert_meshes(link: Element, find: Callable[[str], Path]) -> None:
    for shape in [*link.findall("collision"), *link.findall("visual")]:
        mesh = shape.find("geometry/mesh")
        if mesh is None:
            continue
        files = [find(mesh.get("filename", ""))]
        if files[0].suffix.lower() not in _READ_BY_DRAKE:
            with field_errors(f"robot.model: <{shape.tag}> of {link.get('name')}", ValueError):
                files = as_objs(files[0], hulls=shape.tag == "collision")
        link.remove(shape)
        for file in files:
            mesh.set("filename", file.absolute().as_uri())
            link.append(copy.deepcopy(shape))


def _fix_linkage(model: Element) -> None:
    joints = {joint.get("name"): joint for joint in model.findall("joint")}
    fixed = set()
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is not None and joint.get("type") in _TURNING:
            fixed |= {name, mimic.get("joint")}
    for name in fixed & joints.keys():
        joints[name].set("type", "fixed")
        for part in [*joints[name]]:
            if part.tag not in ("origin", "parent", "child"):
                joints[name].remove(part)
    for transmission in model.findall("transmission"):
        if {joint.get("name") for joint in transmission.findall("joint")} & fixed:
            model.remove(transmission)


def _add_transmission(model: Element, joint: str) -> None:
    transmission = SubElement(model, "transmission", name=f"{joint}_transmission")
    SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
    SubElement(transmission, "joint", name=joint)
    SubElement(transmission, "actuator", name=f"{joint}_motor")
