"""A driven obstacle keeps its course, also where it meets something."""

from typing import Any

import numpy as np
import pytest
from pydrake.geometry import Box
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from drake_oa.geometry.shapes import Sphere
from drake_oa.scenario.obstacles import ABSENT_HEIGHT, Obstacle, offset_at
from drake_oa.world.obstacle_mover import ObstacleMover
from drake_oa.world.obstacles import add_obstacle

STEP = 0.002
BALL = Obstacle(
    name="ball",
    shapes=[Sphere(radius=0.05)],
    translation=[0.1, 0.2, 0.3],
    rpy=[0.4, -0.3, 0.8],
    waypoints=[[0.1, 0.0, 0.0, 0.5], [0.3, 0.4, 0.0, 0.0], [0.5, 0.4, -0.3, 0.0]],
)


def follow(block: Any = None) -> tuple[np.ndarray, float]:
    """Distances to the course at every step, and how far the block went [m]."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=STEP)
    plant.SetUseSampledOutputPorts(False)
    instance = add_obstacle(plant, BALL)
    if block is not None:
        blocks = plant.AddModelInstance("block")
        body = plant.AddRigidBody(
            "block", blocks, SpatialInertia.SolidBoxWithMass(2.0, 0.1, 0.1, 0.1)
        )
        plant.RegisterCollisionGeometry(
            body, RigidTransform(), Box(0.1, 0.1, 0.1), "block", CoulombFriction(0.5, 0.5)
        )
        plant.SetDefaultFloatingBaseBodyPose(body, RigidTransform(block))
        plant.set_gravity_enabled(body.model_instance(), False)
    plant.Finalize()
    ball = plant.GetBodyByName("body", instance)
    course = np.array(BALL.waypoints)
    mover = builder.AddSystem(ObstacleMover(course, mass=ball.default_mass(), step=STEP))
    builder.Connect(plant.get_state_output_port(instance), mover.get_input_port())
    builder.Connect(mover.get_output_port(), plant.get_actuation_input_port(instance))
    simulator = Simulator(builder.Build())
    errors = []

    def watch(root: Any) -> None:
        context = plant.GetMyContextFromRoot(root)
        where = np.asarray(BALL.translation) + offset_at(course, root.get_time())
        X_WO = plant.EvalBodyPoseInWorld(context, ball)
        errors.append(np.linalg.norm(X_WO.translation() - where))

    simulator.set_monitor(watch)
    simulator.AdvanceTo(0.6)
    moved = 0.0
    if block is not None:
        context = plant.GetMyContextFromRoot(simulator.get_context())
        p_WB = plant.EvalBodyPoseInWorld(context, plant.GetBodyByName("block")).translation()
        moved = float(np.linalg.norm(p_WB - block))
    return np.array(errors), moved


def test_a_free_obstacle_is_on_its_course_at_every_step() -> None:
    errors, _ = follow()
    assert len(errors) > 300
    assert errors.max() < 1e-9


def test_what_is_in_the_way_is_pushed_out_of_it() -> None:
    # On the second leg, 0.2 m before its end.
    errors, moved = follow(np.array([0.5, 0.1, 0.3]))
    assert moved > 0.1
    assert errors.max() < 0.005
    assert errors[-20:].max() < 1e-3


def test_what_appears_is_nowhere_else_before_and_disturbs_nothing() -> None:
    """A block rests under the sphere's place: nothing falls on it, nothing moves it."""
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlantSceneGraph(builder, time_step=STEP)
    plant.SetUseSampledOutputPorts(False)
    ball = Obstacle(
        name="ball", shapes=[Sphere(radius=0.05)], translation=[0.0, 0.0, 0.4], present=[0.1, 0.2]
    )
    instance = add_obstacle(plant, ball)
    friction = CoulombFriction(0.5, 0.5)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform([0.0, 0.0, -0.5]), Box(2.0, 2.0, 1.0), "floor", friction
    )
    block = plant.AddRigidBody(
        "block",
        plant.AddModelInstance("block"),
        SpatialInertia.SolidBoxWithMass(2.0, 0.1, 0.1, 0.1),
    )
    plant.RegisterCollisionGeometry(block, RigidTransform(), Box(0.1, 0.1, 0.1), "block", friction)
    plant.SetDefaultFloatingBaseBodyPose(block, RigidTransform([0.02, 0.0, 0.05]))
    plant.Finalize()
    body = plant.GetBodyByName("body", instance)
    mover = builder.AddSystem(
        ObstacleMover(np.zeros((0, 4)), mass=body.default_mass(), step=STEP, present=ball.present)
    )
    builder.Connect(plant.get_state_output_port(instance), mover.get_input_port())
    builder.Connect(mover.get_output_port(), plant.get_actuation_input_port(instance))
    simulator = Simulator(builder.Build())
    heights, moved = {}, []

    def watch(root: Any) -> None:
        context = plant.GetMyContextFromRoot(root)
        heights[root.get_time()] = plant.EvalBodyPoseInWorld(context, body).translation()[2]
        p_WB = plant.EvalBodyPoseInWorld(context, block).translation()
        moved.append(np.linalg.norm(p_WB - [0.02, 0.0, 0.05]))

    simulator.set_monitor(watch)
    simulator.AdvanceTo(0.3)
    for time, height in heights.items():
        away = 0.0 if 0.1 - 1e-9 <= time < 0.2 - 1e-9 else ABSENT_HEIGHT
        assert height == pytest.approx(0.4 + away, abs=1e-8)
    assert max(moved) < 1e-3


@pytest.mark.parametrize(
    ("waypoints", "options", "message"),
    [
        (np.zeros((0, 4)), {}, "must be \\(N, 4\\)"),
        (np.zeros((2, 4)), {}, "times must increase"),
        (np.zeros((0, 4)), {"present": [2.0, 1.0]}, "present must be"),
        (np.zeros((0, 4)), {"present": [1.0, 2.0, 3.0]}, "present must be"),
        (np.zeros((1, 4)), {"mass": 0.0}, "mass must be positive"),
        (np.zeros((1, 4)), {"step": 0.0}, "period must be positive"),
    ],
)
def test_bad_arguments_are_refused(
    waypoints: np.ndarray, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        ObstacleMover(waypoints, **{"mass": 1.0, "step": STEP} | options)
