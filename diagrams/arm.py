"""The arm as the layers know it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.robot.arm import ArmModel, make_arm_model
from drake_oa.robot.config import Robot
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import RobotPlant, home_positions, model_file
from drake_oa.robot.spheres import ArmSpheres, make_arm_spheres
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task_joints import posture_guide
from drake_oa.scenario.tool_orientation import end_rotations

_COVERED: dict[tuple[str, int], ArmSpheres] = {}
"""The robots of this process as spheres, which take seconds to make."""


def covered_arm(robot: Robot, robot_plant: RobotPlant) -> ArmSpheres:
    """The robot as spheres, as near as its block asks; made once.

    They are made at home: from where else would change their last bits, and with these what a
    process does later.

    Args:
        robot: the block.
        robot_plant: the robot alone.

    Raises:
        ScenarioError: for a robot that cannot be covered.
    """
    key = (repr(robot), model_file(robot).stat().st_mtime_ns)
    if key not in _COVERED:
        try:
            q = home_positions(robot_plant, robot)
            _COVERED[key] = make_arm_spheres(robot_plant, q, tool_links(robot), robot.spheres)
        except ValueError as error:
            raise ScenarioError(f"robot: {error}") from None
    return _COVERED[key]


def arm_model(scenario: Scenario, robot_plant: RobotPlant, q_start: FloatArray) -> ArmModel:
    """The joints of the arm at the start, and the orientation of its tool there."""
    R_WE = end_rotations(scenario)[0]
    return make_arm_model(robot_plant.plant, robot_plant.tool_frame, R_WE, q_start)


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
