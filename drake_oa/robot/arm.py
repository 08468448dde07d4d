"""The arm of a Drake plant as arrays, as the compiled kernels take it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, Frame, RevoluteJoint
from pydrake.systems.framework import Context

from drake_oa.common.messages import FloatArray, Frozen, IntArray
from drake_oa.common.numba_tools import kernel_arrays
from drake_oa.robot import arm_kernels as kernels


def make_arm_model(
    plant: MultibodyPlant,
    tool_frame: Frame,
    R_WE: RotationMatrix,
    q: FloatArray,
) -> ArmModel:
    """Reads the joints between the world and the tool.

    Args:
        plant: finalized plant of the robot alone, its base welded to the world.
        tool_frame: the frame E.
        R_WE: orientation that the tool keeps.
        q: (nq,) posture; joints that do not move the tool stay as they are here [rad, m].

    Raises:
        ValueError: if a joint that moves the tool is not revolute.
    """
    context = plant.CreateDefaultContext()
    q = np.asarray(q, dtype=float)
    plant.SetPositions(context, q)
    joints = joints_to(plant, tool_frame)
    index = np.array([joint.position_start() for joint in joints])
    X_WJ = [joint.child_body().EvalPoseInWorld(context) @ axis_frame(joint) for joint in joints]
    before = RigidTransform()
    X_PJ = np.zeros((len(joints) + 1, 4, 4))
    for i in range(len(joints)):
        turned = RigidTransform(RotationMatrix.MakeZRotation(q[index[i]]), np.zeros(3))
        X_PJ[i] = (before.inverse() @ X_WJ[i] @ turned.inverse()).GetAsMatrix4()
        before = X_WJ[i]
    X_PJ[-1] = (before.inverse() @ tool_frame.CalcPoseInWorld(context)).GetAsMatrix4()
    return ArmModel(
        index=index,
        X_PJ=X_PJ,
        R_WE=np.array(R_WE.matrix()),
        posture=q[index],
        lower=plant.GetPositionLowerLimits()[index],
        upper=plant.GetPositionUpperLimits()[index],
        speed=plant.GetVelocityUpperLimits()[[joint.velocity_start() for joint in joints]],
    )


def joints_to(plant: MultibodyPlant, tool_frame: Frame) -> list[RevoluteJoint]:
    """The moving joints from the world to the tool, in that order."""
    moving = [
        joint
        for joint in map(plant.get_joint, plant.GetJointIndices())
        if joint.num_velocities() > 0
        and tool_frame.body().index() in plant.GetBodiesKinematicallyAffectedBy([joint.index()])
    ]
    for joint in moving:
        if not isinstance(joint, RevoluteJoint):
            raise ValueError(
                f"joint '{joint.name()}' moves '{tool_frame.name()}' and is of type "
                f"{joint.type_name()}; the arm's joints must be revolute"
            )
    return moving


def axis_frame(joint: RevoluteJoint) -> RigidTransform:
    """Pose in the child body of a frame whose z axis is the joint's."""
    X_BM = joint.frame_on_child().GetFixedPoseInBodyFrame()
    return X_BM @ RigidTransform(
        RotationMatrix.MakeFromOneVector(joint.revolute_axis(), 2), [0] * 3
    )


def moved_by(plant: MultibodyPlant, joints: list[RevoluteJoint]) -> dict[BodyIndex, int]:
    """The last joint that moves each body that any of them moves."""
    moved = {}
    for i, joint in enumerate(joints):
        for body in plant.GetBodiesKinematicallyAffectedBy([joint.index()]):
            moved[body] = i
    return moved


def in_joint_frame(
    plant: MultibodyPlant,
    context: Context,
    X_WJ: list[RigidTransform],
    moved: dict[BodyIndex, int],
    body: BodyIndex,
) -> FloatArray:
    """(4, 4) pose of a body in the frame of the joint that moves it, or in the world."""
    X_WB = plant.get_body(body).EvalPoseInWorld(context)
    at = moved.get(body, -1)
    return (X_WB if at < 0 else X_WJ[at].inverse() @ X_WB).GetAsMatrix4()


@dataclass(frozen=True, eq=False)
class ArmModel(Frozen):
    """An arm of n revolute joints in a row, as `drake_oa.robot.arm.make_arm_model` reads it.

    A body's frame is that of the joint that moves it; bodies are counted by their joint.

    Attributes:
        index: (n,) where its joints are in the plant's positions.
        X_PJ: (n + 1, 4, 4) frame of each joint in the body before it (the first in the world),
            its z axis being the joint's, and of the tool point E in the last body.
        R_WE: (3, 3) orientation of the tool.
        posture: (n,) that the null space is drawn to where nothing is in the way [rad].
        lower, upper: (n,) joint limits [rad].
        speed: (n,) their velocity limits [rad/s].
    """

    index: IntArray
    X_PJ: FloatArray
    R_WE: FloatArray
    posture: FloatArray
    lower: FloatArray
    upper: FloatArray
    speed: FloatArray

    def poses(self, q: FloatArray) -> FloatArray:
        """(n + 1, 4, 4) poses of the bodies, and of E, in the world."""
        X_WB = np.empty((len(self.posture) + 1, 4, 4))
        kernels.poses(*kernel_arrays(q, self.X_PJ), X_WB)
        return X_WB
