"""Function that adds the simulated station to a diagram, and models of the station's robot."""

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
    """Simulated station (robot, objects and cameras), with the robot models that the layers use.

    Attributes:
        scenario: configuration of the station.
        robot_plant: plant of the robot without its environment.
        q_start: (nq,) positions of all robot joints, fingers included, with the tool point E at the
            start of the task [rad, m].
    """

    scenario: Scenario
    robot_plant: RobotPlant
    q_start: FloatArray

    @cached_property
    def chain(self) -> Chain:
        """Kinematic chain of the arm for compiled forward and inverse kinematics."""
        plant, tool_frame = self.robot_plant.plant, self.robot_plant.tool_frame
        return make_chain(plant, tool_frame, self.q_start, self.spheres.arrays)

    @property
    def robot_shapes(self) -> RobotGeometries:
        """Collision geometry of the robot, with which perception removes points on the robot."""
        robot = self.robot_plant
        return robot_geometries(robot.plant, robot.scene_graph.model_inspector(), robot.instance)

    @property
    def spheres(self) -> ArmSpheres:
        """Spheres that cover the collision geometry of the robot, for the checks of clearance."""
        return covered_arm(robot_of(self.scenario))


def add_station(
    signals: SignalBuilder,
    scenario: Scenario,
    *,
    avoid_obstacles: bool = True,
    external: ExternalInputs | None = None,
) -> StationModel | None:
    """Adds plant, scene graph and, if perception uses cameras, the cameras to a diagram.

    The signals of the plant are robot_state, plant_state, query_object and body_poses. The signals
    of a camera are depth_image, camera_pose, image_stamp and plant_state_at_image, with the suffix
    _NAME if there are several cameras.

    Args:
        signals: builder that receives the systems.
        scenario: configuration of the station.
        avoid_obstacles: whether the diagram avoids obstacles; False: no cameras are added.
        external: measured plant state, and clocks, for cameras outside the simulation; None: the
            state of the simulated plant and the wall clock.

    Returns:
        Station with the robot models; None for a scenario without a robot.

    Raises:
        ScenarioError: if the scenario is invalid; names the field.
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
"""Cache of the spheres that cover the collision geometry of each robot.

A key contains the robot's configuration block as text, and the plant that contains only the robot.
Computing the spheres requires seconds."""


def covered_arm(robot: Robot) -> ArmSpheres:
    """Returns spheres that cover a robot's collision geometry.

    The field `robot.spheres` sets how far the spheres protrude from the surfaces. The spheres are
    computed once per process, always in the home configuration, because rounding depends on the
    configuration. With the start of the first scenario instead, results of later scenarios in the
    process would depend on this start.

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
