"""What comes with the package: files of scenarios and models, and what scenarios say they are."""

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


def package_file(url_or_file: str) -> Path:
    """The file behind a `package://drake_oa/...` URL, or the path itself."""
    prefix = "package://drake_oa/"
    if url_or_file.startswith(prefix):
        return Path(str(resources.files("drake_oa.models"))) / url_or_file.removeprefix(prefix)
    return Path(url_or_file)
