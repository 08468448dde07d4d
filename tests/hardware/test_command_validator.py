"""CommandValidator: valid and rejected commands of joint positions."""

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


@pytest.fixture
def validator() -> CommandValidator:
    """Returns a validator of an arm at zero positions."""
    return CommandValidator(np.zeros(N), LIMITS)


def command(q: float, now: float, **fields: object) -> lcmt_panda_command:
    """Returns a command of equal positions [rad], stamped now [s], with changed fields."""
    message = lcmt_panda_command()
    message.utime = round(1e6 * now)
    message.num_joint_position, message.joint_position = N, [q] * N
    message.control_mode_expected = 1
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def follow(validator: CommandValidator, steps: int = 20) -> tuple[float, float]:
    """Sends commands at a joint speed of 1 rad/s; returns time [s] and position [rad]."""
    for k in range(steps):
        now = START + k * PERIOD
        assert validator.receive(command(k * PERIOD, now), now)
    return START + (steps - 1) * PERIOD, (steps - 1) * PERIOD


def test_arm_holds_without_commands_and_follows_again_later(validator: CommandValidator) -> None:
    now, q = follow(validator)
    positions, speeds = validator.desired(now + 0.11)
    np.testing.assert_allclose(positions, q)
    np.testing.assert_array_equal(speeds, 0.0)
    assert "no command for 0.1 s" in validator.events[-1]
    assert validator.receive(command(q, now + 1.0), now + 1.0)
    assert not validator.is_holding


@pytest.mark.parametrize(
    ("q", "fields", "reason"),
    [
        (0.5, {}, "joint0 jumps by"),
        (0.1, {"joint_position": [2.5] * N}, "joint0 at 2.5 rad is outside [-2, 2]"),
        (0.1, {"joint_position": [np.nan] * N}, "joint0 at nan rad is outside [-2, 2]"),
        (0.1, {"control_mode_expected": 4}, "not 7 positions in position mode"),
        (0.1, {"num_joint_torque": N, "joint_torque": [0.0] * N}, "not 7 positions"),
        (
            0.1,
            {"utime": round(1e6 * (START + 0.09))},
            "a second command source: its stamp is 5.0 ms",
        ),
    ],
)
def test_invalid_command_is_rejected(
    validator: CommandValidator, q: float, fields: dict[str, object], reason: str
) -> None:
    now, before = follow(validator)
    now += PERIOD
    assert not validator.receive(command(q, now, **fields), now)
    np.testing.assert_allclose(validator.desired(now)[0], before)
    assert f"rejected: {reason}" in validator.events[-1]
    count = len(validator.events)
    assert not validator.receive(command(1.01 * q, now, **fields), now)
    assert len(validator.events) == count
    assert validator.receive(command(before, now), now)


@pytest.mark.parametrize("shift", [-1.0, -0.2, 0.2, 1e9])
def test_old_and_future_commands_are_rejected(validator: CommandValidator, shift: float) -> None:
    assert not validator.receive(command(0.0, START + shift), START)
    assert validator.is_holding
    assert "before the wall clock" in validator.events[-1]
