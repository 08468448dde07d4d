"""The systems of a scenario: each function makes one layer from its part of the data."""

from __future__ import annotations

from typing import cast

import numpy as np
from pydrake.common.value import Value
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import ConstantValueSource
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from drake_oa.action import ActionParameters
from drake_oa.cartesian import CartesianGains
from drake_oa.collision_shapes import collect_collision_shapes
from drake_oa.coupling import GuidanceForm
from drake_oa.dmp import Dmp, imitate, minimum_jerk
from drake_oa.inverse_kinematics import solve_tool_pose
from drake_oa.regressor import load_chain
from drake_oa.scenario import (
    DepthCamera,
    GivenEllipsoids,
    GroundTruth,
    RecordedClouds,
    Robot,
    Scenario,
    ScenarioError,
    Task,
    package_file,
    segmentation_config,
)
from drake_oa.station import RobotPlant, Station, home_positions, tool_corners
from drake_oa.systems.cartesian_inverse_dynamics import CartesianInverseDynamics
from drake_oa.systems.cost_ring_selector import CostRingSelector
from drake_oa.systems.depth_perception import DepthPerception
from drake_oa.systems.dmp_integrator import DmpIntegrator
from drake_oa.systems.ellipsoid_descriptor import EllipsoidDescriptor
from drake_oa.systems.ground_truth_perception import GroundTruthPerception
from drake_oa.systems.meshcat_overlay import MeshcatOverlay, dress_scene
from drake_oa.systems.recorded_perception import RecordedPerception
from drake_oa.systems.regressor_chain import RegressorChain
from drake_oa.values import EllipsoidSet, FloatArray, TablePlane
from drake_oa.workspace import tool_down_margin


def make_dmp(scenario: Scenario) -> Dmp:
    """The movement primitive of the task: a demonstrated path, or minimum jerk.

    Raises:
        ScenarioError: naming the file, if the demonstration cannot be read.
    """
    task, policy = scenario.task, scenario.policy
    if task.demonstration:
        path, t = _demonstration(task)
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
        raise ScenarioError(f"task.demonstration: {error}") from None


def _demonstration(task: Task) -> tuple[FloatArray, FloatArray]:
    try:
        with np.load(task.demonstration) as archive:
            path = archive["path"]
            default = np.linspace(0.0, task.duration, len(path))
            return path, archive["t"] if "t" in archive.files else default
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise ScenarioError(
            f"task.demonstration: cannot read '{task.demonstration}': {error}; "
            "it must be an .npz with `path` (T, 3) and optionally `t` (T,)"
        ) from None


def start_positions(robot_plant: RobotPlant, scenario: Scenario) -> FloatArray:
    """All positions of the robot with E at the start, and a check that the goal is in reach.

    Raises:
        ScenarioError: naming start or goal, if it is out of reach.
    """
    robot: Robot | None = scenario.robot
    if robot is None:
        raise ScenarioError("robot: a start pose needs a robot; this scenario has null")
    R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix()
    seed = home_positions(robot_plant, robot)
    found = {}
    for name, place in (("start", scenario.task.start), ("goal", scenario.task.goal)):
        try:
            found[name] = solve_tool_pose(
                robot_plant.plant,
                robot_plant.tool_frame.name(),
                RigidTransform(R_WE, np.asarray(place)),
                seed,
            )
        except ValueError as error:
            raise ScenarioError(f"task.{name}: {error}") from None
    return found["start"]


def make_perception(
    scenario: Scenario, station: Station | None, robot_plant: RobotPlant | None
) -> LeafSystem:
    """The perception source that the scenario's tagged block asks for."""
    source = scenario.perception
    if isinstance(source, GivenEllipsoids):
        return ConstantValueSource(Value(given_ellipsoids(source)))
    if station is None or robot_plant is None:
        raise ScenarioError(f"perception: !{type(source).__name__} needs a robot")
    if isinstance(source, GroundTruth):
        return GroundTruthPerception(
            station.plant,
            station.scene_graph.model_inspector(),
            station.obstacles,
            table=_table(scenario),
            period=source.period,
        )
    prior = {} if scenario.table_height is None else {"table_height": scenario.table_height}
    robot = collect_collision_shapes(
        robot_plant.plant, robot_plant.scene_graph.model_inspector(), robot_plant.instance
    )
    if isinstance(source, RecordedClouds):
        try:
            return RecordedPerception(
                source.folder,
                config=segmentation_config(source.segmentation, **prior),
                robot=robot,
                period=source.period,
                loop=source.loop,
            )
        except (OSError, ValueError) as error:
            raise ScenarioError(f"perception.folder: {error}") from None
    camera = next(config for config in scenario.cameras if config.name == source.camera)
    return DepthPerception(
        _intrinsics(station.cameras[source.camera]),
        config=segmentation_config(source.segmentation, **prior),
        robot=robot,
        # Drake's VTK renderer samples pixels at their centres.
        pixel_center=0.5,
        period=1.0 / camera.fps,
    )


def make_ellipsoid_descriptor(scenario: Scenario, robot_plant: RobotPlant) -> EllipsoidDescriptor:
    """The descriptor, which dilates by the robot's tool."""
    if scenario.robot is None:
        raise ScenarioError("robot: the descriptor needs a tool; this scenario has null")
    return EllipsoidDescriptor(tool_corners(robot_plant, scenario.robot))


def _intrinsics(sensor: RgbdSensor) -> CameraInfo:
    return sensor.default_depth_render_camera().core().intrinsics()


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


def _table(scenario: Scenario) -> TablePlane | None:
    return None if scenario.table_height is None else TablePlane(offset=scenario.table_height)


def make_regressor_chain(scenario: Scenario) -> RegressorChain:
    """The regressor chain with the scenario's weights.

    Raises:
        ScenarioError: naming the file, if the weights are missing or do not fit.
    """
    try:
        weights = load_chain(package_file(scenario.policy.weights))
    except (OSError, ValueError) as error:
        raise ScenarioError(f"policy.weights: {error}") from None
    return RegressorChain(weights, scenario.task.clearance)


def make_cost_ring_selector(scenario: Scenario) -> CostRingSelector:
    """The route selection; with a robot, its workspace is a ring."""
    policy = scenario.policy
    return CostRingSelector(
        scenario.task.clearance,
        period=policy.route_period,
        n_directions=policy.ring_directions,
        table_height=policy.table_height,
        workspace=tool_down_margin if scenario.robot is not None else None,
    )


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


def make_controller(
    scenario: Scenario, robot_plant: RobotPlant, q_start: FloatArray
) -> CartesianInverseDynamics:
    """The control law; posture and tool orientation are those of the start."""
    robot = scenario.robot
    if robot is None:
        raise ScenarioError("robot: a controller needs a robot; this scenario has null")
    gains = robot.gains
    return CartesianInverseDynamics(
        robot_plant.plant,
        R_WE_desired=RollPitchYaw(robot.rpy_WE).ToRotationMatrix(),
        q_posture=q_start,
        tool_frame=robot_plant.tool_frame.name(),
        gains=CartesianGains(**vars(gains)),
        finger_opening=robot.finger_opening,
    )


def make_overlay(scenario: Scenario, station: Station | None, meshcat: Meshcat) -> MeshcatOverlay:
    """What our layers think, drawn into the viewer; also dresses the scene."""
    dress_scene(meshcat)
    if station is None or scenario.robot is None:
        return MeshcatOverlay(meshcat)
    hand = station.plant.GetBodyByName(scenario.robot.hand_link, station.robot)
    source = scenario.perception
    sensor = station.cameras.get(source.camera) if isinstance(source, DepthCamera) else None
    return MeshcatOverlay(
        meshcat,
        camera_info=None if sensor is None else _intrinsics(sensor),
        body_index=hand.index(),
        p_BE=np.asarray(scenario.robot.p_HE),
    )
