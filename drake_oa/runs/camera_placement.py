"""Check of a scenario's cameras: fraction of the space near the arm that no camera observes, and a
better camera pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.station import covered_arm
from drake_oa.geometry.pinhole import View, look_at_pose, pinhole
from drake_oa.perception.config import CameraSource
from drake_oa.perception.coverage import REACH, points_near, unobserved_fraction
from drake_oa.perception.depth_perception import FreeSpace
from drake_oa.robot.arm import make_chain
from drake_oa.robot.plant import make_robot_plant
from drake_oa.robot.spheres import sphere_centers
from drake_oa.scenario.end_poses import end_positions, posture_guide
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import camera_configs
from drake_oa.world.cameras import PIXEL_CENTER, add_camera, depth_intrinsics
from drake_oa.world.delayed_camera import Rendered
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
_ELEVATIONS = tuple(math.radians(degrees) for degrees in (35, 50, 65, 80))
"""Elevations of the camera poses that are evaluated for a suggestion: angles above the horizontal
plane [rad]."""
_CONFIGURATIONS = 5
"""Number of arm configurations, evenly spaced in time from start to goal of the nominal motion, for
which the observed space is computed."""


def _motion_space(scenario: Scenario) -> tuple[FloatArray, list[FloatArray], FloatArray]:
    """Samples the space near the arm along a scenario's nominal motion.

    Returns:
        T configurations (T, n) of the robot from start to goal [rad, m]; for each of them, points
        (N, 3) near the arm in the world [m]; and the mean position (3,) of the arm [m].
    """
    robot = robot_of(scenario)
    robot_plant, spheres = make_robot_plant(robot), covered_arm(robot).arrays
    q_start, q_goal = end_positions(scenario)
    chain = make_chain(robot_plant.plant, robot_plant.tool_frame, q_start, spheres)
    s = np.linspace(0.0, 1.0, _CONFIGURATIONS)
    q = np.tile(q_start, (_CONFIGURATIONS, 1))
    q[:, chain.q_index] = posture_guide(s, q_start[chain.q_index], q_goal[chain.q_index])
    p_WS = sphere_centers(chain, spheres, q[:, chain.q_index])
    return q, points_near(p_WS, spheres.radius, scenario.table_height), p_WS.mean(axis=(0, 1))


def free_space_of(
    source: CameraSource, configs: Sequence[CameraConfig], images: Sequence[Rendered]
) -> FreeSpace:
    """Returns the space that rendered images of one instant show to be free.

    A pixel without a surface in the camera's range has no depth, and shows no free space.

    Args:
        source: perception block of a scenario, with the range of depth that perception uses.
        configs: configurations of the cameras.
        images: image of each camera.
    """
    views = []
    for config, (depth, X_WC) in zip(configs, images, strict=True):
        K = np.array(pinhole(depth_intrinsics(config))) - [0.0, 0.0, PIXEL_CENTER, PIXEL_CENTER]
        views.append(View(np.where(np.isinf(depth), np.nan, depth), K, X_WC.GetAsMatrix4()))
    near = max(source.segmentation.near, *(config.z_near for config in configs))
    far = min(source.segmentation.far, *(config.z_far for config in configs))
    return FreeSpace(tuple(views), 0.0, near, far)


def _render(
    scenario: Scenario, config: CameraConfig, q: FloatArray, poses: Sequence[RigidTransform] = ()
) -> list[list[Rendered]]:
    """Renders depth images of a camera in the initial world of a scenario.

    Args:
        scenario: scenario with a robot.
        config: configuration of the camera.
        q: (T, n) configurations of the robot [rad, m].
        poses: poses of the camera in the world; empty: its own pose.

    Returns:
        For each pose, the images in the T configurations.
    """
    plant, builder = MultibodyPlant(time_step=scenario.plant_step), DiagramBuilder()
    # Obstacles have visual geometry.
    plant.RegisterAsSourceForSceneGraph(builder.AddSystem(SceneGraph()))
    robot = add_world(plant, scenario)
    plant.Finalize()
    sensor = add_camera(builder, scenario, config)
    diagram, plant_context = builder.Build(), plant.CreateDefaultContext()
    context = diagram.CreateDefaultContext()
    sensor_context = sensor.GetMyMutableContextFromRoot(context)
    image, pose = sensor.depth_image_32F_output_port(), sensor.body_pose_in_world_output_port()
    if poses:
        sensor.SetParentFrameId(sensor_context, SceneGraph.world_frame_id())
    images: list[list[Rendered]] = []
    for X_PB in poses or [sensor.GetX_PB(sensor_context)]:
        sensor.SetX_PB(sensor_context, X_PB)
        images.append([])
        for positions in q:
            plant.SetPositions(plant_context, robot, positions)
            state = plant.GetPositionsAndVelocities(plant_context)
            diagram.get_input_port().FixValue(context, state)
            depth = np.array(image.Eval(sensor_context).data[:, :, 0])
            images[-1].append(Rendered(depth, RigidTransform(pose.Eval(sensor_context))))
    return images


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


def unobserved_near_arm(scenario: Scenario) -> float:
    """Computes the fraction of the space near the arm, along its nominal motion, that none of the
    cameras of a scenario observes to be free; obstacles are at their initial poses.

    Raises:
        ValueError: if the scenario's perception uses no cameras.
    """
    source = scenario.perception
    if not isinstance(source, CameraSource):
        raise ValueError("perception: must use cameras, such as !DepthCamera")
    (q, points, _), configs = _motion_space(scenario), camera_configs(scenario, source)
    images = zip(*(_render(scenario, config, q)[0] for config in configs), strict=True)
    return unobserved_fraction(points, [free_space_of(source, configs, one) for one in images])


def view_note(scenario: Scenario) -> str:
    """Returns one line of text with the fraction of the space near the arm that no camera observes.

    Above `MAX_UNOBSERVED_FRACTION`, the line also suggests the pose of a single camera that
    observes more of the space, or states that there is none. The line is empty if the perception
    uses no cameras.
    """
    source = scenario.perception
    if not isinstance(source, CameraSource):
        return ""
    share = unobserved_near_arm(scenario)
    note = f"cameras: {share:.0%} of the space within {REACH:g} m of the arm is unobserved"
    if share <= MAX_UNOBSERVED_FRACTION:
        return note
    (q, points, center), camera = _motion_space(scenario), camera_configs(scenario, source)[0]
    directions = product(_AZIMUTHS, _ELEVATIONS)
    poses = [camera_pose_around(center, *direction, _DISTANCE) for direction in directions]
    source = replace(source, segmentation=replace(source.segmentation, far=camera.z_far))
    shares = [
        unobserved_fraction(points, [free_space_of(source, [camera], [one]) for one in images])
        for images in _render(scenario, camera, q, poses)
    ]
    best = int(np.argmin(shares))
    if shares[best] >= share:
        return f"{note}; no single camera at a distance of {_DISTANCE:g} m observes more"
    X_WC = poses[best]
    position = np.round(X_WC.translation(), 2).tolist()
    angles = (np.round(np.degrees(RollPitchYaw(X_WC.rotation()).vector()), 1) + 0.0).tolist()
    return (
        f"{note}; {shares[best]:.0%} with '{camera.name}' at X_PB: {{translation: {position}, "
        f"rotation: !Rpy {{deg: {angles}}}}} and segmentation: {{far: {camera.z_far:g}}}"
    )
