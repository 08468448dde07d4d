"""Random scenes of the Panda are what their description says."""

import math

import numpy as np
import pytest

from drake_oa.perception.config import DepthCamera, GroundTruth
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.studies.panda import (
    scene_parts as panda_scene_parts,
)
from drake_oa.studies.panda import (
    table_scenes as panda_tabletop_scenes,
)
from drake_oa.studies.panda.obstacles import footprint_radius
from drake_oa.studies.panda.scenes import draw_panda_scene

_SCENES = [(0, 2), (0, 9), (1, 0)]


@pytest.fixture(scope="module")
def scenes():
    return {place: draw_panda_scene(*place) for place in _SCENES}


def test_a_scene_depends_on_seed_and_index_alone(scenes):
    again = draw_panda_scene(1, 0)
    assert scenario_text(again) == scenario_text(scenes[1, 0])
    truth = draw_panda_scene(1, 0, perception="truth")
    assert isinstance(truth.perception, GroundTruth)
    assert isinstance(again.perception, DepthCamera)
    assert truth.obstacles == again.obstacles
    assert truth.task == again.task
    assert len({scenario_text(s) for s in scenes.values()}) == len(scenes)


@pytest.mark.parametrize("place", _SCENES)
def test_the_text_runs_as_a_scenario(scenes, place):
    text = scenario_text(scenes[place])
    assert scenario_text(parse_scenario(text)) == text


@pytest.mark.parametrize("place", _SCENES)
def test_the_ends_are_free_and_the_planned_motion_is_not_clear(scenes, place):
    scenario = scenes[place]
    task = scenario.task
    assert 0.5 <= math.dist(task.start, task.goal) <= 1.0
    assert 1 <= len(scenario.obstacles) <= 6
    # Judged by the metrics of a run, in a world of their own.
    motion = panda_scene_parts.planning_scene().straight_motion(
        np.array(task.start), np.array(task.goal)
    )
    metrics = robot_metrics(scenario, motion)
    np.testing.assert_allclose(metrics.p_WE[[0, -1]], [task.start, task.goal], atol=1e-3)
    assert metrics.robot_clearance[[0, -1]].min() >= panda_scene_parts.FREE - 1e-6
    assert metrics.robot_clearance.min() < -1e-3
    assert metrics.contacts
    assert all("obstacle" in contact for contact in metrics.contacts)
    assert not robot_metrics(scenario, motion[[0, -1]]).contacts


@pytest.mark.parametrize("place", _SCENES)
def test_obstacles_stand_apart_and_in_view(scenes, place):
    obstacles = scenes[place].obstacles
    for row, one in enumerate(obstacles):
        radius = footprint_radius(one)
        assert math.hypot(*one.translation[:2]) > radius + 0.15
        for other in obstacles[:row]:
            gap = math.dist(one.translation[:2], other.translation[:2])
            assert gap >= radius + footprint_radius(other) + 0.02 - 1e-9


def test_what_the_camera_looks_at_is_in_view_and_what_is_behind_it_is_not():
    assert panda_scene_parts.in_view(np.array([0.45, 0.0, 0.2]))
    assert not panda_scene_parts.in_view(np.array([2.0, 0.5, 0.5]))
    assert not panda_scene_parts.in_view(np.array([-1.0, -1.5, 0.0]))


def test_distance_to_a_triangle():
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    distance = panda_tabletop_scenes._distance_to_triangle
    assert distance(np.array([0.2, 0.2]), corners) == 0.0
    assert distance(np.array([0.2, 0.2]), corners[::-1]) == 0.0
    assert distance(np.array([-0.3, 0.5]), corners) == pytest.approx(0.3)
    assert distance(np.array([1.0, 1.0]), corners) == pytest.approx(math.sqrt(0.5))


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"kind": "maze"}, "unknown kind of scenes 'maze'"), ({"perception": "sonar"}, "sonar")],
)
def test_unknown_words_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        draw_panda_scene(0, 0, **changes)
