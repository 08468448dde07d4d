"""What a commanded position must be for the arm to follow it."""

# No postponed annotations here: `check_values` reads the fields' types.
import dataclasses as dc
import logging

import numpy as np
from drake import lcmt_panda_command

from drake_oa.common.config import check_values, number
from drake_oa.common.messages import FloatArray
from drake_oa.hardware.panda_arm import MICROSECOND, POSITION_MODE
from drake_oa.robot.plant import RobotLimits

_logger = logging.getLogger("drake_oa")


@dc.dataclass
class CommandRules:
    """What commands are held to."""

    # A command is in force for this long; then the arm holds. One whose stamp is farther from
    # the wall clock is not taken. The vendor's driver has the same.
    expiry: float = number(0.1, "s", 1e-3, 10.0)
    # From one command to the next no joint goes farther than this times its greatest speed
    # times the time between them, and this much more.
    speed_share: float = number(1.2, "1", 0.0, 10.0, open_low=True)
    slack: float = number(0.01, "rad", 0.0, 1.0)


@dc.dataclass(frozen=True)
class Event:
    """What the guard said.

    Attributes:
        time: of the wall clock [s].
        what: in words.
    """

    time: float
    what: str


class CommandGuard:
    """Follows one commander, and holds where there is none, or more than one.

    Old commands are passed over. After one that is out of limits, jumps, is of another mode or of
    a second commander, the arm holds the last position that was in order, until nobody has
    commanded for `CommandRules.expiry`, and goes on from there.

    Attributes:
        events: whenever what is done changed.
        rejected: how many commands were not followed.
    """

    def __init__(self, q: FloatArray, limits: RobotLimits, rules: CommandRules) -> None:
        """Holds.

        Args:
            q: (n,) where the arm is [rad].
            limits: of its joints, in the same order.
            rules: what commands are held to.

        Raises:
            ValueError: if the rules are out of range, or the limits of another arm.
        """
        check_values(rules)
        if limits.position_lower.shape != q.shape:
            raise ValueError(f"limits are of {len(limits.position_lower)} joints, q of {len(q)}")
        self._q = np.array(q, dtype=float)
        self._v = np.zeros_like(self._q)
        self._limits, self._rules = limits, rules
        self._accepted = self._heard = -np.inf
        self._stamp: int | None = None
        self._refused: FloatArray | None = None
        self._latched = False
        self.events: list[Event] = []
        self.rejected = 0

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
        if abs(age) > self._rules.expiry:
            self._say(now, f"command passed over: its stamp is {age:.3f} s before the wall clock")
            self.rejected += 1
            return False
        why = self._why_not(command)
        self._heard = now
        if why or self._latched:
            self._refuse(command, why, now)
            return False
        if self._stamp is None:
            self._say(now, "following")
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
        if self._stamp is not None and now - self._accepted > self._rules.expiry:
            self._hold(now, f"holding: no command for {self._rules.expiry:g} s")
        if self._latched and now - self._heard > self._rules.expiry:
            self._latched, self._refused = False, None
            self._say(now, "holding: nobody commands; the next commander may begin here")

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
        inside = (self._limits.position_lower <= q) & (q <= self._limits.position_upper)
        if not inside.all():
            j = int(np.argmin(inside))
            low, high = self._limits.position_lower[j], self._limits.position_upper[j]
            name = self._limits.position_name[j]
            return f"{name} at {q[j]:.4g} rad is out of [{low:.4g}, {high:.4g}]"
        elapsed = 0.0
        if self._stamp is not None:
            elapsed = MICROSECOND * (command.utime - self._stamp)
        step = np.abs(q - self._q)
        allowed = (
            self._rules.slack + self._rules.speed_share * elapsed * self._limits.velocity_limit
        )
        if (step > allowed).any():
            j = int(np.argmax(step - allowed))
            return (
                f"{self._limits.position_name[j]} jumps by {step[j]:.3g} rad, "
                f"{allowed[j]:.3g} are possible"
            )
        return ""

    def _refuse(self, command: lcmt_panda_command, why: str, now: float) -> None:
        self.rejected += 1
        if not self._latched:
            self._latched = True
            self._refused = np.array(command.joint_position)
            self._hold(now, f"holding: command refused: {why}")
        elif not why and self._refused is not None and len(self._refused) == len(self._q):
            # Whoever jumped would go on from there: this one is somebody else.
            apart = np.abs(np.array(command.joint_position) - self._refused).max()
            self._say(
                now, f"holding: command refused: a second commander, {apart:.3g} rad from the first"
            )
            self._refused = None

    def _hold(self, now: float, why: str) -> None:
        self._v, self._stamp = np.zeros_like(self._q), None
        self._say(now, why)

    def _say(self, now: float, what: str) -> None:
        kind = what.split(" is ")[0]
        if self.events and self.events[-1].what.split(" is ")[0] == kind:
            return
        self.events.append(Event(now, what))
        _logger.warning("station: %s", what)
