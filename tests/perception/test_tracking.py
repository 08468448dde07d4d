"""What is remembered from frame to frame, on drawn depth images with a camera's noise."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_oa.common.messages import ObstacleClouds, TablePlane
from drake_oa.geometry.pinhole import View
from drake_oa.geometry.solids import Solids, solids_of
from drake_oa.geometry.solids import box as box_solid
from drake_oa.perception.config import SegmentationConfig
from drake_oa.perception.segmentation import (
    Segmentation,
    segment_depth,
    segment_points,
    segment_views,
)
from drake_oa.perception.tracking import ObstacleMemory, fuse
from drake_oa.perception.velocity import seen_sides
from drake_oa.world.depth_noise import add_depth_noise
from tests.reference.depth_images import look_at, rays_of

SHAPE = (240, 320)
K = np.array([400.0, 400.0, 159.5, 119.5])
CONFIG = SegmentationConfig(table_height=0.0)


X_WC = look_at([1.25, 0.1, 0.9], [0.1, 0.0, 0.05])


def box(center, size):
    return "box", np.asarray(center, dtype=float), np.asarray(size, dtype=float) / 2.0


def sphere(center, radius):
    return "sphere", np.asarray(center, dtype=float), float(radius)


def arm(center, size=(0.06, 0.06, 0.6)) -> tuple[tuple, Solids]:
    """An upright box that is the robot: to be drawn, and its solids."""
    X_WB = np.eye(4)
    X_WB[:3, 3] = center
    return box(center, size), solids_of([replace(box_solid(size), X_WO=X_WB)])


@cache
def seen_table(pose: bytes, focal: float) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the table, and the rays of unit depth in the world (one reciprocal each)."""
    X_WC = np.frombuffer(pose).reshape(4, 4)
    rays = rays_of(X_WC, [focal, focal, *K[2:]], SHAPE)
    depth = -X_WC[2, 3] / rays[..., 2]
    hit = X_WC[:3, 3] + depth[..., None] * rays
    on_table = (depth > 0.0) & (np.abs(hit[..., :2]) < 0.6).all(axis=-1)
    return np.where(on_table, depth, np.inf), rays


def render(*things, K=K, X_WC=X_WC) -> np.ndarray:
    """Depth of the table z = 0, |x| and |y| below 0.6 m, and of things on it."""
    table, rays = seen_table(X_WC.tobytes(), K[0])
    depth, start = table.copy(), X_WC[:3, 3]
    for kind, center, size in things:
        # Only the pixels in the cone round it.
        reach = np.linalg.norm(size) if kind == "box" else size
        to = (center - start) @ X_WC[:3, :3]
        u, v, r = K[0] * to[0] / to[2] + K[2], K[1] * to[1] / to[2] + K[3], K[0] * 1.3 * reach
        r = r / (to[2] - reach)
        rows = slice(max(0, int(v - r)), max(0, int(v + r) + 2))
        columns = slice(max(0, int(u - r)), max(0, int(u + r) + 2))
        ray, part = rays[rows, columns], depth[rows, columns]
        with np.errstate(divide="ignore", invalid="ignore"):
            if kind == "box":
                one, other = (center - size - start) / ray, (center + size - start) / ray
                near = np.minimum(one, other).max(axis=-1)
                far = np.maximum(one, other).min(axis=-1)
                at = np.where((near < far) & (far > 0.0), near, np.inf)
            else:
                a, b = (ray**2).sum(axis=-1), ray @ (start - center)
                root = b * b - a * (((start - center) ** 2).sum() - size**2)
                at = np.where(root > 0.0, (-b - np.sqrt(np.maximum(root, 0.0))) / a, np.inf)
        np.minimum(part, at, out=part)
    return depth.astype(np.float32)


def noisy(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Axial noise, edge dropouts, flying pixels, single missing pixels and small holes."""
    seen = np.isfinite(depth)
    z = np.where(seen, depth, 4.0)
    edge = np.zeros(depth.shape, dtype=bool)
    for axis in (0, 1):
        step = np.abs(np.diff(z, axis=axis)) > 0.03
        pad = [(0, 0), (0, 0)]
        pad[axis] = (0, 1)
        edge |= np.pad(step, pad)
        pad[axis] = (1, 0)
        edge |= np.pad(step, pad)
    deviation = 0.0012 + 0.0019 * (z - 0.4) ** 2
    result = np.where(seen, z + deviation * rng.standard_normal(z.shape), np.inf)
    chance = rng.random(z.shape)
    near = np.minimum(np.roll(z, 1, axis=1), np.roll(z, -1, axis=1))
    far = np.maximum(np.roll(z, 1, axis=1), np.roll(z, -1, axis=1))
    between = near + rng.random(z.shape) * (far - near)
    result = np.where(edge & (chance < 0.1), between, result)
    result[(edge & (chance > 0.6)) | (rng.random(z.shape) < 0.002)] = np.nan
    for _ in range(3):
        v, u, size = rng.integers(0, z.shape[0]), rng.integers(0, z.shape[1]), rng.integers(2, 8)
        result[v : v + size, u : u + size] = np.nan
    return result.astype(np.float32)


def step(memory, depth, stamp, robot=None, *, config=CONFIG, K=K, X_WC=X_WC):
    """The memory after one frame more."""
    frame = segment_depth(depth, K, X_WC, config, robot)
    return fuse(memory, frame, stamp, config, robot)


FRAME = 1.0 / 30.0
BLOCK = box([0.1, 0.0, 0.1], [0.12, 0.14, 0.2])
LEFT, RIGHT = box([-0.1, -0.35, 0.05], [0.1] * 3), box([-0.2, 0.3, 0.08], [0.1, 0.12, 0.16])
HIDES = arm([0.6, 0.05, 0.35], [0.05, 0.16, 0.5])  # stands before BLOCK


def play(*frames, memory=None, start=0.0, robot=None, rng=None):
    """The memory after frames at 30 Hz; each is what is drawn."""
    memory = memory or ObstacleMemory()
    for k, things in enumerate(frames):
        depth = render(*things)
        depth = depth if rng is None else noisy(depth, rng)
        memory = step(memory, depth, start + k * FRAME, robot)
    return memory


def middle(cloud: np.ndarray) -> np.ndarray:
    return (cloud.min(axis=0) + cloud.max(axis=0)) / 2.0


def named(obstacles: ObstacleClouds, near) -> int:
    """The row of the obstacle nearest to a place."""
    gaps = [np.linalg.norm(middle(cloud) - near) for cloud in obstacles.clouds_W]
    return int(np.argmin(gaps))


def same(one: ObstacleMemory, other: ObstacleMemory) -> bool:
    a, b = one.obstacles, other.obstacles
    return (
        np.array_equal(a.ids, b.ids)
        and np.array_equal(a.v_WO, b.v_WO)
        and all(np.array_equal(c, d) for c, d in zip(a.clouds_W, b.clouds_W, strict=True))
    )


def test_the_first_frame_is_taken_as_it_is():
    seen = segment_depth(render(BLOCK, LEFT), K, X_WC, CONFIG)
    now = play([BLOCK, LEFT], start=0.5).obstacles
    assert now.stamp == 0.5
    np.testing.assert_array_equal(now.ids, [0, 1])
    assert not now.v_WO.any()
    for cloud, expected in zip(now.clouds_W, seen.clouds_W, strict=True):
        np.testing.assert_array_equal(np.sort(cloud, axis=0), np.sort(expected, axis=0))
        assert not cloud.flags.writeable


def test_an_unchanged_scene_stays_the_same_array():
    first = play([BLOCK, LEFT])
    second = play([BLOCK, LEFT], memory=first, start=1.0 * FRAME)
    for one, other in zip(first.obstacles.clouds_W, second.obstacles.clouds_W, strict=True):
        assert one is other
    assert second.obstacles.stamp == FRAME


def test_a_resting_scene_under_noise_rests():
    rng = np.random.default_rng(0)
    memory = play(*[[BLOCK, LEFT, RIGHT]] * 6, rng=rng)
    changes = 0
    for k in range(60):
        before = memory.obstacles
        memory = play([BLOCK, LEFT, RIGHT], memory=memory, start=(6 + k) * FRAME, rng=rng)
        now = memory.obstacles
        np.testing.assert_array_equal(now.ids, before.ids)
        assert not now.v_WO.any()
        assert now.table is before.table
        pairs = list(zip(before.clouds_W, now.clouds_W, strict=True))
        changes += any(one is not other for one, other in pairs)
        for one, other in pairs:
            np.testing.assert_allclose(one.min(axis=0), other.min(axis=0), atol=0.008)
            np.testing.assert_allclose(one.max(axis=0), other.max(axis=0), atol=0.008)
    assert changes < 12


def bars(lowest: float = 0.0) -> list:
    """A cage of upright bars, each 1.2 cm thick, open at its top."""
    side = np.linspace(-0.16, 0.16, 5)
    ends = [(x, y) for x in side for y in (-0.16, 0.16)]
    ends += [(x, y) for x in (-0.16, 0.16) for y in side[1:-1]]
    long, middle = 0.26 - lowest, 0.13 + lowest / 2.0
    upright = [box([x, y, middle], [0.012, 0.012, long]) for x, y in ends]
    rims = [box([0.0, y, 0.254], [0.33, 0.012, 0.012]) for y in (-0.16, 0.16)]
    return upright + rims + [box([x, 0.0, 0.254], [0.012, 0.33, 0.012]) for x in (-0.16, 0.16)]


def test_thin_bars_do_not_seem_to_move_where_their_ends_come_and_go():
    steep, memory = look_at([0.3, 0.05, 1.1], [0.0, 0.0, 0.1]), ObstacleMemory()
    for k in range(24):
        seen = bars(0.16 if k % 6 > 3 else 0.06)
        memory = step(memory, render(*seen, X_WC=steep), k * FRAME, X_WC=steep)
        assert not memory.obstacles.v_WO.any()
        reach = np.concatenate(memory.obstacles.clouds_W)
        assert 0.255 < reach[:, 2].max() < 0.275


def test_what_the_arm_hides_is_kept_and_does_not_seem_to_move():
    rng = np.random.default_rng(1)
    memory = play(*[[BLOCK, LEFT]] * 5, rng=rng)
    before = memory.obstacles.clouds_W
    for k, y in enumerate(np.linspace(-0.3, 0.4, 42)):
        drawn, robot = arm([0.6, y, 0.35], [0.05, 0.08, 0.5])
        start = (5 + k) * FRAME
        memory = play([BLOCK, LEFT, drawn], memory=memory, start=start, robot=robot, rng=rng)
        np.testing.assert_array_equal(memory.obstacles.ids, [0, 1])
        assert not memory.obstacles.v_WO.any()
        for one, other in zip(before, memory.obstacles.clouds_W, strict=True):
            np.testing.assert_allclose(one.min(axis=0), other.min(axis=0), atol=0.01)
            np.testing.assert_allclose(one.max(axis=0), other.max(axis=0), atol=0.01)


def test_what_is_hidden_is_kept_until_its_place_is_seen_empty_in_two_frames():
    small = box([0.1, 0.02, 0.05], [0.06, 0.06, 0.1])
    drawn, robot = HIDES
    memory = play([small, LEFT], [small, LEFT])
    hidden = play(*[[LEFT, drawn]] * 10, memory=memory, start=2 * FRAME, robot=robot)
    assert same(hidden, memory)
    gone = play([LEFT], [LEFT], memory=hidden, start=12 * FRAME)
    assert len(gone.obstacles) == 1


def test_one_frame_without_an_obstacle_does_not_remove_it():
    memory = play([BLOCK, LEFT], [BLOCK, LEFT])
    once = play([LEFT], memory=memory, start=2 * FRAME)
    np.testing.assert_array_equal(once.obstacles.ids, memory.obstacles.ids)
    again = play([BLOCK, LEFT], memory=once, start=3 * FRAME)
    np.testing.assert_array_equal(again.obstacles.ids, memory.obstacles.ids)
    assert len(play([LEFT], memory=once, start=3 * FRAME).obstacles) == 1


@pytest.mark.parametrize(("value", "kept"), [(np.nan, 2), (0.0, 2), (np.inf, 1)])
def test_missing_depth_hides_and_infinite_depth_shows(value, kept):
    memory = play([BLOCK, LEFT], [BLOCK, LEFT])
    depth = render(LEFT)
    changed = render(BLOCK, LEFT) != depth
    depth[changed] = value
    depth[np.roll(changed, 4, axis=1) | np.roll(changed, -4, axis=1)] = value
    for k in range(2, 5):
        memory = step(memory, depth, k * FRAME)
    assert len(memory.obstacles) == kept


def test_what_leaves_the_image_is_kept():
    memory = play([BLOCK, LEFT], [BLOCK, LEFT])
    aside = X_WC.copy()
    aside[1, 3] += 0.8
    for k in range(2, 5):
        memory = step(memory, render(X_WC=aside), k * FRAME, X_WC=aside)
    assert len(memory.obstacles) == 2


@pytest.mark.parametrize(
    ("new", "at_once"), [(BLOCK, True), (box([0.1, 0.0, 0.0175], [0.03, 0.03, 0.035]), False)]
)
def test_a_new_obstacle_is_there_with_the_second_frame_at_the_latest(new, at_once):
    memory = play(*[[LEFT]] * 3)
    once = play([LEFT, new], memory=memory, start=3 * FRAME)
    assert len(once.obstacles) == 1 + at_once
    assert len(play([LEFT, new], memory=once, start=4 * FRAME).obstacles) == 2


def test_what_flies_in_a_single_frame_is_never_handed_on():
    memory = play(*[[LEFT]] * 3)
    flying = box([0.2, 0.1, 0.25], [0.024, 0.024, 0.024])
    once = play([LEFT, flying], memory=memory, start=3 * FRAME)
    assert len(once.obstacles) == 1
    twice = play([LEFT], memory=once, start=4 * FRAME)
    assert len(twice.tracks) == 1
    # Nor as a part of an obstacle.
    beside = box([-0.1, -0.35, 0.113], [0.024, 0.024, 0.024])
    once = play([LEFT, beside], memory=memory, start=3 * FRAME)
    assert same(once, memory)
    assert same(play([LEFT], memory=once, start=4 * FRAME), memory)


@pytest.mark.parametrize(
    ("make", "start", "velocity"),
    [
        (lambda p: box(p, [0.1, 0.1, 0.12]), [0.15, -0.25, 0.06], [0.0, 0.2, 0.0]),
        (lambda p: sphere(p, 0.06), [0.15, -0.4, 0.06], [0.0, 0.4, 0.0]),
        (lambda p: box(p, [0.1, 0.14, 0.12]), [0.35, -0.2, 0.06], [-0.14, 0.14, 0.0]),
    ],
)
def test_a_moving_obstacle_is_followed(make, start, velocity):
    rng = np.random.default_rng(2)
    memory, velocity = ObstacleMemory(), np.array(velocity)
    speed = np.linalg.norm(velocity)
    names, offset = set(), None
    for k in range(40):
        p_WO = np.array(start) + velocity * k * FRAME
        things = [make(p_WO), box([-0.3, 0.4, 0.05], [0.1] * 3)]
        memory = play(things, memory=memory, start=k * FRAME, rng=rng)
        now = memory.obstacles
        row = named(now, p_WO)
        names.add(int(now.ids[row]))
        # What is seen of it is not centred on it: that is no lag.
        seen = segment_depth(render(*things), K, X_WC, CONFIG)
        nearest = min(seen.clouds_W, key=lambda cloud: np.linalg.norm(middle(cloud) - p_WO))
        offset = (middle(now.clouds_W[row]) - middle(nearest)) @ velocity / speed
        if k >= 9:
            assert abs(np.linalg.norm(now.v_WO[row]) / speed - 1.0) < 0.15, k
            cosine = now.v_WO[row] @ velocity / np.linalg.norm(now.v_WO[row]) / speed
            assert cosine > np.cos(np.deg2rad(10.0)), k
            assert abs(offset) < 0.015, k
            assert not np.delete(now.v_WO, row, axis=0).any()
            assert (np.ptp(now.clouds_W[row], axis=0) < 0.16).all()
    assert len(names) == 1
    assert len(now) == 2


@pytest.mark.parametrize(("speed", "seed"), [(0.1, 0), (0.1, 1), (0.13, 2)])
def test_what_moves_slowly_is_seen_to_move(speed, seed):
    # Little beyond the noise of a single velocity; what stays behind of it tells.
    rng = np.random.default_rng(seed)
    memory, direction = ObstacleMemory(), np.array([0.34, 0.94, 0.0])
    for k in range(60):
        p_WO = np.array([0.2, -0.2, 0.3]) + direction * speed * FRAME * max(k - 10, 0)
        things = [sphere(p_WO, 0.048), box([-0.2, 0.3, 0.05], [0.1] * 3)]
        memory = play(things, memory=memory, start=k * FRAME, rng=rng)
        now = memory.obstacles
        row = named(now, p_WO)
        if k < 10:
            assert not now.v_WO.any()
        elif k > 40:
            np.testing.assert_allclose(now.v_WO[row], speed * direction, atol=0.035)
        assert not np.delete(now.v_WO, row, axis=0).any()


def test_the_velocity_of_a_distant_obstacle_is_known_within_half_a_second():
    # At 2.8 m a step of the depth is as far as the obstacle goes in a frame.
    far, config = look_at([2.6, 0.4, 1.2], [0.0, 0.0, 0.2]), replace(CONFIG, far=4.0)
    sharp, memory = np.array([580.0, 580.0, 159.5, 119.5]), ObstacleMemory()
    for k in range(40):
        p_WO = np.array([-0.2 + 0.6 * FRAME * max(k - 12, 0), 0.0, 0.3])
        depth = render(box(p_WO, [0.2, 0.2, 0.2]), K=sharp, X_WC=far)
        depth = add_depth_noise(depth, k * FRAME, K=sharp, seed=3)
        memory = step(memory, depth, k * FRAME, config=config, K=sharp, X_WC=far)
        (v_WO,) = memory.obstacles.v_WO
        if k <= 12:
            assert not v_WO.any()
        elif k > 12 + 12:
            np.testing.assert_allclose(v_WO, [0.6, 0.0, 0.0], atol=0.12)


LEVEL = look_at([1.25, 0.1, 0.6], [0.0, 0.0, 0.45])  # sees over the table


def before_nothing(depth: np.ndarray) -> np.ndarray:
    """A camera that does not tell what is too far away from what is missing."""
    return np.where(np.isinf(depth), np.float32(np.nan), depth)


@pytest.mark.parametrize(
    "make", [lambda p: box(p, [0.1, 0.1, 0.12]), lambda p: sphere(p, 0.05)], ids=["box", "ball"]
)
def test_what_moves_before_a_background_too_far_away_is_followed(make):
    rng = np.random.default_rng(5)
    memory = ObstacleMemory()
    for k in range(45):
        p_WO = np.array([0.1, 0.06 - 0.3 * FRAME * np.clip(k - 10, 0, 25), 0.5])
        things = [make(p_WO), box([-0.2, 0.1, 0.05], [0.1] * 3)]
        depth = before_nothing(noisy(render(*things, X_WC=LEVEL), rng))
        memory = step(memory, depth, k * FRAME, X_WC=LEVEL)
        now = memory.obstacles
        row = named(now, p_WO)
        assert (np.ptp(now.clouds_W[row], axis=0) < 0.17).all(), k
        assert not np.delete(now.v_WO, row, axis=0).any()
        if k < 10:
            assert not now.v_WO.any()
        elif 18 < k < 35:
            # Its depth is less certain: a face that comes into sight may seem to be motion.
            np.testing.assert_allclose(now.v_WO[row, 1:], [-0.3, 0.0], atol=0.06)
            assert abs(middle(now.clouds_W[row])[1] - p_WO[1]) < 0.02, k
    assert not now.v_WO.any()
    assert abs(middle(now.clouds_W[row])[1] - p_WO[1]) < 0.02


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_a_large_hole_in_the_image_moves_and_removes_nothing(share):
    rng = np.random.default_rng(6)
    memory = ObstacleMemory()
    thing = box([0.1, 0.1, 0.5], [0.1, 0.16, 0.16])
    mask = np.isfinite(render(thing, X_WC=LEVEL)) & ~np.isfinite(render(X_WC=LEVEL))
    columns = np.flatnonzero(mask.any(axis=0))
    end = int(columns[0] + share * (columns[-1] - columns[0])) + (30 if share == 1.0 else 0)
    for k in range(40):
        depth = before_nothing(noisy(render(thing, RIGHT, X_WC=LEVEL), rng))
        if k >= 10:
            depth[:, columns[0] - 30 : end] = np.nan
        memory = step(memory, depth, k * FRAME, X_WC=LEVEL)
        assert not memory.obstacles.v_WO.any(), k
        if k == 9:
            before = memory.obstacles.clouds_W[named(memory.obstacles, thing[1])]
    after = memory.obstacles.clouds_W[named(memory.obstacles, thing[1])]
    np.testing.assert_allclose(np.ptp(after, axis=0), np.ptp(before, axis=0), atol=0.01)


@pytest.mark.parametrize("value", [np.nan, 0.0])
def test_missing_depth_removes_no_part_of_a_moving_obstacle(value):
    rng = np.random.default_rng(7)
    memory = ObstacleMemory()
    for k in range(30):
        p_WO = np.array([0.1, -0.2 + 0.3 * FRAME * k, 0.5])
        thing = box(p_WO, [0.1, 0.24, 0.16])
        mask = np.isfinite(render(thing, X_WC=LEVEL)) & ~np.isfinite(render(X_WC=LEVEL))
        columns = np.flatnonzero(mask.any(axis=0))
        depth = before_nothing(noisy(render(thing, X_WC=LEVEL), rng))
        if k >= 20:
            depth[:, (columns[0] + columns[-1]) // 2 :] = value
        memory = step(memory, depth, k * FRAME, X_WC=LEVEL)
        (row,) = range(len(memory.obstacles))
        length = np.ptp(memory.obstacles.clouds_W[row], axis=0)[1]
        assert k < 3 or length > 0.2, k
    assert memory.obstacles.v_WO[row, 1] > 0.15


def test_a_moving_obstacle_keeps_its_name_behind_the_arm():
    rng = np.random.default_rng(3)
    memory, names, unseen = ObstacleMemory(), set(), 0.0
    drawn, robot = arm([0.6, -0.02, 0.35], [0.05, 0.08, 0.6])
    for k in range(45):
        p_WO = np.array([0.15, -0.4 + 0.4 * k * FRAME, 0.06])
        things = [sphere(p_WO, 0.06), RIGHT, drawn]
        memory = play(things, memory=memory, start=k * FRAME, robot=robot, rng=rng)
        row = named(memory.obstacles, p_WO)
        names.add(int(memory.obstacles.ids[row]))
        unseen = max(unseen, float(memory.tracks.unseen.max()))
        if k >= 9:
            off = middle(memory.obstacles.clouds_W[row]) - p_WO
            assert np.linalg.norm(off[:2]) < 0.04
            assert memory.obstacles.v_WO[row, 1] == pytest.approx(0.4, abs=0.08)
    assert unseen > 0.1
    assert len(names) == 1


def test_a_side_that_faces_the_camera_ends_there_though_the_arm_is_below_it():
    # What would go on toward the camera would be seen before the side itself.
    drawn, robot = arm([0.55, 0.1, 0.4], [0.06, 0.4, 0.1])
    depth = render(box([0.0, 0.1, 0.2], [0.1, 0.12, 0.1]), drawn)
    frame = segment_depth(depth, K, X_WC, CONFIG, robot)
    sides = seen_sides(frame, np.array([0]), np.zeros(1), CONFIG.voxel)
    assert sides.place[0, 0, 1] == pytest.approx(0.05, abs=2e-3)
    assert sides.ends[0, 0, 1]
    # Its lowest side may go on behind the arm.
    assert not sides.ends[0, 2, 0]


def test_one_that_stops_rests_exactly_and_one_that_starts_is_noticed():
    rng = np.random.default_rng(4)
    memory, seen = ObstacleMemory(), []
    for k in range(60):
        moved = 0.2 * FRAME * np.clip(k - 10, 0, 20)
        things = [box([0.15, -0.1 + moved, 0.06], [0.1, 0.1, 0.12])]
        memory = play(things, memory=memory, start=k * FRAME, rng=rng)
        seen.append(float(np.linalg.norm(memory.obstacles.v_WO[0])))
    assert not any(seen[:10])
    assert all(seen[19:30])
    assert not any(seen[42:])
    np.testing.assert_array_equal(memory.obstacles.ids, [0])


def test_nothing_remembered_is_carried_away_by_a_long_occlusion():
    memory = ObstacleMemory()
    drawn, robot = arm([0.6, 0.1, 0.35], [0.05, 0.7, 0.6])
    for k in range(12):
        things = [sphere([0.15, -0.2 + 0.4 * k * FRAME, 0.06], 0.06)]
        memory = play(things, memory=memory, start=k * FRAME)
    assert memory.obstacles.v_WO.any()
    notes = []
    for k in range(12, 42):
        memory = play([drawn], memory=memory, start=k * FRAME, robot=robot)
        notes.append(memory.obstacles.note)
    assert any("obstacle 0 has moved on unseen for 0.33 s" in note for note in notes)
    assert not memory.obstacles.v_WO.any()
    assert notes[-1] == ""
    assert middle(memory.obstacles.clouds_W[0])[1] < 0.25


def test_a_split_obstacle_becomes_two_and_the_larger_keeps_the_name():
    one = box([0.1, 0.0, 0.05], [0.1, 0.3, 0.1])
    parts = [box([0.1, -0.05, 0.05], [0.1, 0.2, 0.1]), box([0.1, 0.2, 0.05], [0.1, 0.08, 0.1])]
    memory = play([one], [one], *[parts] * 4)
    np.testing.assert_array_equal(memory.obstacles.ids, [0, 1])
    assert memory.obstacles.clouds_W[0][:, 1].max() < 0.07


def test_two_that_touch_for_long_become_one_and_the_larger_keeps_the_name():
    large, small = box([0.1, -0.1, 0.08], [0.1, 0.16, 0.16]), [0.1, 0.15, 0.04]
    memory = play(*[[large, box(small, [0.08, 0.08, 0.08])]] * 2)
    name = memory.obstacles.ids[named(memory.obstacles, [0.1, -0.1, 0.08])]
    for k in range(2, 52):
        y = max(0.02, 0.15 - 0.01 * (k - 2))
        things = [large, box([0.1, y, 0.04], [0.08, 0.08, 0.08])]
        memory = play(things, memory=memory, start=k * FRAME)
        assert name in memory.obstacles.ids
    np.testing.assert_array_equal(memory.obstacles.ids, [name])


def test_names_are_never_given_twice():
    memory = play([LEFT, RIGHT], [LEFT, RIGHT], *[[LEFT]] * 3, *[[LEFT, RIGHT]] * 2)
    np.testing.assert_array_equal(memory.obstacles.ids, [1, 2])


def test_an_unusable_frame_changes_nothing_but_the_note():
    memory = play([BLOCK], [BLOCK])
    frame = Segmentation(usable=False, note="no supporting plane found")
    after = fuse(memory, frame, 1.0, CONFIG)
    assert after.obstacles.note == "no supporting plane found"
    assert after.obstacles.stamp == memory.obstacles.stamp
    assert same(after, memory)
    assert play([BLOCK], memory=after, start=1.1).obstacles.note == ""


def test_a_frame_that_repeats_changes_nothing():
    memory = play([BLOCK], [BLOCK])
    assert same(step(memory, render(LEFT), FRAME), memory)


def test_a_frame_from_before_begins_anew_with_new_names():
    memory = step(play([BLOCK], [BLOCK], start=5.0), render(LEFT), 0.0)
    np.testing.assert_array_equal(memory.obstacles.ids, [1])
    assert memory.obstacles.stamp == 0.0


def test_frames_in_a_burst_and_after_a_gap_are_no_motion():
    rng, memory, time = np.random.default_rng(5), ObstacleMemory(), 0.0
    for dt in [FRAME] * 5 + [0.001] * 10 + [3.0] + [0.1, 0.01] * 5:
        time += dt
        memory = step(memory, noisy(render(BLOCK, LEFT), rng), time)
        assert not memory.obstacles.v_WO.any()
        np.testing.assert_array_equal(memory.obstacles.ids, [0, 1])


def test_after_a_gap_no_velocity_is_believed():
    memory = ObstacleMemory()
    for k in range(12):
        memory = play(
            [sphere([0.15, -0.2 + 0.012 * k, 0.06], 0.06)], memory=memory, start=k * FRAME
        )
    assert memory.obstacles.v_WO.any()
    assert not play([LEFT], memory=memory, start=5.0).obstacles.v_WO.any()


def test_a_cloud_shows_everything():
    memory = ObstacleMemory()
    grid = np.arange(-0.4, 0.4, 0.008)
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    table = np.stack([x, y, np.zeros(len(x))], axis=1)
    top = table[(np.abs(x) < 0.05) & (np.abs(y) < 0.05)] + [0.0, 0.0, 0.1]
    for k, points in enumerate([np.concatenate([table, top])] * 2 + [table] * 2):
        frame = segment_points(points, np.eye(4), SegmentationConfig(min_occupancy=1))
        memory = fuse(memory, frame, k * FRAME)
        assert len(memory.obstacles) == (1 if k < 3 else 0)


def test_the_table_is_kept_while_only_noise_moves_it():
    memory = play([BLOCK])
    table = memory.obstacles.table
    frame = segment_depth(render(BLOCK), K, X_WC, CONFIG)
    for k, (offset, kept) in enumerate([(0.002, True), (0.01, False)]):
        moved = Segmentation(
            frame.clouds_W,
            frame.pixels,
            TablePlane(table.normal_W, table.offset + offset),
            X_WC=frame.X_WC,
            views=frame.views,
        )
        after = fuse(memory, moved, (k + 1) * FRAME, CONFIG)
        assert (after.obstacles.table is table) == kept


@settings(max_examples=12)
@given(st.lists(st.sampled_from(["all", "left", "none", "blind", "arm"]), max_size=6))
def test_whatever_comes_the_value_is_consistent(kinds):
    memory, given_names = ObstacleMemory(), -1
    for k, kind in enumerate(kinds):
        drawn, robot = HIDES
        things = {"all": [BLOCK, LEFT], "left": [LEFT], "arm": [drawn, BLOCK, LEFT]}
        depth = render(*things.get(kind, []))
        if kind == "blind":
            depth[:] = np.nan
        before = set(memory.obstacles.ids.tolist())
        memory = step(memory, depth, k * FRAME, robot if kind == "arm" else None)
        now = memory.obstacles
        assert len(now.clouds_W) == len(now.ids) == len(now.v_WO) == len(set(now.ids.tolist()))
        assert len(memory.tracks) == 0 or memory.points.owner.max() < len(memory.tracks)
        new = set(now.ids.tolist()) - before
        assert all(name > given_names for name in new)
        given_names = max([given_names, *new])
        for cloud in now.clouds_W:
            assert np.isfinite(cloud).all()


OPPOSITE = look_at([-1.05, -0.1, 0.9], [0.1, 0.0, 0.05])
"""Sees BLOCK's other sides."""


def views(things, rng=None) -> list[View]:
    """Images of both cameras."""
    drawn = [render(*things, X_WC=X) for X in (X_WC, OPPOSITE)]
    if rng is not None:
        drawn = [noisy(depth, rng) for depth in drawn]
    return [View(depth, K, X) for depth, X in zip(drawn, (X_WC, OPPOSITE), strict=True)]


def play_both(*frames, memory=None, start=0.0, robot=None, cameras=2, **options):
    """As `play`, with both cameras, or with the first one alone."""
    rng = options.pop("rng", None)
    memory = memory or ObstacleMemory()
    for k, things in enumerate(frames):
        frame = segment_views(views(things, rng)[:cameras], CONFIG, robot)
        memory = fuse(memory, frame, start + k * FRAME, CONFIG, robot, **options)
    return memory


def extent(cloud: np.ndarray) -> np.ndarray:
    return np.stack([cloud.min(axis=0), cloud.max(axis=0)])


def test_two_cameras_on_opposite_sides_see_a_box_whole():
    whole = np.array([[0.04, -0.07, 0.0], [0.16, 0.07, 0.2]])
    memory = play_both(*[[BLOCK, LEFT]] * 6, rng=np.random.default_rng(2))
    seen = memory.obstacles
    np.testing.assert_array_equal(seen.ids, [0, 1])
    assert not seen.v_WO.any()
    cloud = seen.clouds_W[named(seen, [0.1, 0.0, 0.1])]
    np.testing.assert_allclose(extent(cloud)[:, :2], whole[:, :2], atol=0.012)
    np.testing.assert_allclose(extent(cloud)[:, 2], whole[:, 2], atol=0.02)
    # All four walls: one camera shows two of them.
    walls = [
        np.sum((np.abs(cloud[:, axis] - whole[side, axis]) < 0.01) & (cloud[:, 2] < 0.15))
        for axis in (0, 1)
        for side in (0, 1)
    ]
    assert min(walls[:2]) > 100
    assert max(walls[2:]) > 30


def test_what_one_camera_does_not_see_is_tracked_by_the_other():
    hidden = box([-0.12, -0.03, 0.04], [0.06] * 2 + [0.08])
    assert len(play(*[[BLOCK, hidden]] * 3).obstacles) == 1
    memory = play_both(*[[BLOCK, hidden]] * 3)
    assert len(memory.obstacles) == 2
    # It moves on, and its velocity is measured.
    v = np.array([0.0, 0.2, 0.0])
    for k in range(3, 15):
        moved = hidden[0], hidden[1] + (k - 2) * FRAME * v, hidden[2]
        memory = play_both([BLOCK, moved], memory=memory, start=k * FRAME)
    row = named(memory.obstacles, moved[1])
    np.testing.assert_allclose(memory.obstacles.v_WO[row], v, atol=0.03)
    assert not np.delete(memory.obstacles.v_WO, row, axis=0).any()


def test_a_point_that_one_camera_sees_through_is_gone_though_the_other_sees_nothing():
    hidden = box([-0.12, -0.03, 0.04], [0.06] * 2 + [0.08])
    memory = play_both(*[[BLOCK, hidden]] * 3)
    alone, ids = play(*[[BLOCK]] * 6, memory=memory, start=3 * FRAME), memory.obstacles.ids
    # The first camera cannot tell: it is hidden behind the block.
    np.testing.assert_array_equal(alone.obstacles.ids, ids)
    gone = play_both(*[[BLOCK]] * 3, memory=memory, start=3 * FRAME)
    assert len(gone.obstacles) == 1


def test_the_far_side_that_the_other_camera_saw_is_kept_while_that_is_missing():
    memory = play_both(*[[BLOCK]] * 4)
    before = extent(memory.obstacles.clouds_W[0])
    options = {"cameras": 1, "complete": False}
    memory = play_both(*[[BLOCK]] * 8, memory=memory, start=4 * FRAME, **options)
    np.testing.assert_allclose(extent(memory.obstacles.clouds_W[0]), before, atol=0.003)
    # One camera that has always been alone has not seen it, and takes it for a remainder.
    memory = play_both(*[[BLOCK]] * 8, memory=memory, start=12 * FRAME, cameras=1)
    assert len(memory.obstacles.clouds_W[0]) > 0


def test_an_arm_before_one_camera_hides_nothing_from_the_other():
    drawn, robot = HIDES
    memory = play_both(*[[BLOCK]] * 3)
    memory = play_both(*[[BLOCK, drawn]] * 5, memory=memory, start=3 * FRAME, robot=robot)
    np.testing.assert_array_equal(memory.obstacles.ids, [0])
    # It is taken away behind the arm: the other camera sees it go.
    memory = play_both(*[[drawn]] * 3, memory=memory, start=8 * FRAME, robot=robot)
    assert len(memory.obstacles) == 0
