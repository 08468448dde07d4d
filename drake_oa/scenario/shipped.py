"""The scenarios that come with the package: their files, and what they say they are."""

from importlib import resources
from pathlib import Path

import yaml

_SUFFIX = ".scenario.yaml"


def shipped_scenarios() -> dict[str, Path]:
    """Name -> file of the scenarios that come with the package."""
    folder = Path(str(resources.files("drake_oa.diagrams")))
    return {p.name.removesuffix(_SUFFIX): p for p in sorted(folder.glob(f"*{_SUFFIX}"))}


def description(path: Path) -> str:
    """A scenario file's field `description`, read without building the scenario."""
    # Nodes, as the tags of blocks mean nothing to YAML itself.
    root = yaml.compose(
        path.read_text("utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    )
    fields = root.value if isinstance(root, yaml.MappingNode) else ()
    return next((value.value for key, value in fields if key.value == "description"), "")
