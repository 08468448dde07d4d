"""Operational-space inverse dynamics on arrays: torques for a commanded tool acceleration.

With the arm's equation of motion M(q) dv/dt + h(q, v) = tau and the tool's spatial acceleration
A = J dv/dt + dJ/dt v, a commanded acceleration A_c of the tool and an acceleration a_0 of the
joints toward a nominal posture give the joint acceleration dv/dt_c and the torques (Khatib, IEEE J.
Robotics and Automation 3(1), 1987)

    dv/dt_c = a_0 + J# (A_c - dJ/dt v - J a_0),    tau = M dv/dt_c + h,

with the dynamically consistent inverse J# = M^-1 J^T (J M^-1 J^T)^-1. Since J J# = I, a_0 produces
no acceleration of the tool. Spatial quantities have Drake's order, rotation before translation.
"""

from __future__ import annotations

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.robot.config import Gains


def operational_space_drive(
    M: FloatArray, J: FloatArray, task: FloatArray, posture: FloatArray, gains: Gains
) -> FloatArray:
    """Computes joint torques for accelerations of the tool and, in its null space, of the joints.

    The arm's equation of motion is M dv/dt + h = tau, and J is the Jacobian of the tool. The
    torques are tau - h = M a_0 + J^T (J M^-1 J^T)^-1 (A_c - dJ/dt v - J a_0), to which the
    controller adds gravity and velocity terms h. The inverse of J M^-1 J^T is damped near
    singularities.

    Args:
        M: (n, n) mass matrix [kg m^2].
        J: (6, n) Jacobian of the tool's spatial velocity in the world frame, rotation first.
        task: (6,) A_c - dJ/dt v in the world frame, with the commanded acceleration A_c of the tool
            and joint velocities v, rotation first [rad/s^2, m/s^2].
        posture: (n,) acceleration a_0 of the joints toward the nominal posture [rad/s^2].
        gains: gains, of which those of the damping are used: `max_effective_mass`, the effective
            mass of the tool above which a direction is damped [kg], and `rotation_length`, the
            length that converts rotations to distances [m].

    Returns:
        (n,) torques tau - h [N m]; not finite if `task` or `posture` is not. M and J must be
        finite.
    """
    J_by_M = np.linalg.solve(M, J.T).T
    remaining = task - J @ posture
    force = damped_task_force(
        J_by_M @ J.T, remaining, gains.max_effective_mass, gains.rotation_length
    )
    drive: FloatArray = M @ posture + J.T @ force
    return drive


def damped_task_force(
    inverse_inertia: FloatArray, acceleration: FloatArray, max_mass: float, length: float
) -> FloatArray:
    """Computes the spatial force (J M^-1 J^T)^-1 A that accelerates the tool as commanded, damped
    near singularities.

    A is the commanded spatial acceleration of the tool, J its Jacobian and M the mass matrix. Let
    u_i and w_i be eigenvectors and eigenvalues of S (J M^-1 J^T) S, where the diagonal matrix S
    multiplies rotations by a length. w_i is the inverse of the effective mass in direction u_i. The
    damped inverse is S sum_i u_i u_i^T / (w_i + mu_i) S with

        mu_i = w_0 (1 - w_i / w_0)^2 if w_i < w_0 = 1 / max_mass, else 0.

    This is damped least squares in the near-singular directions only; the other directions are
    exact. Joint accelerations are bounded because the smallest denominator is 3 w_0 / 4 (compare
    Chiaverini, IEEE T. Robotics and Automation 13(3), 1997, with singular values instead of
    effective masses).

    Args:
        inverse_inertia: (6, 6) inverse J M^-1 J^T of the tool's inertia matrix in the world frame,
            rotation first.
        acceleration: (6,) acceleration A in the world frame, rotation first [rad/s^2, m/s^2].
        max_mass: effective mass above which a direction is damped [kg].
        length: length that converts rotations to distances [m].

    Returns:
        (6,) spatial force on the tool in the world frame, torque first [N m, N].
    """
    scale = np.repeat([length, 1.0], 3)
    eigenvalues, vectors = np.linalg.eigh(np.outer(scale, scale) * inverse_inertia)
    # Rounding may make a vanishing eigenvalue slightly negative.
    w = np.maximum(eigenvalues, 0.0)
    damping = np.maximum(1.0 - max_mass * w, 0.0) ** 2 / max_mass
    force: FloatArray = scale * (vectors @ (vectors.T @ (scale * acceleration) / (w + damping)))
    return force
