"""The control layer: torques that make the tool follow the desired motion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable, MultibodyForces
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    LeafSystem,
    ValueProducer,
)

from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.common.ports import Cell, ModelContext, valid_period
from drake_oa.control.operational_space import (
    ArmLimits,
    ArmState,
    DesiredMotion,
    JointTorque,
    no_torque,
    operational_space_torque,
)
from drake_oa.geometry.rotation import rotation_of
from drake_oa.robot.config import Gains

_ORIGIN = np.zeros(3)


@dataclass(frozen=True, eq=False)
class _Joints:
    """Where the joints are in the plant's velocities: arm (moves the tool) and hand."""

    arm: slice
    hand: list[int]
    limits: ArmLimits
    hand_effort: list[float]
    order: IntArray  # actuation[i] = tau[order[i]]


class _Control(NamedTuple):
    """What the law answers, for arm and hand; `arm` is the model at the state of bytes `x`."""

    torque: JointTorque
    hand_force: list[float]
    x: bytes
    arm: ArmState | None


class CartesianInverseDynamics(LeafSystem):
    """Follows a tool motion by operational-space inverse dynamics.

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
      - tracking_error
      - stopping
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
      braked instead (`drake_oa.control.operational_space.braking_torque`), else 0.
    - orientation_error: (3,) rotation vector from the actual to the desired orientation in
      the world frame [rad]; inf while it is not known.

    The robot's model is in the Context, in a cache entry, and the law is evaluated
    once for all outputs.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        *,
        R_WE_desired: RotationMatrix,
        q_posture: FloatArray,
        tool_frame: str,
        gains: Gains | None = None,
        finger_opening: float = 0.04,
        finger_stiffness: float = 400.0,
        finger_damping: float = 10.0,
    ) -> None:
        """Declares the ports.

        Args:
            plant: finalized plant of the robot alone, its base welded to the world,
                every joint of one degree of freedom and actuated. It must outlive
                the system.
            R_WE_desired: orientation of the tool, held where no other is asked for.
            q_posture: posture that the null space is drawn to, where no other is asked for:
                the arm's joints, or all positions of the plant [rad].
            tool_frame: name of the frame E.
            gains: of the law; None: the defaults.
            finger_opening: set point of each joint that does not move the tool [m].
            finger_stiffness: of those joints [N/m].
            finger_damping: of those joints [N s/m].

        Raises:
            ValueError: if the plant is not such a robot, has no such frame, or the
                posture has the wrong size.
        """
        super().__init__()
        if not plant.is_finalized():
            raise ValueError("plant: it must be finalized: call plant.Finalize() first")
        if not plant.HasFrameNamed(tool_frame):
            raise ValueError(f"tool_frame: the plant has no frame '{tool_frame}'")
        self._plant = plant
        self._frame = plant.GetFrameByName(tool_frame)
        self._world = plant.world_frame()
        self._joints = _find_joints(plant, self._frame)
        self._R_WE_desired = np.array(R_WE_desired.matrix())
        self._q_posture = _posture(q_posture, plant.num_positions(), self._joints.arm)
        self._gains = gains or Gains()
        self._finger = (finger_opening, finger_stiffness, finger_damping)
        if not np.all(np.isfinite(self._finger)) or min(self._finger[1:]) < 0.0:
            raise ValueError(
                f"finger opening, stiffness, damping {self._finger} must be finite, and the "
                "last two not negative"
            )

        self._n = n = plant.num_velocities()
        self._state = self.DeclareVectorInputPort("robot_state", 2 * n)
        self._desired = [
            self.DeclareVectorInputPort(f"desired_{name}", 3)
            for name in ("position", "velocity", "acceleration")
        ]
        self._optional = [
            self.DeclareVectorInputPort(f"desired_{name}", size)
            for name, size in (
                ("orientation", 4),
                ("angular_velocity", 3),
                ("angular_acceleration", 3),
            )
        ]
        arm = len(self._joints.limits.effort)
        self._posture = self.DeclareVectorInputPort("desired_posture", 2 * arm)
        self._model = ModelContext(self, plant)
        read = (self._state, *self._desired, *self._optional, self._posture)
        self._law = self.DeclareCacheEntry(
            "operational-space law",
            ValueProducer(allocate=lambda: Value(Cell()), calc=self._calc_law),
            prerequisites_of_calc={port.ticket() for port in read},
        )
        for name, size, calc in (
            ("actuation", n, self._calc_actuation),
            ("torque_saturation", 1, self._calc_saturation),
            ("tracking_error", 3, self._calc_error),
            ("stopping", 1, self._calc_stopping),
            ("orientation_error", 3, self._calc_orientation_error),
        ):
            self.DeclareVectorOutputPort(
                name, size, calc, prerequisites_of_calc={self._law.ticket()}
            )

    def _arm_state(self, context: Context, x: FloatArray) -> ArmState:
        """The model evaluated at a finite state x."""
        plant, frame, world = self._plant, self._frame, self._world
        arm = self._joints.arm
        model = self._model.at(context, x[: self._n], x[self._n :])
        X_WE = frame.CalcPoseInWorld(model)
        J = self._model.jacobian(model, frame)
        bias = plant.CalcBiasSpatialAcceleration(
            model, JacobianWrtVariable.kV, frame, _ORIGIN, world, world
        )
        forces = MultibodyForces(plant)
        plant.CalcForceElementsContribution(model, forces)
        h = plant.CalcInverseDynamics(model, np.zeros(self._n), forces)
        return ArmState(
            q=x[arm],
            v=x[self._n :][arm],
            p_WE=X_WE.translation(),
            R_WE=X_WE.rotation().matrix(),
            M=plant.CalcMassMatrix(model)[arm, arm],
            h=h[arm],
            J=J[:, arm],
            Jdot_v=bias.get_coeffs(),
        )

    def _calc_law(self, context: Context, value: AbstractValue) -> None:
        x = self._state.Eval(context)
        limits = self._joints.limits
        cell: Cell[_Control] = value.get_mutable_value()
        key, arm = x.tobytes(), None
        if math.isfinite(x.dot(x)):
            # Each unrestricted update of any system outdates the law, and few move the arm.
            before = cell.value
            arm = before.arm if before is not None and before.x == key else None
            arm = arm or self._arm_state(context, x)
            p, v, a = [port.Eval(context) for port in self._desired]
            quaternion, w, alpha = [
                port.Eval(context) if port.HasValue(context) else None for port in self._optional
            ]
            R_WE = self._R_WE_desired if quaternion is None else rotation_of(quaternion)
            q_posture, v_posture = self._q_posture, None
            if self._posture.HasValue(context):
                posture = self._posture.Eval(context)
                q_posture, v_posture = posture[: len(q_posture)], posture[len(q_posture) :]
            desired = DesiredMotion(p, v, a, R_WE, w, alpha)
            torque = operational_space_torque(
                arm, desired, q_posture, limits, self._gains, v_posture
            )
        else:
            torque = no_torque(len(limits.effort))
        cell.value = _Control(torque, self._hand_force(x), key, arm)

    def _hand_force(self, x: FloatArray) -> list[float]:
        """Spring and damper on the joints that do not move the tool."""
        opening, stiffness, damping = self._finger
        force = []
        for i, effort in zip(self._joints.hand, self._joints.hand_effort, strict=True):
            wanted = stiffness * (opening - float(x[i])) - damping * float(x[self._n + i])
            force.append(min(max(wanted, -effort), effort) if math.isfinite(wanted) else 0.0)
        return force

    def _eval(self, context: Context) -> _Control:
        cell: Cell[_Control] = self._law.Eval(context)
        return cell.known

    def _calc_actuation(self, context: Context, output: BasicVector) -> None:
        control = self._eval(context)
        joints = self._joints
        tau = np.empty(self._n)
        tau[joints.arm] = control.torque.tau
        tau[joints.hand] = control.hand_force
        output.SetFromVector(tau[joints.order])

    def _calc_saturation(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._eval(context).torque.saturated.any()))

    def _calc_error(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._eval(context).torque.position_error)

    def _calc_orientation_error(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._eval(context).torque.orientation_error)

    def _calc_stopping(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, float(self._eval(context).torque.stopping))


def _find_joints(plant: MultibodyPlant, frame: Frame) -> _Joints:
    """Sorts the joints into those that move the tool and the others."""
    n = plant.num_velocities()
    moving = [
        joint
        for joint in map(plant.get_joint, plant.GetJointIndices())
        if joint.num_velocities() > 0
    ]
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices()]
    order = np.array([a.joint().velocity_start() for a in actuators], dtype=np.int64)
    for joint in moving:
        if joint.num_velocities() != 1 or joint.velocity_start() not in order:
            raise ValueError(
                f"plant: joint '{joint.name()}' has {joint.num_velocities()} degrees of freedom"
                f"{'' if joint.velocity_start() in order else ' and no actuator'}; every joint "
                "must have one and be actuated, and the base be welded to the world"
            )
    tool = frame.body().index()
    arm = [
        joint.velocity_start()
        for joint in moving
        if tool in plant.GetBodiesKinematicallyAffectedBy([joint.index()])
    ]
    if not arm or arm != list(range(arm[0], arm[0] + len(arm))):
        raise ValueError(
            f"tool_frame: the joints that move '{frame.name()}' have indices {arm}; they must "
            "follow one another in the plant's velocities, and there must be one at least"
        )
    moves = slice(arm[0], arm[0] + len(arm))
    hand = [i for i in range(n) if i not in arm]
    effort = np.empty(n)
    for actuator in actuators:
        effort[actuator.joint().velocity_start()] = actuator.effort_limit()
    limits = ArmLimits(
        plant.GetPositionLowerLimits()[moves], plant.GetPositionUpperLimits()[moves], effort[moves]
    )
    return _Joints(moves, hand, limits, effort[hand].tolist(), order)


def _posture(q: FloatArray, n: int, arm: slice) -> FloatArray:
    q = np.array(q, dtype=float)
    count = arm.stop - arm.start
    if q.shape not in ((count,), (n,)) or not np.isfinite(q).all():
        raise ValueError(
            f"q_posture: shape {q.shape} with values {q}; it must hold {count} (the arm) or {n} "
            "(all positions) finite numbers"
        )
    return q if q.shape == (count,) else q[arm]


LARGEST_ERROR = 0.01
"""Nothing is summed up while the tool is farther off: something else is wrong then [m]."""
LARGEST_ACCELERATION = 2.0
"""Most that is added along each axis [m/s^2]; a wrong model of the Panda asks for under 1."""


class IntegralAction(LeafSystem):
    """Adds to the desired acceleration what the controller's model lacks of the truth.

    .. pydrake_system::

      name: IntegralAction
      input_ports:
      - tracking_error
      - desired_acceleration
      output_ports:
      - desired_acceleration

    - tracking_error: (3,) desired minus actual position of the tool in the world [m].
    - desired_acceleration (in): (3,) of the tool point in the world [m/s^2].
    - desired_acceleration (out): (3,) the same plus k_i times the integral of the error.

    The law behind it, e'' + k_d e' + k_p e = 0, leaves the error d / k_p under a lasting
    disturbance d; with the integral it goes to zero, and is stable for k_i < k_p k_d. It
    rests while the error is unknown or larger than `LARGEST_ERROR`, and never adds more than
    `LARGEST_ACCELERATION`, so that a tool that is held back does not gather force.
    """

    def __init__(self, gain: float, *, period: float) -> None:
        """Declares ports, state and events.

        Args:
            gain: k_i [1/s^3].
            period: of the sum [s].

        Raises:
            ValueError: for a gain or period that is not positive.
        """
        super().__init__()
        if not 0.0 < gain < np.inf:
            raise ValueError(f"gain must be positive and finite [1/s^3], not {gain}")
        self._gain, self._period = float(gain), valid_period(period)
        self._error = self.DeclareVectorInputPort("tracking_error", 3)
        self._asked = self.DeclareVectorInputPort("desired_acceleration", 3)
        # The acceleration that is added, rather than the integral.
        self._added = self.DeclareDiscreteState(3)
        self.DeclarePeriodicDiscreteUpdateEvent(period, period, self._sum)
        self.DeclareVectorOutputPort(
            "desired_acceleration",
            3,
            self._calc,
            {self._asked.ticket(), self.discrete_state_ticket(self._added)},
        )

    def _sum(self, context: Context, values: DiscreteValues) -> None:
        added = context.get_discrete_state(self._added).value()
        error = self._error.Eval(context)
        if float(error @ error) <= LARGEST_ERROR**2:
            added = np.clip(
                added + self._gain * self._period * error,
                -LARGEST_ACCELERATION,
                LARGEST_ACCELERATION,
            )
        values.set_value(self._added, added)

    def _calc(self, context: Context, output: BasicVector) -> None:
        added = context.get_discrete_state(self._added).value()
        output.SetFromVector(self._asked.Eval(context) + added)
