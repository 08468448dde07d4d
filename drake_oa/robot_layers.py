"""Makes the systems that move the robot and watch it: controller and supervisor."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.cartesian import CartesianGains
from drake_oa.collision_shapes import collect_collision_shapes
from drake_oa.faults import ModelError
from drake_oa.inverse_kinematics import solve_tool_pose
from drake_oa.layers import make_dmp, perception_period, table_plane
from drake_oa.scenario import DepthCamera, RecordedClouds, Robot, Scenario, ScenarioError
from drake_oa.scenario_perception import segmentation_config
from drake_oa.station import RobotPlant, home_positions, make_robot_plant
from drake_oa.supervision import SupervisorParameters
from drake_oa.systems.cartesian_inverse_dynamics import CartesianInverseDynamics
from drake_oa.systems.integral_action import IntegralAction
from drake_oa.systems.supervisor import Supervisor
from drake_oa.values import FloatArray

_SURFACE_GAP = 0.01
"""How far a link may come into a surface between the points that ground truth has of it [m]."""


def start_positions(robot_plant: RobotPlant, scenario: Scenario) -> FloatArray:
    """(nq,) positions of the robot with E at the start, and a check that the goal is in reach.

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


def make_controller(
    scenario: Scenario, robot_plant: RobotPlant, q_start: FloatArray
) -> CartesianInverseDynamics:
    """The control law; posture and tool orientation are those of the start.

    Args:
        scenario: with a robot.
        robot_plant: the robot alone, as the plant has it.
        q_start: (nq,) its positions at the start, see `start_positions`.

    Raises:
        ScenarioError: if the scenario has no robot, or its model error is of another one.
    """
    robot = scenario.robot
    if robot is None:
        raise ScenarioError("robot: a controller needs a robot; this scenario has null")
    if any(isinstance(fault, ModelError) for fault in scenario.faults):
        robot_plant = make_robot_plant(robot, uniform_density=True)
    gains = robot.gains
    return CartesianInverseDynamics(
        robot_plant.plant,
        R_WE_desired=RollPitchYaw(robot.rpy_WE).ToRotationMatrix(),
        q_posture=q_start,
        tool_frame=robot_plant.tool_frame.name(),
        gains=CartesianGains(**{k: v for k, v in vars(gains).items() if k != "ki_position"}),
        finger_opening=robot.finger_opening,
    )


def make_integral_action(scenario: Scenario) -> IntegralAction | None:
    """What takes away the error that a wrong model leaves; None: not asked for.

    Raises:
        ScenarioError: for a gain with which the law is not stable.
    """
    robot = scenario.robot
    if robot is None or robot.gains.ki_position == 0.0:
        return None
    gains = robot.gains
    if gains.ki_position >= gains.kp_position * gains.kd_position:
        raise ScenarioError(
            f"robot.gains.ki_position: {gains.ki_position:g} must be below kp_position times "
            f"kd_position, {gains.kp_position * gains.kd_position:g} [1/s^3]"
        )
    return IntegralAction(gains.ki_position, period=scenario.policy.period)


def make_supervisor(scenario: Scenario, robot_plant: RobotPlant) -> Supervisor:
    """What watches the motion; it decides as often as the policy steps.

    Raises:
        ScenarioError: if the scenario has no supervisor.
    """
    given, policy, source = scenario.supervisor, scenario.policy, scenario.perception
    if given is None:
        raise ScenarioError("supervisor: this scenario has null")
    if isinstance(source, (DepthCamera, RecordedClouds)):
        padding = 0.5 * segmentation_config(source.segmentation).voxel
    else:
        padding = _SURFACE_GAP
    return Supervisor(
        collect_collision_shapes(
            robot_plant.plant, robot_plant.scene_graph.model_inspector(), robot_plant.instance
        ),
        robot_plant.tool_frame.name(),
        make_dmp(scenario).duration,
        period=policy.period,
        parameters=SupervisorParameters(
            stop_distance=given.stop_distance,
            padding=padding,
            reaction_time=policy.hold_time + given.lag,
            leave_scale=given.leave_scale,
            frame_period=perception_period(scenario),
            stale_frames=given.stale_frames,
            max_age=policy.max_observation_age,
            joint_margin=given.joint_margin,
            tracking_slow=given.tracking_slow,
            tracking_hold=given.tracking_hold,
            saturation_time=given.saturation_time,
            recovery_time=given.recovery_time,
            patience=given.patience,
        ),
        table=table_plane(scenario),
    )
