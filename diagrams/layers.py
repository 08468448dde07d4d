"""The systems of a scenario: each function makes one layer from its part of the data.

Perception, decision and action; the layers of the robot are in `drake_oa.diagrams.robot_layers`.
"""

from __future__ import annotations

import logging
import math
from pathlib import Path
from typing import cast

import numpy as np
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain, TrajectorySource
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.messages import EllipsoidSet, FloatArray, TablePlane
from drake_oa.common.schema_check import ScenarioError
from drake_oa.descriptor.convex_decomposition import merged_parts
from drake_oa.descriptor.ellipsoid_descriptor import EllipsoidDescriptor
from drake_oa.descriptor.given_ellipsoids import GivenEllipsoidSource
from drake_oa.geometry.collision_shapes import RobotModel, collect_collision_shapes
from drake_oa.perception.depth_perception import DepthPerception
from drake_oa.perception.ground_truth_perception import GroundTruthPerception
from drake_oa.perception.hidden_sides_system import HiddenSides
from drake_oa.perception.point_cloud import SegmentationConfig
from drake_oa.perception.recorded_perception import RecordedPerception
from drake_oa.policy.action import ActionParameters
from drake_oa.policy.coupling import GuidanceForm
from drake_oa.policy.dmp import Dmp, imitate, minimum_jerk, trajectory
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.regulation.regressor import load_chain
from drake_oa.regulation.regressor_chain import RegressorChain
from drake_oa.regulation.verification import SearchParameters
from drake_oa.regulation.verified_regressor_chain import RobotArm, VerifiedRegressorChain
from drake_oa.robot.arm_model import make_arm_model
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant, tool_link_corners
from drake_oa.robot.reachability import Reachability, reachability
from drake_oa.robot.workspace import tool_down_annulus
from drake_oa.route.cost_ring_selector import CostRingSelector
from drake_oa.scenario.camera_noise import noise_parameters
from drake_oa.scenario.demonstration import read_demonstration
from drake_oa.scenario.loading import package_file
from drake_oa.scenario.perception import segmentation_config
from drake_oa.scenario.scenario import (
    DepthCamera,
    GivenEllipsoids,
    GroundTruth,
    Policy,
    RecordedClouds,
    Regressor,
    Scenario,
    Verified,
)
from drake_oa.scenario.task import goal_trajectory
from drake_oa.scenario.tool_orientation import held_robots, tool_orientation
from drake_oa.viewing.meshcat_overlay import MeshcatOverlay, dress_scene
from drake_oa.world.depth_noise_system import DepthNoise
from drake_oa.world.station import OBSTACLE_PREFIX, Station

_logger = logging.getLogger("drake_oa")

_PANDA = "panda_arm_hand.urdf"
_TOOL_DOWN_ANGLE = math.radians(15.0)
"""How far from straight down the tool may point for the tool-down workspace to hold."""
PIXEL_CENTER = 0.5
"""Where Drake's VTK renderer samples the first pixel: at its centre [pixel]."""
_LEAST_STEPS, _MOST_STEPS = 250, 1000
"""Steps of a roll-out a unit of normalised time."""


def make_dmp(scenario: Scenario) -> Dmp:
    """The movement primitive of the task: a demonstrated path, or minimum jerk.

    Raises:
        ScenarioError: naming the file, if the demonstration cannot be read.
    """
    task, policy = scenario.task, scenario.policy
    if task.demonstration:
        shown = read_demonstration(task)
        path, t = shown.path, shown.t
    else:
        path, t = minimum_jerk(task.start, task.goal, duration=task.duration)
    try:
        return imitate(
            path,
            t,
            n_basis=policy.n_basis,
            alpha_x=policy.alpha_x,
            beta_x=policy.beta_x,
            alpha_k=policy.alpha_k,
        )
    except ValueError as error:
        field = f"task.demonstration: '{task.demonstration}'" if task.demonstration else "policy"
        raise ScenarioError(f"{field}: {error}") from None


def make_perception(
    scenario: Scenario, station: Station | None, robot_plant: RobotPlant | None
) -> LeafSystem:
    """The perception source that the scenario's tagged block asks for."""
    source = scenario.perception
    if isinstance(source, GivenEllipsoids):
        return GivenEllipsoidSource(given_ellipsoids(source))
    if station is None or robot_plant is None:
        raise ScenarioError(f"perception: !{type(source).__name__} needs a robot")
    _warn_without_obstacles(station)
    if isinstance(source, GroundTruth):
        return GroundTruthPerception(
            station.plant,
            station.scene_graph.model_inspector(),
            station.obstacles,
            table=table_plane(scenario),
            period=source.period,
        )
    prior = {} if scenario.table_height is None else {"table_height": scenario.table_height}
    robot = collect_collision_shapes(
        robot_plant.plant, robot_plant.scene_graph.model_inspector(), robot_plant.instance
    )
    if isinstance(source, RecordedClouds):
        return _recorded_perception(
            source, segmentation_config(source.segmentation, **prior), robot
        )
    camera = camera_config(scenario, source)
    return DepthPerception(
        station.cameras[source.camera].intrinsics,
        config=segmentation_config(source.segmentation, **prior),
        robot=robot,
        pixel_center=PIXEL_CENTER,
        period=1.0 / camera.fps,
        delay=station.cameras[source.camera].delay,
    )


def make_robot_state(station: Station) -> MatrixGain:
    """The robot's state [q, v] out of the whole plant's."""
    plant, robot = station.plant, station.robot
    n_q, n_v = plant.num_positions(robot), plant.num_velocities(robot)
    D = np.zeros((n_q + n_v, plant.num_multibody_states()))
    q = plant.GetPositionsFromArray(robot, np.arange(plant.num_positions()))
    v = plant.GetVelocitiesFromArray(robot, np.arange(plant.num_velocities()))
    D[np.arange(n_q), q.astype(int)] = 1.0
    D[n_q + np.arange(n_v), plant.num_positions() + v.astype(int)] = 1.0
    return MatrixGain(D)


def make_depth_noise(scenario: Scenario, station: Station) -> DepthNoise | None:
    """The noise of the camera that perception looks through.

    None for an ideal one, and for one whose images come late: they are made with it.
    """
    source = scenario.perception
    if not isinstance(source, DepthCamera) or source.noise is None:
        return None
    camera = station.cameras[source.camera]
    if camera.delay > 0.0:
        return None
    return DepthNoise(
        camera.intrinsics, parameters=noise_parameters(source.noise), seed=scenario.seed
    )


def _warn_without_obstacles(station: Station) -> None:
    if station.obstacles:
        return
    count = station.plant.num_model_instances()
    names = [station.plant.GetModelInstanceName(ModelInstanceIndex(i)) for i in range(2, count)]
    _logger.warning(
        "directives: no model instance is named '%s...': ground truth sees no obstacle, and "
        "none is reported on; there are %s",
        OBSTACLE_PREFIX,
        ", ".join(names),
    )


def _recorded_perception(
    source: RecordedClouds, config: SegmentationConfig, robot: RobotModel
) -> RecordedPerception:
    X_WC = _camera_pose(source)
    try:
        perception = RecordedPerception(
            source.folder,
            X_WC=X_WC,
            config=config,
            robot=robot,
            period=source.period,
            loop=source.loop,
        )
    except (OSError, ValueError) as error:
        raise ScenarioError(f"perception.folder: {error}") from None
    if X_WC is None and perception.files_without_pose:
        # By the table alone the scene would lie somewhere else than the robot.
        raise ScenarioError(
            f"perception.X_WC: '{perception.files_without_pose[0]}' holds no X_WC, and the robot "
            "must know where the camera was: give 'X_WC: {translation: [x, y, z], "
            "rotation: !Rpy {deg: [r, p, y]}}', or 'X_WC: {}' for a cloud in the world frame"
        )
    return perception


def _camera_pose(source: RecordedClouds) -> RigidTransform | None:
    if source.X_WC is None:
        return None
    if source.X_WC.base_frame not in (None, "", "world"):
        raise ScenarioError(
            f"perception.X_WC.base_frame: '{source.X_WC.base_frame}' is not valid here; "
            "the pose is in the world frame: leave it out"
        )
    if not source.X_WC.IsDeterministic():
        raise ScenarioError("perception.X_WC: is random; it must be the one pose the camera had")
    return source.X_WC.GetDeterministicValue()


def make_ellipsoid_descriptor(scenario: Scenario, robot_plant: RobotPlant) -> EllipsoidDescriptor:
    """The descriptor, which dilates by the robot's tool, in each of the ways it is held."""
    if scenario.robot is None:
        raise ScenarioError("robot: the descriptor needs a tool; this scenario has null")
    task = scenario.task
    held = [tool_link_corners(robot_plant, robot) for robot in held_robots(scenario)]
    links = [np.concatenate(of_link) for of_link in zip(*held, strict=True)]
    return EllipsoidDescriptor(
        np.concatenate(links),
        # A goal that moves comes by a port.
        free_W=[task.start] if task.goal_moves else [task.start, task.goal],
        tool_parts=merged_parts(links),
        turn_axis_W=(0.0, 0.0, 1.0) if scenario.policy.turn is None else scenario.policy.turn.axis,
    )


def make_hidden_sides(scenario: Scenario) -> HiddenSides:
    """What gives moving obstacles the side that a camera does not see."""
    return HiddenSides(period=perception_period(scenario))


def make_goal(scenario: Scenario) -> LeafSystem:
    """What says where the goal is: it stays, or is moved in steps; one port of size 3 [m]."""
    if not scenario.task.goal_moves:
        return ConstantVectorSource(np.asarray(scenario.task.goal))
    return TrajectorySource(goal_trajectory(scenario.task))


def camera_config(scenario: Scenario, source: DepthCamera) -> CameraConfig:
    """Of the camera that perception sees by."""
    return next(config for config in scenario.cameras if config.name == source.camera)


def given_ellipsoids(source: GivenEllipsoids) -> EllipsoidSet:
    """The ellipsoids of a `!GivenEllipsoids` block; they are never out of date."""
    items = source.ellipsoids
    return EllipsoidSet(
        stamp=np.inf,
        p_WO=np.array([item.center for item in items], dtype=float).reshape(-1, 3),
        R_WO=np.array(
            [RollPitchYaw(item.rpy).ToRotationMatrix().matrix() for item in items]
        ).reshape(-1, 3, 3),
        semi_axes=np.array([item.semi_axes for item in items], dtype=float).reshape(-1, 3),
        v_WO=np.zeros((len(items), 3)),
        ids=np.arange(len(items)),
    )


def table_plane(scenario: Scenario) -> TablePlane | None:
    """The table that the scenario tells of, in the world; None where it has none."""
    return None if scenario.table_height is None else TablePlane(offset=scenario.table_height)


def make_regressor_chain(
    scenario: Scenario, arm: RobotArm | None = None
) -> RegressorChain | VerifiedRegressorChain:
    """The regulation that the scenario asks for, with its weights.

    Args:
        scenario: which.
        arm: what plans the posture of the robot's arm; None: nothing does.

    Raises:
        ScenarioError: naming the file, if the weights are missing or do not fit.
    """
    policy, clearance = scenario.policy, scenario.task.clearance
    try:
        weights = load_chain(package_file(policy.weights))
    except (OSError, ValueError) as error:
        raise ScenarioError(f"policy.weights: {error}") from None
    unit = weights.metadata.get("units", {}).get("alpha", "1/T")
    if unit != "1/T":
        raise ScenarioError(
            f"policy.weights: {policy.weights} counts alpha in {unit}, for the released code's "
            "action level; the policy needs a chain of `drake-oa train --recipe project`"
        )
    if isinstance(scenario.regulation, Regressor):
        return RegressorChain(weights, clearance)
    dmp = make_dmp(scenario)
    return VerifiedRegressorChain(
        weights,
        dmp,
        clearance,
        period=perception_period(scenario),
        parameters=search_parameters(scenario.regulation, policy, dmp),
        table_height=policy.table_height,
        annulus=held_annulus(scenario),
        arm=arm,
        thinking=scenario.thinking,
        step=policy.period,
        # What was demonstrated is not to be begun again from its middle.
        begins_anew=not scenario.task.demonstration
        and policy.turn is None
        and (scenario.robot is None or tool_orientation(scenario) is None),
    )


def search_parameters(regulation: Verified, policy: Policy, dmp: Dmp) -> SearchParameters:
    """How far the search of a verified motion goes."""
    # A step of a roll-out is one of the policy, where that is neither coarse nor costly.
    steps = round(dmp.duration / policy.period)
    return SearchParameters(
        candidates=regulation.candidates,
        rounds=regulation.rounds,
        polish=regulation.polish,
        retries=regulation.retries,
        slack=regulation.slack,
        steps=min(max(steps, _LEAST_STEPS), _MOST_STEPS),
        fade=policy.fade,
    )


def perception_period(scenario: Scenario) -> float:
    """Time between observations [s]."""
    source = scenario.perception
    if isinstance(source, DepthCamera):
        return 1.0 / camera_config(scenario, source).fps
    if isinstance(source, GivenEllipsoids):
        return scenario.policy.route_period
    return source.period


def make_cost_ring_selector(scenario: Scenario) -> CostRingSelector:
    """The route selection; what the robot reaches is mapped by inverse kinematics.

    Of a tool that turns on the way, what it reaches as at the start or as at the goal counts.
    """
    policy = scenario.policy
    held = held_robots(scenario)
    ends = {id(robot): robot for robot in (held[0], held[-1])} if held else {}
    reach = [found for found in map(robot_reachability, ends.values()) if found is not None]

    def workspace(p_WQ: FloatArray) -> FloatArray:
        return np.asarray(np.max([each.reach_margin(p_WQ) for each in reach], axis=0))

    def joint_limits(p_WQ: FloatArray) -> FloatArray:
        return np.asarray(np.max([each.joint_margin(p_WQ) for each in reach], axis=0))

    return CostRingSelector(
        scenario.task.clearance,
        period=policy.route_period,
        n_directions=policy.ring_directions,
        table_height=policy.table_height,
        workspace=workspace if reach else None,
        joint_limits=joint_limits if reach else None,
        followed=reach[0].followed if len(ends) == len(reach) == 1 else None,
    )


def robot_reachability(robot: Robot | None) -> Reachability | None:
    """Where the robot can hold its tool; None without a robot, or where it is not known.

    It takes a second or two for each robot and tool orientation, once a process.
    """
    if robot is None:
        return None
    robot_plant = make_robot_plant(robot)
    try:
        arm = make_arm_model(
            robot_plant.plant,
            robot_plant.scene_graph.model_inspector(),
            robot_plant.tool_frame,
            RollPitchYaw(robot.rpy_WE).ToRotationMatrix(),
            home_positions(robot_plant, robot),
            collect_collision_shapes(
                robot_plant.plant, robot_plant.scene_graph.model_inspector(), robot_plant.instance
            ),
        )
        return reachability(arm)
    except ValueError as error:
        _logger.info("routes are chosen without the robot's limits: %s", error)
        return None


def _has_known_workspace(robot: Robot | None) -> bool:
    """Whether this is a Panda, held tool down."""
    if robot is None:
        return False
    down = -float(RollPitchYaw(robot.rpy_WE).ToRotationMatrix().matrix()[2, 2])
    known = Path(robot.model).name == _PANDA and down >= math.cos(_TOOL_DOWN_ANGLE)
    if not known:
        _logger.info("routes are chosen without the robot's limits: known for a Panda, tool down")
    return known


def robot_annulus(robot: Robot | None) -> FloatArray | None:
    """Where the tool point can be, as `workspace.tool_down_annulus` has it; None: not known."""
    return tool_down_annulus() if _has_known_workspace(robot) else None


def held_annulus(scenario: Scenario) -> FloatArray | None:
    """`robot_annulus` of a robot whose tool is down on the whole way; None: not known."""
    annuli = [robot_annulus(robot) for robot in held_robots(scenario)]
    return None if not annuli or any(a is None for a in annuli) else annuli[0]


def make_dmp_integrator(scenario: Scenario) -> DmpIntegrator:
    """The action level."""
    policy = scenario.policy
    return DmpIntegrator(
        make_dmp(scenario),
        np.asarray(scenario.task.start, dtype=float),
        period=policy.period,
        parameters=ActionParameters(
            guidance=cast(GuidanceForm, policy.guidance),
            guidance_gain=policy.guidance_gain,
            fade=policy.fade,
            max_observation_age=policy.max_observation_age,
            hold_time=policy.hold_time,
        ),
    )


def make_overlay(scenario: Scenario, station: Station | None, meshcat: Meshcat) -> MeshcatOverlay:
    """What our layers think, drawn into the viewer; also dresses the scene."""
    dress_scene(meshcat)
    planned_W = _planned_path(scenario)
    if station is None or scenario.robot is None:
        return MeshcatOverlay(meshcat, planned_W=planned_W)
    hand = station.plant.GetBodyByName(scenario.robot.hand_link, station.robot)
    p_BE = np.asarray(scenario.robot.p_HE)
    source = scenario.perception
    if not isinstance(source, DepthCamera) or source.camera not in station.cameras:
        return MeshcatOverlay(meshcat, planned_W=planned_W, body_index=hand.index(), p_BE=p_BE)
    config = camera_config(scenario, source)
    return MeshcatOverlay(
        meshcat,
        planned_W=planned_W,
        camera_info=station.cameras[source.camera].intrinsics,
        depth_range=(config.z_near, config.z_far),
        body_index=hand.index(),
        p_BE=p_BE,
    )


def _planned_path(scenario: Scenario) -> FloatArray | None:
    """(T, 3) the planned motion in the world; None for the straight line."""
    task = scenario.task
    if not task.demonstration:
        return None
    return trajectory(make_dmp(scenario), task.start, task.goal).p
