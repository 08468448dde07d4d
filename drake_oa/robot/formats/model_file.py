"""Functions that read and check the model file of a robot (URDF, SDF or MJCF), and convert it so
that Drake can parse it.
"""

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
from drake_oa.robot.formats.mjcf import convert_mjcf
from drake_oa.robot.formats.urdf import convert_urdf

# Drake recognizes its namespace only by the prefix "drake".
ElementTree.register_namespace("drake", "http://drake.mit.edu")
_CONVERSIONS = {".urdf": convert_urdf, ".xml": convert_mjcf}
"""Functions that convert a robot model so that Drake can parse it, by suffix of the model's
file."""
_LENGTHS = ("size", "radius", "length", "radii")
"""Names of the dimensions of shapes in URDF and SDF, used to check that they are positive."""
_logged: set[str] = set()
"""Drake's warnings about model files that this process has already logged."""


def add_installed_package(packages: PackageMap, url: str, field: str = "robot.model") -> None:
    """Adds the folder of an installed Python package to a package map, if a URL refers to this
    package.

    Args:
        packages: package map, modified in place unless it already has the package.
        url: URL package://NAME/... of a file; other URLs are ignored.
        field: name of the scenario's field with the URL, for the error message.

    Raises:
        ScenarioError: if the package does not exist.
    """
    name = url.removeprefix("package://").partition("/")[0]
    if not url.startswith("package://") or packages.Contains(name):
        return
    folder = installed_package(name)
    if folder is None:
        raise ScenarioError(
            f"{field}: '{url}': '{name}' is neither a package of Drake nor an installed Python "
            "package; for models of shipped scenarios: pip install 'drake_oa[robots]'"
        )
    packages.Add(name, str(folder))


def converted_model(file: Path, packages: PackageMap) -> ElementTree.Element | None:
    """Reads the model file of a robot, and returns its root element, converted so that Drake can
    parse it; None for an SDF, which needs no conversion.

    Args:
        file: model file, as URDF, MJCF or SDF.
        packages: package map that resolves the URLs of meshes.

    Raises:
        ScenarioError: for a mesh that cannot be read, an invalid value, or a file that is not XML.
    """
    with field_errors(f"robot.model: '{file}'", ElementTree.ParseError, OSError):
        root = ElementTree.parse(file).getroot()
    check_links(root, file)
    convert = _CONVERSIONS.get(file.suffix.lower())
    if convert is None:
        return None

    def find(url: str) -> Path:
        """Returns the file of a mesh, given its URL or its name relative to the model's file."""
        if "://" not in url:
            return file.parent / url
        add_installed_package(packages, url)
        with field_errors(f"robot.model: '{file}'", RuntimeError):
            return Path(packages.ResolveUrl(url))

    convert(root, find)
    return root


def check_links(root: ElementTree.Element, file: Path, field: str = "robot.model") -> None:
    """Checks that the shapes of a model's links have positive sizes, and that no mass is negative.

    Drake would replace invalid values by defaults, or abort.

    Args:
        root: root element of a URDF or SDF; an MJCF has no links.
        file: file of the model, for the error message.
        field: name of the scenario's field with the model, for the error message.

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
    """Returns the numbers in a text, separated by spaces, for the check of a model's values.

    The list is empty for None and for invalid text, which Drake rejects later.
    """
    try:
        return [float(word) for word in (text or "").split()]
    except ValueError:
        return []


def with_file_name(message: str, file: Path | str) -> str:
    """Returns a message of Drake's parser with the name of the model's file in place of Drake's
    placeholder `<literal-string>`.

    Args:
        message: message about a model that Drake parsed from a string.
        file: file of the model.
    """
    # The line number is dropped: it refers to the converted text.
    return re.sub(r"<literal-string>(\.\w+)?(:\d+)?", str(file), message)


@contextlib.contextmanager
def named_warnings(file: Path | str = "") -> Iterator[None]:
    """Provides a context in which each of Drake's warnings about a model is logged once per process
    only, with the name of the model's file.

    Args:
        file: file of the model that is parsed within the context.
    """

    def is_new(record: logging.LogRecord) -> bool:
        """Adds the file name to a logged warning, and returns whether this process has not logged
        the warning yet.
        """
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
