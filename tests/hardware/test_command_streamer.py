"""CommandStreamer with a simulated station: motion, pauses, and failures that stop it."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drake import lcmt_panda_command, lcmt_panda_status
from pydrake.manipulation import PandaControlMode

from drake_oa.hardware.command_streamer import COMMAND_CHANNEL, STATUS_CHANNEL, STATUS_TIMEOUT
from drake_oa.hardware.hardware_station import arm_of
from drake_oa.hardware.robot_link import HardwareError
from tests.hardware.lockstep import EPOCH, Lockstep, joints


@pytest.fixture
def lockstep() -> Lockstep:
    """Simulation of `tabletop_box` at its start."""
    return Lockstep()


def ready(lockstep: Lockstep) -> np.ndarray:
    """Waits until the arm can start at its present positions; returns them (7,) [rad]."""
    assert lockstep.scenario.robot is not None
    _, limits = arm_of(lockstep.scenario)
    return lockstep.link.ready_arm(joints(lockstep.station), limits)


def move(lockstep: Lockstep, q: np.ndarray, duration: float, begin: float = 0.0) -> np.ndarray:
    """Writes a smooth motion of all joints by up to 0.3 rad; returns its end (7,) [rad]."""
    goal = q + np.linspace(-0.3, 0.3, 7)
    for t in np.arange(begin, duration, 0.004):
        s = t / duration
        lockstep.link.write(t, q + (goal - q) * s**3 * (10 - 15 * s + 6 * s**2))
    return goal


def test_arm_follows_the_written_positions_and_rests_at_their_end(lockstep: Lockstep) -> None:
    q = ready(lockstep)
    goal = move(lockstep, q, 2.0)
    lockstep.link.close()
    for _ in range(100):
        lockstep.step()
    assert lockstep.streamer.is_finished
    np.testing.assert_allclose(joints(lockstep.station), goal, atol=2e-3)
    assert not any("rejected" in event for event in lockstep.station.validator.events)
    assert lockstep.link.trajectory.max_tracking_error < 5e-3
    # The pace is full from the first command on.
    assert lockstep.clock.now - EPOCH < 2.0 + 0.2 + 2 * STATUS_TIMEOUT


def test_arm_moved_after_the_check_is_not_commanded(lockstep: Lockstep) -> None:
    q = ready(lockstep)
    with pytest.raises(HardwareError, match=r"0\.05 rad from its planned position"):
        move(lockstep, q + 0.05, 2.0)
    assert not lockstep.station.validator.events


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"robot_mode": lcmt_panda_status.kUserStopped}, "stopped by its user"),
        ({"control_mode": int(PandaControlMode.kTorque)}, "does not follow positions"),
        ({"utime": round(1e6 * (EPOCH - 5.0))}, "synchronize the clocks"),
        ({"joint_velocity": [0.2] * 7}, "moves at 0.2 rad/s; the arm must be at rest"),
        ({"joint_position": [np.nan] * 7}, "must hold 7 finite positions"),
    ],
)
def test_error_of_an_invalid_status_names_the_problem(
    lockstep: Lockstep, changes: dict[str, Any], reason: str
) -> None:
    status, lockstep.station_runs = lockstep.station.status(lockstep.clock.now), False

    def send() -> None:
        """Publishes the changed status."""
        status.utime = round(1e6 * lockstep.clock.now)
        for name, value in changes.items():
            setattr(status, name, value)
        lockstep.lcm.Publish(STATUS_CHANNEL, status.encode())

    lockstep.before_step = send
    with pytest.raises(HardwareError, match=reason):
        ready(lockstep)


def test_arm_slows_down_and_waits_at_the_end_of_the_written_positions(lockstep: Lockstep) -> None:
    q = ready(lockstep)
    for t in np.arange(0.0, 0.6, 0.004):
        lockstep.link.write(t, q + 0.5 * t)
    last, speeds = joints(lockstep.station), []
    for _ in range(300):
        lockstep.step()
        speeds.append(np.abs(joints(lockstep.station) - last).max() / 0.002)
        last = joints(lockstep.station)
    np.testing.assert_allclose(joints(lockstep.station), q + 0.5 * 0.596, atol=2e-3)
    assert speeds[-1] < 1e-3
    # The arm does not accelerate, and decelerates from 0.5 rad/s within the lead, without a jump.
    assert max(speeds) < 0.6
    assert np.abs(np.diff(speeds)).max() / 0.002 < 40.0
    assert lockstep.station.validator.events[-1] == "following"
    lockstep.link.write(0.6, q + 0.3)
    assert lockstep.link.trajectory.note == ""


def test_arm_holds_while_statuses_are_lost_and_resumes(lockstep: Lockstep) -> None:
    q = ready(lockstep)
    notes: list[str] = []

    def before_step() -> None:
        lockstep.statuses.is_lossy = 1.0 < lockstep.clock.now - EPOCH < 1.25
        notes.append(lockstep.link.trajectory.note)

    lockstep.before_step = before_step
    goal = move(lockstep, q, 2.0)
    lockstep.link.close()
    for _ in range(200):
        lockstep.step()
    np.testing.assert_allclose(joints(lockstep.station), goal, atol=2e-3)
    silent = "no status on PANDA_STATUS for 0.1 s"
    assert 50 < notes.count(silent) < 100
    assert [note for _, note in lockstep.link.events] == [f"arm holds: {silent}", "arm resumed"]


def test_arm_stops_for_another_command_source(lockstep: Lockstep) -> None:
    q = ready(lockstep)
    other = lcmt_panda_command()
    other.utime = round(1e6 * EPOCH)
    lockstep.before_step = lambda: (
        lockstep.lcm.Publish(COMMAND_CHANNEL, other.encode())
        if lockstep.clock.now - EPOCH > 1.0
        else None
    )
    with pytest.raises(HardwareError, match="another command source sends on PANDA_COMMAND"):
        move(lockstep, q, 2.0)


def test_motion_does_not_start_away_from_its_start_or_beyond_limits(lockstep: Lockstep) -> None:
    assert lockstep.scenario.robot is not None
    _, limits = arm_of(lockstep.scenario)
    with pytest.raises(HardwareError, match="move the arm to"):
        lockstep.link.ready_arm(joints(lockstep.station) + 0.2, limits)
    low = limits.position_lower.copy()
    low[3] = -1.0
    with pytest.raises(HardwareError, match=r"joint4 at .* outside"):
        lockstep.link.ready_arm(joints(lockstep.station), replace(limits, position_lower=low))
