"""Checks of a scenario that require its diagram, and the clearances at start and goal."""

from __future__ import annotations

from collections.abc import Callable

from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.config import ScenarioError
from drake_oa.common.console import Column, TextTable
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.robot.grasped_object import tool_links
from drake_oa.runs.metrics import MotionMetrics, clearance_evaluator
from drake_oa.runs.report import achievable_clearance_of
from drake_oa.scenario.end_poses import end_positions
from drake_oa.scenario.obstacles import OBSTACLE_PREFIX
from drake_oa.scenario.scenario import Scenario
from drake_oa.world.station import make_station


def unbuildable(scenario: Scenario) -> list[str]:
    """Returns the errors of building a scenario, a line each: world, both ends, all layers."""
    steps: list[Callable[[], object]] = [lambda: build_avoidance(scenario)]
    if scenario.robot is not None:
        steps = [
            lambda: make_station(DiagramBuilder(), scenario),
            lambda: end_positions(scenario),
            *steps,
        ]
    found: dict[str, None] = {}
    for step in steps:
        try:
            step()
        except (ScenarioError, RuntimeError, OSError) as error:
            found[str(error)] = None
    return list(found)


def end_contacts(scenario: Scenario) -> str:
    """Returns one line that names contacts which make a motion impossible; "" without any.

    Those are contacts of the robot at the start, and of the tool at the goal: there the arm may
    take another posture, and moving obstacles may have left.
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
        f"task.{end}: contact of {', '.join(found)}; move it or the obstacle"
        for end, found in pairs.items()
        if found
    )


def _ends(scenario: Scenario) -> list[MotionMetrics]:
    """Returns the metrics of the robot at the start and at the goal."""
    evaluator = clearance_evaluator(scenario)
    return [evaluator.metrics(q[None]) for q in end_positions(scenario)]


_COLUMNS = (
    Column("end", ""),
    Column("tool", "tool clearance [m]", "{:.3f}"),
    Column("robot", "robot clearance [m]", "{:.3f}"),
    Column("touches", side="left"),
)


def end_table(scenario: Scenario) -> TextTable:
    """Returns a table of clearances and contacts at start and goal.

    The notes name the requested clearance, and the feasible one if it is less.
    """
    rows = [
        {
            "end": name,
            "tool": at.tool_clearance[0],
            "robot": at.robot_clearance[0],
            "touches": ", ".join((*at.contacts, *at.self_contacts)) or "nothing",
        }
        for name, at in zip(("start", "goal"), _ends(scenario), strict=True)
    ]
    requested, feasible = scenario.task.clearance, achievable_clearance_of(scenario)
    notes = [f"requested clearance: {requested:g} m"]
    if feasible < requested - 1e-4:
        notes.append(f"start and goal leave {feasible:.3f} m: there is no more to be kept")
    return TextTable(_COLUMNS, rows, notes)
