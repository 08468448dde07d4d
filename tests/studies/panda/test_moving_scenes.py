"""Scenes in which things move do what their description says."""

import math

import numpy as np
import pytest

from drake_oa.geometry.shapes import Box, Sphere, bounding_radius
from drake_oa.perception.config import DepthCamera
from drake_oa.studies.panda.evaluation import run_and_judge
from drake_oa.studies.panda.moving_scenes import LONGEST
from drake_oa.studies.panda.scene_parts import FREE, in_view, is_outside_image, planning_scene
from drake_oa.studies.panda.scenes import draw_panda_scene

_SCENES = {"moving": 4, "moving_hard": 8}


@pytest.fixture(scope="module")
def scenes():
    return {
        kind: [draw_panda_scene(0, index, kind=kind) for index in range(count)]
        for kind, count in _SCENES.items()
    }


@pytest.fixture(scope="module")
def movers(scenes):
    """Of `moving_hard`."""
    return [item for scene in scenes["moving_hard"] for item in scene.obstacles if item.waypoints]


def velocities(item):
    """(N, 2) of the pieces of a course, and (N,) how long they last."""
    rows = np.diff(np.array(item.waypoints), axis=0)
    return rows[:, 1:3] / rows[:, :1], rows[:, 0]


@pytest.mark.parametrize(
    ("kind", "counts", "largest"), [("moving", (1, 2), 0.15), ("moving_hard", (2, 4), 0.30)]
)
def test_so_many_things_so_large_move_among_what_rests(scenes, kind, counts, largest):
    for scene in scenes[kind]:
        assert isinstance(scene.perception, DepthCamera)
        assert scene.perception.noise is not None
        moving = [item for item in scene.obstacles if item.waypoints]
        assert counts[0] <= len(moving) <= counts[1]
        assert len(scene.obstacles) - len(moving) <= 2
        assert moving == scene.obstacles[: len(moving)]
        for item in moving:
            (shape,) = item.shapes
            if isinstance(shape, Box):
                size = shape.size
            elif isinstance(shape, Sphere):
                size = [2.0 * shape.radius]
            else:
                size = [2.0 * shape.radius, shape.length]
            assert all(0.05 <= edge <= largest for edge in size)
            for time in np.arange(item.waypoints[0][0], item.waypoints[-1][0], 0.05):
                x, y, _ = item.translation + item.offset_at(time)
                assert math.hypot(x, y) >= bounding_radius(shape) + 0.15


def test_courses_of_moving_are_straight_and_steady(scenes):
    for item in (item for scene in scenes["moving"] for item in scene.obstacles if item.waypoints):
        (velocity,), _ = velocities(item)
        assert 0.099 <= np.linalg.norm(velocity) <= 0.401
        assert item.waypoints[0][0] >= 0.0


def test_courses_are_smooth_level_in_time_and_off_the_base(movers):
    for item in movers:
        velocity, seconds = velocities(item)
        speed = np.linalg.norm(velocity, axis=1)
        assert speed.max() <= 0.805
        assert speed.max() >= 0.095
        # Begin and end are at rest; 3 m/s^2 along the way and 0.8^2 / 0.2 across it, for 0.05 s.
        jumps = np.diff(velocity, axis=0, prepend=0.0, append=0.0)
        assert np.linalg.norm(jumps, axis=1).max() < 0.05 * math.hypot(3.0, 3.2) + 0.01
        assert not np.array(item.waypoints)[:, 3].any()
        begin, end = item.waypoints[0][0], item.waypoints[-1][0]
        assert 0.0 <= begin <= 2.0
        assert begin < end <= LONGEST
        assert seconds.min() > 0.04


def test_things_enter_speed_up_turn_stop_and_come_back(movers):
    seen = dict.fromkeys(("enters", "speeds up", "turns", "stops", "comes back"), 0)
    for item in movers:
        p = [item.translation + item.offset_at(t) for t in np.arange(0.0, LONGEST, 0.05)]
        outside = is_outside_image(p[0], bounding_radius(item.shapes[0]))
        seen["enters"] += outside and item.waypoints[0][0] == 0.0 and any(map(in_view, p))
        velocity, seconds = velocities(item)
        speed = np.linalg.norm(velocity, axis=1)
        steady = speed[(seconds > 0.25) & (speed > 0.09)]
        seen["speeds up"] += bool((np.diff(steady) > 0.1).any())
        seen["stops"] += bool((seconds[speed < 1e-3] > 0.4).any())
        heading = velocity[speed > 0.05] / speed[speed > 0.05, None]
        turned = np.arccos(np.clip((heading[1:] * heading[:-1]).sum(axis=1), -1.0, 1.0))
        seen["comes back"] += bool((turned > 3.0).any())
        seen["turns"] += bool(turned[turned < 3.0].sum() > math.radians(25.0))
    assert all(count >= 3 for count in seen.values()), seen


@pytest.mark.parametrize(
    ("kind", "index"), [("moving", 0), ("moving_hard", 0), ("moving_hard", 1), ("moving_hard", 2)]
)
def test_the_first_is_met_and_the_ends_are_free(scenes, kind, index):
    scene, cell = scenes[kind][index], planning_scene()
    start, goal = np.array(scene.task.start), np.array(scene.task.goal)
    assert 0.5 <= math.dist(start, goal) <= 1.0
    motion = cell.straight_motion(start, goal)
    deepest = 0.0
    for q, time in zip(motion, np.linspace(0.0, scene.task.duration, len(motion)), strict=True):
        cell.put(scene.obstacles[:1], time)
        deepest = max([deepest, *(depth for _, thing, depth in cell.contacts(q) if thing)])
    assert deepest >= 5e-3
    for time in np.arange(0.0, 1.01, 0.05) if kind == "moving" else (0.0,):
        cell.put(scene.obstacles, time)
        assert cell.clearance(motion[0]) >= FREE - 1e-9
    # At last all of `moving` leaves the goal free, of `moving_hard` what rests.
    resting = [item for item in scene.obstacles if kind == "moving" or not item.waypoints]
    cell.put(resting, LONGEST)
    assert cell.clearance(cell.tool_down(goal)) >= FREE - 1e-9


def test_a_scene_runs(scenes):
    scene = scenes["moving_hard"][0]
    result = run_and_judge(scene, "preplanned", "depth", duration=0.05).result
    assert not result["failed"]
    assert result["duration"] == pytest.approx(0.05, abs=0.01)
