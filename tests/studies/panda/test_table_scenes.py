"""Random scenes on a table are what their description says."""

import math

import numpy as np
import pytest

from drake_oa.geometry.shapes import Box, Sphere
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.studies.panda.scene_parts import (
    FREE,
    footprint_radius,
    in_view,
    is_outside_image,
    planning_scene,
)
from drake_oa.studies.panda.scenes import (
    NEAR,
    NEAR_OBSTACLES,
    _distance_to_triangle,
    distance_to_line,
    draw_panda_scene,
)

_SCENES = [("tabletop", 0, 2), ("tabletop", 0, 9), ("tabletop", 1, 0), ("clutter6", 0, 0)]


@pytest.fixture(scope="module", params=_SCENES, ids=lambda place: f"{place[0]}-{place[2]}")
def scene(request):
    kind, seed, index = request.param
    return kind, draw_panda_scene(seed, index, kind=kind)


def test_the_ends_are_free_and_the_planned_motion_is_not_clear(scene):
    kind, scenario = scene
    start, goal = np.array(scenario.task.start), np.array(scenario.task.goal)
    assert 0.5 <= math.dist(start, goal) <= 1.0
    # Judged by the metrics of a run, in a world of their own.
    motion = planning_scene().straight_motion(start, goal)
    metrics = robot_metrics(scenario, motion)
    np.testing.assert_allclose(metrics.p_WE[[0, -1]], [start, goal], atol=1e-3)
    assert metrics.robot_clearance[[0, -1]].min() >= FREE - 1e-6
    assert metrics.robot_clearance.min() < -1e-3
    assert metrics.contacts
    assert all("obstacle" in contact for contact in metrics.contacts)
    assert not robot_metrics(scenario, motion[[0, -1]]).contacts
    near = [distance_to_line(start, goal, item) < NEAR for item in scenario.obstacles]
    if kind == "clutter6":
        assert len(scenario.obstacles) == 6
        assert sum(near) >= NEAR_OBSTACLES
    assert 1 <= len(scenario.obstacles) <= 6


def test_obstacles_stand_apart(scene):
    obstacles = scene[1].obstacles
    for row, one in enumerate(obstacles):
        radius = footprint_radius(one)
        assert math.hypot(*one.translation[:2]) > radius + 0.15
        for other in obstacles[:row]:
            gap = math.dist(one.translation[:2], other.translation[:2])
            assert gap >= radius + footprint_radius(other) + 0.02 - 1e-9


def test_distance_to_the_line_of_a_low_and_of_a_tall_thing():
    start, goal = np.array([0.4, -0.4, 0.3]), np.array([0.4, 0.4, 0.3])
    low = Obstacle("low", [Sphere(radius=0.05, translation=[0.0, 0.0, 0.05])], [0.4, 0.0, 0.0])
    tall = Obstacle("tall", [Box([0.1, 0.1, 0.4], [0.0, 0.0, 0.2])], [0.6, 0.0, 0.0])
    assert distance_to_line(start, goal, low) == pytest.approx(0.2)
    assert distance_to_line(start, goal, tall) == pytest.approx(0.2 - 0.05 * math.sqrt(2.0))


def test_what_is_in_the_image_and_what_is_wholly_outside():
    assert in_view(np.array([0.45, 0.0, 0.2]))
    assert not in_view(np.array([2.0, 0.5, 0.5]))
    assert not in_view(np.array([-1.0, -1.5, 0.0]))
    beside = np.array([0.45, 1.2, 0.2])
    assert is_outside_image(beside, 0.1)
    assert not is_outside_image(beside, 1.0)
    assert not is_outside_image(np.array([0.45, 0.0, 0.2]), 0.01)
    assert is_outside_image(np.array([3.0, 0.5, 1.5]), 0.1), "behind the camera"


def test_distance_to_a_triangle():
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert _distance_to_triangle(np.array([0.2, 0.2]), corners) == 0.0
    assert _distance_to_triangle(np.array([0.2, 0.2]), corners[::-1]) == 0.0
    assert _distance_to_triangle(np.array([-0.3, 0.5]), corners) == pytest.approx(0.3)
    assert _distance_to_triangle(np.array([1.0, 1.0]), corners) == pytest.approx(math.sqrt(0.5))
