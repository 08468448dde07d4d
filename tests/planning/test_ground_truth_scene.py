"""Tests of the ground-truth collision scene, against distances of SceneGraph."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import Box, SceneGraph, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.messages import OUT_OF_WORLD
from drake_oa.geometry.collision_scene import ENVIRONMENT, CollisionScene, geometry_distance
from drake_oa.planning.ground_truth_scene import GroundTruthScene

PERIOD = 0.1
X_WB = RigidTransform(RollPitchYaw(0.3, -0.5, 0.9), [0.5, 0.1, 0.4])
X_BG = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0.05, -0.02, 0.1])


class World:
    """Simulation of two bodies without gravity: a box with a ball, and the ball of obstacle 4."""

    def __init__(self) -> None:
        builder = DiagramBuilder()
        self.plant, graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        self.graph: SceneGraph = graph
        self.plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
        inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
        self.bodies = [self.plant.AddRigidBody(name, inertia) for name in ("box", "ball")]
        for body, X, of in (
            (0, X_BG, Box(0.1, 0.2, 0.3)),
            (0, RigidTransform([0.0, 0.0, -0.2]), Sphere(0.05)),
            (1, RigidTransform(), Sphere(0.1)),
        ):
            self.plant.RegisterCollisionGeometry(
                self.bodies[body], X, of, of.__class__.__name__, CoulombFriction()
            )
        self.plant.Finalize()
        indices = [body.index() for body in self.bodies]
        geometries = GroundTruthScene(
            self.plant, graph.model_inspector(), indices, names={indices[1]: 4}, period=PERIOD
        )
        self.system = builder.AddSystem(geometries)
        builder.Connect(graph.get_query_output_port(), self.system.GetInputPort("query_object"))
        self.simulator = Simulator(builder.Build())
        self.root = self.simulator.get_mutable_context()
        self.context = self.plant.GetMyMutableContextFromRoot(self.root)
        self.place(0, X_WB)
        self.place(1, RigidTransform([1.0, 1.0, 1.0]))

    def place(self, body: int, X: RigidTransform) -> None:
        self.plant.SetFreeBodyPose(self.context, self.bodies[body], X)

    def push(self, v_WB: list[float], w_WB: list[float]) -> None:
        velocity = SpatialVelocity(np.array(w_WB), np.array(v_WB))
        self.plant.SetFreeBodySpatialVelocity(
            context=self.context, body=self.bodies[0], V_JpJc=velocity
        )

    def scene(self, time: float = 0.0) -> CollisionScene:
        # Events of an instant take effect just after it.
        self.simulator.AdvanceTo(time + 1e-3) if time else self.simulator.Initialize()
        context = self.system.GetMyContextFromRoot(self.root)
        return self.system.GetOutputPort("collision_scene_W").Eval(context)

    def check(self, scene: CollisionScene, tolerance: float = 1e-6) -> None:
        """Checks distances of random points against those of SceneGraph at the current time."""
        query = self.graph.get_query_output_port().Eval(self.graph.GetMyContextFromRoot(self.root))
        now = self.root.get_time()
        for p in np.random.default_rng(1).uniform(-0.5, 1.5, (50, 3)):
            found = min(geometry_distance(scene.geometries, k, *p, now) for k in range(len(scene)))
            true = min(one.distance for one in query.ComputeSignedDistanceToPoint(p))
            assert found == pytest.approx(true, abs=tolerance)


def test_geometries_have_the_poses_and_velocities_of_scene_graph() -> None:
    world = World()
    world.push([0.2, -0.1, 0.05], [0.0, 0.0, 0.0])
    scene = world.scene()
    assert (scene.stamp, scene.moves) == (0.0, False)
    assert [int(name) for name in scene.geometries.layout[:, 5]] == [ENVIRONMENT, ENVIRONMENT, 4]
    assert scene.labels[2] == "obstacle 4"
    assert scene.labels[0].endswith("::box")
    world.check(scene)
    scene = world.scene(PERIOD)
    assert scene.moves
    np.testing.assert_allclose(scene.geometries.ball[:2, 4:7], [[0.2, -0.1, 0.05]] * 2, atol=1e-6)
    np.testing.assert_array_equal(scene.geometries.ball[2, 4:7], 0.0)
    later = world.scene(0.5)
    world.check(scene)
    world.check(later)


def test_rotating_bodies_are_updated_and_distant_bodies_omitted() -> None:
    world = World()
    world.push([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    world.scene()
    scene = world.scene(3 * PERIOD)
    # The origin of the rotating body is at rest.
    assert not scene.moves
    world.check(scene, 1e-3)
    world.place(1, RigidTransform([2.0 * OUT_OF_WORLD, 0.0, 0.0]))
    assert len(world.scene(4 * PERIOD)) == 2
    # At its appearance the body has velocity 0.
    world.place(1, RigidTransform([1.0, 1.0, 1.0]))
    scene = world.scene(5 * PERIOD)
    assert len(scene) == 3
    assert not scene.moves
