"""The player, before a simulated station: what it plays, and when it stops."""

from typing import Any

import numpy as np
import pytest
from drake import lcmt_panda_command, lcmt_panda_status
from pydrake.manipulation import PandaControlMode

from drake_oa.hardware.command_streamer import (
    COMMAND_CHANNEL,
    SILENCE,
    STATUS_CHANNEL,
)
from drake_oa.hardware.hardware_station import arm_of
from drake_oa.hardware.robot_link import HardwareError
from tests.hardware.lockstep import EPOCH, Lockstep, joints


def ready(both: Lockstep) -> np.ndarray:
    assert both.scenario.robot is not None
    _, limits = arm_of(both.scenario)
    return both.link.ready_arm(joints(both.station), limits)


def move(both: Lockstep, q: np.ndarray, duration: float, begin: float = 0.0) -> np.ndarray:
    """A smooth motion of all joints by up to 0.3 rad; returns where it ends."""
    goal = q + np.linspace(-0.3, 0.3, 7)
    for t in np.arange(begin, duration, 0.004):
        s = t / duration
        both.link.write(t, q + (goal - q) * s**3 * (10 - 15 * s + 6 * s**2))
    return goal


def test_the_arm_does_what_is_written_and_comes_to_rest_at_its_end() -> None:
    both = Lockstep()
    q = ready(both)
    goal = move(both, q, 2.0)
    both.link.close()
    for _ in range(100):
        both.step()
    assert both.player.finished
    np.testing.assert_allclose(joints(both.station), goal, atol=2e-3)
    assert not any("refused" in event for event in both.station.guard.events)
    assert both.link.motion.farthest < 5e-3
    # Full speed all the way: the pace lacks only its ramp and the lead.
    assert both.clock.now - EPOCH < 2.0 + 0.2 + 0.5 + 2 * SILENCE


def test_an_arm_that_was_moved_since_it_was_looked_at_is_not_driven() -> None:
    both = Lockstep()
    q = ready(both)
    with pytest.raises(HardwareError, match=r"0\.05 rad from where it was left"):
        move(both, q + 0.05, 2.0)
    assert not both.station.guard.events


@pytest.mark.parametrize(
    ("spoil", "why"),
    [
        ({"robot_mode": lcmt_panda_status.kUserStopped}, "stopped by its user"),
        ({"control_mode": int(PandaControlMode.kTorque)}, "does not take positions"),
        ({"utime": round(1e6 * (EPOCH - 5.0))}, "are both clocks set alike"),
        ({"joint_velocity": [0.2] * 7}, "moves at 0.2 rad/s; the arm has to rest"),
        ({"joint_position": [np.nan] * 7}, "hold no 7 finite positions"),
    ],
)
def test_a_status_that_does_not_fit_is_told(spoil: dict[str, Any], why: str) -> None:
    both = Lockstep()
    status, both.alive = both.station.status(both.clock.now), False

    def send() -> None:
        status.utime = round(1e6 * both.clock.now)
        for name, value in spoil.items():
            setattr(status, name, value)
        both.lcm.Publish(STATUS_CHANNEL, status.encode())

    both.each = send
    with pytest.raises(HardwareError, match=why):
        ready(both)


def test_where_nothing_more_is_written_the_arm_slows_along_it_and_waits() -> None:
    both = Lockstep()
    q = ready(both)
    for t in np.arange(0.0, 0.6, 0.004):
        both.link.write(t, q + 0.5 * t)
    last, speeds = joints(both.station), []
    for _ in range(300):
        both.step()
        speeds.append(np.abs(joints(both.station) - last).max() / 0.002)
        last = joints(both.station)
    np.testing.assert_allclose(joints(both.station), q + 0.5 * 0.596, atol=2e-3)
    assert speeds[-1] < 1e-3
    # No faster than it was, and no jump: 0.5 rad/s end within the lead, not at once.
    assert max(speeds) < 0.6
    assert np.abs(np.diff(speeds)).max() / 0.002 < 40.0
    assert both.station.guard.events[-1] == "following"
    both.link.write(0.6, q + 0.3)
    assert both.link.motion.note == ""


def test_holds_while_statuses_are_lost_and_goes_on_where_it_was() -> None:
    both = Lockstep()
    q = ready(both)
    seen: list[str] = []

    def each() -> None:
        both.statuses.lost = 1.0 < both.clock.now - EPOCH < 1.25
        seen.append(both.link.motion.note)

    both.each = each
    goal = move(both, q, 2.0)
    both.link.close()
    for _ in range(200):
        both.step()
    np.testing.assert_allclose(joints(both.station), goal, atol=2e-3)
    silent = "no status on PANDA_STATUS for 0.1 s"
    assert 50 < seen.count(silent) < 100
    assert [note for _, note in both.link.events] == [f"arm holds: {silent}", "arm resumed"]


def test_stops_when_somebody_else_commands() -> None:
    both = Lockstep()
    q = ready(both)
    other = lcmt_panda_command()
    other.utime = round(1e6 * EPOCH)
    both.each = lambda: (
        both.lcm.Publish(COMMAND_CHANNEL, other.encode()) if both.clock.now - EPOCH > 1.0 else None
    )
    with pytest.raises(HardwareError, match="somebody else commands on PANDA_COMMAND"):
        move(both, q, 2.0)


def test_does_not_begin_while_the_arm_may_not_be_moved() -> None:
    both = Lockstep()
    assert both.scenario.robot is not None
    _, limits = arm_of(both.scenario)
    with pytest.raises(HardwareError, match="move the arm to"):
        both.link.ready_arm(joints(both.station) + 0.2, limits)
    low = limits.position_lower.copy()
    low[3] = -1.0
    with pytest.raises(HardwareError, match=r"joint4 at .* out of"):
        both.link.ready_arm(
            joints(both.station), type(limits)(**{**vars(limits), "position_lower": low})
        )
