"""Poses of the arm as arrays, compared with Drake's."""

import numpy as np
import pytest
from pydrake.math import RollPitchYaw, RotationMatrix

from drake_oa.robot.arm import ArmModel
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotPlant
from tests.builders import arm_of


@pytest.fixture(scope="module")
def arm(panda: RobotPlant) -> ArmModel:
    return arm_of(panda, RotationMatrix(RollPitchYaw(Robot().rpy_WE)))


def random_postures(arm: ArmModel, count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(arm.lower, arm.upper, (count, 7))


def test_forward_kinematics_are_drakes(panda: RobotPlant, arm: ArmModel) -> None:
    context = panda.plant.CreateDefaultContext()
    for q in random_postures(arm, 50):
        panda.plant.SetPositions(context, np.append(q, [0.01, 0.01]))
        expected = panda.tool_frame.CalcPoseInWorld(context).GetAsMatrix4()
        X_WB = arm.poses(q)
        np.testing.assert_allclose(X_WB[-1], expected, atol=1e-12)
        for joint in range(7):
            frame = panda.plant.GetJointByName(f"panda_joint{joint + 1}").frame_on_child()
            expected = frame.CalcPoseInWorld(context)
            np.testing.assert_allclose(X_WB[joint, :3, 3], expected.translation(), atol=1e-12)
            np.testing.assert_allclose(X_WB[joint, :3, 2], expected.rotation().col(2), atol=1e-12)
