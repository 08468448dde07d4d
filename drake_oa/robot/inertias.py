"""Other inertial parameters for a model's links: what a controller takes the robot for.

The package's Panda has identified ones (C. Gaz et al., IEEE RA-L 4(4), 2019). Those in the file
beside it, of uniform density, are as far off as those of a robot without identification.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import (
    BLOCK,
    ScenarioError,
    Vector3,
    field_errors,
    length,
    read_yaml,
    validate,
)
from drake_oa.robot.formats.urdf import DRAKE_XML


@dataclass(config=BLOCK)
class Inertia:
    """Inertial parameters of a link."""

    mass: Annotated[float, Field(gt=0.0, le=1e4)]
    """Mass [kg]. Raising it makes the link heavier."""
    com: Vector3
    """Center of mass in the link's frame [m]."""
    inertia: Annotated[list[float], length(6)]
    """Rotational inertia about the center of mass in the link's axes: xx, yy, zz, xy, xz, yz
    [kg m^2]. Raising the first three makes rotations slower."""


def read_inertias(file: Path) -> dict[str, Inertia]:
    """Returns the inertial parameters in a YAML file by the name of the link.

    Raises:
        ScenarioError: naming the file and every wrong value.
    """
    with field_errors(f"'{file}'", OSError, UnicodeDecodeError, ScenarioError):
        inertias: dict[str, Inertia] = validate(
            dict[str, Inertia], read_yaml(file.read_text()), "inertias"
        )
    return inertias


def with_inertias(urdf: str, inertias: dict[str, Inertia]) -> str:
    """The text of a URDF with the inertial parameters of some links replaced.

    Raises:
        ScenarioError: if the model lacks one of the links.
    """
    ElementTree.register_namespace("drake", DRAKE_XML)
    root = ElementTree.fromstring(urdf)
    links = {link.get("name", ""): link for link in root.iter("link")}
    missing = [name for name in inertias if name not in links]
    if missing:
        raise ScenarioError(
            f"is of links that robot.model has not: {', '.join(missing)}; it has {', '.join(links)}"
        )
    for name, item in inertias.items():
        link = links[name]
        for old in link.findall("inertial"):
            link.remove(old)
        inertial = ElementTree.SubElement(link, "inertial")
        ElementTree.SubElement(inertial, "origin", xyz=" ".join(map(repr, item.com)))
        ElementTree.SubElement(inertial, "mass", value=repr(item.mass))
        names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        values = dict(zip(names, map(repr, item.inertia), strict=True))
        ElementTree.SubElement(inertial, "inertia", values)
    return ElementTree.tostring(root, encoding="unicode")
