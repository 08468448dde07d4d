"""Fraction of the space near the arm that no camera observes, and better camera poses."""

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
from drake_oa.geometry.pinhole import pinhole
from drake_oa.perception.config import CameraSource
from drake_oa.perception.coverage import REACH, ViewVolume, points_near, unobserved_share
from drake_oa.robot.arm import make_chain
from drake_oa.robot.plant import make_robot_plant
from drake_oa.robot.spheres import sphere_centers
from drake_oa.scenario.end_poses import end_positions, posture_guide
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import camera_configs
from drake_oa.viewing.viewer import look_at_pose
from drake_oa.world.cameras import depth_intrinsics
from drake_oa.world.world_model import add_world

MAX_UNOBSERVED_FRACTION = 0.15
"""Unobserved fraction of the space near the arm above which a camera pose is suggested."""
_DISTANCE = 2.1
"""Distance of the suggested cameras from the mean position of the arm's spheres [m]."""
_AZIMUTHS = tuple(math.radians(degrees) for degrees in range(0, 360, 45))
"""Azimuths of the candidate cameras about the vertical, from the world's x axis [rad]."""
_ELEVATIONS = tuple(math.radians(degrees) for degrees in (20, 35, 50))
"""Elevations of the candidate cameras above the horizontal plane [rad]."""
_CONFIGURATIONS = 5
"""Number of configurations of the nominal motion, start and goal included."""


def spheres_along(scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """Computes centers (T, S, 3) and radii (S,) of the arm's spheres on the nominal motion [m]."""
    robot = robot_of(scenario)
    robot_plant, spheres = make_robot_plant(robot), covered_arm(robot).arrays
    q_start, q_goal = end_positions(scenario)
    chain = make_chain(robot_plant.plant, robot_plant.tool_frame, q_start, spheres)
    s = np.linspace(0.0, 1.0, _CONFIGURATIONS)
    q = posture_guide(s, q_start[chain.q_index], q_goal[chain.q_index])
    return sphere_centers(chain, spheres, q), spheres.radius


def view_volumes(scenario: Scenario, source: CameraSource) -> list[ViewVolume]:
    """Computes the volume in which each camera of the perception measures depth."""
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
    """Computes the view volume of a camera with pose X_WC between two depths [m]."""
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
    """Computes the pose X_WC of a camera that looks at a target, with a horizontal x axis.

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
    """Returns one line about the unobserved space near the arm; "" without cameras.

    Above `MAX_UNOBSERVED_FRACTION` it suggests the best pose of a single camera.
    """
    source = scenario.perception
    if not isinstance(source, CameraSource):
        return ""
    p_WS, radius = spheres_along(scenario)
    points = points_near(p_WS, radius, scenario.table_height)
    share_of = partial(unobserved_share, p_WS, radius, points)
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
