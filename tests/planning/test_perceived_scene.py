"""Tests of the perceived collision scene: reuse and recomputation of distance fields."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform, RotationMatrix

from drake_oa.common.messages import ObstacleClouds, TablePlane
from drake_oa.geometry.collision_scene import CollisionGeometries, geometry_distance
from drake_oa.geometry.pinhole import View
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.perception.visibility import ImageRange, with_occluded_extents
from drake_oa.planning.perceived_scene import (
    PerceivedScene,
    PerceivedSceneState,
    seen_free,
    update_scene,
)
from tests.reference.depth_images import SIZE, K, look_at, ray_cast

CAMERA = np.array([1.2, 0.0, 0.8])
HALF = np.array([0.04, 0.1, 0.1])
CENTER = np.array([0.4, 0.0, 0.1])
VOXEL = 0.01
RNG = np.random.default_rng(5)
TABLE = TablePlane(offset=0.0)


def box(half=HALF, center=CENTER, spacing=0.004, noise=0.0):
    """Samples points (N, 3) on the front and top of a box, visible to a camera above."""
    x, y, z = (np.arange(-h, h + 1e-9, spacing) for h in half)
    front = np.stack(np.meshgrid([half[0]], y, z), -1).reshape(-1, 3)
    top = np.stack(np.meshgrid(x, y, [half[2]]), -1).reshape(-1, 3)
    points = np.concatenate([front, top]) + center
    return points + noise * RNG.normal(size=points.shape)


def clouds(*clouds, stamp=1.0, table=TABLE, ids=None, v_WO=()):
    names = np.arange(len(clouds)) if ids is None else np.array(ids)
    return ObstacleClouds(stamp, clouds, names, table, v_WO=np.array(v_WO).reshape(-1, 3))


def distance(geometries: CollisionGeometries, row: int, point, time=0.0):
    return geometry_distance(geometries, row, *map(float, point), time)


def test_fields_are_reused_under_noise():
    first = update_scene(PerceivedSceneState(), clouds(box(noise=0.0012)), CAMERA[None])
    now = first
    for frame in range(2, 12):
        table = replace(TABLE, offset=1e-3 * RNG.uniform(-1.0, 1.0))
        cloud = RNG.permutation(box(noise=0.0012))[100:]
        now = update_scene(now, clouds(cloud, stamp=float(frame), table=table), CAMERA[None])
        assert now.scene.same_as(first.scene)
    assert now.scene.stamp == 11.0
    turned = update_scene(now, clouds(box(), stamp=12.0), np.array([[0.4, 1.2, 0.8]]))
    assert not turned.scene.same_as(first.scene)


def test_fields_are_recomputed_for_new_and_missing_points():
    first = update_scene(PerceivedSceneState(), clouds(box()), CAMERA[None])
    stick = CENTER + np.linspace([0.0, 0.0, 0.1], [0.0, 0.0, 0.14], 9)
    grown = update_scene(first, clouds(np.concatenate([box(), stick])), CAMERA[None])
    assert distance(grown.scene.geometries, 0, stick[-1]) <= VOXEL
    short = box(HALF - [0.0, 0.0, 0.02], CENTER - [0.0, 0.0, 0.02])
    less = update_scene(first, clouds(short), CAMERA[None])
    assert distance(less.scene.geometries, 0, CENTER + [0.0, 0.0, 0.15]) > 0.06
    assert update_scene(first, clouds(), CAMERA[None]).scene.labels == ("the table",)


def test_a_moving_obstacle_reuses_its_field_and_is_deeper():
    broad, behind = np.array([0.005, 0.15, 0.1]), CENTER - [0.12, 0.0, 0.0]
    v_WO = np.array([0.0, 0.15, 0.0])
    now = update_scene(PerceivedSceneState(), clouds(box(broad)), CAMERA[None])
    assert distance(now.scene.geometries, 0, behind) > 0.02
    now = first = update_scene(now, clouds(box(broad), v_WO=[v_WO]), CAMERA[None])
    assert now.scene.moves
    for time, noise in ((1.1, 0.0), (1.2, 0.001), (1.3, 0.0)):
        way = (time - 1.0) * v_WO
        seen = clouds(box(broad, CENTER + way, noise=noise), stamp=time, v_WO=[v_WO])
        now = update_scene(now, seen, CAMERA[None])
        assert now.fields[0].grid is first.fields[0].grid
        assert distance(now.scene.geometries, 0, behind + way, time) < 0.0
    # The obstacle rests again: its depth remains that of a moving obstacle.
    rests = update_scene(now, clouds(box(broad, CENTER + way), stamp=2.0), CAMERA[None])
    assert not rests.scene.moves
    assert rests.moved_ids == {0}
    # At an unexpected position the field is recomputed.
    elsewhere = update_scene(rests, clouds(box(broad), stamp=3.0), CAMERA[None])
    assert elsewhere.fields[0].grid is not first.fields[0].grid


@pytest.mark.parametrize("bad", [np.nan, 1e7])
def test_an_observation_that_is_not_finite_is_ignored(bad):
    first = update_scene(PerceivedSceneState(), clouds(box(), v_WO=[[0.1, 0.0, 0.0]]), CAMERA[None])
    cloud = box()
    cloud[3, 1] = bad
    for given in (clouds(cloud, stamp=2.0), clouds(box(), stamp=2.0, v_WO=[[0.0, bad, 0.0]])):
        now = update_scene(first, given, CAMERA[None])
        assert (now.scene.geometries is first.scene.geometries, now.scene.stamp) == (True, 1.0)
        assert "not finite" in now.scene.note
    assert not update_scene(now, clouds(box(), stamp=3.0), CAMERA[None]).scene.note


def test_late_observations_are_ignored_and_the_table_remains():
    first = update_scene(PerceivedSceneState(), clouds(box()), CAMERA[None])
    late = update_scene(first, clouds(stamp=0.5), CAMERA[None])
    assert late.scene.geometries is first.scene.geometries
    after = update_scene(first, clouds(box(), stamp=2.0, table=None), CAMERA[None])
    assert after.scene.labels == ("obstacle 0", "the table")


def post(height):
    """Samples points (N, 3) on the front of a post of 4 cm width and the given height [m]."""
    y, z = np.meshgrid(np.arange(-0.02, 0.021, 0.005), np.arange(0.0, height, 0.005))
    return np.stack([np.full(y.size, 0.5), y.ravel(), z.ravel()], axis=1)


OTHER = np.array([-0.4, 0.0, 0.8])
"""(3,) position of a second camera, on the other side of the obstacles [m]."""


def image(eye, *boxes):
    """Renders the depth image of boxes (low, high) on a table, from a viewpoint `eye` [m]."""
    X_WC = look_at(eye, [0.4, 0.0, 0.1])
    return View(ray_cast(X_WC, boxes), K, X_WC)


# 1 cm thick, 20 cm wide: with one camera the occluded part is 8 cm deep.
THIN = np.array([0.005, 0.1, 0.1])
BOARD = CENTER - THIN, CENTER + THIN
BEHIND = CENTER - [0.05, 0.0, 0.0]


def test_space_occluded_from_all_cameras_is_filled():
    # A post occludes the view of the second camera, and leaves.
    post = np.array([0.1, -0.3, 0.0]), np.array([0.14, 0.3, 0.5])
    eyes, found = np.stack([CAMERA, OTHER]), PerceivedSceneState()
    for stamp, objects, is_free in (
        (1.0, [BOARD, post], False),
        (1.1, [BOARD], True),
        # Space observed as free remains free after the post has returned.
        (1.2, [BOARD, post], True),
    ):
        views = [image(eye, *objects) for eye in eyes]
        found = update_scene(found, clouds(box(THIN), stamp=stamp), eyes, views)
        assert (distance(found.scene.geometries, 0, BEHIND) > 0.02) == is_free
    assert distance(found.scene.geometries, 0, CENTER) <= 0.0


def test_fields_are_reused_under_noise_of_two_cameras():
    eyes, now, grids = np.stack([CAMERA, OTHER]), PerceivedSceneState(), []
    images = [image(eye, BOARD) for eye in eyes]
    for stamp in range(1, 6):
        views = [x._replace(z=x.z + 0.01 * RNG.normal(size=x.z.shape)) for x in images]
        now = update_scene(now, clouds(box(THIN), stamp=float(stamp)), eyes, views)
        grids.append(now.fields[0].grid)
    assert all(grid is grids[0] for grid in grids)


def test_a_truncated_obstacle_is_extended_unless_observed_as_free():
    X_WC = image(CAMERA).X_WC
    last = (post(0.2)[-1] - X_WC[:3, 3]) @ X_WC[:3, :3]
    near = ImageRange(K[0], K[3], SIZE[0], near=float(last[2]) - 0.005)
    cut = clouds(post(0.2))
    (longer,) = with_occluded_extents(cut, [(X_WC, near)]).clouds_W
    np.testing.assert_array_equal(longer[: len(post(0.2))], post(0.2))
    assert longer[:, 2].max() > 0.3
    views = [image(OTHER)]
    assert with_occluded_extents(cut, [(X_WC, near)], lambda p: seen_free(views, p)) is cut
    whole = near._replace(near=0.1)
    assert with_occluded_extents(cut, [(X_WC, whole)]) is cut


def test_the_system_reads_images_of_the_same_observation():
    ranges = {f"camera_pose_{name}": ImageRange(K[0], K[3], SIZE[0]) for name in ("a", "b")}
    made = PerceivedScene(period=0.1, cameras=ranges)
    context = made.CreateDefaultContext()
    views = tuple(image(eye, BOARD) for eye in (CAMERA, OTHER))
    for name, view in zip(ranges, views, strict=True):
        X_WC = RigidTransform(RotationMatrix(view.X_WC[:3, :3]), view.X_WC[:3, 3])
        made.GetInputPort(name).FixValue(context, AbstractValue.Make(X_WC))
    space = AbstractValue.Make(FreeSpace(views, 1.3))
    made.GetInputPort("free_space_W").FixValue(context, space)
    # Images of another time are ignored, since obstacles may have moved.
    for stamp, is_free in ((1.2, False), (1.3, True)):
        context.SetTime(stamp)
        obstacles = AbstractValue.Make(clouds(box(THIN), stamp=stamp))
        made.GetInputPort("obstacles_W").FixValue(context, obstacles)
        made.ExecuteInitializationEvents(context)
        scene = made.GetOutputPort("collision_scene_W").Eval(context)
        assert (distance(scene.geometries, 0, BEHIND) > 0.0) == is_free
