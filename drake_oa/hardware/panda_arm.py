"""The arm that the messages are of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydrake.manipulation import PandaControlMode

from drake_oa.common.config import ScenarioError
from drake_oa.robot.arm import joints_to
from drake_oa.robot.plant import RobotLimits, make_robot_plant
from drake_oa.scenario.scenario import Scenario, robot_of

STATUS_CHANNEL, COMMAND_CHANNEL = "PANDA_STATUS", "PANDA_COMMAND"
ARM_JOINTS = 7
_LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
_UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
"""How far a Panda's joints go, by its maker [rad]."""
_SLACK = 0.02


POSITION_MODE = int(PandaControlMode.kPosition)
"""Control mode of commands and statuses in messages: joint positions."""
MICROSECOND = 1e-6
"""Unit of the stamps [s]."""


def arm_of(scenario: Scenario) -> tuple[list[int], RobotLimits]:
    """Returns the places of the arm's joints in the robot's positions, and their limits.

    Raises:
        ScenarioError: for an arm that the messages are not of, or without a robot.
    """
    robot_plant = make_robot_plant(robot_of(scenario))
    joints = joints_to(robot_plant.plant, robot_plant.tool_frame)
    arm = [joint.position_start() for joint in joints]
    if len(arm) != ARM_JOINTS:
        raise ScenarioError(
            f"robot.model: an arm of {len(arm)} joints; a Panda's messages are of {ARM_JOINTS}"
        )
    limits = robot_plant.limits
    lower, upper = limits.position_lower[arm], limits.position_upper[arm]
    if (lower < _LOWER - _SLACK).any() or (upper > _UPPER + _SLACK).any():
        raise ScenarioError(
            "robot.model: its joints reach beyond a Panda's, which the messages are of"
        )
    names = tuple(limits.position_name[i] for i in arm)
    return arm, replace(
        limits,
        position_name=names,
        position_lower=lower,
        position_upper=upper,
        velocity_limit=limits.velocity_limit[arm],
        actuator_name=names,
        effort_limit=limits.effort_limit[[limits.actuator_name.index(name) for name in names]],
    )
