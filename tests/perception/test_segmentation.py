from dataclasses import replace

import numpy as np
import pydrake.geometry as drake
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.geometry.collision_scene import geometries_of, geometry_of
from drake_oa.geometry.pinhole import View
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.segmentation import segment_depth, segment_points, segment_views
from tests.reference.depth_images import SIZE, K, box, camera_pose, look_at, ray_cast

X_WC = camera_pose()
NOWHERE = (50.0, 50.0, 0.1, 0.1)
NO_TABLE = SegmentationConfig(table=False)
TWO = (box(0.8, -0.15), box(0.9, 0.2, (0.12, 0.08, 0.06)))


def test_each_box_becomes_one_cluster_inside_it():
    depth = ray_cast(X_WC, TWO)
    found = segment_depth(depth, K, X_WC)
    assert found.note == ""
    assert len(found.clouds_W) == 2
    assert abs(found.table.offset) < 1e-3
    assert found.plane_rms < 1e-3
    for cloud, (low, high) in zip(found.clouds_W, TWO, strict=True):
        assert (cloud > low - 2e-3).all()
        assert (cloud < high + 2e-3).all()
        assert cloud[:, 2].max() > high[2] - 5e-3
    on_box = np.flatnonzero(depth.ravel() < ray_cast(X_WC, ()).ravel() - 1e-4)
    assert not np.intersect1d(*found.pixels).size
    assert np.isin(np.concatenate(found.pixels), on_box).all()


@settings(max_examples=15, deadline=None)
@given(
    pitch=st.floats(0.7, 1.2),
    yaw=st.floats(-3.0, 3.0),
    height=st.floats(0.6, 0.9),
    seed=st.integers(0, 1000),
)
def test_a_noisy_box_is_found_from_any_side(pitch, yaw, height, seed):
    X = camera_pose(height, pitch, yaw)
    distance = height / np.tan(pitch)
    target = box(distance * np.cos(yaw), distance * np.sin(yaw), (0.12, 0.12, 0.1))
    depth = ray_cast(X, [target])
    noise = np.random.default_rng(seed).normal(scale=0.001, size=SIZE)
    depth = np.where(depth < 4.0, depth, np.inf)
    depth[depth < 4.0] += (noise * depth**2)[depth < 4.0]
    found = segment_depth(depth, K, X)
    assert len(found.clouds_W) == 1
    assert np.abs(found.clouds_W[0].mean(axis=0)[:2] - (target[0] + target[1])[:2] / 2).max() < 0.06
    assert abs(found.table.offset) < 5e-3


def test_a_large_wall_does_not_win_over_a_small_table():
    wall = box(1.0, 0.0, (0.02, 6.0, 2.0), z=-1.0)
    depth = ray_cast(camera_pose(0.5, 0.35), [wall, box(0.75, 0.0)], (0.7, 0.0, 0.25, 0.3))
    for pose in (camera_pose(0.5, 0.35), None):
        found = segment_depth(depth, K, pose)
        assert len(found.clouds_W) == 1
        assert abs(abs(found.table.normal_W[2]) - 1.0) < 1e-3


def test_nothing_beside_the_table_is_an_obstacle():
    beside = box(0.9, 0.6, (0.1, 0.1, 0.9), z=-0.7)
    found = segment_depth(ray_cast(X_WC, [TWO[0], beside], (0.8, -0.1, 0.3, 0.4)), K, X_WC)
    assert len(found.clouds_W) == 1


@pytest.mark.parametrize("has_table", [True, False])
def test_the_robot_is_taken_out(has_table):
    X_WB = np.eye(4)
    X_WB[:3, 3] = [0.8, -0.15, 0.08]
    robot = geometries_of([replace(geometry_of(drake.Box(0.1, 0.1, 0.16)), X_WO=X_WB)])
    depth = ray_cast(X_WC, TWO) if has_table else ray_cast(X_WC, TWO, NOWHERE)
    config = SegmentationConfig(table=has_table)
    found = segment_depth(depth, K, X_WC, config, robot)
    assert len(found.clouds_W) == 1
    assert found.clouds_W[0][:, 1].min() > 0.0


def test_an_unknown_pose_makes_the_table_the_world():
    found = segment_depth(ray_cast(X_WC, TWO), K, None)
    assert len(found.clouds_W) == 2
    np.testing.assert_allclose(found.table.normal_W, [0.0, 0.0, 1.0], atol=1e-9)
    assert abs(found.table.offset) < 1e-9
    # The origin lies where the optical axis meets the table, y points away.
    np.testing.assert_allclose(found.X_WC[0, 3], 0.0, atol=1e-4)
    assert found.X_WC[1, 3] < 0.0
    assert found.X_WC[2, 3] == pytest.approx(0.8, abs=2e-3)


def test_an_empty_image_and_an_empty_cloud_say_so():
    assert segment_depth(np.zeros((0, 0)), K, None).note == "hardly any depth is measured"
    assert segment_points(np.full((9, 3), np.nan), None).note == "hardly any depth is measured"


def test_a_wall_alone_is_no_table():
    found = segment_depth(np.full(SIZE, 1.0, dtype=np.float32), K, camera_pose(0.8, 0.0))
    assert found.note == "no support plane found"


@pytest.mark.parametrize("table", [(), ((0.8, 0.0, 0.4, 0.012),)], ids=["bare", "narrow"])
def test_a_bare_table_is_no_fault(table):
    found = segment_depth(ray_cast(X_WC, (), *table), K, X_WC)
    assert (found.note, found.clouds_W) == ("", ())
    assert found.table is not None


def test_without_a_table_all_that_is_seen_is_an_obstacle():
    hung = (box(0.8, -0.15, z=0.2), box(0.9, 0.2, (0.12, 0.08, 0.06), z=0.3))
    depth = ray_cast(X_WC, hung, NOWHERE)
    # Whoever looks for a table takes their tops for it.
    assert segment_depth(depth, K, X_WC).clouds_W == ()
    cloud = back_projected_all(depth)
    for found in (
        segment_depth(depth, K, X_WC, NO_TABLE),
        segment_points(cloud, X_WC, NO_TABLE),
    ):
        assert found.usable
        assert found.note == ""
        assert found.table is None
        assert len(found.clouds_W) == 2
        for seen, (low, high) in zip(found.clouds_W, hung, strict=True):
            assert (seen > low - 2e-3).all()
            assert (seen < high + 2e-3).all()
    # So is a table that nobody tells of.
    assert len(segment_depth(ray_cast(X_WC, ()), K, X_WC, NO_TABLE).clouds_W) == 1


def back_projected_all(depth: np.ndarray) -> np.ndarray:
    v, u = np.nonzero(np.isfinite(depth))
    z = depth[v, u].astype(float)
    return np.column_stack([z * (u - K[2]) / K[0], z * (v - K[3]) / K[1], z])


def test_without_a_table_an_empty_view_is_one_and_a_blind_one_is_not():
    far = np.full(SIZE, np.inf, dtype=np.float32)
    found = segment_depth(far, K, X_WC, NO_TABLE)
    assert found.usable
    assert not found.clouds_W
    for unusable_views in (
        np.full(SIZE, np.nan, dtype=np.float32),
        np.zeros(SIZE, dtype=np.float32),
    ):
        found = segment_depth(unusable_views, K, X_WC, NO_TABLE)
        assert not found.usable
        assert found.note == "hardly any depth is measured"
    with pytest.raises(ValueError, match="X_WC must be given where no table"):
        segment_depth(far, K, None, NO_TABLE)


OTHER = look_at([1.5, 0.1, 0.8], [0.8, 0.0, 0.0])


def both(boxes, table=(0.8, 0.0, 0.5, 0.4)) -> list[View]:
    """Images of the boxes from both sides."""
    return [View(ray_cast(X, boxes, table), K, X) for X in (X_WC, OTHER)]


def test_images_of_one_instant_are_one_frame():
    views = both(TWO)
    found = segment_views(views)
    assert len(found.clouds_W) == 2
    assert [view.z for view in found.views] == [view.z for view in views]
    assert found.unusable_views == {}
    for image, view in enumerate(views):
        alone = segment_depth(*view)
        # Which is the larger may differ.
        shown = sorted(map(len, alone.pixels))
        label = found.labels[image]
        np.testing.assert_allclose(sorted(np.bincount(label + 1)[1:]), shown, rtol=0.05)
        assert (view.z.ravel()[label >= 0] > 0.3).all()
    one = segment_depth(*views[0])
    np.testing.assert_array_equal(one.clouds_W[0], segment_views(views[:1]).clouds_W[0])


def test_an_image_without_the_table_shows_it_as_the_others_do():
    # The second camera sees the boxes and nothing else.
    views = both(TWO)
    alone = ray_cast(OTHER, TWO, NOWHERE)
    # By itself it takes the top of a box for it.
    assert segment_depth(alone, K, OTHER).clouds_W == ()
    found = segment_views([views[0], View(alone, K, OTHER)])
    assert found.unusable_views == {}
    assert len(found.clouds_W) == 2
    assert np.bincount(found.labels[1] + 1).min() > 50


@pytest.mark.parametrize("config", [None, NO_TABLE])
def test_a_blind_image_is_left_out_and_told_of(config):
    views = both(TWO)
    nothing = View(np.full(SIZE, np.nan), K, OTHER)
    found = segment_views([nothing, views[0]], config)
    assert list(found.unusable_views) == [0]
    assert found.usable
    assert [view.z for view in found.views] == [views[0].z]
    none = segment_views([nothing, nothing], config)
    assert not none.usable
    assert none.note == none.unusable_views[0] != ""


def test_a_gap_that_one_image_sees_through_separates():
    # Behind each other, as the first camera sees them, a short gap apart.
    near, far = box(0.75, 0.0, (0.06, 0.12, 0.12)), box(0.86, 0.0, (0.06, 0.12, 0.11))
    assert len(segment_views(both([near, far])).clouds_W) == 2
