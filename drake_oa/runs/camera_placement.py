"""Space near the arm that a scenario's cameras do not see."""

from __future__ import annotations

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.multibody.parsing import GetScopedFrameByName
from pydrake.multibody.plant import MultibodyPlant

from drake_oa.diagrams.station import covered_arm
from drake_oa.geometry.pinhole import pinhole
from drake_oa.perception.config import CameraSource
from drake_oa.perception.coverage import REACH, ViewVolume, unseen_share
from drake_oa.robot.arm import make_chain
from drake_oa.robot.plant import make_robot_plant
from drake_oa.robot.spheres import sphere_centers
from drake_oa.scenario.end_poses import end_positions, posture_guide
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.sources import camera_configs
from drake_oa.world.cameras import depth_intrinsics
from drake_oa.world.world_model import add_world

_CONFIGURATIONS = 5
"""Number of configurations between start and goal."""


def unseen_near(scenario: Scenario, source: CameraSource) -> float:
    """Computes the share that the cameras of perception do not see of the space near the arm.

    The arm is at the start, and along the pre-planned motion.
    """
    robot = robot_of(scenario)
    robot_plant, spheres = make_robot_plant(robot), covered_arm(robot).arrays
    q_start, q_goal = end_positions(scenario)
    chain = make_chain(robot_plant.plant, robot_plant.tool_frame, q_start, spheres)
    s = np.linspace(0.0, 1.0, _CONFIGURATIONS)
    q = posture_guide(s, q_start[chain.q_index], q_goal[chain.q_index])
    p_WS, views = sphere_centers(chain, spheres, q), view_volumes(scenario, source)
    return unseen_share(p_WS, spheres.radius, scenario.table_height, views)


def view_volumes(scenario: Scenario, source: CameraSource) -> list[ViewVolume]:
    """Computes the volumes in which the cameras of perception measure."""
    limits, volumes = source.segmentation, []
    scene_graph, plant = SceneGraph(), MultibodyPlant(time_step=scenario.plant_step)
    # Obstacles have visual geometry.
    plant.RegisterAsSourceForSceneGraph(scene_graph)
    add_world(plant, scenario)
    plant.Finalize()
    context = plant.CreateDefaultContext()
    for camera in camera_configs(scenario, source):
        seen = depth_intrinsics(camera)
        frame = GetScopedFrameByName(plant, camera.X_PB.base_frame or "world")
        X_WC = frame.CalcPoseInWorld(context) @ camera.X_PB.GetDeterministicValue()
        volumes.append(
            ViewVolume(
                X_WC.GetAsMatrix4(),
                np.array(pinhole(seen)),
                (seen.height(), seen.width()),
                max(camera.z_near, limits.near),
                min(camera.z_far, limits.far),
            )
        )
    return volumes


def view_note(scenario: Scenario) -> str:
    """Returns one line about the unseen share of the space near the arm; "" without cameras."""
    source = scenario.perception
    if not isinstance(source, CameraSource):
        return ""
    share = unseen_near(scenario, source)
    return f"cameras: {share:.0%} of the space within {REACH:g} m of the arm is unseen"
