"""Connection to a Franka Research 3 by pylibfranka, the client library of its vendor.

The controller of the robot generates the motion between targets within its own limits of
acceleration and jerk, so that this computer needs no control loop at 1 kHz.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from drake_oa.common.config import read_yaml
from drake_oa.common.files import import_extra, package_file
from drake_oa.common.messages import FloatArray
from drake_oa.hardware.command_streamer import LEAD, ArmStoppedError, SharedTrajectory, Status

TARGET_PERIOD = 0.008
"""Wall time between two targets (joint positions to which the robot's controller moves), equal to
the default time step with which MotionGuard commands the joints [s]."""
_GOAL_TOLERANCE = 1e-3
"""Distance of the joints from a target at which the controller reports that the target is reached
[rad]."""
_LAG_GAIN = 0.1
"""Fraction of the arm's measured lag that is added to the lookahead with each target [-]. The
lookahead is the time by which targets are ahead of `SharedTrajectory.executed_time`."""
_MIN_SPEED = 0.05
"""Minimum planned speed, as the norm of all joints' speeds, at which the lag of the arm behind the
planned motion is measured [rad/s]."""
_REST_SPEED, _REST_STATES = 0.01, 1000
"""Maximum speed of each joint of an arm at rest [rad/s], and number of received robot states within
which the arm must be at rest or have recovered from an error, before it counts as failed."""

_logger = logging.getLogger("drake_oa")
"""Logger of the package drake_oa, for warnings about the arm."""

_MODES = {
    "Other": "not ready: unlock its joints, and activate FCI",
    "Idle": "idle: its controller has ended the motion",
    "Move": "moved by another client: end it",
    "Guiding": "being guided by hand: release the button",
    "UserStopped": "stopped by its user: release the stop",
    "AutomaticErrorRecovery": "recovering from an error: wait",
}
"""Descriptions of the robot modes in which the arm does not follow targets, by name of the mode."""

_ERRORS = "package://drake_oa/fr3/errors.yaml"
"""YAML file with cause and remedy of the errors of the robot's controller, by name of the error."""
_OTHER = "a motion of another client or of Desk: end it"
"""Cause and remedy of errors that are not in the file `_ERRORS`: those of Cartesian motions, forces
and torques, which this package does not command."""


@cache
def error_texts() -> dict[str, str]:
    """Returns cause and remedy of the errors of the robot's controller, by name of the error."""
    texts: dict[str, str] = read_yaml(package_file(_ERRORS).read_text())
    return texts


class FrankaArm:
    """Connection to a Franka Research 3 that follows targets of its joint positions.

    The executed time is the simulated time whose planned positions `send` receives. A target
    consists of the planned positions at a later time, the executed time plus the lookahead. The
    robot's controller plans each motion so that it can stop at the target; the arm therefore lags
    behind the target. The lookahead compensates the lag [s] of the controller's desired positions
    behind the executed time: with each target it changes by a fraction (`_LAG_GAIN`) of the present
    lag, within 0 and `LEAD`. Without new targets the arm stops on the planned motion.

    Attributes:
        name: address of the robot.
        period: wall time between two targets [s].
        handler: object of the vendor's library that sends targets to the robot; None before the
            first target.
    """

    period = TARGET_PERIOD

    def __init__(self, host: str, speeds: list[float], trajectory: SharedTrajectory) -> None:
        """Connects to the robot, and recovers it from a reflex.

        Args:
            host: address of the robot.
            speeds: (7,) maximum speeds of the joints [rad/s].
            trajectory: trajectory shared with the diagram. While the robot does not answer, its
                note states possible reasons.

        Raises:
            ValueError: if pylibfranka is not installed.
            ArmStoppedError: if the robot is not reachable or not ready.
        """
        self._franka = import_extra("pylibfranka", "franka")
        self.name, self._speeds, self._trajectory = host, speeds, trajectory
        self.handler: Any = None
        self._lookahead = 0.0
        trajectory.note = f"{host} does not answer: activate FCI, and end its other clients"
        try:
            self._robot = self._franka.Robot(host, self._franka.RealtimeConfig.kIgnore)
        except Exception as error:
            raise ArmStoppedError(f"no connection to {host}: {error}") from None
        trajectory.note = ""
        self._recover()

    def receive(self, now: float) -> Status:
        """Returns the newest state of the robot; waits for one if there is none.

        Args:
            now: time of the wall clock [s].

        Returns:
            `now`, and the measured positions (7,) [rad] and velocities (7,) [rad/s] of the joints.

        Raises:
            ArmStoppedError: if the connection is lost, or the robot does not follow targets.
        """
        state = self._read()
        if reasons := _reasons(state):
            raise ArmStoppedError(reasons)
        if state.robot_mode.name != ("Move" if self.handler else "Idle"):
            raise ArmStoppedError(f"arm is {_MODES[state.robot_mode.name]}")
        return now, np.array(state.q), np.array(state.dq)

    def send(self, now: float, q: FloatArray) -> None:
        """Sends the next target of the joint positions to the robot.

        The first call starts the motion generator of the robot.

        Args:
            now: time of the wall clock, which is not used [s].
            q: (7,) planned joint positions at the simulated time `executed_time` of the shared
                trajectory [rad]; the target is further along the planned motion.

        Raises:
            ArmStoppedError: if the robot rejects the motion, or the connection is lost.
        """
        handler = self._franka.AsyncPositionControlHandler
        if not self.handler:
            limits = handler.Configuration(self._speeds, _GOAL_TOLERANCE)
            started = handler.configure(self._robot, limits)
            if started.error_message:
                raise ArmStoppedError(f"motion rejected by {self.name}: {started.error_message}")
            self.handler = started.handler
        target = handler.JointPositionTarget(self._target(q).tolist())
        result = self.handler.set_joint_position_target(target)
        if not result.was_successful:
            raise ArmStoppedError(f"connection to {self.name} lost: {result.error_message}")

    def close(self) -> None:
        """Waits until the arm is at rest, and ends the motion generator of the robot."""
        try:
            if self.handler:
                self._wait("at rest", lambda state: np.abs(state.dq_d).max() < _REST_SPEED)
                self.handler.stop_control()
        except Exception as error:  # After a reflex, the library has ended the motion itself.
            _logger.warning("%s: stopping the motion generator failed: %s", self.name, error)

    def _target(self, q: FloatArray) -> FloatArray:
        """Returns the next target (7,) [rad]: the planned joint positions at a time ahead of t.

        t is `executed_time` of the shared trajectory, and q (7,) are the planned positions at t
        [rad]. With the planned velocity v and the controller's desired positions q_d::

            lag = (q - q_d) . v / (v . v),    lookahead += _LAG_GAIN * lag,
            target = planned(t + lookahead)
        """
        trajectory, t = self._trajectory, self._trajectory.executed_time
        v = (q - trajectory.planned(t - TARGET_PERIOD)) / TARGET_PERIOD
        if v @ v > _MIN_SPEED**2:
            lag = (q - np.array(self._state.q_d)) @ v / (v @ v)
            self._lookahead = float(np.clip(self._lookahead + _LAG_GAIN * lag, 0.0, LEAD))
        return trajectory.planned(t + self._lookahead)

    def _recover(self) -> None:
        """Recovers the robot from a reflex, and warns about its cause.

        Raises:
            ArmStoppedError: if the robot does not recover.
        """
        if not (reasons := _reasons(self._read())):
            return
        try:
            self._robot.automatic_error_recovery()
        except Exception as error:
            raise ArmStoppedError(f"no recovery from {reasons}: {error}") from None
        self._wait("recovered", lambda state: not _reasons(state))
        _logger.warning("robot recovered from %s", reasons)

    def _wait(self, name: str, is_reached: Callable[[Any], bool]) -> None:
        """Reads states of the robot, at most `_REST_STATES`, until one of them meets a condition.

        Args:
            name: name of the condition in the error.
            is_reached: function that returns whether a state meets the condition.

        Raises:
            ArmStoppedError: if the connection is lost, or the condition is not reached.
        """
        if not any(is_reached(self._read()) for _ in range(_REST_STATES)):
            raise ArmStoppedError(f"arm not {name} after {_REST_STATES} states")

    def _read(self) -> Any:
        """Reads and stores the newest state of the robot.

        Raises:
            ArmStoppedError: if the connection is lost.
        """
        try:
            self._state = self._robot.read_once()
        except Exception as error:
            raise ArmStoppedError(f"connection to {self.name} lost: {error}") from None
        return self._state


def _reasons(state: Any) -> str:
    """Returns the errors of a robot's state with causes and remedies; "" if there is none."""
    is_reflex = state.robot_mode.name == "Reflex"
    use_last = is_reflex and not state.current_errors
    errors = state.last_motion_errors if use_last else state.current_errors
    names = [name for name in dir(errors) if name[0] != "_" and getattr(errors, name)]
    causes = [f"{name}: {error_texts().get(name, _OTHER)}" for name in names]
    return "; ".join(causes) or "a reflex" * is_reflex
