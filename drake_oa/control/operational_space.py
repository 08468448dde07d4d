"""Operational-space inverse dynamics: joint torques that move the tool as asked.

With the arm's equation of motion M(q) dv/dt + h(q, v) = tau and the tool's spatial
acceleration A = J dv/dt + dJ/dt v, a task acceleration A_c and a posture
acceleration a_0 give (Khatib, IEEE J. Robotics and Automation 3(1), 1987)

    dv/dt_c = a_0 + J# (A_c - dJ/dt v - J a_0),    tau = M dv/dt_c + h,

with J# = M^-1 J^T (J M^-1 J^T)^-1, the dynamically consistent inverse: what a_0
contributes produces no acceleration of the tool.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray
from drake_oa.control.operational_space_kernels import law, limit_torque
from drake_oa.robot.config import Gains


@dataclass(frozen=True, eq=False)
class ArmLimits:
    """What the n joints of the arm can do.

    Attributes:
        q_lower: (n,) lower position limits [rad].
        q_upper: (n,) upper position limits [rad].
        effort: (n,) largest torque either way [N m], positive; inf where unlimited.
    """

    q_lower: FloatArray
    q_upper: FloatArray
    effort: FloatArray

    def __post_init__(self) -> None:
        if not np.all(self.q_lower <= self.q_upper):
            raise ValueError(
                f"ArmLimits: q_lower {self.q_lower} must not exceed q_upper {self.q_upper}"
            )
        if not np.all(self.effort > 0.0):
            raise ValueError(f"ArmLimits: effort {self.effort} must be positive [N m]")


class ArmState(NamedTuple):
    """The arm and its dynamics at one instant; n joints, tool frame E, world W.

    Spatial quantities have Drake's order, rotation before translation.

    Attributes:
        q: (n,) positions [rad].
        v: (n,) velocities [rad/s].
        p_WE: (3,) tool point [m].
        R_WE: (3, 3) tool orientation.
        M: (n, n) mass matrix, reflected rotor inertia included [kg m^2].
        h: (n,) Coriolis and centrifugal minus gravity and joint friction [N m].
        J: (6, n) Jacobian: V_WE = J v.
        Jdot_v: (6,) its bias: A_WE = J dv/dt + Jdot_v.
    """

    q: FloatArray
    v: FloatArray
    p_WE: FloatArray
    R_WE: FloatArray
    M: FloatArray
    h: FloatArray
    J: FloatArray
    Jdot_v: FloatArray


class DesiredMotion(NamedTuple):
    """The tool motion asked for, in the world frame.

    Attributes:
        p_WE: (3,) position [m].
        v_WE: (3,) velocity [m/s].
        a_WE: (3,) acceleration [m/s^2].
        R_WE: (3, 3) orientation.
        w_WE: (3,) angular velocity [rad/s]; None: it does not turn.
        alpha_WE: (3,) angular acceleration [rad/s^2]; None: none.
    """

    p_WE: FloatArray
    v_WE: FloatArray
    a_WE: FloatArray
    R_WE: FloatArray
    w_WE: FloatArray | None = None
    alpha_WE: FloatArray | None = None


class JointTorque(NamedTuple):
    """What the law answers.

    Attributes:
        tau: (n,) torques, finite and within the limits [N m].
        saturated: (n,) the joints that were asked for more than they have.
        stopping: whether the law could not be followed and the joints are braked.
        position_error: (3,) desired minus actual tool point in W [m]; inf when it
            is not known, so that any threshold on it trips.
        orientation_error: (3,) rotation vector from the actual to the desired
            orientation in W [rad]; inf when it is not known.
        singularity: share, 0 to 1, of damping in the worst direction of the task;
            0 when no direction is near singular.
    """

    tau: FloatArray
    saturated: BoolArray
    stopping: bool
    position_error: FloatArray
    orientation_error: FloatArray
    singularity: float


def braking_torque(state: ArmState, limits: ArmLimits, gains: Gains) -> JointTorque:
    """Carries the arm and brakes every joint: tau = h - kd_stop M v, within the limits.

    For when the desired motion is not finite. When the state is not either, see
    `no_torque`.

    Args:
        state: the arm.
        limits: effort limits.
        gains: `kd_stop`.
    """
    drive = -gains.kd_stop * (state.M @ state.v)
    if not math.isfinite(float(drive.sum() + state.h.sum())):
        return no_torque(len(limits.effort))
    tau, saturated = limit_torque(state.h, drive, limits.effort)
    unknown = np.full(3, np.inf)
    return JointTorque(tau, saturated, True, unknown, unknown, 0.0)


def no_torque(count: int) -> JointTorque:
    """Zero torque for `count` joints, for when the state itself is not finite.

    Carrying the arm would mean guessing where it is, and could push as hard as it
    should hold; a robot's own brakes are the answer to a lost encoder.
    """
    unknown = np.full(3, np.inf)
    return JointTorque(np.zeros(count), np.zeros(count, dtype=bool), True, unknown, unknown, 0.0)


def operational_space_torque(
    state: ArmState,
    desired: DesiredMotion,
    q_posture: FloatArray,
    limits: ArmLimits,
    gains: Gains,
    v_posture: FloatArray | None = None,
) -> JointTorque:
    """The law of this module.

    The task acceleration is A_c = (alpha_c, a_c) with

        a_c = a_d + kd_position (v_d - v) + kp_position (p_d - p),
        alpha_c = alpha_d + kd_orientation (w_d - w) + kp_orientation log(R_d R^T),

    and the posture acceleration

        a_0 = kp_posture (q_posture - q) + kd_posture (v_posture - v)
              + kp_limit M^-1 diag(M) (clip(q) - q),

    where clip(q) keeps `limit_margin` away from the limits: the last term is a torque
    away from them, so its share in the null space never points towards the limit. The
    task inertia is damped near singularities (`cartesian_kernels.damped_task_force`),
    and the torque is fitted into the effort limits without bending the motion
    (`cartesian_kernels.limit_torque`).

    Torques are never NaN: an input that is not finite, or so
    large that the law overflows, gives `braking_torque`.

    Args:
        state: the arm.
        desired: the tool motion asked for.
        q_posture: (n,) posture that the null space is drawn to [rad].
        limits: of the joints.
        gains: of the law.
        v_posture: (n,) its velocity [rad/s]; None: it is at rest.
    """
    n = len(q_posture)
    forward_fed = np.zeros(6 + n)
    if desired.w_WE is not None:
        forward_fed[:3] = desired.w_WE
    if desired.alpha_WE is not None:
        forward_fed[3:6] = desired.alpha_WE
    if v_posture is not None:
        forward_fed[6:] = v_posture
    finite, tau, saturated, error_p, error_R, singularity = law(
        state.q,
        state.v,
        state.p_WE,
        np.ascontiguousarray(state.R_WE),
        np.ascontiguousarray(state.M),
        state.h,
        np.ascontiguousarray(state.J),
        state.Jdot_v,
        desired.p_WE,
        desired.v_WE,
        desired.a_WE,
        np.ascontiguousarray(desired.R_WE),
        q_posture,
        forward_fed,
        limits.q_lower,
        limits.q_upper,
        limits.effort,
        tuple(map(float, _of_law(gains))),
    )
    if not finite:
        return braking_torque(state, limits, gains)
    return JointTorque(tau, saturated, False, error_p, error_R, singularity)


_of_law = attrgetter(
    "kp_position",
    "kd_position",
    "kp_orientation",
    "kd_orientation",
    "kp_posture",
    "kd_posture",
    "kp_limit",
    "limit_margin",
    "max_effective_mass",
    "rotation_length",
)
"""The gains in the order in which `law` takes them."""
