"""The arm as the layers know it: where it starts, and what plans its posture."""

from __future__ import annotations

import logging
from collections.abc import Callable

import numpy as np

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.geometry.collision_shapes import collect_collision_shapes
from drake_oa.posture.posture_plan import PostureParameters
from drake_oa.posture.posture_planner import WholeArm
from drake_oa.regulation.config import Verified
from drake_oa.regulation.verified_regressor_chain import RobotArm
from drake_oa.robot.arm import ArmModel, make_arm_model
from drake_oa.robot.config import Robot
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import RobotPlant
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import padding
from drake_oa.scenario.task_joints import posture_guide
from drake_oa.scenario.tool_orientation import end_rotations, tool_orientation

_logger = logging.getLogger("drake_oa")

_FARTHER = 0.01
"""How much farther than the supervisor's stop a planned posture stays away [m]."""


def make_robot_arm(
    scenario: Scenario, robot_plant: RobotPlant, q_start: FloatArray
) -> RobotArm | None:
    """What plans the posture of the arm; None: the scenario asks for none.

    An arm that does not have seven revolute joints in a row has no posture to plan.

    Args:
        scenario: with a robot.
        robot_plant: the robot alone, as the plant has it.
        q_start: (nq,) its positions at the start, see `start_positions`.

    Raises:
        ScenarioError: for links that are to keep less than the supervisor lets them.
    """
    robot = scenario.robot
    if robot is None or robot.posture is None or not isinstance(scenario.regulation, Verified):
        return None
    if not robot.posture.plan:
        return None
    stop = 0.0 if scenario.supervisor is None else scenario.supervisor.stop_distance
    stop += padding(scenario.perception) + _FARTHER
    least = stop + _FARTHER
    link_clearance = robot.posture.link_clearance
    if link_clearance < least:
        # Nearer than the stop the supervisor would hold the motion.
        raise ScenarioError(
            f"robot.posture.link_clearance: {link_clearance:g} must be at least {least:g} [m], "
            "a little more than supervisor.stop_distance and what perception leaves open"
        )
    try:
        arm = arm_model(scenario, robot, robot_plant, q_start)
        held = tool_orientation(scenario)
        planner = WholeArm(
            arm,
            PostureParameters(
                link_clearance=robot.posture.link_clearance,
                stop_distance=stop,
                roll_joint=robot.posture.roll_joint,
            ),
            None if held is None else held.along,
            make_posture_guide(scenario, arm.posture),
        )
    except ValueError as error:
        _logger.info("the posture of the arm is not planned: %s", error)
        return None
    return RobotArm(planner, tuple(arm.index.tolist()), robot_plant.plant.num_multibody_states())


def arm_model(
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
