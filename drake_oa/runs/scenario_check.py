"""Checks of a scenario before its run: errors of its diagram, and contacts and clearances at start
and goal.
"""

from __future__ import annotations

from collections.abc import Callable

from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.config import ScenarioError
from drake_oa.common.console import Column, TextTable
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.robot.grasped_object import tool_links
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import MotionMetrics, clearance_evaluator
from drake_oa.runs.report import achievable_clearance_of
from drake_oa.scenario.end_poses import end_positions
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.world.station import make_station


def build_problems(scenario: Scenario) -> list[str]:
    """Builds world and diagram of a scenario, solves the inverse kinematics at start and goal, and
    returns the error messages.
    """
    steps: list[Callable[[], object]] = [lambda: build_avoidance(scenario)]
    if scenario.robot is not None:
        steps = [
            lambda: make_station(DiagramBuilder(), scenario),
            lambda: end_positions(scenario),
            *steps,
        ]
    errors: dict[str, None] = {}
    for step in steps:
        try:
            step()
        except (ScenarioError, RuntimeError, OSError) as error:
            errors[str(error)] = None
    return list(errors)


def end_contacts(scenario: Scenario) -> str:
    """Returns one line with the contacts at start or goal that make the task impossible; "" without
    such contacts.

    These are all contacts of the robot at the start, and contacts of the tool with resting objects
    at the goal. Other contacts at the goal do not count, because the arm may arrive in another
    configuration, and moving obstacles may be elsewhere by then.
    """
    if scenario.robot is None:
        return ""
    start, goal = _ends(scenario)
    moving = {f"{OBSTACLE_PREFIX}_{item.name}" for item in scenario.obstacles if item.is_driven}
    tool = tool_links(scenario.robot)
    at_goal = [
        pair
        for pair in goal.contacts
        if pair.split(" - ")[0] in tool and pair.split(" - ")[1] not in moving
    ]
    pairs = {"start": (*start.contacts, *start.self_contacts), "goal": at_goal}
    return "; ".join(
        f"task.{end}: contact of {', '.join(names)}; move it or the obstacle"
        for end, names in pairs.items()
        if names
    )


def _ends(scenario: Scenario) -> list[MotionMetrics]:
    """Computes contacts and clearances of the resting robot, first in its start configuration, then
    in its goal configuration.

    Each result has one instant.
    """
    evaluator = clearance_evaluator(scenario)
    return [evaluator.metrics(q[None]) for q in end_positions(scenario)]


_COLUMNS = (
    Column("end", ""),
    Column("tool", "tool clearance [m]", "{:.3f}"),
    Column("robot", "robot clearance [m]", "{:.3f}"),
    Column("contacts", side="left"),
)
"""Columns of the table of clearances and contacts at start and goal, which `drake-oa check` prints.
"""


def end_table(scenario: Scenario) -> TextTable:
    """Returns a table of the robot's clearances and contacts at start and goal of a scenario.

    Notes below the table state the requested clearance, the achievable clearance if that is less,
    and joints without a limit of speed or torque.
    """
    rows = [
        {
            "end": name,
            "tool": at.tool_clearance[0],
            "robot": at.robot_clearance[0],
            "contacts": ", ".join((*at.contacts, *at.self_contacts)) or "none",
        }
        for name, at in zip(("start", "goal"), _ends(scenario), strict=True)
    ]
    requested, achievable = scenario.task.clearance, achievable_clearance_of(scenario)
    notes = [f"requested clearance: {requested:g} m"]
    if achievable < requested - 1e-4:
        notes.append(f"achievable clearance: {achievable:.3f} m, limited by start or goal")
    notes += filter(None, [make_robot_plant(robot_of(scenario)).limits.note])
    return TextTable(_COLUMNS, rows, notes)
