"""Scenarios of the package: their files, descriptions and required packages."""

from pathlib import Path

from drake_oa.common.files import installed_package, package_folder

_SUFFIX = ".scenario.yaml"


def shipped_scenarios() -> dict[str, Path]:
    """Name -> file of the scenarios that come with the package."""
    folder = package_folder("drake_oa.diagrams")
    return {p.name.removesuffix(_SUFFIX): p for p in sorted(folder.glob(f"*{_SUFFIX}"))}


def description(path: Path) -> str:
    """A scenario file's field `description`, read without building the scenario."""
    return _text(path, "description")


def missing_package(path: Path) -> str:
    """The package of the robot's model where it is not installed, else "".

    Read without building the scenario.
    """
    url = _text(path, "robot", "model")
    name = url.removeprefix("package://").partition("/")[0]
    if not url.startswith("package://") or name == "drake_oa" or installed_package(name):
        return ""
    return name


def _text(path: Path, *fields: str) -> str:
    # Not at the top: `drake-oa --help` reads no file.
    import yaml

    # Nodes, as the tags of blocks mean nothing to YAML itself.
    node = yaml.compose(
        path.read_text("utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    )
    for field in fields:
        pairs = node.value if isinstance(node, yaml.MappingNode) else ()
        node = next((value for key, value in pairs if key.value == field), None)
    return node.value if isinstance(node, yaml.ScalarNode) else ""
