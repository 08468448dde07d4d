"""Commands of joint positions: sent from a planned motion, and checked before the arm follows.

Decisions may need longer than the arm can wait: the diagram writes the planned joint positions
into shared memory, a little ahead, and a `CommandStreamer` in a process of its own sends commands
from there at its own rate. Where the planned motion ends the player slows along it and waits; it
never extrapolates. On the arm's side a `CommandValidator` checks each command; it does not use LCM.
"""

import ctypes
import gc
import logging
import math
import multiprocessing
import os
import signal
import time
from collections import deque
from contextlib import suppress

import numpy as np
from drake import lcmt_panda_command, lcmt_panda_status
from pydrake.lcm import DrakeLcm
from pydrake.manipulation import PandaControlMode

from drake_oa.common.messages import FloatArray
from drake_oa.robot.plant import RobotLimits

STATUS_CHANNEL, COMMAND_CHANNEL = "PANDA_STATUS", "PANDA_COMMAND"
"""LCM channels of the arm."""
ARM_JOINTS = 7
"""Number of joints in messages."""
POSITION_MODE = int(PandaControlMode.kPosition)
"""Control mode of commands and statuses in messages: joint positions."""
MICROSECOND = 1e-6
"""Unit of stamps in messages [s]."""

_logger = logging.getLogger("drake_oa")

_NOT_FREE = {
    lcmt_panda_status.kGuiding: "being guided by hand",
    lcmt_panda_status.kReflex: "stopped by a reflex",
    lcmt_panda_status.kUserStopped: "stopped by its user",
    lcmt_panda_status.kAutomaticErrorRecovery: "recovering from an error",
}
"""Modes of the arm in which it cannot be driven."""

_ROWS = 4096
"""Capacity of the shared buffers of planned and measured positions."""
_NOTE = 400
"""Size of the longest note [byte]."""
_REMEMBERED = 400
"""Number of sent commands that are compared with received commands and statuses."""


COMMAND_PERIOD = 0.004
"""Time between two commands [s]."""
LEAD = 0.04
"""Time by which the motion is computed ahead of its commands [s]: tolerates pauses of the
simulation of up to half of it."""
_RAMP = 0.15
"""Time from rest to full speed, and from full speed to rest after a failure [s]."""
SILENCE = 0.1
"""Time without a status message after which the arm is held and simulated time stops [s]."""
_PATIENCE = 0.3
"""Further time without a status message after which the run stops [s]."""
_RESTART_TOLERANCE = 0.03
"""Maximum distance of a joint from its command when the motion resumes from rest [rad]."""
_ASTRAY, _ASTRAY_TIME = 0.1, 0.2
"""Distance of a joint from all commands of a period that stops the run [rad], and period [s]."""
EXPIRY = 0.1
"""Time for which the arm follows a command, and maximum difference of its stamp from the wall clock
[s]. The vendor's driver has the same."""
SPEED_SHARE = 1.2
"""Maximum speed between two accepted commands, relative to the joint's limit [1]."""
SLACK = 0.01
"""Additional joint displacement allowed between two accepted commands [rad]."""


def beyond_limits(q: FloatArray, limits: RobotLimits) -> str:
    """Returns a message about the first of the positions (n,) beyond its limits; "" if none is."""
    lower, upper = limits.position_lower, limits.position_upper
    for name, value, low, high in zip(limits.position_name, q, lower, upper, strict=True):
        if not low <= value <= high:
            return f"{name} at {value:.4g} rad is out of [{low:.4g}, {high:.4g}]"
    return ""


class SharedTrajectory(ctypes.Structure):
    """Memory shared by the diagram and the player: planned and measured motion, and progress.

    Each field has one writer. Rows are written before they are counted.

    Attributes:
        stopped: 1 once the player has stopped for good.
        played: simulated time that the arm is at [s].
        end: 1 once the player is to end.
        farthest: greatest distance of a joint from its commands [rad].
    """

    _fields_ = (
        ("_planned", ctypes.c_double * (1 + ARM_JOINTS) * _ROWS),
        ("_planned_count", ctypes.c_int64),
        ("_measured", ctypes.c_double * (2 * ARM_JOINTS) * _ROWS),
        ("_measured_count", ctypes.c_int64),
        ("_note", ctypes.c_char * _NOTE),
        ("stopped", ctypes.c_double),
        ("played", ctypes.c_double),
        ("end", ctypes.c_double),
        ("farthest", ctypes.c_double),
    )

    def write_planned(self, t: float, q: FloatArray) -> None:
        """Adds the planned positions of the joints (7,) at a simulated time [s, rad]."""
        self._planned[self._planned_count % _ROWS][:] = [t, *q]
        self._planned_count += 1

    def write_measured(self, q: FloatArray, v: FloatArray) -> None:
        """Adds positions and speeds of the joints (7,) in a status [rad, rad/s]."""
        self._measured[self._measured_count % _ROWS][:] = [*q, *v]
        self._measured_count += 1

    @property
    def planned_until(self) -> float:
        """Simulated time of the last planned positions; -inf before the first [s]."""
        count = self._planned_count
        return float(self._planned[(count - 1) % _ROWS][0]) if count else -math.inf

    def planned(self, t: float) -> FloatArray:
        """Returns the planned positions (7,) at a simulated time that was written [rad]."""
        count = self._planned_count
        latest = np.arange(max(0, count - _ROWS // 2), count) % _ROWS
        times, *joints = np.ctypeslib.as_array(self._planned)[latest].T
        return np.array([np.interp(t, times, joint) for joint in joints])

    @property
    def measured(self) -> tuple[FloatArray, FloatArray]:
        """Positions and speeds (7,) in the last status; NaN before the first [rad, rad/s]."""
        count, row = self._measured_count, np.full(2 * ARM_JOINTS, np.nan)
        if count:
            row[:] = self._measured[(count - 1) % _ROWS]
        return row[:ARM_JOINTS], row[ARM_JOINTS:]

    @property
    def note(self) -> str:
        """Reason for which the arm is stopped or held; "" if it is not."""
        return bytes(self._note).decode(errors="replace")

    @note.setter
    def note(self, note: str) -> None:
        self._note = note.encode()[: _NOTE - 1]


def shared_trajectory() -> SharedTrajectory:
    """Allocates the memory, without any row."""
    return multiprocessing.get_context("spawn").RawValue(SharedTrajectory)


class _StoppedError(Exception):
    """A condition that stops the arm for good; the message says why."""


class CommandStreamer:
    """Commands the positions in a `SharedTrajectory`, monitors the arm, and stops it where necessary.

    Simulated time is played at `rate` seconds in one of the wall clock, more slowly where less
    than half of `LEAD` is written, and not at all where the arm is silent, astray or
    commanded by somebody else.
    """

    def __init__(self, motion: SharedTrajectory, lcm: DrakeLcm, rate: float) -> None:
        """Subscribes to statuses and commands.

        Args:
            motion: shared with the diagram.
            lcm: the bus of the messages.
            rate: simulated seconds in one of the wall clock, at most.
        """
        self._motion, self._lcm, self._rate = motion, lcm, rate
        # Speed of simulated time, and when each was last: a status, a step, each by a clock that
        # is never set.
        self._pace, self._heard, self._stepped = 0.0, -math.inf, -math.inf
        self._rejected = "no status has come"
        self._sent: deque[tuple[float, int, FloatArray]] = deque(maxlen=_REMEMBERED)
        self._statuses: list[bytes] = []
        self._commands: list[bytes] = []
        lcm.Subscribe(STATUS_CHANNEL, self._statuses.append)
        lcm.Subscribe(COMMAND_CHANNEL, self._commands.append)

    @property
    def finished(self) -> bool:
        """True if it was told to end, and the arm is at rest as far as it is commanded."""
        motion = self._motion
        rests = self._pace < 1e-3 or motion.planned_until <= motion.played
        return bool(motion.end and (motion.stopped or rests))

    def step(self, now: float, tick: float | None = None) -> None:
        """Handles received messages, and sends the next command.

        Args:
            now: the wall clock, which may be set [s].
            tick: a clock that is never set [s]; None: the wall clock is not.
        """
        try:
            self._step(now, now if tick is None else tick)
        except _StoppedError as error:
            self._motion.note, self._motion.stopped = str(error), 1.0
            _logger.warning("stopped: %s", error)

    def _step(self, now: float, tick: float) -> None:
        motion = self._motion
        while self._lcm.HandleSubscriptions(0):
            pass
        if motion.stopped:
            return
        self._check_status(now, tick)
        self._check_commands()
        silence = tick - self._heard
        trouble = self._rejected if silence > SILENCE else ""
        if SILENCE + _PATIENCE < silence < math.inf:
            raise _StoppedError(trouble)
        if trouble != motion.note:
            motion.note = trouble
            if self._sent:
                _logger.warning("holding: %s" if trouble else "resumed%s", trouble)
        elapsed, self._stepped = tick - self._stepped, tick
        if motion.planned_until == -math.inf or (trouble and not self._sent):
            return
        if elapsed > SILENCE:
            # By now the arm holds.
            self._pace = 0.0
        if self._pace == 0.0 and not trouble:
            off = float(np.abs(motion.measured[0] - motion.planned(motion.played)).max())
            if off > _RESTART_TOLERANCE:
                raise _StoppedError(f"the arm is {off:.3g} rad from where it was left")
        elapsed = min(elapsed, 3.0 * COMMAND_PERIOD)
        lead = motion.planned_until - motion.played
        change = self._rate * elapsed / _RAMP
        slows = trouble or motion.end > 0.0
        pace = max(0.0, self._pace - change) if slows else self._pace + change
        self._pace = min(pace, self._rate * min(1.0, max(0.0, lead / (0.5 * LEAD))))
        motion.played = min(motion.played + self._pace * elapsed, motion.planned_until)
        q = motion.planned(motion.played)
        message = lcmt_panda_command()
        message.utime = round(now / MICROSECOND)
        message.control_mode_expected = POSITION_MODE
        message.num_joint_position, message.joint_position = ARM_JOINTS, list(q)
        self._sent.append((now, message.utime, q))
        self._lcm.Publish(COMMAND_CHANNEL, message.encode())

    def _check_status(self, now: float, tick: float) -> None:
        # Handlers may not raise: messages are decoded here. The last one counts.
        data, self._statuses[:] = self._statuses[-1:], []
        if not data:
            return
        try:
            status = lcmt_panda_status.decode(data[0])
            q, v = np.array([status.joint_position, status.joint_velocity])
            age = now - MICROSECOND * status.utime
            if q.shape != (ARM_JOINTS,) or not np.isfinite([q, v]).all():
                raise ValueError(f"statuses hold no {ARM_JOINTS} finite positions and speeds")
            if abs(age) > SILENCE:
                raise ValueError(
                    f"statuses are {age:.3f} s old by this clock, at most {SILENCE:g} "
                    "may be: are both clocks set alike?"
                )
        except Exception as error:
            self._rejected = f"{STATUS_CHANNEL}: {error}"
            return
        self._heard, self._rejected = tick, f"no status on {STATUS_CHANNEL} for {SILENCE:g} s"
        if status.robot_mode in _NOT_FREE:
            name = _NOT_FREE[status.robot_mode]
            raise _StoppedError(f"the arm is {name}; it has to be free to move")
        # Zero is the mode of a driver that does not state it.
        if status.control_mode not in (0, POSITION_MODE):
            raise _StoppedError("the arm does not take positions; start it in position mode")
        self._motion.write_measured(q, v)
        stamp = now - age
        recent = [at for when, _, at in self._sent if stamp - _ASTRAY_TIME <= when <= stamp]
        if not recent:
            return
        off = float(np.abs(np.array(recent) - q).max(axis=1).min())
        self._motion.farthest = max(self._motion.farthest, off)
        if off > _ASTRAY:
            raise _StoppedError(f"the arm is {off:.3g} rad from where it was sent")

    def _check_commands(self) -> None:
        own = {utime for _, utime, _ in self._sent}
        received, self._commands[:] = self._commands[:], []
        for data in received:
            with suppress(Exception):
                if lcmt_panda_command.decode(data).utime in own:
                    continue
            raise _StoppedError(f"somebody else commands on {COMMAND_CHANNEL}")


def stream_commands(motion: SharedTrajectory, lcm_url: str, rate: float, parent: int) -> None:
    """Streams commands until told to stop or until the parent process ends.

    Args:
        motion: shared with the parent process.
        lcm_url: of the bus.
        rate: simulated seconds in one of the wall clock, at most.
        parent: process that computes the motion.
    """
    # A signal to the whole group would stop the arm at full speed.
    for kind in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(kind, signal.SIG_IGN)
    logging.basicConfig(format="%(levelname)s: arm: %(message)s")
    gc.disable()
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, -10)
    player = CommandStreamer(motion, DrakeLcm(lcm_url), rate)
    due = time.monotonic()
    while not player.finished:
        if os.getppid() != parent and not motion.end:
            _logger.warning("parent process ended: stopping the arm")
            motion.end = 1.0
        player.step(time.time(), time.monotonic())
        due = max(due + COMMAND_PERIOD, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))


class CommandValidator:
    """Follows one commander, and holds where there is none, or more than one.

    Commands that are old, out of limits, that jump, or of another mode are ignored. Where none is
    accepted for `EXPIRY` the arm holds the last position, and goes on from there.

    Attributes:
        events: message whenever its behavior changed.
    """

    def __init__(self, q: FloatArray, limits: RobotLimits) -> None:
        """Holds.

        Args:
            q: (n,) positions of the arm [rad].
            limits: of its joints, in the same order.
        """
        self._q = np.array(q, dtype=float)
        self._v = np.zeros_like(self._q)
        self._limits = limits
        self._accepted = -np.inf
        self._stamp: int | None = None
        self.events: list[str] = []

    def receive(self, command: lcmt_panda_command, now: float) -> bool:
        """Checks a command at a time of the wall clock [s]; returns whether the arm follows it."""
        self._update(now)
        if why := self._problem(command, now):
            self._log(f"command refused: {why}")
            return False
        q = np.array(command.joint_position)
        if self._stamp is None:
            self._log("following")
            self._v[:] = 0.0
        else:
            self._v = (q - self._q) / (MICROSECOND * (command.utime - self._stamp))
        self._q, self._stamp, self._accepted = q, command.utime, now
        return True

    def desired(self, now: float) -> tuple[FloatArray, FloatArray]:
        """Returns desired positions [rad] and speeds [rad/s], (n,) each, at a time [s]."""
        self._update(now)
        return self._q, self._v

    @property
    def holding(self) -> bool:
        """True if no command is followed."""
        return self._stamp is None

    def _update(self, now: float) -> None:
        """Holds when the last command has expired."""
        if self._stamp is not None and now - self._accepted > EXPIRY:
            self._v, self._stamp = np.zeros_like(self._q), None
            self._log(f"holding: no command for {EXPIRY:g} s")

    def _problem(self, command: lcmt_panda_command, now: float) -> str:
        n, limits, elapsed = len(self._q), self._limits, 0.0
        age = now - MICROSECOND * command.utime
        if abs(age) > EXPIRY:
            return f"its stamp is {age:.3f} s before the wall clock"
        sizes = (command.num_joint_position, command.num_joint_velocity, command.num_joint_torque)
        if sizes != (n, 0, 0) or command.control_mode_expected != POSITION_MODE:
            return f"not {n} positions in position mode"
        if self._stamp is not None:
            elapsed = MICROSECOND * (command.utime - self._stamp)
            if elapsed <= 0.0:
                return f"a second commander: its stamp is {-1e3 * elapsed:.1f} ms before the last"
        q = np.array(command.joint_position)
        if beyond := beyond_limits(q, limits):
            return beyond
        step = np.abs(q - self._q)
        allowed = SLACK + SPEED_SHARE * elapsed * limits.velocity_limit
        j = int(np.argmax(step - allowed))
        if step[j] <= allowed[j]:
            return ""
        name = limits.position_name[j]
        return f"{name} jumps by {step[j]:.3g} rad, {allowed[j]:.3g} are possible"

    def _log(self, event: str) -> None:
        """Adds an event, unless it differs from the last one in numbers only."""
        if not self.events or self.events[-1].split(" is ")[0] != event.split(" is ")[0]:
            self.events.append(event)
            _logger.warning("station: %s", event)
