"""A scenario driven through messages, in one process and in two."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from drake import lcmt_panda_status
from pydrake.lcm import DrakeLcm

from drake_oa.app.main import main
from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import ObstacleClouds, TablePlane
from drake_oa.hardware.command_streamer import STATUS_CHANNEL
from drake_oa.hardware.hardware_station import hardware_scenario
from drake_oa.hardware.robot_link import HardwareError, check_table
from drake_oa.runs.hardware_run import drive, ready, station_log
from drake_oa.runs.motion_log import MotionEnd, MotionLog, load_logs
from drake_oa.runs.report import motion_report
from drake_oa.scenario.loading import load_scenario
from tests.hardware.lockstep import Lockstep
from tests.test_systems import checked_systems


def run(both: Lockstep, duration: float | None = None) -> MotionLog:
    driven = ready(both.scenario, both.link)
    assert checked_systems(driven.diagram) >= {"CommandStream", "MeasuredState", "LiveCamera"}
    for _ in range(25):
        both.step()
    log = drive(driven, both.link, duration=duration)
    while not both.station.finished:
        both.step()
    return log


def test_a_scenario_begins_through_messages() -> None:
    both = Lockstep(images=True, log=True)
    log = run(both, duration=0.3)
    assert log.ended == MotionEnd.TIME_LIMIT
    assert not any("refused" in event for event in both.station.guard.events)
    assert log.observation_time.size >= 5
    truth = station_log(both.scenario, both.station)
    # The arm comes to rest where the log's end has it, or a little before.
    assert np.linalg.norm(truth.p_WE[-1] - log.p_WE[-1]) < 5e-3
    assert "following" in truth.event


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tabletop_box", "moving_obstacle"])
def test_a_scenario_ends_as_in_one_process(name: str) -> None:
    both = Lockstep(name, images=True, log=True)
    log = run(both)
    assert log.ended == MotionEnd.GOAL
    report = motion_report(both.scenario, station_log(both.scenario, both.station))
    assert report["contacts"] == []
    assert report["goal_error"] < 5e-3
    # In one process 0.162 and 0.166 m: images are 80 ms later here.
    assert report["robot_clearance_min"] > 0.14


def test_what_is_of_the_simulated_world_is_refused() -> None:
    url = "memq://"
    with pytest.raises(ScenarioError, match="!GroundTruth does not see"):
        hardware_scenario(load_scenario("tabletop_box", ["perception=!GroundTruth {}"]), url)
    with pytest.raises(ScenarioError, match="faults"):
        hardware_scenario(load_scenario("tabletop_box", ["faults=[!Push {}]"]), url)
    known = hardware_scenario(load_scenario("moving_obstacle"), url)
    assert known.obstacles == []
    known = hardware_scenario(load_scenario("tabletop_box"), url)
    names = [one.add_model.name for one in known.directives if one.add_model]
    assert names == ["table", "camera_mount"]


def test_a_camera_that_is_not_where_it_should_be_is_told() -> None:
    table = TablePlane()
    seen = ObstacleClouds(stamp=0.0, table=TablePlane(offset=0.01))
    check_table(seen, table)
    check_table(ObstacleClouds(), None)
    with pytest.raises(HardwareError, match=r"\+20 mm from where it is"):
        check_table(ObstacleClouds(stamp=0.0, table=TablePlane(offset=0.02)), table)
    tilted = TablePlane(normal_W=np.array([0.0, np.sin(0.05), np.cos(0.05)]))
    with pytest.raises(HardwareError, match=r"tilted by 2\.9 deg"):
        check_table(ObstacleClouds(stamp=0.0, table=tilted), table)
    with pytest.raises(HardwareError, match="does not see the table: no valid pixel"):
        check_table(ObstacleClouds(note="no valid pixel"), table)


COMMAND = [sys.executable, "-m", "drake_oa.app.main"]
# Slowly, so that whatever else this machine does is no matter.
RATE = ["--rate", "0.25"]


def popen(*words: str) -> subprocess.Popen[str]:
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [*COMMAND, *words], stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGKILL])
def test_the_arm_slows_down_when_who_decides_is_ended(kind: int, tmp_path: Path) -> None:
    url = f"udpm://239.255.76.99:{7680 + kind}?ttl=0&recv_buf_size=4000000"
    truth, sent = tmp_path / "truth.npz", tmp_path / "sent.npz"
    arm = popen("station", "tabletop_box", "--lcm-url", url, *RATE, "--wait", "--log", str(truth))
    words = ["run", "tabletop_box", "--lcm-url", url, *RATE, "--hardware", "--log", str(sent)]
    driver = popen(*words)
    lcm, got = DrakeLcm(url), list[bytes]()
    lcm.Subscribe(STATUS_CHANNEL, got.append)
    try:
        deadline = time.monotonic() + 120.0
        while time.monotonic() < deadline:
            lcm.HandleSubscriptions(100)
            if got and np.abs(lcmt_panda_status.decode(got[-1]).joint_velocity).max() > 0.05:
                break
        if kind == signal.SIGKILL:
            # Its player is left alone.
            driver.kill()
        else:
            os.killpg(driver.pid, kind)
        _, told = driver.communicate(timeout=60.0)
        _, said = arm.communicate(timeout=60.0)
    finally:
        arm.kill()
        driver.kill()
    assert "Traceback" not in told
    assert "no command for 0.1 s" in said
    (log,) = load_logs(truth).values()
    fast = np.abs(log.v[:, :7]).max(axis=1)
    assert fast.max() > 0.2
    assert fast[-1] < 0.01
    # Not at once: from full speed in the lead, at a quarter of the rate, or slower.
    assert np.abs(np.diff(log.v[:, :7], axis=0)).max() / 0.004 < 40.0
    if kind == signal.SIGINT:
        assert driver.returncode == 130, told
        (log,) = load_logs(sent).values()
        assert log.ended == MotionEnd.INTERRUPTED
    else:
        assert "parent process ended" in told


def test_no_arm_is_told_in_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("drake_oa.hardware.robot_link.START_UP", 0.5)
    url = "udpm://239.255.76.99:7674?ttl=0"
    assert main(["run", "tabletop_box", "--hardware", "--lcm-url", url, "--no-log"]) == 1
    said = capsys.readouterr().err
    assert "no status" in said
    assert f"({url})" in said
    assert main(["run", "tabletop_box", "--rate", "0.5"]) == 2
