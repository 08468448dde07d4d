"""Commands `drake-oa run`, which runs a scenario, and `drake-oa station`, which simulates an arm
with LCM messages.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Literal

from drake_oa.app.scenarios import (
    Overrides,
    Positive,
    Rate,
    ScenarioName,
    build_errors,
    check_end_contacts,
    open_scenario,
    scenario_name,
)
from drake_oa.common.console import FAILED, TERMINATED, complain, is_interrupt, progress_bar, show
from drake_oa.common.files import import_extra, replace_json, replace_text, reserve_file

# Diagrams and simulation are imported where they are used: `--help` answers at once.
if TYPE_CHECKING:
    from pydrake.geometry import Meshcat
    from pydrake.lcm import DrakeLcm
    from pydrake.systems.framework import Context

    from drake_oa.common.bags import BagWriter
    from drake_oa.runs.motion_log import MotionLog
    from drake_oa.runs.page import LivePanel
    from drake_oa.runs.simulation import MotionMonitor
    from drake_oa.scenario.scenario import Scenario

LOG_FOLDER = Path("drake_oa_runs")
"""Default folder of the logs that commands write, relative to the current folder."""
LCM_URL = "udpm://239.255.76.99:7699?ttl=0&recv_buf_size=4000000"
"""Default URL of the LCM bus: local to this computer, with a receive buffer for images."""


@dataclass
class _Run:
    """Settings and results of one call of `drake-oa run`, which the functions of this module share.

    Attributes:
        name: name of the scenario.
        scenario: scenario of the run.
        meshcat: viewer, or None.
        browser: whether a browser displays the viewer.
        html: file to which the recording of the avoiding motion is written, or None.
        duration: simulated time after which each motion is stopped [s]; None: no such limit.
        raise_if_requested: function that raises KeyboardInterrupt after a request to stop.
        bag: bag to which the avoiding motion is written, or None.
        logs: logs of the finished motions "nominal" and "avoiding", by name.
        failure: exception that interrupted the last motion; None: no interruption.
    """

    name: str
    scenario: Scenario
    meshcat: Meshcat | None
    browser: bool
    html: Path | None
    duration: float | None
    raise_if_requested: Callable[[], None]
    bag: BagWriter | None = None
    logs: dict[str, MotionLog] = field(default_factory=dict)
    failure: BaseException | None = None


def run(  # noqa: PLR0913
    scenario: ScenarioName,
    /,
    *,
    overrides: Overrides = (),
    meshcat: bool = False,
    html: Path | None = None,
    json: Path | None = None,
    log: Path | None = None,
    no_log: bool = False,
    write_bag: Path | None = None,
    duration: Positive | None = None,
    hardware: Literal["lcm", "franka"] | None = None,
    host: str | None = None,
    lcm_url: str = LCM_URL,
    rate: Rate = 1.0,
) -> int:
    """Simulate the nominal and the avoiding motion of a scenario, and print their clearances.

    The nominal motion avoids nothing; the avoiding motion avoids the perceived obstacles. The table
    has a column for each, and these rows, evaluated on the true geometry until the world is at
    rest:

      collisions                pairs of a robot link and an object in contact
      tool clearance [m]        minimum clearance of hand and fingers to the obstacles
      robot clearance [m]       minimum clearance of all links to the obstacles
      requested clearance [m]   clearance that the scenario requests of hand and fingers
      achievable clearance [m]  the requested clearance, or the clearance of hand and fingers at
                                start or goal if that is less
      clearance shortfall [mm]  achievable clearance minus tool clearance to resting obstacles, if
                                positive
      goal error [mm]           distance of the tool point to the goal at the end
      orientation error [deg]   angle to the orientation of the goal at the end, if the motion
                                changes the orientation
      saturated [%]             fraction of the time with a joint torque at its limit
      duration [s]              time from start to termination
      motion source             source of the avoiding motion, with the fraction of the time:
                                nominal, chain (the regressor chain of Pairet et al., RA-L 2019),
                                search (among simulated motions) or joint_path (a planned path)
      termination               goal, or the reason for which the motion ended elsewhere

    Notes and warnings below the table state contacts between links of the robot, an achievable
    clearance below the requested one, clearance reductions (a smaller clearance was required,
    because an obstacle was perceived near start or goal) and clearance shortfalls.

    Both motions are written to one log for `drake-oa replay` and `drake-oa plot`:
    drake_oa_runs/SCENARIO-TIME.npz, or the file of --log.

    With --write-bag the depth images, intrinsics and poses of the cameras, the joint states, and
    the contents of the log are written as ROS 2 messages, for viewers and for the perception
    `!RecordedBag` of a scenario; see docs/guides/perception.md.

    With --hardware only the avoiding motion is executed, by a real arm and its cameras; see
    docs/hardware.md. Images are on --lcm-url, or on the bus that the scenario's `!LcmCamera` names.
    The arm is on --lcm-url, too (lcm: the driver of a Panda, or `drake-oa station`), or at --host
    (franka: a Franka Research 3). True obstacles are unknown then, and the clearances are "-".

    Exit status: 0 if the avoiding motion ended with the tool at the goal, or at --duration; 1 if it
    ended otherwise, if the robot was in contact, or if an output could not be written; 2 for
    invalid input; 130 if interrupted, 143 by SIGTERM. After a failure or an interruption the
    report and the outputs have the motions until then.

    --set A.B=C replaces field B of block A of the scenario. C is YAML; a tag replaces the whole
    block. The error for an unknown field lists the valid fields.

      --set task.clearance=0.1
      --set 'task.goal=[0.5, 0.4, 0.35]'
      --set 'perception=!GroundTruth {}'
      --set 'perception=!RecordedClouds {folder: /data/clouds}'
      --set 'perception=!RecordedBag {path: /data/bag}'

    Args:
        scenario: name of a shipped scenario (see `drake-oa scenarios`), or a file.
        overrides: A.B=C replaces a field of the scenario; may be repeated.
        meshcat: show the motions in a browser during the run.
        html: write a recording of the avoiding motion to this file, a page for a browser.
        json: write the report to this file.
        log: write the log to this file, which is replaced if it exists.
        no_log: write no log.
        write_bag: write the avoiding motion to this file, an MCAP bag of ROS 2; 37 MB of images for
            each camera (640 x 480 pixels, 30 images/s) and simulated second.
        duration: stop each motion at this simulated time [s].
        hardware: execute the avoiding motion on a real arm instead of simulating it: on one behind
            Drake's LCM messages, or on a Franka Research 3 (pip install 'drake_oa[franka]').
        host: with --hardware franka, address of the robot.
        lcm_url: with --hardware, URL of the LCM bus of arm and images.
        rate: with --hardware, simulated time over wall time, at most 1.
    """
    from drake_oa.common.bags import new_bag

    loaded_scenario = open_scenario(scenario, overrides, html, json, log, write_bag)
    if hardware:
        if write_bag:
            raise ValueError("--write-bag and --hardware exclude each other")
        _open_bus(lcm_url)
    elif rate != 1.0 or lcm_url != LCM_URL:
        raise ValueError("--lcm-url and --rate require --hardware")
    if (hardware == "franka") != bool(host):
        raise ValueError("--hardware franka requires --host ADDRESS, and only it uses --host")
    if not hardware:
        check_end_contacts(loaded_scenario)
    viewer = None
    if meshcat or html:
        from drake_oa.viewing.viewer import start_viewer

        viewer = start_viewer(browser=meshcat)
    name = scenario_name(scenario)
    with (
        reserved_log(log, no_log, name) as log_file,
        new_bag(write_bag) if write_bag else contextlib.nullcontext() as bag,
        stop_between_steps() as raise_if_requested,
    ):
        this = _Run(name, loaded_scenario, viewer, meshcat, html, duration, raise_if_requested, bag)
        if hardware:
            from drake_oa.hardware.robot_link import HardwareError

            try:
                _drive(this, lcm_url, rate, host)
            except HardwareError as error:
                complain(str(error))
                return FAILED
        else:
            _simulate_both(this, log_file)
        status = _report(this, json, log_file)
        if this.failure is not None and not is_interrupt(this.failure):
            complain(f"interrupted: {next(reversed(this.logs.values())).stop_reason}")
            status, meshcat = FAILED, False
        raise_if_requested()
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
    """Simulate a Panda and its cameras, which use the LCM messages of the real arm and cameras.

    The station receives lcmt_panda_command on PANDA_COMMAND. It sends lcmt_panda_status on
    PANDA_STATUS, and depth images as lcmt_image_array on DRAKE_RGBD_CAMERA_IMAGES_<camera>. The arm
    holds its position if commands end, jump, exceed limits or have two sources; a log message
    states the reason. The station runs until Ctrl-C; see docs/hardware.md.

    With --log it prints the rows of `drake-oa run` for the motion of the arm.

    Args:
        scenario: name of a shipped scenario (see `drake-oa scenarios`), or a file.
        overrides: A.B=C replaces a field of the scenario; may be repeated.
        lcm_url: URL of the LCM bus; the default bus is local to this computer.
        rate: simulated time over wall time, at most 1; reduce it on a slow computer.
        wait: start the simulated world with the first command, and end the station when commands
            have ended and the world is at rest.
        duration: end the station at this simulated time [s].
        log: write the true motion of the arm to this file, and print its clearances.
    """
    from drake_oa.hardware.panda_station import PandaStation
    from drake_oa.runs.hardware_run import station_log
    from drake_oa.runs.motion_log import save_logs
    from drake_oa.runs.report import contact_error, report_table, run_report

    loaded_scenario = open_scenario(scenario, overrides, log)
    lcm = _open_bus(lcm_url)
    with contextlib.suppress(OSError):
        # A real arm has its own control computer. The thread that renders inherits the priority.
        os.setpriority(os.PRIO_PROCESS, 0, -10)
    with build_errors():
        arm = PandaStation(loaded_scenario, lcm, rate=rate, waits=wait, log=log is not None)
    failure: BaseException | None = None
    print(f"station: {scenario_name(scenario)} on {lcm_url}", file=sys.stderr)
    with stop_between_steps() as raise_if_requested:
        try:
            arm.run(math.inf if duration is None else duration, raise_if_requested)
        except (Exception, KeyboardInterrupt) as error:
            failure = error
    contact = ""
    if log is not None:
        logs = {"avoiding": station_log(loaded_scenario, arm)}
        save_logs(log, logs)
        print(f"log: {log}", file=sys.stderr)
        report = run_report(scenario_name(scenario), loaded_scenario, logs)
        show(report_table(report))
        if contact := contact_error(report):
            complain(contact)
    if isinstance(failure, Exception):
        complain(f"interrupted: {type(failure).__name__}: {failure}")
        return FAILED
    return TERMINATED if isinstance(failure, Terminated) else FAILED if contact else 0


def _open_bus(lcm_url: str) -> DrakeLcm:
    """Opens the LCM bus at the URL of --lcm-url, and returns it.

    Raises:
        ValueError: if the URL is invalid.
    """
    from pydrake.lcm import DrakeLcm

    from drake_oa.common.config import check_lcm_url

    check_lcm_url(lcm_url, "--lcm-url")
    try:
        return DrakeLcm(lcm_url)
    except RuntimeError as error:
        raise ValueError(f"--lcm-url: {lcm_url}: {error}") from None


@contextlib.contextmanager
def reserved_log(named: Path | None, no_log: bool, scenario: str) -> Iterator[Path | None]:
    """Yields the log file of a run: the file of --log, a new file in `LOG_FOLDER`, or None with
    --no-log.

    A new file that is still empty at the end of the `with` block is deleted.

    Args:
        named: file of --log, or None.
        no_log: whether --no-log was given.
        scenario: name of the scenario, with which the name of a new file begins.

    Raises:
        ValueError: if both options were given, or the folder cannot be written.
    """
    if named is not None and no_log:
        raise ValueError("--log and --no-log exclude each other")
    if named is not None or no_log:
        yield named
        return
    # The file is created at once, so that two simultaneous runs have different names.
    file = reserve_file(LOG_FOLDER, scenario, ".npz")
    try:
        yield file
    finally:
        with contextlib.suppress(FileNotFoundError):
            if file.stat().st_size == 0:
                file.unlink()


def _simulate_both(this: _Run, log_file: Path | None) -> None:
    """Simulates the nominal motion and then the avoiding motion of a run, and adds their logs to
    the run.

    After an interruption of the nominal motion, the avoiding motion is not simulated.

    Args:
        this: settings of the run.
        log_file: file to which the log of the nominal motion is written before the avoiding motion
            is simulated; None: none.
    """
    from drake_oa.diagrams.avoidance import build_avoidance
    from drake_oa.diagrams.perception import record_images
    from drake_oa.runs.motion_log import save_logs
    from drake_oa.runs.simulation import simulate

    with build_errors():
        # Errors of the avoiding motion are reported before the first one is simulated.
        customize = partial(record_images, this.bag, this.scenario) if this.bag else None
        built = build_avoidance(this.scenario, meshcat=this.meshcat, customize=customize)
    panel = _open_panel(this)
    run_motion = partial(simulate, this.scenario, duration=this.duration)
    _add_motion(this, "nominal", partial(run_motion, avoid_obstacles=False))
    if log_file is not None:
        # The nominal motion is saved in case the process is killed; `_report` writes the file
        # again, and reports an error.
        with contextlib.suppress(OSError):
            save_logs(log_file, this.logs)
    if this.failure is None:
        _add_motion(
            this, "avoiding", partial(run_motion, avoid_obstacles=True, diagram=built), panel
        )


def _drive(this: _Run, lcm_url: str, rate: float, host: str | None) -> None:
    """Executes the avoiding motion of a run on a real arm, and adds its log to the run.

    Args:
        this: settings of the run.
        lcm_url: URL of the LCM bus.
        rate: maximum ratio of simulated time to wall time.
        host: address of a Franka Research 3; None: the arm communicates on the LCM bus.
    """
    from drake_oa.hardware.hardware_station import arm_of
    from drake_oa.hardware.robot_link import RobotLink
    from drake_oa.runs.hardware_run import drive, prepare_hardware

    address, connect = host or lcm_url, None
    if host:
        import_extra("pylibfranka", "franka")
        from drake_oa.hardware.franka_arm import FrankaArm

        _, limits = arm_of(this.scenario)
        connect = partial(FrankaArm, host, limits.velocity_limit.tolist())
    stop = this.raise_if_requested
    link = RobotLink(lcm_url, connect=connect, address=address, rate=rate, raise_if_requested=stop)
    link.start()
    with contextlib.closing(link):
        print(f"waiting for the arm on {address} ...", file=sys.stderr)
        with build_errors():
            driven = prepare_hardware(this.scenario, link, this.meshcat)
        print("arm is ready", file=sys.stderr)
        this.scenario = driven.known_scenario
        panel = _open_panel(this)
        _add_motion(this, "avoiding", partial(drive, driven, link, duration=this.duration), panel)
        error = link.trajectory.max_tracking_error
        print(f"maximum tracking error of the arm: {error:.3f} rad", file=sys.stderr)


def _add_motion(
    this: _Run, name: str, motion: Callable[..., MotionLog], panel: LivePanel | None = None
) -> None:
    """Runs a motion with a progress bar, and adds its log to the run, also after an interruption.

    Args:
        this: settings of the run.
        name: name of the motion, "nominal" or "avoiding".
        motion: function that runs the motion; its argument `on_step` is called once per period of
            the movement primitive.
        panel: panel of a viewer page that is updated during the motion, or None.
    """
    from drake_oa.policy.dmp import normalized_time
    from drake_oa.runs.simulation import MotionInterruptedError
    from drake_oa.viewing.viewer import recording

    recorded = this.meshcat if this.html and name == "avoiding" else None
    try:
        with build_errors(), recording(recorded), progress_bar(1.0) as update:

            def update_progress(monitor: MotionMonitor, root: Context) -> None:
                this.raise_if_requested()
                share = normalized_time(monitor.phase, this.scenario.policy.alpha_k)
                update(f"{name:>10} {root.get_time():6.2f} s", share)
                if panel is not None:
                    panel(monitor, root)

            this.logs[name] = motion(on_step=update_progress)
    except MotionInterruptedError as error:
        this.logs[name], this.failure = error.log, error.__cause__ or error
        logging.getLogger(__name__).info("traceback of the interruption", exc_info=True)


def _report(this: _Run, json: Path | None, log_file: Path | None) -> int:
    """Prints the report of a run, and writes its log, recording and report to their files.

    Args:
        this: settings and logs of the run.
        json: file of the report, or None.
        log_file: file of the log, or None.

    Returns:
        0, or `FAILED` (1) if the avoiding motion was in contact, or ended neither at the goal nor
        at --duration.
    """
    from drake_oa.runs.bag_log import write_log
    from drake_oa.runs.motion_log import MotionEnd, save_logs
    from drake_oa.runs.page import label_page
    from drake_oa.runs.report import contact_error, report_table, run_report

    logs, report = this.logs, run_report(this.name, this.scenario, this.logs)
    contact = contact_error(report)
    # The callbacks run in reverse order, the others also after an exception in one of them.
    with contextlib.ExitStack() as outputs:
        if contact:
            outputs.callback(complain, contact)
        outputs.callback(replace_json, json, report)
        if this.bag and "avoiding" in logs:
            outputs.callback(write_log, this.bag, this.scenario, logs["avoiding"])
        if log_file is not None:
            outputs.callback(print, f"log: {log_file}", file=sys.stderr)
            outputs.callback(save_logs, log_file, logs)
        outputs.callback(show, report_table(report))
        if this.meshcat is not None and this.html is not None and "avoiding" in logs:
            page = label_page(this.meshcat.StaticHtml(), this.name, this.scenario, logs["avoiding"])
            outputs.callback(replace_text, this.html, page)
    # The nominal motion may be in contact.
    last = logs.get("avoiding") or next(iter(logs.values()))
    successes = {MotionEnd.GOAL, *([MotionEnd.TIME_LIMIT] if this.duration is not None else [])}
    return 0 if not contact and last.ended in successes else FAILED


def _open_panel(this: _Run) -> LivePanel | None:
    """Opens the live viewer page of a run in a browser, and returns the updater of its text panel.

    The result is None if the run has no viewer in a browser.
    """
    if this.meshcat is None or not this.browser:
        return None
    from drake_oa.runs.page import LivePanel, motion_name
    from drake_oa.viewing.viewer import open_page

    title = f"{this.name}: {motion_name(True)}"
    page = open_page(this.meshcat, title, this.scenario.description)
    return LivePanel(page, this.scenario)


class Terminated(KeyboardInterrupt):
    """Exception for the signals SIGTERM and SIGHUP, which commands handle like Ctrl-C.

    Attributes:
        status: exit status of the command.
    """

    status = TERMINATED


@contextlib.contextmanager
def stop_between_steps() -> Iterator[Callable[[], None]]:
    """Delays exceptions by Ctrl-C, SIGTERM and SIGHUP in the `with` block until the end of a
    simulation step.

    Inside a callback of numba or Drake, an exception would leave inconsistent data. A second signal
    raises its exception at once.

    Yields:
        Function to call between two steps: it raises the exception of a signal that has arrived.
    """
    requested: list[KeyboardInterrupt] = []

    def request_stop(number: int, _: FrameType | None) -> None:
        stop = KeyboardInterrupt() if number == signal.SIGINT else Terminated("terminated")
        if requested:
            raise stop
        requested.append(stop)
        hint = str(stop) or "Ctrl-C again stops at once"
        print(f"\nstopping after this step ({hint}) ...", file=sys.stderr)

    def raise_if_requested() -> None:
        if requested:
            raise requested[0]

    signals = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    # nohup ignores SIGHUP.
    handled = [number for number in signals if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, request_stop) for number in handled}
    try:
        yield raise_if_requested
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
