"""Descriptor: obstacles as ellipsoids that the tool dilates."""

from __future__ import annotations

import numpy as np

from drake_oa.common.wires import Wires
from drake_oa.descriptor.descriptor import merged_parts
from drake_oa.descriptor.ellipsoid_descriptor import EllipsoidDescriptor
from drake_oa.diagrams.station import Cell
from drake_oa.regulation.config import Paper
from drake_oa.robot.plant import tool_link_corners
from drake_oa.scenario.scenario import (
    Scenario,
)
from drake_oa.scenario.tool_orientation import held_robots


def add_descriptor(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds ellipsoid_descriptor where there are obstacles: obstacles_W -> ellipsoids_W."""
    if cell is None or "obstacles_W" not in wires:
        return
    goal = None if not scenario.task.goal_moves else "goal"
    wires.add(
        "ellipsoid_descriptor",
        make_ellipsoid_descriptor(scenario),
        reads={"goal": goal},
    )


def make_ellipsoid_descriptor(scenario: Scenario) -> EllipsoidDescriptor:
    """The descriptor, which dilates by the robot's tool, in each of the ways it is held."""
    task = scenario.task
    held = list(map(tool_link_corners, held_robots(scenario)))
    links = [np.concatenate(of_link) for of_link in zip(*held, strict=True)]
    paper = scenario.regulation if isinstance(scenario.regulation, Paper) else None
    fitted = paper is not None and paper.shape == "superquadric"
    return EllipsoidDescriptor(
        np.concatenate(links),
        method="least_squares" if fitted else "enclosing",
        exponent_prior=paper.exponent_prior if fitted and paper is not None else None,
        # A goal that moves comes by a port.
        free_W=[task.start] if task.goal_moves else [task.start, task.goal],
        tool_parts=merged_parts(links),
    )
