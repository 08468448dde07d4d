"""`drake-oa evaluate`: written results and scenes, and resumed evaluations."""

import json
import sys
from functools import partial
from pathlib import Path

import pytest

from drake_oa.perception.config import GroundTruth
from drake_oa.scenario.loading import load_scenario
from tests.builders import command

run = partial(command, "evaluate")


def test_results_of_several_kinds_are_written_and_resumed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    short = ("--scenes", "1", "--duration", "0.02", "--perception", "truth")
    chosen = ("--method", "nominal", "--suite", "tabletop", "--suite", "clutter6")
    again = partial(run, "panda", *short, *chosen, "--json", "p.json")
    assert again("--write-scenes", "scenes") == 0
    out = capsys.readouterr().out
    kinds = json.loads(Path("p.json").read_text())["kinds"]
    assert list(kinds) == ["tabletop", "clutter6"]
    for kind, metrics in kinds.items():
        assert f"{kind}: nominal, truth" in out
        assert metrics["methods"]["nominal"]["stopped"] == 1
    for scene in Path("scenes").iterdir():
        assert isinstance(load_scenario(str(scene)).perception, GroundTruth)
    assert len(list(Path("p.scenes").glob("*.json"))) == 4
    assert again() == 0
    assert "2 results read from p.scenes" in capsys.readouterr().out


def test_unknown_suites_give_an_error_that_lists_suites_and_subcommands(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run("pnda") == run("panda", "--suite", "maze") == 2
    points, panda = capsys.readouterr().err.splitlines()
    assert "unknown suite or subcommand 'pnda'; valid: novel," in points
    assert "panda, mbm, sources" in points
    assert "unknown suite 'maze'; valid: drp, tabletop," in panda


def test_level_and_cameras_select_scenes_of_drp() -> None:
    chosen = "--suite drp --level floating1 --method nominal --scenes 1 --cameras 2"
    assert run("panda", *chosen.split(), "--duration", "0.02", "--json", "p.json") == 0
    metrics = json.loads(Path("p.json").read_text())["methods"]["nominal"]
    assert metrics["drp_success"] == metrics["drp_contacts"] == 0


def test_without_ompl_the_error_names_the_package(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("ompl", "ompl.base"):
        monkeypatch.setitem(sys.modules, name, None)
    assert run("panda", "--method", "planner") == 2
    assert "pip install 'drake_oa[baselines]'" in capsys.readouterr().err
    assert list(Path().iterdir()) == []
