"""Planners that know all obstacles exactly, to find the scenes that have a solution at all.

Obstacles at rest (`run_planner`): OMPL's RRT-Connect (Kuffner and LaValle, ICRA 2000) in the joints
of the arm, from the start's configuration to configurations with the tool, held as the task asks,
at the goal, or to the task's joints there. On the way the tool may turn as it likes: the planner
may do all that the methods may, and more. A state is valid where what moves of the robot keeps the
clearance to every obstacle, its joint limits, and off the table and itself, by Drake's
`SceneGraphCollisionChecker`. Needs the extra `baselines`: pip install 'drake_oa[baselines]'.

Moving obstacles, whose courses are known: a tree of configurations at rest, each at a time, grows
from the start by random motions (`find_motion`): the arm waits, and then goes to another
configuration as fast as its joints can (`bang_motions`). From each node at which it could stay
until all obstacles rest, RRT-Connect (`plan_path`) looks for a path among them to the goal. A
motion that is found is within the limits of position, velocity and acceleration and, by enclosing
spheres, clear: a proof. That none is found proves nothing.

The same scenario, seed and limits give the same plan: the limits count states, not seconds.
"""

from __future__ import annotations

import math
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from drake_oa.common.files import import_extra
from drake_oa.common.messages import FloatArray
from drake_oa.evaluation.panda.differential_ik import make_collision_checker
from drake_oa.evaluation.panda.true_world import (
    STEP,
    TrueWorld,
    bang_motions,
    clear_steps,
    make_true_world,
)
from drake_oa.planning.collision_model import is_collision_free
from drake_oa.planning.joint_planner import plan_path
from drake_oa.robot.arm import inverse_kinematics, make_chain
from drake_oa.robot.plant import make_robot_plant
from drake_oa.runs.metrics import path_length, robot_metrics
from drake_oa.runs.motion_log import MotionEnd
from drake_oa.runs.report import min_clearance
from drake_oa.scenario.end_poses import end_positions, end_rotations
from drake_oa.scenario.obstacles import last_change
from drake_oa.scenario.scenario import Scenario, robot_of

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

MOVING_CLEARANCE = 0.005
"""Clearance of the whole robot to all solids and itself among moving obstacles [m]."""
MOVING_STATES = 3_000_000
"""Maximum number of configurations that are checked: 10 to 25 s of processor time."""
_PATH_STATES = 20_000
"""Maximum number of configurations that one search among resting obstacles checks."""
_MOTIONS, _STEPS = 64, 150
"""Number of motions that are tried at once, and of their steps: within them each comes to rest."""
_MOVING_RANGE = 1.0
"""Maximum way of a joint in one motion [rad]."""
_WAIT = 50
"""Maximum number of steps for which the arm waits before a motion."""


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


def run_planner(
    scenario: Scenario, *, clearance: float = CLEARANCE, states: int = STATES
) -> dict[str, Any]:
    """Plans a scenario's motion and judges the plan.

    Args:
        scenario: with a robot.
        clearance: minimum distance between the robot and obstacles at rest [m].
        states: maximum number of checked states among obstacles at rest.

    Returns:
        What `motion_report` gives of a run and `run_and_evaluate` keeps, as far as a plan has it; the
        `stop_reason` says why there is none. `wall_time` is that of planning, `states` the number
        of checked configurations.

    Raises:
        ValueError: if obstacles rest and OMPL is not installed.
    """
    begin = perf_counter()
    if last_change(scenario.obstacles) > 0.0:
        reason, found = _plan_among_moving(scenario)
    else:
        reason, found = _plan_at_rest(scenario, clearance, states)
    return {
        "stop_reason": reason or "goal",
        "ended": MotionEnd.MISSED if reason else MotionEnd.GOAL,
        "wall_time": perf_counter() - begin,
        **found,
    }


def _plan_at_rest(scenario: Scenario, clearance: float, states: int) -> tuple[str, dict[str, Any]]:
    """Plans by RRT-Connect; returns why there is no plan, or "", and its figures."""
    base, geometric, util = (
        import_extra(f"ompl.{name}", "baselines") for name in ("base", "geometric", "util")
    )
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(1 + scenario.seed)
    checker = make_collision_checker(scenario, tool=clearance, links=clearance, world=0.0, own=0.0)
    of_robot, n = make_robot_plant(robot_of(scenario)).limits, len(robot_of(scenario).q_seed)
    lower, upper, looked_at = of_robot.position_lower[:n], of_robot.position_upper[:n], 0

    def is_free(q: FloatArray) -> bool:
        nonlocal looked_at
        looked_at += 1
        return bool(checker.CheckConfigCollisionFree(q))

    q_start, q_goal = end_positions(scenario)
    goals = [q for q in goal_positions(scenario, q_goal) if is_free(q)]
    if not is_free(q_start):
        return "the start is not free", {"states": looked_at}
    if not goals:
        return "no configuration at the goal is free", {"states": looked_at}
    last = looked_at + states
    space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
    for joint in range(n):
        bounds.setLow(joint, float(lower[joint]))
        bounds.setHigh(joint, float(upper[joint]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()

    def positions(state: Any) -> FloatArray:
        return np.array([*(state[joint] for joint in range(n)), *q_start[n:]])

    def state_of(q: FloatArray) -> Any:
        state = space.allocState()
        for joint, value in enumerate(np.clip(q[:n], lower, upper).tolist()):
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
    setup.solve(base.PlannerTerminationCondition(lambda: looked_at >= last))
    if not setup.haveExactSolutionPath():
        return f"no path found in {states} states", {"states": looked_at}
    setup.simplifySolution()
    found = setup.getSolutionPath()
    found.interpolate()
    found.interpolate(_FINE * found.getStateCount())
    path = np.array([positions(found.getState(row)) for row in range(found.getStateCount())])
    metrics = robot_metrics(scenario, path)
    steps = np.abs(np.diff(path[:, :n], axis=0)) / (_SPEED * of_robot.velocity_limit[:n])
    return "", {
        "contacts": list(metrics.contacts),
        "self_contacts": list(metrics.self_contacts),
        "tool_clearance_min": min_clearance(metrics.tool_clearance),
        "robot_clearance_min": min_clearance(metrics.robot_clearance),
        "goal_error": math.dist(metrics.p_WE[-1], scenario.task.goal),
        # Some joint always moves at its fraction of the maximum speed.
        "duration": float(steps.max(axis=1).sum()),
        "path_length": path_length(metrics.p_WE),
        "states": looked_at,
    }


def _plan_among_moving(scenario: Scenario) -> tuple[str, dict[str, Any]]:
    """Returns why there is no plan, or "", and its figures."""
    q_start, q_goal = end_positions(scenario)
    world = make_true_world(scenario, MOVING_CLEARANCE)
    chain, goals = world.arm.chain, np.array(goal_positions(scenario, q_goal))
    motion, states = find_motion(
        world, q_start[chain.q_index], goals[:, chain.q_index], scenario.seed
    )
    if motion is None:
        return "no motion found", {"states": states}
    seconds = (np.abs(np.diff(motion.path, axis=0)) / chain.speed).max(axis=1).sum()
    duration = STEP * (len(motion.q) - 1) + float(seconds)
    return "", {"goal_error": 0.0, "duration": duration, "states": states}


class JointMotion(NamedTuple):
    """Motion (T, n) of the arm, a row every `STEP`, then a path (M, n) among resting obstacles."""

    q: FloatArray
    path: FloatArray


def find_motion(
    world: TrueWorld, q_start: FloatArray, goals: FloatArray, seed: int
) -> tuple[JointMotion | None, int]:
    """Searches a motion from rest at time 0 to rest at a goal.

    Args:
        world: the arm, its clearance and the solids.
        q_start: (n,) positions at first [rad].
        goals: (m, n) positions at the goal [rad].
        seed: of the random motions.

    Returns:
        The motion, or None, and the number of configurations that were checked.
    """
    random, chain, checked = np.random.default_rng(seed), world.arm.chain, 0
    if not any(is_collision_free(world.arm, q) for q in goals):
        return None, len(goals)
    nodes = new = [q_start[None]]
    while checked < MOVING_STATES:
        for motion in new:
            stay = np.tile(motion[-1], (1, max(len(world.ball) - len(motion), 0) + 1, 1))
            clear = int(clear_steps(world, stay, np.array([len(motion) - 1]))[0])
            checked += clear
            if clear == stay.shape[1]:
                checked += _PATH_STATES
                path = plan_path(world.arm, motion[-1], goals, most=_PATH_STATES, seed=seed)
                if len(path):
                    return JointMotion(np.vstack([motion, stay[0, 1:]]), path), checked
        # Of two nodes the later one: the tree is to outlast the courses.
        pairs = random.integers(len(nodes), size=(_MOTIONS, 2)).tolist()
        picked = [max((nodes[row] for row in pair), key=len) for pair in pairs]
        q = np.array([motion[-1] for motion in picked])
        way = random.uniform(chain.lower, chain.upper, q.shape) - q
        way *= _MOVING_RANGE * random.random((_MOTIONS, 1)) / np.abs(way).max(axis=1, keepdims=True)
        legs = np.clip(np.stack([q, q + way], axis=1), chain.lower, chain.upper)
        switch = random.integers(0, _WAIT + 1, _MOTIONS)
        motions = bang_motions(world, q, np.zeros_like(q), legs, switch, _STEPS)
        counts = clear_steps(world, motions, np.array([len(motion) - 1 for motion in picked]))
        checked += _MOTIONS + int(counts.sum())
        grown = zip(picked, motions, counts, strict=True)
        new = [np.vstack([before, more[1:]]) for before, more, count in grown if count > _STEPS]
        nodes = nodes + new
    return None, checked
