"""The arm as the layers know it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.robot.config import Robot
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant
from drake_oa.robot.spheres import ArmSpheres, make_arm_spheres
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task_joints import posture_guide

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
        try:
            q = home_positions(robot)
            _COVERED[key] = make_arm_spheres(robot_plant, q, tool_links(robot), robot.spheres)
        except ValueError as error:
            raise ScenarioError(f"robot: {error}") from None
    return _COVERED[key]


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
