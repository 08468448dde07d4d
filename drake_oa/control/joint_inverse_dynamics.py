"""Drake system that controls the arm in joint space by inverse dynamics, and the base class of both
controllers.

With the arm's equation of motion M(q) dv/dt + h(q, v) = tau, computed torque (J. Y. S. Luh, M. W.
Walker and R. P. C. Paul, IEEE Trans. Automatic Control 25(3), 1980) is

    tau = M (a_d + kd (v_d - v) + kp (q_d - q) + i) + h,    di/dt = ki (q_d - q),

with desired joint positions q_d, velocities v_d and accelerations a_d, and integral action i.
`InverseDynamics` is the common base class of `JointInverseDynamics` and `CartesianInverseDynamics`.
"""

from __future__ import annotations

import logging
import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, MultibodyForces
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem, ValueProducer

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, zeros
from drake_oa.common.ports import valid_period
from drake_oa.robot.arm import check_actuated, joints_to
from drake_oa.robot.config import Gains

_logger = logging.getLogger("drake_oa")
LARGEST_ERROR = 0.02
"""Position error of a joint above which the integral of this error pauses [rad].

With a larger error, contact probably blocks the arm."""
LARGEST_ACCELERATION = 4.0
"""Maximum acceleration that the controller's integral action adds to the desired acceleration of
each joint [rad/s^2]."""
FINGER_STIFFNESS = 400.0
"""Stiffness with which the controller holds each finger joint at its set point [N/m]."""
FINGER_DAMPING = 10.0
"""Damping with which the controller holds each finger joint at its set point [N s/m]."""
LARGEST_STATE = 1e9
"""Magnitude of a position [rad, m] or velocity [rad/s, m/s] from which the controller treats the
robot's state as invalid.

The controller reacts as to a state that is not finite, because torques computed from larger values
would overflow."""


@dataclass(frozen=True, eq=False)
class Command(Frozen):
    """Result of one evaluation of a controller's control law: joint torques, control error and
    status.

    Attributes:
        tau: (m,) torques and forces of all m joints in the order of the plant's velocities, finite
            and within the limits [N m, N].
        saturated: whether the control law exceeds the effort limit of an arm joint.
        stopping: whether the joints are braked because an input is not finite.
        error: control error; inf while the joints are braked. In joint space: (n,) desired minus
            actual positions of the arm's n joints [rad]. For the tool: (6,) rotation vector from
            the actual to the desired orientation (3) [rad], then desired minus actual position (3)
            [m], both in the world frame.
    """

    tau: FloatArray = zeros(0)
    saturated: bool = False
    stopping: bool = False
    error: FloatArray = zeros(0)


class InverseDynamics(LeafSystem):
    """Base class of inverse-dynamics controllers of an arm with springs on the finger joints.

    .. pydrake_system::

      name: InverseDynamics
      input_ports:
      - robot_state
      output_ports:
      - actuation
      - torque_saturation
      - stopping

    - robot_state: (2m,) positions and velocities of the robot's m joints [rad, m, rad/s, m/s].
    - actuation: (m,) torques and forces in the order of the plant's actuators [N m, N].
    - torque_saturation: (1,) 1 while the control law exceeds the effort limit of an arm joint,
      otherwise 0.
    - stopping: (1,) 1 while the joints are braked because an input is not finite, otherwise 0.

    With the arm's equation of motion M dv/dt + h = tau (mass matrix M, gravity and velocity terms
    h), a subclass computes tau - h and the control error, desired minus actual. The subclass also
    declares a discrete state. For each component of the error, the state has one element:
    `ki_position` times the integral of this component, an acceleration. The last element of the
    state is 1 while the arm is braked, otherwise 0. Braking applies the torques -kd_stop M v + h
    or, if the robot's state is not finite, 0. When braking begins, a warning names the invalid
    inputs. The control law is evaluated once for all outputs. The Context of the robot's plant is a
    cache entry.
    """

    largest_error: FloatArray | float
    """Magnitude of a component of the control error above which the integral of this component
    pauses [m or rad]; 0: the component has no integral action."""
    max_correction: float
    """Maximum acceleration that integral action adds to each component of the controlled motion
    [m/s^2 or rad/s^2]."""

    def __init__(
        self,
        plant: MultibodyPlant,
        *,
        tool_frame: str,
        gains: Gains | None = None,
        finger_opening: float = 0.04,
        period: float = 0.008,
    ) -> None:
        """Declares the shared ports, the cache entries and the update of the integral.

        Args:
            plant: finalized plant of the robot alone, its base welded to the world, every joint of
                one degree of freedom and actuated. It must outlive the system.
            tool_frame: name of the tool frame E, which the arm's joints move.
            gains: gains of the controller; None: the defaults.
            finger_opening: set point of each finger joint [m]; all joints that do not move E count
                as finger joints.
            period: period with which the integral is updated [s].

        Raises:
            ValueError: if a joint that is not fixed has no actuator, if no joint moves E, if the
                joints that move E are not revolute or not consecutive, or if the period is not
                positive.
        """
        super().__init__()
        check_actuated(plant)
        self._plant, self._frame = plant, plant.GetFrameByName(tool_frame)
        self._gains, self._opening = gains or Gains(), finger_opening
        self._period, self._m = valid_period(period), plant.num_velocities()
        actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
        self._order = [actuator.joint().velocity_start() for actuator in actuators]
        self._effort = np.empty(self._m)
        self._effort[self._order] = plant.GetEffortUpperLimits()
        self._arm = find_arm(plant, self._frame)
        self._n = self._arm.stop - self._arm.start
        self._hand = np.delete(np.arange(self._m), self._arm)
        self._state = self.DeclareVectorInputPort("robot_state", 2 * self._m)
        self._model = self.DeclareCacheEntry(
            "context of the robot's model",
            ValueProducer(lambda: Value(plant.CreateDefaultContext()), ValueProducer.NoopCalc),
            {self.nothing_ticket()},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(self._period, self._period, self._update)
        self._command = self.DeclareCacheEntry(
            "joint torques",
            ValueProducer(allocate=lambda: Value(Command()), calc=self._calc_command),
            prerequisites_of_calc={self.all_input_ports_ticket(), self.xd_ticket()},
        )
        self._declare_output("actuation", self._m, lambda command: command.tau[self._order])
        self._declare_output("torque_saturation", 1, lambda command: np.full(1, command.saturated))
        self._declare_output("stopping", 1, lambda command: np.full(1, command.stopping))

    def _declare_output(self, name: str, size: int, part: Callable[[Command], Any]) -> None:
        """Declares a vector output port that publishes a part of the current `Command`, the result
        of the control law.

        Args:
            name: name of the port.
            size: size of the vector.
            part: function from the command to the vector.
        """
        self.DeclareVectorOutputPort(
            name,
            size,
            lambda context, output: output.SetFromVector(part(self._evaluate(context))),
            prerequisites_of_calc={self._command.ticket()},
        )

    def _evaluate(self, context: Context) -> Command:
        command: Command = self._command.Eval(context)
        return command

    @abstractmethod
    def _drive(
        self, context: Context, model: Context, M: FloatArray, correction: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Computes the torques that accelerate the arm, without those that compensate gravity and
        velocity terms.

        Args:
            context: context of the system.
            model: context of the plant, set to the robot's current state, which is finite.
            M: (n, n) mass matrix of the arm's n joints, reflected rotor inertia included [kg m^2].
            correction: (k,) acceleration that integral action adds to each component of the
                controlled motion [m/s^2 or rad/s^2].

        Returns:
            Torques (n,) without those against gravity and velocity terms [N m], not finite if an
            input is not; and control error (k,), desired minus actual [rad or m].
        """

    def _update(self, context: Context, values: DiscreteValues) -> None:
        """Updates the integral of the error, and logs when braking begins.

        The message names the inputs that are not finite or not below `LARGEST_STATE` or, without
        such inputs, a quaternion that is zero.
        """
        command, state = self._evaluate(context), context.get_discrete_state_vector().value()
        integrand = np.where(np.abs(command.error) <= self.largest_error, command.error, 0.0)
        correction = state[:-1] + self._period * self._gains.ki_position * integrand
        correction = np.clip(correction, -self.max_correction, self.max_correction)
        values.set_value(np.append(correction, command.stopping))
        if command.stopping and not state[-1]:
            ports = [self.get_input_port(i) for i in range(self.num_input_ports())]
            inputs = {p.get_name(): p.Eval(context) for p in ports if p.HasValue(context)}
            names = [name for name, x in inputs.items() if not np.abs(x).max() < LARGEST_STATE]
            invalid = ", ".join(names) or "the rotation of a zero quaternion"
            message = "t=%.3f s: the arm is braked; not finite: %s"
            _logger.warning(message, context.get_time(), invalid)

    # Inputs that are not finite are expected, and detected by the sum of the drive.
    @np.errstate(over="ignore", invalid="ignore")
    def _calc_command(self, context: Context, value: AbstractValue) -> None:
        plant, arm, hand, effort = self._plant, self._arm, self._hand, self._effort
        q, v = np.split(self._state.Eval(context), 2)
        correction = context.get_discrete_state_vector().value()[:-1]
        unknown = np.full(len(correction), np.inf)
        tau, saturated, stopping, error = np.zeros(self._m), False, True, unknown
        spring = FINGER_STIFFNESS * (self._opening - q[hand]) - FINGER_DAMPING * v[hand]
        tau[hand] = np.clip(np.nan_to_num(spring), -effort[hand], effort[hand])
        if np.abs([q, v]).max() < LARGEST_STATE:
            entry = self._model.get_mutable_cache_entry_value(context)
            model: Context = entry.GetMutableValueOrThrow()
            plant.SetPositionsAndVelocities(model, self._state.Eval(context))
            forces = MultibodyForces(plant)
            plant.CalcForceElementsContribution(model, forces)
            bias = plant.CalcInverseDynamics(model, np.zeros(self._m), forces)[arm]
            M = plant.CalcMassMatrix(model)[arm, arm]
            drive, error = self._drive(context, model, M, correction)
            stopping = not math.isfinite(drive.sum())
            if stopping:
                drive, error = -self._gains.kd_stop * (M @ v[arm]), unknown
            tau[arm], saturated = limit_torque(bias, drive, effort[arm])
        value.set_value(Command(tau, saturated, stopping, error))


class JointInverseDynamics(InverseDynamics):
    """Inverse-dynamics controller that tracks a desired motion of the arm's joints.

    .. pydrake_system::

      name: JointInverseDynamics
      input_ports:
      - robot_state
      - desired_joint_state
      - desired_joint_acceleration
      output_ports:
      - actuation
      - torque_saturation
      - stopping

    - robot_state: (2m,) positions and velocities of the robot's m joints [rad, m, rad/s, m/s].
    - desired_joint_state: (2n,) positions [rad] and velocities [rad/s] of the arm's n joints.
    - desired_joint_acceleration: (n,) accelerations of the arm's joints [rad/s^2].
    - actuation: (m,) torques and forces in the order of the plant's actuators [N m, N]: the control
      law below for the arm, spring and damper for the other joints.
    - torque_saturation: (1,) 1 while the control law exceeds the effort limit of an arm joint,
      otherwise 0.
    - stopping: (1,) 1 while the joints are braked because an input is not finite, otherwise 0; the
      torque of the arm is 0 if the robot's state is not finite.

    The control law is

        tau = M (a_d + kd_position (v_d - v) + kp_position (q_d - q) + i) + h,
        di/dt = ki_position (q_d - q), which pauses for a joint while |q_d - q| > 0.02 rad,

    with measured q and v, desired q_d, v_d and a_d, integral action i, mass matrix M, gravity and
    velocity terms h, and the gains of the configuration `robot.gains`. Braking applies the torques
    -kd_stop M v + h. If a torque exceeds its limit, the accelerating torques tau - h of all joints
    are reduced by the same factor. The direction of the acceleration then does not change. Drake's
    `InverseDynamicsController` does not limit torques, and outputs NaN for a state that is not
    finite.
    """

    largest_error, max_correction = LARGEST_ERROR, LARGEST_ACCELERATION

    def __init__(self, plant: MultibodyPlant, **options: Any) -> None:
        """Declares the ports and the state of the controller.

        Args:
            plant: finalized plant of the robot alone, its base welded to the world, every joint of
                one degree of freedom and actuated. It must outlive the system.
            options: keyword arguments tool_frame (required), gains, finger_opening and period of
                `InverseDynamics`. For a plant of `make_robot_plant`, tool_frame is
                `robot_plant.tool_frame.name()`, and finger_opening the field of the block `robot`.
        """
        super().__init__(plant, **options)
        self._desired = self.DeclareVectorInputPort("desired_joint_state", 2 * self._n)
        self._acceleration = self.DeclareVectorInputPort("desired_joint_acceleration", self._n)
        self.DeclareDiscreteState(self._n + 1)

    def _drive(
        self, context: Context, model: Context, M: FloatArray, correction: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        state, gains = np.reshape(self._state.Eval(context), (2, -1)), self._gains
        error, error_rate = np.reshape(self._desired.Eval(context), (2, -1)) - state[:, self._arm]
        acceleration = (
            self._acceleration.Eval(context)
            + gains.kp_position * error
            + gains.kd_position * error_rate
            + correction
        )
        return M @ acceleration, error


def find_arm(plant: MultibodyPlant, frame: Frame) -> slice:
    """Finds the joints that move the tool, and returns their range as a slice of the plant's
    velocities.

    Args:
        plant: finalized plant of the robot.
        frame: tool frame E.

    Raises:
        ValueError: if no joint moves the tool frame, or if the joints that move the tool frame are
            not revolute or not consecutive.
    """
    arm = [joint.velocity_start() for joint in joints_to(plant, frame)]
    if not arm or arm != list(range(arm[0], arm[0] + len(arm))):
        raise ValueError(
            f"tool_frame: the joints that move '{frame.name()}' have indices {arm}; there must be "
            "at least one, and the indices in the plant's velocities must be consecutive"
        )
    return slice(arm[0], arm[0] + len(arm))


def limit_torque(
    bias: FloatArray, drive: FloatArray, effort: FloatArray
) -> tuple[FloatArray, bool]:
    """Limits the torques tau = bias + drive of an arm to the effort limits of the joints.

    If a joint exceeds its effort limit, the drive of all joints is scaled by the largest factor in
    [0, 1] for which all torques are within their limits. Gravity remains compensated, and the
    acceleration keeps its direction. Clipping each joint separately would bend the tool's path and
    rotate the tool. A bias that alone exceeds a limit is clipped.

    Args:
        bias: (n,) torques that compensate gravity and velocity terms [N m].
        drive: (n,) torques that accelerate the arm [N m].
        effort: (n,) maximum magnitudes of the torques [N m].

    Returns:
        Torques (n,) within the limits [N m], and whether bias + drive exceeds a limit.
    """
    saturated: BoolArray = np.abs(bias + drive) > effort
    acts = drive != 0.0
    room = (np.sign(drive) * effort - bias)[acts] / drive[acts]
    factor = np.clip(room.min(initial=1.0), 0.0, 1.0)
    return np.clip(bias + factor * drive, -effort, effort), bool(saturated.any())
