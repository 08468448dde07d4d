"""Random scenes: those of a kind, seed and index for ever, and as their description says."""

import dataclasses
import hashlib
import json
import math

import numpy as np
import pytest

from drake_oa.perception.config import GroundTruth
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.studies.panda.scene_parts import FREE, footprint_radius, planning_scene
from drake_oa.studies.panda.scenes import (
    ELBOW,
    HAND_FREE,
    NEAR,
    NEAR_OBSTACLES,
    SWINGS,
    SWUNG_FREE,
    distance_to_line,
    draw_panda_scene,
)
from drake_oa.studies.results import Tally

_DIGESTS = {
    "tabletop": "0d7868a80228",
    "moving": "d10e717e8fdd",
    "elbow": "a4283f503dec",
    "clutter6": "1d3045b732f9",
    "moving_hard": "09f89c8d4c8e",
}
"""Of scene 0 of seed 0 of each kind."""


@pytest.fixture(scope="module")
def scenes():
    return {kind: draw_panda_scene(0, 0, kind=kind) for kind in _DIGESTS}


def digest(scenario):
    things = [dataclasses.asdict(item) for item in scenario.obstacles]
    told = json.dumps([things, scenario.task.start, scenario.task.goal, scenario.seed])
    rounded = json.loads(told, parse_float=lambda number: f"{float(number):.6f}")
    return hashlib.sha256(json.dumps(rounded).encode()).hexdigest()[:12]


@pytest.mark.parametrize("kind", _DIGESTS)
def test_a_seed_gives_the_scenes_that_it_always_gave(scenes, kind):
    assert digest(scenes[kind]) == _DIGESTS[kind]
    text = scenario_text(scenes[kind])
    assert scenario_text(parse_scenario(text)) == text


def test_perception_changes_nothing_else():
    one, two, truth = (draw_panda_scene(1, 0, perception=p) for p in ("depth", "depth2", "truth"))
    assert isinstance(truth.perception, GroundTruth)
    assert two.perception.names == ("camera", "opposite")
    assert two.perception.noise == one.perception.noise
    for other in (two, truth):
        assert (other.obstacles, other.task, other.seed) == (one.obstacles, one.task, one.seed)


def test_scenes_that_are_looked_at_are_taken_or_dropped_for_a_reason():
    tally, again = Tally(), Tally()
    draw_panda_scene(0, 1, tally=tally)
    draw_panda_scene(0, 1, tally=again)
    assert again.counts == tally.counts
    assert tally.counts["scenes"][""] == 1
    assert tally.counts["pairs of start and goal"][""] == sum(tally.counts["scenes"].values())


@pytest.mark.parametrize("kind", ["tabletop", "clutter6", "elbow"])
def test_the_ends_are_free_and_the_planned_motion_is_not_clear(scenes, kind):
    scenario = scenes[kind]
    start, goal = np.array(scenario.task.start), np.array(scenario.task.goal)
    assert 0.5 <= math.dist(start, goal) <= 1.0
    # Judged by the metrics of a run, in a world of their own.
    metrics = robot_metrics(scenario, planning_scene().straight_motion(start, goal))
    np.testing.assert_allclose(metrics.p_WE[[0, -1]], [start, goal], atol=1e-3)
    assert metrics.robot_clearance[[0, -1]].min() >= FREE - 1e-6
    assert metrics.robot_clearance.min() < -1e-3
    assert all("obstacle" in contact for contact in metrics.contacts)


@pytest.mark.parametrize("kind", ["tabletop", "clutter6"])
def test_things_stand_apart_and_clutter_beside_the_way(scenes, kind):
    obstacles, task = scenes[kind].obstacles, scenes[kind].task
    for row, one in enumerate(obstacles):
        radius = footprint_radius(one)
        assert math.hypot(*one.translation[:2]) > radius + 0.15
        for other in obstacles[:row]:
            gap = math.dist(one.translation[:2], other.translation[:2])
            assert gap >= radius + footprint_radius(other) + 0.02 - 1e-9
    ends = np.array(task.start), np.array(task.goal)
    near = sum(distance_to_line(*ends, item) < NEAR for item in obstacles)
    assert kind == "tabletop" or (len(obstacles) == 6 and near >= NEAR_OBSTACLES)


def test_the_elbow_alone_touches_and_another_posture_is_free(scenes):
    scenario, cell = scenes["elbow"], planning_scene()
    cell.put(scenario.obstacles)
    start, goal = np.array(scenario.task.start), np.array(scenario.task.goal)
    found = [hit for q in cell.straight_motion(start, goal) for hit in cell.nearby(q, HAND_FREE)]
    assert min(d for link, _, d in found if link in cell.arm_links[ELBOW]) <= -5e-3
    assert not any(link in scenario.robot.tool_links for link, _, _ in found)
    swung = (cell.straight_motion(start, goal, swing) for swing in SWINGS)
    assert any(
        motion is not None and all(cell.is_free(q, SWUNG_FREE) for q in motion) for motion in swung
    )
