"""Check of a scenario's cameras: fraction of the space near the arm that no camera observes, and a
better camera pose.
"""

from __future__ import annotations

import math
from functools import partial
from itertools import product

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.station import covered_arm
from drake_oa.geometry.pinhole import look_at_pose, pinhole
from drake_oa.perception.config import CameraSource
from drake_oa.perception.coverage import REACH, ViewVolume, points_near, unobserved_fraction
from drake_oa.robot.arm import make_chain
from drake_oa.robot.plant import make_robot_plant
from drake_oa.robot.spheres import sphere_centers
from drake_oa.scenario.end_poses import end_positions, posture_guide
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import camera_configs
from drake_oa.world.cameras import depth_intrinsics
from drake_oa.world.world_model import add_world

MAX_UNOBSERVED_FRACTION = 0.15
"""Maximum fraction of the space near the arm that no camera observes; above it `view_note` suggests
a camera pose."""
_DISTANCE = 2.1
"""Distance of a suggested camera from its target, the mean position of the arm along the nominal
motion [m]."""
_AZIMUTHS = tuple(math.radians(degrees) for degrees in range(0, 360, 45))
"""Azimuths of the camera poses that are evaluated for a suggestion: angles about the vertical from
the world's x axis [rad]."""
_ELEVATIONS = tuple(math.radians(degrees) for degrees in (20, 35, 50))
"""Elevations of the camera poses that are evaluated for a suggestion: angles above the horizontal
plane [rad]."""
_CONFIGURATIONS = 5
"""Number of arm configurations, evenly spaced in time from start to goal of the nominal motion, for
which the observed space is computed."""


def spheres_along(scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """Computes the spheres that cover the arm, in several configurations from start to goal of the
    nominal motion.

    Returns:
        Centers (T, S, 3) of S spheres in T configurations, in the world [m], and radii (S,) [m].
    """
    robot = robot_of(scenario)
    robot_plant, spheres = make_robot_plant(robot), covered_arm(robot).arrays
    q_start, q_goal = end_positions(scenario)
    chain = make_chain(robot_plant.plant, robot_plant.tool_frame, q_start, spheres)
    s = np.linspace(0.0, 1.0, _CONFIGURATIONS)
    q = posture_guide(s, q_start[chain.q_index], q_goal[chain.q_index])
    return sphere_centers(chain, spheres, q), spheres.radius


def view_volumes(scenario: Scenario, source: CameraSource) -> list[ViewVolume]:
    """Computes, for each camera of a scenario's perception, the volume in which the camera measures
    depth.

    Cameras on moving bodies have their initial poses.

    Args:
        scenario: scenario with the cameras.
        source: perception block of the scenario, with the names of cameras and the range of depth.
    """
    limits = source.segmentation
    scene_graph, plant = SceneGraph(), MultibodyPlant(time_step=scenario.plant_step)
    # Obstacles have visual geometry.
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    add_world(plant, scenario)
    plant.Finalize()
    context, volumes = plant.CreateDefaultContext(), []
    for camera in camera_configs(scenario, source):
        frame = GetScopedFrameByName(plant, camera.X_PB.base_frame or "world")
        X_WC = frame.CalcPoseInWorld(context) @ camera.X_PB.GetDeterministicValue()
        volumes.append(_view_volume(camera, X_WC, limits.near, limits.far))
    return volumes


def _view_volume(camera: CameraConfig, X_WC: RigidTransform, near: float, far: float) -> ViewVolume:
    """Computes the view volume of a camera: the space inside its image, between two depths.

    Args:
        camera: camera with image size, field of view and its own range of depth.
        X_WC: pose of the camera in the world.
        near: minimum depth that the perception uses [m].
        far: maximum depth that the perception uses [m].
    """
    intrinsics = depth_intrinsics(camera)
    return ViewVolume(
        X_WC.GetAsMatrix4(),
        np.array(pinhole(intrinsics)),
        (intrinsics.height(), intrinsics.width()),
        max(camera.z_near, near),
        min(camera.z_far, far),
    )


def camera_pose_around(
    target: FloatArray, azimuth: float, elevation: float, distance: float
) -> RigidTransform:
    """Computes the pose X_WC of a camera that looks at a target from a given direction and
    distance.

    The x axis of the camera is horizontal.

    Args:
        target: (3,) target in the world [m].
        azimuth: angle of the camera about the vertical through the target, from the x axis [rad].
        elevation: angle of the camera above the horizontal plane through the target [rad].
        distance: distance of the camera to the target [m].
    """
    level = math.cos(elevation)
    direction = [level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)]
    return look_at_pose(RigidTransform(), target + distance * np.array(direction), target)


def view_note(scenario: Scenario) -> str:
    """Returns one line of text with the fraction of the space near the arm that no camera observes.

    Above `MAX_UNOBSERVED_FRACTION`, the line also suggests the pose of a single camera that
    observes more of the space, or states that there is none. The line is empty if the perception
    uses no cameras.
    """
    source = scenario.perception
    if not isinstance(source, CameraSource):
        return ""
    p_WS, radius = spheres_along(scenario)
    points = points_near(p_WS, radius, scenario.table_height)
    share_of = partial(unobserved_fraction, p_WS, radius, points)
    share = share_of(view_volumes(scenario, source))
    note = f"cameras: {share:.0%} of the space within {REACH:g} m of the arm is unobserved"
    if share <= MAX_UNOBSERVED_FRACTION:
        return note
    camera, middle = camera_configs(scenario, source)[0], p_WS.mean(axis=(0, 1))
    min_share, X_WC = share, RigidTransform()
    for azimuth, elevation in product(_AZIMUTHS, _ELEVATIONS):
        X_WP = camera_pose_around(middle, azimuth, elevation, _DISTANCE)
        view = _view_volume(camera, X_WP, source.segmentation.near, camera.z_far)
        if (candidate := share_of([view])) < min_share:
            min_share, X_WC = candidate, X_WP
    if min_share == share:
        return f"{note}; no single camera at a distance of {_DISTANCE:g} m observes more"
    position = np.round(X_WC.translation(), 2).tolist()
    angles = (np.round(np.degrees(RollPitchYaw(X_WC.rotation()).vector()), 1) + 0.0).tolist()
    return (
        f"{note}; {min_share:.0%} with '{camera.name}' at X_PB: {{translation: {position}, "
        f"rotation: !Rpy {{deg: {angles}}}}} and segmentation: {{far: {camera.z_far:g}}}"
    )
