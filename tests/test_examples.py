"""Each example runs, and is short."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))
LONG = ("03_swap_perception", "04_own_cost_ring", "06_put_a_system_between")
ARGUMENTS = {name: {"duration": 0.05} for name in LONG}
"""Arguments of the examples that simulate a long motion."""


def load(path: Path) -> ModuleType:
    """Imports the module of an example."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load(path).main(**ARGUMENTS.get(path.stem, {}))
    assert capsys.readouterr().out.strip()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_is_at_most_60_lines_with_a_docstring(path: Path) -> None:
    text = path.read_text()
    assert len(text.splitlines()) <= 60
    assert text.startswith('"""')
