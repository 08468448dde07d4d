"""Replacement of a model's inertial parameters, to give the controller a wrong model.

The shipped Panda has identified parameters (C. Gaz et al., IEEE RA-L 4(4), 2019). The shipped file
models/panda/uniform_density.yaml has those of links with uniform density, with the typical errors
of a robot without identification.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated
from xml.etree.ElementTree import Element, SubElement

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK, ScenarioError, Vector3, length, read_yaml, validate


@dataclass(config=BLOCK)
class Inertia:
    """Inertial parameters of a link: an entry of a file of inertias."""

    mass: Annotated[float, Field(gt=0.0, le=1e4)]
    """Mass [kg]. Raising it makes the link heavier."""
    com: Vector3
    """Center of mass in the link's frame [m]."""
    inertia: Annotated[list[float], length(6)]
    """Rotational inertia about the center of mass in the link's axes: xx, yy, zz, xy, xz, yz
    [kg m^2]. Raising the first three makes rotations slower."""


def set_inertias(urdf: Element | None, file: Path) -> None:
    """Replaces the inertial parameters of the links that are named in a YAML file.

    Args:
        urdf: root of a URDF, modified in place; None: the model is no URDF.
        file: file with inertial parameters by name of the link.

    Raises:
        OSError: if the file does not exist.
        ScenarioError: listing every wrong value, or naming a link that is not in the model.
    """
    inertias = validate(dict[str, Inertia], read_yaml(file.read_text("utf-8")), "inertias")
    links = {} if urdf is None else {link.get("name"): link for link in urdf.iter("link")}
    for name, item in inertias.items():
        link = links.get(name)
        if link is None:
            raise ScenarioError(
                f"robot.model has no link {name}; it has {', '.join(map(str, links))}"
            )
        for previous in link.findall("inertial"):
            link.remove(previous)
        inertial = SubElement(link, "inertial")
        SubElement(inertial, "origin", xyz=" ".join(map(repr, item.com)))
        SubElement(inertial, "mass", value=repr(item.mass))
        names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
        SubElement(inertial, "inertia", dict(zip(names, map(repr, item.inertia), strict=True)))
