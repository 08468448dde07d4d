"""Start and goal of a task that are given as joints: where they put the tool, and what follows."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import minimum_jerk_share
from drake_oa.robot.inverse_kinematics import solve_tool_pose
from drake_oa.robot.plant import RobotPlant, home_positions, make_robot_plant
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.scenario.tool_orientation import end_rotations

_APART, _TURNED = 1e-3, 0.01
"""Stated poses agree with those of the joints within this [m, rad]."""
_ENDS = ("start", "goal")


def joint_ends(scenario: Scenario) -> dict[str, FloatArray]:
    """Returns the (nq,) positions at those of "start" and "goal" that are given as joints.

    Raises:
        ScenarioError: for another number of joints than the arm has, or one beyond its limits.
    """
    found = {}
    for end in _ENDS:
        joints = getattr(scenario.task, f"q_{end}")
        if joints is None:
            continue
        robot = robot_of(scenario)
        count = len(robot.q_seed)
        if len(joints) != count:
            raise ScenarioError(
                f"task.q_{end}: expected {count} numbers, as robot.q_seed has, not {len(joints)}"
            )
        plant = make_robot_plant(robot).plant
        lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
        for row, value in enumerate(joints):
            if not lower[row] <= value <= upper[row]:
                raise ScenarioError(
                    f"task.q_{end}[{row}]: {value:g} is outside [{lower[row]:g}, "
                    f"{upper[row]:g}], the joint's limits [rad]"
                )
        q = home_positions(robot)
        q[:count] = joints
        found[end] = q
    return found


def follow_joints(scenario: Scenario, stated: Collection[str] = ()) -> None:
    """Puts start, goal and their orientations where `q_start` and `q_goal` have the tool.

    Args:
        scenario: to be changed.
        stated: names of fields of the task that are to be left: `end_positions` checks them.

    Raises:
        ScenarioError: as `joint_ends`, and if there is no robot.
    """
    task = scenario.task
    if task.q_start is None and task.q_goal is None:
        return
    if scenario.robot is None:
        end = "goal" if task.q_start is None else "start"
        raise ScenarioError(f"task.q_{end}: needs a robot; this scenario has null")
    for end, q in joint_ends(scenario).items():
        (X_WE,) = make_robot_plant(scenario.robot).tool_poses(q[None])
        if end not in stated:
            setattr(task, end, X_WE.translation().tolist())
        if f"rpy_{end}" not in stated:
            setattr(task, f"rpy_{end}", RollPitchYaw(X_WE.rotation()).vector().tolist())


def _check_agreement(
    robot_plant: RobotPlant, end: str, q: FloatArray, X_WE: RigidTransform
) -> None:
    """Refuses a pose of the task that is not that of its joints.

    Args:
        robot_plant: the robot alone.
        end: "start" or "goal".
        q: (nq,) the robot's positions there.
        X_WE: the pose that the task asks for.

    Raises:
        ScenarioError: naming the field.
    """
    (of_joints,) = robot_plant.tool_poses(q[None])
    apart = float(np.linalg.norm(of_joints.translation() - X_WE.translation()))
    if apart > _APART:
        raise ScenarioError(
            f"task.{end}: {np.round(X_WE.translation(), 4).tolist()} is {1e3 * apart:.1f} mm from "
            f"where task.q_{end} has the tool, {np.round(of_joints.translation(), 4).tolist()} m; "
            "leave one of the two out"
        )
    off = of_joints.rotation().InvertAndCompose(X_WE.rotation()).ToAngleAxis().angle()
    if off > _TURNED:
        rpy = np.round(RollPitchYaw(of_joints.rotation()).vector(), 4).tolist()
        raise ScenarioError(
            f"task.rpy_{end}: the orientation is {np.rad2deg(off):.1f} degrees from that of "
            f"task.q_{end}, {rpy} rad; leave one of the two out"
        )


def posture_guide(s: FloatArray, q_start: FloatArray, q_goal: FloatArray) -> FloatArray:
    """(T, n) postures from start to goal at normalised times (T,), of minimum jerk."""
    share = minimum_jerk_share(np.clip(s, 0.0, 1.0))
    return q_start + share[:, None] * (q_goal - q_start)


def start_positions(scenario: Scenario) -> FloatArray:
    """Returns (nq,) positions with E at the start; raises as `end_positions` does."""
    return end_positions(scenario)[0]


def end_positions(scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """Returns (nq,) positions with E at the start, and at the last goal.

    They are `task.q_start` and `task.q_goal` where these are given; each goal must be in reach.

    Raises:
        ScenarioError: naming start, goal or the move of the goal that is out of reach, or that
            does not agree with `task.q_start` or `task.q_goal`.
    """
    robot_plant = make_robot_plant(robot_of(scenario))
    R_WS, R_WG = end_rotations(scenario)
    seed, found = home_positions(robot_of(scenario)), joint_ends(scenario)
    places = {"start": scenario.task.start, "goal": scenario.task.goal}
    places |= {f"goal_moves[{row}]": move[1:] for row, move in enumerate(scenario.task.goal_moves)}
    for name, place in places.items():
        X_WE = RigidTransform(R_WS if name == "start" else R_WG, np.asarray(place))
        if name in found:
            _check_agreement(robot_plant, name, found[name], X_WE)
            continue
        try:
            found[name] = solve_tool_pose(
                robot_plant.plant, robot_plant.tool_frame.name(), X_WE, seed
            )
        except ValueError as error:
            raise ScenarioError(f"task.{name}: {error}") from None
    return found["start"], found[name]
