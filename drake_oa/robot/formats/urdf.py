"""Conversion of URDF models so that Drake can use them: meshes to .obj files, added actuators, and
fixed gripper linkages.

Drake reads meshes in .obj, .gltf and .vtk files. It adds no actuator to a joint without a
<transmission>, and does not close the kinematic loops of a gripper's linkage. Most models of arms
have .stl or .dae meshes, no transmissions, and a linkage in the gripper.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement

from drake_oa.common.config import field_errors
from drake_oa.robot.formats.meshes import convert_to_objs

_READ_BY_DRAKE = {".obj", ".gltf", ".vtk"}
"""Suffixes of the mesh files that Drake can read; meshes in other formats are converted to .obj
files."""
_TURNING = ("revolute", "continuous")
"""Types of rotational joints in a URDF."""


def convert_urdf(model: Element, find: Callable[[str], Path]) -> None:
    """Converts a URDF model in place so that Drake can read it.

    - Meshes that Drake cannot read are converted by `convert_to_objs`.
    - If no joint has a transmission, each revolute or prismatic joint that does not mimic another
      one gets an actuator, with the effort limit of the joint.
    - A rotational joint that mimics another joint, and the mimicked joint, are fixed at zero. Such
      joints form a gripper's linkage; the controller would not move them together, because it
      holds each joint of a hand separately.
    - The link `world` and the joint that fixes the base to it are removed: the scenario sets the
      base pose.

    Args:
        model: root element of the URDF.
        find: function that returns the file of a mesh, given its URL.

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
    """Converts those meshes of a URDF link that Drake cannot read to .obj files.

    A collision mesh is replaced by one collision element per convex hull.

    Args:
        link: element of the link, modified in place.
        find: function that returns the file of a mesh, given its URL.

    Raises:
        ScenarioError: for a mesh that cannot be read.
    """
    for shape in [*link.findall("collision"), *link.findall("visual")]:
        mesh = shape.find("geometry/mesh")
        if mesh is None:
            continue
        files = [find(mesh.get("filename", ""))]
        if files[0].suffix.lower() not in _READ_BY_DRAKE:
            with field_errors(f"robot.model: <{shape.tag}> of {link.get('name')}", ValueError):
                files = convert_to_objs(files[0], hulls=shape.tag == "collision")
        link.remove(shape)
        for file in files:
            mesh.set("filename", f"file://{file.absolute()}")
            link.append(copy.deepcopy(shape))


def _fix_linkage(model: Element) -> None:
    """Changes each rotational joint of a URDF that mimics another joint, and the mimicked joint, to
    a fixed joint.

    Transmissions of these joints are removed. The joints are those of a gripper's linkage.
    """
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
    """Adds a <transmission> with an actuator to a URDF, so that Drake actuates the named joint.

    Args:
        model: root element of the URDF.
        joint: name of the joint.
    """
    transmission = SubElement(model, "transmission", name=f"{joint}_transmission")
    SubElement(transmission, "type").text = "transmission_interface/SimpleTransmission"
    SubElement(transmission, "joint", name=joint)
    SubElement(transmission, "actuator", name=f"{joint}_motor")
