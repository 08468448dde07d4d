"""The arm that is kept safe, as spheres, and how its joints move with its tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drake_oa.common.messages import FloatArray, Frozen, IntArray
from drake_oa.robot.arm import Chain, Spheres, joints_to
from drake_oa.robot.plant import RobotPlant
from drake_oa.robot.spheres import ArmSpheres


@dataclass(frozen=True, eq=False)
class GuardedArm(Frozen):
    """An arm of n revolute joints, as spheres in G groups.

    Attributes:
        chain, spheres: see `drake_oa.planning.arm_world.ArmWorld`.
        joints: (n,) names of the joints.
        index: (n,) where they are in the robot's positions.
        size: how many positions the robot has, and velocities.
        overshoot: (G,) how far the spheres of each body stick out of it at most [m].
    """

    chain: Chain
    spheres: Spheres
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
        joints=tuple(joint.name() for joint in joints_to(plant, robot.tool_frame)),
        index=chain.q_index,
        size=plant.num_positions(),
        overshoot=covered.overshoot,
    )
