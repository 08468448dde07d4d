"""Names and limits of a robot's joints, and where its tool point is, from its plant."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import ModelInstanceIndex

from drake_oa.common.messages import FloatArray


@dataclass(frozen=True, eq=False)
class RobotLimits:
    """Names and limits of a robot's joints; all empty where there is no robot.

    Attributes:
        position_name: (nq,) names of the positions.
        position_lower: (nq,) lower limits [rad, m].
        position_upper: (nq,) upper limits [rad, m].
        velocity_limit: (nv,) greatest speeds [rad/s, m/s].
        actuator_name: (nu,) names of the actuated joints.
        effort_limit: (nu,) greatest actuation [N m, N]; inf: none.
    """

    position_name: tuple[str, ...] = ()
    position_lower: FloatArray = field(default_factory=lambda: np.zeros(0))
    position_upper: FloatArray = field(default_factory=lambda: np.zeros(0))
    velocity_limit: FloatArray = field(default_factory=lambda: np.zeros(0))
    actuator_name: tuple[str, ...] = ()
    effort_limit: FloatArray = field(default_factory=lambda: np.zeros(0))


def robot_limits(plant: MultibodyPlant, robot: ModelInstanceIndex) -> RobotLimits:
    """Limits of one model instance of a finalized plant, in the plant's order."""
    actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(robot)]
    return RobotLimits(
        position_name=tuple(plant.GetPositionNames(robot, always_add_suffix=False)),
        position_lower=plant.GetPositionsFromArray(robot, plant.GetPositionLowerLimits()),
        position_upper=plant.GetPositionsFromArray(robot, plant.GetPositionUpperLimits()),
        velocity_limit=plant.GetVelocitiesFromArray(robot, plant.GetVelocityUpperLimits()),
        actuator_name=tuple(actuator.joint().name() for actuator in actuators),
        effort_limit=np.array([actuator.effort_limit() for actuator in actuators]),
    )


def frame_path(
    plant: MultibodyPlant, robot: ModelInstanceIndex, frame: str, q: FloatArray
) -> FloatArray:
    """Where a frame's origin was in the world, by forward kinematics.

    Args:
        plant: finalized plant.
        robot: model instance that moved; the others are where they are by default.
        frame: name of the frame.
        q: (T, nq) positions of the robot [rad, m].

    Returns:
        (T, 3) p_WF [m].
    """
    context = plant.CreateDefaultContext()
    moving = plant.GetFrameByName(frame)
    path = np.empty((len(q), 3))
    for row, positions in enumerate(q):
        plant.SetPositions(context, robot, positions)
        path[row] = moving.CalcPoseInWorld(context).translation()
    return path
