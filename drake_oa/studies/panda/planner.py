"""The planner as a method on the Panda's scenes: solved or not, judged as the others are.

Nothing is simulated: the plan is followed exactly, at its own times.
"""

from __future__ import annotations

import math
from time import perf_counter
from typing import Any

import numpy as np
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.messages import FloatArray
from drake_oa.runs.metrics import path_length, robot_metrics
from drake_oa.scenario.obstacles import last_change
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.sampling_planner import CLEARANCE, Plan, plan_motion
from drake_oa.world.station import OBSTACLE_PREFIX, make_station

_FINE = 4
"""Instants that are judged for each step of a plan."""
_WAITING = 0.01
"""Time between those that are judged after it [s]."""


def run_planner(
    scenario: Scenario, *, clearance: float = CLEARANCE, states: int | None = None
) -> dict[str, Any]:
    """Plans a scenario's motion and judges the plan.

    Args:
        scenario: with a robot.
        clearance: that the whole robot keeps [m].
        states: see `plan_motion`.

    Returns:
        What `motion_report` gives of a run and `panda_run` keeps; without a plan its
        `stop_reason` says why. `wall_time` is that of planning, `states` how many
        configurations were looked at.

    Raises:
        ValueError: if OMPL is not installed.
    """
    begin = perf_counter()
    plan = plan_motion(scenario, clearance=clearance, states=states)
    seconds = perf_counter() - begin
    found: dict[str, Any] = {
        "contacts": [],
        "self_contacts": [],
        "tool_clearance_min": None,
        "robot_clearance_min": None,
        "goal_error": math.dist(scenario.task.start, scenario.task.goal),
        "duration": None,
        "path_length": 0.0,
        "torque_saturation": 0.0,
        "stop_reason": plan.reason,
        "events": [],
    }
    if len(plan.t):
        found |= _judged(scenario, plan)
    return {**found, "states": plan.states, "wall_time": seconds, "real_time_factor": None}


def _judged(scenario: Scenario, plan: Plan) -> dict[str, Any]:
    """Until all obstacles have ended their courses, the robot at rest at the plan's end."""
    rows = np.arange(len(plan.t))
    fine = np.linspace(0.0, rows[-1], _FINE * rows[-1] + 1)
    q = np.stack([np.interp(fine, rows, joint) for joint in plan.q.T], axis=1)
    t = np.interp(fine, rows, plan.t)
    last = last_change(scenario.obstacles)
    waits = np.arange(t[-1], last, _WAITING)[1:]
    t, q = np.append(t, waits), np.concatenate([q, np.tile(q[-1], (len(waits), 1))])
    metrics = robot_metrics(scenario, q, world_positions(scenario, t))

    def least(clearance: FloatArray) -> float | None:
        return float(clearance.min()) if np.isfinite(clearance).all() else None

    return {
        "contacts": list(metrics.contacts),
        "self_contacts": list(metrics.self_contacts),
        "tool_clearance_min": least(metrics.tool_clearance),
        "robot_clearance_min": least(metrics.robot_clearance),
        "goal_error": math.dist(metrics.p_WE[-1], scenario.task.goal),
        "duration": float(plan.t[-1]),
        "path_length": path_length(metrics.p_WE),
        "stop_reason": "goal",
    }


def world_positions(scenario: Scenario, times: FloatArray) -> FloatArray | None:
    """(T, n) positions of a scenario's world with the moving obstacles on their courses.

    Those of the robot are zero. None where nothing but the robot moves.

    Args:
        scenario: with a robot.
        times: (T,) when [s].
    """
    moving = [item for item in scenario.obstacles if item.driven]
    if not moving:
        return None
    builder = DiagramBuilder()
    station = make_station(builder, scenario, render=False)
    plant = station.plant
    positions = np.zeros((len(times), plant.num_positions()))
    for item in moving:
        instance = plant.GetModelInstanceByName(f"{OBSTACLE_PREFIX}_{item.name}")
        columns = [plant.GetJointByName(axis, instance).position_start() for axis in "xyz"]
        positions[:, columns] = [item.offset_at(float(time)) for time in times]
    return positions
