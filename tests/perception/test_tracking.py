"""Tracking of obstacles from frame to frame, on ray-cast depth images with a camera's noise."""

from dataclasses import replace

import numpy as np
import pydrake.geometry as drake
import pytest

from drake_oa.common.messages import ObstacleClouds
from drake_oa.geometry.collision_scene import CollisionGeometries, geometries_of, geometry_of
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.segmentation import Segmentation, segment_views
from drake_oa.perception.tracking import TrackerState, update_tracks
from drake_oa.world.depth_noise import add_depth_noise
from tests.reference.depth_images import look_at, ray_cast

K = np.array([400.0, 400.0, 159.5, 119.5])
CONFIG = SegmentationConfig(table_height=0.0, far=4.0)
FRONT, OPPOSITE = (
    look_at(p_WC, [0.1, 0.0, 0.05]) for p_WC in ([1.25, 0.1, 0.9], [-1.05, -0.1, 0.9])
)
FRAME = 1.0 / 30.0


def box(center, size):
    """Lowest and highest corner."""
    half = np.array(size) / 2.0
    return center - half, center + half


BLOCK = box([0.1, 0.0, 0.1], [0.12, 0.14, 0.2])
LEFT, RIGHT = box([-0.1, -0.35, 0.05], [0.1] * 3), box([-0.2, 0.3, 0.08], [0.1, 0.12, 0.16])


def arm(center, size) -> tuple[tuple, CollisionGeometries]:
    """An upright box that is the robot: to be drawn, and its solids."""
    X_WB = np.eye(4)
    X_WB[:3, 3] = center
    return box(center, size), geometries_of([replace(geometry_of(drake.Box(*size)), X_WO=X_WB)])


HIDES = arm([0.6, 0.05, 0.35], [0.05, 0.16, 0.5])  # stands before BLOCK


def play(
    *frames,
    memory=None,
    start=0.0,
    robot=None,
    noise=False,
    K=K,
    poses=(FRONT,),
    missing=(),
    **options,
) -> TrackerState:
    """The memory after frames at 30 Hz; each is the boxes that cameras at some poses see.

    Args:
        frames: boxes of each.
        memory: what is remembered before.
        start: time of the first one [s].
        robot: its solids.
        noise: whether the images have a camera's noise.
        K: intrinsics.
        poses: of the cameras.
        missing: boxes whose pixels have no depth.
        options: of `update_tracks`.
    """
    memory = memory or TrackerState()
    for k, boxes in enumerate(frames):
        stamp, views = start + k * FRAME, []
        for X_WC in poses:
            depth = ray_cast(X_WC, boxes, (0.0, 0.0, 0.6, 0.6), K)
            if missing:
                depth[ray_cast(X_WC, missing, (0.0, 0.0, 0.6, 0.6), K) < depth] = np.nan
            if noise:
                depth = add_depth_noise(depth, stamp, K=K)
            views.append((depth, np.array(K), X_WC))
        memory = update_tracks(
            memory, segment_views(views, CONFIG, robot), stamp, CONFIG, robot, **options
        )
    return memory


def middle(cloud: np.ndarray) -> np.ndarray:
    return (cloud.min(axis=0) + cloud.max(axis=0)) / 2.0


def extent(cloud: np.ndarray) -> np.ndarray:
    return np.stack([cloud.min(axis=0), cloud.max(axis=0)])


def named(obstacles: ObstacleClouds, near) -> int:
    """The row of the obstacle nearest to a place."""
    gaps = [np.linalg.norm(middle(cloud) - near) for cloud in obstacles.clouds_W]
    return int(np.argmin(gaps))


def same(one: TrackerState, other: TrackerState) -> bool:
    """Whether the same obstacles are handed on, bit for bit."""
    a, b = one.obstacles, other.obstacles
    return (
        np.array_equal(a.ids, b.ids)
        and np.array_equal(a.v_WO, b.v_WO)
        and all(np.array_equal(c, d) for c, d in zip(a.clouds_W, b.clouds_W, strict=True))
    )


@pytest.mark.parametrize("sweep", [False, True])
def test_a_resting_scene_rests_under_noise_and_behind_a_passing_arm(sweep):
    memory = play(*[[BLOCK, LEFT, RIGHT]] * 8, noise=True)
    first, changes = memory.obstacles, 0
    for k, y in enumerate(np.linspace(-0.3, 0.4, 40)):
        before = memory.obstacles
        boxes, robot = [BLOCK, LEFT, RIGHT], None
        if sweep:
            drawn, robot = arm([0.6, y, 0.35], [0.05, 0.08, 0.5])
            boxes = [*boxes, drawn]
        start = (8 + k) * FRAME
        memory = play(boxes, memory=memory, start=start, robot=robot, noise=True)
        now = memory.obstacles
        np.testing.assert_array_equal(now.ids, first.ids)
        assert not now.v_WO.any()
        changes += any(a is not b for a, b in zip(before.clouds_W, now.clouds_W, strict=True))
        for one, other in zip(first.clouds_W, now.clouds_W, strict=True):
            np.testing.assert_allclose(extent(one), extent(other), atol=0.012)
    assert changes < 20


def bars(lowest: float = 0.0) -> list:
    """A cage of upright bars, each 1.2 cm thick, open at its top."""
    side = np.linspace(-0.16, 0.16, 5)
    ends = [(x, y) for x in side for y in (-0.16, 0.16)]
    upright = [box([x, y, 0.13 + lowest / 2.0], [0.012, 0.012, 0.26 - lowest]) for x, y in ends]
    return upright + [box([0.0, y, 0.254], [0.33, 0.012, 0.012]) for y in (-0.16, 0.16)]


def test_thin_bars_do_not_seem_to_move_where_their_ends_come_and_go():
    poses, memory = [look_at([0.3, 0.05, 1.1], [0.0, 0.0, 0.1])], TrackerState()
    for k in range(24):
        seen = bars(0.16 if k % 6 > 3 else 0.06)
        memory = play(seen, memory=memory, start=k * FRAME, poses=poses)
        assert not memory.obstacles.v_WO.any()


def test_an_occluded_obstacle_is_kept_and_a_removed_one_forgotten():
    small = box([0.1, 0.02, 0.05], [0.06, 0.06, 0.1])
    drawn, robot = HIDES
    memory = play(*[[small, LEFT]] * 2)
    hidden = play(*[[LEFT, drawn]] * 10, memory=memory, start=2 * FRAME, robot=robot)
    assert same(hidden, memory)
    # Nor do pixels without depth, or a camera that looks elsewhere, remove it.
    around = box([0.1, 0.02, 0.06], [0.12, 0.12, 0.2])
    assert same(play(*[[LEFT]] * 3, memory=memory, start=1.0, missing=[around]), memory)
    aside = FRONT.copy()
    aside[1, 3] += 1.5
    assert same(play(*[[]] * 3, memory=memory, start=1.0, poses=[aside]), memory)
    once = play([LEFT], memory=hidden, start=12 * FRAME)
    assert len(once.obstacles) == 2
    gone = play([LEFT], memory=once, start=13 * FRAME)
    assert len(gone.obstacles) == 1
    # It comes back with another ID.
    back = play(*[[LEFT, small]] * 2, memory=gone, start=14 * FRAME)
    assert not set(back.obstacles.ids) <= set(memory.obstacles.ids)


def test_what_is_seen_in_a_single_frame_is_never_handed_on():
    memory = play(*[[LEFT]] * 3)
    for center in ([0.2, 0.1, 0.25], [-0.1, -0.35, 0.113]):
        once = play([LEFT, box(center, [0.024] * 3)], memory=memory, start=3 * FRAME)
        assert same(once, memory)
        assert same(play([LEFT], memory=once, start=4 * FRAME), memory)
    assert len(play([LEFT, BLOCK], memory=memory, start=3 * FRAME).obstacles) == 2


@pytest.mark.parametrize(
    ("size", "start", "velocity"),
    [
        ([0.1, 0.1, 0.12], [0.15, -0.25, 0.06], [0.0, 0.2, 0.0]),
        ([0.1, 0.14, 0.12], [0.35, -0.2, 0.06], [-0.14, 0.14, 0.0]),
        ([0.1, 0.1, 0.12], [0.15, -0.3, 0.3], [0.0, 0.4, 0.0]),
    ],
)
def test_a_moving_obstacle_is_followed_and_rests_where_it_stops(size, start, velocity):
    memory, velocity = TrackerState(), np.array(velocity)
    for k in range(60):
        p_WO = start + velocity * FRAME * np.clip(k - 10, 0, 25)
        boxes = [box(p_WO, size), box([-0.3, 0.4, 0.05], [0.1] * 3)]
        memory = play(boxes, memory=memory, start=k * FRAME, noise=True)
        now = memory.obstacles
        np.testing.assert_array_equal(now.ids, [0, 1])
        row = named(now, p_WO)
        assert not np.delete(now.v_WO, row, axis=0).any()
        assert (np.ptp(now.clouds_W[row], axis=0) < 0.17).all()
        if k < 10 or k > 48:
            assert not now.v_WO.any()
        elif 20 < k < 35:
            np.testing.assert_allclose(now.v_WO[row], velocity, atol=0.06)
            assert np.abs(middle(now.clouds_W[row]) - p_WO).max() < 0.06


def test_the_velocity_of_a_distant_obstacle_is_known_within_half_a_second():
    # At 2.8 m a step of the depth is as far as the obstacle goes in a frame.
    poses, K = [look_at([2.6, 0.4, 1.2], [0.0, 0.0, 0.2])], [580.0, 580.0, 159.5, 119.5]
    memory = TrackerState()
    for k in range(36):
        p_WO = np.array([-0.2 + 0.6 * FRAME * max(k - 12, 0), 0.0, 0.3])
        boxes = [box(p_WO, [0.2] * 3)]
        memory = play(boxes, memory=memory, start=k * FRAME, noise=True, K=K, poses=poses)
        (v_WO,) = memory.obstacles.v_WO
        if k <= 12:
            assert not v_WO.any()
        elif k > 12 + 15:
            np.testing.assert_allclose(v_WO, [0.6, 0.0, 0.0], atol=0.15)


def test_a_moving_obstacle_keeps_its_id_behind_the_arm_and_is_not_carried_away():
    drawn, robot = arm([0.6, -0.02, 0.35], [0.05, 0.08, 0.6])
    memory = TrackerState()
    for k in range(45):
        p_WO = np.array([0.15, -0.4 + 0.4 * k * FRAME, 0.06])
        seen = [box(p_WO, [0.1, 0.1, 0.12]), drawn]
        memory = play(seen, memory=memory, start=k * FRAME, robot=robot)
        np.testing.assert_array_equal(memory.obstacles.ids, [0])
        if k >= 9:
            assert np.linalg.norm((middle(memory.obstacles.clouds_W[0]) - p_WO)[:2]) < 0.06
            np.testing.assert_allclose(memory.obstacles.v_WO[0], [0.0, 0.4, 0.0], atol=0.1)
    # Occluded for long, it stops.
    drawn, robot = arm([0.6, 0.25, 0.35], [0.05, 0.5, 0.6])
    for k in range(45, 75):
        memory = play([drawn], memory=memory, start=k * FRAME, robot=robot)
    assert not memory.obstacles.v_WO.any()
    assert middle(memory.obstacles.clouds_W[0])[1] < p_WO[1] + 0.3


def test_split_and_merged_obstacles_leave_the_id_to_the_larger():
    parts = [box([0.1, -0.05, 0.05], [0.1, 0.2, 0.1]), box([0.1, 0.2, 0.05], [0.1, 0.08, 0.1])]
    one = box([0.1, 0.0, 0.05], [0.1, 0.3, 0.1])
    memory = play([one], [one], *[parts] * 4)
    np.testing.assert_array_equal(memory.obstacles.ids, [0, 1])
    assert memory.obstacles.clouds_W[0][:, 1].max() < 0.07
    for k in range(6, 56):
        y = max(0.09, 0.2 - 0.01 * (k - 6))
        boxes = [parts[0], box([0.1, y, 0.05], [0.1, 0.08, 0.1])]
        memory = play(boxes, memory=memory, start=k * FRAME)
    np.testing.assert_array_equal(memory.obstacles.ids, [0])


def test_frames_that_are_unusable_repeat_or_go_back():
    memory = play([BLOCK], [BLOCK])
    unusable = update_tracks(memory, Segmentation(usable=False, note="no plane"), 1.0, CONFIG)
    assert same(unusable, memory)
    assert (unusable.obstacles.note, unusable.obstacles.stamp) == ("no plane", FRAME)
    assert same(play([LEFT], memory=memory, start=FRAME), memory)
    # From before, it begins again, and gives no ID twice.
    np.testing.assert_array_equal(play([LEFT], memory=memory, start=-1.0).obstacles.ids, [1])


def test_frames_in_a_burst_and_after_a_gap_are_no_motion():
    memory, time = TrackerState(), 0.0
    for dt in [FRAME] * 5 + [0.001] * 10 + [3.0] + [0.1, 0.01] * 5:
        time += dt
        memory = play([BLOCK, LEFT], memory=memory, start=time, noise=True)
        assert not memory.obstacles.v_WO.any()
        np.testing.assert_array_equal(memory.obstacles.ids, [0, 1])


def test_what_one_camera_does_not_see_is_tracked_by_the_other():
    start, both = np.array([-0.12, -0.03, 0.04]), (FRONT, OPPOSITE)
    hidden = box(start, [0.06, 0.06, 0.08])
    assert len(play(*[[BLOCK, hidden]] * 3).obstacles) == 1
    memory = play(*[[BLOCK, hidden]] * 3, poses=both)
    assert len(memory.obstacles) == 2
    # The first camera cannot tell whether it is gone, the second one can.
    alone = play(*[[BLOCK]] * 6, memory=memory, start=3 * FRAME)
    np.testing.assert_array_equal(alone.obstacles.ids, memory.obstacles.ids)
    assert len(play(*[[BLOCK]] * 3, memory=memory, start=3 * FRAME, poses=both).obstacles) == 1
    v = np.array([0.0, 0.2, 0.0])
    for k in range(3, 15):
        p_WO = start + (k - 2) * FRAME * v
        boxes = [BLOCK, box(p_WO, [0.06, 0.06, 0.08])]
        memory = play(boxes, memory=memory, start=k * FRAME, poses=both)
    row = named(memory.obstacles, p_WO)
    np.testing.assert_allclose(memory.obstacles.v_WO[row], v, atol=0.03)
    assert not np.delete(memory.obstacles.v_WO, row, axis=0).any()


def test_the_far_side_that_the_other_camera_saw_is_kept_while_that_is_missing():
    memory = play(*[[BLOCK]] * 4, poses=(FRONT, OPPOSITE))
    before = extent(memory.obstacles.clouds_W[0])
    memory = play(*[[BLOCK]] * 8, memory=memory, start=4 * FRAME, complete=False)
    np.testing.assert_allclose(extent(memory.obstacles.clouds_W[0]), before, atol=0.003)
