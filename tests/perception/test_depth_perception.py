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
from pydrake.systems.sensors import CameraInfo, ImageDepth32F, RgbdSensor

from drake_oa.common.messages import ObstacleClouds
from drake_oa.geometry.collision_shapes import RobotModel, collect_collision_shapes
from drake_oa.geometry.pinhole import pinhole
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.depth_perception import DepthPerception, as_of
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
    box: PrismaticJoint


def add_shape(plant, body, X_BG, shape, name):
    friction = CoulombFriction(0.5, 0.5)
    plant.RegisterCollisionGeometry(body, X_BG, shape, name, friction)
    plant.RegisterVisualGeometry(body, X_BG, shape, name + "_visual", [0.5, 0.5, 0.5, 1.0])


def add_slider(plant, instance, name, axis):
    body = plant.AddRigidBody(name, instance, SpatialInertia.SolidBoxWithMass(1.0, 0.1, 0.1, 0.1))
    joint = PrismaticJoint(name, plant.world_frame(), body.body_frame(), axis)
    return body, plant.AddJoint(joint)


def make_cell(*, self_filter: bool = True, config: SegmentationConfig | None = None) -> Cell:
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    scene_graph.AddRenderer("vtk", MakeRenderEngineVtk(RenderEngineVtkParams()))
    world = plant.world_body()
    add_shape(plant, world, RigidTransform([0.0, 0.0, -0.02]), Box(1.0, 1.2, 0.04), "table")
    add_shape(plant, world, RigidTransform([-0.9, 0.0, 0.0]), Box(0.05, 4.0, 3.0), "wall")
    add_shape(plant, world, RigidTransform([0.0, 0.0, -0.7]), Box(5.0, 5.0, 0.02), "floor")
    add_shape(plant, world, RigidTransform([0.1, 0.4, LOW[2] / 2]), Box(*LOW), "low")
    boxes = plant.AddModelInstance("box")
    body, box = add_slider(plant, boxes, "tall", [0.0, 1.0, 0.0])
    add_shape(plant, body, RigidTransform([-0.1, 0.0, TALL[2] / 2]), Box(*TALL), "tall")
    robot = plant.AddModelInstance("robot")
    body, arm = add_slider(plant, robot, "arm", [0.0, 1.0, 0.0])
    # An upright arm halfway between the camera and the box.
    X_BG = RigidTransform([0.35, 0.0, 0.35])
    add_shape(plant, body, X_BG, Capsule(0.05, 0.5), "link")
    plant.set_gravity_enabled(boxes, False)
    plant.Finalize()

    core = RenderCameraCore("vtk", CAMERA, ClippingRange(0.05, 10.0), RigidTransform())
    sensor = builder.AddSystem(
        RgbdSensor(
            scene_graph.world_frame_id(), X_WC, DepthRenderCamera(core, DepthRange(0.1, 5.0))
        )
    )
    model: RobotModel | None = None
    if self_filter:
        model = collect_collision_shapes(plant, scene_graph.model_inspector(), robot)
    perception = builder.AddNamedSystem(
        "perception",
        DepthPerception(CAMERA, config=config, robot=model, pixel_center=0.5, period=PERIOD),
    )
    builder.Connect(scene_graph.get_query_output_port(), sensor.query_object_input_port())
    builder.Connect(sensor.depth_image_32F_output_port(), perception.GetInputPort("depth_image"))
    builder.Connect(sensor.body_pose_in_world_output_port(), perception.GetInputPort("camera_pose"))
    if self_filter:
        builder.Connect(plant.get_state_output_port(robot), perception.GetInputPort("robot_state"))
    return Cell(builder.Build(), perception, arm, box)


class Playback:
    """Places arm and box and steps the perception frame by frame."""

    def __init__(self, cell: Cell, *, arm: float = 2.0, box: float = 0.0) -> None:
        self.cell = cell
        self.context = cell.diagram.CreateDefaultContext()
        self.plant_context = cell.arm.GetParentPlant().GetMyMutableContextFromRoot(self.context)
        self.place(arm, box)
        self.simulator = Simulator(cell.diagram, self.context)
        self.frames = 0

    def place(self, arm: float, box: float) -> None:
        plant = self.cell.arm.GetParentPlant()
        self.cell.arm.set_translation(self.plant_context, arm)
        self.cell.box.set_translation(self.plant_context, box)
        plant.SetVelocities(self.plant_context, np.zeros(plant.num_velocities()))

    def seen(self) -> ObstacleClouds:
        if not self.frames:
            self.simulator.Initialize()
        else:
            # Each frame an initialization: the joints stay where they were placed.
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


def test_the_arm_is_no_obstacle(cell):
    playback = Playback(cell, arm=-0.35)
    assert len(playback.seen()) == 2


def test_without_the_self_filter_the_arm_is_one():
    playback = Playback(make_cell(self_filter=False), arm=-0.35)
    assert len(playback.seen()) == 3


def test_an_obstacle_keeps_name_and_extent_while_the_arm_passes_before_it(cell):
    playback = Playback(cell, arm=-0.4)
    first = playback.seen()
    name, reference = first.ids[0], tall_cloud(first)
    hidden = 0
    for y in np.linspace(-0.4, 0.5, 19):
        playback.place(y, 0.0)
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


def test_an_obstacle_taken_away_behind_the_arm_disappears_with_it(cell):
    playback = Playback(cell)
    playback.seen()
    playback.place(0.05, 5.0)
    playback.seen()
    playback.place(2.0, 5.0)
    assert len(playback.seen()) == 1


def test_updates_come_at_the_period_and_the_stamp_says_when(cell):
    context = cell.diagram.CreateDefaultContext()
    cell.arm.set_translation(cell.arm.GetParentPlant().GetMyMutableContextFromRoot(context), 2.0)
    simulator = Simulator(cell.diagram, context)
    simulator.AdvanceTo(1.5 * PERIOD)
    mine = cell.perception.GetMyContextFromRoot(context)
    assert cell.perception.GetOutputPort("obstacles_W").Eval(mine).stamp == pytest.approx(PERIOD)


def test_the_cloud_for_viewing_holds_the_points_above_the_table(cell):
    playback = Playback(cell)
    playback.seen()
    context = cell.perception.GetMyContextFromRoot(playback.context)
    points = cell.perception.GetOutputPort("cloud").Eval(context).xyzs()
    assert points.shape[1] > 1000
    assert points[2].min() > 0.0


def alone(image: np.ndarray, **options) -> tuple[DepthPerception, object]:
    system = DepthPerception(CAMERA, **options)
    context = system.CreateDefaultContext()
    set_image(system, context, image)
    system.GetInputPort("camera_pose").FixValue(context, Value(X_WC))
    return system, context


def set_image(system, context, image: np.ndarray) -> None:
    value = ImageDepth32F(image.shape[1], image.shape[0])
    value.mutable_data[:, :, 0] = image
    system.GetInputPort("depth_image").FixValue(context, Value(value))


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


@pytest.mark.parametrize(
    ("bad", "reason"),
    [(np.nan, "no valid pixel"), (0.0, "no valid pixel"), (np.inf, "no valid pixel")],
)
def test_a_blind_frame_keeps_the_last_obstacles_with_their_stamp(bad, reason, caplog):
    good = table_with_block()
    system, context = alone(good)
    context.SetTime(1.0)
    before = update(system, context)
    assert len(before) == 1
    context.SetTime(2.0)
    set_image(system, context, np.full_like(good, bad))
    with caplog.at_level(logging.INFO, logger="drake_oa"):
        after = update(system, context)
        context.SetTime(3.0)
        update(system, context)
    assert (after.stamp, after.note) == (1.0, reason)
    np.testing.assert_array_equal(after.clouds_W[0], before.clouds_W[0])
    assert len(caplog.records) == 1  # once, not every frame
    set_image(system, context, good)
    with caplog.at_level(logging.INFO, logger="drake_oa"):
        recovered = update(system, context)
    assert (recovered.stamp, recovered.note) == (3.0, "")
    assert "sees again" in caplog.records[-1].message


def test_before_any_good_frame_there_is_nothing_and_a_reason():
    system, context = alone(np.full((240, 320), np.nan, dtype=np.float32))
    assert len(system.GetOutputPort("obstacles_W").Eval(context)) == 0
    obstacles = update(system, context)
    assert len(obstacles) == 0
    assert obstacles.stamp == -np.inf
    assert obstacles.note == "no valid pixel"


def test_an_image_of_another_size_is_refused():
    system, context = alone(np.ones((120, 160), dtype=np.float32))
    with pytest.raises(ValueError, match=r"160x120.*320x240"):
        update(system, context)


def test_a_port_that_is_not_connected_is_an_error():
    system = DepthPerception(CAMERA)
    with pytest.raises(RuntimeError, match="depth_image"):
        update(system, system.CreateDefaultContext())


def test_only_a_system_that_knows_the_robot_has_its_port(cell):
    assert cell.perception.GetInputPort("robot_state").size() == 2
    assert not DepthPerception(CAMERA).HasInputPort("robot_state")


@pytest.mark.parametrize("period", [0.0, -1.0, np.nan, np.inf])
def test_a_period_that_is_none_is_refused(period):
    with pytest.raises(ValueError, match="period"):
        DepthPerception(CAMERA, period=period)


def test_a_pixel_center_that_is_none_is_refused():
    with pytest.raises(ValueError, match="pixel_center"):
        DepthPerception(CAMERA, pixel_center=320.0)


@pytest.mark.parametrize("camera", [[500.0, 500.0, 320.0], [0.0, 500.0, 1.0, 1.0], [np.nan] * 4])
def test_invalid_intrinsics_are_refused(camera):
    with pytest.raises(ValueError, match="fx, fy, cx, cy"):
        DepthPerception(camera)


def test_a_moving_obstacle_has_a_velocity_on_the_port_and_a_clone_goes_on_alike(cell):
    playback = Playback(cell, box=-0.3)
    speed = 0.3
    for k in range(1, 9):
        obstacles = playback.seen()
        playback.place(2.0, -0.3 + speed * k * PERIOD)
    row = int(np.argmax([cloud[:, 2].max() for cloud in obstacles.clouds_W]))
    np.testing.assert_allclose(obstacles.v_WO[row], [0.0, speed, 0.0], atol=0.15 * speed)
    assert not np.delete(obstacles.v_WO, row, axis=0).any()
    results = []
    for context in (playback.context.Clone(), playback.context.Clone()):
        context.SetTime(playback.frames * PERIOD)
        Simulator(cell.diagram, context).Initialize()
        mine = cell.perception.GetMyContextFromRoot(context)
        results.append(cell.perception.GetOutputPort("obstacles_W").Eval(mine))
    one, other = results
    np.testing.assert_array_equal(one.v_WO, other.v_WO)
    for a, b in zip(one.clouds_W, other.clouds_W, strict=True):
        np.testing.assert_array_equal(a, b)


def pair(**options) -> tuple[DepthPerception, object]:
    """Two cameras at one place, whose images have stamps."""
    system = DepthPerception({"left": CAMERA, "right": CAMERA}, **options)
    context = system.CreateDefaultContext()
    for name in ("left", "right"):
        system.GetInputPort(f"camera_pose_{name}").FixValue(context, Value(X_WC))
        give(system, context, name, table_with_block(), 0.0)
    return system, context


def give(system, context, name: str, image: np.ndarray | None, stamp: float) -> None:
    """A new image of one camera, or only its stamp."""
    if image is not None:
        value = ImageDepth32F(image.shape[1], image.shape[0])
        value.mutable_data[:, :, 0] = image
        system.GetInputPort(f"depth_image_{name}").FixValue(context, Value(value))
    system.GetInputPort(f"image_stamp_{name}").FixValue(context, [stamp])


def test_each_of_several_cameras_has_its_ports():
    system, _ = pair()
    of_one = ["depth_image", "camera_pose", "image_stamp"]
    assert [system.get_input_port(i).get_name() for i in range(system.num_input_ports())] == [
        f"{port}_{name}" for name in ("left", "right") for port in of_one
    ]
    outputs = [system.get_output_port(i).get_name() for i in range(system.num_output_ports())]
    assert outputs == ["obstacles_W", "cloud", "views"]
    with pytest.raises(ValueError, match="one or more"):
        DepthPerception({})
    with pytest.raises(ValueError, match="camera must be"):
        DepthPerception({"left": CAMERA, "right": [0.0, 1.0, 2.0, 3.0]})


@pytest.mark.parametrize("all_needed", [True, False])
def test_a_camera_that_stops_leaves_the_others_sight_and_an_old_stamp(all_needed, caplog):
    system, context = pair(all_needed=all_needed)
    first = update(system, context)
    assert (first.stamp, first.note, len(first)) == (0.0, "", 1)
    seen = system.GetOutputPort("views").Eval(context).views
    assert all(view is not None for view in seen)
    # The block goes; only the left camera has new images.
    gone = table_with_block()
    gone[90:130, 140:180] = np.median(gone[np.isfinite(gone)])
    with caplog.at_level(logging.INFO, logger="drake_oa"):
        for k in range(1, 4):
            give(system, context, "left", gone, 0.1 * k)
            context.SetTime(0.1 * k)
            after = update(system, context)
    assert after.note == "right: no new image"
    assert after.stamp == pytest.approx(0.0 if all_needed else 0.3)
    assert len(caplog.records) == 1
    views = system.GetOutputPort("views").Eval(context).views
    assert views[0] is not None
    assert views[1] is None
    give(system, context, "left", table_with_block(), 0.4)
    give(system, context, "right", table_with_block(), 0.4)
    again = update(system, context)
    assert (again.stamp, again.note) == (0.4, "")


def test_a_blind_or_late_image_of_one_camera_is_left_out():
    system, context = pair()
    update(system, context)
    give(system, context, "right", np.full((240, 320), np.nan, dtype=np.float32), 0.1)
    give(system, context, "left", None, 0.1)
    blind = update(system, context)
    assert (blind.stamp, blind.note) == (0.0, "right: no valid pixel")
    # Late ones, as of a driver that has fallen behind, are of another instant.
    give(system, context, "left", None, 0.3)
    give(system, context, "right", table_with_block(), 0.2)
    late = update(system, context)
    assert (late.stamp, late.note) == (0.0, "right: no new image")
    for name in ("left", "right"):
        give(system, context, name, None, 0.4)
    assert update(system, context).stamp == 0.4
    assert update(system, context).note == "no new image"


def test_images_that_are_not_far_apart_are_taken_together():
    system, context = pair(together=0.03)
    update(system, context)
    give(system, context, "left", table_with_block(), 0.1)
    give(system, context, "right", table_with_block(), 0.08)
    obstacles = update(system, context)
    assert (obstacles.stamp, obstacles.note) == (0.1, "")
    assert all(view is not None for view in system.GetOutputPort("views").Eval(context).views)
    # One that comes behind a newer one that is known already waits for the next.
    give(system, context, "right", table_with_block(), 0.09)
    obstacles = update(system, context)
    assert (obstacles.stamp, obstacles.note) == (0.1, "no new image")
    give(system, context, "left", table_with_block(), 0.14)
    assert update(system, context).note == "right: no new image"
    with pytest.raises(ValueError, match="together"):
        pair(together=-1.0)


def test_that_an_image_is_missing_may_be_said_later():
    system, context = pair(unsaid=0.15)
    update(system, context)
    for time, note in ((0.1, ""), (0.2, "no new image")):
        context.SetTime(time)
        assert update(system, context).note == note
    for time, note in ((0.3, ""), (0.4, ""), (0.5, "right: no new image")):
        context.SetTime(time)
        give(system, context, "left", None, time)
        if time < 0.35:
            give(system, context, "right", None, time)
        seen = update(system, context)
        assert (seen.note, seen.stamp) == (note, min(time, 0.3))


def test_the_robot_is_taken_out_where_it_was_at_each_of_the_images(cell):
    playback = Playback(cell)
    image = cell.perception.GetInputPort("depth_image")
    system, context = pair(together=0.05, pixel_center=0.5, robot=cell.perception._robot)
    for name, arm, stamp in (("left", -0.1, 0.10), ("right", 0.1, 0.13)):
        playback.place(arm, 0.0)
        at = cell.perception.GetMyContextFromRoot(playback.context)
        give(system, context, name, np.array(image.Eval(at).data[:, :, 0]), stamp)
        system.GetInputPort(f"robot_state_{name}").FixValue(context, [arm, 0.0])
    seen = update(system, context)
    assert seen.note == ""
    assert len(seen) == 2
    assert max(cloud[:, 0].max() for cloud in seen.clouds_W) < 0.2


def test_until_each_camera_has_seen_something_nothing_is_known():
    system, context = pair()
    give(system, context, "right", np.full((240, 320), np.nan, dtype=np.float32), 0.0)
    obstacles = update(system, context)
    assert (obstacles.stamp, len(obstacles)) == (-np.inf, 1)


def test_what_moves_is_handed_on_where_it_was_at_an_older_stamp():
    cloud, v_WO = np.ones((3, 3)), np.array([[0.0, 0.5, 0.0], [0.0, 0.0, 0.0]])
    now = ObstacleClouds(2.0, (cloud, cloud), np.array([0, 1]), v_WO=v_WO)
    then = as_of(now, 1.8)
    assert then.stamp == 1.8
    np.testing.assert_allclose(then.clouds_W[0], cloud - [0.0, 0.1, 0.0])
    assert then.clouds_W[1] is cloud
