"""Places of the depth cameras of studied scenes.

All are ASUS Xtions as the shipped scenarios have them: 640 x 480 pixels, 58 x 45 degrees, what is
nearer than 0.8 m is not seen, 30 images a second that come 30 ms late, with the published noise.

- `seen_from`: one or two cameras 2.1 m from the middle of the workspace, which see most of what
  is near the arm (`drake_oa.runs.camera_placement`) and 0.6 m beside the table, to 3.5 m depth.
- `with_two`: left and right of the way from the robot to what is to be done, see there.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np
from pydrake.common.schema import Transform
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.collision_scene import (
    CollisionGeometries,
    geometries_of,
    least_distances,
    shape_geometries,
)
from drake_oa.geometry.shapes import pose
from drake_oa.perception.config import CameraNoise, DepthCamera
from drake_oa.robot.plant import base_pose
from drake_oa.runs.camera_placement import camera_pose_around
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.scenario.scenario import Scenario

MIDDLE = np.array([0.4, 0.0, 0.3])
"""Point that the cameras of `seen_from` look at [m]."""
ONE = {"camera": (0.0, 35.0)}
"""Name of a camera -> azimuth and elevation of its place [degrees]: in front of the robot."""
TWO = {"left": (90.0, 20.0), "right": (-90.0, 20.0)}
"""Names and places of a pair beside the robot, which misses 1 % of the space near the arm."""
FAR, BESIDE = 3.5, 0.6
"""Maximum depth, and distance from the table up to which obstacles count [m]."""
_STAND = "package://drake_oa/scenes/camera_xtion.dmd.yaml"
_SEEN_FROM = 2.1
"""From a camera of `seen_from` to the middle [m]."""
AWAY = 1.2
"""Distance from a camera of `with_two` to the middle of the task [m]."""
ASIDE = math.radians(60.0)
"""From the way to the robot to that to a camera, seen from above [rad]."""
ELEVATIONS = np.radians([35.0, 50.0, 65.0, 80.0, 20.0])
"""Elevations of a camera over the middle, of which the first that fits is used [rad]."""
APART = 0.15
"""Minimum distance of a camera, and of its first 0.8 m of sight to the middle, to obstacles [m]."""
_NEAREST = 0.8


def xtion(name: str, X_WC: RigidTransform) -> CameraConfig:
    """Makes a camera (x right, y down, z forward) at a pose in the world."""
    camera = copy.deepcopy(load_scenario("tabletop_box").cameras[0])
    camera.name, camera.X_PB = name, Transform(X_WC)
    return camera


def seen_from(scenario: Scenario, places: Mapping[str, tuple[float, float]]) -> Scenario:
    """Returns the scenario, seen by cameras around the workspace, above the table and beside it.

    Args:
        scenario: seen by a depth camera.
        places: name of each camera -> azimuth and elevation of its place, as `ONE` and `TWO`.

    Raises:
        ValueError: if it is not seen by a depth camera.
    """
    source = scenario.perception
    if not isinstance(source, DepthCamera):
        raise ValueError("other places of cameras need a scenario that is seen by a depth camera")
    scenario = copy.deepcopy(scenario)
    # The stand of the camera at the table would be an obstacle beside it.
    scenario.directives = [
        item
        for item in scenario.directives
        if item.add_directives is None or item.add_directives.file != _STAND
    ]
    scenario.cameras = [
        xtion(name, camera_pose_around(MIDDLE, azimuth, elevation, _SEEN_FROM))
        for name, (azimuth, elevation) in zip(places, np.radians([*places.values()]), strict=True)
    ]
    scenario.perception = replace(
        source,
        camera=DepthCamera.camera,
        cameras=list(places),
        segmentation=replace(source.segmentation, far=FAR, table_margin=BESIDE),
    )
    return scenario


def obstacle_geometries(obstacles: Iterable[Obstacle], time: float = 0.0) -> CollisionGeometries:
    """Returns the solids of obstacles where they are at a time [s]."""
    placed = []
    for item in obstacles:
        X_WO = pose(item).GetAsMatrix4()
        X_WO[:3, 3] += item.offset_at(time)
        placed += shape_geometries(item.shapes, X_WO)
    return geometries_of(placed)


def with_two(scenario: Scenario) -> Scenario:
    """Returns the scenario, seen by two cameras.

    They look at the middle between the task's start and goal from 1.2 m, left and right: seen from
    above, by 60 degrees from the way to the robot's base, past which they look into what is open
    towards it; over the middle by 35 degrees, or by 50, 65, 80 or 20 where there is something
    within 0.15 m of the camera or of its first 0.8 m of sight, in which it sees nothing. All that
    is seen and is not the robot is an obstacle, with a table or without.
    """
    scenario = copy.deepcopy(scenario)
    task = scenario.task
    middle = 0.5 * (np.array(task.start) + np.array(task.goal))
    base = base_pose(scenario.robot).translation()
    toward = math.atan2(base[1] - middle[1], base[0] - middle[0])
    objects = obstacle_geometries(scenario.obstacles)
    places = {
        name: _place(middle, toward + side * ASIDE, objects)
        for name, side in (("left", -1.0), ("right", 1.0))
    }
    scenario.cameras = [xtion(name, X_WC) for name, X_WC in places.items()]
    scenario.perception = DepthCamera(cameras=list(places), noise=CameraNoise())
    return scenario


def _place(middle: FloatArray, heading: float, objects: CollisionGeometries) -> RigidTransform:
    """Returns the pose of a camera that looks at the middle."""
    X_WC = RigidTransform()
    for elevation in ELEVATIONS:
        X_WC = camera_pose_around(middle, heading, elevation, AWAY)
        along = np.linspace(0.0, _NEAREST, 9)[:, None]
        sight = X_WC.translation() + along * X_WC.rotation().col(2)
        if (least_distances(objects, sight, 0.0, APART, APART) >= APART).all():
            break
    # If none fits, what stands in its way is seen from near, or not at all.
    return X_WC
