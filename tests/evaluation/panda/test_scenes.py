"""Tests of random scenes: reproducibility by kind, seed and index, and their conditions."""

import hashlib
import json
import math

import numpy as np
import pytest

from drake_oa.evaluation.panda.scene_arm import scene_arm
from drake_oa.evaluation.panda.scene_parts import MIN_END_CLEARANCE, footprint_radius
from drake_oa.evaluation.panda.scenes import KINDS, draw_panda_scene, with_perception
from drake_oa.perception.config import GroundTruth
from drake_oa.runs.camera_placement import unobserved_near_arm
from drake_oa.runs.metrics import robot_metrics
from drake_oa.scenario.loading import parse_scenario, scenario_text

DIGESTS = """
tabletop 05833eed moving 8c8163c2 elbow 3ca6ac0d clutter6 b031fd7f moving_hard a557fa02
moving_high 858cf87f drp_sudden1 f75bb3d2 drp_sudden2 ab4f2214 drp_sudden3 4c5a9c57
drp_floating1 73a5a429 drp_floating2 548cdb1c drp_goal_blocked1 f82eae2c
drp_goal_blocked2 3a0414e4 drp_moving_goal_blocked1 a1be35f6 drp_moving_goal_blocked2 7c0701ce
drp_moving_goal_blocked3 cce50f59 drp_moving_goal_blocked4 5f2585f3
drp_floating1_at_0.18 0ba1c672 drp_floating1_at_0.5 04de2ffc drp_floating1_at_1.0 430fe95f
drp_floating1_at_1.6 73851d67
"""
"""Kinds, each with the digest of its first scene of seed 0; source changes must preserve it."""


@pytest.fixture(scope="module")
def scenes():
    return {kind: draw_panda_scene(0, 0, kind=kind) for kind in KINDS}


def test_scenes_have_the_stored_digests(scenes):
    digests = []
    for kind, scene in scenes.items():
        objects = [[o.name, o.translation, o.rpy, o.present, o.waypoints] for o in scene.obstacles]
        content = [scene.seed, scene.task.start, scene.task.goal, objects]
        digests += [kind, hashlib.sha256(json.dumps(content).encode()).hexdigest()[:8]]
        text = scenario_text(scene)
        assert scenario_text(parse_scenario(text)) == text
    assert digests == DIGESTS.split()


@pytest.mark.parametrize(
    "kind", ["moving", "moving_hard", "drp_sudden3", "drp_floating1", "drp_moving_goal_blocked4"]
)
def test_cameras_of_moving_scenes_observe_most_space_near_the_arm(scenes, kind):
    # Obstacles in front of the goal occlude space.
    by_one, by_two = (0.35, 0.2) if "goal_blocked" in kind else (0.2, 0.12)
    for perception, max_share in (("depth", by_one), ("depth2", by_two)):
        scene = with_perception(scenes[kind], perception)
        assert unobserved_near_arm(scene) < max_share
        # The only model is the table, which occludes nothing above it.
        assert len(scene.directives) == 1


def test_perception_does_not_change_the_scene():
    one = draw_panda_scene(1, 0)
    two, truth = (with_perception(one, perception) for perception in ("depth2", "truth"))
    assert isinstance(truth.perception, GroundTruth)
    assert two.perception.names == ("left", "right")
    assert two.perception.noise == one.perception.noise
    for other in (two, truth):
        assert (other.obstacles, other.task, other.seed) == (one.obstacles, one.task, one.seed)


@pytest.mark.parametrize("kind", ["tabletop", "clutter6", "elbow"])
def test_ends_are_free_and_nominal_motion_collides(scenes, kind):
    scenario = scenes[kind]
    start, goal = scenario.task.start, scenario.task.goal
    assert 0.5 <= math.dist(start, goal) <= 1.0
    motion = scene_arm().straight_motion(np.array(start), np.array(goal))
    assert motion is not None
    # Metrics of a run, computed with SceneGraph.
    fingers = np.full((len(motion.q), 2), scenario.robot.finger_opening)
    metrics = robot_metrics(scenario, np.c_[motion.q, fingers])
    np.testing.assert_allclose(metrics.p_WE[[0, -1]], [start, goal], atol=1e-3)
    assert metrics.robot_clearance[[0, -1]].min() >= MIN_END_CLEARANCE
    assert metrics.robot_clearance.min() <= -5e-3
    assert all("obstacle" in contact for contact in metrics.contacts)
    # In `elbow`, tool and wrist are collision-free.
    touched = {contact.partition(" - ")[0] for contact in metrics.contacts}
    assert kind != "elbow" or touched <= {f"panda_link{number}" for number in range(2, 6)}
    assert kind != "elbow" or metrics.tool_clearance.min() >= 0.05
    for row, one in enumerate(scenario.obstacles):
        radius = footprint_radius(one)
        assert math.hypot(*one.translation[:2]) > radius + 0.15
        for other in scenario.obstacles[:row]:
            gap = math.dist(one.translation[:2], other.translation[:2])
            assert gap >= radius + footprint_radius(other) + 0.02 - 1e-9
