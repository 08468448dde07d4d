"""Commands `drake-oa replay`, `plot` and `export`: replay, plot and ROS 2 bag of a logged run."""

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
    """Replay a logged motion in a browser, or write the replay as a page.

    The replay shows the logged positions of robot and world, the observed ellipsoids, the nominal
    path and the executed path. It simulates nothing. A log has neither point clouds nor cost rings
    (costs of passing an obstacle on each side); `drake-oa run --meshcat` and `--html` show these.

    For example:

        drake-oa replay drake_oa_runs/tabletop_box-20250131T120000Z.npz --meshcat
        drake-oa replay box.npz --meshcat --motion nominal --speed 0.25
        drake-oa replay box.npz --html box.html

    Args:
        log: log of `drake-oa run` or `drake-oa play`.
        meshcat: show the motion in a browser.
        html: write the motion to this file, a page for a browser.
        motion: nominal or avoiding, or leg_N of `drake-oa play` (default: avoiding, or the first
            motion of the log).
        speed: with --meshcat, simulated time over wall time.
    """
    log.stat()  # A missing file is an OSError.
    if not (meshcat or html):
        raise ValueError("no output selected: add --meshcat, --html FILE or both")
    from pydrake.systems.analysis import Simulator

    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.page import label_page, motion_name, readings
    from drake_oa.runs.replay import (
        build_replay,
        choose_motion,
        logged_scenario,
        nominal_path,
        show_readings,
    )
    from drake_oa.viewing.viewer import open_page, recording, start_viewer, wait_for_viewer

    logs = load_logs(log)
    selected_motion = choose_motion(log, logs, motion)
    motion_log = logs[selected_motion]
    scenario = logged_scenario(log, motion_log)
    check_outputs(html, read=[log])
    viewer = start_viewer(browser=meshcat)
    with build_errors():
        diagram = build_replay(scenario, motion_log, viewer, nominal_W=nominal_path(scenario, logs))
    simulator = Simulator(diagram)
    if meshcat:
        simulator.set_target_realtime_rate(speed)
        title = f"{log.stem}: {motion_name(motion_log.avoid_obstacles)}"
        page = open_page(viewer, title, scenario.description)
        simulator.set_monitor(show_readings(page, readings(scenario, motion_log)))
    with recording(viewer):
        simulator.AdvanceTo(motion_log.simulated_time)
    print(f"{selected_motion}: {motion_log.duration:.2f} s, terminated by {motion_log.stop_reason}")
    if html is not None:
        replace_text(html, label_page(viewer.StaticHtml(), log.stem, scenario, motion_log))
    if meshcat:
        wait_for_viewer()


def plot(log: Path, /, *, out: Path | None = None) -> None:
    """Plot the motions of a logged run to a file.

    The plots over time are: clearance of tool and robot, with the requested clearance; phase of the
    movement primitive, from 1 to 0, and speed scale, the fraction of full speed; and the maximum
    joint torque over its limit. Two further plots are the path with the observed obstacles, from
    above and from the side.

    For example:

        drake-oa plot drake_oa_runs/tabletop_box-20250131T120000Z.npz
        drake-oa plot box.npz --out box.pdf

    Args:
        log: log of `drake-oa run` or `drake-oa play`.
        out: file of the figure, in a format of Matplotlib (default: LOG with the suffix .plot.png).
    """
    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.plots import plot_run
    from drake_oa.runs.replay import choose_motion, logged_scenario

    out = out or log.with_suffix(".plot.png")
    logs = load_logs(log)
    chosen = choose_motion(log, logs, None)
    logs = {name: of for name, of in logs.items() if len(of.t)}
    scenario = logged_scenario(log, logs[chosen])
    check_outputs(out, read=[log])
    title = f"{log.stem}: {scenario.description}".removesuffix(": ")
    with build_errors():
        plot_run(out, title, scenario, logs)
    print(f"plot: {out}")


def export(log: Path, bag: Path, /) -> None:
    """Write the avoiding motion of a log as a bag of ROS 2 messages, without images.

    The bag has the topics of `drake-oa run --write-bag`, except those of the cameras; see
    docs/guides/perception.md.

    For example:

        drake-oa export box.npz box.mcap

    Args:
        log: log of `drake-oa run`, or of `drake-oa play`, of which the first motion is written.
        bag: MCAP file of the bag, which is replaced if it exists.
    """
    from drake_oa.common.bags import new_bag
    from drake_oa.runs.bag_log import write_log
    from drake_oa.runs.motion_log import load_logs
    from drake_oa.runs.replay import choose_motion, logged_scenario

    logs = load_logs(log)
    motion_log = logs[choose_motion(log, logs, None)]
    scenario = logged_scenario(log, motion_log)
    check_outputs(bag, read=[log])
    with build_errors(), new_bag(bag) as writer:
        write_log(writer, scenario, motion_log)
    print(f"bag: {bag}")
