"""What only shows when a scenario is built: whether all of it can be, and what its ends leave."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.config import ScenarioError
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import RobotJudge
from drake_oa.runs.report import feasible_clearance_of
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.task_joints import end_positions
from drake_oa.world.station import make_station


def unbuildable(scenario: Scenario) -> list[str]:
    """What keeps a scenario from being built, a line each: world, both ends, all layers."""
    steps: list[Callable[[], object]] = [lambda: build_avoidance(scenario)]
    if scenario.robot is not None:
        robot = scenario.robot
        steps = [
            lambda: make_station(DiagramBuilder(), scenario),
            lambda: end_positions(make_robot_plant(robot), scenario),
            *steps,
        ]
    found: dict[str, None] = {}
    for step in steps:
        try:
            step()
        except (ScenarioError, RuntimeError, OSError) as error:
            found[str(error)] = None
    return list(found)


def end_rows(scenario: Scenario) -> tuple[list[tuple[str, str, str, str]], list[str]]:
    """What start and goal leave the arm, and what can be kept between them.

    Returns:
        Rows: which end, clearance of the tool and of any link, what is touched; and notes.
    """
    judge = RobotJudge(scenario)
    if scenario.robot is None:
        raise ScenarioError("robot: this scenario has null")
    rows = []
    for name, q in zip(
        ("start", "goal"), end_positions(make_robot_plant(scenario.robot), scenario), strict=True
    ):
        at = judge.metrics(np.atleast_2d(q))
        touched = ", ".join((*at.contacts, *at.self_contacts)) or "nothing"
        rows.append((name, _metres(at.tool_clearance[0]), _metres(at.robot_clearance[0]), touched))
    asked, feasible = scenario.task.clearance, feasible_clearance_of(scenario, judge)
    notes = [f"asked clearance: {asked:g} m"]
    if feasible < asked - 1e-4:
        notes.append(f"start and goal leave {feasible:.3f} m: there is no more to be kept")
    return rows, notes


def _metres(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else "-"
