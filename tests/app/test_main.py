"""`drake-oa`: help, interruptions, output streams, and results of `run`."""

import io
import json
import logging
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from pydrake.systems.framework import Context

from drake_oa.app import main as cli
from drake_oa.app.run import Terminated
from drake_oa.runs import simulation
from drake_oa.runs.motion_log import load_logs
from drake_oa.scenario.shipped import shipped_scenarios
from tests.builders import command as run


@pytest.fixture(autouse=True)
def _restore_logging() -> None:
    """Restores the level of Drake's log, which commands set for their process."""
    drake = logging.getLogger("drake")
    level = drake.level
    yield
    drake.setLevel(level)


@pytest.mark.parametrize("command", [(), *((name,) for name in cli._COMMANDS)])
def test_help_explains_each_command(
    command: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*command, "--help") == 0
    text = capsys.readouterr().out
    assert "Usage: drake-oa" in text
    assert len(text.splitlines()) > 6
    if "Commands:\n" in text:
        summaries = text.split("Commands:\n")[1].split("\n\n")[0].splitlines()
        # Lines without an indent continue a long summary.
        assert all(line.partition(": ")[2].strip() for line in summaries if line[:2] == "  ")


def test_help_and_scenarios_import_no_large_package() -> None:
    source = (
        "import sys, drake_oa.app.main as cli\n"
        "for words in (['--help'], ['run', '--help'], ['scenarios']): cli.main(words)\n"
        "heavy = ('numpy', 'numba', 'pydrake', 'open3d', 'torch', 'matplotlib', 'scipy')\n"
        "print([name for name in heavy if name in sys.modules])"
    )
    command = [sys.executable, "-c", source]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ended.stdout.splitlines()[-1] == "[]"


class Terminal(io.StringIO):
    """Text stream that claims to be a terminal."""

    def isatty(self) -> bool:
        return True


def test_progress_is_printed_only_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("run", "free_space", "--duration", "0.2", "--no-log")
    assert run(*arguments) == 0
    assert "%" not in capsys.readouterr().err
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    assert run(*arguments) == 0
    for motion in ("nominal", "avoiding"):
        assert re.search(rf"{motion} .*\d%", screen.getvalue())
    assert "\x1b" not in capsys.readouterr().out


def test_set_replaces_fields_and_the_motion_reaches_the_goal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    shutil.copy(shipped_scenarios()["free_space"], "mine.scenario.yaml")
    arguments = ("run", "mine.scenario.yaml", "--json", "report.json", "--set", "seed=7")
    assert run(*arguments, "--set", "perception=!GivenEllipsoids {}") == 0
    report = json.loads(Path("report.json").read_text())
    assert (report["scenario"], report["seed"]) == ("mine", 7)
    assert report["avoiding"]["tool_clearance_min"] is None
    *_, ended = (line for line in capsys.readouterr().out.splitlines() if "termination" in line)
    assert ended.split() == ["termination", "goal", "goal"]


def test_motion_with_an_exception_is_reported_and_logged(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    original = simulation.simulate

    def look(_: object, root: Context) -> None:
        if root.get_time() > 0.1:
            raise RuntimeError("boom")

    def simulate(scenario: object, *, avoid_obstacles: bool, **options: object) -> object:
        options |= {"on_step": look} if avoid_obstacles else {}
        return original(scenario, avoid_obstacles=avoid_obstacles, **options)

    monkeypatch.setattr(simulation, "simulate", simulate)
    arguments = ("--duration", "0.2", "--json", "report.json", "--log", "run.npz")
    assert run("run", "free_space", *arguments) == 1
    assert "interrupted" in capsys.readouterr().err.splitlines()[-1]
    report = json.loads(Path("report.json").read_text())
    assert report["avoiding"]["stop_reason"] == "RuntimeError: boom"
    logs = load_logs(Path("run.npz"))
    assert list(logs) == ["nominal", "avoiding"]
    assert logs["avoiding"].duration == pytest.approx(0.1, abs=0.02)


def test_ctrl_c_in_a_command_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupt() -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            # Compiled modules raise this error.
            raise SystemError("returned a result with an exception set") from error

    def terminate() -> None:
        raise Terminated

    cases = (interrupt, 130, "interrupted"), (terminate, 143, "terminated")
    for function, status, reason in cases:
        monkeypatch.setattr("drake_oa.app.scenarios.shipped_scenarios", function)
        assert run("scenarios") == status
        assert capsys.readouterr().err == f"drake-oa: error: {reason}\n"


def test_ctrl_c_while_modules_are_imported_is_one_line() -> None:
    source = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Interrupt:\n"
        "    def find_spec(name, *_):\n"
        "        if name == 'pydrake.common.yaml': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupt)\n"
        "from drake_oa.app.main import main\n"
        "sys.exit(main(['graph', 'free_space', '--dot']))"
    )
    command = [sys.executable, "-c", source]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (130, "drake-oa: error: interrupted\n")


def test_a_closed_pipe_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "drake_oa.app.main", "scenarios"]
    ended = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    assert (ended.returncode, ended.stderr) == (1, "")
