"""Tests of segmentation on ray-cast depth images."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.geometry.collision_scene import geometries_of
from drake_oa.geometry.pinhole import View
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.segmentation import segment_depth, segment_points, segment_views
from tests.planning.arms import box_at
from tests.reference.depth_images import SIZE, K, box, camera_pose, look_at, ray_cast, rays_of

X_WC = camera_pose()
NO_TABLE_EXTENT = (50.0, 50.0, 0.1, 0.1)
"""Center and half extents of a table outside every image [m]."""
NO_TABLE_CONFIG = SegmentationConfig(table=False)
BOXES = (box(0.8, -0.15), box(0.9, 0.2, (0.12, 0.08, 0.06)))


def test_each_box_becomes_one_cluster_inside_it():
    depth = ray_cast(X_WC, BOXES)
    result = segment_depth(depth, K, X_WC)
    assert result.note == ""
    assert len(result.clouds_W) == 2
    assert abs(result.table.offset) < 1e-3
    assert result.plane_rms < 1e-3
    for cloud, (low, high) in zip(result.clouds_W, BOXES, strict=True):
        assert (cloud > low - 2e-3).all()
        assert (cloud < high + 2e-3).all()
        assert cloud[:, 2].max() > high[2] - 5e-3
    on_box = np.flatnonzero(depth.ravel() < ray_cast(X_WC, ()).ravel() - 1e-4)
    assert not np.intersect1d(*result.pixels).size
    assert np.isin(np.concatenate(result.pixels), on_box).all()


@settings(max_examples=15, deadline=None)
@given(
    pitch=st.floats(0.7, 1.2),
    yaw=st.floats(-3.0, 3.0),
    height=st.floats(0.6, 0.9),
    seed=st.integers(0, 1000),
)
def test_a_box_is_detected_in_noise_from_any_side(pitch, yaw, height, seed):
    X = camera_pose(height, pitch, yaw)
    distance = height / np.tan(pitch)
    target = box(distance * np.cos(yaw), distance * np.sin(yaw), (0.12, 0.12, 0.1))
    depth = ray_cast(X, [target])
    noise = np.random.default_rng(seed).normal(scale=0.001, size=SIZE)
    depth = np.where(depth < 4.0, depth, np.inf)
    depth[depth < 4.0] += (noise * depth**2)[depth < 4.0]
    result = segment_depth(depth, K, X)
    assert len(result.clouds_W) == 1
    away = result.clouds_W[0].mean(axis=0) - (target[0] + target[1]) / 2
    assert np.abs(away[:2]).max() < 0.06
    assert abs(result.table.offset) < 5e-3


def test_a_wall_does_not_replace_a_smaller_table():
    wall = box(1.0, 0.0, (0.02, 6.0, 2.0), z=-1.0)
    depth = ray_cast(camera_pose(0.5, 0.35), [wall, box(0.75, 0.0)], (0.7, 0.0, 0.25, 0.3))
    for pose in (camera_pose(0.5, 0.35), None):
        result = segment_depth(depth, K, pose)
        assert len(result.clouds_W) == 1
        assert abs(abs(result.table.normal_W[2]) - 1.0) < 1e-3


def test_an_object_beside_the_table_is_no_obstacle():
    beside = box(0.9, 0.6, (0.1, 0.1, 0.9), z=-0.7)
    result = segment_depth(ray_cast(X_WC, [BOXES[0], beside], (0.8, -0.1, 0.3, 0.4)), K, X_WC)
    assert len(result.clouds_W) == 1


@pytest.mark.parametrize("has_table", [True, False])
def test_the_self_filter_removes_the_robot(has_table):
    robot = geometries_of([box_at([0.1, 0.1, 0.16], [0.8, -0.15, 0.08])])
    depth = ray_cast(X_WC, BOXES) if has_table else ray_cast(X_WC, BOXES, NO_TABLE_EXTENT)
    config = SegmentationConfig(table=has_table)
    result = segment_depth(depth, K, X_WC, config, robot)
    assert len(result.clouds_W) == 1
    assert result.clouds_W[0][:, 1].min() > 0.0


def test_with_an_unknown_pose_the_table_defines_the_world():
    result = segment_depth(ray_cast(X_WC, BOXES), K, None)
    assert len(result.clouds_W) == 2
    np.testing.assert_allclose(result.table.normal_W, [0.0, 0.0, 1.0], atol=1e-9)
    assert abs(result.table.offset) < 1e-9
    # The origin lies where the optical axis meets the table, y points away.
    np.testing.assert_allclose(result.X_WC[0, 3], 0.0, atol=1e-4)
    assert result.X_WC[1, 3] < 0.0
    assert result.X_WC[2, 3] == pytest.approx(0.8, abs=2e-3)


def test_an_empty_image_or_cloud_has_a_note():
    assert segment_depth(np.zeros((0, 0)), K, None).note == "hardly any depth is measured"
    assert segment_points(np.full((9, 3), np.nan), None).note == "hardly any depth is measured"


def test_a_wall_alone_is_no_table():
    result = segment_depth(np.full(SIZE, 1.0, dtype=np.float32), K, camera_pose(0.8, 0.0))
    assert result.note == "no support plane found"


@pytest.mark.parametrize("table", [(), ((0.8, 0.0, 0.4, 0.012),)], ids=["bare", "narrow"])
def test_a_table_without_objects_is_usable(table):
    result = segment_depth(ray_cast(X_WC, (), *table), K, X_WC)
    assert (result.note, result.clouds_W) == ("", ())
    assert result.table is not None


def test_without_a_table_every_visible_object_is_an_obstacle():
    hung = (box(0.8, -0.15, z=0.2), box(0.9, 0.2, (0.12, 0.08, 0.06), z=0.3))
    depth = ray_cast(X_WC, hung, NO_TABLE_EXTENT)
    # With a table expected, their tops count as the table.
    assert segment_depth(depth, K, X_WC).clouds_W == ()
    cloud = (rays_of(np.eye(4), K, SIZE) * depth[..., None])[np.isfinite(depth)]
    for result in (
        segment_depth(depth, K, X_WC, NO_TABLE_CONFIG),
        segment_points(cloud, X_WC, NO_TABLE_CONFIG),
    ):
        assert result.usable
        assert result.note == ""
        assert result.table is None
        assert len(result.clouds_W) == 2
        for seen, (low, high) in zip(result.clouds_W, hung, strict=True):
            assert (seen > low - 2e-3).all()
            assert (seen < high + 2e-3).all()
    # A table is an obstacle if none is expected.
    assert len(segment_depth(ray_cast(X_WC, ()), K, X_WC, NO_TABLE_CONFIG).clouds_W) == 1


def test_without_a_table_free_space_is_usable_and_missing_depth_is_not():
    far = np.full(SIZE, np.inf, dtype=np.float32)
    result = segment_depth(far, K, X_WC, NO_TABLE_CONFIG)
    assert result.usable
    assert not result.clouds_W
    for value in (np.nan, 0.0):
        result = segment_depth(np.full(SIZE, value, dtype=np.float32), K, X_WC, NO_TABLE_CONFIG)
        assert not result.usable
        assert result.note == "hardly any depth is measured"
    with pytest.raises(ValueError, match="X_WC: must be given, since no table"):
        segment_depth(far, K, None, NO_TABLE_CONFIG)


OTHER_X_WC = look_at([1.5, 0.1, 0.8], [0.8, 0.0, 0.0])


def both(boxes, table=(0.8, 0.0, 0.5, 0.4)) -> list[View]:
    """Returns images of boxes from two sides."""
    return [View(ray_cast(X, boxes, table), K, X) for X in (X_WC, OTHER_X_WC)]


def test_images_of_one_instant_form_one_frame():
    views = both(BOXES)
    result = segment_views(views)
    assert len(result.clouds_W) == 2
    assert [view.z for view in result.views] == [view.z for view in views]
    assert result.unusable_views == {}
    for image, view in enumerate(views):
        alone = segment_depth(*view)
        # The order of the clusters may differ.
        sizes = sorted(map(len, alone.pixels))
        label = result.labels[image]
        np.testing.assert_allclose(sorted(np.bincount(label + 1)[1:]), sizes, rtol=0.05)
        assert (view.z.ravel()[label >= 0] > 0.3).all()
    one = segment_depth(*views[0])
    np.testing.assert_array_equal(one.clouds_W[0], segment_views(views[:1]).clouds_W[0])


def test_an_image_without_the_table_uses_that_of_the_other_image():
    # The second image contains only the boxes.
    views = both(BOXES)
    alone = ray_cast(OTHER_X_WC, BOXES, NO_TABLE_EXTENT)
    # Alone, the top of a box counts as the table.
    assert segment_depth(alone, K, OTHER_X_WC).clouds_W == ()
    result = segment_views([views[0], View(alone, K, OTHER_X_WC)])
    assert result.unusable_views == {}
    assert len(result.clouds_W) == 2
    assert np.bincount(result.labels[1] + 1).min() > 50


@pytest.mark.parametrize("config", [None, NO_TABLE_CONFIG])
def test_an_image_without_depth_is_left_out_and_listed(config):
    views = both(BOXES)
    nothing = View(np.full(SIZE, np.nan), K, OTHER_X_WC)
    result = segment_views([nothing, views[0]], config)
    assert list(result.unusable_views) == [0]
    assert result.usable
    assert [view.z for view in result.views] == [views[0].z]
    none = segment_views([nothing, nothing], config)
    assert not none.usable
    assert none.note == none.unusable_views[0] != ""


def test_a_gap_visible_in_one_image_separates_two_clusters():
    # One box behind the other in the first image, with a short gap between them.
    near, far = box(0.75, 0.0, (0.06, 0.12, 0.12)), box(0.86, 0.0, (0.06, 0.12, 0.11))
    assert len(segment_views(both([near, far])).clouds_W) == 2
