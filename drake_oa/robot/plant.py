"""Plant of the robot alone, without obstacles, and limits of its joints.

The controller uses this plant as its model. The self filter, which removes the robot from depth
images, uses it for kinematics and shapes.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import PackageMap, Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, ModelInstanceIndex, RevoluteJoint
from pydrake.systems.framework import Diagram, DiagramBuilder

from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.common.files import package_file
from drake_oa.common.messages import FloatArray, zeros
from drake_oa.geometry.collision_scene import outline_corners, read_geometry
from drake_oa.geometry.shapes import pose
from drake_oa.robot.arm import check_actuated, joints_to
from drake_oa.robot.config import Robot
from drake_oa.robot.formats.model_file import (
    add_installed_package,
    converted_model,
    named_warnings,
    with_file_name,
)
from drake_oa.robot.grasped_object import add_carried, exclude_grasp_contacts, tool_links
from drake_oa.robot.inertias import set_inertias

_logger = logging.getLogger("drake_oa")
TOOL_FRAME = "tool_point"
"""Name of the tool frame E, at the tool point between the fingertips, in each plant with a
robot."""


def known_packages() -> PackageMap:
    """Returns a package map with the packages of Drake and the package `package://drake_oa`."""
    packages = PackageMap()
    packages.AddPackageXml(str(package_file("package://drake_oa/package.xml")))
    return packages


def make_parser(plant: MultibodyPlant) -> Parser:
    """Creates a parser of model files for a plant, which can resolve URLs package://drake_oa/... in
    addition to Drake's packages.
    """
    parser = Parser(plant)
    parser.package_map().AddMap(known_packages())
    return parser


def add_robot(plant: MultibodyPlant, robot: Robot, *, inertias: str = "") -> ModelInstanceIndex:
    """Adds the robot to a plant, with its base welded to the world, its tool frame E, and its
    grasped object.

    Args:
        plant: plant that is not finalized.
        robot: configuration of the robot.
        inertias: URL or name of a file of inertial parameters, which replace those of the model;
            empty: the parameters of the model are used.

    Returns:
        Model instance of the robot.

    Raises:
        ScenarioError: naming the invalid field of the robot's configuration.
    """
    parser = make_parser(plant)
    packages = parser.package_map()
    add_installed_package(packages, robot.model)
    with field_errors(f"robot.model: cannot load '{robot.model}'", RuntimeError):
        file = Path(packages.ResolveUrl(_url(robot.model)))
    root = converted_model(file, packages)
    if inertias:
        field = f"faults: !ModelError.inertias: '{inertias}'"
        with field_errors(field, RuntimeError, OSError, ScenarioError):
            set_inertias(root, Path(packages.ResolveUrl(_url(inertias))))
    try:
        with named_warnings(file):
            if root is None:
                (instance,) = parser.AddModels(str(file))
            else:
                text = ElementTree.tostring(root, encoding="unicode")
                (instance,) = parser.AddModelsFromString(text, file.suffix[1:].lower())
    except (RuntimeError, ValueError) as error:
        reason = with_file_name(str(error), file)
        raise ScenarioError(f"robot.model: cannot load '{robot.model}': {reason}") from None
    for name, link in (("base_link", robot.base_link), ("hand_link", robot.hand_link)):
        if not plant.HasBodyNamed(link, instance):
            names = [plant.get_body(i).name() for i in plant.GetBodyIndices(instance)]
            raise ScenarioError(
                f"robot.{name}: '{robot.model}' has no link '{link}'; it has {', '.join(names)}"
            )
    base = plant.GetFrameByName(robot.base_link, instance)
    plant.WeldFrames(plant.world_frame(), base, base_pose(robot))
    plant.AddFrame(
        FixedOffsetFrame(
            TOOL_FRAME, plant.GetFrameByName(robot.hand_link, instance), RigidTransform(robot.p_HE)
        )
    )
    _limit_speed(plant, instance, robot)
    add_carried(plant, instance, robot)
    return instance


def _limit_speed(plant: MultibodyPlant, instance: ModelInstanceIndex, robot: Robot) -> None:
    """Reduces the speed limits of the arm's joints to `robot.joint_speed`.

    The arm's joints are the first moving joints of the model.

    Raises:
        ScenarioError: if the number of speeds is not the number of the arm's joints.
    """
    if robot.joint_speed is None:
        return
    joints = [plant.get_joint(i) for i in plant.GetJointIndices(instance)]
    moving = [joint for joint in joints if joint.num_velocities()]
    if len(robot.joint_speed) != len(robot.q_seed) or len(moving) < len(robot.q_seed):
        raise ScenarioError(
            f"robot.joint_speed: expected {len(robot.q_seed)} numbers, as in robot.q_seed, not "
            f"{len(robot.joint_speed)}"
        )
    for joint, speed in zip(moving, robot.joint_speed, strict=False):
        limit = np.minimum(joint.velocity_upper_limits(), speed)
        joint.set_velocity_limits(-limit, limit)


def base_pose(robot: Robot | None) -> RigidTransform:
    """Returns the pose X_WB of the robot's base in the world; the identity if there is no robot."""
    return RigidTransform() if robot is None else pose(robot.X_WB)


def _url(url_or_file: str) -> str:
    """Returns the URL of a model file, given a URL, which is returned unchanged, or a file name."""
    # Drake does not decode percent signs, as of `Path.as_uri`.
    return url_or_file if "://" in url_or_file else f"file://{Path(url_or_file).absolute()}"


@dataclass(frozen=True, eq=False)
class RobotLimits:
    """Names and limits of the joints of a robot; all arrays are empty if there is no robot.

    Attributes:
        position_name: (nq,) names of the joint positions.
        position_lower: (nq,) lower position limits [rad, m].
        position_upper: (nq,) upper position limits [rad, m].
        velocity_limit: (nv,) maximum speeds [rad/s, m/s]; inf: no limit.
        actuator_name: (nu,) name of the joint of each actuator.
        effort_limit: (nu,) maximum actuation [N m, N]; inf: no limit.
    """

    position_name: tuple[str, ...] = ()
    position_lower: FloatArray = zeros(0)
    position_upper: FloatArray = zeros(0)
    velocity_limit: FloatArray = zeros(0)
    actuator_name: tuple[str, ...] = ()
    effort_limit: FloatArray = zeros(0)

    @property
    def note(self) -> str:
        """Warning that names joints without a limit of speed or torque; "" if there are none."""
        names = [f"speed of {name}" for name in self.position_name]
        names += [f"torque of {name}" for name in self.actuator_name]
        is_unlimited = np.isinf(np.append(self.velocity_limit, self.effort_limit))
        unlimited = ", ".join(np.array(names)[is_unlimited])
        return f"robot.model: no limit of {unlimited}" if unlimited else ""


@dataclass(frozen=True, eq=False)
class RobotPlant:
    """Plant of the robot alone, for kinematics and control, as `make_robot_plant` creates it.

    All users of a robot configuration share one plant, which must not be modified; each user
    creates its own Context.

    Attributes:
        diagram: diagram of the plant and its scene graph.
        plant: finalized plant of the robot.
        scene_graph: scene graph of the plant.
        instance: model instance of the robot.
    """

    diagram: Diagram
    plant: MultibodyPlant
    scene_graph: SceneGraph
    instance: ModelInstanceIndex

    @property
    def tool_frame(self) -> Frame:
        """Tool frame E of the plant, at the tool point."""
        return self.plant.GetFrameByName(TOOL_FRAME)

    @property
    def limits(self) -> RobotLimits:
        """Names of the robot's joints and actuators in the order of the plant, with limits of
        position, velocity and effort.
        """
        plant, robot = self.plant, self.instance
        actuators = [plant.get_joint_actuator(i) for i in plant.GetJointActuatorIndices(robot)]
        return RobotLimits(
            position_name=tuple(plant.GetPositionNames(robot, always_add_suffix=False)),
            position_lower=plant.GetPositionsFromArray(robot, plant.GetPositionLowerLimits()),
            position_upper=plant.GetPositionsFromArray(robot, plant.GetPositionUpperLimits()),
            velocity_limit=plant.GetVelocitiesFromArray(robot, plant.GetVelocityUpperLimits()),
            actuator_name=tuple(actuator.joint().name() for actuator in actuators),
            effort_limit=np.array([actuator.effort_limit() for actuator in actuators]),
        )

    def tool_poses(self, q: FloatArray) -> list[RigidTransform]:
        """Computes the poses X_WE of the tool frame at configurations q (T, nq) of the robot [rad,
        m].
        """
        context, poses = self.plant.CreateDefaultContext(), []
        for positions in q:
            self.plant.SetPositions(context, self.instance, positions)
            poses.append(self.tool_frame.CalcPoseInWorld(context))
        return poses

    def tool_path(self, q: FloatArray) -> FloatArray:
        """Computes the positions p_WE (T, 3) of the tool point at configurations q (T, nq) of the
        robot [m].
        """
        return np.array([X_WE.translation() for X_WE in self.tool_poses(q)]).reshape(-1, 3)


_PLANTS: dict[tuple[str, str], RobotPlant] = {}
"""Cache of the robot plants that this process has created, by robot configuration and file of
inertial parameters."""


def make_robot_plant(robot: Robot, *, inertias: str = "") -> RobotPlant:
    """Returns the plant of the robot alone, with its base link welded to the world at the pose
    `robot.X_WB`.

    The model of each configuration is parsed once per process, and its plant is shared.

    Args:
        robot: configuration of the robot.
        inertias: URL or name of a file of inertial parameters, which replace those of the model
            (see `drake_oa.robot.inertias`); empty: the parameters of the model are used.

    Raises:
        ScenarioError: naming the invalid field of the robot's configuration.
    """
    key = repr(robot), inertias
    if key not in _PLANTS:
        _PLANTS[key] = _parse(robot, inertias)
    return _PLANTS[key]


def _parse(robot: Robot, inertias: str) -> RobotPlant:
    """Builds the plant of a robot from its model file, and checks that `robot.q_seed` has a value
    within the limits for each joint of the arm. Joints without a limit of speed or torque are
    logged.

    Args:
        robot: configuration of the robot.
        inertias: URL or name of a file of inertial parameters, which replace those of the model;
            empty: the parameters of the model are used.

    Raises:
        ScenarioError: naming the invalid field of the robot's configuration.
    """
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, time_step=0.0)
    with field_errors("robot.base_link", RuntimeError):
        instance = add_robot(plant, robot, inertias=inertias)
        plant.Finalize()
    with field_errors("robot.model", ValueError):
        arm = joints_to(plant, plant.GetFrameByName(TOOL_FRAME))
        _check_joints(plant, arm)
    n = len(arm)
    lower, upper = plant.GetPositionLowerLimits()[:n], plant.GetPositionUpperLimits()[:n]
    if len(robot.q_seed) != n or np.clip(robot.q_seed, lower, upper).tolist() != robot.q_seed:
        raise ScenarioError(
            f"robot.q_seed: expected {n} numbers, of {', '.join(joint.name() for joint in arm)}, "
            f"between {lower.tolist()} and {upper.tolist()} rad, not {robot.q_seed}"
        )
    exclude_grasp_contacts(plant, scene_graph, robot)
    robot_plant = RobotPlant(builder.Build(), plant, scene_graph, instance)
    if note := robot_plant.limits.note:
        _logger.warning("%s", note)
    return robot_plant


def _check_joints(plant: MultibodyPlant, arm: Sequence[RevoluteJoint]) -> None:
    """Checks the joints of a robot's model.

    Args:
        plant: finalized plant of the robot.
        arm: joints of the arm, from base to tool.

    Raises:
        ValueError: if no joint moves the tool, if the joints of the arm are not the first ones of
            the plant, if a joint has no actuator or a speed limit of 0, or if a joint moves a link
            without mass. The mass of a link includes the links that are welded to it.
    """
    if not arm:
        raise ValueError("no joint between robot.base_link and robot.hand_link moves")
    for row, joint in enumerate(arm):
        if joint.position_start() != row:
            raise ValueError(f"joint '{joint.name()}' of the arm must precede all other joints")
    check_actuated(plant)
    massless: list[str] = []
    for joint in map(plant.get_joint, plant.GetJointIndices()):
        if (joint.velocity_upper_limits() <= 0.0).any():
            raise ValueError(f"joint '{joint.name()}' has no speed: its limit must be above 0")
        links = plant.GetBodiesWeldedTo(joint.child_body()) if joint.num_velocities() else []
        if not sum(link.default_mass() for link in links) > 0.0:
            massless += [link.name() for link in links]
    if massless:
        raise ValueError(f"links move without mass: {', '.join(massless)}; add <inertial> elements")


def tool_link_corners(robot: Robot) -> list[FloatArray]:
    """Computes the corners of each tool link with collision geometry relative to the tool point E,
    as a list of arrays (K_i, 3) in world axes [m].

    The corners are used to dilate obstacles by the tool. They are those of the collision geometry
    of `robot.tool_links` and `robot.carried`, with the tool in the orientation `robot.rpy_WE` and
    the finger joints at `robot.finger_opening`. The corners of a rounded shape are those of its
    bounding box.

    Raises:
        ScenarioError: for a link that the last joint of the arm does not move, or if no tool link
            has collision geometry.
    """
    robot_plant = make_robot_plant(robot)
    plant, inspector = robot_plant.plant, robot_plant.scene_graph.model_inspector()
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, robot_plant.instance, home_positions(robot))
    R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix()
    X_EW = robot_plant.tool_frame.CalcPoseInWorld(context).inverse()
    last = joints_to(plant, robot_plant.tool_frame)[-1].index()
    moved = [plant.get_body(i).name() for i in plant.GetBodiesKinematicallyAffectedBy([last])]
    corners = []
    for link in tool_links(robot):
        if link not in moved:
            valid = ", ".join(moved)
            raise ScenarioError(f"robot.tool_links: the last joint moves {valid}, but not '{link}'")
        body = plant.GetBodyByName(link, robot_plant.instance)
        X_EB = X_EW @ plant.EvalBodyPoseInWorld(context, body)
        with field_errors("robot.tool_links", ValueError):
            geometries = [
                read_geometry(inspector, geometry_id)
                for geometry_id in plant.GetCollisionGeometriesForBody(body)
            ]
            points = [geometry.placed(outline_corners(geometry)).T for geometry in geometries]
        if points:
            corners.append(np.hstack([R_WE @ X_EB.multiply(p_BQ) for p_BQ in points]).T)
    if not corners:
        raise ScenarioError(
            f"robot.tool_links: {robot.tool_links} have no collision geometry; the model needs a "
            "<collision> on one of them"
        )
    return corners


def home_positions(robot: Robot) -> FloatArray:
    """Returns the configuration (nq,) with the arm at `robot.q_seed` and each finger at
    `robot.finger_opening` [rad, m].
    """
    q = np.full(make_robot_plant(robot).plant.num_positions(), robot.finger_opening)
    q[: len(robot.q_seed)] = robot.q_seed
    return q
