"""How the tool is held along the motion of a scenario."""

from __future__ import annotations

import dataclasses as dc
import math

import numpy as np
from pydrake.math import RollPitchYaw, RotationMatrix

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import FloatArray
from drake_oa.policy.orientation_dmp import (
    OrientationDmp,
    demonstrated_goal,
    minimum_jerk_orientation,
    orientation_along,
)
from drake_oa.robot.config import Robot
from drake_oa.scenario.demonstration import demonstrated_orientation, primitive_constants
from drake_oa.scenario.scenario import Scenario, robot_of

_APART = math.radians(10.0)
"""Orientations of the way that stand for all of it are no further apart, on average."""
_FEWEST = 5


@dc.dataclass(frozen=True, eq=False)
class ToolOrientation:
    """The orientation along the motion.

    Attributes:
        primitive: its movement primitive.
        R_WS: (3, 3) R_WE at the start.
        R_WG: (3, 3) R_WE at the goal.
    """

    primitive: OrientationDmp
    R_WS: FloatArray
    R_WG: FloatArray

    def along(self, s: FloatArray) -> FloatArray:
        """(T, 3, 3) orientations at normalised times (T,)."""
        return orientation_along(self.primitive, self.R_WS, self.R_WG, s)

    def samples(self) -> FloatArray:
        """(N, 3, 3) orientations of the whole way, from start to goal."""
        R = self.along(np.linspace(0.0, 1.0, 201))
        # The angle between one and the next, from the trace of the rotation between them.
        cosine = 0.5 * (np.einsum("tij,tij->t", R[1:], R[:-1]) - 1.0)
        angle = np.append(0.0, np.cumsum(np.arccos(np.clip(cosine, -1.0, 1.0))))
        count = max(_FEWEST, math.ceil(angle[-1] / _APART) + 1)
        rows = np.searchsorted(angle, np.linspace(0.0, angle[-1], count))
        return R[np.minimum(rows, len(R) - 1)]


def tool_orientation(scenario: Scenario) -> ToolOrientation | None:
    """The orientation along the motion; None: it stays `robot.rpy_WE`, or there is no robot.

    Start and goal are `task.rpy_start` and `task.rpy_goal`; where one is not given, what the
    demonstration has there, or without orientations in it `robot.rpy_WE`.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    task, robot = scenario.task, scenario.robot
    asked = {"rpy_start": task.rpy_start, "rpy_goal": task.rpy_goal}
    given = [name for name, rpy in asked.items() if rpy is not None]
    if robot is None:
        if given:
            raise ScenarioError(f"task.{given[0]}: needs a robot; this scenario has null")
        return None
    shown = demonstrated_orientation(scenario)
    if shown is None and not given:
        return None
    ends = []
    for rpy, of_demonstration in (
        (task.rpy_start, None if shown is None else shown.first),
        (task.rpy_goal, None if shown is None else shown.last),
    ):
        if rpy is None and of_demonstration is not None:
            ends.append(of_demonstration)
        else:
            ends.append(_matrix(robot.rpy_WE if rpy is None else rpy))
    primitive = shown or minimum_jerk_orientation(**primitive_constants(scenario.policy))
    try:
        demonstrated_goal(primitive, *ends)
    except ValueError as error:
        raise ScenarioError(f"task.rpy_goal: {error}") from None
    return ToolOrientation(primitive, *ends)


def end_rotations(scenario: Scenario) -> tuple[RotationMatrix, RotationMatrix]:
    """R_WE at start and goal.

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
    """The robot with each orientation that stands for the way as its `rpy_WE`; the start's first.

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


def _matrix(rpy: list[float]) -> FloatArray:
    return np.array(RollPitchYaw(rpy).ToRotationMatrix().matrix())
