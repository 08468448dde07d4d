"""Tests of multi-object tracking, on ray-cast depth images with the noise of a depth camera."""

from dataclasses import replace

import numpy as np
import pytest

from drake_oa.common.messages import ObstacleClouds
from drake_oa.geometry.collision_scene import CollisionGeometries, geometries_of
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.segmentation import Segmentation, segment_views
from drake_oa.perception.tracking import TrackerState, update_tracks
from drake_oa.perception.velocity import Sides, correct_tracks, new_tracks
from drake_oa.world.depth_noise import add_depth_noise
from tests.planning.arms import box_at
from tests.reference.depth_images import look_at, ray_cast

K = np.array([400.0, 400.0, 159.5, 119.5])
CONFIG = SegmentationConfig(table_height=0.0, far=4.0)
FRONT, OPPOSITE = (
    look_at(p_WC, [0.1, 0.0, 0.05]) for p_WC in ([1.25, 0.1, 0.9], [-1.05, -0.1, 0.9])
)
FRAME = 1.0 / 30.0
"""Time between two frames [s]."""


def box(center, size):
    """Returns the lowest and highest corner of a box [m]."""
    half = np.array(size) / 2.0
    return center - half, center + half


BLOCK = box([0.1, 0.0, 0.1], [0.12, 0.14, 0.2])
LEFT, RIGHT = box([-0.1, -0.35, 0.05], [0.1] * 3), box([-0.2, 0.3, 0.08], [0.1, 0.12, 0.16])


def arm(center, size) -> tuple[tuple, CollisionGeometries]:
    """Returns an upright box that is the robot: its corners, and its collision geometry."""
    return box(center, size), geometries_of([box_at(size, center)])


OCCLUDER = arm([0.6, 0.05, 0.35], [0.05, 0.16, 0.5])
"""Robot that occludes BLOCK from the camera at FRONT."""


def track(
    *frames,
    tracker=None,
    start=0.0,
    robot=None,
    noise=False,
    K=K,
    poses=(FRONT,),
    missing=(),
    **options,
) -> TrackerState:
    """Returns the tracker state after frames at 30 Hz.

    Args:
        frames: boxes in the view of the cameras, for each frame.
        tracker: state before the first frame; None: initial state.
        start: time of the first frame [s].
        robot: collision geometry of the robot.
        noise: whether the images have the noise of a depth camera.
        K: intrinsics of the cameras [pixel].
        poses: poses X_WC of the cameras.
        missing: boxes whose pixels have no depth.
        options: options of `update_tracks`.
    """
    tracker = tracker or TrackerState()
    for k, boxes in enumerate(frames):
        stamp, views = start + k * FRAME, []
        for X_WC in poses:
            depth = ray_cast(X_WC, boxes, (0.0, 0.0, 0.6, 0.6), K)
            if missing:
                depth[ray_cast(X_WC, missing, (0.0, 0.0, 0.6, 0.6), K) < depth] = np.nan
            if noise:
                depth = add_depth_noise(depth, stamp, K=K)
            views.append((depth, np.array(K), X_WC))
        tracker = update_tracks(
            tracker, segment_views(views, CONFIG, robot), stamp, CONFIG, robot, **options
        )
    return tracker


def middle(cloud: np.ndarray) -> np.ndarray:
    """Returns the center of the bounding box of a cloud [m]."""
    return (cloud.min(axis=0) + cloud.max(axis=0)) / 2.0


def extent(cloud: np.ndarray) -> np.ndarray:
    """Returns the lowest and highest corner of the bounding box of a cloud [m]."""
    return np.stack([cloud.min(axis=0), cloud.max(axis=0)])


def row_near(obstacles: ObstacleClouds, near) -> int:
    """Returns the row of the obstacle nearest to a place [m]."""
    gaps = [np.linalg.norm(middle(cloud) - near) for cloud in obstacles.clouds_W]
    return int(np.argmin(gaps))


def has_same_output(one: TrackerState, other: TrackerState) -> bool:
    """Checks whether two tracker states have the same output, equal to the bit."""
    a, b = one.obstacles, other.obstacles
    return (
        np.array_equal(a.ids, b.ids)
        and np.array_equal(a.v_WO, b.v_WO)
        and all(np.array_equal(c, d) for c, d in zip(a.clouds_W, b.clouds_W, strict=True))
    )


@pytest.mark.parametrize("is_occluded", [False, True])
def test_resting_obstacles_have_no_velocity_under_noise_and_occlusion(is_occluded):
    tracker = track(*[[BLOCK, LEFT, RIGHT]] * 8, noise=True)
    first, change_count = tracker.obstacles, 0
    for k, y in enumerate(np.linspace(-0.3, 0.4, 40)):
        before = tracker.obstacles
        boxes, robot = [BLOCK, LEFT, RIGHT], None
        if is_occluded:
            drawn, robot = arm([0.6, y, 0.35], [0.05, 0.08, 0.5])
            boxes = [*boxes, drawn]
        start = (8 + k) * FRAME
        tracker = track(boxes, tracker=tracker, start=start, robot=robot, noise=True)
        output = tracker.obstacles
        np.testing.assert_array_equal(output.ids, first.ids)
        assert not output.v_WO.any()
        change_count += any(
            a is not b for a, b in zip(before.clouds_W, output.clouds_W, strict=True)
        )
        for one, other in zip(first.clouds_W, output.clouds_W, strict=True):
            np.testing.assert_allclose(extent(one), extent(other), atol=0.012)
    assert change_count < 20


def bars(lowest: float = 0.0) -> list:
    """Returns a cage of upright bars, 1.2 cm thick, whose lower ends are at a height [m]."""
    side = np.linspace(-0.16, 0.16, 5)
    ends = [(x, y) for x in side for y in (-0.16, 0.16)]
    upright = [box([x, y, 0.13 + lowest / 2.0], [0.012, 0.012, 0.26 - lowest]) for x, y in ends]
    return upright + [box([0.0, y, 0.254], [0.33, 0.012, 0.012]) for y in (-0.16, 0.16)]


def test_thin_bars_with_varying_visible_length_have_no_velocity():
    poses, tracker = [look_at([0.3, 0.05, 1.1], [0.0, 0.0, 0.1])], TrackerState()
    for k in range(24):
        seen = bars(0.16 if k % 6 > 3 else 0.06)
        tracker = track(seen, tracker=tracker, start=k * FRAME, poses=poses)
        assert not tracker.obstacles.v_WO.any()


def test_an_occluded_obstacle_remains_and_a_removed_one_is_deleted():
    small = box([0.1, 0.02, 0.05], [0.06, 0.06, 0.1])
    drawn, robot = OCCLUDER
    tracker = track(*[[small, LEFT]] * 2)
    hidden = track(*[[LEFT, drawn]] * 10, tracker=tracker, start=2 * FRAME, robot=robot)
    assert has_same_output(hidden, tracker)
    # Neither pixels without depth nor another direction of view delete it.
    around = box([0.1, 0.02, 0.06], [0.12, 0.12, 0.2])
    assert has_same_output(
        track(*[[LEFT]] * 3, tracker=tracker, start=1.0, missing=[around]), tracker
    )
    aside = FRONT.copy()
    aside[1, 3] += 1.5
    assert has_same_output(track(*[[]] * 3, tracker=tracker, start=1.0, poses=[aside]), tracker)
    once = track([LEFT], tracker=hidden, start=12 * FRAME)
    assert len(once.obstacles) == 2
    gone = track([LEFT], tracker=once, start=13 * FRAME)
    assert len(gone.obstacles) == 1
    # After its return it has another track ID.
    back = track(*[[LEFT, small]] * 2, tracker=gone, start=14 * FRAME)
    assert not set(back.obstacles.ids) <= set(tracker.obstacles.ids)


def test_a_small_cluster_in_a_single_frame_is_not_output():
    tracker = track(*[[LEFT]] * 3)
    for center in ([0.2, 0.1, 0.25], [-0.1, -0.35, 0.113]):
        once = track([LEFT, box(center, [0.024] * 3)], tracker=tracker, start=3 * FRAME)
        assert has_same_output(once, tracker)
        assert has_same_output(track([LEFT], tracker=once, start=4 * FRAME), tracker)
    assert len(track([LEFT, BLOCK], tracker=tracker, start=3 * FRAME).obstacles) == 2


@pytest.mark.parametrize(
    ("size", "start", "velocity"),
    [
        ([0.1, 0.1, 0.12], [0.15, -0.25, 0.06], [0.0, 0.2, 0.0]),
        ([0.1, 0.1, 0.12], [0.15, -0.15, 0.06], [0.0, 0.1, 0.0]),
        ([0.1, 0.14, 0.12], [0.35, -0.2, 0.06], [-0.14, 0.14, 0.0]),
        ([0.1, 0.1, 0.12], [0.15, -0.3, 0.3], [0.0, 0.4, 0.0]),
    ],
)
def test_a_moving_obstacle_is_tracked_until_it_stops(size, start, velocity):
    tracker, velocity = TrackerState(), np.array(velocity)
    for k in range(60):
        p_WO = start + velocity * FRAME * np.clip(k - 10, 0, 25)
        boxes = [box(p_WO, size), box([-0.3, 0.4, 0.05], [0.1] * 3)]
        tracker = track(boxes, tracker=tracker, start=k * FRAME, noise=True)
        output = tracker.obstacles
        np.testing.assert_array_equal(output.ids, [0, 1])
        row = row_near(output, p_WO)
        assert not np.delete(output.v_WO, row, axis=0).any()
        assert (np.ptp(output.clouds_W[row], axis=0) < 0.17).all()
        if k < 10 or k > 48:
            assert not output.v_WO.any()
        elif 20 < k < 35:
            np.testing.assert_allclose(output.v_WO[row], velocity, atol=0.06)
            assert np.abs(middle(output.clouds_W[row]) - p_WO).max() < 0.06


def test_the_velocity_of_a_distant_obstacle_is_measured_within_half_a_second():
    # At 2.8 m a depth step is as large as the displacement in one frame.
    poses, K = [look_at([2.6, 0.4, 1.2], [0.0, 0.0, 0.2])], [580.0, 580.0, 159.5, 119.5]
    tracker = TrackerState()
    for k in range(36):
        p_WO = np.array([-0.2 + 0.6 * FRAME * max(k - 12, 0), 0.0, 0.3])
        boxes = [box(p_WO, [0.2] * 3)]
        tracker = track(boxes, tracker=tracker, start=k * FRAME, noise=True, K=K, poses=poses)
        (v_WO,) = tracker.obstacles.v_WO
        if k <= 12:
            assert not v_WO.any()
        elif k > 12 + 15:
            np.testing.assert_allclose(v_WO, [0.6, 0.0, 0.0], atol=0.15)


def test_an_obstacle_that_rested_moves_with_its_first_velocity_beyond_the_gate():
    tracks = new_tracks(np.zeros((1, 3)))
    certain = np.tile(np.diag([0.002**2, 0.03**2]), (1, 3, 1, 1))
    tracks = replace(tracks, covariance=certain, motion_evidence=np.array([0.4]))
    sides = Sides(
        np.full((1, 3, 2), np.nan), np.zeros((1, 3, 2), dtype=bool), np.full(1, 0.01), np.zeros(1)
    )
    v_W, variance = np.array([[0.55, 0.0, np.nan]]), np.full((1, 3), 0.04**2)
    tracks = correct_tracks(tracks, sides, np.full(1, 0.005), v_W, variance, FRAME)
    assert tracks.is_moving.all()
    np.testing.assert_allclose(tracks.v_W, [[0.55, 0.0, 0.0]], atol=0.02)


def test_an_occluded_moving_obstacle_coasts_with_its_track_id_and_then_stops():
    drawn, robot = arm([0.6, -0.02, 0.35], [0.05, 0.08, 0.6])
    tracker = TrackerState()
    for k in range(45):
        p_WO = np.array([0.15, -0.4 + 0.4 * k * FRAME, 0.06])
        seen = [box(p_WO, [0.1, 0.1, 0.12]), drawn]
        tracker = track(seen, tracker=tracker, start=k * FRAME, robot=robot)
        np.testing.assert_array_equal(tracker.obstacles.ids, [0])
        if k >= 9:
            assert np.linalg.norm((middle(tracker.obstacles.clouds_W[0]) - p_WO)[:2]) < 0.06
            np.testing.assert_allclose(tracker.obstacles.v_WO[0], [0.0, 0.4, 0.0], atol=0.1)
    # The track stops after the maximum duration of coasting.
    drawn, robot = arm([0.6, 0.25, 0.35], [0.05, 0.5, 0.6])
    for k in range(45, 75):
        tracker = track([drawn], tracker=tracker, start=k * FRAME, robot=robot)
    assert not tracker.obstacles.v_WO.any()
    assert middle(tracker.obstacles.clouds_W[0])[1] < p_WO[1] + 0.3


def test_split_and_merged_tracks_retain_the_id_of_the_larger_part():
    parts = [box([0.1, -0.05, 0.05], [0.1, 0.2, 0.1]), box([0.1, 0.2, 0.05], [0.1, 0.08, 0.1])]
    one = box([0.1, 0.0, 0.05], [0.1, 0.3, 0.1])
    tracker = track([one], [one], *[parts] * 4)
    np.testing.assert_array_equal(tracker.obstacles.ids, [0, 1])
    assert tracker.obstacles.clouds_W[0][:, 1].max() < 0.07
    for k in range(6, 56):
        y = max(0.09, 0.2 - 0.01 * (k - 6))
        boxes = [parts[0], box([0.1, y, 0.05], [0.1, 0.08, 0.1])]
        tracker = track(boxes, tracker=tracker, start=k * FRAME)
    np.testing.assert_array_equal(tracker.obstacles.ids, [0])


def test_unusable_repeated_and_earlier_frames():
    tracker = track([BLOCK], [BLOCK])
    unusable = update_tracks(tracker, Segmentation(usable=False, note="no plane"), 1.0, CONFIG)
    assert has_same_output(unusable, tracker)
    assert (unusable.obstacles.note, unusable.obstacles.stamp) == ("no plane", FRAME)
    assert has_same_output(track([LEFT], tracker=tracker, start=FRAME), tracker)
    # A frame with an earlier stamp resets the tracker; no track ID is used twice.
    np.testing.assert_array_equal(track([LEFT], tracker=tracker, start=-1.0).obstacles.ids, [1])


def test_irregular_frame_times_cause_no_velocity():
    tracker, time = TrackerState(), 0.0
    for dt in [FRAME] * 5 + [0.001] * 10 + [3.0] + [0.1, 0.01] * 5:
        time += dt
        tracker = track([BLOCK, LEFT], tracker=tracker, start=time, noise=True)
        assert not tracker.obstacles.v_WO.any()
        np.testing.assert_array_equal(tracker.obstacles.ids, [0, 1])


def test_an_obstacle_occluded_from_one_camera_is_tracked_by_the_other():
    start, both = np.array([-0.12, -0.03, 0.04]), (FRONT, OPPOSITE)
    hidden = box(start, [0.06, 0.06, 0.08])
    assert len(track(*[[BLOCK, hidden]] * 3).obstacles) == 1
    tracker = track(*[[BLOCK, hidden]] * 3, poses=both)
    assert len(tracker.obstacles) == 2
    # Only the second camera observes the place of the removed obstacle.
    alone = track(*[[BLOCK]] * 6, tracker=tracker, start=3 * FRAME)
    np.testing.assert_array_equal(alone.obstacles.ids, tracker.obstacles.ids)
    assert len(track(*[[BLOCK]] * 3, tracker=tracker, start=3 * FRAME, poses=both).obstacles) == 1
    v = np.array([0.0, 0.2, 0.0])
    for k in range(3, 15):
        p_WO = start + (k - 2) * FRAME * v
        boxes = [BLOCK, box(p_WO, [0.06, 0.06, 0.08])]
        tracker = track(boxes, tracker=tracker, start=k * FRAME, poses=both)
    row = row_near(tracker.obstacles, p_WO)
    np.testing.assert_allclose(tracker.obstacles.v_WO[row], v, atol=0.03)
    assert not np.delete(tracker.obstacles.v_WO, row, axis=0).any()


def test_the_rear_side_remains_while_the_camera_behind_is_missing():
    tracker = track(*[[BLOCK]] * 4, poses=(FRONT, OPPOSITE))
    before = extent(tracker.obstacles.clouds_W[0])
    tracker = track(*[[BLOCK]] * 8, tracker=tracker, start=4 * FRAME, complete=False)
    np.testing.assert_allclose(extent(tracker.obstacles.clouds_W[0]), before, atol=0.003)
