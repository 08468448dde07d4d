"""Commands of joint positions: sent from a planned motion, and checked before the arm follows.

Decisions may need longer than the arm can wait: the diagram writes the planned joint positions
into shared memory, a little ahead, and a `CommandPlayer` in a process of its own sends commands
from there at its own rate. Where the planned motion ends the player slows along it and waits; it
never extrapolates. On the arm's side a `CommandGuard` checks each command; it does not use LCM.
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
from enum import IntEnum

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
"""Instants that are kept of what is to be, and of what was measured."""
_NOTE = 400
"""Bytes of the longest note."""
_REMEMBERED = 400
"""Commands of our own that are told from somebody else's."""


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
"""Distance of a joint from its command that stops the run [rad], and its duration [s]."""
SPEED_SHARE = 1.2
"""Maximum speed between two accepted commands, relative to the joint's limit [1]."""
SLACK = 0.01
"""Additional joint displacement allowed between two accepted commands [rad]."""


def check_rate(rate: float) -> None:
    """Raises ValueError for a rate that is not above 0 and at most 1."""
    if not 0.0 < rate <= 1.0:
        raise ValueError(f"rate: {rate} must be above 0 and at most 1")


def beyond_limits(q: FloatArray, limits: RobotLimits) -> str:
    """Returns a message about the first of the positions (n,) beyond its limits; "" if none is."""
    lower, upper = limits.position_lower, limits.position_upper
    for name, value, low, high in zip(limits.position_name, q, lower, upper, strict=True):
        if not low <= value <= high:
            return f"{name} at {value:.4g} rad is out of [{low:.4g}, {high:.4g}]"
    return ""


class PlayerState(IntEnum):
    """What the player does."""

    LISTENING = 0
    """No status has come."""
    READY = 1
    """Nothing was written yet; nothing is commanded."""
    PLAYING = 2
    HOLDING = 3
    """Something is wrong that may pass."""
    STOPPED = 4
    """For good."""


class SharedMotion(ctypes.Structure):
    """Memory shared by the diagram and the player: planned and measured motion, and progress.

    Each field has one writer. Rows are written before they are counted.

    Attributes:
        played: simulated time that the arm is at [s].
        end: 1 once the player is to end.
        longest_pause: longest time between two commands [s].
        commands: number of commands.
        farthest: greatest distance of a joint from its commands [rad].
    """

    _fields_ = (
        ("_planned", ctypes.c_double * (1 + ARM_JOINTS) * _ROWS),
        ("_planned_count", ctypes.c_int64),
        ("_measured", ctypes.c_double * (1 + 2 * ARM_JOINTS) * _ROWS),
        ("_measured_count", ctypes.c_int64),
        ("_state", ctypes.c_int),
        ("_note", ctypes.c_char * _NOTE),
        ("played", ctypes.c_double),
        ("end", ctypes.c_double),
        ("longest_pause", ctypes.c_double),
        ("commands", ctypes.c_double),
        ("farthest", ctypes.c_double),
    )

    def write_planned(self, t: float, q: FloatArray) -> None:
        """Adds the planned positions of the joints (7,) at a simulated time [s, rad]."""
        self._planned[self._planned_count % _ROWS][:] = [t, *q]
        self._planned_count += 1

    def write_measured(self, stamp: float, q: FloatArray, v: FloatArray) -> None:
        """Adds the state of the joints (7,) in a status of the wall clock [s, rad, rad/s]."""
        self._measured[self._measured_count % _ROWS][:] = [stamp, *q, *v]
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
    def measured(self) -> tuple[float, FloatArray, FloatArray]:
        """Stamp [s], positions and speeds (7,) of the last status; NaN before the first."""
        count, row = self._measured_count, np.full(1 + 2 * ARM_JOINTS, np.nan)
        if count:
            row[:] = self._measured[(count - 1) % _ROWS]
        return float(row[0]), row[1 : 1 + ARM_JOINTS], row[1 + ARM_JOINTS :]

    def tell(self, state: PlayerState, note: str) -> None:
        """Says what the player does, and why."""
        self._note = note.encode()[: _NOTE - 1]
        self._state = state

    @property
    def state(self) -> PlayerState:
        """What the player does."""
        return PlayerState(self._state)

    @property
    def note(self) -> str:
        """Why."""
        return bytes(self._note).decode(errors="replace")


def shared_motion() -> SharedMotion:
    """Allocates the memory, without any row."""
    return multiprocessing.get_context("spawn").RawValue(SharedMotion)


class CommandPlayer:
    """Commands what is in a `SharedMotion`, watches the arm, and stops it where it must.

    Simulated time is played at `rate` seconds in one of the wall clock, more slowly where less
    than half of `LEAD` is written, and not at all where the arm is silent, astray or
    commanded by somebody else.
    """

    def __init__(self, motion: SharedMotion, lcm: DrakeLcm, rate: float) -> None:
        """Listens.

        Args:
            motion: what is to be.
            lcm: what messages come and go by.
            rate: simulated seconds in one of the wall clock, at most.

        Raises:
            ValueError: if the rate is not above 0 and at most 1.
        """
        check_rate(rate)
        self._motion, self._lcm, self._rate = motion, lcm, rate
        self._pace = self._played = 0.0
        self._heard = self._last = self._commanded = -math.inf
        self._trouble_since = self._astray_since = math.inf
        self._sent: deque[int] = deque(maxlen=_REMEMBERED)
        self._past: deque[tuple[float, FloatArray]] = deque(maxlen=_REMEMBERED)
        # Whether the arm is where it is to be has to be looked at before it moves.
        self._from_rest = True
        self._apart = 0.0
        self._stop = self._passed = ""
        self._statuses: list[bytes] = []
        self._commands: list[bytes] = []
        lcm.Subscribe(STATUS_CHANNEL, self._statuses.append)
        lcm.Subscribe(COMMAND_CHANNEL, self._commands.append)

    @property
    def finished(self) -> bool:
        """Whether it was told to end, and the arm is at rest as far as it is commanded."""
        if not self._motion.end:
            return False
        stopped = self._motion.state is PlayerState.STOPPED
        return stopped or self._pace < 1e-3 or self._motion.planned_until <= self._played

    def step(self, now: float, tick: float | None = None) -> None:
        """Hears what has come, and sends the next command.

        Args:
            now: the wall clock, which may be set [s].
            tick: one that is never set [s]; None: the wall clock is not.
        """
        tick = now if tick is None else tick
        motion = self._motion
        while self._lcm.HandleSubscriptions(0):
            pass
        self._take_statuses(now, tick)
        self._take_commands()
        elapsed, self._last = tick - self._last, tick
        if motion.state is PlayerState.STOPPED:
            return
        trouble = self._trouble(tick)
        self._say(tick, trouble)
        begun = self._commanded > -math.inf
        if self._stopped() or motion.planned_until == -math.inf or (trouble and not begun):
            return
        if trouble or elapsed > SILENCE:
            self._from_rest = True
        if elapsed > SILENCE:
            # The arm holds by now.
            self._pace = 0.0
        slow = bool(trouble) or motion.end > 0.0
        if self._from_rest and not trouble:
            if self._moved_away():
                return
            self._from_rest = False
        self._play(min(elapsed, 3.0 * COMMAND_PERIOD), slow)
        self._send(now, tick)

    def _stopped(self) -> bool:
        return self._motion.state is PlayerState.STOPPED

    def _moved_away(self) -> bool:
        """Stops for good if the arm, at rest, is not where it is to be."""
        _, q, _ = self._motion.measured
        off = float(np.abs(q - self._motion.planned(self._played)).max())
        if off > _RESTART_TOLERANCE:
            self._tell(PlayerState.STOPPED, f"the arm is {off:.3g} rad from where it was left")
        return self._stopped()

    def _play(self, elapsed: float, slow: bool) -> None:
        motion = self._motion
        lead = motion.planned_until - self._played
        most = self._rate * min(1.0, max(0.0, lead / (0.5 * LEAD)))
        change = self._rate * elapsed / _RAMP
        wanted = max(0.0, self._pace - change) if slow else self._pace + change
        self._pace = min(wanted, most)
        self._played = min(self._played + self._pace * elapsed, motion.planned_until)
        motion.played = self._played

    def _send(self, now: float, tick: float) -> None:
        motion = self._motion
        q = motion.planned(self._played)
        message = lcmt_panda_command()
        message.utime = round(now / MICROSECOND)
        message.num_joint_velocity = 0
        message.control_mode_expected = POSITION_MODE
        message.num_joint_position, message.joint_position = ARM_JOINTS, list(q)
        self._sent.append(message.utime)
        self._past.append((now, q))
        self._lcm.Publish(COMMAND_CHANNEL, message.encode())
        if self._commanded > -math.inf:
            pause = tick - self._commanded
            motion.longest_pause = max(motion.longest_pause, pause)
        self._commanded = tick
        motion.commands += 1.0

    def _take_statuses(self, now: float, tick: float) -> None:
        # Handlers may not raise: what has come is looked at here. The last one counts.
        for data in self._statuses[-1:]:
            try:
                status = lcmt_panda_status.decode(data)
                q, v = np.array(status.joint_position), np.array(status.joint_velocity)
            except Exception as error:
                self._passed = f"what comes is no lcmt_panda_status: {error}"
                continue
            age = now - MICROSECOND * status.utime
            if q.shape != (ARM_JOINTS,) or v.shape != q.shape or not np.isfinite([q, v]).all():
                self._passed = f"statuses hold no {ARM_JOINTS} finite positions and speeds"
            elif abs(age) > SILENCE:
                self._passed = (
                    f"statuses are {age:.3f} s old by this clock, at most {SILENCE:g} "
                    "may be: are both clocks set alike?"
                )
            else:
                self._heard, self._passed = tick, ""
                self._check_modes(status)
                self._motion.write_measured(now - age, q, v)
                self._watch(tick, now - age, q)
        self._statuses.clear()

    def _check_modes(self, status: lcmt_panda_status) -> None:
        if status.robot_mode in _NOT_FREE:
            name = _NOT_FREE[status.robot_mode]
            self._stop = f"the arm is {name}; it has to be free to move"
        # Zero, of who does not tell.
        if status.control_mode not in (0, POSITION_MODE):
            self._stop = "the arm does not take positions; start it in position mode"

    def _watch(self, tick: float, stamp: float, q: FloatArray) -> None:
        """How far the arm is from the nearest of what it was sent lately."""
        motion = self._motion
        sent = [at for when, at in self._past if stamp - _ASTRAY_TIME <= when <= stamp]
        if not sent:
            return
        self._apart = float(np.abs(np.array(sent) - q).max(axis=1).min())
        motion.farthest = max(motion.farthest, self._apart)
        astray = self._apart > _ASTRAY
        self._astray_since = min(self._astray_since, tick) if astray else math.inf

    def _take_commands(self) -> None:
        for data in self._commands:
            try:
                utime = lcmt_panda_command.decode(data).utime
            except Exception:
                utime = 0
            if utime not in self._sent:
                self._stop = f"somebody else commands on {COMMAND_CHANNEL}"
        self._commands.clear()

    def _trouble(self, tick: float) -> str:
        """What is wrong and may pass; what may not stops for good."""
        if tick - self._astray_since > _ASTRAY_TIME:
            self._stop = f"the arm is {self._apart:.3g} rad from where it was sent"
        if self._stop:
            self._tell(PlayerState.STOPPED, self._stop)
        if tick - self._heard <= SILENCE:
            return ""
        since = f" for {SILENCE:g} s" if self._heard > -math.inf else ""
        return self._passed or f"no status on {STATUS_CHANNEL}{since}"

    def _say(self, tick: float, trouble: str) -> None:
        """Tells what is done about it."""
        if self._stopped():
            return
        self._trouble_since = min(self._trouble_since, tick) if trouble else math.inf
        if trouble and self._heard == -math.inf:
            self._tell(PlayerState.LISTENING, trouble)
        elif tick - self._trouble_since > _PATIENCE:
            self._tell(PlayerState.STOPPED, trouble)
        elif trouble:
            self._tell(PlayerState.HOLDING, trouble)
        elif self._motion.planned_until == -math.inf:
            self._tell(PlayerState.READY, "")
        else:
            self._tell(PlayerState.PLAYING, "")

    def _tell(self, state: PlayerState, note: str) -> None:
        motion, before = self._motion, self._motion.state
        if (state, note) == (before, motion.note):
            return
        motion.tell(state, note)
        if state is PlayerState.STOPPED:
            _logger.warning("stopped: %s", note)
        elif state is PlayerState.HOLDING:
            _logger.warning("holds: %s", note)
        elif before is PlayerState.HOLDING:
            _logger.warning("goes on")


def _hurry() -> None:
    """Has this process go before others, as far as the system allows it."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    except OSError:
        try:
            os.setpriority(os.PRIO_PROCESS, 0, -10)
        except OSError:
            _logger.info("commands have no priority: others may make them pause")


def play(motion: SharedMotion, lcm_url: str, rate: float, parent: int) -> None:
    """Plays until it was told to end, or who decides is no more: the body of a process.

    Args:
        motion: shared with who decides.
        lcm_url: of the bus.
        rate: simulated seconds in one of the wall clock, at most.
        parent: process that decides.
    """
    # Told by who decides, or by its end: a signal to the whole group would stop it at full speed.
    for kind in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(kind, signal.SIG_IGN)
    logging.basicConfig(format="%(levelname)s: arm: %(message)s")
    gc.disable()
    _hurry()
    player = CommandPlayer(motion, DrakeLcm(lcm_url), rate)
    due = time.monotonic()
    while not player.finished:
        if os.getppid() != parent and not motion.end:
            _logger.warning("who decides is no more: the arm is stopped")
            motion.end = 1.0
        player.step(time.time(), time.monotonic())
        due = max(due + COMMAND_PERIOD, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))


class CommandGuard:
    """Follows one commander, and holds where there is none, or more than one.

    Old commands are passed over. After one that is out of limits, jumps, is of another mode or of
    a second commander, the arm holds the last position that was in order, until nobody has
    commanded for `expiry`, and goes on from there.

    Attributes:
        events: message whenever its behavior changed.
    """

    def __init__(self, q: FloatArray, limits: RobotLimits, expiry: float = 0.1) -> None:
        """Holds.

        Args:
            q: (n,) where the arm is [rad].
            limits: of its joints, in the same order.
            expiry: time for which a command is valid, after which the arm holds; maximum difference
                of its stamp from the wall clock [s]. The vendor's driver has the same.

        Raises:
            ValueError: if the limits are of another number of joints, or the expiry is not between
                1 ms and 10 s.
        """
        if not 1e-3 <= expiry <= 10.0:
            raise ValueError(f"expiry must be between 0.001 and 10 s, not {expiry}")
        if limits.position_lower.shape != q.shape:
            raise ValueError(f"limits are of {len(limits.position_lower)} joints, q of {len(q)}")
        self._q = np.array(q, dtype=float)
        self._v = np.zeros_like(self._q)
        self._limits, self._expiry = limits, expiry
        self._accepted = self._heard = -np.inf
        self._stamp: int | None = None
        self._refused: FloatArray | None = None
        self._latched = False
        self.events: list[str] = []

    def receive(self, command: lcmt_panda_command, now: float) -> bool:
        """Takes a command, or says why not.

        Args:
            command: what came.
            now: the wall clock [s].

        Returns:
            Whether the arm follows it.
        """
        self._look(now)
        age = now - MICROSECOND * command.utime
        if abs(age) > self._expiry:
            self._log(f"command passed over: its stamp is {age:.3f} s before the wall clock")
            return False
        why = self._why_not(command)
        self._heard = now
        if why or self._latched:
            self._refuse(command, why)
            return False
        if self._stamp is None:
            self._log("following")
        q = np.array(command.joint_position)
        self._v[:] = 0.0
        if self._stamp is not None:
            self._v = (q - self._q) / (MICROSECOND * (command.utime - self._stamp))
        self._q = q
        self._stamp, self._accepted = command.utime, now
        return True

    def desired(self, now: float) -> tuple[FloatArray, FloatArray]:
        """(n,) positions [rad] and (n,) speeds [rad/s] that the arm is to have now."""
        self._look(now)
        return self._q, self._v

    @property
    def holding(self) -> bool:
        """Whether nothing is followed."""
        return self._stamp is None

    def _look(self, now: float) -> None:
        """Holds when the last command has expired; listens again when all are silent."""
        if self._stamp is not None and now - self._accepted > self._expiry:
            self._hold(f"holding: no command for {self._expiry:g} s")
        if self._latched and now - self._heard > self._expiry:
            self._latched, self._refused = False, None
            self._log("holding: nobody commands; the next commander may begin here")

    def _why_not(self, command: lcmt_panda_command) -> str:
        n = len(self._q)
        only = (command.num_joint_position, command.num_joint_velocity, command.num_joint_torque)
        if only != (n, 0, 0) or command.control_mode_expected != POSITION_MODE:
            return f"not {n} positions in position mode"
        if self._stamp is not None and command.utime <= self._stamp:
            before = 1e-3 * (self._stamp - command.utime)
            return f"a second commander: its stamp is {before:.1f} ms before the last"
        return self._position_out(command)

    def _position_out(self, command: lcmt_panda_command) -> str:
        q = np.array(command.joint_position)
        if beyond := beyond_limits(q, self._limits):
            return beyond
        elapsed = 0.0
        if self._stamp is not None:
            elapsed = MICROSECOND * (command.utime - self._stamp)
        step = np.abs(q - self._q)
        allowed = SLACK + SPEED_SHARE * elapsed * self._limits.velocity_limit
        if (step > allowed).any():
            j = int(np.argmax(step - allowed))
            return (
                f"{self._limits.position_name[j]} jumps by {step[j]:.3g} rad, "
                f"{allowed[j]:.3g} are possible"
            )
        return ""

    def _refuse(self, command: lcmt_panda_command, why: str) -> None:
        if not self._latched:
            self._latched = True
            self._refused = np.array(command.joint_position)
            self._hold(f"holding: command refused: {why}")
        elif not why and self._refused is not None and len(self._refused) == len(self._q):
            # Whoever jumped would go on from there: this one is somebody else.
            apart = np.abs(np.array(command.joint_position) - self._refused).max()
            self._log(
                f"holding: command refused: a second commander, {apart:.3g} rad from the first"
            )
            self._refused = None

    def _hold(self, why: str) -> None:
        self._v, self._stamp = np.zeros_like(self._q), None
        self._log(why)

    def _log(self, event: str) -> None:
        """Adds an event, unless it differs from the last one in numbers only."""
        if not self.events or self.events[-1].split(" is ")[0] != event.split(" is ")[0]:
            self.events.append(event)
            _logger.warning("station: %s", event)
