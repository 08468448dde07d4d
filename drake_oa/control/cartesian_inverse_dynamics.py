"""Drake system of the control layer that tracks a tool motion by operational-space inverse
dynamics.
"""

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
"""Position error of the tool along a world axis above which the integral of this error pauses [m].

A larger error is probably not caused by errors of the robot's model, but by contact or saturation.
"""
LARGEST_ACCELERATION = 2.0
"""Maximum acceleration that the controller's integral action adds to the tool's acceleration along
a world axis [m/s^2].

Model errors of a Panda require less than 1 m/s^2."""


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

    - robot_state: (2n,) positions and velocities of the robot's n joints, 18 elements for the Panda
      with its hand [rad, m, rad/s, m/s].
    - desired_position: (3,) position of the tool point in the world frame [m].
    - desired_velocity: (3,) velocity of the tool point in the world frame [m/s].
    - desired_acceleration: (3,) acceleration of the tool point in the world frame [m/s^2].
    - desired_orientation (optional): (4,) quaternion w, x, y, z of R_WE, of either sign and
      any nonzero length. Not connected: the constructor's orientation.
    - desired_angular_velocity (optional): (3,) w_WE in the world frame [rad/s]. Not connected: 0.
    - desired_angular_acceleration (optional): (3,) alpha_WE in the world frame [rad/s^2]. Not
      connected: 0.
    - desired_posture (optional): (2m,) nominal positions [rad] and velocities [rad/s] of the arm's
      m joints, which the null space tracks. Not connected: the constructor's posture, at rest.
    - actuation: (n,) torques and forces in the order of the plant's actuators [N m, N]: the control
      law below for the arm, spring and damper for the fingers.
    - torque_saturation: (1,) 1 while the control law exceeds the effort limit of an arm joint,
      otherwise 0.
    - tracking_error: (3,) desired minus actual position in the world frame [m]; inf while stopping
      is 1.
    - stopping: (1,) 1 while the joints are braked because an input is not finite or the
      quaternion is zero, otherwise 0; the torque of the arm is 0 if the robot's state is not
      finite.
    - orientation_error: (3,) rotation vector from the actual to the desired orientation in
      the world frame [rad]; inf while stopping is 1.

    Under a constant disturbance d, such as a model error, the position error e obeys
    e'' + kd e' + kp e = d and would remain at d / kp. Integral action removes this error:
    `ki_position` times the integral of e is added to the desired acceleration. So that the force of
    a blocked tool does not grow, the integral pauses along each world axis on which the error
    exceeds `LARGEST_ERROR`, and the added acceleration is limited to `LARGEST_ACCELERATION` along
    each axis. The orientation error has no integral action.

    With the index d for desired quantities of the tool (position p, velocity v, acceleration a,
    rotation R, angular velocity w and angular acceleration alpha), the commanded acceleration of
    the tool is A_c = (alpha_c, a_c) with

        a_c = a_d + kd_position (v_d - v) + kp_position (p_d - p) + ki_position int (p_d - p) dt,
        alpha_c = alpha_d + kd_orientation (w_d - w) + kp_orientation log(R_d R^T),

    where int is the integral over time. With the arm's joint positions q, the acceleration of the
    joints toward the nominal posture is

        a_0 = kp_posture (q_posture - q) + kd_posture (dq_posture/dt - dq/dt).

    With the arm's mass matrix M, gravity and velocity terms h, and the Jacobian J of the tool, the
    torques of the arm are

        tau = M a_0 + J^T (J M^-1 J^T)^-1 (A_c - dJ/dt dq/dt - J a_0) + h,

    where the inverse of J M^-1 J^T is damped near singularities. a_0 acts in the null space.
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
        """Declares the ports and the state of the controller.

        Args:
            plant: finalized plant of the robot alone, its base welded to the world, every joint of
                one degree of freedom and actuated. It must outlive the system.
            R_WE_desired: orientation of the tool, used if desired_orientation is not connected.
            q_posture: (n,) positions of the plant [rad, m]. Those of the arm's joints are the
                nominal posture if desired_posture is not connected.
            options: keyword arguments tool_frame (required), gains, finger_opening and period of
                `InverseDynamics`.
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
        self.DeclareDiscreteState(6 + 1)
        self._declare_output("tracking_error", 3, lambda command: command.error[3:])
        self._declare_output("orientation_error", 3, lambda command: command.error[:3])

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
