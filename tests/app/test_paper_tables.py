"""`drake-oa evaluate table2`, `figure_familiar` and `figure_dead_zone`: tables and JSON."""

import json
from functools import partial
from pathlib import Path

import pytest

from tests.builders import command

run = partial(command, "evaluate")


def test_baselines_without_scenes_have_empty_cells(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("table2", "--scenes", "1") == 0
    lines = capsys.readouterr().out.splitlines()
    empty = next(line for line in lines if line.startswith("goal at 2 m"))
    assert empty.split()[4:6] == ["0", "-"]


@pytest.mark.parametrize("figure", ["figure_familiar", "figure_dead_zone"])
def test_metrics_of_figures_are_printed_and_written(
    figure: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "figure.json"
    assert run(figure, "--scenes", "9", "--json", str(out)) == 0
    printed = capsys.readouterr().out
    whole = json.loads(out.read_text())
    paper = whole["methods"]["paper"]
    if figure == "figure_familiar":
        assert len(paper["settings"]) == 12
        assert paper["collisions"] == 0
        assert "published: no collision" in printed
    else:
        assert whole["terms"][-1]["original_collisions"] == 1
        assert paper["collisions"] == 0
        assert whole["methods"]["original"]["collisions"] == 1
        assert "gamma = 10" in printed
