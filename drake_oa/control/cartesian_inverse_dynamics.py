"""The control layer of the paper: torques that make the tool follow its desired motion."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.systems.framework import Context

from drake_oa.common.messages import FloatArray
from drake_oa.control.joint_inverse_dynamics import InverseDynamics
from drake_oa.control.operational_space import operational_space_drive
from drake_oa.robot.arm import rotation_of, rotation_vector

LARGEST_ERROR = 0.01
"""Error of the tool position along an axis above which the integral rests: another cause is likely
then [m]."""
LARGEST_ACCELERATION = 2.0
"""Largest acceleration by which the integral corrects each axis [m/s^2]; a wrong model of the Panda
needs less than 1."""


class CartesianInverseDynamics(InverseDynamics):
    """Controller of the tool's motion by operational-space inverse dynamics.

    .. pydrake_system::

      name: CartesianInverseDynamics
      input_ports:
      - robot_state
      - desired_position
      - desired_velocity
      - desired_acceleration
      - desired_orientation (optional)
      - desired_angular_velocity (optional)
      - desired_angular_acceleration (optional)
      - desired_posture (optional)
      output_ports:
      - actuation
      - torque_saturation
      - stopping
      - tracking_error
      - orientation_error

    - robot_state: positions and velocities of the robot, (2n,), 18 for the Panda with
      its hand [rad, m, rad/s, m/s].
    - desired_position: (3,) of the tool point in the world frame [m].
    - desired_velocity: (3,) of the tool point in the world frame [m/s].
    - desired_acceleration: (3,) of the tool point in the world frame [m/s^2].
    - desired_orientation (optional): (4,) quaternion w, x, y, z of R_WE, of either sign and
      any length but zero. Without it the orientation is the constructor's.
    - desired_angular_velocity (optional): (3,) w_WE in the world frame [rad/s]; without it 0.
    - desired_angular_acceleration (optional): (3,) in the world frame [rad/s^2]; without it 0.
    - desired_posture (optional): (2m,) positions and velocities of the arm's m joints that the
      null space is drawn to [rad, rad/s]. Without it the constructor's, at rest.
    - actuation: (n,) in the order of the plant's actuators [N m, N]: the law of
      `drake_oa.control.operational_space` for the arm; a spring and damper that hold the fingers.
    - torque_saturation: (1,) 1 while an arm joint is asked for more than its effort
      limit, else 0.
    - tracking_error: (3,) desired minus actual position in the world frame [m]; inf
      while it is not known.
    - stopping: (1,) 1 while an input is not finite, or the quaternion zero, and the joints are
      braked instead, else 0; with a state that is not finite they have no torque.
    - orientation_error: (3,) rotation vector from the actual to the desired orientation in
      the world frame [rad]; inf while it is not known.

    The position error e obeys e'' + kd e' + kp e = d under a lasting disturbance d, as of a wrong
    model: it would stay at d / kp. `ki_position` times its integral, summed up each period, is
    added to the desired acceleration, so that it goes to zero. The integral rests while the error
    is larger than `LARGEST_ERROR`, and never adds more than `LARGEST_ACCELERATION`, so that a tool
    that is held back does not gather force.

    The task acceleration is A_c = (alpha_c, a_c) with

        a_c = a_d + kd_position (v_d - v) + kp_position (p_d - p) + ki_position int (p_d - p) dt,
        alpha_c = alpha_d + kd_orientation (w_d - w) + kp_orientation log(R_d R^T),

    and the posture acceleration

        a_0 = kp_posture (q_posture - q) + kd_posture (v_posture - v).
    """

    largest_error = np.repeat([0.0, LARGEST_ERROR], 3)
    max_correction = LARGEST_ACCELERATION

    def __init__(
        self,
        plant: MultibodyPlant,
        *,
        R_WE_desired: RotationMatrix,
        q_posture: FloatArray,
        **options: Any,
    ) -> None:
        """Declares ports and state.

        Args:
            plant: as of `InverseDynamics`, like all other arguments.
            R_WE_desired: orientation of the tool, held where no other is asked for.
            q_posture: (nq,) positions of the plant, to whose arm the null space is drawn, where no
                other posture is asked for [rad, m].
        """
        super().__init__(plant, **options)
        gains = self._gains
        self._kp = np.repeat([gains.kp_orientation, gains.kp_position], 3)
        self._kd = np.repeat([gains.kd_orientation, gains.kd_position], 3)
        self._desired = [
            self.DeclareVectorInputPort(f"desired_{name}", 3)
            for name in ("position", "velocity", "acceleration")
        ]
        defaults = {
            "orientation": R_WE_desired.ToQuaternion().wxyz(),
            "angular_velocity": np.zeros(3),
            "angular_acceleration": np.zeros(3),
            "posture": np.append(np.asarray(q_posture)[self._arm], np.zeros(self._n)),
        }
        self._optional = [
            (self.DeclareVectorInputPort(f"desired_{name}", len(default)), default)
            for name, default in defaults.items()
        ]
        self.DeclareDiscreteState(6)
        self._offer("tracking_error", 3, lambda command: command.error[3:])
        self._offer("orientation_error", 3, lambda command: command.error[:3])

    def _drive(
        self, context: Context, model: Context, M: FloatArray, correction: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        gains, arm = self._gains, self._arm
        q, v = np.reshape(self._state.Eval(context), (2, -1))[:, arm]
        p_d, v_d, a_d = (port.Eval(context) for port in self._desired)
        quaternion, w_d, alpha_d, posture = (
            port.Eval(context) if port.HasValue(context) else default
            for port, default in self._optional
        )
        X_WE, world = self._frame.CalcPoseInWorld(model), self._plant.world_frame()
        of_frame = model, JacobianWrtVariable.kV, self._frame, np.zeros(3), world, world
        J = self._plant.CalcJacobianSpatialVelocity(*of_frame)[:, arm]
        bias = self._plant.CalcBiasSpatialAcceleration(*of_frame)
        R_error = rotation_of(quaternion) @ X_WE.rotation().matrix().T
        error = np.concatenate((rotation_vector(R_error), p_d - X_WE.translation()))
        velocity_error = np.concatenate((w_d, v_d)) - J @ v
        task = (
            np.concatenate((alpha_d, a_d))
            + self._kd * velocity_error
            + self._kp * error
            + correction
            - bias.get_coeffs()
        )
        q_posture, v_posture = np.split(posture, 2)
        a_0 = gains.kp_posture * (q_posture - q) + gains.kd_posture * (v_posture - v)
        return operational_space_drive(M, J, task, a_0, gains), error
