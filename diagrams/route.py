"""Route: on which side of the obstacles."""

from __future__ import annotations

import logging

import numpy as np
from pydrake.math import RollPitchYaw

from drake_oa.common.messages import FloatArray
from drake_oa.common.wires import Wires
from drake_oa.diagrams.station import Cell
from drake_oa.geometry.annulus import Annulus
from drake_oa.regulation.config import Paper
from drake_oa.robot.arm import make_arm_model
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.robot.reachability import Reachability, reachability
from drake_oa.robot.tool_down import found_annulus, given_annulus, is_tool_down
from drake_oa.route.cost_ring_selector import CostRingSelector
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.tool_orientation import held_robots

_logger = logging.getLogger("drake_oa")


def add_route(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds cost_ring_selector where it leads the motion: ellipsoids_W, goal -> route."""
    regulation = scenario.regulation
    if "ellipsoids_W" in wires and isinstance(regulation, Paper) and regulation.guided:
        wires.add(
            "cost_ring_selector",
            make_cost_ring_selector(scenario),
            offers={"decision": "route", "route": "shown_route"},
        )


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
            robot_plant.tool_frame,
            RollPitchYaw(robot.rpy_WE).ToRotationMatrix(),
            home_positions(robot),
        )
        return reachability(arm)
    except ValueError as error:
        _logger.info("routes are chosen without the robot's limits: %s", error)
        return None


def robot_annulus(robot: Robot | None) -> Annulus | None:
    """Where the tool point can be about the base; None: not known.

    It is that of the robot's block, or found from what the arm reaches.
    """
    if robot is None:
        return None
    if not is_tool_down(robot):
        _logger.info("motions are verified without the arm's reach: not upright, or tool not down")
        return None
    given = given_annulus(robot)
    reach = robot_reachability(robot) if given is None else None
    try:
        return given if reach is None else found_annulus(reach, robot)
    except ValueError as error:
        _logger.info("motions are verified without the arm's reach: %s", error)
        return None


def held_annulus(scenario: Scenario) -> Annulus | None:
    """`robot_annulus` of a robot whose tool is down on the whole way; None: not known."""
    held = held_robots(scenario)
    # The first that has none stands for the whole way.
    return robot_annulus(min(held, key=is_tool_down, default=None))
