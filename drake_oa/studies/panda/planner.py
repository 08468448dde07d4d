"""A sampling-based planner on the Panda: which scenes have a solution at all.

OMPL's RRT-Connect (Kuffner and LaValle, ICRA 2000) in the joints of the arm, from the start's
configuration to configurations with the tool, held as the task asks, at the goal, or to the
task's joints there. On the way the tool may turn as it likes: the planner may do all that the
methods may, and more. A state is valid where what moves of the robot keeps the clearance to every
obstacle, its joint limits, and off the table and itself, by Drake's `SceneGraphCollisionChecker`.
Obstacles rest.

The same scenario, seed and limits give the same plan: the limits count states, not seconds.

Needs the extra `peers`: pip install 'drake_oa[peers]'.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib import import_module
from time import perf_counter
from typing import Any

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.robot.arm import inverse_kinematics, make_chain
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import path_length, robot_metrics
from drake_oa.runs.motion_log import MotionEnd
from drake_oa.runs.report import min_clearance
from drake_oa.scenario.end_poses import end_positions, end_rotations
from drake_oa.scenario.scenario import Scenario, robot_of
from drake_oa.studies.panda.differential_ik import make_collision_checker

CLEARANCE = 0.025
"""Clearance of the whole robot [m]: as near as the supervisor lets a link come to an obstacle."""
STATES = 40_000
"""Maximum number of states that are checked for one path."""
_STEP = 0.03
"""Distance between checked states [rad], all joints together."""
_RANGE = 0.6
"""Maximum step of the trees [rad]."""
_GOALS = 12
"""Number of random seeds for configurations at the goal."""
_SPEED = 0.5
"""Fraction of the joints' maximum speeds that a plan uses."""
_FINE = 4
"""Number of judged instants for each step of a plan."""


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


def goal_positions(scenario: Scenario, q_goal: FloatArray) -> list[FloatArray]:
    """Returns positions (nq,) at the goal: several ones unless the task gives the joints."""
    found = [q_goal]
    if scenario.task.q_goal is not None:
        return found
    robot_plant, (_, R_WG) = make_robot_plant(robot_of(scenario)), end_rotations(scenario)
    chain = make_chain(robot_plant.plant, robot_plant.tool_frame, q_goal)
    X_WE = np.append(R_WG.matrix().ravel(), scenario.task.goal)
    near = q_goal[chain.q_index]
    for joints in inverse_kinematics(chain, X_WE, near, seeds=_GOALS, seed=scenario.seed):
        found.append(q_goal.copy())
        found[-1][chain.q_index] = joints
    return found


def _connect(
    is_free: Callable[[FloatArray], bool],
    is_over: Callable[[], bool],
    limits: tuple[FloatArray, FloatArray],
    q_start: FloatArray,
    goals: list[FloatArray],
    seed: int,
) -> FloatArray | None:
    """Searches a path by RRT-Connect.

    Args:
        is_free: whether positions (nq,) are valid.
        is_over: whether the search has to end.
        limits: (n,) lower and upper limits of the arm's joints, the first positions [rad].
        q_start: (nq,) positions at the start [rad, m].
        goals: positions (nq,) at the goal.
        seed: seed of the random numbers.

    Returns:
        (T, nq) positions, or None if no path was found.
    """
    base, geometric, util = (_ompl(name) for name in ("base", "geometric", "util"))
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(1 + seed)
    n = len(limits[0])
    space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
    for joint, (lower, upper) in enumerate(np.array(limits).T.tolist()):
        bounds.setLow(joint, lower)
        bounds.setHigh(joint, upper)
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()

    def positions(state: Any) -> FloatArray:
        return np.array([*(state[joint] for joint in range(n)), *q_start[n:]])

    def state_of(q: FloatArray) -> Any:
        state = space.allocState()
        for joint, value in enumerate(np.clip(q[:n], *limits).tolist()):
            state[joint] = value
        return state

    setup.setStateValidityChecker(lambda state: is_free(positions(state)))
    information.setStateValidityCheckingResolution(_STEP / space.getMaximumExtent())
    setup.setStartState(state_of(q_start))
    targets = base.GoalStates(information)
    for q in goals:
        targets.addState(state_of(q))
    setup.setGoal(targets)
    planner = geometric.RRTConnect(information)
    planner.setRange(_RANGE)
    setup.setPlanner(planner)
    setup.solve(base.PlannerTerminationCondition(is_over))
    if not setup.haveExactSolutionPath():
        return None
    setup.simplifySolution()
    path = setup.getSolutionPath()
    path.interpolate()
    path.interpolate(_FINE * path.getStateCount())
    return np.array([positions(path.getState(row)) for row in range(path.getStateCount())])


def run_planner(
    scenario: Scenario, *, clearance: float = CLEARANCE, states: int = STATES
) -> dict[str, Any]:
    """Plans a scenario's motion among obstacles at rest and judges the plan.

    Args:
        scenario: with a robot, whose obstacles rest.
        clearance: minimum distance between the robot and the obstacles [m].
        states: maximum number of checked states.

    Returns:
        What `motion_report` gives of a run and `run_and_judge` keeps, as far as a plan has it; the
        `stop_reason` says why there is none. `wall_time` is that of planning, `states` how many
        configurations were looked at.

    Raises:
        ValueError: if OMPL is not installed.
    """
    begin, looked_at, path = perf_counter(), 0, None
    checker = make_collision_checker(scenario, tool=clearance, links=clearance, world=0.0, own=0.0)
    of_robot, n = make_robot_plant(robot_of(scenario)).limits, len(robot_of(scenario).q_seed)
    limits = of_robot.position_lower[:n], of_robot.position_upper[:n]

    def is_free(q: FloatArray) -> bool:
        nonlocal looked_at
        looked_at += 1
        return bool(checker.CheckConfigCollisionFree(q))

    q_start, q_goal = end_positions(scenario)
    goals = [q for q in goal_positions(scenario, q_goal) if is_free(q)]
    reason = f"no path found in {states} states"
    if not is_free(q_start):
        reason = "the start is not free"
    elif not goals:
        reason = "no configuration at the goal is free"
    else:
        last = looked_at + states
        path = _connect(is_free, lambda: looked_at >= last, limits, q_start, goals, scenario.seed)
    found = {"states": looked_at, "wall_time": perf_counter() - begin}
    if path is None:
        return {"stop_reason": reason, "ended": MotionEnd.MISSED, **found}
    metrics = robot_metrics(scenario, path)
    steps = np.abs(np.diff(path[:, :n], axis=0)) / (_SPEED * of_robot.velocity_limit[:n])
    return {
        "contacts": list(metrics.contacts),
        "self_contacts": list(metrics.self_contacts),
        "tool_clearance_min": min_clearance(metrics.tool_clearance),
        "robot_clearance_min": min_clearance(metrics.robot_clearance),
        "goal_error": math.dist(metrics.p_WE[-1], scenario.task.goal),
        # Some joint always moves at its fraction of the maximum speed.
        "duration": float(steps.max(axis=1).sum()),
        "path_length": path_length(metrics.p_WE),
        "stop_reason": "goal",
        "ended": MotionEnd.GOAL,
        **found,
    }
