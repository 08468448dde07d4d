"""Plays a motion that another process makes as commands, without a pause.

Who decides may need longer than the arm may wait: it writes where the joints are to be into
memory that both share, a little ahead, and the player commands from there at its own rate. Where
what is written runs out the player slows along it and waits; it never makes up a motion.
"""

# No postponed annotations here: `check_values` reads the fields' types.
import dataclasses as dc
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

from drake_oa.common.config import check_values, number
from drake_oa.common.messages import FloatArray
from drake_oa.hardware.panda_arm import (
    ARM_JOINTS,
    COMMAND_CHANNEL,
    MICROSECOND,
    POSITION_MODE,
    STATUS_CHANNEL,
)

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


@dc.dataclass
class PlayerRules:
    """How commands are played, and when the arm is stopped."""

    # Time between commands.
    period: float = number(0.004, "s", 5e-4, 0.05)
    # What is to be is written so far ahead: pauses of who decides do not reach the arm if they
    # are half as long. The arm reacts so much later.
    lead: float = number(0.04, "s", 0.01, 1.0)
    # Images come so late, by the wall clock, besides. What is late by that and the lead is not
    # missed: the supervisor does not slow for it.
    image_delay: float = number(0.05, "s", 0.0, 1.0)
    # Full speed is reached, and left where something is wrong, in this time.
    ramp: float = number(0.15, "s", 0.01, 5.0)
    # Without a status for so long the arm is held, and after so much longer not driven any more:
    # meanwhile simulated time stands, and with it the age of what was seen.
    silence: float = number(0.1, "s", 0.01, 10.0)
    patience: float = number(0.3, "s", 0.0, 10.0)
    # Where a joint is, before it is moved from rest, by no more from where it is to be.
    restart_tolerance: float = number(0.03, "rad", 1e-3, 3.0)
    # A joint farther than this from where it was sent, for so long, stops the run.
    astray: float = number(0.1, "rad", 1e-3, 3.0)
    astray_time: float = number(0.2, "s", 0.0, 10.0)
    # The joints are this near to the scenario's start, and slower than this, before they are moved.
    start_tolerance: float = number(0.1, "rad", 0.0, 3.0)
    start_speed: float = number(0.05, "rad/s", 0.0, 3.0)
    # The table is seen this near to where the scenario has it, and tilted by no more.
    table_tolerance: float = number(0.015, "m", 0.0, 1.0)
    table_tilt: float = number(math.radians(1.5), "rad", 0.0, 1.0)


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


_SIZES = {
    "wanted": _ROWS * (1 + ARM_JOINTS),
    "measured": _ROWS * (1 + 2 * ARM_JOINTS),
    "wanted_count": 1,
    "measured_count": 1,
    "played": 1,
    "state": 1,
    "end": 1,
    "longest_pause": 1,
    "commands": 1,
    "farthest": 1,
}
"""Numbers in each part of the shared memory."""


class SharedMotion:
    """What both processes see: what is to be, what was measured, and how the player fares.

    Each array has one writer. Rows are written before they are counted.
    """

    def __init__(self) -> None:
        """Nothing is written."""
        context = multiprocessing.get_context("spawn")
        self._raw = {name: context.RawArray("d", size) for name, size in _SIZES.items()}
        self._note = context.RawArray("c", _NOTE)

    def _array(self, name: str) -> FloatArray:
        return np.frombuffer(self._raw[name])

    def write_wanted(self, t: float, q: FloatArray) -> None:
        """Adds where the joints (7,) are to be at a simulated time [s, rad]."""
        count = int(self._raw["wanted_count"][0])
        row = count % _ROWS
        self._array("wanted").reshape(_ROWS, -1)[row] = (t, *q)
        self._raw["wanted_count"][0] = count + 1

    def write_measured(self, stamp: float, q: FloatArray, v: FloatArray) -> None:
        """Adds what a status of the wall clock [s] says of the joints (7,) [rad, rad/s]."""
        count = int(self._raw["measured_count"][0])
        self._array("measured").reshape(_ROWS, -1)[count % _ROWS] = (stamp, *q, *v)
        self._raw["measured_count"][0] = count + 1

    @property
    def wanted_until(self) -> float:
        """Simulated time of what was written last; -inf before [s]."""
        count = int(self._raw["wanted_count"][0])
        if not count:
            return -math.inf
        return float(self._raw["wanted"][(count - 1) % _ROWS * (1 + ARM_JOINTS)])

    def wanted(self, t: float) -> FloatArray:
        """(7,) where the joints are to be at a simulated time that was written [rad]."""
        count = int(self._raw["wanted_count"][0])
        rows = self._array("wanted").reshape(_ROWS, -1)
        first = max(0, count - _ROWS // 2)
        ordered = rows[np.arange(first, count) % _ROWS]
        after = int(np.searchsorted(ordered[:, 0], t))
        if after == 0:
            return np.array(ordered[0, 1:])
        if after == len(ordered):
            return np.array(ordered[-1, 1:])
        low, high = ordered[after - 1], ordered[after]
        share = (t - low[0]) / (high[0] - low[0])
        return np.array(low[1:] + share * (high[1:] - low[1:]))

    @property
    def measured(self) -> tuple[float, FloatArray, FloatArray]:
        """Stamp [s], positions and speeds (7,) of the last status; NaN before one."""
        count = int(self._raw["measured_count"][0])
        if not count:
            return math.nan, np.full(ARM_JOINTS, np.nan), np.full(ARM_JOINTS, np.nan)
        row = np.array(self._array("measured").reshape(_ROWS, -1)[(count - 1) % _ROWS])
        return float(row[0]), row[1 : 1 + ARM_JOINTS], row[1 + ARM_JOINTS :]

    def tell(self, state: PlayerState, note: str) -> None:
        """Says what the player does, and why."""
        self._note.value = note.encode()[: _NOTE - 1]
        self._raw["state"][0] = float(state)

    @property
    def state(self) -> PlayerState:
        """What the player does."""
        return PlayerState(int(self._raw["state"][0]))

    @property
    def note(self) -> str:
        """Why."""
        return bytes(self._note.value).decode(errors="replace")

    def figure(self, name: str) -> float:
        """One of `played`, `longest_pause`, `commands`, `farthest`, `end`."""
        return float(self._raw[name][0])

    def set_figure(self, name: str, value: float) -> None:
        """Likewise."""
        self._raw[name][0] = value


class CommandPlayer:
    """Commands what is in a `SharedMotion`, watches the arm, and stops it where it must.

    Simulated time is played at `rate` seconds in one of the wall clock, more slowly where less
    than half of `PlayerRules.lead` is written, and not at all where the arm is silent, astray or
    commanded by somebody else.
    """

    def __init__(
        self, motion: SharedMotion, lcm: DrakeLcm, *, rules: PlayerRules, rate: float
    ) -> None:
        """Listens.

        Args:
            motion: what is to be.
            lcm: what messages come and go by.
            rules: when to stop.
            rate: simulated seconds in one of the wall clock, at most.

        Raises:
            ValueError: if they are out of range.
        """
        check_values(rules)
        if not 0.0 < rate <= 1.0:
            raise ValueError(f"rate: {rate} must be above 0 and at most 1")
        self._motion, self._lcm, self._rules, self._rate = motion, lcm, rules, rate
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
        if not self._motion.figure("end"):
            return False
        stopped = self._motion.state is PlayerState.STOPPED
        return stopped or self._pace < 1e-3 or self._motion.wanted_until <= self._played

    def step(self, now: float, tick: float | None = None) -> None:
        """Hears what has come, and sends the next command.

        Args:
            now: the wall clock, which may be set [s].
            tick: one that is never set [s]; None: the wall clock is not.
        """
        tick = now if tick is None else tick
        motion, rules = self._motion, self._rules
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
        if self._stopped() or motion.wanted_until == -math.inf or (trouble and not begun):
            return
        if trouble or elapsed > rules.silence:
            self._from_rest = True
        if elapsed > rules.silence:
            # The arm holds by now.
            self._pace = 0.0
        slow = bool(trouble) or motion.figure("end") > 0.0
        if self._from_rest and not trouble:
            if self._moved_away():
                return
            self._from_rest = False
        self._play(min(elapsed, 3.0 * rules.period), slow)
        self._send(now, tick)

    def _stopped(self) -> bool:
        return self._motion.state is PlayerState.STOPPED

    def _moved_away(self) -> bool:
        """Stops for good if the arm, at rest, is not where it is to be."""
        _, q, _ = self._motion.measured
        off = float(np.abs(q - self._motion.wanted(self._played)).max())
        if off > self._rules.restart_tolerance:
            self._tell(PlayerState.STOPPED, f"the arm is {off:.3g} rad from where it was left")
        return self._stopped()

    def _play(self, elapsed: float, slow: bool) -> None:
        rules, motion = self._rules, self._motion
        lead = motion.wanted_until - self._played
        most = self._rate * min(1.0, max(0.0, lead / (0.5 * rules.lead)))
        change = self._rate * elapsed / rules.ramp
        wanted = max(0.0, self._pace - change) if slow else self._pace + change
        self._pace = min(wanted, most)
        self._played = min(self._played + self._pace * elapsed, motion.wanted_until)
        motion.set_figure("played", self._played)

    def _send(self, now: float, tick: float) -> None:
        motion = self._motion
        q = motion.wanted(self._played)
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
            motion.set_figure("longest_pause", max(motion.figure("longest_pause"), pause))
        self._commanded = tick
        motion.set_figure("commands", motion.figure("commands") + 1.0)

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
            elif abs(age) > self._rules.silence:
                self._passed = (
                    f"statuses are {age:.3f} s old by this clock, at most {self._rules.silence:g} "
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
        rules, motion = self._rules, self._motion
        sent = [at for when, at in self._past if stamp - rules.astray_time <= when <= stamp]
        if not sent:
            return
        self._apart = float(np.abs(np.array(sent) - q).max(axis=1).min())
        motion.set_figure("farthest", max(motion.figure("farthest"), self._apart))
        astray = self._apart > rules.astray
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
        if tick - self._astray_since > self._rules.astray_time:
            self._stop = f"the arm is {self._apart:.3g} rad from where it was sent"
        if self._stop:
            self._tell(PlayerState.STOPPED, self._stop)
        if tick - self._heard <= self._rules.silence:
            return ""
        since = f" for {self._rules.silence:g} s" if self._heard > -math.inf else ""
        return self._passed or f"no status on {STATUS_CHANNEL}{since}"

    def _say(self, tick: float, trouble: str) -> None:
        """Tells what is done about it."""
        if self._stopped():
            return
        self._trouble_since = min(self._trouble_since, tick) if trouble else math.inf
        if trouble and self._heard == -math.inf:
            self._tell(PlayerState.LISTENING, trouble)
        elif tick - self._trouble_since > self._rules.patience:
            self._tell(PlayerState.STOPPED, trouble)
        elif trouble:
            self._tell(PlayerState.HOLDING, trouble)
        elif self._motion.wanted_until == -math.inf:
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


def play(motion: SharedMotion, lcm_url: str, rules: PlayerRules, rate: float, parent: int) -> None:
    """Plays until it was told to end, or who decides is no more: the body of a process.

    Args:
        motion: shared with who decides.
        lcm_url: of the bus.
        rules: when to stop.
        rate: simulated seconds in one of the wall clock, at most.
        parent: process that decides.
    """
    # Told by who decides, or by its end: a signal to the whole group would stop it at full speed.
    for kind in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(kind, signal.SIG_IGN)
    logging.basicConfig(format="%(levelname)s: arm: %(message)s")
    gc.disable()
    _hurry()
    player = CommandPlayer(motion, DrakeLcm(lcm_url), rules=rules, rate=rate)
    due = time.monotonic()
    while not player.finished:
        if os.getppid() != parent and not motion.figure("end"):
            _logger.warning("who decides is no more: the arm is stopped")
            motion.set_figure("end", 1.0)
        player.step(time.time(), time.monotonic())
        due = max(due + rules.period, time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))
