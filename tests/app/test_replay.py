"""Logs of `drake-oa run`, and their replay and plot."""

import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from drake_oa.runs.motion_log import load_logs, save_logs
from tests.builders import command as run

BOX = ("tabletop_box", "--set", "perception=!GroundTruth {}", "--duration", "0.25")


@pytest.fixture(scope="module")
def box_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log of a robot among obstacles, until its time limit of 0.25 s."""
    file = tmp_path_factory.mktemp("logs") / "box.npz"
    assert run("run", *BOX, "--log", file) == 0
    return file


def test_each_run_writes_a_new_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(2):
        assert run("run", "free_space", "--duration", "0.1", "--set", "seed=5") == 0
    first, second = sorted((tmp_path / "drake_oa_runs").iterdir(), key=os.path.getmtime)
    for file in (first, second):
        assert re.fullmatch(r"free_space-\d{8}T\d{6}\.\d+Z\.npz", file.name)
    assert capsys.readouterr().err.splitlines()[-1] == f"log: drake_oa_runs/{second.name}"
    for log in load_logs(first).values():
        assert log.seed == 5
        assert "seed: 5" in log.scenario
        assert any(item.startswith("drake_oa ") for item in log.versions)
    assert run("run", "free_space", "--set", "inference.weights=none.npz") == 2
    assert len(list((tmp_path / "drake_oa_runs").iterdir())) == 2
    shutil.rmtree("drake_oa_runs")
    Path("drake_oa_runs").write_text("in the way")
    assert run("run", "free_space", "--duration", "0.1") == 2
    assert "cannot write to the folder drake_oa_runs" in capsys.readouterr().err


@pytest.mark.parametrize("option", ["--log", "--html"])
def test_full_disk_of_one_output_does_not_affect_the_others(
    option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ("--duration", "0.05", "--json", "run.json", option, "/dev/full")
    assert run("run", "free_space", *arguments) == 1
    printed = capsys.readouterr()
    assert "avoiding" in printed.out
    assert "cannot write /dev/full: No space left on device" in printed.err
    assert Path("run.json").is_file()


@pytest.mark.parametrize(
    ("number", "status", "reason"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")],
)
def test_stopped_run_logs_the_motion_in_progress(
    number: signal.Signals, status: int, reason: str, tmp_path: Path
) -> None:
    # The start is inside the obstacle, so the second motion is held without an end.
    script = (
        "import signal, sys, drake_oa.app.main as cli, drake_oa.runs.simulation as simulation\n"
        # In background jobs of a shell, SIGINT is ignored by default.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "whole = simulation.simulate\n"
        "def simulate(scenario, on_step, **options):\n"
        "    def step(monitor, root):\n"
        "        on_step(monitor, root)\n"
        "        if options['avoid_obstacles'] and 0.1 < root.get_time() < 0.11:\n"
        "            print('simulating', flush=True)\n"
        "    if options['avoid_obstacles']:\n"
        "        options['duration'] = 1e4\n"
        "    return whole(scenario, on_step=step, **options)\n"
        "simulation.simulate, simulation.MAX_HOLD_TIME = simulate, 1e4\n"
        "sys.exit(cli.main(['run', 'free_space', '--duration', '0.3', *sys.argv[1:]]))\n"
    )
    inside = "perception=!GivenEllipsoids {ellipsoids: [{center: [0, 0, 0]}]}"
    process = subprocess.Popen(
        [sys.executable, "-c", script, "--set", inside],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "simulating\n"
        process.send_signal(number)
        _, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == status, errors
    # The line about compiled kernels may follow.
    assert f"drake-oa: error: {reason}" in errors.splitlines()
    (file,) = (tmp_path / "drake_oa_runs").iterdir()
    logs = load_logs(file)
    assert list(logs) == ["nominal", "avoiding"]
    assert logs["avoiding"].duration > 0.0
    assert logs["avoiding"].stop_reason == reason


def test_replay_writes_identical_pages(box_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pages = [Path(name) for name in ("a.html", "b.html")]
    for page in pages:
        assert run("replay", box_log, "--html", page) == 0
        assert capsys.readouterr().out == "avoiding: 0.25 s, terminated by time limit of 0.25 s\n"
    assert "set_animation" in pages[0].read_text()
    assert pages[0].read_bytes() == pages[1].read_bytes()


@pytest.mark.parametrize("command", ["replay", "plot"])
@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("cut off", "is not a motion log, or is damaged"),
        ("other model", "robot.model: 'package://none/x.urdf'"),
    ],
)
def test_unusable_log_is_reported_in_one_line(
    command: str, kind: str, message: str, box_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = Path("log.npz")
    log = load_logs(box_log)["avoiding"]
    if kind == "cut off":
        file.write_bytes(box_log.read_bytes()[:3000])
    else:
        text = "{robot: {model: package://none/x.urdf}, perception: !GivenEllipsoids {}}"
        save_logs(file, {"avoiding": replace(log, scenario=text)})
    capsys.readouterr()
    out = ["--html", "x.html"] if command == "replay" else ["--out", "x.png"]
    assert run(command, file, *out) == 2
    errors = capsys.readouterr().err
    assert message in errors
    assert len(errors.splitlines()) == 1
    assert not Path(out[1]).exists()
