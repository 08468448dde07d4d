"""Configurations of the arm and poses of its tool at the start and goal of a scenario's motion, and
the tool's orientation in between.
"""

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
    minimum_jerk_profile,
    orientation_along,
)
from drake_oa.robot.arm import solve_tool_pose
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import home_positions, make_robot_plant
from drake_oa.scenario.demonstration import demonstrated_orientation, primitive_constants
from drake_oa.scenario.scenario import Scenario, robot_of

_MAX_ANGLE_STEP = math.radians(10.0)
"""Maximum angle between neighboring samples of the tool's orientation along a motion, as the mean
over all neighbors [rad]."""
_MIN_SAMPLES = 5
"""Minimum number of samples of the tool's orientation along a motion."""


@dc.dataclass(frozen=True, eq=False)
class ToolOrientation:
    """Orientation of the tool frame E along a motion, from start to goal.

    Attributes:
        primitive: movement primitive that generates the orientations between start and goal.
        R_WS: (3, 3) orientation R_WE of the tool frame at the start.
        R_WG: (3, 3) orientation R_WE of the tool frame at the goal.
    """

    primitive: OrientationDmp
    R_WS: FloatArray
    R_WG: FloatArray

    def along(self, s: FloatArray) -> FloatArray:
        """Returns the orientations R_WE (T, 3, 3) of the tool frame at normalized times s (T,).

        The normalized time is 0 at the start and 1 at the end of the motion.
        """
        return orientation_along(self.primitive, self.R_WS, self.R_WG, s)

    def samples(self) -> FloatArray:
        """Samples orientations R_WE (N, 3, 3) of the tool frame from start to goal, approximately
        evenly spaced in angle.
        """
        R = self.along(np.linspace(0.0, 1.0, 201))
        # The trace of the relative rotation gives the angle between neighboring samples.
        cosine = 0.5 * (np.einsum("tij,tij->t", R[1:], R[:-1]) - 1.0)
        angle = np.append(0.0, np.cumsum(np.arccos(np.clip(cosine, -1.0, 1.0))))
        count = max(_MIN_SAMPLES, math.ceil(angle[-1] / _MAX_ANGLE_STEP) + 1)
        rows = np.searchsorted(angle, np.linspace(0.0, angle[-1], count))
        return R[np.minimum(rows, len(R) - 1)]


def tool_orientation(scenario: Scenario) -> ToolOrientation | None:
    """Returns the orientation of the tool along the motion of a scenario.

    The result is None if the orientation is constant, or if the scenario has no robot.

    The orientations at start and goal are `task.rpy_start` and `task.rpy_goal`. A missing field is
    replaced by the demonstrated orientation, or by `robot.rpy_WE` if the demonstration has no
    orientations.

    Raises:
        ScenarioError: naming a field of the task: `rpy_start` or `rpy_goal` without a robot,
            `rpy_goal` for a rotation by 180 degrees without demonstrated orientations, or invalid
            files of `demonstration`.
    """
    task, robot = scenario.task, scenario.robot
    requested = {"rpy_start": task.rpy_start, "rpy_goal": task.rpy_goal}
    stated = [name for name, rpy in requested.items() if rpy is not None]
    if robot is None:
        if stated:
            raise ScenarioError(f"task.{stated[0]}: requires a robot; the scenario has null")
        return None
    demonstration = demonstrated_orientation(scenario)
    if demonstration is None and not stated:
        return None
    ends = []
    demonstrated = (
        (None, None) if demonstration is None else (demonstration.first, demonstration.last)
    )
    for rpy, R_WE in zip(requested.values(), demonstrated, strict=True):
        if rpy is not None or R_WE is None:
            R_WE = RollPitchYaw(robot.rpy_WE if rpy is None else rpy).ToRotationMatrix().matrix()
        ends.append(R_WE)
    primitive = demonstration or minimum_jerk_orientation(**primitive_constants(scenario.policy))
    with field_errors("task.rpy_goal", ValueError):
        demonstrated_goal(primitive, *ends)
    return ToolOrientation(primitive, *ends)


def end_rotations(scenario: Scenario) -> tuple[RotationMatrix, RotationMatrix]:
    """Returns the orientations R_WE of the tool frame at start and goal of a scenario's motion.

    Raises:
        ScenarioError: if the scenario has no robot, or if `tool_orientation` rejects a field.
    """
    orientation = tool_orientation(scenario)
    if orientation is None:
        R_WE = RollPitchYaw(robot_of(scenario).rpy_WE).ToRotationMatrix()
        return R_WE, R_WE
    return (
        RotationMatrix.ProjectToRotationMatrix(orientation.R_WS),
        RotationMatrix.ProjectToRotationMatrix(orientation.R_WG),
    )


def robots_along_motion(scenario: Scenario) -> list[Robot]:
    """Returns copies of the robot's configuration block, one for each sampled orientation of the
    tool along the motion.

    Each copy has one of the orientations, as roll, pitch and yaw of the tool frame E in the world
    [rad], in its field `rpy_WE`, in the order from start to goal. The list is empty without a
    robot, and has one item if the orientation is constant.
    """
    robot = scenario.robot
    if robot is None:
        return []
    orientation = tool_orientation(scenario)
    if orientation is None:
        return [robot]
    return [
        dc.replace(
            robot, rpy_WE=RollPitchYaw(RotationMatrix.ProjectToRotationMatrix(R)).vector().tolist()
        )
        for R in orientation.samples()
    ]


_POSE_TOLERANCE = 1e-3
"""Maximum difference between two tool poses of a start or goal: the pose that the task states, and
the pose at the configuration that the task states. It applies to each element of the position [m]
and of the rotation matrix [-]."""
_ENDS = ("start", "goal")
"""Names of the two ends of a motion, as in the field names `q_start` and `q_goal`."""


def joint_ends(scenario: Scenario) -> dict[str, FloatArray]:
    """Returns the configurations (nq,) of the robot that the task states for start and goal of the
    motion, as a dictionary [rad, m].

    The keys are "start" for `task.q_start` and "goal" for `task.q_goal`; a null field has no entry.
    Joints that are not part of the arm have their home positions.

    Raises:
        ScenarioError: for a wrong number of joints, or a joint outside its limits.
    """
    q_ends = {}
    for end in _ENDS:
        joints = getattr(scenario.task, f"q_{end}")
        if joints is None:
            continue
        robot = robot_of(scenario)
        count = len(robot.q_seed)
        if len(joints) != count:
            raise ScenarioError(
                f"task.q_{end}: expected {count} numbers, as in robot.q_seed, not {len(joints)}"
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
        q_ends[end] = q
    return q_ends


def follow_joints(scenario: Scenario, stated: Collection[str] = ()) -> None:
    """Sets the tool's position and orientation at start and goal in the task to the poses at the
    configurations `task.q_start` and `task.q_goal`.

    Start or goal remains unchanged if its configuration is null.

    Args:
        scenario: scenario, modified in place.
        stated: names of the task's fields that remain unchanged, because the user has set them;
            `end_positions` checks that they agree with the configurations.

    Raises:
        ScenarioError: for a wrong number of joints, a joint outside its limits, or a scenario
            without a robot.
    """
    task = scenario.task
    if task.q_start is None and task.q_goal is None:
        return
    if scenario.robot is None:
        end = "goal" if task.q_start is None else "start"
        raise ScenarioError(f"task.q_{end}: requires a robot; the scenario has null")
    for end, q in joint_ends(scenario).items():
        (X_WE,) = make_robot_plant(scenario.robot).tool_poses(q[None])
        if end not in stated:
            setattr(task, end, X_WE.translation().tolist())
        if f"rpy_{end}" not in stated:
            setattr(task, f"rpy_{end}", RollPitchYaw(X_WE.rotation()).vector().tolist())


def posture_guide(s: FloatArray, q_start: FloatArray, q_goal: FloatArray) -> FloatArray:
    """Computes nominal postures (T, n), which the arm tracks in its null space, at normalized times
    s (T,) [rad].

    The postures are q(s) = q_start + m(s) (q_goal - q_start), with the minimum-jerk profile m from
    0 to 1.

    Args:
        s: (T,) normalized times: 0 at the start and 1 at the end of the motion.
        q_start: (n,) configuration at the start [rad].
        q_goal: (n,) configuration at the goal [rad].
    """
    share = minimum_jerk_profile(np.clip(s, 0.0, 1.0))
    return q_start + share[:, None] * (q_goal - q_start)


def start_positions(scenario: Scenario) -> FloatArray:
    """Returns the configuration (nq,) of the robot at the start of the motion [rad, m].

    Raises:
        ScenarioError: for a start or goal that is out of reach.
    """
    return end_positions(scenario)[0]


def end_positions(scenario: Scenario) -> tuple[FloatArray, FloatArray]:
    """Computes the configurations (nq,) of the robot at the start and at the last goal of the
    motion [rad, m].

    The configurations are `task.q_start` and `task.q_goal` if given, otherwise solutions of the
    inverse kinematics. All goals of `task.goal_moves` are checked, too.

    Raises:
        ScenarioError: naming the start or goal, or the entry of `task.goal_moves`, that is out of
            reach or contradicts `task.q_start` or `task.q_goal`.
    """
    robot_plant = make_robot_plant(robot_of(scenario))
    R_WS, R_WG = end_rotations(scenario)
    seed, q_ends = home_positions(robot_of(scenario)), joint_ends(scenario)
    places = {"start": scenario.task.start, "goal": scenario.task.goal}
    places |= {f"goal_moves[{row}]": move[1:] for row, move in enumerate(scenario.task.goal_moves)}
    for name, place in places.items():
        X_WE = RigidTransform(R_WS if name == "start" else R_WG, np.asarray(place))
        if name in q_ends:
            (of_joints,) = robot_plant.tool_poses(q_ends[name][None])
            if not of_joints.IsNearlyEqualTo(X_WE, _POSE_TOLERANCE):
                p = np.round(of_joints.translation(), 4).tolist()
                rpy = np.round(RollPitchYaw(of_joints.rotation()).vector(), 4).tolist()
                raise ScenarioError(
                    f"task.{name}, task.rpy_{name}: task.q_{name} has the tool at {p} m, {rpy} "
                    "rad; remove one of the two"
                )
            continue
        with field_errors(f"task.{name}", ValueError):
            q_ends[name] = solve_tool_pose(
                robot_plant.plant, robot_plant.tool_frame.name(), X_WE, seed
            )
    return q_ends["start"], q_ends[name]
