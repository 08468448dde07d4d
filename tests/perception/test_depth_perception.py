"""Tests of DepthPerception on ray-cast images of one or two cameras."""

import logging
from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.messages import ObstacleClouds
from drake_oa.geometry.collision_scene import geometries_of
from drake_oa.perception.depth_perception import DepthPerception, backdate_obstacles
from tests.builders import depth_image, fix
from tests.planning.arms import box_at
from tests.reference.depth_images import box, look_at, ray_cast

CAMERA = CameraInfo(320, 240, 260.0, 260.0, 159.5, 119.5)
X_WC = RigidTransform(look_at([1.3, 0.1, 0.9], [0.0, 0.0, 0.05]))
TABLE = (0.0, 0.0, 0.5, 0.6)
ARM = (0.1, 0.1, 0.4)


def set_image(system, context, camera="", stamp=0.0, image=None) -> None:
    """Sets the stamp [s] of a camera's image, and an image of (H, W) depths [m]."""
    suffix = f"_{camera}" if camera else ""
    if image is not None:
        fix(system, context, **{f"depth_image{suffix}": depth_image(image)})
    if camera:
        fix(system, context, **{f"image_stamp{suffix}": [stamp]})


def one_camera(image: np.ndarray, **options) -> tuple[DepthPerception, object]:
    """Returns the system with one camera, and its Context."""
    system = DepthPerception(CAMERA, **options)
    context = system.CreateDefaultContext()
    set_image(system, context, image=image)
    fix(system, context, camera_pose=X_WC)
    return system, context


def update(system, context) -> ObstacleClouds:
    """Processes the present images, and returns the obstacles."""
    system.ExecuteInitializationEvents(context)
    return system.GetOutputPort("obstacles_W").Eval(context)


def table_with(*boxes) -> np.ndarray:
    """Returns a depth image of the plane z = 0 and boxes."""
    return ray_cast(X_WC.GetAsMatrix4(), boxes, TABLE)


def table_with_block() -> np.ndarray:
    """Returns a depth image of the plane z = 0 and one box."""
    return table_with(box(0.0, 0.0))


def test_a_frame_without_depth_changes_only_the_note(caplog):
    good = table_with_block()
    system, context = one_camera(good)
    context.SetTime(1.0)
    before = update(system, context)
    assert len(before) == 1
    # The state does not contain the memory of the image.
    (view,) = system.GetOutputPort("free_space_W").Eval(context).views
    assert not np.shares_memory(view.z, system.GetInputPort("depth_image").Eval(context).data)
    context.SetTime(2.0)
    set_image(system, context, image=np.full_like(good, np.nan))
    with caplog.at_level(logging.INFO, logger="drake_oa"):
        after = update(system, context)
        context.SetTime(3.0)
        update(system, context)
    assert (after.stamp, after.note) == (1.0, "hardly any depth is measured")
    np.testing.assert_array_equal(after.clouds_W[0], before.clouds_W[0])
    assert len(caplog.records) == 1  # once, not every frame
    set_image(system, context, image=good)
    with caplog.at_level(logging.INFO, logger="drake_oa"):
        recovered = update(system, context)
    assert (recovered.stamp, recovered.note) == (3.0, "")
    assert "recovered" in caplog.records[-1].message


def test_without_a_usable_frame_the_note_states_the_reason():
    system, context = one_camera(np.full((240, 320), np.nan, dtype=np.float32))
    assert len(system.GetOutputPort("obstacles_W").Eval(context)) == 0
    obstacles = update(system, context)
    assert (len(obstacles), obstacles.stamp) == (0, -np.inf)
    assert obstacles.note == "hardly any depth is measured"


def test_an_image_with_another_size_than_the_intrinsics_is_rejected():
    system, context = one_camera(np.ones((120, 160), dtype=np.float32))
    with pytest.raises(ValueError, match=r"160x120.*320x240"):
        update(system, context)


def two_cameras(**options) -> tuple[DepthPerception, object]:
    """Returns the system with two cameras of the same pose, and its Context."""
    system = DepthPerception({"left": CAMERA, "right": CAMERA}, **options)
    context = system.CreateDefaultContext()
    for name in ("left", "right"):
        fix(system, context, **{f"camera_pose_{name}": X_WC})
        set_image(system, context, name, 0.0, table_with_block())
    return system, context


def test_the_stamp_is_that_of_the_oldest_camera(caplog):
    system, context = two_cameras()
    first = update(system, context)
    assert (first.stamp, first.note, len(first)) == (0.0, "", 1)
    seen = system.GetOutputPort("free_space_W").Eval(context).views
    assert all(view is not None for view in seen)
    # The block is removed; only the left camera has new images.
    gone = table_with()
    with caplog.at_level(logging.INFO, logger="drake_oa"):
        for k in range(1, 4):
            set_image(system, context, "left", 0.1 * k, gone)
            context.SetTime(0.1 * k)
            after = update(system, context)
    assert after.note == "right: no new image"
    assert after.stamp == pytest.approx(0.0)
    assert len(caplog.records) == 1
    views = system.GetOutputPort("free_space_W").Eval(context).views
    assert views[0] is not None
    assert views[1] is None
    # Late, with the stamp of the last frame.
    set_image(system, context, "right", 0.3)
    assert update(system, context).note == "no new image"
    set_image(system, context, "left", 0.4, table_with_block())
    set_image(system, context, "right", 0.4)
    again = update(system, context)
    assert (again.stamp, again.note) == (0.4, "")


def test_an_unusable_or_late_image_of_one_camera_is_left_out():
    system, context = two_cameras()
    update(system, context)
    set_image(system, context, "right", 0.1, np.full((240, 320), np.nan))
    set_image(system, context, "left", 0.1)
    partial = update(system, context)
    assert (partial.stamp, partial.note) == (0.0, "right: hardly any depth is measured")
    # A late image, as of a delayed driver, is not of the same instant.
    set_image(system, context, "left", 0.3)
    set_image(system, context, "right", 0.2, table_with_block())
    late = update(system, context)
    assert (late.stamp, late.note) == (0.0, "right: no new image")
    for name in ("left", "right"):
        set_image(system, context, name, 0.4)
    assert update(system, context).stamp == 0.4
    assert update(system, context).note == "no new image"


def test_images_within_the_sync_tolerance_form_one_frame():
    system, context = two_cameras(sync_tolerance=0.03)
    update(system, context)
    set_image(system, context, "left", 0.1)
    set_image(system, context, "right", 0.08)
    obstacles = update(system, context)
    assert (obstacles.stamp, obstacles.note) == (0.1, "")
    assert None not in system.GetOutputPort("free_space_W").Eval(context).views
    # An image older than the previous frame is not processed before the next frame.
    set_image(system, context, "right", 0.09)
    obstacles = update(system, context)
    assert (obstacles.stamp, obstacles.note) == (0.1, "no new image")
    set_image(system, context, "left", 0.14)
    assert update(system, context).note == "right: no new image"


def test_a_missing_image_is_reported_after_the_timeout():
    system, context = two_cameras(missing_image_timeout=0.15)
    update(system, context)
    for time, note in ((0.1, ""), (0.2, "no new image")):
        context.SetTime(time)
        assert update(system, context).note == note
    for time, note in ((0.3, ""), (0.4, ""), (0.5, "right: no new image")):
        context.SetTime(time)
        set_image(system, context, "left", time)
        if time < 0.35:
            set_image(system, context, "right", time)
        seen = update(system, context)
        assert (seen.note, seen.stamp) == (note, min(time, 0.3))


def test_moving_obstacles_are_output_at_their_position_of_the_older_stamp():
    cloud, v_WO = np.ones((3, 3)), np.array([[0.0, 0.5, 0.0], [0.0, 0.0, 0.0]])
    now = ObstacleClouds(2.0, (cloud, cloud), np.array([0, 1]), v_WO=v_WO)
    then = backdate_obstacles(now, 1.8)
    assert then.stamp == 1.8
    np.testing.assert_allclose(then.clouds_W[0], cloud - [0.0, 0.1, 0.0])
    assert then.clouds_W[1] is cloud


def test_the_self_filter_removes_the_robot_at_its_state_of_each_image():
    def posed(states):
        return geometries_of([box_at(ARM, [0.1, y, 0.2]) for y in np.ravel(states)])

    robot = SimpleNamespace(num_states=1, posed=posed)
    system, context = two_cameras(sync_tolerance=0.05, robot=robot)
    for name, y, stamp in (("left", -0.3, 0.10), ("right", 0.3, 0.13)):
        set_image(system, context, name, stamp, table_with(box(0.1, y, ARM), box(0.0, 0.0)))
        fix(system, context, **{f"robot_state_{name}": [y]})
    seen = update(system, context)
    assert seen.note == ""
    (cloud,) = seen.clouds_W
    assert np.abs(cloud[:, 1]).max() < 0.1
