"""The simulated station and the models of its robot."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from drake_oa.common.config import field_errors
from drake_oa.common.messages import FloatArray
from drake_oa.common.wires import Wires
from drake_oa.geometry.solids import RobotSolids, robot_solids
from drake_oa.perception.config import CameraSource
from drake_oa.robot.arm import Chain, make_chain
from drake_oa.robot.config import Robot
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant
from drake_oa.robot.spheres import ArmSpheres, make_arm_spheres
from drake_oa.scenario.end_poses import start_positions
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.world.live_camera import Outside
from drake_oa.world.station import Station, make_station


@dataclass(frozen=True)
class Cell(Station):
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
    def robot_shapes(self) -> RobotSolids:
        """The robot's collision geometry, which perception does not take for an obstacle."""
        robot = self.robot_plant
        return robot_solids(robot.plant, robot.scene_graph.model_inspector(), robot.instance)

    @property
    def spheres(self) -> ArmSpheres:
        """The robot as spheres."""
        return covered_arm(robot_of(self.scenario))


def add_station(
    wires: Wires, scenario: Scenario, *, modulated: bool = True, outside: Outside | None = None
) -> Cell | None:
    """Adds plant, scene graph and, where perception looks through them, the cameras.

    Offers robot_state, plant_state, query_object and body_poses, and of the camera depth_image,
    camera_pose, image_stamp and plant_state_at_image; of several cameras each of them with _NAME
    behind it.

    Args:
        wires: that are added to.
        scenario: what to build.
        modulated: whether anything is seen.
        outside: what cameras outside the simulation go by.

    Returns:
        None without a robot.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    if scenario.robot is None:
        return None
    robot_plant = make_robot_plant(scenario.robot)
    source = scenario.perception
    sees = modulated and isinstance(source, CameraSource)
    station = make_station(wires.builder, scenario, render=sees, outside=outside)
    q_start = start_positions(scenario)
    plant = station.plant
    plant.SetDefaultPositions(station.robot, q_start)
    wires.offer("robot_state", plant.get_state_output_port(station.robot))
    wires.offer("plant_state", plant.get_state_output_port())
    wires.offer("body_poses", plant.get_body_poses_output_port())
    wires.offer("query_object", station.scene_graph.get_query_output_port())
    if isinstance(source, CameraSource) and station.cameras:
        for name in source.names:
            camera = station.cameras[name]
            wires.offer(source.signal("depth_image", name), camera.depth_image)
            wires.offer(source.signal("camera_pose", name), camera.pose)
            wires.offer(source.signal("image_stamp", name), camera.image_time)
            wires.offer(source.signal("plant_state_at_image", name), camera.plant_state)
    return Cell(**vars(station), scenario=scenario, robot_plant=robot_plant, q_start=q_start)


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
