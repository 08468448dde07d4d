"""`drake-oa replay` and `drake-oa plot`: a logged run, shown again and drawn."""

from __future__ import annotations

from pathlib import Path

from drake_oa.app.scenarios import Positive, build_errors
from drake_oa.common.files import check_outputs, replace_text

# Drake and matplotlib are imported where they are used: `--help` answers at once.


def replay(
    log: Path,
    /,
    *,
    meshcat: bool = False,
    html: Path | None = None,
    motion: str | None = None,
    speed: Positive = 1.0,
) -> None:
    """Show a logged run again.

    Shows a logged motion: the robot and the world as they were, the ellipsoids that
    were seen, the planned path and the one that was taken. Nothing is simulated. The log
    holds neither point clouds nor cost rings: those are shown by `drake-oa run` alone.

    For example:

        drake-oa replay drake_oa_runs/tabletop_box-20250131T120000Z.npz --meshcat
        drake-oa replay box.npz --meshcat --motion nominal --speed 0.25
        drake-oa replay box.npz --html box.html

    Args:
        log: a log that `drake-oa run` wrote.
        meshcat: show it in a browser.
        html: write one page to play in a browser.
        motion: nominal or modulated (default: the avoiding one if it was started).
        speed: with --meshcat, simulated seconds in one of the wall clock.
    """
    if not (meshcat or html):
        raise ValueError("nothing to show it in: give --meshcat, --html FILE or both")
    from pydrake.systems.analysis import Simulator

    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.page import label_page, motion_name, readings
    from drake_oa.runs.replay import (
        build_replay,
        choose_motion,
        logged_scenario,
        planned_path,
        show_readings,
    )
    from drake_oa.viewing.viewer import open_page, recording, start_viewer, wait_for_viewer

    logs = load_logs(log)
    chosen = choose_motion(log, logs, motion)
    shown = logs[chosen]
    scenario = logged_scenario(log, shown)
    check_outputs(html, read=[log])
    viewer = start_viewer(browser=meshcat)
    with build_errors():
        planned_W = planned_path(scenario, logs)
        diagram = build_replay(scenario, shown, viewer, planned_W=planned_W)
    simulator = Simulator(diagram)
    if meshcat:
        simulator.set_target_realtime_rate(speed)
        title = f"{log.stem}: {motion_name(shown.avoid_obstacles)}"
        page = open_page(viewer, title, scenario.description)
        simulator.set_monitor(show_readings(page, readings(scenario, shown)))
    with recording(viewer):
        simulator.AdvanceTo(shown.simulated_time)
    print(f"{chosen}: {shown.duration:.2f} s, terminated by {shown.stop_reason}")
    if html is not None:
        replace_text(html, label_page(viewer.StaticHtml(), log.stem, scenario, shown))
    if meshcat:
        wait_for_viewer()


def plot(log: Path, /, *, out: Path | None = None) -> None:
    """Draw a logged run.

    Draws clearance of tool and robot against the requested one, phase and speed scale, the
    largest joint torque against its limit, and the path from above and from the side.

    For example:

        drake-oa plot drake_oa_runs/tabletop_box-20250131T120000Z.npz
        drake-oa plot box.npz --out box.pdf

    Args:
        log: a log that `drake-oa run` wrote.
        out: the figure, in a format of Matplotlib (default: LOG with .png in place of .npz).
    """
    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.plots import plot_run
    from drake_oa.runs.replay import choose_motion, logged_scenario

    out = out or log.with_suffix(".png")
    logs = load_logs(log)
    chosen = choose_motion(log, logs, None)
    logs = {name: of for name, of in logs.items() if len(of.t)}
    scenario = logged_scenario(log, logs[chosen])
    check_outputs(out, read=[log])
    title = f"{log.stem}: {scenario.description}".removesuffix(": ")
    with build_errors():
        plot_run(out, title, scenario, logs)
    print(f"plot: {out}")
