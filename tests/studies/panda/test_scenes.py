"""Random scenes: the same of a kind, seed and index, and as their description says."""

import math

import numpy as np
import pytest

from drake_oa.perception.config import GroundTruth
from drake_oa.runs.camera_placement import near_space, view_volumes
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.loading import parse_scenario, scenario_text
from drake_oa.studies.panda.scene_arm import scene_arm
from drake_oa.studies.panda.scene_parts import FREE, footprint_radius
from drake_oa.studies.panda.scenes import (
    KINDS,
    MOVING_KINDS,
    NEAR,
    NEAR_OBSTACLES,
    draw_panda_scene,
)


@pytest.fixture(scope="module")
def scenes():
    return {kind: draw_panda_scene(0, 0, kind=kind) for kind in KINDS}


def planned(scenario):
    motion = scene_arm().straight_motion(*map(np.array, ends(scenario)))
    assert motion is not None
    return motion


def ends(scenario):
    return scenario.task.start, scenario.task.goal


@pytest.mark.parametrize("kind", KINDS)
def test_a_scene_is_a_scenario_and_the_same_each_time(scenes, kind):
    text = scenario_text(scenes[kind])
    assert scenario_text(parse_scenario(text)) == text
    assert scenario_text(draw_panda_scene(0, 0, kind=kind)) == text


@pytest.mark.parametrize(
    ("kind", "places"),
    [
        ("moving", {"moving0": [0.2249, -0.4108, 0.5178]}),
        (
            "moving_hard",
            {
                "moving0": [0.0728, 0.6154, 0.5659],
                "moving1": [0.0177, 1.1587, 0.2413],
                "moving2": [1.1508, 0.2416, 0.4629],
                "moving3": [0.5412, 1.5276, 0.1987],
                "box4": [0.4834, 0.0757, 0.0],
                "box5": [0.4947, -0.4046, 0.0],
            },
        ),
        ("elbow", {"board0": [0.3159, 0.3744, 0.0]}),
    ],
)
def test_scenes_are_drawn_by_the_image_of_the_camera_at_the_table(scenes, kind, places):
    assert {item.name: item.translation for item in scenes[kind].obstacles} == places


@pytest.mark.parametrize("kind", MOVING_KINDS)
def test_cameras_of_moving_scenes_see_most_of_the_space_near_the_arm(scenes, kind):
    two = draw_panda_scene(0, 0, kind=kind, perception="depth2")
    # The goals of DRPBench's levels are in places that one camera sees less well.
    by_one = 0.2 if kind.startswith("drp") else 0.15
    for scene, most in ((scenes[kind], by_one), (two, 0.01)):
        space = near_space(scene)
        assert space.unseen_share(view_volumes(scene, scene.perception)) < most
        assert scene.perception.segmentation.far == 3.5
        # Nothing stands in their sight.
        assert len(scene.directives) == 1


def test_perception_changes_nothing_else():
    one, two, truth = (draw_panda_scene(1, 0, perception=p) for p in ("depth", "depth2", "truth"))
    assert isinstance(truth.perception, GroundTruth)
    assert two.perception.names == ("left", "right")
    assert two.perception.noise == one.perception.noise
    for other in (two, truth):
        assert (other.obstacles, other.task, other.seed) == (one.obstacles, one.task, one.seed)


@pytest.mark.parametrize("kind", ["tabletop", "clutter6", "elbow"])
def test_the_ends_are_free_and_the_planned_motion_is_not_clear(scenes, kind):
    scenario = scenes[kind]
    start, goal = ends(scenario)
    assert 0.5 <= math.dist(start, goal) <= 1.0
    # Judged by the metrics of a run, in a world of their own.
    arm = planned(scenario).q
    opening = scenario.robot.finger_opening
    metrics = robot_metrics(scenario, np.c_[arm, np.full((len(arm), 2), opening)])
    np.testing.assert_allclose(metrics.p_WE[[0, -1]], [start, goal], atol=1e-3)
    assert metrics.robot_clearance[[0, -1]].min() >= FREE
    assert metrics.robot_clearance.min() <= -5e-3
    assert all("obstacle" in contact for contact in metrics.contacts)
    # In `elbow`, of tool and wrist nothing touches.
    touched = {contact.partition(" - ")[0] for contact in metrics.contacts}
    assert kind != "elbow" or touched <= {f"panda_link{number}" for number in range(2, 6)}
    assert kind != "elbow" or metrics.tool_clearance.min() >= 0.05


@pytest.mark.parametrize("kind", ["tabletop", "clutter6"])
def test_things_stand_apart_and_clutter_beside_the_way(scenes, kind):
    obstacles = scenes[kind].obstacles
    for row, one in enumerate(obstacles):
        radius = footprint_radius(one)
        assert math.hypot(*one.translation[:2]) > radius + 0.15
        for other in obstacles[:row]:
            gap = math.dist(one.translation[:2], other.translation[:2])
            assert gap >= radius + footprint_radius(other) + 0.02 - 1e-9
    arm, motion = scene_arm(), planned(scenes[kind])
    near = sum(arm.distances(motion.q, [item])[:, arm.tool].min() < NEAR for item in obstacles)
    assert kind == "tabletop" or (len(obstacles) == 6 and near >= NEAR_OBSTACLES)
