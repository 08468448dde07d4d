"""A sampling-based planner on the Panda: which scenes have a solution at all.

OMPL's RRT-Connect (Kuffner and LaValle, ICRA 2000) in the joints of the arm, from the start's
configuration to configurations with the tool, held as the task asks, at the goal, or to the
task's joints there. On the way the tool may turn as it likes: the planner may do all that the
methods may, and more. A state is valid where the whole robot keeps the clearance to every obstacle,
its joint limits, and off the table and itself. Obstacles rest.

The same scenario, seed and limits give the same plan: the limits count states, not seconds.

Needs the extra `peers`: pip install 'drake_oa[peers]'.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib import import_module
from itertools import pairwise
from time import perf_counter
from typing import Any

import numpy as np
from pydrake.math import RotationMatrix

from drake_oa.common.messages import FloatArray
from drake_oa.runs.metrics import path_length, robot_metrics
from drake_oa.runs.motion_log import MotionEnd
from drake_oa.scenario.end_poses import end_rotations
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.planning_scene import PlanningScene

CLEARANCE = 0.025
"""What the whole robot keeps [m]: as near as the supervisor lets a link come to an obstacle."""
STATES = 40_000
"""States that may be looked at for one path among obstacles at rest."""
_STEP = 0.03
"""Between the states that are looked at on the way [rad], all joints together."""
_RANGE = 0.6
"""Longest step of the trees [rad]."""
_GOALS = 12
"""Seeds from which configurations at the goal are looked for."""
_SAME = 0.05
"""Configurations nearer than this to another are not kept [rad]."""
_SPEED = 0.5
"""Share of the joints' greatest speeds that a plan uses."""
_FINE = 4
"""Instants that are judged for each step of a plan."""

Validity = Callable[[FloatArray], bool]


class _Counted:
    """A validity check that counts."""

    def __init__(self, valid: Validity) -> None:
        self.valid, self.count = valid, 0

    def __call__(self, q: FloatArray) -> bool:
        self.count += 1
        return self.valid(q)


def check_planner() -> None:
    """Raises ValueError if OMPL is not installed."""
    _ompl("base")


def _ompl(module: str) -> Any:
    try:
        return import_module(f"ompl.{module}")
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] != "ompl":
            raise
        raise ValueError(
            "a planner needs the package ompl: pip install 'drake_oa[peers]'"
        ) from error


def _plan(
    scenario: Scenario, cell: PlanningScene, is_free: _Counted, states: int
) -> tuple[FloatArray | None, str]:
    """(T, nq) a path for a scenario's task among its resting obstacles; or the reason for none."""
    task, (R_WS, R_WG) = scenario.task, end_rotations(scenario)
    seed = 1 + scenario.seed
    try:
        if task.q_start is None:
            q_start = cell.tool_down(np.asarray(task.start, dtype=float), R_WE=R_WS)
        else:
            q_start = cell.positions(task.q_start)
        if task.q_goal is None:
            goals = _goal_positions(cell, np.asarray(task.goal, dtype=float), R_WG, seed)
        else:
            goals = [cell.positions(task.q_goal)]
    except ValueError as error:
        return None, f"{error}"
    cell.put(scenario.obstacles)
    return _connect(cell, is_free, q_start, goals, states, seed)


def _goal_positions(
    cell: PlanningScene, goal: FloatArray, R_WG: RotationMatrix, seed: int
) -> list[FloatArray]:
    """Configurations of the tool at the goal, as different ones as a few seeds give.

    Raises:
        ValueError: if the goal is out of reach.
    """
    found = [cell.tool_down(goal, R_WE=R_WG)]
    random, (lower, upper) = np.random.default_rng(seed), cell.arm_limits
    for _ in range(_GOALS):
        q_seed = found[0].copy()
        q_seed[: len(lower)] = random.uniform(lower, upper)
        try:
            q = cell.tool_down(goal, q_seed, R_WG)
        except ValueError:
            continue
        if all(np.abs(q - other).max() > _SAME for other in found):
            found.append(q)
    return found


def _connect(
    cell: PlanningScene,
    is_free: _Counted,
    q_start: FloatArray,
    goals: Sequence[FloatArray],
    states: int,
    seed: int,
) -> tuple[FloatArray | None, str]:
    """(T, nq) a path of RRT-Connect among what was put, in steps of `_STEP`; or why not."""
    if not is_free(q_start):
        return None, "the start is not free"
    goals = [q for q in goals if is_free(q)]
    if not goals:
        return None, "no configuration at the goal is free"
    base, geometric, util = (_ompl(name) for name in ("base", "geometric", "util"))
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(seed)
    (lower, upper), fingers = cell.arm_limits, q_start[len(cell.arm_limits[0]) :]
    n, last = len(lower), is_free.count + states

    def positions(state: Any) -> FloatArray:
        return np.array([*(state[joint] for joint in range(n)), *fingers])

    space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
    for joint in range(n):
        bounds.setLow(joint, float(lower[joint]))
        bounds.setHigh(joint, float(upper[joint]))
    space.setBounds(bounds)
    information = base.SpaceInformation(space)
    information.setStateValidityChecker(lambda state: is_free(positions(state)))
    information.setStateValidityCheckingResolution(_STEP / space.getMaximumExtent())
    information.setup()

    def state_of(q: FloatArray) -> Any:
        state = information.allocState()
        for joint in range(n):
            state[joint] = float(np.clip(q[joint], lower[joint], upper[joint]))
        return state

    problem, targets = base.ProblemDefinition(information), base.GoalStates(information)
    problem.addStartState(state_of(q_start))
    for q in goals:
        targets.addState(state_of(q))
    problem.setGoal(targets)
    planner = geometric.RRTConnect(information)
    planner.setRange(_RANGE)
    planner.setProblemDefinition(problem)
    planner.setup()
    planner.solve(base.PlannerTerminationCondition(lambda: is_free.count >= last))
    if not problem.hasExactSolution():
        return None, f"no path found in {states} states"
    path = problem.getSolutionPath()
    corners = np.array([positions(path.getState(k)) for k in range(path.getStateCount())])
    return _shortened(_dense(corners), is_free), ""


def _dense(corners: FloatArray) -> FloatArray:
    """The polyline in steps of `_STEP` at most."""
    pieces = [corners[:1]]
    for one, other in pairwise(corners):
        steps = max(int(np.ceil(np.linalg.norm(other - one) / _STEP)), 1)
        pieces.append(one + np.linspace(0.0, 1.0, steps + 1)[1:, None] * (other - one))
    return np.concatenate(pieces)


def _shortened(path: FloatArray, is_free: Validity) -> FloatArray:
    """The path with straight lines, where they are free, in place of its detours."""
    first, kept = 0, [path[0]]
    while first < len(path) - 1:
        last = len(path) - 1
        # Halved until the way is straight: a step is always free.
        while last > first + 1:
            line = _dense(path[[first, last]])
            if len(line) < last - first + 1 and all(map(is_free, line)):
                break
            last = first + (last - first) // 2
        kept.append(path[last])
        first = last
    return _dense(np.array(kept))


def _duration(cell: PlanningScene, path: FloatArray) -> float:
    """Time that a path takes [s]: some joint always moves at its share of the limit."""
    speeds = _SPEED * cell.arm_speeds
    steps = np.abs(np.diff(path[:, : len(speeds)], axis=0)) / speeds
    return float(steps.max(axis=1).sum())


def run_planner(
    scenario: Scenario, *, clearance: float = CLEARANCE, states: int = STATES
) -> dict[str, Any]:
    """Plans a scenario's motion among obstacles at rest and judges the plan.

    Args:
        scenario: with a robot, whose obstacles rest.
        clearance: that the whole robot keeps [m].
        states: that may be looked at.

    Returns:
        What `motion_report` gives of a run and `run_and_judge` keeps, as far as a plan has it; the
        `stop_reason` says why there is none. `wall_time` is that of planning, `states` how many
        configurations were looked at.

    Raises:
        ValueError: if OMPL is not installed.
    """
    begin = perf_counter()
    cell = PlanningScene(replace(scenario, obstacles=[]))
    is_free = _Counted(lambda q: cell.is_free(q, clearance))
    path, reason = _plan(scenario, cell, is_free, states)
    found = {"states": is_free.count, "wall_time": perf_counter() - begin}
    if path is None:
        return {"stop_reason": reason, "ended": MotionEnd.MISSED, **found}
    rows = np.arange(len(path))
    fine = np.linspace(0.0, rows[-1], _FINE * rows[-1] + 1)
    q = np.stack([np.interp(fine, rows, joint) for joint in path.T], axis=1)
    metrics = robot_metrics(scenario, q)

    def least(clearance: FloatArray) -> float | None:
        return float(clearance.min()) if np.isfinite(clearance).all() else None

    return {
        "contacts": list(metrics.contacts),
        "self_contacts": list(metrics.self_contacts),
        "tool_clearance_min": least(metrics.tool_clearance),
        "robot_clearance_min": least(metrics.robot_clearance),
        "goal_error": math.dist(metrics.p_WE[-1], scenario.task.goal),
        "duration": _duration(cell, path),
        "path_length": path_length(metrics.p_WE),
        "stop_reason": "goal",
        "ended": MotionEnd.GOAL,
        **found,
    }
