"""Options, exit statuses and JSON keys of all commands, compared with a stored snapshot.

After an intended change, write the snapshot again, and review the difference:

    python -m tests.app.test_commands
"""

import contextlib
import io
import json
import os
import shlex
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cyclopts import App

from drake_oa.app.main import _app
from tests.builders import command
from tests.reference.depth_images import K, box, camera_pose, ray_cast

SNAPSHOT = Path(__file__).with_name("commands.json")

INSIDE = "perception=!GivenEllipsoids {ellipsoids: [{center: [0, 0, 0]}]}"
DIRECTIVE = "directives=[{add_model: {name: a, file: b.sdf}}]"
PANDA = "evaluate panda --scenes 1 --duration 0.02 --perception truth --method nominal"

# They run in this order in one folder: later invocations read files that earlier ones have written.
INVOCATIONS = (
    "",
    "rnu free_space",
    "--version",
    "scenarios",
    "scenarios --files",
    "new mine --like cage",
    "new mine",
    "new 'a b'",
    "check mine.scenario.yaml",
    "check tabletop_box --set task.sed=1 --set sed=1",
    "check blocked.yaml",
    "check nowhere",
    "graph free_space --signals",
    "graph free_space --dot",
    "graph nowhere",
    "run",
    "run nowhere",
    "run frame.npz",
    "run free_space more",
    "run free_space --jsno x",
    "run free_space --duration -1",
    "run free_space --duration nan",
    "run free_space --duration long",
    "run free_space --log x.npz --no-log",
    "run free_space --log x --json x",
    "run free_space --log .",
    "run mine.scenario.yaml --html mine.scenario.yaml",
    "run free_space --set task.clearence=1",
    "run free_space --set inference.weights=none.npz",
    "run tabletop_box --set robot.model=package://none/x.urdf",
    f"run tabletop_box --set '{DIRECTIVE}'",
    "run tabletop_box --set 'perception=!RecordedClouds {folder: /nowhere}'",
    "run blocked.yaml",
    "play blocked.yaml",
    "run free_space --rate 0.5",
    f"run free_space --set '{INSIDE}' --no-log",
    "run free_space --duration 0.1 --json run.json --log point.npz",
    "run tabletop_box --set 'perception=!GroundTruth {}' --duration 0.1"
    " --json box.json --log box.npz --html box.html",
    "play tabletop_box --log x.npz --no-log",
    "replay point.npz --html replay.html --motion nominal",
    "replay point.npz",
    "replay point.npz --html x.html --speed 0",
    "replay point.npz --html x.html --motion nothing",
    "replay point.npz --html point.npz",
    "replay none.npz --html x.html",
    "plot box.npz",
    "plot point.npz --out point.svg",
    "plot point.npz --out x.txt",
    "perceive frame.npz --tool none --json perceive.json",
    "perceive none.npz --tool none --json none.json",
    "perceive frame.npz --tool hammer",
    "perceive frame.npz --tool none --intrinsics 0 1 1 1",
    "benchmark --scenario free_space --seconds 0.05 --json benchmark.json",
    "benchmark --scenario nowhere",
    "benchmark --json .",
    "evaluate novel --scenes 4 --method original --json novel.json",
    "evaluate nowhere",
    "evaluate --seed 1 panda",
    "evaluate novel --perception truth",
    "evaluate novel --method nobody",
    "evaluate novel --scenes 0",
    "evaluate table1 --json table1.json",
    "evaluate table2 --scenes 0",
    "evaluate figure_familiar --scenes 5",
    "evaluate figure_familiar --chain running",
    f"{PANDA} --json panda.json --write-scenes scenes",
    f"{PANDA} --jobs 0",
    f"{PANDA} --jobs 2 --scheduler tcp://x:1",
    f"{PANDA} --cameras 2",
    f"{PANDA} --suite maze",
    "station tabletop_box --lcm-url foo://bar",
    "train --recipe mine",
)

BLOCKED = """
obstacles: [{name: a, shapes: [!Sphere {radius: 0.1}], translation: [0.45, -0.45, 0.3]}]
"""
"""Scenario with an obstacle at the start."""

DATA = ("versions", "dropped", "sources")
"""JSON keys whose values are dictionaries with data as keys."""


def options(app: App, root: App) -> dict[str, Any]:
    """Returns the options of all commands of an app in the root app, with their defaults."""
    options_of: dict[str, Any] = {}
    for name in app:
        if name.startswith("-"):
            continue
        part = app[name]
        arguments = part.assemble_argument_collection(default_parameter=root.default_parameter)
        options_of[name] = {
            " ".join(each.names): "required" if each.required else str(each.field_info.default)
            for each in arguments
            if "*" not in each.names
        }
        options_of |= {f"{name} {sub}": value for sub, value in options(part, root).items()}
    return options_of


def keys(value: Any) -> Any:
    """Returns the nested keys of a JSON value; for a list, the union of those of its items."""
    if isinstance(value, list):
        merged: dict[str, Any] = {}
        for item in map(keys, value):
            merged |= item or {}
        return merged or None
    if not isinstance(value, dict):
        return None
    return {key: None if key in DATA else keys(value[key]) for key in sorted(value)}


def observed() -> dict[str, Any]:
    """Runs all invocations in the current folder.

    Returns:
        "commands": options of all commands; "invocations": exit status, number of error messages
        and keys of the written JSON of each invocation; "files": all written files.
    """
    depth = ray_cast(camera_pose(), [box(0.8, -0.15)], (-90.0, 0.0, 99.0, 99.0))
    np.savez("frame.npz", depth=depth.astype(np.float32), K=K)
    Path("blocked.yaml").write_text(BLOCKED)
    app, results = _app(), {}
    for line in INVOCATIONS:
        words, messages = shlex.split(line), io.StringIO()
        with contextlib.redirect_stderr(messages):
            result: dict[str, Any] = {"status": command(*words)}
        result["errors"] = messages.getvalue().count("drake-oa: error: ")
        written = Path(words[words.index("--json") + 1] if "--json" in words else "")
        if written.is_file():
            result["keys"] = keys(json.loads(written.read_text()))
        results[line] = result
    files = sorted(str(path) for path in Path().rglob("*") if path.is_file())
    return {"commands": options(app, app), "invocations": results, "files": files}


def test_commands_and_results_are_those_of_the_snapshot() -> None:
    assert observed() == json.loads(SNAPSHOT.read_text())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        SNAPSHOT.write_text(json.dumps(observed(), indent=1) + "\n")


def test_graph_draws_every_camera(capsys: pytest.CaptureFixture[str]) -> None:
    assert command("graph", "two_cameras") == 0
    drawn = capsys.readouterr().out
    assert all(f">{name}<" in drawn for name in ("delayed_left", "delayed_right", "perception"))
