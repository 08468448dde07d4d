"""`drake-oa evaluate kept`, and what it reads of a folder."""

import json
from pathlib import Path

import pytest

from drake_oa.app.main import main
from drake_oa.studies.kept import Kept, draw_kept, read_kept


def written(folder: Path, name: str, feasible: float | None, kept: float, *contacts: str) -> None:
    folder.mkdir(exist_ok=True)
    run = {"feasible_clearance": feasible, "tool_clearance_min": kept, "contacts": contacts}
    (folder / name).write_text(json.dumps({"key": "", "content": run}))


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    one, other = tmp_path / "before", tmp_path / "after"
    written(one, "tabletop-seed7-scene0000-verified-depth.json", 0.15, 0.26)
    written(one, "tabletop-seed7-scene0000-planner-truth.json", 0.15, 0.01)
    (one / "tabletop-seed7-scene0000.json").write_text("{}")
    written(other, "tabletop-seed7-scene0000-verified-depth.json", 0.15, 0.152)
    written(other, "moving_hard-seed7-scene0003-verified-depth.json", 0.1, -0.001, "a - b")
    written(other, "moving_hard-seed7-scene0004-verified-depth.json", None, 0.2)
    written(other, "mbm-table_pick-scene0012-verified-truth.json", 0.03, 0.03)
    return one, other


def test_runs_are_read_by_suite_and_method(folders: tuple[Path, Path]) -> None:
    one, other = folders
    assert read_kept(one, "verified") == [Kept("tabletop", 0.15, 0.26, False)]
    assert read_kept(one, "planner") == [Kept("tabletop", 0.15, 0.01, False)]
    assert read_kept(other, "verified") == [
        Kept("mbm", 0.03, 0.03, False),
        Kept("moving_hard", 0.1, -0.001, True),
        Kept("tabletop", 0.15, 0.152, False),
    ]


def test_each_suite_has_a_panel_and_each_folder_a_colour(folders: tuple[Path, Path]) -> None:
    figure = draw_kept({folder.name: read_kept(folder, "verified") for folder in folders})
    panels = {axis.get_title(): axis for axis in figure.axes if axis.get_visible()}
    assert set(panels) == {"tabletop", "mbm", "moving_hard"}
    legend = [text.get_text() for text in panels["tabletop"].get_legend().get_texts()]
    assert legend == ["before: 1", "after: 1"]
    (touched,) = panels["moving_hard"].get_legend().get_texts()
    assert touched.get_text() == "after, touched: 1"


def test_the_command_writes_a_picture(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plot = tmp_path / "kept.png"
    assert main(["evaluate", "kept", *map(str, folders), "--plot", str(plot)]) == 0
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert str(plot) in capsys.readouterr().out


def test_bad_input_is_told(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one, other = map(str, folders)
    plot = str(tmp_path / "kept.png")
    for arguments, told in (
        ([one, "--plot", "kept.txt"], "--plot must end in .pdf, .png, .svg"),
        ([str(tmp_path / "none"), "--plot", plot], "is no folder of results"),
        ([other, "--method", "paper", "--plot", plot], "no results of 'paper'"),
        ([one, one, "--plot", plot], "names of their own"),
        ([one] * 5 + ["--plot", plot], "one to four folders"),
    ):
        assert main(["evaluate", "kept", *arguments]) == 2
        assert told in capsys.readouterr().err
    (folders[0] / "tabletop-seed7-scene0009-verified-depth.json").write_text("{}")
    assert main(["evaluate", "kept", one, "--plot", plot]) == 2
    assert "is no result of an evaluation" in capsys.readouterr().err
