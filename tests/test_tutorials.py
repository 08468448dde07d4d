"""Every tutorial runs from its first cell to its last, and shows something."""

from pathlib import Path

import pytest

jupytext = pytest.importorskip("jupytext")
nbclient = pytest.importorskip("nbclient")
pytest.importorskip("ipykernel")

DOCS = Path(__file__).resolve().parents[1] / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
FAST = {"one_system"}
"""Those run by `make test`; `make docs` runs all."""


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[] if path.stem in FAST else [pytest.mark.slow])
        for path in TUTORIALS
    ],
)
def test_tutorial_runs_and_draws(path: Path, tmp_path: Path) -> None:
    if path.stem == "train_a_network":
        pytest.importorskip("torch")
    notebook = jupytext.read(path)
    resources = {"metadata": {"path": str(tmp_path)}}
    nbclient.NotebookClient(notebook, timeout=900, resources=resources).execute()
    shown = [o for cell in notebook.cells for o in cell.get("outputs", ())]
    assert any("image/png" in output.get("data", ()) for output in shown)


def test_every_tutorial_is_on_the_first_page() -> None:
    index = (DOCS / "index.md").read_text()
    assert [path.stem for path in TUTORIALS if f"tutorials/{path.stem}\n" not in index] == []
