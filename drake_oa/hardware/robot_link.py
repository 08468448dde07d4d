"""Link between a diagram and an arm that follows joint positions, and the systems that connect this
link to the diagram.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.process import BaseProcess
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector, Context, LeafSystem

from drake_oa.common.messages import FloatArray, ObstacleClouds, TablePlane
from drake_oa.hardware.command_streamer import (
    COMMAND_PERIOD,
    LEAD,
    STATUS_TIMEOUT,
    Connect,
    beyond_limits,
    connect_lcm,
    shared_trajectory,
    stream_commands,
)
from drake_oa.robot.plant import RobotLimits

_POLL_PERIOD = 5e-4
"""Wall time between two checks of the command streamer's progress, while the diagram waits for the
arm [s]."""
STARTUP_TIMEOUT = 30.0
"""Maximum time from the start of the command streamer's process to the first status of the arm [s].
"""
_START_TOLERANCE, _START_SPEED = 0.1, 0.05
"""Maximum distance of each measured joint from the scenario's start [rad], and maximum measured
speed of each joint [rad/s], at which a hardware run may begin."""
_TABLE_TOLERANCE, _TABLE_TILT = 0.015, math.radians(1.5)
"""Maximum difference in height [m] and maximum angle [rad] between the perceived and the configured
table, used to check the configured camera pose."""


class HardwareError(Exception):
    """Failure that prevents or ends the motion of the arm in a hardware run; the text of the
    exception states the reason.
    """


class RobotLink:
    """Link between a diagram, which plans joint positions, and an arm that follows them.

    The diagram writes planned positions into shared memory. A `CommandStreamer` in a separate
    process, which `start` starts, sends them to the arm, so that long computations of the diagram
    do not delay the commands.

    Attributes:
        trajectory: planned and measured positions, in memory that is shared with the command
            streamer.
        rate: maximum ratio of simulated time to wall time [-].
        url: URL of the LCM bus of the images.
        clock: function that returns the time of the wall clock [s].
        wait: function that is called repeatedly while the link waits for the arm, for a message or
            for the wall clock.
        events: changes of the arm's state (stopped, holds, resumed), each as simulated time [s] and
            text.
    """

    def __init__(
        self,
        lcm_url: str,
        *,
        connect: Connect | None = None,
        address: str | None = None,
        rate: float = 1.0,
        wait: Callable[[], None] = lambda: time.sleep(_POLL_PERIOD),
        raise_if_requested: Callable[[], None] = lambda: None,
        clock: Callable[[], float] = time.time,
    ) -> None:
        """Allocates the shared memory of the trajectory, without starting the command streamer.

        Args:
            lcm_url: URL of the LCM bus of the images.
            connect: function that connects to the arm, in the process of the command streamer;
                None: the arm communicates on the same LCM bus.
            address: address of the arm for messages to the user; None: `lcm_url`.
            rate: maximum ratio of simulated time to wall time [-].
            wait: function that is called repeatedly while the diagram waits, for example because it
                is too far ahead of the arm.
            raise_if_requested: function that raises KeyboardInterrupt if the user has requested the
                end of the run.
            clock: function that returns the time of the wall clock [s].
        """
        self.trajectory, self.rate = shared_trajectory(), rate
        self.url, self.wait, self.clock = lcm_url, wait, clock
        self._connect, self._address = connect or partial(connect_lcm, lcm_url), address or lcm_url
        self._raise_if_requested = raise_if_requested
        self.events: list[tuple[float, str]] = []
        self._warmed_up_since = math.nan
        self._process: BaseProcess | None = None

    def start(self) -> None:
        """Starts the process of the command streamer. The streamer sends no command before `write`
        has written the first planned positions.
        """
        self._process = multiprocessing.get_context("spawn").Process(
            target=stream_commands,
            args=(self.trajectory, self._connect, self.rate, os.getpid()),
            name="command streamer",
            # The streamer must outlive this process, to bring the arm to rest.
            daemon=False,
        )
        self._process.start()

    def close(self) -> None:
        """Requests that the command streamer brings the arm to rest along the planned positions,
        and ends the streamer's process.
        """
        self.trajectory.end_requested = 1.0
        if self._process is not None:
            self._process.join(timeout=5.0)
            if self._process.is_alive():
                self._process.kill()
                self._process.join()

    @contextmanager
    def warmup(self) -> Iterator[None]:
        """Provides a context for slow work before the motion, in which no commands are sent and
        simulated time follows the wall clock.

        The work includes, for example, loading compiled kernels and waiting for images.
        """
        self._warmed_up_since = self.clock()
        try:
            yield
        finally:
            self._warmed_up_since = math.nan

    def to_simulated(self, stamp: float) -> float:
        """Converts a recent time of the wall clock to simulated time [s].

        The result is the simulated time up to which the planned motion had been sent to the arm at
        that wall time. It is exact if the motion has advanced at the full `rate` since. In the
        warm-up before the motion, it is `rate` times the wall time from the start of the warm-up.

        Args:
            stamp: time of the wall clock [s].
        """
        if not math.isnan(self._warmed_up_since):
            return self.rate * (stamp - self._warmed_up_since)
        return self.trajectory.executed_time - self.rate * (self.clock() - stamp)

    def ready_arm(self, q_start: FloatArray, limits: RobotLimits) -> FloatArray:
        """Waits for a status of the arm, and checks before a run that the arm can start the motion.

        Args:
            q_start: (7,) start configuration of the scenario [rad].
            limits: limits of these joints, in the same order.

        Returns:
            (7,) measured positions of the arm's joints [rad].

        Raises:
            HardwareError: if the arm sends no status, is not at the start, has a joint outside its
                position limits, is not at rest, or receives commands of another source.
        """
        since = self.clock()
        while not self.trajectory.is_stopped and np.isnan(self.trajectory.measured[0]).all():
            if self.clock() - since > STARTUP_TIMEOUT:
                break
            self.wait_for_message()
        # During this time, the streamer would detect another command source.
        begin = self.clock()
        while self.clock() - begin < 2.0 * STATUS_TIMEOUT:
            self.wait_for_message()
        q, v = self.trajectory.measured
        if self.trajectory.note or np.isnan(q).any():
            note = self.trajectory.note or "no status of the arm received"
            raise HardwareError(f"{note} ({self._address})")
        if problem := beyond_limits(q, limits):
            raise HardwareError(problem)
        name, deviation = limits.position_name, np.abs(q - q_start)
        if np.abs(v).max() > _START_SPEED:
            j = int(np.argmax(np.abs(v)))
            raise HardwareError(f"{name[j]} moves at {v[j]:.3g} rad/s; the arm must be at rest")
        if deviation.max() > _START_TOLERANCE:
            j = int(np.argmax(deviation))
            raise HardwareError(
                f"{name[j]} is at {q[j]:.4g} rad, {deviation[j]:.3g} rad from the scenario's "
                f"start; move the arm to within {_START_TOLERANCE:g} rad of "
                f"{np.round(q_start, 4).tolist()} rad"
            )
        return q

    def wait_for_message(self) -> None:
        """Waits once, by default for 0.5 ms, so that a message may arrive.

        Raises:
            KeyboardInterrupt: if the user has requested the end of the run.
            HardwareError: if the command streamer has ended.
        """
        self._raise_if_requested()
        if self._process is not None and not self._process.is_alive():
            note = self.trajectory.note or "the process of the command streamer has ended"
            raise HardwareError(f"{note} ({self._address})")
        self.wait()

    def write(self, t: float, q: FloatArray) -> None:
        """Writes planned joint positions for the command streamer, and waits until simulated time
        is at most `LEAD` (0.04 s) ahead of the arm.

        In the warm-up before the motion, nothing is written, and simulated time waits for the wall
        clock.

        Args:
            t: simulated time [s].
            q: (7,) planned positions of the arm's joints [rad].

        Raises:
            HardwareError: if the command streamer has stopped the arm or has ended.
        """
        if not math.isnan(self._warmed_up_since):
            while self.rate * (self.clock() - self._warmed_up_since) < t:
                self.wait()
            self._raise_if_requested()
            return
        self.trajectory.write_planned(t, q)
        self._check_streamer(t)
        while t > self.trajectory.executed_time + LEAD:
            try:
                self._raise_if_requested()
            except KeyboardInterrupt:
                # The monitor of the simulation raises it again after this step.
                return
            self.wait()
            self._check_streamer(t)

    def _check_streamer(self, t: float) -> None:
        """Checks whether the command streamer has stopped, held or resumed the arm, and records
        each change as an event at a simulated time t [s].

        Raises:
            HardwareError: if the command streamer has stopped the arm or has ended.
        """
        last = self.events[-1][1] if self.events else ""
        note = "arm resumed" if last else ""
        # The streamer writes the reason before `is_stopped`, which is therefore read first.
        is_stopped = self.trajectory.is_stopped
        if reason := self.trajectory.note:
            note = f"arm {'stopped' if is_stopped else 'holds'}: {reason}"
        if note != last:
            self.events.append((t, note))
        if is_stopped:
            raise HardwareError(note)
        if self._process is not None and not self._process.is_alive():
            raise HardwareError("arm stopped: the process of the command streamer has ended")


class CommandStream(LeafSystem):
    """System that writes the planned joint positions of the arm to a `RobotLink`, and delays the
    simulation so that it stays just ahead of the arm.

    .. pydrake_system::

      name: CommandStream
      input_ports:
      - robot_state
      - obstacles_W (optional)

    - robot_state: (2n,) positions and velocities of the simulated robot [rad, m, rad/s, m/s]. The
      positions of its arm are the planned positions.
    - obstacles_W (optional): abstract `ObstacleClouds`, the observation that contains the perceived
      table. At initialization, the perceived table is compared with the configured table
      (`check_table`). Not connected: the table is not checked.

    The system writes positions every 0.004 s of simulated time (`COMMAND_PERIOD`), and waits while
    simulated time is more than 0.04 s (`LEAD`) ahead of the arm.
    """

    def __init__(
        self, link: RobotLink, arm: list[int], num_states: int, table: TablePlane | None
    ) -> None:
        """Declares the input ports and events of the system.

        Args:
            link: link to the arm.
            arm: indices of the arm's joints in the robot's positions.
            num_states: size 2n of the robot's state.
            table: configured table plane; None: the table is not checked.
        """
        super().__init__()
        self._link, self._arm, self._table = link, arm, table
        self._state = self.DeclareVectorInputPort("robot_state", num_states)
        self._obstacles = self.DeclareAbstractInputPort("obstacles_W", Value(ObstacleClouds()))
        self.DeclareInitializationPublishEvent(self._begin)
        self.DeclarePeriodicPublishEvent(COMMAND_PERIOD, 0.0, self._publish)

    def _begin(self, context: Context) -> None:
        """Compares the perceived table with the configured table at the initialization of the
        simulation, if the port `obstacles_W` is connected.
        """
        if self._obstacles.HasValue(context):
            perceived: ObstacleClouds = self._obstacles.Eval(context)
            check_table(perceived, self._table)

    def _publish(self, context: Context) -> None:
        """Writes the simulated joint positions of the arm to the link, from where the command
        streamer sends them to the real arm as commands.
        """
        q = self._state.Eval(context)[self._arm]
        self._link.write(context.get_time(), q)


def check_table(perceived: ObstacleClouds, table: TablePlane | None) -> None:
    """Checks whether the configured camera pose is correct, by comparing the perceived table with
    the configured table.

    Args:
        perceived: observation of the obstacles, which contains the perceived table.
        table: configured table plane; None: no check.

    Raises:
        HardwareError: if no table is perceived, or if it differs from the configured table by more
            than 15 mm in height or 1.5 degrees in tilt.
    """
    if table is None:
        return
    if not math.isfinite(perceived.stamp) or perceived.table is None:
        raise HardwareError(f"table not perceived: {perceived.note or 'no plane detected'}")
    deviation = perceived.table.offset - table.offset
    tilt = math.acos(min(1.0, abs(float(perceived.table.normal_W @ table.normal_W))))
    if abs(deviation) > _TABLE_TOLERANCE or tilt > _TABLE_TILT:
        raise HardwareError(
            f"perceived table is {1e3 * deviation:+.0f} mm from the configured height and tilted "
            f"by {math.degrees(tilt):.1f} deg, at most {1e3 * _TABLE_TOLERANCE:.0f} mm and "
            f"{math.degrees(_TABLE_TILT):.1f} deg allowed: correct the camera pose X_PB in the "
            "scenario"
        )


class MeasuredState(LeafSystem):
    """System that outputs the measured state of the robot, for a diagram in which the simulated
    state is only the planned state.

    .. pydrake_system::

      name: MeasuredState
      output_ports:
      - measured_state

    - measured_state: (2n,) positions and velocities of the robot [rad, m, rad/s, m/s]. Velocities
      are with respect to simulated time. Joints without measurements, such as those of the fingers,
      have their start positions and zero velocities.
    """

    def __init__(self, link: RobotLink, arm: list[int], q_start: FloatArray) -> None:
        """Declares the output port `measured_state`.

        Args:
            link: link to the arm, from which measurements are read.
            arm: indices of the arm's joints in the robot's positions.
            q_start: (n,) start positions of the robot [rad, m].
        """
        super().__init__()
        self._link, self._arm, self._q = link, arm, np.array(q_start)
        port = self.DeclareVectorOutputPort("measured_state", 2 * len(q_start), self._calc)
        # The measured state changes independently of the Context, so that it must not be cached.
        port.disable_caching_by_default()

    def _calc(self, _: Context, output: BasicVector) -> None:
        """Sets the output port `measured_state` to the last measurements of the arm's joints, and
        to the start positions of other joints.
        """
        n = len(self._q)
        state: Any = np.concatenate([self._q, np.zeros(n)])
        q, v = self._link.trajectory.measured
        if np.isfinite(q).all():
            state[self._arm] = q
            state[n + np.array(self._arm)] = v / self._link.rate
        output.SetFromVector(state)
