"""Other inertial parameters for a model's links: what a controller takes the robot for.

The package's Panda has identified ones (C. Gaz et al., IEEE RA-L 4(4), 2019). Those in the file
beside it, of uniform density, are as far off as those of a robot without identification.
"""

from __future__ import annotations

import dataclasses as dc
from pathlib import Path
from xml.etree import ElementTree

from drake_oa.common.config import ScenarioError, check, number, read_yaml, vector
from drake_oa.robot.formats.urdf import DRAKE_XML


@dc.dataclass
class Inertia:
    """Of a link: the values of a file of inertias."""

    mass: float = number(1.0, "kg", 0.0, 1e4, open_low=True)
    # Centre of mass in the link's frame.
    com: list[float] = vector([0.0, 0.0, 0.0], "m")
    # About the centre of mass, along the link's axes: xx, yy, zz, xy, xz, yz.
    inertia: list[float] = vector([1.0, 1.0, 1.0, 0.0, 0.0, 0.0], "kg m^2")


def read_inertias(file: Path) -> dict[str, Inertia]:
    """The inertias of a YAML file, by the name of the link; each gives mass, com and inertia.

    Raises:
        ScenarioError: naming the value that is wrong, or the file.
    """
    try:
        data = read_yaml(file.read_text())
        check(data, dict[str, Inertia], "inertias", {})
        for name, item in data.items():
            if missing := [value.name for value in dc.fields(Inertia) if value.name not in item]:
                raise ScenarioError(f"inertias.{name}: {', '.join(missing)} must be given")
        return {name: Inertia(**item) for name, item in data.items()}
    except (OSError, UnicodeDecodeError, ScenarioError) as error:
        raise ScenarioError(f"'{file}': {error}") from None


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
