"""The command `drake-oa run`."""

from __future__ import annotations

import contextlib
import logging
import math
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING

from drake_oa.app.scenarios import (
    Overrides,
    Positive,
    Rate,
    ScenarioName,
    build_errors,
    open_scenario,
    scenario_name,
)
from drake_oa.common.console import (
    FAILED,
    INTERRUPTED,
    TERMINATED,
    complain,
    progress_bar,
    show,
)
from drake_oa.common.files import replace_json, replace_text, reserve_file

# Diagrams and simulation are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from pydrake.geometry import Meshcat
    from pydrake.lcm import DrakeLcm
    from pydrake.systems.framework import Context

    from drake_oa.runs.motion_log import MotionLog
    from drake_oa.runs.page import LivePanel
    from drake_oa.runs.simulation import MotionMonitor
    from drake_oa.scenario.scenario import Scenario

LOG_FOLDER = Path("drake_oa_runs")
"""Folder of logs without --log, relative to the current folder."""
LCM_URL = "udpm://239.255.76.99:7699?ttl=0&recv_buf_size=4000000"
"""Bus that stays on this machine, with room for images."""


@dataclass
class _Run:
    """One run: the motions so far.

    Attributes:
        name: name of the scenario.
        scenario: as it is run.
        meshcat: viewer, or None.
        browser: whether a browser shows the viewer.
        html: file of the page, or None.
        duration: simulated time after which each motion is stopped [s]; None: at its end.
        raise_if_asked: raises KeyboardInterrupt once the end was requested.
        logs: log of each motion.
        failure: exception that cut the last motion short.
    """

    name: str
    scenario: Scenario
    meshcat: Meshcat | None
    browser: bool
    html: Path | None
    duration: float | None
    raise_if_asked: Callable[[], None]
    logs: dict[str, MotionLog] = field(default_factory=dict)
    failure: BaseException | None = None


def run(
    scenario: ScenarioName,
    /,
    *,
    overrides: Overrides = (),
    meshcat: bool = False,
    html: Path | None = None,
    json: Path | None = None,
    log: Path | None = None,
    no_log: bool = False,
    duration: Positive | None = None,
    hardware: bool = False,
    lcm_url: str = LCM_URL,
    rate: Rate = 1.0,
) -> int:
    """Simulate a scenario and print clearances and contacts.

    Simulates two motions from start to goal, the pre-planned one, blind to obstacles,
    and the avoiding one, bent round what perception sees, and prints for each:

      collisions       pairs of a robot link and an obstacle or the table that touched
      tool clearance   least distance of hand and fingers to an obstacle
      robot clearance  least distance of any link to an obstacle
      asked            the clearance that the scenario asks for
      feasible         the requested clearance, or what start and goal leave the tool
      short by         what the tool lacked of that to what stands at rest
      goal error       distance of the tool point to the goal at the end
      saturated        share of steps in which a torque limit was reached

    All of it by the true geometry, until all that moves has come to rest.

    Both motions go into one log, which `drake-oa replay` shows again and `drake-oa plot`
    draws: drake_oa_runs/SCENARIO-TIME.npz unless --log names another file.

    With --hardware only the avoiding motion, by the arm and cameras whose messages are on
    --lcm-url: a real Panda's driver, or `drake-oa station`; see docs/hardware.md. Obstacles
    are what is seen; the report knows of no others.

    Exit status: 0 when the tool of the avoiding motion reached the goal (or the asked
    --duration), 1 when it did not (it failed, was held for good or ran out of time), when the
    robot was in contact, or when an output could not be written, 2 for bad input, 130 when
    interrupted (143 by SIGTERM). What ran until then is reported, and each output that can be
    written is written.

    A.B=C replaces field B of block A of the scenario; C is YAML, a tag swaps the block.
    A mistyped name is answered with the valid ones.

      --set task.clearance=0.1
      --set 'task.goal=[0.5, 0.4, 0.35]'
      --set 'perception=!GroundTruth {}'
      --set 'perception=!RecordedClouds {folder: /data/clouds}'

    Args:
        scenario: a shipped name (see `drake-oa scenarios`) or a file.
        overrides: A.B=C replaces a field of the scenario; may be repeated.
        meshcat: show it in a browser while it runs.
        html: write the avoiding motion as one page to play and pause in a browser.
        json: write the report.
        log: write the log here, in place of an earlier one.
        no_log: write no log.
        duration: stop each motion after so many simulated seconds.
        hardware: drive the arm that is there, in place of a simulated one.
        lcm_url: with --hardware, of the bus.
        rate: with --hardware, simulated seconds in one of the wall clock, at most 1.
    """
    chosen = open_scenario(scenario, overrides, html, json, log)
    if hardware:
        _open_bus(lcm_url)
    elif rate != 1.0 or lcm_url != LCM_URL:
        raise ValueError("--lcm-url and --rate need --hardware")
    viewer = None
    if meshcat or html:
        from drake_oa.viewing.viewer import start_viewer

        viewer = start_viewer(browser=meshcat)
    name = scenario_name(scenario)
    with (
        reserved_log(log, no_log, name) as log_file,
        stop_between_steps() as raise_if_asked,
    ):
        this = _Run(name, chosen, viewer, meshcat, html, duration, raise_if_asked)
        if hardware:
            from drake_oa.hardware.robot_link import HardwareError

            try:
                _drive(this, lcm_url, rate)
            except HardwareError as error:
                complain(str(error))
                return FAILED
        else:
            _simulate_both(this, log_file)
        status = _report(this, json, log_file)
    if isinstance(this.failure, KeyboardInterrupt):
        complain(str(this.failure) or "interrupted")
        return TERMINATED if isinstance(this.failure, Terminated) else INTERRUPTED
    if this.failure is not None:
        complain(f"interrupted: {next(reversed(this.logs.values())).stop_reason}")
        return FAILED
    if meshcat:
        from drake_oa.viewing.viewer import wait_for_viewer

        wait_for_viewer()
    return status


def station(
    scenario: ScenarioName,
    /,
    *,
    overrides: Overrides = (),
    lcm_url: str = LCM_URL,
    rate: Rate = 1.0,
    wait: bool = False,
    duration: Positive | None = None,
    log: Path | None = None,
) -> int:
    """Simulate a Panda and its cameras behind the messages of the real ones.

    Takes lcmt_panda_command on PANDA_COMMAND, sends lcmt_panda_status on
    PANDA_STATUS and depth as lcmt_image_array on DRAKE_RGBD_CAMERA_IMAGES_<camera>. The arm
    holds where commands end, jump, are out of limits or of two commanders, and the log says so.
    Runs until Ctrl-C; see docs/hardware.md.

    Args:
        scenario: a shipped name (see `drake-oa scenarios`) or a file.
        overrides: A.B=C replaces a field of the scenario; may be repeated.
        lcm_url: of the bus; the default one stays on this machine.
        rate: simulated seconds in one of the wall clock, at most 1; smaller where a machine
            cannot keep up.
        wait: let the world begin when the arm follows a command, and end when the commander is
            done and all has come to rest.
        duration: end after so many simulated seconds.
        log: write what the arm did here, and print what it kept and touched.
    """
    from drake_oa.hardware.panda_station import PandaStation
    from drake_oa.runs.hardware_run import station_log
    from drake_oa.runs.motion_log import save_logs
    from drake_oa.runs.report import contact_error, report_table, run_report

    chosen = open_scenario(scenario, overrides, log)
    lcm = _open_bus(lcm_url)
    with build_errors():
        arm = PandaStation(
            chosen,
            lcm,
            rate=rate,
            waits=wait,
            log=log is not None,
        )
    failure: BaseException | None = None
    print(f"station: {scenario_name(scenario)} on {lcm_url}", file=sys.stderr)
    with stop_between_steps() as raise_if_asked:
        try:
            arm.run(math.inf if duration is None else duration, raise_if_asked)
        except (Exception, KeyboardInterrupt) as error:
            failure = error
    contact = ""
    if log is not None:
        logs = {"avoiding": station_log(chosen, arm)}
        save_logs(log, logs)
        print(f"log: {log}", file=sys.stderr)
        report = run_report(scenario_name(scenario), chosen, logs)
        show(report_table(report))
        if contact := contact_error(report):
            complain(contact)
    if isinstance(failure, Exception):
        complain(f"interrupted: {type(failure).__name__}: {failure}")
        return FAILED
    return TERMINATED if isinstance(failure, Terminated) else FAILED if contact else 0


def _open_bus(lcm_url: str) -> DrakeLcm:
    """Opens the bus of --lcm-url."""
    from pydrake.lcm import DrakeLcm

    from drake_oa.common.config import check_lcm_url

    check_lcm_url(lcm_url, "--lcm-url")
    try:
        return DrakeLcm(lcm_url)
    except RuntimeError as error:
        raise ValueError(f"--lcm-url: {lcm_url}: {error}") from None


@contextlib.contextmanager
def reserved_log(named: Path | None, no_log: bool, scenario: str) -> Iterator[Path | None]:
    """Provides the file of the log: the one of --log, or a new one; None with --no-log."""
    if named is not None and no_log:
        raise ValueError("--log and --no-log exclude each other")
    if named is not None or no_log:
        yield named
        return
    # Two runs may start within one second: the second one takes another name.
    file = reserve_file(LOG_FOLDER, scenario, ".npz")
    try:
        yield file
    finally:
        if file.stat().st_size == 0:
            file.unlink()


def _simulate_both(this: _Run, log_file: Path | None) -> None:
    """Simulates both motions; ends after one that is cut short."""
    from drake_oa.diagrams.avoidance import build_avoidance
    from drake_oa.runs.motion_log import save_logs
    from drake_oa.runs.scenario_check import end_contacts
    from drake_oa.runs.simulation import simulate

    with build_errors():
        if contacts := end_contacts(this.scenario):
            raise ValueError(contacts)
        # Errors of the avoiding motion are reported before the first one is simulated.
        built = build_avoidance(this.scenario, meshcat=this.meshcat)
    panel = _open_panel(this)
    run_motion = partial(simulate, this.scenario, duration=this.duration)
    _add_motion(this, "nominal", partial(run_motion, avoid_obstacles=False))
    if log_file is not None:
        # Nothing is lost by what comes next; `_report` tells of a file that cannot be written.
        with contextlib.suppress(OSError):
            save_logs(log_file, this.logs)
    if this.failure is None:
        _add_motion(
            this, "avoiding", partial(run_motion, avoid_obstacles=True, diagram=built), panel
        )


def _drive(this: _Run, lcm_url: str, rate: float) -> None:
    """Runs the avoiding motion on an arm."""
    from drake_oa.hardware.robot_link import RobotLink
    from drake_oa.runs.hardware_run import drive, prepare_hardware

    link = RobotLink(lcm_url, rate=rate, raise_if_asked=this.raise_if_asked)
    link.start()
    with contextlib.closing(link):
        print(f"waiting for the arm on {lcm_url} ...", file=sys.stderr)
        with build_errors():
            driven = prepare_hardware(this.scenario, link, this.meshcat)
        print("the arm is ready", file=sys.stderr)
        this.scenario = driven.known_scenario
        panel = _open_panel(this)
        _add_motion(this, "avoiding", partial(drive, driven, link, duration=this.duration), panel)
        print(
            f"the arm was at most {link.trajectory.max_tracking_error:.3f} rad off", file=sys.stderr
        )


def _add_motion(
    this: _Run, name: str, motion: Callable[..., MotionLog], panel: LivePanel | None = None
) -> None:
    """Runs one more motion with a progress bar, and logs it up to its end or interruption."""
    from drake_oa.policy.dmp import normalized_time
    from drake_oa.runs.simulation import MotionInterruptedError
    from drake_oa.viewing.viewer import recording

    recorded = this.meshcat if this.html and name == "avoiding" else None
    try:
        with build_errors(), recording(recorded), progress_bar(1.0) as update:

            def look(monitor: MotionMonitor, root: Context) -> None:
                this.raise_if_asked()
                share = normalized_time(monitor.phase, this.scenario.policy.alpha_k)
                update(f"{name:>10} {root.get_time():6.2f} s", share)
                if panel is not None:
                    panel(monitor, root)

            this.logs[name] = motion(on_step=look)
    except MotionInterruptedError as error:
        this.logs[name], this.failure = error.log, error.__cause__ or error
        logging.getLogger(__name__).info("where it happened", exc_info=True)


def _report(this: _Run, json: Path | None, log_file: Path | None) -> int:
    """Prints the report, and writes log, page and report.

    Returns:
        FAILED if the avoiding motion did not arrive or was in contact.
    """
    from drake_oa.runs.motion_log import MotionEnd, save_logs
    from drake_oa.runs.page import label_page
    from drake_oa.runs.report import contact_error, report_table, run_report

    logs, report = this.logs, run_report(this.name, this.scenario, this.logs)
    contact = contact_error(report)
    # From the last to the first; one that fails does not cost the others.
    with contextlib.ExitStack() as outputs:
        if contact:
            outputs.callback(complain, contact)
        if this.meshcat is not None and this.html is not None and "avoiding" in logs:
            page = label_page(this.meshcat.StaticHtml(), this.name, this.scenario, logs["avoiding"])
            outputs.callback(replace_text, this.html, page)
        outputs.callback(replace_json, json, report)
        if log_file is not None:
            outputs.callback(print, f"log: {log_file}", file=sys.stderr)
            outputs.callback(save_logs, log_file, logs)
        outputs.callback(show, report_table(report))
    # The nominal motion may end at an obstacle.
    last = logs.get("avoiding") or next(iter(logs.values()))
    enough = {MotionEnd.GOAL, *([MotionEnd.TIME_LIMIT] if this.duration is not None else [])}
    return 0 if not contact and last.ended in enough else FAILED


def _open_panel(this: _Run) -> LivePanel | None:
    """Opens the page that a browser shows, if one is requested."""
    if this.meshcat is None or not this.browser:
        return None
    from drake_oa.runs.page import LivePanel, motion_name
    from drake_oa.viewing.viewer import open_page

    title = f"{this.name}: {motion_name(True)}"
    page = open_page(this.meshcat, title, this.scenario.description)
    return LivePanel(page, this.scenario)


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP: ends a run as Ctrl-C does."""

    def __str__(self) -> str:
        return "terminated"


@contextlib.contextmanager
def stop_between_steps() -> Iterator[Callable[[], None]]:
    """Delays Ctrl-C and SIGTERM; yields a function that raises them, to call between two steps.

    Raised anywhere, it would also strike inside numba's and Drake's own callbacks, and
    leave them half done. A second one is raised at once.
    """
    requested: list[type[KeyboardInterrupt]] = []

    def ask(number: int, _: FrameType | None) -> None:
        kind = KeyboardInterrupt if number == signal.SIGINT else Terminated
        if requested:
            raise kind
        requested.append(kind)
        again = "Ctrl-C again: at once" if kind is KeyboardInterrupt else "terminated"
        print(f"\nstopping ({again}) ...", file=sys.stderr)

    def raise_if_asked() -> None:
        if requested:
            raise requested[0]

    before = {
        number: signal.getsignal(number)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    }
    for number, handler in before.items():
        # nohup ignores SIGHUP.
        if handler is not signal.SIG_IGN:
            signal.signal(number, ask)
    try:
        yield raise_if_asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
