"""The simulated station and the models of its robot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from drake_oa.common.config import field_errors
from drake_oa.common.messages import FloatArray
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.geometry.collision_scene import RobotGeometries, robot_geometries
from drake_oa.perception.config import CameraSource
from drake_oa.robot.arm import Chain, make_chain
from drake_oa.robot.config import Robot
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant
from drake_oa.robot.spheres import ArmSpheres, make_arm_spheres
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.world.live_camera import ExternalInputs
from drake_oa.world.station import Station, make_station


@dataclass(frozen=True)
class StationModel(Station):
    """A station with the robot alone beside it, as the layers know it.

    Attributes:
        scenario: what it was made from.
        robot_plant: the robot alone.
        q_start: (nq,) its positions with E at the start.
    """

    scenario: Scenario
    robot_plant: RobotPlant
    q_start: FloatArray

    @cached_property
    def chain(self) -> Chain:
        """The joints of the arm."""
        plant, tool_frame = self.robot_plant.plant, self.robot_plant.tool_frame
        return make_chain(plant, tool_frame, self.q_start, self.spheres.arrays)

    @property
    def robot_shapes(self) -> RobotGeometries:
        """The robot's collision geometry, which perception does not take for an obstacle."""
        robot = self.robot_plant
        return robot_geometries(robot.plant, robot.scene_graph.model_inspector(), robot.instance)

    @property
    def spheres(self) -> ArmSpheres:
        """The robot as spheres."""
        return covered_arm(robot_of(self.scenario))


def add_station(
    signals: SignalBuilder,
    scenario: Scenario,
    *,
    avoid_obstacles: bool = True,
    external: ExternalInputs | None = None,
) -> StationModel | None:
    """Adds plant, scene graph and, where perception looks through them, the cameras.

    Offers robot_state, plant_state, query_object and body_poses, and of the camera depth_image,
    camera_pose, image_stamp and plant_state_at_image; of several cameras each of them with _NAME
    behind it.

    Args:
        signals: that are added to.
        scenario: what to build.
        avoid_obstacles: whether anything is seen.
        external: state and clocks for cameras outside the simulation.

    Returns:
        None without a robot.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    if scenario.robot is None:
        return None
    robot_plant = make_robot_plant(scenario.robot)
    source = scenario.perception
    sees = avoid_obstacles and isinstance(source, CameraSource)
    station = make_station(signals.builder, scenario, render=sees, external=external)
    q_start = start_positions(scenario)
    plant = station.plant
    plant.SetDefaultPositions(station.robot, q_start)
    signals.add_source("robot_state", plant.get_state_output_port(station.robot))
    signals.add_source("plant_state", plant.get_state_output_port())
    signals.add_source("body_poses", plant.get_body_poses_output_port())
    signals.add_source("query_object", station.scene_graph.get_query_output_port())
    if isinstance(source, CameraSource) and station.cameras:
        for name in source.names:
            camera = station.cameras[name]
            signals.add_source(source.signal("depth_image", name), camera.depth_image)
            signals.add_source(source.signal("camera_pose", name), camera.pose)
            signals.add_source(source.signal("image_stamp", name), camera.image_time)
            signals.add_source(source.signal("plant_state_at_image", name), camera.plant_state)
    return StationModel(
        **vars(station), scenario=scenario, robot_plant=robot_plant, q_start=q_start
    )


_COVERED: dict[tuple[str, RobotPlant], ArmSpheres] = {}
"""The robots of this process as spheres, which take seconds to make."""


def covered_arm(robot: Robot) -> ArmSpheres:
    """Returns the robot as spheres, as near as its block asks; made once.

    They are made at home: from where else would change their last bits, and with these what a
    process does later.

    Raises:
        ScenarioError: for a robot that cannot be covered.
    """
    robot_plant = make_robot_plant(robot)
    key = (repr(robot), robot_plant)
    if key not in _COVERED:
        with field_errors("robot", ValueError):
            q = home_positions(robot)
            _COVERED[key] = make_arm_spheres(robot_plant, q, tool_links(robot), robot.spheres)
    return _COVERED[key]
