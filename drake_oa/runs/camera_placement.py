"""Space near the arm that a scenario's cameras do not see, and better places of a camera."""

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
from drake_oa.perception.coverage import REACH, ViewVolume, points_near, unseen_share
from drake_oa.robot.arm import make_chain
from drake_oa.robot.plant import make_robot_plant
from drake_oa.robot.spheres import sphere_centers
from drake_oa.scenario.end_poses import end_positions, posture_guide
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import camera_configs
from drake_oa.viewing.viewer import look_at_pose
from drake_oa.world.cameras import depth_intrinsics
from drake_oa.world.world_model import add_world

LARGE_SHARE = 0.15
"""Unseen share above which another place is suggested."""
_AWAY = 2.1
"""Distance of the suggested places from the middle of the arm [m]."""
_AZIMUTHS = tuple(math.radians(degrees) for degrees in range(0, 360, 45))
_ELEVATIONS = tuple(math.radians(degrees) for degrees in (20, 35, 50))
_CONFIGURATIONS = 5
"""Number of configurations between start and goal."""


def spheres_along(scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """Computes centers (T, S, 3) and radii (S,) of the arm along the nominal motion [m]."""
    robot = robot_of(scenario)
    robot_plant, spheres = make_robot_plant(robot), covered_arm(robot).arrays
    q_start, q_goal = end_positions(scenario)
    chain = make_chain(robot_plant.plant, robot_plant.tool_frame, q_start, spheres)
    s = np.linspace(0.0, 1.0, _CONFIGURATIONS)
    q = posture_guide(s, q_start[chain.q_index], q_goal[chain.q_index])
    return sphere_centers(chain, spheres, q), spheres.radius


def view_volumes(scenario: Scenario, source: CameraSource) -> list[ViewVolume]:
    """Computes the volumes in which the cameras of perception measure."""
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
    """Computes the volume of a camera at a pose, within limits of the depth [m]."""
    seen = depth_intrinsics(camera)
    return ViewVolume(
        X_WC.GetAsMatrix4(),
        np.array(pinhole(seen)),
        (seen.height(), seen.width()),
        max(camera.z_near, near),
        min(camera.z_far, far),
    )


def placed_around(
    middle: FloatArray, azimuth: float, elevation: float, away: float
) -> RigidTransform:
    """Computes the pose X_WC of a camera that looks at a point from a distance, x axis level.

    Args:
        middle: (3,) the point in the world [m].
        azimuth: angle of the way to the camera about the vertical, from the world's x axis [rad].
        elevation: angle of that way above the horizontal [rad].
        away: its length [m].
    """
    level = math.cos(elevation)
    way = [level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)]
    return look_at_pose(RigidTransform(), middle + away * np.array(way), middle)


def view_note(scenario: Scenario) -> str:
    """Returns one line about the unseen share of the space near the arm; "" without cameras.

    Where the share is large, it suggests the best place around the space for a single camera.
    """
    source = scenario.perception
    if not isinstance(source, CameraSource):
        return ""
    p_WS, radius = spheres_along(scenario)
    points = points_near(p_WS, radius, scenario.table_height)
    share_of = partial(unseen_share, p_WS, radius, points)
    share = share_of(view_volumes(scenario, source))
    note = f"cameras: {share:.0%} of the space within {REACH:g} m of the arm is unseen"
    if share <= LARGE_SHARE:
        return note
    camera, middle = camera_configs(scenario, source)[0], p_WS.mean(axis=(0, 1))
    least, X_WC = share, RigidTransform()
    for azimuth, elevation in product(_AZIMUTHS, _ELEVATIONS):
        X_WP = placed_around(middle, azimuth, elevation, _AWAY)
        view = _view_volume(camera, X_WP, source.segmentation.near, camera.z_far)
        if (unseen := share_of([view])) < least:
            least, X_WC = unseen, X_WP
    if least == share:
        return f"{note}; no single camera at a distance of {_AWAY:g} m sees more"
    place = np.round(X_WC.translation(), 2).tolist()
    angles = (np.round(np.degrees(RollPitchYaw(X_WC.rotation()).vector()), 1) + 0.0).tolist()
    return (
        f"{note}; {least:.0%} with '{camera.name}' at X_PB: {{translation: {place}, "
        f"rotation: !Rpy {{deg: {angles}}}}} and segmentation: {{far: {camera.z_far:g}}}"
    )
