"""Connection to a Panda by the LCM messages of Drake."""

from __future__ import annotations

from collections import deque
from contextlib import suppress

import numpy as np
from drake import lcmt_panda_command, lcmt_panda_status
from pydrake.lcm import DrakeLcm

from drake_oa.common.messages import FloatArray
from drake_oa.hardware.command_streamer import (
    ARM_JOINTS,
    COMMAND_CHANNEL,
    COMMAND_PERIOD,
    MICROSECOND,
    POSITION_MODE,
    STATUS_CHANNEL,
    STATUS_TIMEOUT,
    ArmStatus,
    ArmStoppedError,
    SharedTrajectory,
)

_BLOCKED_MODES = {
    lcmt_panda_status.kGuiding: "being guided by hand",
    lcmt_panda_status.kReflex: "stopped by a reflex",
    lcmt_panda_status.kUserStopped: "stopped by its user",
    lcmt_panda_status.kAutomaticErrorRecovery: "recovering from an error",
}
"""Robot modes of a Panda in which the arm does not follow commands: number of the mode in a status
message -> description for messages."""
_SENT_COUNT = 400
"""Number of recently sent commands that are compared with received commands."""


def connect_lcm(url: str, trajectory: SharedTrajectory) -> LcmArm:
    """Connects to the arm on the LCM bus of a URL; the trajectory is not used."""
    return LcmArm(DrakeLcm(url))


class LcmArm:
    """Connection to a Panda whose driver exchanges LCM messages.

    Attributes:
        name: name of the LCM channel of the statuses.
        period: wall time between two commands [s].
    """

    name, period = STATUS_CHANNEL, COMMAND_PERIOD

    def __init__(self, lcm: DrakeLcm) -> None:
        """Subscribes to the statuses of the arm and to the commands on an LCM bus."""
        self._lcm = lcm
        self._sent: deque[int] = deque(maxlen=_SENT_COUNT)
        self._statuses: list[bytes] = []
        self._commands: list[bytes] = []
        lcm.Subscribe(STATUS_CHANNEL, self._statuses.append)
        lcm.Subscribe(COMMAND_CHANNEL, self._commands.append)

    def receive(self, now: float) -> ArmStatus | None:
        """Returns the newest status of the arm; None if none was received since the last call.

        Args:
            now: time of the wall clock [s].

        Raises:
            ValueError: for a status that is too old or does not describe a Panda.
            ArmStoppedError: if the arm does not follow commands, or has another command source.
        """
        while self._lcm.HandleSubscriptions(0):
            pass
        self._check_commands()
        # LCM handlers must not raise: messages are decoded here. Earlier statuses are ignored.
        data, self._statuses[:] = self._statuses[-1:], []
        if not data:
            return None
        try:
            status = lcmt_panda_status.decode(data[0])
            q, v = np.array([status.joint_position, status.joint_velocity])
            stamp = MICROSECOND * status.utime
            if q.shape != (ARM_JOINTS,) or not np.isfinite([q, v]).all():
                raise ValueError(f"statuses must hold {ARM_JOINTS} finite positions and velocities")
            if abs(now - stamp) > STATUS_TIMEOUT:
                raise ValueError(
                    f"statuses are {now - stamp:.3f} s old, at most {STATUS_TIMEOUT:g} allowed: "
                    "synchronize the clocks of both computers"
                )
        except Exception as error:
            raise ValueError(f"{STATUS_CHANNEL}: {error}") from None
        if status.robot_mode in _BLOCKED_MODES:
            name = _BLOCKED_MODES[status.robot_mode]
            raise ArmStoppedError(f"arm is {name}: enable motion before the run")
        # Zero is the control mode of a driver that does not report it.
        if status.control_mode not in (0, POSITION_MODE):
            raise ArmStoppedError(
                "arm does not follow positions: start its driver in position mode"
            )
        return ArmStatus(stamp, q, v)

    def send(self, now: float, q: FloatArray) -> None:
        """Commands the joint positions q (7,) [rad] at a time of the wall clock [s]."""
        message = lcmt_panda_command()
        message.utime = round(now / MICROSECOND)
        message.control_mode_expected = POSITION_MODE
        message.num_joint_position, message.joint_position = ARM_JOINTS, list(q)
        self._sent.append(message.utime)
        self._lcm.Publish(COMMAND_CHANNEL, message.encode())

    def close(self) -> None:
        """Sends nothing more: the driver of the arm holds the last position."""

    def _check_commands(self) -> None:
        """Checks that all received commands were sent by this connection.

        Raises:
            ArmStoppedError: if another command source has sent a command.
        """
        received, self._commands[:] = self._commands[:], []
        for data in received:
            with suppress(Exception):
                if lcmt_panda_command.decode(data).utime in self._sent:
                    continue
            raise ArmStoppedError(f"another command source sends on {COMMAND_CHANNEL}: end it")
