"""Tests of the camera poses in evaluated scenes."""

import pytest

from drake_oa.evaluation import cameras
from drake_oa.geometry.shapes import Box
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.obstacles import Obstacle


def camera_poses(scenario):
    """Returns camera name -> pose in the world of the cameras beside a task."""
    items = cameras.with_task_cameras(scenario).cameras
    return {item.name: item.X_PB.GetDeterministicValue() for item in items}


def test_camera_is_raised_if_an_obstacle_is_in_its_place():
    scenario = load_scenario("free_space", ["robot={}", "perception=!GroundTruth {}"])
    free = camera_poses(scenario)["left"].translation()
    object = Obstacle(name="board", shapes=[Box(size=[0.2, 0.2, 0.1])], translation=free.tolist())
    scenario.obstacles = [object]
    blocked = camera_poses(scenario)
    assert blocked["left"].translation()[2] > free[2]
    assert blocked["right"].translation()[2] == pytest.approx(free[2])


def test_workspace_cameras_require_perception_by_cameras():
    with pytest.raises(ValueError, match="must be !DepthCamera"):
        cameras.with_workspace_cameras(load_scenario("free_space"), cameras.ONE_CAMERA)
