"""`drake-oa replay` and `drake-oa plot`: a logged run, shown again and drawn."""

from __future__ import annotations

import math
from pathlib import Path

from drake_oa.app.scenarios import build_errors
from drake_oa.common.files import check_outputs, replace_file, same_file

FORMATS = (".png", ".svg", ".pdf")
"""What the name of a plot may end in."""

# Drake and matplotlib are imported where they are used: `--help` answers at once.


def replay(
    log: Path,
    /,
    *,
    meshcat: bool = False,
    html: Path | None = None,
    motion: str | None = None,
    speed: float = 1.0,
) -> None:
    """Show a logged run again.

    Shows a logged motion: the robot and the world as they were, the ellipsoids that
    were seen, the planned path and the one that was taken. Nothing is simulated. The log
    holds neither point clouds nor cost rings: those are shown by `drake-oa run` alone.

    For example:

        drake-oa replay drake_oa_runs/tabletop_box-20250131T120000Z.npz --meshcat
        drake-oa replay box.npz --html box.html --motion preplanned --speed 0.25

    Args:
        log: a log that `drake-oa run` wrote.
        meshcat: show it in a browser.
        html: write one page to play in a browser.
        motion: preplanned or modulated (default: the modulated one if it was started).
        speed: times as fast as it was.
    """
    if not (meshcat or html):
        raise ValueError("nothing to show it in: give --meshcat, --html FILE or both")
    if not 0.0 < speed < math.inf:
        raise ValueError(f"--speed: {speed} must be positive")
    if same_file(log, html):
        raise ValueError("--html must not name the log")
    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.replay import choose_motion, logged_scenario, planned_path

    logs = load_logs(log)
    chosen = choose_motion(log, logs, motion)
    shown = logs[chosen]
    scenario = logged_scenario(log, shown)
    check_outputs(html)

    from pydrake.systems.analysis import Simulator

    from drake_oa.runs.replay import build_replay
    from drake_oa.viewing.viewer import recording, start_viewer, wait_for_viewer

    viewer = start_viewer(announce=meshcat)
    with build_errors():
        planned_W = planned_path(scenario, logs)
        diagram = build_replay(scenario, shown, viewer, planned_W=planned_W, speed=speed)
    simulator = Simulator(diagram)
    if meshcat:
        simulator.set_target_realtime_rate(1.0)
    with recording(viewer, html):
        simulator.AdvanceTo(shown.simulated_time / speed)
    print(f"{chosen}: {shown.duration:.2f} s, ended by {shown.stop_reason}")
    if meshcat:
        wait_for_viewer()


def plot(log: Path, /, *, out: Path | None = None) -> None:
    """Draw a logged run.

    Draws clearance of tool and robot against the asked one, phase and share of full speed with
    the times in which the motion was slowed or held and why, joint torques against their limits,
    tracking error, and the path from above and from the side.

    For example:

        drake-oa plot drake_oa_runs/tabletop_box-20250131T120000Z.npz
        drake-oa plot box.npz --out box.pdf

    Args:
        log: a log that `drake-oa run` wrote.
        out: the picture, .png, .svg or .pdf (default: LOG with .png in place of .npz).
    """
    out = out or log.with_suffix(".png")
    if out.suffix not in FORMATS:
        raise ValueError(f"--out must end in {', '.join(FORMATS)}, not {out.name!r}")
    if same_file(log, out):
        raise ValueError("--out must not name the log")
    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.replay import choose_motion, logged_scenario

    logs = load_logs(log)
    chosen = choose_motion(log, logs, None)
    logs = {name: of for name, of in logs.items() if name == chosen or len(of.t)}
    scenario = logged_scenario(log, logs[chosen])
    check_outputs(out)

    from matplotlib.figure import Figure

    from drake_oa.runs.log_plots import draw_run
    from drake_oa.runs.report import judge_of, motion_metrics

    with build_errors():
        judge = judge_of(scenario)
        metrics = {name: motion_metrics(scenario, of, judge) for name, of in logs.items()}
    figure = Figure(figsize=(14.0, 10.0), layout="constrained")
    title = f"{log.stem}: {scenario.description}".removesuffix(": ")
    draw_run(figure, title, scenario, logs, metrics)
    kind = out.suffix.removeprefix(".")
    replace_file(out, lambda path: figure.savefig(path, format=kind, dpi=130))
    print(f"plot: {out}")
