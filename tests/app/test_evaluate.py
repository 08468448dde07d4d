"""`drake-oa evaluate`: what it prints, writes, refuses and returns."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from drake_oa.studies.scenes import methods
from drake_oa.studies.scenes.scenes import Motions, Scenes, Setting
from drake_oa.studies.scenes.suites import SUITES
from tests.builders import command

Method = Callable[[Scenes, Setting], Motions]
run = partial(command, "evaluate")


@pytest.fixture(autouse=True)
def _simple_methods(monkeypatch: pytest.MonkeyPatch, straight: Method) -> None:
    """The default methods, and one that fails and one that is interrupted."""

    def fail(scenes: Scenes, setting: Setting) -> Motions:
        raise RuntimeError("it is\nbroken")

    def interrupt(scenes: Scenes, setting: Setting) -> Motions:
        raise KeyboardInterrupt

    for name in ("paper", "verified", "original"):
        monkeypatch.setitem(methods.METHODS, name, straight)
    monkeypatch.setitem(methods.METHODS, "failing", fail)
    monkeypatch.setitem(methods.METHODS, "interrupted", interrupt)


@pytest.mark.parametrize("suite", SUITES)
def test_every_suite_is_evaluated(
    suite: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "out.json"
    assert run(suite, "--scenes", "9", "--json", str(out)) == 0
    result = json.loads(out.read_text())
    assert set(result) == {"suite", "seed", "versions", "methods"}
    assert (result["suite"], result["seed"]) == (suite, 0)
    assert {"drake_oa", "numpy"} < set(result["versions"])
    assert list(result["methods"]) == list(SUITES[suite].methods)
    assert all(figures["complete"] for figures in result["methods"].values())
    printed = capsys.readouterr()
    assert f"{suite}: 9 scenes" in printed.out
    assert "%" not in printed.err  # No progress bar when piped.
    assert [p.name for p in out.parent.iterdir()] == ["out.json"]


def test_histograms_are_drawn(tmp_path: Path) -> None:
    plot = tmp_path / "new" / "plot.png"
    chosen = ("--method", "paper", "--scenes", "9")
    assert run("novel", *chosen, "--plot", str(plot)) == 0
    assert plot.read_bytes().startswith(b"\x89PNG")
    assert plot.stat().st_size > 10_000


def test_help_lists_suites_and_methods(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--help") == 0
    shown = capsys.readouterr().out
    for name in (*SUITES, "paper", "verified", "original", "movement_primitives"):
        assert f"\n  {name} " in shown
    assert all(f"\n  {name}: " in shown for name in ("panda", "mbm"))


def test_methods_share_the_scenes_of_a_seed(tmp_path: Path) -> None:
    found = []
    for seed in ("1", "1", "2"):
        out = tmp_path / "out.json"
        assert run("hit", "--scenes", "8", "--seed", seed, "--json", str(out)) == 0
        figures = json.loads(out.read_text())["methods"]
        assert figures["paper"]["clearance_mean"] == figures["verified"]["clearance_mean"]
        found.append(figures["paper"]["clearance_mean"])
    assert found[0] == found[1] != found[2]


def test_scenes_written_are_the_scenes_run(tmp_path: Path) -> None:
    scenes, first, second = (tmp_path / name for name in ("s.npz", "a.json", "b.json"))
    one = ("clutter", "--method", "paper")
    written = ("--scenes", "6", "--write-scenes", str(scenes))
    assert run(*one, *written, "--json", str(first)) == 0
    assert run(*one, "--scenes-file", str(scenes), "--json", str(second)) == 0
    a, b = (json.loads(path.read_text()) for path in (first, second))
    assert b["seed"] is None
    assert a["methods"]["paper"]["clearance_mean"] == b["methods"]["paper"]["clearance_mean"]
    assert (
        command(
            "evaluate", *one, "--scenes-file", str(scenes), "--scenes", "2", "--json", str(second)
        )
        == 0
    )
    assert json.loads(second.read_text())["methods"]["paper"]["scenes"] == 2


@pytest.mark.parametrize(("suite", "last"), [("failing", 1), ("interrupted", 130)])
def test_what_was_computed_is_kept(
    suite: str, last: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out.json"
    chosen = ("--method", "paper", "--method", suite, "--scenes", "8")
    assert run("hit", *chosen, "--json", str(out)) == last
    figures = json.loads(out.read_text())["methods"]
    assert figures["paper"]["complete"] is True
    assert figures["paper"]["scenes"] == 8
    assert figures[suite]["complete"] is False
    printed = capsys.readouterr()
    assert "(not complete)" in printed.out
    errors = [line for line in printed.err.splitlines() if "error" in line]
    assert len(errors) == 1
    assert suite in errors[0]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("nowhere",), "unknown suite 'nowhere'; valid: novel, posed, hit"),
        (("novel", "--method", "nobody"), "unknown method 'nobody'; valid: paper, verified"),
        (("novel", "--scenes", "0"), "--scenes must be at least 1"),
        (("novel", "--scenes", str(10**15)), "GB of memory"),
        (("novel", "--seed", "-3"), "seed must be at least 0"),
        (("familiar",), "familiar is a figure of the paper: drake-oa evaluate figure_familiar"),
        (("dead-zone",), "drake-oa evaluate figure_dead_zone"),
        (("novel", "--plot", "p.gif"), "--plot must end in .pdf, .png, .svg"),
        (("novel", "--json", "a", "--write-scenes", "a"), "must name different files"),
        (("novel", "--json", "/proc/no/where.json"), "cannot write"),
        (("novel", "--scenes-file", "absent.npz"), "absent.npz"),
    ],
)
def test_bad_input_is_refused_at_once(
    arguments: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*arguments) == 2
    message = capsys.readouterr().err.splitlines()
    assert len(message) == 1
    assert named in message[0]


def test_more_scenes_than_the_file_has_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "s.npz")
    assert run("hit", "--scenes", "2", "--write-scenes", path, "--method", "paper") == 0
    assert run("hit", "--scenes", "3", "--scenes-file", path) == 2
    assert "holds 2" in capsys.readouterr().err


def test_a_fault_in_the_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "s.npz"
    assert (
        command(
            "evaluate", "hit", "--scenes", "2", "--write-scenes", str(path), "--method", "paper"
        )
        == 0
    )
    with np.load(path) as file:
        arrays = dict(file)
    arrays["semi_axes"][1, 0, 2] = -0.1
    np.savez(path, **arrays)
    assert run("hit", "--scenes-file", str(path)) == 2
    assert "semi_axes of scene 1, obstacle 0 must be positive" in capsys.readouterr().err
