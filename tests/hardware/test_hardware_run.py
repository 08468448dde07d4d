"""Runs of scenarios with a simulated station behind LCM messages, in one and two processes.

python -m tests.hardware.test_hardware_run fr3_box 3      # runs with the seeds 0 to 2
"""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from drake import lcmt_panda_status
from numba.core.dispatcher import Dispatcher
from pydrake.lcm import DrakeLcm

from drake_oa.app.main import main
from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import ObstacleClouds, TablePlane
from drake_oa.hardware.command_streamer import COMMAND_CHANNEL, STATUS_CHANNEL
from drake_oa.hardware.hardware_station import hardware_scenario
from drake_oa.hardware.robot_link import HardwareError, check_table
from drake_oa.runs.hardware_run import drive, prepare_hardware, station_log
from drake_oa.runs.motion_log import MotionEnd, MotionLog, load_logs
from drake_oa.runs.report import motion_report
from drake_oa.scenario.loading import load_scenario
from tests.hardware.lockstep import PRINTED_METRICS, Lockstep, own_bus
from tests.test_systems import checked_systems


def kernel_count() -> int:
    """Counts the kernels that are loaded, once for each combination of argument types."""
    # References to all objects, as from `gc.get_objects`, would fail checks of pydrake's threads.
    modules = [vars(each) for name, each in sys.modules.copy().items() if "drake_oa" in name]
    values = [value for module in modules for value in module.values()]
    return sum(len(value.signatures) for value in values if isinstance(value, Dispatcher))


def run(lockstep: Lockstep, duration: float | None = None) -> MotionLog:
    """Runs a scenario on the simulated station; returns the log of the commands."""
    driven = prepare_hardware(lockstep.scenario, lockstep.link)
    assert checked_systems(driven.diagram) >= {"CommandStream", "MeasuredState", "LiveCamera"}
    for _ in range(25):
        lockstep.step()
    before = kernel_count()
    log = drive(driven, lockstep.link, duration=duration)
    assert kernel_count() == before, "kernels were loaded while the arm moved"
    while not lockstep.station.is_finished:
        lockstep.step()
    return log


def test_run_starts_with_messages_of_the_simulated_station() -> None:
    lockstep = Lockstep(images=True, log=True)
    log = run(lockstep, duration=0.3)
    assert log.ended == MotionEnd.TIME_LIMIT
    assert not any("rejected" in event for event in lockstep.station.validator.events)
    assert log.observation_time.size >= 5
    truth = station_log(lockstep.scenario, lockstep.station)
    # The arm comes to rest at the last commanded position, or slightly before.
    assert np.linalg.norm(truth.p_WE[-1] - log.p_WE[-1]) < 5e-3
    assert "following" in truth.event


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tabletop_box", "moving_obstacle"])
def test_run_with_messages_arrives_without_contacts(name: str) -> None:
    lockstep = Lockstep(name, images=True, log=True)
    log = run(lockstep)
    assert log.ended == MotionEnd.GOAL
    report = motion_report(lockstep.scenario, station_log(lockstep.scenario, lockstep.station))
    assert report["contacts"] == []
    assert report["goal_error"] < 5e-3
    # Images are 80 ms later than in one process, where seeds 0 to 2 have 0.160 to 0.163 and 0.160
    # to 0.171 m.
    assert report["robot_clearance_min"] > (0.13 if name == "moving_obstacle" else 0.14)


def test_fields_of_the_simulated_world_are_rejected() -> None:
    url = "memq://"
    with pytest.raises(ScenarioError, match="!GroundTruth does not perceive"):
        hardware_scenario(load_scenario("tabletop_box", ["perception=!GroundTruth {}"]), url)
    with pytest.raises(ScenarioError, match="faults"):
        hardware_scenario(load_scenario("tabletop_box", ["faults=[!Push {}]"]), url)
    known = hardware_scenario(load_scenario("moving_obstacle"), url)
    assert known.obstacles == []
    known = hardware_scenario(load_scenario("tabletop_box"), url)
    names = [one.add_model.name for one in known.directives if one.add_model]
    assert names == ["table", "camera_mount"]


def test_error_of_a_wrong_camera_pose_names_the_deviation_of_the_table() -> None:
    table = TablePlane()
    perceived = ObstacleClouds(stamp=0.0, table=TablePlane(offset=0.01))
    check_table(perceived, table)
    check_table(ObstacleClouds(), None)
    with pytest.raises(HardwareError, match=r"\+20 mm from the configured height"):
        check_table(ObstacleClouds(stamp=0.0, table=TablePlane(offset=0.02)), table)
    tilted = TablePlane(normal_W=np.array([0.0, np.sin(0.05), np.cos(0.05)]))
    with pytest.raises(HardwareError, match=r"tilted by 2\.9 deg"):
        check_table(ObstacleClouds(stamp=0.0, table=tilted), table)
    with pytest.raises(HardwareError, match="table not perceived: no valid pixel"):
        check_table(ObstacleClouds(note="no valid pixel"), table)


COMMAND = [sys.executable, "-m", "drake_oa.app.main"]
# Slow, so that the arm moves by less than the allowed jump while other load stops a process.
RATE = ["--rate", "0.2"]


def popen(*words: str) -> subprocess.Popen[str]:
    """Starts a command of drake-oa as a process."""
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [*COMMAND, *words], stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )


@pytest.mark.slow
def test_arm_slows_down_when_the_planning_process_ends(tmp_path: Path) -> None:
    # One after the other: each has three processes, and two cores are too few for six.
    for kind in (signal.SIGINT, signal.SIGKILL):
        run_and_end(kind, tmp_path)


def run_and_end(kind: int, tmp_path: Path) -> None:
    """Sends a signal to a planning process while the arm moves, and checks that the arm stops."""
    url = own_bus()
    truth, sent = tmp_path / f"truth{kind}.npz", tmp_path / f"sent{kind}.npz"
    arm = popen("station", "tabletop_box", "--lcm-url", url, *RATE, "--wait", "--log", str(truth))
    driver = popen(
        "run", "tabletop_box", "--lcm-url", url, *RATE, "--hardware", "lcm", "--log", str(sent)
    )
    lcm, received = DrakeLcm(url), list[bytes]()
    lcm.Subscribe(STATUS_CHANNEL, received.append)
    try:
        deadline = time.monotonic() + 300.0
        while time.monotonic() < deadline and driver.poll() is None:
            lcm.HandleSubscriptions(100)
            while lcm.HandleSubscriptions(0):
                pass  # A status that waits in the queue is of an earlier time.
            status = lcmt_panda_status.decode(received[-1]) if received else lcmt_panda_status()
            if np.abs(status.joint_velocity).max(initial=0.0) > 0.08:
                break
        assert driver.poll() is None, driver.communicate()[1]
        if kind == signal.SIGKILL:
            # The streamer continues without its parent process.
            driver.kill()
        else:
            os.killpg(driver.pid, kind)
        _, output = driver.communicate(timeout=120.0)
        _, error_text = arm.communicate(timeout=120.0)
    finally:
        arm.kill()
        driver.kill()
    assert "Traceback" not in output
    assert arm.returncode == 0, error_text
    assert "no command for 0.1 s" in error_text
    (log,) = load_logs(truth).values()
    fast = np.abs(log.v[:, :7]).max(axis=1)
    assert fast.max() > 0.1
    assert fast[-1] < 0.01
    # The arm decelerates within the lead.
    assert np.abs(np.diff(log.v[:, :7], axis=0)).max() / 0.004 < 40.0
    if kind == signal.SIGINT:
        assert driver.returncode == 130, output
        (log,) = load_logs(sent).values()
        assert log.ended == MotionEnd.INTERRUPTED
    else:
        assert "parent process ended" in output


def test_missing_arm_gives_a_one_line_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("drake_oa.hardware.robot_link.STARTUP_TIMEOUT", 0.5)
    url = own_bus()
    assert main(["run", "tabletop_box", "--hardware", "lcm", "--lcm-url", url, "--no-log"]) == 1
    error_text = capsys.readouterr().err
    assert "no status" in error_text
    assert f"({url})" in error_text
    assert main(["run", "tabletop_box", "--rate", "0.5"]) == 2


def print_run(name: str, seed: int) -> None:
    """Prints metrics of a run, with delays and pauses of commands by the station's clock [ms]."""
    lockstep = Lockstep(name, f"seed={seed}", images=True, log=True)
    statuses, commands = [lockstep.clock()], list[tuple[float, float]]()

    def command(_: bytes) -> None:
        commands.append((lockstep.clock(), lockstep.clock() - statuses[-1]))

    lockstep.lcm.Subscribe(STATUS_CHANNEL, lambda _: statuses.append(lockstep.clock()))
    lockstep.lcm.Subscribe(COMMAND_CHANNEL, command)
    log = run(lockstep)
    report = motion_report(lockstep.scenario, station_log(lockstep.scenario, lockstep.station))
    times, delays = np.transpose(commands)
    pause = np.diff(times).max()
    report |= {"delay": round(1e3 * delays.max()), "pause": round(1e3 * pause)}
    print(log.ended, {key: report[key] for key in PRINTED_METRICS}, flush=True)


if __name__ == "__main__":
    for number in range(int(sys.argv[2])):
        print_run(sys.argv[1], number)
