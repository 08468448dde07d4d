"""Poses and joint positions of a task at start and goal, and the tool orientation between them."""

from __future__ import annotations

import dataclasses as dc
import math
from collections.abc import Collection

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix

from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import (
    OrientationDmp,
    demonstrated_goal,
    minimum_jerk_orientation,
    minimum_jerk_share,
    orientation_along,
)
from drake_oa.robot.arm import solve_tool_pose
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.scenario.demonstration import demonstrated_orientation, primitive_constants
from drake_oa.scenario.scenario import Scenario, robot_of

_APART = math.radians(10.0)
"""Orientations of the way that stand for all of it are no further apart, on average."""
_FEWEST = 5


@dc.dataclass(frozen=True, eq=False)
class ToolOrientation:
    """Orientation of the tool along the motion.

    Attributes:
        primitive: its movement primitive.
        R_WS: (3, 3) R_WE at the start.
        R_WG: (3, 3) R_WE at the goal.
    """

    primitive: OrientationDmp
    R_WS: FloatArray
    R_WG: FloatArray

    def along(self, s: FloatArray) -> FloatArray:
        """Returns orientations (T, 3, 3) at normalized times (T,)."""
        return orientation_along(self.primitive, self.R_WS, self.R_WG, s)

    def samples(self) -> FloatArray:
        """Returns orientations (N, 3, 3) of the whole way, from start to goal."""
        R = self.along(np.linspace(0.0, 1.0, 201))
        # The angle between one and the next, from the trace of the rotation between them.
        cosine = 0.5 * (np.einsum("tij,tij->t", R[1:], R[:-1]) - 1.0)
        angle = np.append(0.0, np.cumsum(np.arccos(np.clip(cosine, -1.0, 1.0))))
        count = max(_FEWEST, math.ceil(angle[-1] / _APART) + 1)
        rows = np.searchsorted(angle, np.linspace(0.0, angle[-1], count))
        return R[np.minimum(rows, len(R) - 1)]


def tool_orientation(scenario: Scenario) -> ToolOrientation | None:
    """Returns the orientation along the motion; None: it is constant, or there is no robot.

    Start and goal are `task.rpy_start` and `task.rpy_goal`; where one is not given, what the
    demonstration has there, or without orientations in it `robot.rpy_WE`.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    task, robot = scenario.task, scenario.robot
    requested = {"rpy_start": task.rpy_start, "rpy_goal": task.rpy_goal}
    given = [name for name, rpy in requested.items() if rpy is not None]
    if robot is None:
        if given:
            raise ScenarioError(f"task.{given[0]}: needs a robot; this scenario has null")
        return None
    shown = demonstrated_orientation(scenario)
    if shown is None and not given:
        return None
    ends = []
    demonstrated = (None, None) if shown is None else (shown.first, shown.last)
    for rpy, R_WE in zip(requested.values(), demonstrated, strict=True):
        if rpy is not None or R_WE is None:
            R_WE = RollPitchYaw(robot.rpy_WE if rpy is None else rpy).ToRotationMatrix().matrix()
        ends.append(R_WE)
    primitive = shown or minimum_jerk_orientation(**primitive_constants(scenario.policy))
    with field_errors("task.rpy_goal", ValueError):
        demonstrated_goal(primitive, *ends)
    return ToolOrientation(primitive, *ends)


def end_rotations(scenario: Scenario) -> tuple[RotationMatrix, RotationMatrix]:
    """Returns R_WE at start and goal.

    Raises:
        ScenarioError: if the scenario has no robot, or as `tool_orientation`.
    """
    held = tool_orientation(scenario)
    if held is None:
        R_WE = RollPitchYaw(robot_of(scenario).rpy_WE).ToRotationMatrix()
        return R_WE, R_WE
    return (
        RotationMatrix.ProjectToRotationMatrix(held.R_WS),
        RotationMatrix.ProjectToRotationMatrix(held.R_WG),
    )


def held_robots(scenario: Scenario) -> list[Robot]:
    """Returns the robot with orientations of the whole way as its `rpy_WE`; the start's first.

    Empty without a robot, of one item where the orientation stays.
    """
    robot = scenario.robot
    if robot is None:
        return []
    held = tool_orientation(scenario)
    if held is None:
        return [robot]
    return [
        dc.replace(
            robot,
            rpy_WE=RollPitchYaw(RotationMatrix.ProjectToRotationMatrix(R)).vector().tolist(),
        )
        for R in held.samples()
    ]


_TOLERANCE = 1e-3
"""Maximum difference of the elements of a given pose from those of the given joints [m, 1]."""
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


def posture_guide(s: FloatArray, q_start: FloatArray, q_goal: FloatArray) -> FloatArray:
    """Returns postures (T, n) from start to goal at normalized times (T,), of minimum jerk."""
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
            (of_joints,) = robot_plant.tool_poses(found[name][None])
            if not of_joints.IsNearlyEqualTo(X_WE, _TOLERANCE):
                p = np.round(of_joints.translation(), 4).tolist()
                rpy = np.round(RollPitchYaw(of_joints.rotation()).vector(), 4).tolist()
                raise ScenarioError(
                    f"task.{name}, task.rpy_{name}: task.q_{name} has the tool at {p} m, {rpy} "
                    "rad; leave one of the two out"
                )
            continue
        with field_errors(f"task.{name}", ValueError):
            found[name] = solve_tool_pose(
                robot_plant.plant, robot_plant.tool_frame.name(), X_WE, seed
            )
    return found["start"], found[name]
