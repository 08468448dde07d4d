"""Policy: the goal, and the movement primitives that go there."""

from __future__ import annotations

import numpy as np
from pydrake.math import RollPitchYaw
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import (
    ConstantVectorSource,
    TrajectorySource,
)

from drake_oa.common.config import ScenarioError
from drake_oa.common.wires import Wires
from drake_oa.diagrams.station import Cell
from drake_oa.policy.dmp import Dmp, imitate, minimum_jerk
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.policy.orientation_dmp import minimum_jerk_orientation
from drake_oa.policy.orientation_integrator import OrientationIntegrator
from drake_oa.scenario.demonstration import demonstrated_path, primitive_constants
from drake_oa.scenario.scenario import (
    Scenario,
)
from drake_oa.scenario.task import goal_trajectory
from drake_oa.scenario.tool_orientation import tool_orientation


def add_policy(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds goal, dmp_integrator and, where the tool's orientation changes, its integrator.

    Reads ellipsoids_W, coupling_parameters, route, speed_scale and evasion, each if offered.
    """
    wires.add("goal", make_goal(scenario), offers={"y0": "goal"})
    wires.add("dmp_integrator", make_dmp_integrator(scenario))
    wires.log("goal", "desired_position", "desired_velocity", "desired_acceleration", "phase")
    wires.export("desired_position", "phase", "policy_state")
    orientation = None if cell is None else make_orientation_integrator(scenario)
    if orientation is not None:
        add_orientation(wires, orientation)


def add_orientation(wires: Wires, system: OrientationIntegrator) -> None:
    """Adds orientation_integrator, which the controller follows."""
    wires.add("orientation_integrator", system)
    wires.log("desired_orientation", "orientation_error")


def make_dmp(scenario: Scenario) -> Dmp:
    """The movement primitive of the task: demonstrated, or minimum jerk.

    Raises:
        ScenarioError: naming the file, if a demonstration cannot be read or imitated.
    """
    task = scenario.task
    if task.demonstration:
        return demonstrated_path(scenario)
    path, t = minimum_jerk(task.start, task.goal, duration=task.duration)
    try:
        return imitate(path, t, **primitive_constants(scenario.policy))
    except ValueError as error:
        raise ScenarioError(f"policy: {error}") from None


def make_goal(scenario: Scenario) -> LeafSystem:
    """What says where the goal is: it stays, or is moved in steps; one port of size 3 [m]."""
    if not scenario.task.goal_moves:
        return ConstantVectorSource(np.asarray(scenario.task.goal))
    return TrajectorySource(goal_trajectory(scenario.task))


def make_dmp_integrator(scenario: Scenario) -> DmpIntegrator:
    """The action level."""
    start = np.asarray(scenario.task.start, dtype=float)
    return DmpIntegrator(make_dmp(scenario), start, config=scenario.policy)


def make_orientation_integrator(scenario: Scenario) -> OrientationIntegrator | None:
    """The action level of the orientation; None: the tool keeps `robot.rpy_WE`.

    Raises:
        ScenarioError: naming the field that does not fit.
    """
    held = tool_orientation(scenario)
    if held is None:
        return None
    return OrientationIntegrator(
        held.primitive, held.R_WS, held.R_WG, period=scenario.policy.period
    )


def make_kept_orientation(scenario: Scenario) -> OrientationIntegrator:
    """An orientation that stays as it is at the start until something else is demonstrated.

    Raises:
        ScenarioError: if the scenario has no robot.
    """
    robot = scenario.robot
    if robot is None:
        raise ScenarioError("robot: this scenario has none that has a tool")
    R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix().matrix()
    return OrientationIntegrator(
        minimum_jerk_orientation(alpha_k=scenario.policy.alpha_k),
        R_WE,
        R_WE,
        period=scenario.policy.period,
    )
