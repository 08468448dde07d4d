"""A wall-less world seen from above: the camera looks straight down from 1 m."""

import numpy as np
import pytest

from drake_oa.point_cloud import SegmentationConfig, segment_depth
from drake_oa.self_filter import RobotShapes
from drake_oa.tracking import fuse, track
from drake_oa.values import ObstacleClouds

K = np.array([250.0, 250.0, 99.5, 99.5])
X_WC = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
)
# A plate held at 0.5 m, the "arm": half extents, and its place's height.
PLATE = np.array([0.05, 0.4, 0.01])
HEIGHT = 0.5


def image(*boxes: tuple[float, float, float, float, float]) -> np.ndarray:
    """Depth of the table with boxes (x, y, half x, half y, top) seen from above.

    Sides are not seen: each top is drawn where its pixels fall.
    """
    depth = np.ones((200, 200), dtype=np.float32)
    v, u = np.mgrid[:200, :200]
    for x, y, half_x, half_y, top in sorted(boxes, key=lambda item: item[-1]):
        z = 1.0 - top
        p_x, p_y = (u - K[2]) / K[0] * z, -(v - K[3]) / K[1] * z
        depth[(np.abs(p_x - x) <= half_x) & (np.abs(p_y - y) <= half_y)] = z
    return depth


def plate(x: float):
    return (x, 0.0, PLATE[0], PLATE[1], HEIGHT + PLATE[2])


def robot_at(x: float):
    shapes = RobotShapes(np.array([0]), np.eye(4)[None], PLATE[None], np.zeros(1))
    X_WB = np.eye(4)
    X_WB[:3, 3] = [x, 0.0, HEIGHT]
    return shapes.posed(X_WB[None])


def step(previous: ObstacleClouds, depth: np.ndarray, stamp: float, robot=None, **options):
    frame = segment_depth(depth, K, X_WC, None, robot)
    assert frame.note == ""
    return fuse(previous, frame, depth, K, stamp, None, robot, **options)


BLOCK = (0.0, 0.0, 0.06, 0.06, 0.1)


def test_the_first_frame_is_taken_as_it_is():
    now = step(ObstacleClouds(), image(BLOCK, (0.2, 0.0, 0.04, 0.04, 0.1)), 0.5)
    assert now.stamp == 0.5
    np.testing.assert_array_equal(now.ids, [0, 1])
    assert len(now.clouds_W[0]) > len(now.clouds_W[1])
    assert not now.clouds_W[0].flags.writeable


def test_an_unchanged_scene_stays_unchanged():
    first = step(ObstacleClouds(), image(BLOCK), 0.0)
    second = step(first, image(BLOCK), 1.0)
    np.testing.assert_array_equal(first.clouds_W[0], second.clouds_W[0])
    np.testing.assert_array_equal(first.ids, second.ids)
    assert second.stamp == 1.0


def test_noise_does_not_make_an_obstacle_grow():
    rng = np.random.default_rng(0)
    now = step(ObstacleClouds(), image(BLOCK), 0.0)
    size = len(now.clouds_W[0])
    for k in range(20):
        depth = image(BLOCK)
        depth += rng.normal(scale=0.0015, size=depth.shape).astype(np.float32)
        now = step(now, depth, float(k))
    assert len(now) == 1
    assert len(now.clouds_W[0]) < 2.2 * size  # noise alone doubles a flat top's voxels
    assert np.ptp(now.clouds_W[0][:, 2]) < 0.02


@pytest.mark.parametrize("x", [-0.03, 0.0, 0.04])
def test_what_the_arm_hides_is_kept(x):
    first = step(ObstacleClouds(), image(BLOCK), 0.0)
    alone = step(ObstacleClouds(), image(BLOCK, plate(x)), 0.0, robot_at(x))
    assert sum(map(len, alone.clouds_W)) < 0.7 * len(first.clouds_W[0])
    now = step(first, image(BLOCK, plate(x)), 1.0, robot_at(x))
    np.testing.assert_array_equal(now.ids, first.ids)
    assert len(now.clouds_W[0]) == pytest.approx(len(first.clouds_W[0]), rel=0.05)


def test_a_wholly_hidden_obstacle_is_kept_until_its_place_is_seen_empty():
    small = (0.0, 0.0, 0.03, 0.03, 0.1)
    now = step(ObstacleClouds(), image(small), 0.0)
    for k in range(3):
        now = step(now, image(plate(0.0)), 1.0 + k, robot_at(0.0))
        np.testing.assert_array_equal(now.ids, [0])
    assert len(step(now, image(), 5.0)) == 0


def test_missing_depth_hides_and_infinite_depth_shows():
    now = step(ObstacleClouds(), image(BLOCK), 0.0)
    for value, kept in ((np.nan, 1), (0.0, 1), (np.inf, 0)):
        depth = image()
        depth[60:140, 60:140] = value
        assert len(step(now, depth, 1.0)) == kept


def test_what_leaves_the_image_is_kept():
    now = step(ObstacleClouds(), image(BLOCK), 0.0)
    aside = X_WC.copy()
    aside[0, 3] = 0.6
    frame = segment_depth(image(), K, aside)
    assert len(fuse(now, frame, image(), K, 1.0)) == 1


def test_an_obstacle_that_rises_leaves_nothing_behind_itself():
    now = step(ObstacleClouds(), image(BLOCK), 0.0)
    for k, top in enumerate((0.15, 0.2, 0.25)):
        now = step(now, image((*BLOCK[:4], top)), 1.0 + k)
        np.testing.assert_array_equal(now.ids, [0])
        assert now.clouds_W[0][:, 2].min() > top - 0.02


def test_a_split_obstacle_becomes_two_and_the_larger_keeps_the_name():
    now = step(ObstacleClouds(), image((0.0, 0.0, 0.1, 0.05, 0.1)), 0.0)
    now = step(now, image((-0.05, 0.0, 0.05, 0.05, 0.1), (0.1, 0.0, 0.03, 0.05, 0.1)), 1.0)
    np.testing.assert_array_equal(now.ids, [0, 1])
    assert now.clouds_W[0][:, 0].max() < 0.01


def test_names_follow_the_obstacles_and_are_never_given_twice():
    left, right = (-0.2, 0.0, 0.05, 0.05, 0.1), (0.2, 0.0, 0.06, 0.06, 0.1)
    now = step(ObstacleClouds(), image(left, right), 0.0)
    names = {np.sign(c[:, 0].mean()): i for c, i in zip(now.clouds_W, now.ids, strict=True)}
    moved = step(now, image((-0.13, 0.0, 0.05, 0.05, 0.1), right), 1.0)
    for cloud, name in zip(moved.clouds_W, moved.ids, strict=True):
        assert names[np.sign(cloud[:, 0].mean())] == name
    gone = step(moved, image(), 2.0)
    assert len(gone) == 0
    np.testing.assert_array_equal(step(gone, image(left), 3.0, first_new_id=2).ids, [2])


def test_tracking_alone_names_but_remembers_nothing():
    now = track(ObstacleClouds(), segment_depth(image(BLOCK), K, X_WC), 0.0)
    depth = image(BLOCK, plate(0.04))
    after = track(now, segment_depth(depth, K, X_WC, None, robot_at(0.04)), 1.0)
    np.testing.assert_array_equal(after.ids, now.ids)
    assert len(after.clouds_W[0]) < len(now.clouds_W[0])


def test_a_frame_may_use_its_own_parameters():
    config = SegmentationConfig(min_cluster_voxels=10_000)
    frame = segment_depth(image(BLOCK), K, X_WC, config)
    assert len(fuse(ObstacleClouds(), frame, image(BLOCK), K, 0.0, config)) == 0
