"""A sampling-based planner on the Panda: which scenes have a solution at all.

OMPL's RRT-Connect (Kuffner and LaValle, ICRA 2000) in the joints of the arm, from the start's
configuration to configurations with the tool, held as the task asks, at the goal, or to the
task's joints there. On the way the tool
may turn as it likes: the planner may do all that the methods may, and more. A state is valid
where the whole robot keeps the clearance to every obstacle, its joint limits, and off the
table and itself.

Where obstacles move, path and timing are planned one after the other (Kant and Zucker, IJRR
1986): RRT-Connect finds paths among the resting obstacles, with the moving ones left out and
frozen at several instants of their courses; the straight motion is tried first. Along each
path the robot may then go on, back or wait, in steps of time: a search of the grid of
configurations and instants finds the earliest arrival after which the robot can stay at the
goal until all courses have ended. That finds no motion which none of these paths carries: what
it solves has a solution, what it does not solve may have one.

The same scenario, seed and limits give the same plan: the limits count states, not seconds.
`run_planner` judges plans among obstacles that rest; no suite runs it among moving ones.

Needs the extra `peers`: pip install 'drake_oa[peers]'.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
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
from drake_oa.scenario.obstacles import Obstacle, last_change
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.planning_scene import PlanningScene

CLEARANCE = 0.025
"""What the whole robot keeps [m]: as near as the supervisor lets a link come to an obstacle."""
STATES = 40_000
"""States that may be looked at for one path among obstacles at rest."""
MOVING_STATES = 12_000
"""The same for each of the paths that are tried among moving ones."""

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
_TICK = 0.05
"""Of the grid of time [s]."""
_INSTANTS = (1.0, 0.0, 0.5, 0.25, 0.75)
"""Of the courses, as shares of their time, at which moving obstacles are frozen."""

Validity = Callable[[FloatArray], bool]


@dataclass(frozen=True, eq=False)
class Plan:
    """A motion, or why there is none.

    Attributes:
        q: (T, nq) positions of the robot; (0, nq) if none was found.
        t: (T,) when [s].
        reason: "" or why there is no motion.
        states: how many were looked at.
    """

    q: FloatArray
    t: FloatArray
    reason: str
    states: int


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


def plan_motion(
    scenario: Scenario,
    *,
    clearance: float = CLEARANCE,
    states: int | None = None,
    seed: int | None = None,
) -> Plan:
    """Plans the motion of a scenario's task.

    Args:
        scenario: with a robot; of its world the table and the `obstacles`.
        clearance: that the whole robot keeps [m].
        states: that may be looked at for one path; None: `STATES`, or `MOVING_STATES`.
        seed: of the planner; None: the scenario's.

    Raises:
        ValueError: if OMPL is not installed.
    """
    check_planner()
    seed = 1 + (scenario.seed if seed is None else seed)
    cell = PlanningScene(scenario_without_obstacles(scenario))
    moving = [item for item in scenario.obstacles if item.driven]
    start, goal = (np.asarray(p, dtype=float) for p in (scenario.task.start, scenario.task.goal))
    task, (R_WS, R_WG) = scenario.task, end_rotations(scenario)
    try:
        if task.q_start is None:
            q_start = cell.tool_down(start, R_WE=R_WS)
        else:
            q_start = cell.positions(task.q_start)
        if task.q_goal is None:
            goals = _goal_positions(cell, goal, R_WG, seed)
        else:
            goals = [cell.positions(task.q_goal)]
    except ValueError as error:
        return _no_plan(cell, f"{error}", 0)
    is_free = _Counted(lambda q: cell.is_free(q, clearance))
    if not moving:
        cell.put(scenario.obstacles)
        path, reason = _connect(cell, is_free, q_start, goals, states or STATES, seed)
        if path is None:
            return _no_plan(cell, reason, is_free.count)
        return Plan(path, _paced(cell, path), "", is_free.count)
    reason = "no path found"
    for path in _candidates(
        cell, scenario.obstacles, is_free, q_start, goals, goal, states or MOVING_STATES, seed
    ):
        found = _in_time(cell, scenario.obstacles, path, clearance)
        if found is not None:
            return Plan(*found, "", is_free.count)
        reason = "no timing found along the paths"
    return _no_plan(cell, reason, is_free.count)


def scenario_without_obstacles(scenario: Scenario) -> Scenario:
    """The same world with nothing under `obstacles`: they are put into the cell."""
    return replace(scenario, obstacles=[])


def _no_plan(cell: PlanningScene, reason: str, states: int) -> Plan:
    q = np.empty((0, cell.num_positions))
    return Plan(q, np.empty(0), reason, states)


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


def _paced(cell: PlanningScene, path: FloatArray) -> FloatArray:
    """(T,) times at which a path is passed [s]: some joint goes at its share of the limit."""
    speeds = _SPEED * cell.arm_speeds
    steps = np.abs(np.diff(path[:, : len(speeds)], axis=0)) / speeds
    return np.concatenate([[0.0], np.cumsum(steps.max(axis=1))])


def _candidates(
    cell: PlanningScene,
    obstacles: Sequence[Obstacle],
    is_free: _Counted,
    q_start: FloatArray,
    goals: Sequence[FloatArray],
    goal: FloatArray,
    states: int,
    seed: int,
) -> Iterator[FloatArray]:
    """Paths that are free of the resting obstacles."""
    moving = [item for item in obstacles if item.driven]
    resting = [item for item in obstacles if not item.driven]
    cell.put(resting)
    straight = cell.straight_motion(cell.tool_point(q_start), goal)
    if straight is not None:
        straight = _dense(straight)
        if all(map(is_free, straight)):
            yield straight
    end = last_change(moving)
    worlds: list[tuple[Sequence[Obstacle], float]] = [(resting, 0.0)]
    worlds += [(obstacles, share * end) for share in _INSTANTS]
    for number, (world, time) in enumerate(worlds):
        cell.put(world, time)
        path, _ = _connect(cell, is_free, q_start, goals, states, seed + number)
        if path is not None:
            yield path


def _in_time(
    cell: PlanningScene, obstacles: Sequence[Obstacle], path: FloatArray, clearance: float
) -> tuple[FloatArray, FloatArray] | None:
    """The earliest arrival to stay along a path, on a grid of its configurations and of time.

    Within a step of time the robot goes on or back by one configuration, or waits.

    Returns:
        (T, nq) positions and (T,) times [s]; None if it does not arrive.
    """
    paced = _paced(cell, path)
    places = np.arange(0.0, paced[-1] + _TICK, _TICK)
    q = np.stack([np.interp(places, paced, joint) for joint in path.T], axis=1)
    end = last_change(obstacles)
    ticks = int(np.ceil(end / _TICK))
    stays = _stays_free(cell, obstacles, q[-1], ticks, clearance)
    layers = ticks + len(q) + 1
    reached = np.zeros((layers, len(q)), bool)
    at_rest: dict[int, bool] = {}
    reached[0, 0] = True
    for layer in range(1, layers):
        time = layer * _TICK
        before = reached[layer - 1]
        near = before.copy()
        near[1:] |= before[:-1]
        near[:-1] |= before[1:]
        if not near.any():
            return None
        if time <= end + _TICK:
            cell.put(obstacles, time)
        for place in np.flatnonzero(near).tolist():
            if time <= end:
                free = cell.is_free(q[place], clearance)
            else:
                if place not in at_rest:
                    at_rest[place] = cell.is_free(q[place], clearance)
                free = at_rest[place]
            reached[layer, place] = free
        if reached[layer, -1] and layer >= stays:
            return _traced(reached[: layer + 1], q)
    return None


def _stays_free(
    cell: PlanningScene, obstacles: Sequence[Obstacle], q: FloatArray, last: int, clearance: float
) -> float:
    """The first tick after which (nq,) positions q are free up to the last one; inf: none."""
    for tick in range(last, -1, -1):
        cell.put(obstacles, tick * _TICK)
        if not cell.is_free(q, clearance):
            return tick + 1 if tick < last else np.inf
    return 0


def _traced(reached: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The way through the grid to its last configuration at its last instant."""
    place = len(q) - 1
    places = [place]
    for before in reached[-2::-1]:
        # Rather from behind than by waiting, rather by waiting than back.
        place = next(p for p in (place - 1, place, place + 1) if 0 <= p < len(q) and before[p])
        places.append(place)
    places.reverse()
    return q[places], _TICK * np.arange(len(places), dtype=float)


_FINE = 4
"""Instants that are judged for each step of a plan."""


def run_planner(
    scenario: Scenario, *, clearance: float = CLEARANCE, states: int | None = None
) -> dict[str, Any]:
    """Plans a scenario's motion among obstacles at rest and judges the plan.

    Args:
        scenario: with a robot, whose obstacles rest.
        clearance: that the whole robot keeps [m].
        states: see `plan_motion`.

    Returns:
        What `motion_report` gives of a run and `run_and_judge` keeps; without a plan its
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
        "ended": MotionEnd.MISSED,
        "events": [],
    }
    if len(plan.t):
        found |= _judged(scenario, plan)
    return {**found, "states": plan.states, "wall_time": seconds, "real_time_factor": None}


def _judged(scenario: Scenario, plan: Plan) -> dict[str, Any]:
    """Metrics of a plan among obstacles at rest, see `run_planner`."""
    rows = np.arange(len(plan.t))
    fine = np.linspace(0.0, rows[-1], _FINE * rows[-1] + 1)
    q = np.stack([np.interp(fine, rows, joint) for joint in plan.q.T], axis=1)
    metrics = robot_metrics(scenario, q)

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
        "ended": MotionEnd.GOAL,
    }
