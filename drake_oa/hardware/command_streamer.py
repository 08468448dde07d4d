"""Streaming of joint position commands to an arm from memory shared between processes, and
validation of received commands.

A decision of the diagram may last longer than the period of commands. Therefore the diagram writes
the planned joint positions into shared memory, a little ahead of time. A `CommandStreamer` in a
separate process sends them as commands at a constant rate. Near the end of the written positions,
the streamer slows the motion down and waits; it never extrapolates. A `CommandValidator`, which
does not depend on LCM, checks each command before the simulated arm follows it.
"""

import ctypes
import gc
import logging
import math
import multiprocessing
import os
import re
import signal
import time
from collections import deque
from collections.abc import Callable
from contextlib import closing, suppress
from typing import Protocol

import numpy as np
from drake import lcmt_panda_command, lcmt_panda_status
from pydrake.lcm import DrakeLcm
from pydrake.manipulation import PandaControlMode

from drake_oa.common.messages import FloatArray
from drake_oa.robot.plant import RobotLimits

STATUS_CHANNEL, COMMAND_CHANNEL = "PANDA_STATUS", "PANDA_COMMAND"
"""Names of two LCM channels: the channel on which the arm sends its statuses, and the channel on
which it receives commands."""
ARM_JOINTS = 7
"""Number of arm joints in the LCM messages of a Panda; hardware runs require an arm with this
number of joints."""
POSITION_MODE = int(PandaControlMode.kPosition)
"""Control mode in the LCM messages of a Panda: the arm follows commanded joint positions."""
MICROSECOND = 1e-6
"""Unit of the time stamps in LCM messages [s]."""

_logger = logging.getLogger("drake_oa")
"""Logger of the package drake_oa, used for failures of the arm and for events of
`CommandValidator`."""

_BLOCKED_MODES = {
    lcmt_panda_status.kGuiding: "being guided by hand",
    lcmt_panda_status.kReflex: "stopped by a reflex",
    lcmt_panda_status.kUserStopped: "stopped by its user",
    lcmt_panda_status.kAutomaticErrorRecovery: "recovering from an error",
}
"""Robot modes of a Panda in which the arm does not follow commands: number of the mode in a status
message -> description for error messages."""
_ROWS = 4096
"""Number of rows in each of the two buffers of a `SharedTrajectory`, which store planned and
measured joint positions."""
_NOTE_SIZE = 400
"""Maximum size of the text `SharedTrajectory.note`, which states why the arm is stopped or holds
its position [byte]."""
_SENT_COUNT = 400
"""Number of recently sent commands that are stored, to compare them with received commands and
statuses."""


COMMAND_PERIOD = 0.004
"""Wall time between two commands to the arm [s]."""
LEAD = 0.04
"""Simulated time by which the diagram writes planned positions ahead of the commands that are sent
to the arm [s]. Pauses of the diagram that last up to half of this time do not slow down the arm."""
_RAMP = 0.15
"""Time in which the streamed motion accelerates to full speed after a hold, and decelerates to rest
if no valid status arrives or the end of the streamer is requested [s]."""
STATUS_TIMEOUT = 0.1
"""Time without a valid status of the arm after which the arm holds and simulated time pauses [s]. A
status that is older than this time on arrival is invalid."""
_STOP_TIMEOUT = 0.3
"""Time without a valid status of the arm, in addition to `STATUS_TIMEOUT`, after which the command
streamer stops the arm permanently [s]."""
_RESTART_TOLERANCE = 0.03
"""Maximum distance of each joint from its planned position at which the streamed motion may start
or resume from rest [rad]. At a larger distance something else has moved the arm, and the streamer
stops the arm permanently."""
_MAX_TRACKING_ERROR, _TRACKING_WINDOW = 0.1, 0.2
"""Maximum distance between the measured joint positions and the nearest recent command, as the
largest difference of any joint [rad], and maximum age of a recent command [s]. At a larger distance
the streamer stops the arm permanently."""
COMMAND_TIMEOUT = 0.1
"""Time after which a simulated arm no longer follows its last command, and maximum difference
between a command's stamp and the wall clock [s]. The driver of the arm's vendor uses an equal
value."""
MAX_SPEED_RATIO = 1.2
"""Maximum ratio of the speed between two commands to the speed limit of each joint [-]; faster
commands are rejected."""
STEP_TOLERANCE = 0.01
"""Displacement of each joint between two commands that is valid in addition to the displacement at
maximum speed [rad]."""


def beyond_limits(q: FloatArray, limits: RobotLimits) -> str:
    """Returns an error text that names the first joint whose position is outside its limits; "" if
    all joints are within their limits.

    Args:
        q: (n,) joint positions [rad].
        limits: limits of these joints, in the same order.
    """
    lower, upper = limits.position_lower, limits.position_upper
    for name, value, low, high in zip(limits.position_name, q, lower, upper, strict=True):
        if not low <= value <= high:
            return f"{name} at {value:.4g} rad is outside [{low:.4g}, {high:.4g}] rad"
    return ""


class SharedTrajectory(ctypes.Structure):
    """Memory that the diagram and the command streamer share: planned and measured joint positions,
    and the progress of the motion.

    The two processes access the memory without locks: each field has one writer, except for
    `end_requested`, which is only ever set; a row is written before the count of rows increases.

    Attributes:
        is_stopped: 1 after the streamer has stopped the arm permanently, otherwise 0.
        executed_time: simulated time of the last command that was sent to the arm [s].
        end_requested: 1 if the streamer must bring the arm to rest and end. The diagram sets the
            value; the streamer sets it if its parent process has ended.
        max_tracking_error: largest distance so far between the measured joint positions and the
            nearest recent command, as the largest difference of any joint [rad].
    """

    _fields_ = (
        ("_planned", ctypes.c_double * (1 + ARM_JOINTS) * _ROWS),
        ("_planned_count", ctypes.c_int64),
        ("_measured", ctypes.c_double * (2 * ARM_JOINTS) * _ROWS),
        ("_measured_count", ctypes.c_int64),
        ("_note", ctypes.c_char * _NOTE_SIZE),
        ("is_stopped", ctypes.c_double),
        ("executed_time", ctypes.c_double),
        ("end_requested", ctypes.c_double),
        ("max_tracking_error", ctypes.c_double),
    )

    def write_planned(self, t: float, q: FloatArray) -> None:
        """Appends planned joint positions q (7,) [rad] for a simulated time t [s] to the shared
        memory.
        """
        self._planned[self._planned_count % _ROWS][:] = [t, *q]
        self._planned_count += 1

    def write_measured(self, q: FloatArray, v: FloatArray) -> None:
        """Appends a measured state to the shared memory: joint positions q (7,) [rad] and
        velocities v (7,) [rad/s] from the arm's status message.
        """
        self._measured[self._measured_count % _ROWS][:] = [*q, *v]
        self._measured_count += 1

    @property
    def planned_until(self) -> float:
        """Simulated time of the latest planned joint positions in the shared memory [s]; -inf if no
        positions were planned.
        """
        count = self._planned_count
        return float(self._planned[(count - 1) % _ROWS][0]) if count else -math.inf

    def planned(self, t: float) -> FloatArray:
        """Interpolates the planned joint positions (7,) [rad] in the shared memory at a simulated
        time t [s].
        """
        count = self._planned_count
        latest = np.arange(max(0, count - _ROWS // 2), count) % _ROWS
        times, *joints = np.ctypeslib.as_array(self._planned)[latest].T
        return np.array([np.interp(t, times, joint) for joint in joints])

    @property
    def measured(self) -> tuple[FloatArray, FloatArray]:
        """Joint positions (7,) [rad] and velocities (7,) [rad/s] in the arm's last valid status;
        NaN before the first status.
        """
        count, row = self._measured_count, np.full(2 * ARM_JOINTS, np.nan)
        if count:
            row[:] = self._measured[(count - 1) % _ROWS]
        return row[:ARM_JOINTS], row[ARM_JOINTS:]

    @property
    def note(self) -> str:
        """Reason why the arm is stopped or holds its position, as text; "" while the arm moves."""
        return bytes(self._note).decode(errors="replace")

    @note.setter
    def note(self, note: str) -> None:
        """Sets the reason why the arm is stopped or holds; longer texts are cut to `_NOTE_SIZE`."""
        self._note = note.encode()[: _NOTE_SIZE - 1]


def shared_trajectory() -> SharedTrajectory:
    """Allocates a `SharedTrajectory`, in memory that two processes can share, without any planned
    or measured positions.
    """
    return multiprocessing.get_context("spawn").RawValue(SharedTrajectory)


class ArmStoppedError(Exception):
    """Failure after which the arm must stop permanently; the text of the exception states the
    reason.
    """


Status = tuple[float, FloatArray, FloatArray]
"""Measured motion of an arm: time of the measurement by the wall clock [s], (7,) joint positions
[rad], and (7,) joint velocities by the wall clock [rad/s]."""


class Arm(Protocol):
    """Connection to an arm that follows joint positions.

    Attributes:
        name: name of the source of statuses, for messages to the user.
        period: wall time between two commands [s].
    """

    name: str
    period: float

    def receive(self, now: float) -> Status | None:
        """Returns the newest status of the arm; None if none was received since the last call.

        Args:
            now: time of the wall clock [s].

        Returns:
            Time of the measurement by the wall clock [s], joint positions (7,) [rad], and joint
            velocities (7,) by the wall clock [rad/s].

        Raises:
            ValueError: for an invalid status.
            ArmStoppedError: if the arm does not follow the commands of this connection.
        """

    def send(self, now: float, q: FloatArray) -> None:
        """Commands the joint positions q (7,) [rad] at a time of the wall clock [s].

        Raises:
            ArmStoppedError: if the arm rejects the command.
        """

    def close(self) -> None:
        """Ends the connection; the arm then holds its position or comes to rest."""


class CommandStreamer:
    """Sender of joint position commands to an arm, which reads planned positions from a
    `SharedTrajectory`, monitors the arm, and stops it after failures.

    The trajectory begins at time 0 and at rest. From the first command on, one second of wall time
    executes `rate` seconds of the trajectory, or less if the diagram has written less than half of
    `LEAD` ahead. Failures have these consequences::

        no valid status for `STATUS_TIMEOUT`        the arm holds, and resumes with the next status
        no valid status for `_STOP_TIMEOUT` more    the arm stops permanently
        joint too far from its recent commands,     the arm stops permanently
        second command source, or a mode in
        which the arm follows no commands
    """

    def __init__(self, trajectory: SharedTrajectory, arm: Arm, rate: float) -> None:
        """Initializes the sender, which sends no command before the diagram has planned positions.

        Args:
            trajectory: trajectory shared with the diagram.
            arm: connection to the arm.
            rate: maximum ratio of simulated time to wall time [-].
        """
        self._trajectory, self._arm, self._rate = trajectory, arm, rate
        # Present rate of simulated time, and monotonic times of the last valid status and step.
        self._pace, self._status_tick, self._step_tick = 0.0, -math.inf, -math.inf
        self._status_problem = f"no status received on {arm.name}"
        self._sent: deque[tuple[float, FloatArray]] = deque(maxlen=_SENT_COUNT)

    @property
    def is_finished(self) -> bool:
        """Whether the end of the streamer was requested and the arm's commands are at rest, so that
        the process may end.
        """
        trajectory = self._trajectory
        is_at_rest = self._pace < 1e-3 or trajectory.planned_until <= trajectory.executed_time
        return bool(trajectory.end_requested and (trajectory.is_stopped or is_at_rest))

    def step(self, now: float, tick: float | None = None) -> None:
        """Checks the received messages, and sends the next command to the arm.

        A failure stops the arm permanently: its reason is stored in the shared trajectory and
        logged, and no command is sent any more.

        Args:
            now: time of the wall clock, which may be adjusted [s].
            tick: time of a monotonic clock [s]; None: `now`.
        """
        try:
            self._step(now, now if tick is None else tick)
        except ArmStoppedError as error:
            self._trajectory.note, self._trajectory.is_stopped = str(error), 1.0
            _logger.warning("arm stopped: %s", error)

    def _step(self, now: float, tick: float) -> None:
        """Checks the received messages, and sends the next command of the shared trajectory to the
        arm. Without a valid status, the commands slow down to rest.

        Args:
            now: time of the wall clock, which may be adjusted [s].
            tick: time of a monotonic clock [s].

        Raises:
            ArmStoppedError: if the arm must stop permanently.
        """
        trajectory = self._trajectory
        if trajectory.is_stopped:
            return
        self._check_status(now, tick)
        silence = tick - self._status_tick
        problem = self._status_problem if silence > STATUS_TIMEOUT else ""
        if STATUS_TIMEOUT + _STOP_TIMEOUT < silence < math.inf:
            raise ArmStoppedError(problem)
        if problem != trajectory.note:
            trajectory.note = problem
            if self._sent:
                _logger.warning("arm holds: %s" if problem else "arm resumed%s", problem)
        elapsed, self._step_tick = tick - self._step_tick, tick
        if not self._sent and (problem or trajectory.planned_until < 0.5 * LEAD):
            return
        if elapsed > STATUS_TIMEOUT:
            # After a pause of this length the arm holds: the motion starts again from rest.
            self._pace = 0.0
        if self._pace == 0.0 and not problem:
            q = trajectory.planned(trajectory.executed_time)
            deviation = float(np.abs(trajectory.measured[0] - q).max())
            if deviation > _RESTART_TOLERANCE:
                raise ArmStoppedError(
                    f"a joint at rest is {deviation:.3g} rad from its planned position, at most "
                    f"{_RESTART_TOLERANCE:g} allowed: the arm was moved"
                )
        if trajectory.executed_time == 0.0:
            # The planned motion begins at rest. With a ramp, obstacles, which do not wait, would be
            # ahead of simulated time by half the duration of the ramp.
            self._pace = self._rate
        elapsed = min(elapsed, 3.0 * self._arm.period) if self._sent else 0.0
        lead = trajectory.planned_until - trajectory.executed_time
        change = self._rate * elapsed / _RAMP
        is_slowing = problem or trajectory.end_requested > 0.0
        pace = max(0.0, self._pace - change) if is_slowing else self._pace + change
        self._pace = min(pace, self._rate * min(1.0, max(0.0, lead / (0.5 * LEAD))))
        trajectory.executed_time = min(
            trajectory.executed_time + self._pace * elapsed, trajectory.planned_until
        )
        q = trajectory.planned(trajectory.executed_time)
        self._sent.append((now, q))
        self._arm.send(now, q)

    def _check_status(self, now: float, tick: float) -> None:
        """Checks the last received status of the arm, and stores its measurements in the shared
        memory.

        Args:
            now: time of the wall clock [s].
            tick: time of a monotonic clock [s].

        Raises:
            ArmStoppedError: if the arm does not follow commands, or is too far from its recent
                commands.
        """
        try:
            status = self._arm.receive(now)
        except ValueError as error:
            self._status_problem = str(error)
            return
        if status is None:
            return
        self._status_tick = tick
        self._status_problem = f"no status on {self._arm.name} for {STATUS_TIMEOUT:g} s"
        stamp, q, v = status
        self._trajectory.write_measured(q, v)
        recent = [at for when, at in self._sent if stamp - _TRACKING_WINDOW <= when <= stamp]
        if not recent:
            return
        deviation = float(np.abs(np.array(recent) - q).max(axis=1).min())
        self._trajectory.max_tracking_error = max(self._trajectory.max_tracking_error, deviation)
        if deviation > _MAX_TRACKING_ERROR:
            raise ArmStoppedError(
                f"a joint is {deviation:.3g} rad from its commands of the last "
                f"{_TRACKING_WINDOW:g} s, at most {_MAX_TRACKING_ERROR:g} allowed"
            )


Connect = Callable[[SharedTrajectory], Arm]
"""Type of a function that connects to an arm; it raises `ArmStoppedError` if it fails. The function
may write into `SharedTrajectory.note` why it waits."""


def stream_commands(
    trajectory: SharedTrajectory, connect: Connect, rate: float, parent: int
) -> None:
    """Sends the positions of a shared trajectory to the arm as commands, until the end is requested
    or the parent process has ended.

    This function is the entry point of the streamer's process.

    Args:
        trajectory: trajectory shared with the parent process.
        connect: function that connects to the arm.
        rate: maximum ratio of simulated time to wall time [-].
        parent: process ID of the process that computes the motion.
    """
    # A signal to the process group would end the streamer, and stop the arm from full speed.
    for kind in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(kind, signal.SIG_IGN)
    logging.basicConfig(format="%(levelname)s: %(message)s")
    gc.disable()
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, -10)
    try:
        arm = connect(trajectory)
    except ArmStoppedError as error:
        trajectory.note, trajectory.is_stopped = str(error), 1.0
        return
    streamer = CommandStreamer(trajectory, arm, rate)
    due = time.monotonic()
    with closing(arm):
        while not streamer.is_finished:
            if os.getppid() != parent and not trajectory.end_requested:
                _logger.warning("parent process ended: stopping the arm")
                trajectory.end_requested = 1.0
            streamer.step(time.time(), time.monotonic())
            due = max(due + arm.period, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))


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

    def receive(self, now: float) -> Status | None:
        """Returns the newest status of the arm; None if none was received since the last call.

        Args:
            now: time of the wall clock [s].

        Returns:
            Time of the measurement by the wall clock [s], joint positions (7,) [rad], and joint
            velocities (7,) by the wall clock [rad/s].

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
        return stamp, q, v

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


def connect_lcm(url: str, trajectory: SharedTrajectory) -> LcmArm:
    """Connects to the arm on the LCM bus of a URL; the trajectory is not used."""
    return LcmArm(DrakeLcm(url))


class CommandValidator:
    """Validator of received joint position commands, which computes the desired motion of the
    simulated arm from the valid commands.

    A command is rejected for one of these reasons::

        time stamp more than `COMMAND_TIMEOUT` before or after the wall clock
        other content than one position per arm joint in position mode
        time stamp not after that of the last valid command, as with two command sources
        position outside the limits of its joint
        jump of a joint by more than `STEP_TOLERANCE` plus, unless the arm holds, `MAX_SPEED_RATIO`
        times the displacement at the speed limit since the last valid command

    After `COMMAND_TIMEOUT` without a valid command, the arm holds its last desired position, and
    may follow commands again from there.

    Attributes:
        events: texts of the events so far: the arm begins to follow commands, it begins to hold, or
            a command is rejected.
    """

    def __init__(self, q: FloatArray, limits: RobotLimits) -> None:
        """Initializes the validator for an arm that holds its position.

        Args:
            q: (n,) joint positions of the arm [rad].
            limits: limits of these joints, in the same order; speeds are with respect to the wall
                clock.
        """
        self._q = np.array(q, dtype=float)
        self._v = np.zeros_like(self._q)
        self._limits = limits
        self._accepted_at = -np.inf
        self._stamp: int | None = None
        self.events: list[str] = []

    def receive(self, command: lcmt_panda_command, now: float) -> bool:
        """Checks a command, and stores it as the desired motion of the arm if it is valid.

        Args:
            command: received command.
            now: time of the wall clock [s].

        Returns:
            Whether the command is valid, so that the arm follows it.
        """
        self._update(now)
        if reason := self._problem(command, now):
            self._log(f"command rejected: {reason}")
            return False
        q = np.array(command.joint_position)
        if self._stamp is None:
            self._log("following")
            self._v[:] = 0.0
        else:
            self._v = (q - self._q) / (MICROSECOND * (command.utime - self._stamp))
        self._q, self._stamp, self._accepted_at = q, command.utime, now
        return True

    def desired(self, now: float) -> tuple[FloatArray, FloatArray]:
        """Returns the desired joint positions (n,) [rad] and velocities (n,) [rad/s] at a time of
        the wall clock [s].
        """
        self._update(now)
        return self._q, self._v

    @property
    def is_holding(self) -> bool:
        """Whether the arm holds its position, because no valid command was received within
        `COMMAND_TIMEOUT`.
        """
        return self._stamp is None

    def _update(self, now: float) -> None:
        """Sets the desired velocity to zero, so that the arm holds, if the last command has expired
        at a time of the wall clock [s].
        """
        if self._stamp is not None and now - self._accepted_at > COMMAND_TIMEOUT:
            self._v, self._stamp = np.zeros_like(self._q), None
            self._log(f"holding: no command for {COMMAND_TIMEOUT:g} s")

    def _problem(self, command: lcmt_panda_command, now: float) -> str:
        """Checks a command at a time of the wall clock [s], and returns the reason to reject it; ""
        if the command is valid.
        """
        n, limits, elapsed = len(self._q), self._limits, 0.0
        age = now - MICROSECOND * command.utime
        if abs(age) > COMMAND_TIMEOUT:
            return f"its stamp is {age:.3f} s before the wall clock"
        sizes = (command.num_joint_position, command.num_joint_velocity, command.num_joint_torque)
        if sizes != (n, 0, 0) or command.control_mode_expected != POSITION_MODE:
            return f"not {n} positions in position mode"
        if self._stamp is not None:
            elapsed = MICROSECOND * (command.utime - self._stamp)
            if elapsed <= 0.0:
                return (
                    f"a second command source: its stamp is {-1e3 * elapsed:.1f} ms before the last"
                )
        q = np.array(command.joint_position)
        if problem := beyond_limits(q, limits):
            return problem
        step = np.abs(q - self._q)
        allowed = STEP_TOLERANCE + MAX_SPEED_RATIO * elapsed * limits.velocity_limit
        j = int(np.argmax(step - allowed))
        if step[j] <= allowed[j]:
            return ""
        name = limits.position_name[j]
        return f"{name} jumps by {step[j]:.3g} rad, at most {allowed[j]:.3g} allowed"

    def _log(self, event: str) -> None:
        """Logs and stores an event of the command validation, unless it repeats the previous event.

        Two events are the same if their texts up to the first digit are equal.
        """
        kinds = [re.split(r"\d", text)[0] for text in (*self.events[-1:], event)]
        if len(set(kinds)) == len(kinds):
            self.events.append(event)
            _logger.warning("station: %s", event)
