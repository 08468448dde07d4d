"""What a commanded position must be for the arm to follow it."""

import numpy as np
import pytest
from drake import lcmt_panda_command

from drake_oa.hardware.command_streamer import CommandValidator
from drake_oa.robot.plant import RobotLimits

N, PERIOD, START = 7, 0.005, 1000.0
LIMITS = RobotLimits(
    position_name=tuple(f"joint{i}" for i in range(N)),
    position_lower=np.full(N, -2.0),
    position_upper=np.full(N, 2.0),
    velocity_limit=np.full(N, 2.0),
)


def guard() -> CommandValidator:
    return CommandValidator(np.zeros(N), LIMITS)


def command(q: float, now: float, **fields: object) -> lcmt_panda_command:
    message = lcmt_panda_command()
    message.utime = round(1e6 * now)
    message.num_joint_position, message.joint_position = N, [q] * N
    message.control_mode_expected = 1
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def moving(moved: CommandValidator, steps: int = 20) -> tuple[float, float]:
    """Follows a joint speed of 1 rad/s; returns time and position."""
    for k in range(steps):
        now = START + k * PERIOD
        assert moved.receive(command(k * PERIOD, now), now)
    return START + (steps - 1) * PERIOD, (steps - 1) * PERIOD


def test_holds_when_commands_end_and_goes_on_when_they_come_back() -> None:
    lost = guard()
    now, q = moving(lost)
    positions, speeds = lost.desired(now + 0.11)
    np.testing.assert_allclose(positions, q)
    np.testing.assert_array_equal(speeds, 0.0)
    assert "no command for 0.1 s" in lost.events[-1]
    assert lost.receive(command(q, now + 1.0), now + 1.0)
    assert not lost.holding


@pytest.mark.parametrize(
    ("q", "fields", "why"),
    [
        (0.5, {}, "joint0 jumps by"),
        (0.1, {"joint_position": [2.5] * N}, "joint0 at 2.5 rad is out of [-2, 2]"),
        (0.1, {"joint_position": [np.nan] * N}, "joint0 at nan rad is out of [-2, 2]"),
        (0.1, {"control_mode_expected": 4}, "not 7 positions in position mode"),
        (0.1, {"num_joint_torque": N, "joint_torque": [0.0] * N}, "not 7 positions"),
        (0.1, {"utime": round(1e6 * (START + 0.09))}, "a second commander: its stamp is 5.0 ms"),
    ],
)
def test_a_command_that_is_not_in_order_is_ignored(
    q: float, fields: dict[str, object], why: str
) -> None:
    kept = guard()
    now, before = moving(kept)
    now += PERIOD
    assert not kept.receive(command(q, now, **fields), now)
    np.testing.assert_allclose(kept.desired(now)[0], before)
    assert f"refused: {why}" in kept.events[-1]
    assert kept.receive(command(before, now), now)


@pytest.mark.parametrize("shift", [-1.0, -0.2, 0.2, 1e9])
def test_passes_over_what_is_not_of_now(shift: float) -> None:
    fresh = guard()
    assert not fresh.receive(command(0.0, START + shift), START)
    assert fresh.holding
    assert "before the wall clock" in fresh.events[-1]
