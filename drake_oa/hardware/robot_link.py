"""The robot's messages as systems, in place of the simulated world of a diagram."""

from __future__ import annotations

import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_oa.common.messages import FloatArray, ObstacleClouds, TablePlane
from drake_oa.hardware.command_streamer import (
    COMMAND_PERIOD,
    LEAD,
    SILENCE,
    beyond_limits,
    shared_trajectory,
    stream_commands,
)
from drake_oa.robot.plant import RobotLimits

_NAP = 5e-4
"""Time between two checks of the player's progress [s]."""
START_UP = 30.0
"""Maximum time in which the player's process begins [s]."""
_START_TOLERANCE, _START_SPEED = 0.1, 0.05
"""Maximum distance of a joint from the scenario's start before the motion [rad], and maximum speed
[rad/s]."""
_TABLE_TOLERANCE, _TABLE_TILT = 0.015, math.radians(1.5)
"""Maximum difference between the heights of the perceived and the configured table [m], and maximum
angle between them [rad]."""


class HardwareError(Exception):
    """Reason for which the robot is not driven, or not any more."""


class RobotLink:
    """Joins a diagram to the arm behind LCM messages: the diagram writes, a player commands.

    The player is a process of its own, which `start` begins, so that the diagram may think.

    Attributes:
        motion: what both share.
        rate: simulated seconds in one of the wall clock, at most.
        url: of the bus.
        clock: the wall clock [s].
        wait: called repeatedly during waits.
        events: (simulated time [s], message about the player's state) at each change.
    """

    def __init__(
        self,
        lcm_url: str,
        *,
        rate: float = 1.0,
        wait: Callable[[], None] = lambda: time.sleep(_NAP),
        raise_if_asked: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """Makes the shared memory.

        Args:
            lcm_url: of the bus.
            rate: simulated seconds in one of the wall clock, at most.
            wait: called again and again while the diagram is too far ahead.
            raise_if_asked: raises KeyboardInterrupt when somebody has asked for the end.
            clock: the wall clock [s].
        """
        self.motion, self.rate = shared_trajectory(), rate
        self.url, self.wait, self.clock = lcm_url, wait, clock
        self._raise_if_asked = raise_if_asked
        self.events: list[tuple[float, str]] = []
        self._warmed_up_since = math.nan
        self._process: BaseProcess | None = None

    def start(self) -> None:
        """Starts the player; nothing is commanded before something is written."""
        self._process = multiprocessing.get_context("spawn").Process(
            target=stream_commands,
            args=(self.motion, self.url, self.rate, os.getpid()),
            name="command player",
            # Ends the arm's motion by itself when this process is gone.
            daemon=False,
        )
        self._process.start()

    def close(self) -> None:
        """Brings the arm to rest along the planned motion, and ends the player."""
        self.motion.end = 1.0
        if self._process is not None:
            self._process.join(timeout=5.0)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()

    @contextmanager
    def warmup(self) -> Iterator[None]:
        """Suppresses commands in the block, where simulated time follows the clock.

        Slow first-time work is done then: kernels are loaded, images awaited.
        """
        self._warmed_up_since = self.clock()
        try:
            yield
        finally:
            self._warmed_up_since = math.nan

    def to_simulated(self, stamp: float) -> float:
        """Computes the simulated time of the arm at a recent time of the wall clock [s]."""
        if not math.isnan(self._warmed_up_since):
            return self.rate * (stamp - self._warmed_up_since)
        return self.motion.played - self.rate * (self.clock() - stamp)

    def ready_arm(self, q_start: FloatArray, limits: RobotLimits) -> FloatArray:
        """Waits until the arm may be moved, and returns its positions.

        Args:
            q_start: (7,) where the scenario begins [rad].
            limits: of these joints.

        Returns:
            (7,) measured positions [rad].

        Raises:
            HardwareError: if it is silent, somewhere else, out of limits, moves, or is commanded.
        """
        since = self.clock()
        while not self.motion.stopped and np.isnan(self.motion.measured[0]).all():
            if self.clock() - since > START_UP:
                break
            self._raise_if_asked()
            self.wait()
        # By then any other commander is heard.
        listened = self.clock()
        while self.clock() - listened < 2.0 * SILENCE:
            self.wait()
        q, v = self.motion.measured
        if self.motion.note or np.isnan(q).any():
            raise HardwareError(f"{self.motion.note or 'no status of the arm'} ({self.url})")
        if beyond := beyond_limits(q, limits):
            raise HardwareError(beyond)
        name, off = limits.position_name, np.abs(q - q_start)
        if np.abs(v).max() > _START_SPEED:
            j = int(np.argmax(np.abs(v)))
            raise HardwareError(f"{name[j]} moves at {v[j]:.3g} rad/s; the arm has to rest")
        if off.max() > _START_TOLERANCE:
            j = int(np.argmax(off))
            raise HardwareError(
                f"{name[j]} is at {q[j]:.4g} rad, {off[j]:.3g} from where the scenario begins; "
                f"move the arm to {np.round(q_start, 4).tolist()} rad, to within "
                f"{_START_TOLERANCE:g}"
            )
        return q

    def write(self, t: float, q: FloatArray) -> None:
        """Plans positions of the joints, and waits until the player is near.

        Args:
            t: simulated time [s].
            q: (7,) positions [rad].

        Raises:
            HardwareError: if the arm was stopped.
        """
        if not math.isnan(self._warmed_up_since):
            while self.rate * (self.clock() - self._warmed_up_since) < t:
                self.wait()
            self._raise_if_asked()
            return
        self.motion.write_planned(t, q)
        self._check_streamer(t)
        while t > self.motion.played + LEAD:
            try:
                self._raise_if_asked()
            except KeyboardInterrupt:
                # The monitor of the simulation's steps raises it there.
                return
            self.wait()
            self._check_streamer(t)

    def _check_streamer(self, t: float) -> None:
        """Records changes of the player's state at a simulated time; raises if it has stopped."""
        motion, last = self.motion, self.events[-1][1] if self.events else ""
        note = "arm resumed" if last else ""
        if motion.note:
            note = f"arm {'stopped' if motion.stopped else 'holds'}: {motion.note}"
        if note != last:
            self.events.append((t, note))
        if motion.stopped:
            raise HardwareError(note)
        if self._process is not None and not self._process.is_alive():
            raise HardwareError("arm stopped: the command player has ended")


class CommandStream(LeafSystem):
    """Hands the joints' positions on to the arm, and keeps the simulation to its pace.

    .. pydrake_system::

      name: CommandStream
      input_ports:
      - robot_state
      - obstacles_W (optional)

    - robot_state: positions and velocities (2n,) of the robot's model, which is where the arm is
      to be [rad, m, rad/s, m/s].
    - obstacles_W (optional): abstract `ObstacleClouds`; the table in them is looked at before
      anything moves.

    It publishes at initialization and every `period`, and waits there while simulated time is
    farther ahead of the arm than `LEAD`.
    """

    def __init__(
        self,
        link: RobotLink,
        arm: list[int],
        num_states: int,
        table: TablePlane | None,
    ) -> None:
        """Declares ports and events.

        Args:
            link: what commands.
            arm: where the arm's joints are in the robot's positions.
            num_states: size 2n of the robot's state.
            table: where it has to be; None: anywhere, or none.
        """
        super().__init__()
        self._link, self._arm, self._table = link, arm, table
        self._state = self.DeclareVectorInputPort("robot_state", num_states)
        self._seen = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self.DeclareInitializationPublishEvent(self._begin)
        self.DeclarePeriodicPublishEvent(COMMAND_PERIOD, 0.0, self._publish)

    def _begin(self, context: Context) -> None:
        if self._seen.HasValue(context):
            seen: ObstacleClouds = self._seen.Eval(context)
            check_table(seen, self._table)

    def _publish(self, context: Context) -> None:
        q = self._state.Eval(context)[self._arm]
        self._link.write(context.get_time(), q)


def check_table(seen: ObstacleClouds, table: TablePlane | None) -> None:
    """Checks that the camera sees the table where it is, as one with the right pose does.

    Raises:
        HardwareError: if it is somewhere else, or not seen.
    """
    if table is None:
        return
    if not math.isfinite(seen.stamp) or seen.table is None:
        raise HardwareError(f"the camera does not see the table: {seen.note or 'no plane found'}")
    off = seen.table.offset - table.offset
    tilt = math.acos(min(1.0, abs(float(seen.table.normal_W @ table.normal_W))))
    if abs(off) > _TABLE_TOLERANCE or tilt > _TABLE_TILT:
        raise HardwareError(
            f"the camera sees the table {1e3 * off:+.0f} mm from where it is, and tilted by "
            f"{math.degrees(tilt):.1f} deg: its pose X_PB in the scenario does not fit "
            f"({1e3 * _TABLE_TOLERANCE:.0f} mm and {math.degrees(_TABLE_TILT):.1f} deg "
            "may be off)"
        )


class MeasuredState(LeafSystem):
    """Measured state of the robot, in place of the state of a simulated one.

    .. pydrake_system::

      name: MeasuredState
      output_ports:
      - measured_state

    - measured_state: (2n,) positions and velocities; what the arm's messages do not tell, the
      fingers, stays as at the start [rad, m, rad/s, m/s].
    """

    def __init__(self, link: RobotLink, arm: list[int], q_start: FloatArray) -> None:
        """Declares the port.

        Args:
            link: what hears the arm.
            arm: where its joints are in the robot's positions.
            q_start: (n,) positions at the start [rad, m].
        """
        super().__init__()
        self._link, self._arm, self._q = link, arm, np.array(q_start)
        port = self.DeclareVectorOutputPort("measured_state", 2 * len(q_start), self._calc)
        # The arm moves by itself: what was read is out of date at once.
        port.disable_caching_by_default()

    def _calc(self, _: Context, output: BasicVector) -> None:
        n = len(self._q)
        state: Any = np.concatenate([self._q, np.zeros(n)])
        q, v = self._link.motion.measured
        if np.isfinite(q).all():
            state[self._arm] = q
            state[n + np.array(self._arm)] = v / self._link.rate
        output.SetFromVector(state)
