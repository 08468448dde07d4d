"""Check of a scenario's cameras: unobserved fraction of the space near the arm, and a pose of the
first camera with a smaller fraction.

A point is unobserved if no camera sees that it is free, that is, in front of the surface that the
camera measures.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.station import covered_arm
from drake_oa.geometry.pinhole import View, look_at_pose, pinhole
from drake_oa.perception.config import CameraSource, DepthCamera, RecordedBag
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
"""Unobserved fraction of the space within 0.4 m of the arm above which `view_note` suggests another
camera pose [-]."""
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
        T configurations (T, n) of the robot from start to goal [rad, m]; for each of them, grid
        points (N, 3) that sample the space near the arm (see `unobserved_near_arm`), in the world
        [m]; and the mean position (3,) of the spheres that cover the arm, over all configurations,
        in the world [m].
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


def observed_free_space(
    source: CameraSource, configs: Sequence[CameraConfig], images: Sequence[Rendered]
) -> FreeSpace:
    """Computes the space that the cameras of a scenario observe to be free at one instant, from
    rendered depth images.

    A pixel without a surface up to the maximum depth of its camera shows no free space, as in
    images of structured-light cameras. If `!DepthCamera` has exact images (`noise: null`), the
    pixel shows free space up to the maximum depth.

    Args:
        source: perception block of the scenario.
        configs: configurations of the cameras.
        images: rendered depth image (H, W) [m] and pose X_WC of each camera.

    Returns:
        Observed space, whose method `contains` checks which points in the world are in it.
    """
    too_far = np.inf if isinstance(source, DepthCamera) and source.noise is None else np.nan
    views = []
    for config, (depth, X_WC) in zip(configs, images, strict=True):
        K = np.array(pinhole(depth_intrinsics(config))) - [0.0, 0.0, PIXEL_CENTER, PIXEL_CENTER]
        views.append(View(np.where(np.isinf(depth), too_far, depth), K, X_WC.GetAsMatrix4()))
    ranges = tuple((config.z_near, config.z_far) for config in configs)
    return FreeSpace(tuple(views), ranges=ranges)


def _render(
    scenario: Scenario, config: CameraConfig, q: FloatArray, poses: Sequence[RigidTransform] = ()
) -> Iterator[list[Rendered]]:
    """Renders depth images of a camera in the initial world of a scenario.

    Args:
        scenario: scenario with a robot.
        config: configuration of the camera.
        q: (T, n) configurations of the robot [rad, m].
        poses: poses X_WC of the camera; empty: only the pose in `config`.

    Yields:
        For each pose, a list of T items, one for each configuration: the depth image (H, W) [m]
        and the pose X_WC of the camera.
    """
    plant, builder = MultibodyPlant(time_step=scenario.plant_step), DiagramBuilder()
    scene_graph = SceneGraph()
    # Obstacles have visual geometry.
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    robot = add_world(plant, scenario)
    plant.Finalize()
    sensor = add_camera(builder, scenario, config)
    diagram, plant_context = builder.Build(), plant.CreateDefaultContext()
    context = diagram.CreateDefaultContext()
    sensor_context = sensor.GetMyMutableContextFromRoot(context)
    image, pose = sensor.depth_image_32F_output_port(), sensor.body_pose_in_world_output_port()
    if poses:
        sensor.SetParentFrameId(sensor_context, SceneGraph.world_frame_id())
    for X_PB in poses or [sensor.GetX_PB(sensor_context)]:
        sensor.SetX_PB(sensor_context, X_PB)
        images = []
        for positions in q:
            plant.SetPositions(plant_context, robot, positions)
            state = plant.GetPositionsAndVelocities(plant_context)
            diagram.get_input_port().FixValue(context, state)
            depth = np.array(image.Eval(sensor_context).data[:, :, 0])
            images.append(Rendered(depth, RigidTransform(pose.Eval(sensor_context))))
        yield images


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
    """Computes the unobserved fraction of the space near the arm, along the nominal motion.

    A point is unobserved if none of the cameras of perception sees that it is free. The space is
    outside the arm and within 0.4 m of its surface. If there is a table, only points from the table
    to 0.75 m above it belong to the space. The fraction, in [0, 1], is the mean over five
    configurations of the arm. Images have no noise; obstacles are at their initial poses.

    Args:
        scenario: scenario with a robot and perception by cameras.
    """
    return next(_unobserved_fractions(scenario, *_motion_space(scenario)[:2]))


def _unobserved_fractions(
    scenario: Scenario,
    q: FloatArray,
    points: Sequence[FloatArray],
    poses: Sequence[RigidTransform] = (),
) -> Iterator[float]:
    """Computes the unobserved fraction of given points, for several poses of the first camera of
    perception.

    A point is unobserved if no camera sees that it is free.

    Args:
        scenario: scenario with perception by cameras.
        q: (T, n) configurations of the robot [rad, m].
        points: for each configuration, points (N, 3) in the world [m].
        poses: poses X_WC of the first camera; empty: only the pose in its configuration.

    Yields:
        For each pose, the fraction in [0, 1], as the mean over the T configurations.
    """
    source: Any = scenario.perception
    configs = camera_configs(scenario, source)
    others = [next(_render(scenario, config, q)) for config in configs[1:]]
    for first in _render(scenario, configs[0], q, poses):
        images = zip(first, *others, strict=True)
        spaces = [observed_free_space(source, configs, one) for one in images]
        yield unobserved_fraction(points, spaces)


def view_note(scenario: Scenario) -> str:
    """Returns one line of text with the unobserved fraction of the space near the arm.

    A point is unobserved if no camera sees that it is free. Above 15 %
    (`MAX_UNOBSERVED_FRACTION`), the line also suggests a pose of the first camera with a smaller
    fraction, or states that none of the evaluated poses has one. The line is empty if perception
    uses no cameras, or recorded images.
    """
    source = scenario.perception
    if not isinstance(source, CameraSource) or isinstance(source, RecordedBag):
        return ""
    q, points, center = _motion_space(scenario)
    share = next(_unobserved_fractions(scenario, q, points))
    note = f"cameras: {share:.0%} of the space within {REACH:g} m of the arm is unobserved"
    if share <= MAX_UNOBSERVED_FRACTION:
        return note
    directions = product(_AZIMUTHS, _ELEVATIONS)
    poses = [camera_pose_around(center, *direction, _DISTANCE) for direction in directions]
    shares = list(_unobserved_fractions(scenario, q, points, poses))
    best, camera = int(np.argmin(shares)), camera_configs(scenario, source)[0]
    if shares[best] >= share:
        return f"{note}; no pose of '{camera.name}' at a distance of {_DISTANCE:g} m observes more"
    position = np.round(poses[best].translation(), 2).tolist()
    rpy = np.degrees(RollPitchYaw(poses[best].rotation()).vector())
    angles = (np.round(rpy, 1) + 0.0).tolist()
    return (
        f"{note}; {shares[best]:.0%} with '{camera.name}' at X_PB: {{translation: {position}, "
        f"rotation: !Rpy {{deg: {angles}}}}} and segmentation: {{far: {camera.z_far:g}}}"
    )
