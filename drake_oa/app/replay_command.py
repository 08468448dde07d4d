"""The command `drake-oa replay`."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from drake_oa.app.command_line import add_verbose, build_errors
from drake_oa.common.files import check_outputs, same_file

_DESCRIPTION = """\
Shows a logged motion again: the robot and the world as they were, the ellipsoids that
were seen, the planned path and the one that was taken. Nothing is simulated. The log
holds neither point clouds nor cost rings: those are shown by `drake-oa run` alone.
"""

_EXAMPLES = """\
examples:
  drake-oa replay drake_oa_runs/tabletop_box-20250131T120000Z.npz --meshcat
  drake-oa replay box.npz --html box.html --motion preplanned --speed 0.25
"""


def add_parser(commands: Any) -> None:
    """Adds the subcommand to those of `drake-oa`."""
    parser = commands.add_parser(
        "replay",
        help="show a logged run again",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("log", type=Path, metavar="LOG", help="a log that `drake-oa run` wrote")
    parser.add_argument("--meshcat", action="store_true", help="show it in a browser")
    parser.add_argument(
        "--html", type=Path, metavar="FILE", help="write one page to play in a browser"
    )
    parser.add_argument(
        "--motion",
        metavar="NAME",
        help="preplanned or modulated (default: the modulated one if it was started)",
    )
    parser.add_argument(
        "--speed", type=float, default=1.0, metavar="X", help="times as fast as it was (default 1)"
    )
    add_verbose(parser)
    parser.set_defaults(action=_replay)


def _replay(options: argparse.Namespace) -> int:
    if not (options.meshcat or options.html):
        raise ValueError("nothing to show it in: give --meshcat, --html FILE or both")
    if not 0.0 < options.speed < math.inf:
        raise ValueError(f"--speed: {options.speed} must be positive")
    if same_file(options.log, options.html):
        raise ValueError("--html must not name the log")
    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.replay import choose_motion, logged_scenario, planned_path

    logs = load_logs(options.log)
    motion = choose_motion(options.log, logs, options.motion)
    log = logs[motion]
    scenario = logged_scenario(options.log, log)
    check_outputs(options.html)

    from pydrake.systems.analysis import Simulator

    from drake_oa.runs.replay_diagram import build_replay
    from drake_oa.viewing.viewer import recording, start_viewer, wait_for_viewer

    meshcat = start_viewer(announce=options.meshcat)
    with build_errors():
        diagram = build_replay(
            scenario,
            log,
            meshcat,
            planned_W=planned_path(scenario, logs),
            speed=options.speed,
        )
    simulator = Simulator(diagram)
    if options.meshcat:
        simulator.set_target_realtime_rate(1.0)
    with recording(meshcat, options.html):
        simulator.AdvanceTo(log.simulated_time / options.speed)
    print(f"{motion}: {log.duration:.2f} s, ended by {log.stop_reason}")
    if options.meshcat:
        wait_for_viewer()
    return 0
