"""The links' reaction to obstacles: the coupling law in the null space of the tool's task.

The final remarks of the paper: "collisions of the links can also be considered by finding the
closest geometric section on the robot to the obstacle, and then modulating the kinematic
null-space movement with the proposed approach". For each obstacle, of the links' point S that
is nearest to it, at distance d and with velocity v relative to the obstacle,

    a_S = Omega x v,    |Omega| = alpha exp(-theta^2 / psi^2) exp(-kappa d^2),

which is (eq. oa_complete) with theta the angle from the way to the obstacle to v, d counted
from the surface, and time in place of normalised time. It acts while v approaches, theta <
pi / 2, and fades over the last 0.2 of cos(theta). In joint space, with Z an orthonormal basis
of the null space of the tool's Jacobian, the sum over the obstacles of

    a_0 = Z (J_S Z)^+ a_S

with a damped inverse (A. A. Maciejewski, C. A. Klein, Int. J. Robotics Research 4(3), 1985)
is what the controller adds: none of it moves the tool.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drake_oa.common.kernel_arrays import kernel_arrays
from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.posture import null_space_coupling_kernels as kernels
from drake_oa.posture.arm_surroundings import ArmSurroundings
from drake_oa.robot.arm_kernels import jacobian
from drake_oa.robot.arm_motion import ArmModel

DAMPING = 0.1
"""Of the damped inverse [m]: a section that the null space moves by less a radian than this
is not chased."""
MOST = 30.0
"""Default bound of the norm of the joints' acceleration [rad/s^2]."""
_FAINT = 1e-3
"""Where exp(-kappa d^2) is below this there is no reaction."""
_SINGULAR = 1e-6
"""Singular values of the tool's Jacobian below this share of the largest are zero."""


@dataclass(frozen=True, eq=False)
class NullSpaceCouplingParameters(Frozen):
    """The law's parameters.

    Attributes:
        alpha: strength [rad/s], at least 0.
        psi: width of the reaction over the heading [rad], above 0.
        kappa: decay over the distance to the surface [1/m^2], above 0.
        most: bound of the norm of the joints' acceleration [rad/s^2], above 0.

    Raises:
        ValueError: for a parameter out of its range.
    """

    alpha: float
    psi: float
    kappa: float
    most: float = MOST

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0.0 <= self.alpha < math.inf:
            raise ValueError(f"alpha must be finite and at least 0 [rad/s], not {self.alpha}")
        for name, unit in (("psi", "rad"), ("kappa", "1/m^2"), ("most", "rad/s^2")):
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be finite and positive [{unit}], not {value}")

    @property
    def reach(self) -> float:
        """Distance beyond which there is no reaction [m]."""
        return math.sqrt(-math.log(_FAINT) / self.kappa)


def section_acceleration(
    v_W: FloatArray,
    u_W: FloatArray,
    distance: float,
    parameters: NullSpaceCouplingParameters,
    step: float,
) -> FloatArray:
    """(3,) acceleration a_S of a section [m/s^2], orthogonal to v.

    Args:
        v_W: (3,) velocity relative to the obstacle's [m/s].
        u_W: (3,) unit direction to the obstacle.
        distance: to its surface [m].
        parameters: of the law.
        step: how long it is held [s].
    """
    a_W = np.zeros(3)
    if distance < parameters.reach:
        p = parameters
        v, u = kernel_arrays(v_W, u_W)
        kernels.turned_away(v, u, distance, p.alpha, p.psi, p.kappa, step, a_W)
    return a_W


def null_space_basis(J: FloatArray) -> FloatArray:
    """(n, n - rank) orthonormal columns Z with J Z = 0."""
    _, values, rows = np.linalg.svd(J)
    rank = int(np.count_nonzero(values > _SINGULAR * values[0])) if len(values) else 0
    return np.asarray(rows[rank:].T)


def null_space_acceleration(
    arm: ArmModel,
    around: ArmSurroundings,
    q: FloatArray,
    v: FloatArray,
    parameters: NullSpaceCouplingParameters,
    *,
    time: float,
    step: float,
) -> FloatArray:
    """The joints' accelerations that turn the arm's nearest sections away from the obstacles.

    Args:
        arm: whose.
        around: the obstacles, with their velocities; the table is none of them.
        q, v: (n,) positions and velocities of the arm's joints [rad, rad/s].
        parameters: of the law.
        time: now [s].
        step: how long the acceleration is held [s].

    Returns:
        (n,) in the null space of the tool's Jacobian [rad/s^2], of a bounded norm.
    """
    n = len(arm.posture)
    total = np.zeros(n)
    seen = around.points
    if not len(seen.points) or parameters.alpha == 0.0:
        return total
    X_WB = arm.poses(q)
    age = around.lag(time)
    shapes = [np.array(array, order="C") for array in arm.shapes]
    p_WS, u_W, J_S, Z = np.empty(3), np.empty(3), np.empty((3, n)), np.empty((n, 0))
    for row, v_WO in enumerate(seen.v_WO):
        distance, body = kernels.nearest_section(
            X_WB, *shapes, seen.points, seen.start, seen.owner, seen.sphere, seen.v_WO,
            age, row, parameters.reach + around.padding, p_WS, u_W,
        )  # fmt: skip
        if body < 0:
            continue
        kernels.point_jacobian(X_WB, body, p_WS, J_S)
        a_S = section_acceleration(J_S @ v - v_WO, u_W, distance - around.padding, parameters, step)
        if not a_S.any():
            continue
        if not Z.shape[1]:
            J = np.empty((6, n))
            jacobian(X_WB, J)
            Z = null_space_basis(J)
            if not Z.shape[1]:
                return total
        moves = J_S @ Z
        square = moves.T @ moves + DAMPING**2 * np.eye(Z.shape[1])
        total += Z @ np.linalg.solve(square, moves.T @ a_S)
    size = float(np.linalg.norm(total))
    return total if size <= parameters.most else total * (parameters.most / size)
