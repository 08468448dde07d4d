"""Each example runs, and is short."""

from pathlib import Path

import pytest

from tests.builders import load_module

EXAMPLES = sorted((Path(__file__).resolve().parents[1] / "examples").glob("*.py"))
LONG = ("03_swap_perception", "04_own_cost_ring", "06_put_a_system_between")
"""Examples that simulate a long motion."""


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs_and_is_short(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load_module(path).main(**({"duration": 0.05} if path.stem in LONG else {}))
    assert capsys.readouterr().out.strip()
    assert len(path.read_text().splitlines()) <= 60
