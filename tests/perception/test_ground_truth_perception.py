"""Tests of GroundTruthPerception with bodies in a scene graph."""

import numpy as np
import pytest
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.messages import TablePlane
from drake_oa.perception.ground_truth_perception import GroundTruthPerception


def make_scene(**options):
    """Returns a diagram with a falling box of two parts and a fixed ball, perception, Context."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    box, ball = plant.AddModelInstance("box"), plant.AddModelInstance("ball")
    body = plant.AddRigidBody("box", box, SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
    friction = CoulombFriction()
    for x in (0.0, 0.1):
        plant.RegisterCollisionGeometry(
            body, RigidTransform([x, 0.0, 0.0]), Box(0.1, 0.1, 0.2), f"part{x}", friction
        )
    fixed = plant.AddRigidBody("ball", ball, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.WeldFrames(plant.world_frame(), fixed.body_frame(), RigidTransform([0.0, 1.0, 0.1]))
    plant.RegisterCollisionGeometry(fixed, RigidTransform(), Sphere(0.1), "ball", friction)
    empty = plant.AddModelInstance("empty")
    plant.AddRigidBody("empty", empty, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.Finalize()
    names = options.pop("obstacles", ("box", "ball"))
    perception = builder.AddSystem(
        GroundTruthPerception(
            plant,
            scene_graph.model_inspector(),
            [plant.GetModelInstanceByName(name) for name in names],
            **options,
        )
    )
    builder.Connect(scene_graph.get_query_output_port(), perception.GetInputPort("query_object"))
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    plant.SetFreeBodyPose(
        plant.GetMyMutableContextFromRoot(context), body, RigidTransform([0.5, 0.0, 1.0])
    )
    return diagram, perception, context


def read_obstacles(perception, context):
    """Returns the obstacles that the system outputs in a diagram's Context."""
    return perception.GetOutputPort("obstacles_W").Eval(perception.GetMyContextFromRoot(context))


def test_clouds_have_the_poses_of_the_scene_graph():
    diagram, perception, context = make_scene()
    Simulator(diagram, context).Initialize()
    obstacles = read_obstacles(perception, context)
    assert obstacles.stamp == 0.0
    np.testing.assert_array_equal(obstacles.ids, [0, 1])
    box, ball = obstacles.clouds_W
    np.testing.assert_allclose(box.min(axis=0), [0.45, -0.05, 0.9], atol=1e-12)
    np.testing.assert_allclose(box.max(axis=0), [0.65, 0.05, 1.1], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(ball - [0.0, 1.0, 0.1], axis=1), 0.1, atol=1e-12)
    assert not box.flags.writeable


def test_table_and_cloud_are_output():
    table = TablePlane(np.array([0.0, 0.0, 1.0]), 0.4)
    diagram, perception, context = make_scene(table=table)
    Simulator(diagram, context).Initialize()
    assert read_obstacles(perception, context).table is table
    cloud = perception.GetOutputPort("cloud").Eval(perception.GetMyContextFromRoot(context))
    points = np.concatenate(read_obstacles(perception, context).clouds_W)
    np.testing.assert_allclose(cloud.xyzs().T, points, atol=1e-6)


def test_an_obstacle_without_collision_geometry_is_rejected():
    with pytest.raises(ValueError, match="'empty' has no collision geometry"):
        make_scene(obstacles=("box", "empty"))


def test_clouds_and_velocities_are_those_of_the_bodies():
    diagram, perception, context = make_scene(period=0.05)
    simulator = Simulator(diagram, context)
    simulator.Initialize()
    np.testing.assert_array_equal(read_obstacles(perception, context).v_WO, np.zeros((2, 3)))
    simulator.AdvanceTo(0.12)
    obstacles = read_obstacles(perception, context)
    assert obstacles.stamp == pytest.approx(0.1)
    assert obstacles.clouds_W[0][:, 2].max() == pytest.approx(1.1 - 9.81 / 2 * 0.1**2, abs=1e-4)
    falling, welded = obstacles.v_WO
    # Mean velocity of the last period.
    np.testing.assert_allclose(falling, [0.0, 0.0, -9.81 * 0.075], atol=5e-3)
    assert not welded.any()


def test_an_obstacle_outside_the_world_is_omitted_and_returns_at_rest():
    diagram, perception, context = make_scene(period=0.05)
    plant = next(s for s in diagram.GetSystems() if s.get_name() == "plant")
    plant_context = plant.GetMyMutableContextFromRoot(context)
    box = plant.GetBodyByName("box")
    plant.SetFreeBodyPose(plant_context, box, RigidTransform([0.5, 0.0, 60.0]))
    simulator = Simulator(diagram, context)
    simulator.AdvanceTo(0.05)
    np.testing.assert_array_equal(read_obstacles(perception, context).ids, [1])
    plant.SetFreeBodyPose(plant_context, box, RigidTransform([0.5, 0.0, 1.0]))
    simulator.AdvanceTo(0.1)
    obstacles = read_obstacles(perception, context)
    np.testing.assert_array_equal(obstacles.ids, [0, 1])
    # It fell in between, but its previous position is unknown.
    np.testing.assert_array_equal(obstacles.v_WO, np.zeros((2, 3)))
