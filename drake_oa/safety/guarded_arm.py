"""The arm that is kept safe, as spheres, and how its joints move with its tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, Frozen, IntArray
from drake_oa.robot.arm import Chain, Spheres, chain_poses, jacobian, joints_to
from drake_oa.robot.plant import RobotPlant
from drake_oa.robot.spheres import ArmSpheres


@dataclass(frozen=True, eq=False)
class GuardedArm(Frozen):
    """An arm of n revolute joints, as spheres in G groups.

    Attributes:
        chain, spheres: see `drake_oa.planning.arm_world.ArmWorld`.
        bodies: (G,) names of the groups.
        joints: (n,) names of the joints.
        index: (n,) where they are in the robot's positions.
        size: how many positions the robot has, and velocities.
        overshoot: (G,) how far the spheres of each body stick out of it at most [m].
    """

    chain: Chain
    spheres: Spheres
    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    index: IntArray
    size: int
    overshoot: FloatArray

    def __post_init__(self) -> None:
        """Leaves the arrays unlocked: the kernels are compiled for such, and change none."""

    def split(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n,) positions and velocities of the joints in the robot's state x (2 size,)."""
        return np.array(x[self.index]), np.array(x[self.size + self.index])


def make_guarded_arm(robot: RobotPlant, chain: Chain, covered: ArmSpheres) -> GuardedArm:
    """The arm of a robot.

    Args:
        robot: the robot alone.
        chain: its joints.
        covered: it as spheres.

    Raises:
        ValueError: if a joint of the robot has several degrees of freedom.
    """
    plant = robot.plant
    if plant.num_positions() != plant.num_velocities():
        raise ValueError("robot: each joint must have one degree of freedom")
    return GuardedArm(
        chain=chain,
        spheres=covered.arrays,
        bodies=covered.bodies,
        joints=tuple(joint.name() for joint in joints_to(plant, robot.tool_frame)),
        index=chain.q_index,
        size=plant.num_positions(),
        overshoot=covered.overshoot,
    )


@compiled
def tool_jacobian(chain: Chain, q: FloatArray) -> FloatArray:
    """(6, n) of the tool point's angular and linear velocity in the world."""
    n = len(q)
    X, J = np.empty((n + 2, 12)), np.empty((6, n))
    chain_poses(q, chain.X_PJ, X)
    jacobian(X, J)
    return J


@compiled
def full_speed_rates(J: FloatArray, v: FloatArray, v_WE: FloatArray, damping: float) -> FloatArray:
    """(n,) velocities of the joints if the policy ran at full speed [rad/s].

    The tool point moves as the policy wants, without turning; in the null space of the tool
    the arm moves as it does.

    Args:
        J: (6, n) see `tool_jacobian`.
        v: (n,) the joints' velocities now [rad/s].
        v_WE: (3,) velocity of the tool point at full speed, in the world [m/s].
        damping: of the least-squares solution, against singular postures [m^2].
    """
    n = len(v)
    lacking, square = np.zeros(6), np.zeros((6, 6))
    for i in range(6):
        lacking[i] = v_WE[i - 3] if i >= 3 else 0.0
        for k in range(n):
            lacking[i] -= J[i, k] * v[k]
        for j in range(6):
            for k in range(n):
                square[i, j] += J[i, k] * J[j, k]
        square[i, i] += damping
    share = np.linalg.solve(square, lacking)
    rates = v.copy()
    for k in range(n):
        for i in range(6):
            rates[k] += J[i, k] * share[i]
    return rates
