"""Scenes in which things move do what their description says."""

import math

import numpy as np
import pytest

from drake_oa.studies.panda.evaluation import run_and_judge
from drake_oa.studies.panda.moving_scenes import LONGEST
from drake_oa.studies.panda.scene_parts import bounding_ball, view_margin
from drake_oa.studies.panda.scenes import draw_panda_scene


@pytest.fixture(scope="module")
def scenes():
    drawn = {"moving": 2, "moving_hard": 8, "moving_high": 2}
    return {
        kind: [draw_panda_scene(0, index, kind=kind) for index in range(count)]
        for kind, count in drawn.items()
    }


def movers(scenes):
    return [item for scene in scenes for item in scene.obstacles if item.waypoints]


def velocities(item):
    """(N, 2) of the pieces of a course, and (N,) how long they last."""
    rows = np.diff(np.array(item.waypoints), axis=0)
    return rows[:, 1:3] / rows[:, :1], rows[:, 0]


@pytest.mark.parametrize(
    ("kind", "counts"), [("moving", (1, 2)), ("moving_hard", (2, 4)), ("moving_high", (2, 4))]
)
def test_so_many_things_move_off_the_base(scenes, kind, counts):
    for scene in scenes[kind]:
        moving = movers([scene])
        assert counts[0] <= len(moving) <= counts[1]
        assert moving == scene.obstacles[: len(moving)]
        assert len(scene.obstacles) - len(moving) <= 2
        for item in moving:
            times = np.arange(item.waypoints[0][0], item.waypoints[-1][0], 0.05)
            places = [item.translation + item.offset_at(time) for time in times]
            nearest = min(math.hypot(x, y) for x, y, _ in places)
            assert nearest >= bounding_ball(item)[1] + 0.15


def test_only_in_moving_high_something_passes_above_60_cm(scenes):
    heights = {
        kind: [max(item.translation[2] for item in movers([scene])) for scene in of_kind]
        for kind, of_kind in scenes.items()
    }
    assert max(heights["moving"] + heights["moving_hard"]) <= 0.6
    assert min(heights["moving_high"]) > 0.6
    assert max(heights["moving_high"]) <= 1.0


def test_scenes_of_moving_hard_are_those_of_earlier_versions(scenes):
    expected = [
        (
            534990184,
            [0.5835, -0.4048, 0.4485],
            [0.0728, 0.6154, 0.5659],
            [7.44, 1.4023, -1.7669, 0],
        ),
        (417601619, [0.119, 0.6881, 0.2012], [1.0942, -0.335, 0.5186], [7.15, -1.8506, 1.157, 0]),
        (
            1017261145,
            [0.197, -0.6455, 0.4692],
            [1.3055, -0.4027, 0.5671],
            [10.12, 1.7455, 0.6502, 0],
        ),
    ]
    for scene, (seed, start, place, end) in zip(scenes["moving_hard"], expected, strict=False):
        first = scene.obstacles[0]
        assert scene.seed == seed
        np.testing.assert_allclose(scene.task.start, start)
        np.testing.assert_allclose(first.translation, place)
        np.testing.assert_allclose(first.waypoints[-1], end)


def test_courses_of_moving_are_straight_and_steady(scenes):
    for item in movers(scenes["moving"]):
        velocity, seconds = velocities(item)
        speed = np.linalg.norm(velocity, axis=1)
        assert 0.099 <= speed[seconds.argmax()] <= 0.401
        assert speed.max() <= speed[seconds.argmax()] + 5e-3
        heading = velocity / speed[:, None]
        assert (heading @ heading[0]).min() > 0.99


def test_things_enter_speed_up_turn_stop_and_come_back_smoothly(scenes):
    seen = dict.fromkeys(("enters", "speeds up", "turns", "stops", "comes back"), 0)
    for item in movers(scenes["moving_hard"]):
        assert item.waypoints[-1][0] <= LONGEST
        p = [item.translation + item.offset_at(t) for t in np.arange(0.0, LONGEST, 0.05)]
        seen["enters"] += bool(view_margin(np.array(p))[0] <= -bounding_ball(item)[1])
        velocity, seconds = velocities(item)
        # Begin and end are at rest; 3 m/s^2 along the way and 0.8^2 / 0.2 across it, for 0.05 s.
        jumps = np.diff(velocity, axis=0, prepend=0.0, append=0.0)
        assert np.linalg.norm(jumps, axis=1).max() < 0.05 * math.hypot(3.0, 3.2) + 0.01
        speed = np.linalg.norm(velocity, axis=1)
        assert 0.095 <= speed.max() <= 0.805
        steady = speed[(seconds > 0.25) & (speed > 0.09)]
        seen["speeds up"] += bool((np.diff(steady) > 0.1).any())
        seen["stops"] += bool((seconds[speed < 1e-3] > 0.4).any())
        heading = velocity[speed > 0.05] / speed[speed > 0.05, None]
        turned = np.arccos(np.clip((heading[1:] * heading[:-1]).sum(axis=1), -1.0, 1.0))
        seen["comes back"] += bool((turned > 3.0).any())
        seen["turns"] += bool(turned[turned < 3.0].sum() > math.radians(25.0))
    assert all(count >= 3 for count in seen.values()), seen


@pytest.mark.parametrize("kind", ["moving", "moving_hard"])
def test_the_first_is_met(scenes, kind):
    result = run_and_judge(scenes[kind][0], "preplanned", "truth").result
    assert not result["failed"]
    assert any("moving0" in contact for contact in result["contacts"])
