"""Rendered depth of a small cell: a table before a wall, two boxes, a sliding arm."""

import logging
from dataclasses import dataclass

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import (
    Box,
    Capsule,
    ClippingRange,
    DepthRange,
    DepthRenderCamera,
    MakeRenderEngineVtk,
    RenderCameraCore,
    RenderEngineVtkParams,
)
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from drake_oa.common.messages import ObstacleClouds
from drake_oa.geometry.pinhole import pinhole
from drake_oa.geometry.solids import robot_solids
from drake_oa.perception.depth_perception import DepthPerception, as_of
from tests.builders import depth_image
from tests.reference.depth_images import look_at, rays_of

CAMERA = CameraInfo(320, 240, np.deg2rad(45.0))
TALL = np.array([0.10, 0.16, 0.30])  # box behind the arm's way
LOW = np.array([0.12, 0.12, 0.08])
PERIOD = 1.0 / 15.0


X_WC = RigidTransform(look_at([1.3, 0.1, 0.9], [0.0, 0.0, 0.05]))


@dataclass
class Cell:
    diagram: Diagram
    perception: DepthPerception
    arm: PrismaticJoint


def add_shape(plant, body, p_BG, shape, name):
    friction, X_BG = CoulombFriction(0.5, 0.5), RigidTransform(p_BG)
    plant.RegisterCollisionGeometry(body, X_BG, shape, name, friction)
    plant.RegisterVisualGeometry(body, X_BG, shape, name + "_visual", [0.5, 0.5, 0.5, 1.0])


def make_cell() -> Cell:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
    world = plant.world_body()
    add_shape(plant, world, [0.0, 0.0, -0.02], Box(1.0, 1.2, 0.04), "table")
    add_shape(plant, world, [-0.9, 0.0, 0.0], Box(0.05, 4.0, 3.0), "wall")
    add_shape(plant, world, [0.0, 0.0, -0.7], Box(5.0, 5.0, 0.02), "floor")
    add_shape(plant, world, [0.1, 0.4, LOW[2] / 2], Box(*LOW), "low")
    add_shape(plant, world, [-0.1, 0.0, TALL[2] / 2], Box(*TALL), "tall")
    robot = plant.AddModelInstance("robot")
    body = plant.AddRigidBody("arm", robot, SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
    arm = plant.AddJoint(
        PrismaticJoint("arm", plant.world_frame(), body.body_frame(), [0.0, 1.0, 0.0])
    )
    # An upright arm halfway between the camera and the box.
    add_shape(plant, body, [0.35, 0.0, 0.35], Capsule(0.05, 0.5), "link")
    plant.Finalize()

    core = RenderCameraCore("vtk", CAMERA, ClippingRange(0.05, 10.0), RigidTransform())
    sensor = builder.AddSystem(
        RgbdSensor(
            scene_graph.world_frame_id(), X_WC, DepthRenderCamera(core, DepthRange(0.1, 5.0))
        )
    )
    model = robot_solids(plant, scene_graph.model_inspector(), robot)
    perception = builder.AddNamedSystem(
        "perception",
        DepthPerception(CAMERA, robot=model, pixel_center=0.5, period=PERIOD),
    )
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    builder.Connect(sensor.depth_image_32F_output_port(), perception.GetInputPort("depth_image"))
    builder.Connect(sensor.body_pose_in_world_output_port(), perception.GetInputPort("camera_pose"))
    builder.Connect(plant.get_state_output_port(robot), perception.GetInputPort("robot_state"))
    return Cell(builder.Build(), perception, arm)


class Playback:
    """Places the arm and steps the perception frame by frame."""

    def __init__(self, cell: Cell, *, arm: float = 2.0) -> None:
        self.cell = cell
        self.context = cell.diagram.CreateDefaultContext()
        self.place(arm)
        self.simulator = Simulator(cell.diagram, self.context)
        self.frames = 0

    def place(self, arm: float) -> None:
        plant = self.cell.arm.GetParentPlant()
        self.cell.arm.set_translation(plant.GetMyMutableContextFromRoot(self.context), arm)

    def seen(self) -> ObstacleClouds:
        # Each frame an initialization: the arm stays where it was placed.
        self.context.SetTime(self.frames * PERIOD)
        self.simulator.Initialize()
        self.frames += 1
        context = self.cell.perception.GetMyContextFromRoot(self.context)
        return self.cell.perception.GetOutputPort("obstacles_W").Eval(context)


@pytest.fixture(scope="module")
def cell() -> Cell:
    return make_cell()


def tall_cloud(obstacles: ObstacleClouds) -> np.ndarray:
    heights = [cloud[:, 2].max() for cloud in obstacles.clouds_W]
    return obstacles.clouds_W[int(np.argmax(heights))]


def test_finds_each_box_of_the_table_and_nothing_else(cell):
    obstacles = Playback(cell).seen()
    assert len(obstacles) == 2
    assert obstacles.stamp == 0.0
    assert obstacles.note == ""
    np.testing.assert_allclose(obstacles.table.normal_W, [0.0, 0.0, 1.0], atol=5e-4)
    assert abs(obstacles.table.offset) < 5e-4
    for cloud, center, size in zip(
        obstacles.clouds_W,
        ([-0.1, 0.0, TALL[2] / 2], [0.1, 0.4, LOW[2] / 2]),
        (TALL, LOW),
        strict=True,
    ):
        outside = np.abs(cloud - center) - size / 2
        assert outside.max() < 0.006  # rendering error and half a voxel
        assert cloud[:, 2].min() < 0.03
        assert abs(cloud[:, 2].max() - size[2]) < 0.006


def test_an_obstacle_keeps_name_and_extent_while_the_arm_passes_before_it(cell):
    playback = Playback(cell, arm=-0.4)
    first = playback.seen()
    name, reference = first.ids[0], tall_cloud(first)
    hidden = 0
    for y in np.linspace(-0.4, 0.5, 19):
        playback.place(y)
        now = playback.seen()
        assert len(now) == 2
        cloud = now.clouds_W[list(now.ids).index(name)]
        np.testing.assert_allclose(cloud.min(axis=0), reference.min(axis=0), atol=0.01)
        np.testing.assert_allclose(cloud.max(axis=0), reference.max(axis=0), atol=0.01)
        assert 0.9 < len(cloud) / len(reference) < 1.1
        fresh = Playback(cell, arm=y).seen()
        hidden = max(hidden, len(reference) - len(tall_cloud(fresh)))
    # It did pass before it.
    assert hidden > len(reference) / 3


def give(system, context, camera="", stamp=0.0, image=None) -> None:
    """Stamp [s] of a camera's image, and a new image of (H, W) depths [m]."""
    suffix = f"_{camera}" if camera else ""
    if image is not None:
        value = depth_image(image)
        system.GetInputPort(f"depth_image{suffix}").FixValue(context, Value(value))
    if camera:
        system.GetInputPort(f"image_stamp{suffix}").FixValue(context, [stamp])


def alone(image: np.ndarray, **options) -> tuple[DepthPerception, object]:
    system = DepthPerception(CAMERA, **options)
    context = system.CreateDefaultContext()
    give(system, context, image=image)
    system.GetInputPort("camera_pose").FixValue(context, Value(X_WC))
    return system, context


def update(system, context) -> ObstacleClouds:
    system.ExecuteInitializationEvents(context)
    return system.GetOutputPort("obstacles_W").Eval(context)


def table_with_block() -> np.ndarray:
    """A depth image of the plane z = 0, and of a block that stands on it."""
    X = X_WC.GetAsMatrix4()
    rays = rays_of(X, pinhole(CAMERA), (CAMERA.height(), CAMERA.width()))
    depth = -X[2, 3] / rays[..., 2]
    block = np.s_[90:130, 140:180]
    depth[block] = (0.1 - X[2, 3]) / rays[block][..., 2]
    return np.where((depth > 0) & (depth < 4.0), depth, np.inf).astype(np.float32)


def test_a_blind_frame_keeps_the_last_obstacles_with_their_stamp(caplog):
    good = table_with_block()
    system, context = alone(good)
    context.SetTime(1.0)
    before = update(system, context)
    assert len(before) == 1
    context.SetTime(2.0)
    give(system, context, image=np.full_like(good, np.nan))
    with caplog.at_level(logging.INFO, logger="drake_oa"):
        after = update(system, context)
        context.SetTime(3.0)
        update(system, context)
    assert (after.stamp, after.note) == (1.0, "no valid pixel")
    np.testing.assert_array_equal(after.clouds_W[0], before.clouds_W[0])
    assert len(caplog.records) == 1  # once, not every frame
    give(system, context, image=good)
    with caplog.at_level(logging.INFO, logger="drake_oa"):
        recovered = update(system, context)
    assert (recovered.stamp, recovered.note) == (3.0, "")
    assert "sees again" in caplog.records[-1].message


def test_before_any_good_frame_there_is_nothing_and_a_reason():
    system, context = alone(np.full((240, 320), np.nan, dtype=np.float32))
    assert len(system.GetOutputPort("obstacles_W").Eval(context)) == 0
    obstacles = update(system, context)
    assert (len(obstacles), obstacles.stamp) == (0, -np.inf)
    assert obstacles.note == "no valid pixel"


def test_an_image_of_another_size_is_refused():
    system, context = alone(np.ones((120, 160), dtype=np.float32))
    with pytest.raises(ValueError, match=r"160x120.*320x240"):
        update(system, context)


def pair(**options) -> tuple[DepthPerception, object]:
    """Two cameras at one place, whose images have stamps."""
    system = DepthPerception({"left": CAMERA, "right": CAMERA}, **options)
    context = system.CreateDefaultContext()
    for name in ("left", "right"):
        system.GetInputPort(f"camera_pose_{name}").FixValue(context, Value(X_WC))
        give(system, context, name, 0.0, table_with_block())
    return system, context


def test_a_camera_that_stops_leaves_the_others_sight_and_an_old_stamp(caplog):
    system, context = pair()
    first = update(system, context)
    assert (first.stamp, first.note, len(first)) == (0.0, "", 1)
    seen = system.GetOutputPort("free_space_W").Eval(context).views
    assert all(view is not None for view in seen)
    # The block goes; only the left camera has new images.
    gone = table_with_block()
    gone[90:130, 140:180] = np.median(gone[np.isfinite(gone)])
    with caplog.at_level(logging.INFO, logger="drake_oa"):
        for k in range(1, 4):
            give(system, context, "left", 0.1 * k, gone)
            context.SetTime(0.1 * k)
            after = update(system, context)
    assert after.note == "right: no new image"
    assert after.stamp == pytest.approx(0.0)
    assert len(caplog.records) == 1
    views = system.GetOutputPort("free_space_W").Eval(context).views
    assert views[0] is not None
    assert views[1] is None
    give(system, context, "left", 0.4, table_with_block())
    give(system, context, "right", 0.4)
    again = update(system, context)
    assert (again.stamp, again.note) == (0.4, "")


def test_a_blind_or_late_image_of_one_camera_is_left_out():
    system, context = pair()
    update(system, context)
    give(system, context, "right", 0.1, np.full((240, 320), np.nan))
    give(system, context, "left", 0.1)
    blind = update(system, context)
    assert (blind.stamp, blind.note) == (0.0, "right: no valid pixel")
    # Late ones, as of a driver that has fallen behind, are of another instant.
    give(system, context, "left", 0.3)
    give(system, context, "right", 0.2, table_with_block())
    late = update(system, context)
    assert (late.stamp, late.note) == (0.0, "right: no new image")
    for name in ("left", "right"):
        give(system, context, name, 0.4)
    assert update(system, context).stamp == 0.4
    assert update(system, context).note == "no new image"


def test_images_that_are_not_far_apart_are_taken_together():
    system, context = pair(together=0.03)
    update(system, context)
    give(system, context, "left", 0.1)
    give(system, context, "right", 0.08)
    obstacles = update(system, context)
    assert (obstacles.stamp, obstacles.note) == (0.1, "")
    assert all(
        view is not None for view in system.GetOutputPort("free_space_W").Eval(context).views
    )
    # One that comes behind a newer one that is known already waits for the next.
    give(system, context, "right", 0.09)
    obstacles = update(system, context)
    assert (obstacles.stamp, obstacles.note) == (0.1, "no new image")
    give(system, context, "left", 0.14)
    assert update(system, context).note == "right: no new image"


def test_that_an_image_is_missing_may_be_said_later():
    system, context = pair(unsaid=0.15)
    update(system, context)
    for time, note in ((0.1, ""), (0.2, "no new image")):
        context.SetTime(time)
        assert update(system, context).note == note
    for time, note in ((0.3, ""), (0.4, ""), (0.5, "right: no new image")):
        context.SetTime(time)
        give(system, context, "left", time)
        if time < 0.35:
            give(system, context, "right", time)
        seen = update(system, context)
        assert (seen.note, seen.stamp) == (note, min(time, 0.3))


def test_the_robot_is_taken_out_where_it_was_at_each_of_the_images(cell):
    playback = Playback(cell)
    image = cell.perception.GetInputPort("depth_image")
    system, context = pair(together=0.05, pixel_center=0.5, robot=cell.perception._robot)
    for name, arm, stamp in (("left", -0.1, 0.10), ("right", 0.1, 0.13)):
        playback.place(arm)
        at = cell.perception.GetMyContextFromRoot(playback.context)
        give(system, context, name, stamp, image.Eval(at).data[:, :, 0])
        system.GetInputPort(f"robot_state_{name}").FixValue(context, [arm, 0.0])
    seen = update(system, context)
    assert seen.note == ""
    assert len(seen) == 2
    assert max(cloud[:, 0].max() for cloud in seen.clouds_W) < 0.2


def test_what_moves_is_handed_on_where_it_was_at_an_older_stamp():
    cloud, v_WO = np.ones((3, 3)), np.array([[0.0, 0.5, 0.0], [0.0, 0.0, 0.0]])
    now = ObstacleClouds(2.0, (cloud, cloud), np.array([0, 1]), v_WO=v_WO)
    then = as_of(now, 1.8)
    assert then.stamp == 1.8
    np.testing.assert_allclose(then.clouds_W[0], cloud - [0.0, 0.1, 0.0])
    assert then.clouds_W[1] is cloud
