"""Where the depth cameras of studied scenes stand, that are not a shipped scenario's.

All are ASUS Xtions as the shipped scenarios have them: 640 x 480 pixels, 58 x 45 degrees, what is
nearer than 0.8 m is not seen, 30 images a second that come 30 ms late, with the published noise.

- `with_opposite`: a second camera where the first one of a scenario stands, turned by half a circle
  about the vertical line through the middle of the workspace, (0.45, 0): behind the robot's base.
- `with_two`: left and right of the way from the robot to what is to be done, see there.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace

import numpy as np
from pydrake.common.schema import Transform
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import pose
from drake_oa.geometry.solids import Solids, least_distances, shape_solids, solids_of
from drake_oa.perception.config import CameraNoise, DepthCamera
from drake_oa.robot.plant import base_pose
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import camera_configs
from drake_oa.world.world_model import add_world

WORKSPACE = (0.45, 0.0)
"""Middle of the workspace over a table [m]."""
AWAY = 1.2
"""From a camera to the middle of what it looks at [m]."""
ASIDE = math.radians(60.0)
"""From the way to the robot to that to a camera, seen from above [rad]."""
ELEVATIONS = tuple(math.radians(degrees) for degrees in (35.0, 50.0, 65.0, 80.0, 20.0))
"""Of a camera over the middle, the first that fits [rad]."""
APART = 0.15
"""What a camera, and its first 0.8 m of sight to the middle, keep to things [m]."""
_NEAREST = 0.8


def xtion(name: str, X_WC: RigidTransform) -> CameraConfig:
    """Makes a camera (x right, y down, z forward) at a pose in the world."""
    camera = copy.deepcopy(load_scenario("tabletop_box").cameras[0])
    camera.name, camera.X_PB = name, Transform(X_WC)
    return camera


def looking_at(p_WC: FloatArray, p_WT: FloatArray) -> RigidTransform:
    """Pose of a camera at a place that looks at another, its x axis level."""
    z = np.subtract(p_WT, p_WC) / np.linalg.norm(np.subtract(p_WT, p_WC))
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    return RigidTransform(RotationMatrix(np.column_stack([x, np.cross(z, x), z])), p_WC)


def with_opposite(scenario: Scenario) -> Scenario:
    """The scenario, seen by a second camera too, see above; it must be seen by one already.

    Raises:
        ValueError: if it is not.
    """
    source = scenario.perception
    if not isinstance(source, DepthCamera) or len(source.names) != 1:
        raise ValueError("a second camera needs a scenario that is seen by one depth camera")
    scenario = copy.deepcopy(scenario)
    (first,) = camera_configs(scenario, source)
    X_WC, middle = camera_pose(scenario, first), np.array([*WORKSPACE, 0.0])
    half = RotationMatrix.MakeZRotation(math.pi)
    p_WC = middle + half @ (X_WC.translation() - middle)
    second = copy.deepcopy(first)
    second.name = "opposite"
    second.X_PB = Transform(RigidTransform(half @ X_WC.rotation(), p_WC))
    scenario.cameras.append(second)
    cameras = [first.name, second.name]
    scenario.perception = replace(source, camera=DepthCamera.camera, cameras=cameras)
    return scenario


def with_two(scenario: Scenario) -> Scenario:
    """The scenario, seen by two cameras in place of what it is seen by.

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
    things = solids_of(
        [
            solid
            for thing in scenario.obstacles
            for solid in shape_solids(thing.shapes, pose(thing).GetAsMatrix4())
        ]
    )
    places = {
        name: _place(middle, toward + side * ASIDE, things)
        for name, side in (("left", -1.0), ("right", 1.0))
    }
    scenario.cameras = [xtion(name, looking_at(p_WC, middle)) for name, p_WC in places.items()]
    scenario.perception = DepthCamera(cameras=list(places), noise=CameraNoise())
    return scenario


def _place(middle: FloatArray, heading: float, things: Solids) -> FloatArray:
    """(3,) where a camera stands that looks at the middle [m]."""
    found = middle
    for elevation in ELEVATIONS:
        level = math.cos(elevation)
        way = np.array([level * math.cos(heading), level * math.sin(heading), math.sin(elevation)])
        found = middle + AWAY * way
        sight = found - np.linspace(0.0, _NEAREST, 9)[:, None] * way
        if (least_distances(things, sight, 0.0, APART, APART) >= APART).all():
            return found
    # None fits: what stands in its way is seen from near, or not at all.
    return found


def camera_pose(scenario: Scenario, camera: CameraConfig) -> RigidTransform:
    """Computes the pose in the world of a camera of a scenario."""
    scene_graph, plant = SceneGraph(), MultibodyPlant(time_step=scenario.plant_step)
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    add_world(plant, scenario)
    plant.Finalize()
    frame = GetScopedFrameByName(plant, camera.X_PB.base_frame or "world")
    X_WP = frame.CalcPoseInWorld(plant.CreateDefaultContext())
    return X_WP @ camera.X_PB.GetDeterministicValue()
