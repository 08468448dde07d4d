"""Scenes with moving things, with the elbow's way blocked, and clutter: their conditions."""

import math

import numpy as np
import pytest

from drake_oa.geometry.shapes import Box, Cylinder, Sphere, bounding_radius
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.studies.panda.elbow_scenes import ELBOW_LINKS, HAND_FREE, SWINGS, SWUNG_FREE
from drake_oa.studies.panda.planning_scene import PlanningScene
from drake_oa.studies.panda.scenes import draw_panda_scene
from drake_oa.studies.panda.table_scenes import NEAR, NEAR_OBSTACLES, distance_to_line

_FREE = 0.05


@pytest.fixture(scope="module")
def scenes():
    kinds = ("moving", "elbow", "clutter6", "moving_hard")
    return {kind: draw_panda_scene(0, 0, kind=kind) for kind in kinds}


def ends(scenario):
    return np.array(scenario.task.start), np.array(scenario.task.goal)


def cell_of(scenario):
    """A cell of its own, with the scenario's obstacles where they are at first."""
    cell = PlanningScene(draw_panda_scene(0, 2))
    cell.put(scenario.obstacles)
    return cell


@pytest.mark.parametrize("kind", ["moving", "clutter6", "moving_hard"])
def test_a_scene_depends_on_kind_seed_and_index_alone(kind, scenes):
    text = scenario_text(scenes[kind])
    assert scenario_text(parse_scenario(text)) == text
    assert scenario_text(draw_panda_scene(0, 0, kind=kind)) == text
    other = draw_panda_scene(0, 1, kind=kind)
    assert other.task != scenes[kind].task
    assert len({scene.seed for scene in (*scenes.values(), other)}) == 5


@pytest.mark.parametrize("kind", ["moving", "elbow", "clutter6"])
def test_start_and_goal_are_free(kind, scenes):
    scenario = scenes[kind]
    start, goal = ends(scenario)
    assert 0.5 <= math.dist(start, goal) <= 1.0
    cell = cell_of(scenario)
    motion = cell.straight_motion(start, goal)
    assert cell.clearance(motion[0]) >= _FREE - 1e-9
    last = max((row[0] for item in scenario.obstacles for row in item.waypoints), default=0.0)
    cell.put(scenario.obstacles, last)
    for q in (motion[-1], cell.tool_down(goal)):
        assert cell.clearance(q) >= _FREE - 1e-9
        assert not cell.contacts(q)


def test_six_things_stand_and_three_of_them_near_the_way(scenes):
    scenario = scenes["clutter6"]
    start, goal = ends(scenario)
    assert len(scenario.obstacles) == 6
    near = [distance_to_line(start, goal, item) < NEAR for item in scenario.obstacles]
    assert sum(near) >= NEAR_OBSTACLES
    cell = cell_of(scenario)
    hits = [hit for q in cell.straight_motion(start, goal) for hit in cell.contacts(q)]
    assert max(depth for _, _, depth in hits) >= 5e-3
    assert all(thing for _, thing, _ in hits)


def test_distance_to_the_line_of_a_low_and_of_a_tall_thing():
    start, goal = np.array([0.4, -0.4, 0.3]), np.array([0.4, 0.4, 0.3])
    low = Obstacle("low", [Sphere(radius=0.05, translation=[0.0, 0.0, 0.05])], [0.4, 0.0, 0.0])
    tall = Obstacle("tall", [Box([0.1, 0.1, 0.4], [0.0, 0.0, 0.2])], [0.6, 0.0, 0.0])
    assert distance_to_line(start, goal, low) == pytest.approx(0.2)
    assert distance_to_line(start, goal, tall) == pytest.approx(0.2 - 0.05 * math.sqrt(2.0))


def test_the_elbow_touches_and_the_hand_does_not(scenes):
    scenario = scenes["elbow"]
    start, goal = ends(scenario)
    cell = cell_of(scenario)
    found = [hit for q in cell.straight_motion(start, goal) for hit in cell.nearby(q, HAND_FREE)]
    assert min(distance for link, _, distance in found if link in ELBOW_LINKS) <= -5e-3
    assert not any(link in scenario.robot.tool_links for link, _, _ in found)


def test_another_posture_is_free_with_the_tool_on_the_same_way(scenes):
    start, goal = ends(scenes["elbow"])
    cell = cell_of(scenes["elbow"])
    swung = [cell.straight_motion(start, goal, swing) for swing in SWINGS]
    free = [
        motion
        for motion in swung
        if motion is not None and all(cell.is_free(q, SWUNG_FREE) for q in motion)
    ]
    assert free
    plain = cell.straight_motion(start, goal)
    for one, other in zip(plain, free[0], strict=True):
        assert math.dist(cell.tool_point(one), cell.tool_point(other)) < 1.5e-3


def test_a_moving_thing_meets_the_planned_motion(scenes):
    scenario = scenes["moving"]
    start, goal = ends(scenario)
    cell = cell_of(scenario)
    motion = cell.straight_motion(start, goal)
    times = np.linspace(0.0, scenario.task.duration, len(motion))
    deepest = 0.0
    for q, time in zip(motion, times, strict=True):
        cell.put(scenario.obstacles[:1], time)
        deepest = max([deepest, *(depth for _, _, depth in cell.contacts(q))])
    assert deepest >= 5e-3
    for time in np.arange(0.0, 1.01, 0.05):
        cell.put(scenario.obstacles, time)
        assert cell.clearance(motion[0]) >= _FREE - 1e-9


@pytest.mark.parametrize("index", range(4))
def test_moving_things_are_as_large_and_as_fast_as_is_said(index):
    scenario = draw_panda_scene(0, index, kind="moving")
    moving = [item for item in scenario.obstacles if item.waypoints]
    assert 1 <= len(moving) <= 2
    assert len(scenario.obstacles) - len(moving) <= 2
    assert moving == scenario.obstacles[: len(moving)]
    for item in moving:
        (begin, *first), (end, *last) = item.waypoints
        assert 0.0 <= begin < end
        assert 0.099 <= math.dist(first, last) / (end - begin) <= 0.401
        (shape,) = item.shapes
        size = {
            Box: lambda s: s.size,
            Cylinder: lambda s: [2.0 * s.radius, s.length],
            Sphere: lambda s: [2.0 * s.radius],
        }[type(shape)](shape)
        assert all(0.05 <= edge <= 0.15 for edge in size)
        for time in np.linspace(begin, end, 9):
            x, y, _ = item.translation + item.offset_at(time)
            assert math.hypot(x, y) >= bounding_radius(shape) + 0.15
