"""Scenario files that are part of this package: functions that list them, and read their
descriptions and required Python packages.
"""

from pathlib import Path

from drake_oa.common.files import installed_package, package_folder

_SUFFIX = ".scenario.yaml"
"""Suffix of the file names of shipped scenarios, after the scenario's name."""


def shipped_scenarios() -> dict[str, Path]:
    """Returns the scenario files that are part of this package, by scenario name."""
    folder = package_folder("drake_oa.diagrams")
    return {p.name.removesuffix(_SUFFIX): p for p in sorted(folder.glob(f"*{_SUFFIX}"))}


def description(path: Path) -> str:
    """Reads the text of the field `description` from a scenario file, without building the
    scenario.
    """
    return _text(path, "description")


def missing_package(path: Path) -> str:
    """Returns the name of the Python package that contains a scenario's robot model, if this
    package is not installed; otherwise "".

    The function reads the scenario file without building the scenario.
    """
    url = _text(path, "robot", "model")
    name = url.removeprefix("package://").partition("/")[0]
    if not url.startswith("package://") or name == "drake_oa" or installed_package(name):
        return ""
    return name


def _text(path: Path, *fields: str) -> str:
    """Reads the text of a nested field from a YAML file, without building the scenario; returns ""
    if the field is missing or not a scalar.

    Args:
        path: YAML file.
        fields: names of the field and its enclosing blocks, outermost block first.
    """
    # Not at the top, so that `drake-oa --help` starts faster: it reads no file.
    import yaml

    # Nodes are composed, not loaded, because YAML cannot construct the tagged blocks.
    node = yaml.compose(
        path.read_text("utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    )
    for field in fields:
        pairs = node.value if isinstance(node, yaml.MappingNode) else ()
        node = next((value for key, value in pairs if key.value == field), None)
    return node.value if isinstance(node, yaml.ScalarNode) else ""
