"""The system that knows the world's solids, in a world of its own."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.geometry import Box, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import RigidBody, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.messages import OUT_OF_WORLD
from drake_oa.geometry.solids import SURROUNDINGS, SolidScene, solid_distance
from drake_oa.planning.true_solids import TrueSolids

PERIOD = 0.1
X_WB = RigidTransform(RollPitchYaw(0.3, -0.5, 0.9), [0.5, 0.1, 0.4])
X_BG = RigidTransform(RollPitchYaw(0.1, 0.2, 0.3), [0.05, -0.02, 0.1])


class World:
    """Three bodies without weight: a box beside its body's origin with a ball, a ball, no shape."""

    def __init__(self, period: float = PERIOD, *, called: int | None = None) -> None:
        builder = DiagramBuilder()
        plant, self.graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
        inertia = SpatialInertia.SolidSphereWithMass(1.0, 0.1)
        self.bodies: list[RigidBody] = [
            plant.AddRigidBody(name, inertia) for name in ("box", "ball", "bare")
        ]
        friction = CoulombFriction()
        for body, X, of in (
            (0, X_BG, Box(0.1, 0.2, 0.3)),
            (0, RigidTransform([0.0, 0.0, -0.2]), Sphere(0.05)),
            (1, RigidTransform(), Sphere(0.1)),
        ):
            plant.RegisterCollisionGeometry(
                self.bodies[body], X, of, of.__class__.__name__, friction
            )
        plant.Finalize()
        self.plant = plant
        self.system = builder.AddSystem(
            TrueSolids(
                plant,
                self.graph.model_inspector(),
                [body.index() for body in self.bodies],
                names={} if called is None else {self.bodies[1].index(): called},
                period=period,
            )
        )
        builder.Connect(
            self.graph.get_query_output_port(), self.system.GetInputPort("query_object")
        )
        self.simulator = Simulator(builder.Build())
        self.root = self.simulator.get_mutable_context()
        self.context = plant.GetMyMutableContextFromRoot(self.root)
        self.place(0, X_WB)
        self.place(1, RigidTransform([1.0, 1.0, 1.0]))
        self.place(2, RigidTransform([-2.0, 0.0, 0.0]))

    def place(self, body: int, X: RigidTransform) -> None:
        self.plant.SetFreeBodyPose(self.context, self.bodies[body], X)

    def push(self, body: int, v_WB: list[float], w_WB: list[float]) -> None:
        velocity = SpatialVelocity(np.array(w_WB), np.array(v_WB))
        self.plant.SetFreeBodySpatialVelocity(
            context=self.context, body=self.bodies[body], V_JpJc=velocity
        )

    def scene(self, time: float | None = None) -> SolidScene:
        if time is None:
            self.simulator.Initialize()
        else:
            # What happens at an instant has happened just after it.
            self.simulator.AdvanceTo(time + 1e-3)
        context = self.system.GetMyContextFromRoot(self.root)
        return self.system.GetOutputPort("solids_W").Eval(context)

    def true_distance(self, p_WQ: np.ndarray) -> float:
        query = self.graph.get_query_output_port().Eval(self.graph.GetMyContextFromRoot(self.root))
        return min(found.distance for found in query.ComputeSignedDistanceToPoint(p_WQ))


def least(scene: SolidScene, p: np.ndarray, t: float) -> float:
    return min(solid_distance(scene.solids, k, *p, t) for k in range(len(scene)))


def test_the_solids_are_where_scene_graph_has_them() -> None:
    world, random = World(), np.random.default_rng(1)
    scene = world.scene()
    assert scene.stamp == 0.0
    assert not scene.moves
    assert [label.rpartition("::")[2] for label in scene.labels] == ["box", "box", "ball"]
    X_WG = (X_WB @ X_BG).GetAsMatrix4()
    np.testing.assert_allclose(scene.solids.X_WO[0], X_WG[:3], atol=1e-12)
    for p in random.uniform(-0.5, 1.5, (100, 3)):
        assert least(scene, p, 0.0) == pytest.approx(world.true_distance(p), abs=1e-9)


def test_what_moves_is_foretold() -> None:
    world, random = World(), np.random.default_rng(2)
    world.push(0, [0.2, -0.1, 0.05], [0.0, 0.0, 0.0])
    assert not world.scene().moves
    scene = world.scene(PERIOD)
    assert scene.stamp == pytest.approx(PERIOD)
    assert scene.moves
    np.testing.assert_allclose(scene.solids.ball[:2, 4:7], [[0.2, -0.1, 0.05]] * 2, atol=1e-6)
    np.testing.assert_array_equal(scene.solids.ball[2, 4:7], 0.0)
    # Foretold from the reading, and read at the end.
    later = world.scene(0.5)
    now = world.root.get_time()
    for p in random.uniform(-0.5, 1.5, (50, 3)):
        for known in (scene, later):
            assert least(known, p, now) == pytest.approx(world.true_distance(p), abs=1e-6)
    assert later.stamp == pytest.approx(0.5)


def test_an_obstacle_is_called_as_perception_calls_it() -> None:
    scene = World(called=4).scene()
    assert [int(name) for name in scene.solids.layout[:, 5]] == [SURROUNDINGS, SURROUNDINGS, 4]
    assert scene.labels[2] == "obstacle 4"
    assert scene.labels[0].endswith("box")


def test_a_body_that_turns_is_read_anew() -> None:
    world = World()
    world.push(0, [0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    world.scene()
    scene = world.scene(3 * PERIOD)
    # Its origin rests.
    assert not scene.moves
    turn = RollPitchYaw(0.0, 0.0, 3 * PERIOD).ToRotationMatrix()
    X_WG = RigidTransform(turn @ X_WB.rotation(), X_WB.translation()) @ X_BG
    np.testing.assert_allclose(scene.solids.X_WO[0], X_WG.GetAsMatrix4()[:3], atol=1e-6)


def test_a_body_that_trembles_rests() -> None:
    world = World()
    world.push(0, [5e-4, 0.0, 0.0], [0.0, 0.0, 0.0])
    world.scene()
    assert not world.scene(PERIOD).moves


def test_what_is_far_away_is_left_out_and_appears_at_rest() -> None:
    world = World()
    away = RigidTransform([0.0, 0.0, 2.0 * OUT_OF_WORLD])
    world.place(1, away)
    assert [label.rpartition("::")[2] for label in world.scene().labels] == ["box", "box"]
    world.place(1, RigidTransform([1.0, 0.0, 0.0]))
    scene = world.scene(PERIOD)
    assert len(scene) == 3
    # It has not flown here.
    assert not scene.moves
    world.place(0, away)
    assert len(world.scene(2 * PERIOD)) == 1


def test_scenes_are_the_same_while_nothing_moves() -> None:
    world = World()
    first = world.scene()
    again = world.scene(PERIOD)
    assert again.stamp > first.stamp
    assert first.same_as(again)
    world.place(1, RigidTransform([1.0, 1.0, 1.01]))
    assert not again.same_as(world.scene(2 * PERIOD))
    assert first.same_as(first)
    assert SolidScene().same_as(SolidScene())
