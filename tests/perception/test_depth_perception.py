"""DepthPerception on drawn images of one or two cameras."""

import logging
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pydrake.geometry as drake
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo

from drake_oa.common.messages import ObstacleClouds
from drake_oa.geometry.collision_scene import geometries_of, geometry_of
from drake_oa.perception.depth_perception import DepthPerception, backdate_obstacles
from tests.builders import depth_image
from tests.reference.depth_images import box, look_at, ray_cast

CAMERA = CameraInfo(320, 240, 260.0, 260.0, 159.5, 119.5)
X_WC = RigidTransform(look_at([1.3, 0.1, 0.9], [0.0, 0.0, 0.05]))
TABLE = (0.0, 0.0, 0.5, 0.6)
ARM = (0.1, 0.1, 0.4)


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


def table_with(*boxes) -> np.ndarray:
    """A depth image of the plane z = 0, and of boxes."""
    return ray_cast(X_WC.GetAsMatrix4(), boxes, TABLE)


def table_with_block() -> np.ndarray:
    return table_with(box(0.0, 0.0))


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
    assert (after.stamp, after.note) == (1.0, "hardly any depth is measured")
    np.testing.assert_array_equal(after.clouds_W[0], before.clouds_W[0])
    assert len(caplog.records) == 1  # once, not every frame
    give(system, context, image=good)
    with caplog.at_level(logging.INFO, logger="drake_oa"):
        recovered = update(system, context)
    assert (recovered.stamp, recovered.note) == (3.0, "")
    assert "recovered" in caplog.records[-1].message


def test_before_any_good_frame_there_is_nothing_and_a_reason():
    system, context = alone(np.full((240, 320), np.nan, dtype=np.float32))
    assert len(system.GetOutputPort("obstacles_W").Eval(context)) == 0
    obstacles = update(system, context)
    assert (len(obstacles), obstacles.stamp) == (0, -np.inf)
    assert obstacles.note == "hardly any depth is measured"


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
    gone = table_with()
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
    unusable_views = update(system, context)
    assert (unusable_views.stamp, unusable_views.note) == (
        0.0,
        "right: hardly any depth is measured",
    )
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
    system, context = pair(sync_tolerance=0.03)
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
    system, context = pair(missing_image_timeout=0.15)
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


def test_what_moves_is_handed_on_where_it_was_at_an_older_stamp():
    cloud, v_WO = np.ones((3, 3)), np.array([[0.0, 0.5, 0.0], [0.0, 0.0, 0.0]])
    now = ObstacleClouds(2.0, (cloud, cloud), np.array([0, 1]), v_WO=v_WO)
    then = backdate_obstacles(now, 1.8)
    assert then.stamp == 1.8
    np.testing.assert_allclose(then.clouds_W[0], cloud - [0.0, 0.1, 0.0])
    assert then.clouds_W[1] is cloud


def test_the_robot_is_taken_out_where_it_was_at_each_of_the_images():
    def posed(states):
        poses = [RigidTransform([0.1, y, 0.2]).GetAsMatrix4() for y in np.ravel(states)]
        return geometries_of([replace(geometry_of(drake.Box(*ARM)), X_WO=X_WB) for X_WB in poses])

    system, context = pair(sync_tolerance=0.05, robot=SimpleNamespace(num_states=1, posed=posed))
    for name, y, stamp in (("left", -0.3, 0.10), ("right", 0.3, 0.13)):
        give(system, context, name, stamp, table_with(box(0.1, y, ARM), box(0.0, 0.0)))
        system.GetInputPort(f"robot_state_{name}").FixValue(context, [y])
    seen = update(system, context)
    assert seen.note == ""
    (cloud,) = seen.clouds_W
    assert np.abs(cloud[:, 1]).max() < 0.1
