"""`drake-oa evaluate panda` on the command line."""

import json
import sys

import pytest

from drake_oa.app.main import main
from drake_oa.perception.config import GroundTruth
from drake_oa.scenario.loading import load_scenario

_SHORT = ["evaluate", "panda", "--scenes", "1", "--duration", "0.02", "--perception", "truth"]


def test_every_command_of_evaluate_has_a_summary(capsys):
    assert main(["evaluate", "--help"]) == 0
    commands = capsys.readouterr().out.split("Commands:\n")[1].split("\n\n")[0].splitlines()
    assert len(commands) > 5
    # Lines without an indent go on with a long summary.
    for line in commands:
        assert not line.startswith("  ") or line.partition(": ")[2].strip()


def test_help_lists_the_suite(capsys):
    assert main(["evaluate", "panda", "--help"]) == 0
    text = capsys.readouterr().out
    for word in (
        "panda",
        "--suite",
        "clutter6",
        "planner",
        "--perception",
        "--jobs",
        "--scheduler",
        "differential_ik",
    ):
        assert word in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["hit", "--perception", "truth"], "Unknown option: --perception"),
        (["novel", "--jobs", "2"], "Unknown option: --jobs"),
        (["novel", "--html-dir", "d"], "Unknown option: --html-dir"),
        (["panda", "--scenes-file", "f.npz"], "Unknown option: --scenes-file"),
        (["panda", "--plot", "f.png"], "Unknown option: --plot"),
        (["panda", "--method", "original"], "unknown method 'original'; panda has: preplanned"),
        (["panda", "--suite", "elbow,moving_hard", "--method", "planner"], "of moving_hard move"),
        (["panda", "--perception", "sonar"], 'Choose from: "depth", "truth"'),
        (["panda", "--cameras", "3"], "Choose from: 1, 2"),
        (["panda", "--cameras", "2", "--perception", "truth"], "--cameras 2 needs --perception"),
        (["hit", "--suite", "elbow"], "Unknown option: --suite"),
        (["panda", "--suite", "elbow,maze"], "unknown kind of scenes 'maze': it must be one of"),
        (["panda", "--suite", ""], "unknown kind of scenes ''"),
        (["panda", "--jobs", "0"], "--jobs must be at least 1"),
        (["panda", "--jobs", "2", "--scheduler", "tcp://x:1"], "exclude each other"),
        (["panda", "--scenes", "0"], "--scenes must be at least 1"),
        (["--seed", "1", "panda"], "the suite comes first: drake-oa evaluate panda"),
        (["pandas"], "unknown suite 'pandas'; valid: novel"),
    ],
)
def test_what_does_not_go_together_is_said(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["evaluate", *arguments]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_scenes_figures_and_pages_are_written_and_resumed(tmp_path, capsys):
    file, pages, scenes = tmp_path / "p.json", tmp_path / "pages", tmp_path / "scenes"
    command = [*_SHORT, "--method", "preplanned", "--json", str(file)]
    assert main([*command, "--html-dir", str(pages), "--write-scenes", str(scenes)]) == 0
    out = capsys.readouterr().out
    assert "preplanned: stopped, 1 scene: time limit of # s" in out
    figures = json.loads(file.read_text())
    looked_at = figures["drawn"]["scenes"]["looked_at"]
    assert f"tabletop: scenes looked at: {looked_at}; dropped: " in out
    assert (figures["suite"], figures["seed"], figures["perception"]) == ("panda", 0, "truth")
    method = figures["methods"]["preplanned"]
    assert (method["scenes"], method["stopped"], method["complete"]) == (1, 1, True)
    assert method["runs"][0]["scene"] == 0
    (page,) = pages.iterdir()
    assert page.stat().st_size > 100_000
    (scene,) = scenes.iterdir()
    assert isinstance(load_scenario(str(scene)).perception, GroundTruth)
    assert len(list((tmp_path / "p.scenes").glob("*.json"))) == 2
    assert main(command) == 0
    assert "1 runs were on disk" in capsys.readouterr().out


def test_several_kinds_share_a_table(tmp_path, capsys):
    file = tmp_path / "p.json"
    command = [*_SHORT, "--method", "preplanned", "--suite", "tabletop,clutter6"]
    assert main([*command, "--suite", "tabletop", "--json", str(file)]) == 0
    out = capsys.readouterr().out
    assert "tabletop: preplanned, truth" in out
    assert "clutter6: preplanned, truth" in out
    figures = json.loads(file.read_text())
    assert list(figures["kinds"]) == ["tabletop", "clutter6"]
    assert all(of["methods"]["preplanned"]["scenes"] == 1 for of in figures["kinds"].values())


def test_without_ompl_the_error_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    for name in ("ompl", "ompl.base"):
        monkeypatch.setitem(sys.modules, name, None)
    assert main(["evaluate", "panda", "--suite", "elbow"]) == 2
    assert "pip install 'drake_oa[peers]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
