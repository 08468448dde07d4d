"""The arm as arrays: where it is and what it is near to, as Drake has it."""

import numpy as np
import pytest
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.messages import ObstacleClouds
from drake_oa.geometry.points import ObstaclePoints
from drake_oa.robot import arm_kernels as kernels
from drake_oa.robot.arm import ArmModel
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotPlant, add_robot
from tests.builders import arm_of

TOOL = ("panda_hand", "panda_leftfinger", "panda_rightfinger")


@pytest.fixture(scope="module")
def arm(panda: RobotPlant) -> ArmModel:
    return arm_of(panda, RotationMatrix(RollPitchYaw(Robot().rpy_WE)), without=TOOL)


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


def test_clearance_is_scene_graphs(arm: ArmModel) -> None:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    instance = add_robot(plant, Robot())
    p_WQ = np.array([0.3, 0.25, 0.5])
    point = plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform(p_WQ), Sphere(1e-9), "point", CoulombFriction()
    )
    plant.Finalize()
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    context = plant.GetMyContextFromRoot(root)
    seen = ObstaclePoints.of(ObstacleClouds(stamp=0.0, clouds_W=(p_WQ[None],), ids=np.arange(1)))
    links = [plant.GetBodyByName(f"panda_link{k}", instance) for k in range(1, 8)]
    for q in random_postures(arm, 30):
        plant.SetPositions(context, instance, np.append(q, [0.01, 0.01]))
        query = scene_graph.get_query_output_port().Eval(scene_graph.GetMyContextFromRoot(root))
        expected = min(
            query.ComputeSignedDistancePairClosestPoints(shape, point).distance
            for link in links
            for shape in plant.GetCollisionGeometriesForBody(link)
        )
        distance, shape, owner, row = kernels.nearest_point(
            arm.poses(q), arm.shapes, seen.blocks, 0.0, -1, 10.0
        )
        assert distance == pytest.approx(expected, abs=2e-6)
        assert (owner, row) == (0, 0)
        assert shape >= 0
