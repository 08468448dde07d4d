"""The arm as arrays: where it is and what it is near to, as Drake has it."""

import numpy as np
import pytest
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.messages import ObstacleClouds, TablePlane
from drake_oa.posture.arm_surroundings import ArmSurroundings
from drake_oa.robot import arm_kernels as kernels
from drake_oa.robot.arm import ArmModel
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotPlant, add_robot
from tests.builders import arm_of

ROLL = 2
"""The upper arm's roll, whose value tells postures apart."""

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
    around = ArmSurroundings.of(ObstacleClouds(stamp=0.0, clouds_W=(p_WQ[None],), ids=np.arange(1)))
    seen = around.points
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


def test_links_are_tested_as_the_model_says(panda: RobotPlant, arm: ArmModel) -> None:
    plant = panda.plant
    diagram_context = panda.diagram.CreateDefaultContext()
    context = plant.GetMyContextFromRoot(diagram_context)
    scene_context = panda.scene_graph.GetMyContextFromRoot(diagram_context)
    inspector = panda.scene_graph.model_inspector()
    parts = arm.parts
    capsules = [f"panda_link{k}" for k in range(1, 8)]
    for q in random_postures(arm, 30):
        plant.SetPositions(context, np.append(q, [0.01, 0.01]))
        query = panda.scene_graph.get_query_output_port().Eval(scene_context)
        least = np.inf
        for i, one in enumerate(capsules):
            for other in capsules[: max(i - 1, 0)]:
                for a in plant.GetCollisionGeometriesForBody(plant.GetBodyByName(one)):
                    for b in plant.GetCollisionGeometriesForBody(plant.GetBodyByName(other)):
                        if not inspector.CollisionFiltered(a, b):
                            pair = query.ComputeSignedDistancePairClosestPoints(a, b)
                            least = min(least, pair.distance)
        found = kernels.self_distance(arm.poses(q), parts, 10.0)
        # Hand and base count too, and their boxes as capsules that hold them.
        assert found <= least + 1e-6


@pytest.mark.parametrize("value", [-1.2, 0.4])
def test_newton_finds_the_posture_with_one_joint_given(arm: ArmModel, value: float) -> None:
    q = np.array(arm.posture)
    target = arm.poses(q)[-1]
    X_WB = np.empty((8, 4, 4))
    for joint in np.linspace(q[ROLL], value, 12):
        q[ROLL] = joint
        assert kernels.reach(
            q, target[:3, 3].copy(), target[:3, :3].copy(), ROLL, np.array(arm.X_PJ), X_WB,
            8, 1e-6,
        )  # fmt: skip
    assert q[ROLL] == pytest.approx(value)
    np.testing.assert_allclose(arm.poses(q)[-1], target, atol=1e-5)


def test_newton_says_what_is_out_of_reach(arm: ArmModel) -> None:
    q, X_WB = np.array(arm.posture), np.empty((8, 4, 4))
    p_WE = np.array([1.4, 0.0, 0.5])
    assert not kernels.reach(q, p_WE, np.array(arm.R_WE), ROLL, np.array(arm.X_PJ), X_WB, 8, 1e-6)


def test_points_are_thinned_and_moved_with_their_obstacle(arm: ArmModel) -> None:
    cloud = np.random.default_rng(1).uniform(0.0, 0.1, (2000, 3)) + [0.3, 0.2, 0.4]
    seen = ObstacleClouds(
        stamp=1.0, clouds_W=(cloud,), ids=np.arange(1), v_WO=np.array([[0.0, 0.5, 0.0]])
    )
    around = ArmSurroundings.of(seen, TablePlane())
    assert len(around.points.points) < 300
    assert around.lag(3.0) == 2.0
    assert around.lag(0.5) == 0.0
    later = ObstacleClouds(stamp=1.0, clouds_W=(cloud + [0.0, 0.5, 0.0],), ids=np.arange(1))
    moved = ArmSurroundings.of(later)
    distances = []
    for points, age in ((around.points, 1.0), (moved.points, 0.0)):
        distances.append(
            kernels.nearest_point(arm.poses(arm.posture), arm.shapes, points.blocks, age, -1, 2.0)[
                0
            ]
        )
    assert distances[0] == pytest.approx(distances[1], abs=0.02)


@pytest.mark.parametrize("table", [None, TablePlane()])
def test_table_is_none_or_a_plane(arm: ArmModel, table: TablePlane | None) -> None:
    around = ArmSurroundings.of(ObstacleClouds(), table)
    height = kernels.lowest_height(arm.poses(arm.posture), arm.shapes, around.table)
    assert (height == np.inf) if table is None else (0.0 < height < 1.0)


def test_what_is_seen_from_one_side_is_as_deep_as_it_is_broad() -> None:
    y, z = (a.ravel() for a in np.meshgrid(np.arange(-0.03, 0.03, 0.01), np.arange(0.0, 0.4, 0.01)))
    front = np.column_stack([np.full_like(y, 0.5), y, z])
    seen = ObstacleClouds(stamp=0.0, clouds_W=(front,), ids=np.arange(1))
    deep = ArmSurroundings.of(seen, None, np.array([1.5, 0.0, 1.0])).points.points
    assert deep[:, 0].max() <= 0.5 + 1e-9
    assert deep[:, 0].min() == pytest.approx(0.45, abs=0.01)
    above = ArmSurroundings.of(seen, None, np.array([0.5, 0.0, 1.0])).points.points
    np.testing.assert_array_equal(above[:, 0], 0.5)
    none = ArmSurroundings.of(ObstacleClouds(stamp=0.0), None, np.array([1.5, 0.0, 1.0]))
    assert not len(none.points.points)
