"""The command `drake-oa plot`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from drake_oa.app.command_line import add_verbose, build_errors
from drake_oa.common.files import check_outputs, replace_file, same_file

FORMATS = (".png", ".svg", ".pdf")
"""What the picture's name may end in."""

_DESCRIPTION = """\
Draws a logged run: clearance of tool and robot against the asked one, phase and share of
full speed with the times in which the motion was slowed or held and why, joint torques
against their limits, tracking error, and the path from above and from the side.
"""

_EXAMPLES = """\
examples:
  drake-oa plot drake_oa_runs/tabletop_box-20250131T120000Z.npz
  drake-oa plot box.npz --out box.pdf
"""


def add_parser(commands: Any) -> None:
    """Adds the subcommand to those of `drake-oa`."""
    parser = commands.add_parser(
        "plot",
        help="draw a logged run",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("log", type=Path, metavar="LOG", help="a log that `drake-oa run` wrote")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help=f"the picture, {', '.join(FORMATS)} (default: LOG with .png in place of .npz)",
    )
    add_verbose(parser)
    parser.set_defaults(action=_plot)


def _plot(options: argparse.Namespace) -> int:
    out: Path = options.out or options.log.with_suffix(".png")
    if out.suffix not in FORMATS:
        raise ValueError(f"--out must end in {', '.join(FORMATS)}, not {out.name!r}")
    if same_file(options.log, out):
        raise ValueError("--out must not name the log")
    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.replay import choose_motion, logged_scenario

    logs = load_logs(options.log)
    name = choose_motion(options.log, logs, None)
    logs = {motion: log for motion, log in logs.items() if motion == name or len(log.t)}
    scenario = logged_scenario(options.log, logs[name])
    check_outputs(out)

    # matplotlib and the station are imported where they are used: `--help` answers at once.
    from matplotlib.figure import Figure

    from drake_oa.runs.log_plots import draw_run
    from drake_oa.runs.report import motion_metrics

    with build_errors():
        metrics = {motion: motion_metrics(scenario, log) for motion, log in logs.items()}
    figure = Figure(figsize=(14.0, 10.0), layout="constrained")
    title = f"{options.log.stem}: {scenario.description}".removesuffix(": ")
    draw_run(figure, title, scenario, logs, metrics)
    kind = out.suffix.removeprefix(".")
    replace_file(out, lambda path: figure.savefig(path, format=kind, dpi=130))
    print(f"plot: {out}")
    return 0
