"""`drake-oa replay` and `drake-oa plot`: a logged run, shown again and drawn."""

from __future__ import annotations

import logging
from pathlib import Path

from drake_oa.app.scenarios import (
    Overrides,
    Positive,
    ScenarioName,
    build_errors,
    open_scenario,
    scenario_name,
)
from drake_oa.common.files import check_outputs, check_plot_file, replace_text

_log = logging.getLogger(__name__)

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
    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.replay import choose_motion, logged_scenario, planned_path
    from drake_oa.scenario.loading import scenario_files

    logs = load_logs(log)
    chosen = choose_motion(log, logs, motion)
    shown = logs[chosen]
    scenario = logged_scenario(log, shown)
    check_outputs(html, read=[log, *scenario_files(scenario)])

    from pydrake.systems.analysis import Simulator

    from drake_oa.runs.page import label_page, motion_name, readings
    from drake_oa.runs.replay import build_replay, show_readings
    from drake_oa.viewing.viewer import open_page, recording, start_viewer, wait_for_viewer

    viewer = start_viewer(browser=meshcat)
    with build_errors():
        planned_W = planned_path(scenario, logs)
        diagram = build_replay(scenario, shown, viewer, planned_W=planned_W, speed=speed)
    simulator = Simulator(diagram)
    if meshcat:
        simulator.set_target_realtime_rate(1.0)
        title = f"{log.stem}: {motion_name(shown.modulated)}"
        page = open_page(viewer, title, scenario.description)
        simulator.set_monitor(show_readings(page, readings(scenario, shown, speed=speed)))
    with recording(viewer):
        simulator.AdvanceTo(shown.simulated_time / speed)
    print(f"{chosen}: {shown.duration:.2f} s, ended by {shown.stop_reason}")
    if html is not None:
        recorded = viewer.StaticHtml()
        replace_text(html, label_page(recorded, log.stem, scenario, shown, speed=speed))
    if meshcat:
        wait_for_viewer()


def plot(shown: ScenarioName, /, *, overrides: Overrides = (), out: Path | None = None) -> None:
    """Draw a logged run, or what demonstrations teach a scenario.

    Of a log it draws clearance of tool and robot against the asked one, phase and share of full
    speed with the times in which the motion was slowed or held and why, joint torques against
    their limits, tracking error, and the path from above and from the side, beside what was
    demonstrated. Of a scenario it draws the demonstrations before anything is run: every sample,
    put on the way from the task's start to its goal, and the motion that is learnt of them.

    For example:

        drake-oa plot drake_oa_runs/tabletop_box-20250131T120000Z.npz
        drake-oa plot box.npz --out box.pdf
        drake-oa plot demonstrated_arc
        drake-oa plot tabletop_box --set task.demonstration=mine.csv --out mine.png

    Args:
        shown: a log that `drake-oa run` wrote; or a scenario: a shipped name or a .yaml file.
        overrides: A.B=C replaces field B of block A of the scenario; may be repeated.
        out: the picture, .png, .svg or .pdf (default: LOG or SCENARIO with .png in place of .npz).
    """
    from drake_oa.scenario.shipped import shipped_scenarios

    of_scenario = shown in shipped_scenarios() or Path(shown).suffix in (".yaml", ".yml")
    log, name = Path(shown), scenario_name(shown)
    out = out or (Path(f"{name}.png") if of_scenario else log.with_suffix(".png"))
    check_plot_file("--out", out)
    if overrides and not of_scenario:
        raise ValueError("--set is of a scenario: a log has its own")
    if of_scenario:
        _plot_scenario(shown, overrides, out)
    else:
        _plot_log(log, out)
    print(f"plot: {out}")


def _plot_scenario(shown: str, overrides: Overrides, out: Path) -> None:
    """Draws the demonstrations of a scenario."""
    from drake_oa.runs.plots import place_demonstrations, plot_demonstrations

    scenario = open_scenario(shown, overrides, out)
    found = place_demonstrations(scenario)
    if found is None:
        raise ValueError(
            f"{shown} has no task.demonstration to draw: give a log, or "
            "--set task.demonstration=FILE"
        )
    title = f"{scenario_name(shown)}: {scenario.description}".removesuffix(": ")
    plot_demonstrations(out, title, scenario, found)


def _plot_log(log: Path, out: Path) -> None:
    """Draws a logged run."""
    from drake_oa.common.config import ScenarioError
    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.plots import place_demonstrations, plot_run
    from drake_oa.runs.replay import choose_motion, logged_scenario
    from drake_oa.scenario.loading import scenario_files

    logs = load_logs(log)
    chosen = choose_motion(log, logs, None)
    logs = {name: of for name, of in logs.items() if name == chosen or len(of.t)}
    scenario = logged_scenario(log, logs[chosen])
    check_outputs(out, read=[log, *scenario_files(scenario)])
    title = f"{log.stem}: {scenario.description}".removesuffix(": ")
    try:
        shown = place_demonstrations(scenario)
    except ScenarioError as error:
        # The log does not hold what was demonstrated.
        _log.warning("drawn without the demonstrations: %s", error)
        shown = None
    with build_errors():
        plot_run(out, title, scenario, logs, shown)
