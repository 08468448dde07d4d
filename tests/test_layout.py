"""Checks of the folder structure; import-linter checks import directions in `make lint`."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = sorted(
    path.parent.relative_to(ROOT)
    for tree in ("drake_oa", "diagrams")
    for path in (ROOT / tree).rglob("__init__.py")
)
README_LINES = 10
"""Minimum number of lines of a package overview."""


@pytest.mark.parametrize("folder", FOLDERS, ids=str)
def test_each_package_has_an_overview(folder: Path) -> None:
    init = (ROOT / folder / "__init__.py").read_text()
    docstring = ast.get_docstring(ast.parse(init)) or ""
    if folder != Path("drake_oa"):
        assert len(docstring.splitlines()) >= README_LINES
        assert "import" not in init.replace(docstring, "")


def test_tests_mirror_the_tree() -> None:
    """Each folder of tests has the name of a folder of the package."""
    for path in (ROOT / "tests").rglob("test_*.py"):
        folder = path.parent.relative_to(ROOT / "tests")
        assert Path("drake_oa") / folder in FOLDERS or str(folder) in ("diagrams", "regression")
