"""Poses of the depth cameras in evaluated scenes.

All cameras are the ASUS Xtions of the shipped scenarios: 640 x 480 pixels, a field of view of 58 x
45 degrees, 30 images per second with a delay of 30 ms, and the noise model of
`drake_oa.world.depth_noise`. Depths below 0.8 m are not measured.

- `with_workspace_cameras`: one or two cameras 2.1 m from the center of the workspace. They observe
  most of the space near the arm (as computed by `drake_oa.runs.camera_placement`). Perception uses
  points at a depth of up to 3.5 m and at most 0.6 m beside the table.
- `with_task_cameras`: two cameras to the left and right of the task, 1.2 m from the middle between
  start and goal.
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

WORKSPACE_CENTER = np.array([0.4, 0.0, 0.3])
"""Position (3,) in the world at which the cameras that observe the workspace look [m]."""
ONE_CAMERA = {"camera": (0.0, 80.0)}
"""Place of a single camera above the table: name -> azimuth and elevation [degrees].

Both angles are those of the camera's position, seen from `WORKSPACE_CENTER`: azimuth from the
world's x axis toward y, elevation above the horizontal plane. From a lower
elevation, the camera would see background beyond its range, so that pixels would have no depth."""
TWO_CAMERAS = {"left": (90.0, 60.0), "right": (-90.0, 60.0)}
"""Places of two cameras beside the robot: name -> azimuth and elevation [degrees].

Both angles are those of the camera's position, seen from `WORKSPACE_CENTER`: azimuth from the
world's x axis toward y, elevation above the horizontal plane."""
MAX_DEPTH = 3.5
"""Maximum depth of points that perception uses from cameras that observe the workspace [m]."""
TABLE_MARGIN = 0.6
"""Maximum horizontal distance from the table's edge up to which objects are perceived [m].

It applies to the cameras of `with_workspace_cameras`."""
_STAND = "package://drake_oa/scenes/camera_xtion.dmd.yaml"
"""URL of the model directives that add the stand of the camera in shipped scenarios.

`with_workspace_cameras` removes these directives with the camera."""
_WORKSPACE_DISTANCE = 2.1
"""Distance between the center of the workspace and a camera that observes the workspace [m]."""
TASK_DISTANCE = 1.2
"""Distance between a camera of `with_task_cameras` and the middle of start and goal [m]."""
TASK_AZIMUTH = math.radians(60.0)
"""Horizontal angle between robot base and camera, seen from the middle of start and goal [rad]."""
ELEVATIONS = np.radians([35.0, 50.0, 65.0, 80.0, 20.0])
"""Elevations of a camera in order of preference: angles above the horizontal plane [rad].

The angles are measured at the middle of start and goal. The first elevation is used at which no
obstacle is within 0.15 m of the camera or of the first 0.8 m of its optical axis; if every
elevation has such an obstacle, the last one is used."""
MIN_DISTANCE = 0.15
"""Minimum distance of obstacles from a camera and from the first 0.8 m of its optical axis [m].

A camera is placed at the first of the elevations `ELEVATIONS` that leaves this distance."""
_MIN_DEPTH = 0.8
"""Minimum depth that the simulated depth cameras of an evaluation measure [m]."""


def make_xtion_camera(name: str, X_WC: RigidTransform) -> CameraConfig:
    """Returns the configuration of an ASUS Xtion depth camera with given name and pose.

    Args:
        name: name of the camera.
        X_WC: pose of the camera in the world, with the axes x right, y down, z forward.
    """
    camera = copy.deepcopy(load_scenario("tabletop_box").cameras[0])
    camera.name, camera.X_PB = name, Transform(X_WC)
    return camera


def with_workspace_cameras(
    scenario: Scenario, places: Mapping[str, tuple[float, float]]
) -> Scenario:
    """Replaces the cameras of a scenario by cameras that look at the center of the workspace.

    Args:
        scenario: scenario with depth-camera perception.
        places: camera name -> azimuth (from the world's x axis toward y) and elevation of its
            position, seen from the center of the workspace [degrees]; for example `ONE_CAMERA` or
            `TWO_CAMERAS`.

    Returns:
        A copy of the scenario, whose perception uses points up to 0.6 m beside the table.

    Raises:
        ValueError: if the scenario's perception is not `DepthCamera`.
    """
    source = scenario.perception
    if not isinstance(source, DepthCamera):
        raise ValueError("perception: must be !DepthCamera, for the cameras to be replaced")
    scenario = copy.deepcopy(scenario)
    # Remove the stand of the table's camera: beside the table it would be perceived as an obstacle.
    scenario.directives = [
        item
        for item in scenario.directives
        if item.add_directives is None or item.add_directives.file != _STAND
    ]
    scenario.cameras = [
        make_xtion_camera(
            name, camera_pose_around(WORKSPACE_CENTER, azimuth, elevation, _WORKSPACE_DISTANCE)
        )
        for name, (azimuth, elevation) in zip(places, np.radians([*places.values()]), strict=True)
    ]
    scenario.perception = replace(
        source,
        camera=DepthCamera.camera,
        cameras=list(places),
        segmentation=replace(source.segmentation, far=MAX_DEPTH, table_margin=TABLE_MARGIN),
    )
    return scenario


def obstacle_geometries(obstacles: Iterable[Obstacle], time: float = 0.0) -> CollisionGeometries:
    """Returns the collision geometries of obstacles in the world frame at one simulated time.

    The geometries have no velocity, even those of moving obstacles.

    Args:
        obstacles: obstacles of a scenario.
        time: simulated time at which the poses of moving obstacles are computed [s].
    """
    placed = []
    for item in obstacles:
        X_WO = pose(item).GetAsMatrix4()
        X_WO[:3, 3] += item.offset_at(time)
        placed += shape_geometries(item.shapes, X_WO)
    return geometries_of(placed)


def with_task_cameras(scenario: Scenario) -> Scenario:
    """Replaces perception and cameras of a scenario by two depth cameras that look at its task.

    Each camera is 1.2 m from the middle between the task's start and goal and looks at it. Seen
    from above, the cameras are 60 degrees to the left and right of the direction to the robot's
    base. The elevation above the horizontal plane is 35 degrees, or else the first of 50, 65, 80
    and 20 degrees at which no obstacle is within 0.15 m of the camera or of the first 0.8 m of its
    optical axis; if there is none, it is 20 degrees. In a scenario with a table, only objects above
    the table are obstacles; in a scenario without a table (`table_height: null`), everything
    perceived except the robot is.
    """
    scenario = copy.deepcopy(scenario)
    task = scenario.task
    middle = 0.5 * (np.array(task.start) + np.array(task.goal))
    base = base_pose(scenario.robot).translation()
    toward = math.atan2(base[1] - middle[1], base[0] - middle[0])
    objects = obstacle_geometries(scenario.obstacles)
    places = {
        name: _place(middle, toward + side * TASK_AZIMUTH, objects)
        for name, side in (("left", -1.0), ("right", 1.0))
    }
    scenario.cameras = [make_xtion_camera(name, X_WC) for name, X_WC in places.items()]
    scenario.perception = DepthCamera(cameras=list(places), noise=CameraNoise())
    return scenario


def _place(middle: FloatArray, heading: float, objects: CollisionGeometries) -> RigidTransform:
    """Computes the pose X_WC of a camera that looks at the task, at the first free elevation.

    An elevation of `ELEVATIONS` is free if no obstacle is within `MIN_DISTANCE` of the camera or of
    the first 0.8 m of its optical axis. If none is free, the last one is used.

    Args:
        middle: (3,) middle between start and goal of the task in the world [m].
        heading: angle of the horizontal direction from the middle to the camera, from the world's x
            axis toward y [rad].
        objects: collision geometries of the obstacles in the world.
    """
    X_WC = RigidTransform()
    for elevation in ELEVATIONS:
        X_WC = camera_pose_around(middle, heading, elevation, TASK_DISTANCE)
        along = np.linspace(0.0, _MIN_DEPTH, 9)[:, None]
        sight = X_WC.translation() + along * X_WC.rotation().col(2)
        if (least_distances(objects, sight, 0.0, MIN_DISTANCE, MIN_DISTANCE) >= MIN_DISTANCE).all():
            break
    # If no elevation is free, the last one is used, and near obstacles may not be measured.
    return X_WC
