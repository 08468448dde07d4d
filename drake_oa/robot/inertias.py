"""Replacement of the inertial parameters in a robot's model, used to simulate a controller whose
model has errors.

The shipped Panda has identified parameters (C. Gaz et al., IEEE RA-L 4(4), 2019). The shipped file
models/panda/uniform_density.yaml has the parameters of links with uniform density instead. Its
errors are typical of a robot whose parameters were not identified.
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
    """Inertial parameters of one link: entry of a YAML file whose values replace those of a robot's
    model.
    """

    mass: Annotated[float, Field(gt=0.0, le=1e4)]
    """Mass of the link [kg]."""
    com: Vector3
    """Center of mass of the link in the link's frame [m]."""
    inertia: Annotated[list[float], length(6)]
    """Rotational inertia of the link about its center of mass, in the axes of the link's frame: xx,
    yy, zz, xy, xz, yz [kg m^2]."""


def set_inertias(urdf: Element | None, file: Path) -> None:
    """Replaces the inertial parameters of a URDF model by those of a YAML file, for each link that
    the file names.

    Args:
        urdf: root element of a URDF, modified in place; None: the model is not a URDF.
        file: YAML file with the inertial parameters of links, by link name.

    Raises:
        OSError: if the file does not exist.
        ScenarioError: naming each invalid value in the file, or a link that is not in the model.
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
