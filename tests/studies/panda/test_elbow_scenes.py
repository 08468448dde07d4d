"""Scenes with the elbow's way blocked: it touches, the hand does not, another posture is free."""

import math

import numpy as np
import pytest

from drake_oa.studies.panda.scene_parts import FREE, planning_scene
from drake_oa.studies.panda.scenes import ELBOW, HAND_FREE, SWINGS, SWUNG_FREE, draw_panda_scene


@pytest.fixture(scope="module")
def scene():
    return draw_panda_scene(0, 0, kind="elbow")


@pytest.fixture
def robot(scene):
    """The planning scene with the scene's things, start and goal."""
    planning_scene().put(scene.obstacles)
    return planning_scene(), np.array(scene.task.start), np.array(scene.task.goal)


def test_the_ends_are_free(robot):
    cell, start, goal = robot
    motion = cell.straight_motion(start, goal)
    for q in (motion[0], motion[-1], cell.tool_down(goal)):
        assert cell.clearance(q) >= FREE - 1e-9
        assert not cell.contacts(q)


def test_the_elbow_touches_and_the_hand_does_not(scene, robot):
    cell, start, goal = robot
    found = [hit for q in cell.straight_motion(start, goal) for hit in cell.nearby(q, HAND_FREE)]
    elbow = cell.arm_links[ELBOW]
    assert elbow == ("panda_link2", "panda_link3", "panda_link4", "panda_link5")
    assert min(distance for link, _, distance in found if link in elbow) <= -5e-3
    assert not any(link in scene.robot.tool_links for link, _, _ in found)


def test_another_posture_is_free_with_the_tool_on_the_same_way(robot):
    cell, start, goal = robot
    swung = (cell.straight_motion(start, goal, swing) for swing in SWINGS)
    free = next(
        motion
        for motion in swung
        if motion is not None and all(cell.is_free(q, SWUNG_FREE) for q in motion)
    )
    for one, other in zip(cell.straight_motion(start, goal), free, strict=True):
        assert math.dist(cell.tool_point(one), cell.tool_point(other)) < 1.5e-3
