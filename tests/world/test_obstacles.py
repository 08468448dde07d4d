"""Obstacles of a scenario: their models in the station, and their motion."""

from typing import Any

import numpy as np
import pytest
from pydrake import geometry
from pydrake.geometry import Role
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.config import ScenarioError
from drake_oa.geometry.shapes import Sphere
from drake_oa.scenario.loading import parse_scenario
from drake_oa.scenario.obstacles import ABSENT_HEIGHT, Obstacle
from drake_oa.world.obstacles import ObstacleMover, add_obstacle
from drake_oa.world.station import make_station

_TEXT = """
directives:
- add_directives: {file: package://drake_oa/scenes/table.dmd.yaml}
obstacles:
- name: pile
  shapes:
  - !Box {size: [0.2, 0.1, 0.06], translation: [0, 0, 0.03]}
  - !Cylinder {radius: 0.03, length: 0.2, translation: [0, 0, 0.16]}
  - !Sphere {radius: 0.05, translation: [0, 0.05, 0.11], rpy: [0, 0, 1]}
  translation: [0.5, 0.1, 0]
  rpy: [0, 0, 0.5]
  color: [0.1, 0.2, 0.3, 1.0]
- name: ball
  shapes: [!Sphere {radius: 0.04, translation: [0, 0, 0.04]}]
  translation: [0.4, -0.3, 0]
"""


def _station(text):
    """Builds the station of a scenario's text, and its diagram."""
    builder = DiagramBuilder()
    station = make_station(builder, parse_scenario(text), render=False)
    return station, builder.Build()


def test_each_obstacle_is_a_welded_model_instance_with_both_geometries():
    station, diagram = _station(_TEXT)
    plant = station.plant
    names = [plant.GetModelInstanceName(i) for i in station.obstacles]
    assert names == ["obstacle_pile", "obstacle_ball"]
    body = plant.get_body(plant.GetBodyIndices(station.obstacles[0])[0])
    assert plant.IsAnchored(body)
    context = plant.GetMyContextFromRoot(diagram.CreateDefaultContext())
    X_WO = plant.EvalBodyPoseInWorld(context, body)
    np.testing.assert_allclose(X_WO.translation(), [0.5, 0.1, 0.0])
    np.testing.assert_allclose(RollPitchYaw(X_WO.rotation()).vector(), [0, 0, 0.5], atol=1e-12)
    inspector = station.scene_graph.model_inspector()
    frame = plant.GetBodyFrameIdOrThrow(body.index())
    for role in (Role.kProximity, Role.kIllustration, Role.kPerception):
        assert inspector.NumGeometriesForFrameWithRole(frame, role) == 3
    visual = plant.GetVisualGeometriesForBody(body)[0]
    color = inspector.GetIllustrationProperties(visual).GetProperty("phong", "diffuse")
    assert (color.r(), color.g(), color.b()) == (0.1, 0.2, 0.3)


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("shapes: []", r"obstacles\[0\].shapes: "),
        ("name: ''", r"obstacles\[0\].name: "),
        ("name: other", "two obstacles are named 'other'"),
        ("waypoints: [[1, 0, 0, 0], [1, 1, 0, 0]]", r"waypoints.*\[1\]: its time 1 s must be"),
        ("present: [2, 1]", r"obstacles\[0\]\.present"),
    ],
)
def test_inconsistent_fields_are_rejected(field: str, message: str) -> None:
    obstacle = {"name": "name: a", "shapes": "shapes: [!Sphere {}]"} | {field.split(":")[0]: field}
    other = "{name: other, shapes: [!Sphere {}]}"
    with pytest.raises(ScenarioError, match=message):
        parse_scenario(f"obstacles: [{{{', '.join(obstacle.values())}}}, {other}]")


def test_trajectory_is_linear_between_waypoints_and_constant_outside() -> None:
    waypoints = [[1.0, 0.0, 0.0, 1.0], [2.0, 1.0, -2.0, 1.0], [4.0, 1.0, 2.0, 1.0]]
    ball = Obstacle(name="ball", shapes=[Sphere()], waypoints=waypoints)
    offsets = [ball.offset_at(time) for time in (0.0, 1.5, 3.0, 9.0)]
    expected = [[0.0, 0.0, 1.0], [0.5, -1.0, 1.0], [1.0, 0.0, 1.0], [1.0, 2.0, 1.0]]
    np.testing.assert_allclose(offsets, expected)


def test_obstacles_do_not_collide_with_each_other_or_the_table():
    text = _TEXT + "  waypoints: [[0, 0, 0, 0], [1, 0.2, 0.4, -0.1]]\n"
    station, _ = _station(text)
    inspector, plant = station.scene_graph.model_inspector(), station.plant
    models = (*station.obstacles, plant.GetModelInstanceByName("table"))
    bodies = [plant.GetBodyByName("body", model) for model in models]
    bodies.append(plant.GetBodyByName("panda_hand"))
    pile, ball, table, hand = (plant.GetCollisionGeometriesForBody(body)[0] for body in bodies)
    assert inspector.CollisionFiltered(pile, ball)
    assert inspector.CollisionFiltered(table, ball)
    for other in (pile, ball, table):
        assert not inspector.CollisionFiltered(hand, other)


STEP = 0.002
BALL = Obstacle(
    name="ball",
    shapes=[Sphere(radius=0.05)],
    translation=[0.1, 0.2, 0.3],
    rpy=[0.4, -0.3, 0.8],
    waypoints=[[0.1, 0.0, 0.0, 0.5], [0.3, 0.4, 0.0, 0.0], [0.5, 0.4, -0.3, 0.0]],
)


def simulate_obstacle(
    obstacle: Obstacle, end: float, block: Any, *, floor: bool = False
) -> tuple[dict[float, np.ndarray], np.ndarray]:
    """Simulates an obstacle and a free block, which floats or is on a floor at z = 0.

    Returns:
        Position (3,) of the obstacle by time [s, m]; (N,) displacement of the block [m].
    """
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=STEP)
    plant.SetUseSampledOutputPorts(False)
    instance = add_obstacle(plant, obstacle)
    friction = CoulombFriction(0.5, 0.5)
    blocks = plant.AddModelInstance("block")
    inertia = SpatialInertia.SolidBoxWithMass(2.0, 0.1, 0.1, 0.1)
    block_body = plant.AddRigidBody("block", blocks, inertia)
    parts = [(plant.world_body(), -0.5, [2.0, 2.0, 1.0])] * floor + [(block_body, 0.0, [0.1] * 3)]
    for body, z, size in parts:
        X_BG, shape = RigidTransform([0, 0, z]), geometry.Box(*size)
        plant.RegisterCollisionGeometry(body, X_BG, shape, "c", friction)
    plant.SetDefaultFloatingBaseBodyPose(block_body, RigidTransform(block))
    plant.set_gravity_enabled(blocks, floor)
    plant.Finalize()
    body = plant.GetBodyByName("body", instance)
    mover = builder.AddSystem(ObstacleMover(obstacle, mass=body.default_mass(), step=STEP))
    builder.Connect(plant.get_state_output_port(instance), mover.get_input_port())
    builder.Connect(mover.get_output_port(), plant.get_actuation_input_port(instance))
    simulator = Simulator(builder.Build())
    places: dict[float, np.ndarray] = {}
    displacements = []

    def record(root: Any) -> None:
        """Records the position of the obstacle and the displacement of the block."""
        context = plant.GetMyContextFromRoot(root)
        places[root.get_time()] = plant.EvalBodyPoseInWorld(context, body).translation().copy()
        p_WB = plant.EvalBodyPoseInWorld(context, block_body).translation()
        displacements.append(np.linalg.norm(p_WB - block))

    simulator.set_monitor(record)
    simulator.AdvanceTo(end)
    return places, np.array(displacements)


def test_obstacle_follows_its_trajectory_and_pushes_a_block() -> None:
    # The block is on the second segment, 0.2 m before its end.
    places, displacements = simulate_obstacle(BALL, 0.6, np.array([0.5, 0.1, 0.3]))
    errors = {
        time: np.linalg.norm(place - BALL.translation - BALL.offset_at(time))
        for time, place in places.items()
    }
    assert max(error for time, error in errors.items() if time < 0.3) < 1e-9
    assert displacements[-1] > 0.1
    assert max(errors.values()) < 0.005
    assert max(error for time, error in errors.items() if time > 0.56) < 1e-3


def test_obstacle_appears_without_intermediate_positions() -> None:
    """A block at rest below the position of the sphere is not moved."""
    ball = Obstacle(
        name="ball", shapes=[Sphere(radius=0.05)], translation=[0.0, 0.0, 0.4], present=[0.1, 0.2]
    )
    places, displacements = simulate_obstacle(ball, 0.3, np.array([0.02, 0.0, 0.05]), floor=True)
    for time, place in places.items():
        away = 0.0 if 0.1 - 1e-9 <= time < 0.2 - 1e-9 else ABSENT_HEIGHT
        assert place[2] == pytest.approx(0.4 + away, abs=1e-8)
    assert displacements.max() < 1e-3
