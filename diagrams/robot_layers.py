"""Makes the systems that move the robot and watch it: controller and supervisor."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.primitives import ConstantValueSource

from drake_oa.common.messages import FloatArray, PlannedMotion
from drake_oa.common.schema_check import ScenarioError
from drake_oa.control.cartesian_inverse_dynamics import CartesianInverseDynamics
from drake_oa.control.integral_action import IntegralAction
from drake_oa.control.operational_space import CartesianGains
from drake_oa.diagrams.layers import held_annulus, make_dmp, perception_period, table_plane
from drake_oa.geometry.collision_shapes import collect_collision_shapes
from drake_oa.posture.null_space_coupling import NullSpaceCouplingParameters
from drake_oa.posture.null_space_coupling_system import NullSpaceCoupling
from drake_oa.posture.posture_follower import PostureFollower
from drake_oa.posture.posture_plan import PostureParameters
from drake_oa.posture.posture_planner import WholeArm
from drake_oa.regulation.verified_regressor_chain import RobotArm
from drake_oa.robot.arm_model import make_arm_model
from drake_oa.robot.arm_motion import ArmModel
from drake_oa.robot.config import Robot
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.inverse_kinematics import solve_tool_pose
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant
from drake_oa.safety.lookahead import EvasionParameters
from drake_oa.safety.obstacle_evasion import ObstacleEvasion
from drake_oa.safety.supervision import SupervisorParameters
from drake_oa.safety.supervisor import Supervisor
from drake_oa.scenario.faults import ModelError
from drake_oa.scenario.perception import segmentation_config
from drake_oa.scenario.scenario import DepthCamera, RecordedClouds, Scenario, Verified
from drake_oa.scenario.task_joints import check_agreement, joint_ends, posture_guide
from drake_oa.scenario.tool_orientation import end_rotations, tool_orientation

_logger = logging.getLogger("drake_oa")
_FARTHER = 0.01
"""How much farther than the supervisor's stop a planned posture stays away [m]."""
_GUIDE_SAMPLES = 41
"""Of a posture that is not planned, along the motion."""
_SURFACE_GAP = 0.01
"""How far a link may come into a surface between the points that ground truth has of it [m]."""


def start_positions(robot_plant: RobotPlant, scenario: Scenario) -> FloatArray:
    """(nq,) positions of the robot with E at the start; raises as `end_positions` does."""
    return end_positions(robot_plant, scenario)[0]


def end_positions(robot_plant: RobotPlant, scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """(nq,) positions with E at the start, and at the last goal; each goal must be in reach.

    Those of `task.q_start`, where they are given.

    Raises:
        ScenarioError: naming start, goal or the move of the goal that is out of reach, or that
            does not agree with `task.q_start` or `task.q_goal`.
    """
    robot: Robot | None = scenario.robot
    if robot is None:
        raise ScenarioError("robot: a start pose needs a robot; this scenario has null")
    R_WS, R_WG = end_rotations(scenario)
    seed = home_positions(robot_plant, robot)
    found = joint_ends(robot_plant, scenario)
    places = {"start": scenario.task.start, "goal": scenario.task.goal}
    places |= {f"goal_moves[{row}]": move[1:] for row, move in enumerate(scenario.task.goal_moves)}
    for name, place in places.items():
        X_WE = RigidTransform(R_WS if name == "start" else R_WG, np.asarray(place))
        if name in found:
            check_agreement(robot_plant, name, found[name], X_WE)
            continue
        try:
            found[name] = solve_tool_pose(
                robot_plant.plant, robot_plant.tool_frame.name(), X_WE, seed
            )
        except ValueError as error:
            raise ScenarioError(f"task.{name}: {error}") from None
    return found["start"], found[name]


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
        R_WE_desired=end_rotations(scenario)[0],
        q_posture=q_start,
        tool_frame=robot_plant.tool_frame.name(),
        gains=CartesianGains(**{k: v for k, v in vars(gains).items() if k != "ki_position"}),
        finger_opening=robot.finger_opening,
    )


def make_robot_arm(
    scenario: Scenario, robot_plant: RobotPlant, q_start: FloatArray
) -> RobotArm | None:
    """What plans the posture of the arm; None: the scenario asks for none.

    An arm that does not have seven revolute joints in a row has no posture to plan.

    Args:
        scenario: with a robot.
        robot_plant: the robot alone, as the plant has it.
        q_start: (nq,) its positions at the start, see `start_positions`.
    """
    robot = scenario.robot
    if robot is None or robot.posture is None or not isinstance(scenario.regulation, Verified):
        return None
    if not robot.posture.plan:
        return None
    stop = 0.0 if scenario.supervisor is None else scenario.supervisor.stop_distance
    stop += _padding(scenario.perception) + _FARTHER
    try:
        arm = _arm_model(scenario, robot, robot_plant, q_start)
        held = tool_orientation(scenario)
        planner = WholeArm(
            arm,
            # Nearer than the stop the supervisor would hold the motion.
            PostureParameters(
                clearance=max(robot.posture.clearance, stop + _FARTHER), stop_distance=stop
            ),
            None if held is None else held.along,
            make_posture_guide(scenario, arm.posture),
        )
    except ValueError as error:
        _logger.info("the posture of the arm is not planned: %s", error)
        return None
    return RobotArm(planner, tuple(arm.index.tolist()), robot_plant.plant.num_multibody_states())


def _arm_model(
    scenario: Scenario, robot: Robot, robot_plant: RobotPlant, q_start: FloatArray
) -> ArmModel:
    """The arm's links without the tool, which has a clearance of its own."""
    plant, inspector = robot_plant.plant, robot_plant.scene_graph.model_inspector()
    return make_arm_model(
        plant,
        inspector,
        robot_plant.tool_frame,
        end_rotations(scenario)[0],
        q_start,
        collect_collision_shapes(plant, inspector, robot_plant.instance),
        without=tool_links(robot),
    )


def make_posture_guide(
    scenario: Scenario, q_start: FloatArray
) -> Callable[[FloatArray], FloatArray] | None:
    """(T, n) postures that the null space is drawn to at normalised times (T,).

    Args:
        scenario: with a robot.
        q_start: (n,) positions of the arm at the start [rad].

    Returns:
        None where the task does not give the joints at the goal: the posture of the start.
    """
    q_goal = scenario.task.q_goal
    return None if q_goal is None else lambda s: posture_guide(s, q_start, np.asarray(q_goal))


def make_null_space_coupling(
    scenario: Scenario, robot_plant: RobotPlant, q_start: FloatArray
) -> NullSpaceCoupling | None:
    """What turns the links away from obstacles; None: the scenario asks for none.

    Raises:
        ScenarioError: for an arm whose joints are not all revolute.
    """
    robot = scenario.robot
    given = None if robot is None or robot.posture is None else robot.posture.coupling
    if robot is None or given is None:
        return None
    try:
        arm = _arm_model(scenario, robot, robot_plant, q_start)
    except ValueError as error:
        raise ScenarioError(f"robot.posture.coupling: {error}") from None
    return NullSpaceCoupling(
        arm,
        robot_plant.plant.num_multibody_states(),
        NullSpaceCouplingParameters(given.alpha, given.psi, given.kappa),
        period=scenario.policy.period,
        table=table_plane(scenario),
    )


def make_posture_follower(
    scenario: Scenario, arm: RobotArm, q_start: FloatArray
) -> PostureFollower:
    """What draws the null space to the planned posture; without one to that of the start."""
    policy, evasion = scenario.policy, scenario.evasion
    turn = {} if evasion is None else {"turn_acceleration": evasion.turn_acceleration}
    return PostureFollower(
        q_start[list(arm.positions)], policy.alpha_k, period=policy.period, **turn
    )


def make_guide_follower(
    scenario: Scenario, q_start: FloatArray
) -> tuple[PostureFollower, ConstantValueSource] | None:
    """What draws the null space from the joints at the start to those at the goal, unplanned.

    Args:
        scenario: with a robot.
        q_start: (nq,) its positions at the start.

    Returns:
        The follower and its motion; None where the task does not give the joints at the goal.
    """
    robot = scenario.robot
    if (
        robot is None
        or (guide := make_posture_guide(scenario, q_start[: len(robot.q_seed)])) is None
    ):
        return None
    s = np.linspace(0.0, 1.0, _GUIDE_SAMPLES)
    motion = PlannedMotion(s, np.zeros((len(s), 3)), guide(s))
    follower = PostureFollower(motion.q[0], scenario.policy.alpha_k, period=scenario.policy.period)
    return follower, ConstantValueSource(Value(motion))


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
    return Supervisor(
        collect_collision_shapes(
            robot_plant.plant, robot_plant.scene_graph.model_inspector(), robot_plant.instance
        ),
        robot_plant.tool_frame.name(),
        make_dmp(scenario).duration,
        period=policy.period,
        parameters=SupervisorParameters(
            stop_distance=given.stop_distance,
            padding=_padding(source),
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


def make_evasion(
    scenario: Scenario, robot_plant: RobotPlant, *, turns: bool = True
) -> ObstacleEvasion:
    """What gets the arm out of the way of what moves; it decides with every observation.

    Args:
        scenario: of the robot.
        robot_plant: the robot.
        turns: whether there is a posture follower, which turns the arm.

    Raises:
        ScenarioError: if the scenario has none.
    """
    given, policy = scenario.evasion, scenario.policy
    if given is None:
        raise ScenarioError("evasion: this scenario has null")
    return ObstacleEvasion(
        collect_collision_shapes(
            robot_plant.plant, robot_plant.scene_graph.model_inspector(), robot_plant.instance
        ),
        robot_plant.tool_frame.name(),
        make_dmp(scenario),
        period=perception_period(scenario),
        step=policy.period,
        max_age=policy.max_observation_age,
        parameters=EvasionParameters(
            margin=given.margin,
            horizon=given.horizon,
            speed=given.speed,
            acceleration=given.acceleration,
            turn_speed=given.turn_speed if turns else 0.0,
            turn_acceleration=given.turn_acceleration,
            padding=_padding(scenario.perception),
            hold_time=policy.hold_time,
        ),
        table=table_plane(scenario),
        table_height=policy.table_height,
        annulus=held_annulus(scenario),
        thinking=scenario.thinking,
    )


def _padding(source: object) -> float:
    """How far an obstacle's surface may lie outside the points that are seen of it [m]."""
    if isinstance(source, (DepthCamera, RecordedClouds)):
        return 0.5 * segmentation_config(source.segmentation).voxel
    return _SURFACE_GAP
