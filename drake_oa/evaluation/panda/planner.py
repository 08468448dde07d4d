"""Planners that know all obstacles exactly, to determine which scenes of an evaluation have a
solution.

Resting obstacles (`run_planner`): OMPL's RRT-Connect (Kuffner and LaValle, ICRA 2000) plans in the
joint space of the arm. It plans from the start configuration to the goal configuration that the
scenario's task specifies (`task.q_goal`), or else to configurations with the tool at the goal pose.
Between start and goal the tool's orientation is free, so that the planner may use every motion of
the evaluated methods, and more. A valid state is within the joint limits, and the clearance of the
moving links to every obstacle is at least the minimum clearance. In a valid state the robot touches
neither the environment (table) nor itself (Drake's `SceneGraphCollisionChecker`). Requires the
extra `baselines`: pip install 'drake_oa[baselines]'.

Moving obstacles with known trajectories (`find_motion`): a tree grows from the start at time 0;
each node is a configuration at rest at a time. A random edge waits, and then moves to another
configuration in minimum time (`bang_motions`). From each node at which the arm can stay until all
obstacles are at rest, RRT-Connect (`plan_path`) searches a path among the resting obstacles to the
goal. A resulting motion is a proof that the scene has a solution: it is within the limits of
position, velocity and acceleration, and collision-free by enclosing spheres. Without a motion
nothing is proven.

The limits count states, not seconds: same scenario, seed and limits give the same plan.
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
"""Default minimum clearance between the whole robot and resting obstacles in a plan [m]."""
STATES = 40_000
"""Default maximum number of states that RRT-Connect checks for one path among resting obstacles."""
_CHECK_STEP = 0.03
"""Joint-space distance between neighboring configurations at which RRT-Connect checks an edge for
collisions [rad]."""
_MAX_STEP = 0.6
"""Maximum joint-space length of an edge of the trees in RRT-Connect [rad]."""
_GOAL_SEEDS = 12
"""Number of random seeds of the inverse kinematics that computes goal configurations for the
planner."""
_SPEED_FRACTION = 0.5
"""Assumed joint speed of a planned path among resting obstacles, as a fraction of the maximum joint
speed [-]."""
_SUBSTEPS = 4
"""Factor by which interpolation multiplies the number of configurations of a planned path, before
contacts and clearances along the path are evaluated."""

MOVING_CLEARANCE = 0.005
"""Minimum clearance of the whole robot to all objects, and between its links, in a plan among
moving obstacles [m]."""
MOVING_STATES = 3_000_000
"""Maximum number of configurations that are checked to find a motion among moving obstacles, which
requires 10 to 25 s of processor time."""
_PATH_STATES = 20_000
"""Maximum number of configurations that one search for a path to the goal checks, among obstacles
that have come to rest."""
_BATCH = 64
"""Number of random motions among moving obstacles that are computed and checked at once."""
_MOTION_STEPS = 150
"""Number of steps of 8 ms of a random motion among moving obstacles, within which the arm comes to
rest again."""
_MAX_JOINT_MOTION = 1.0
"""Maximum displacement of a joint in one random motion among moving obstacles [rad]."""
_MAX_WAIT = 50
"""Maximum number of steps of 8 ms for which the arm waits before it starts a random motion among
moving obstacles."""


def goal_positions(scenario: Scenario, q_goal: FloatArray) -> list[FloatArray]:
    """Returns one or several goal configurations among which the planner may choose.

    If the scenario's task specifies a goal configuration (`task.q_goal`), it is the only goal.
    Otherwise inverse kinematics computes further configurations with the tool at the goal pose.

    Args:
        scenario: scenario with a robot.
        q_goal: (nq,) configuration of the robot at the goal, by `end_positions`; it is the first
            one in the result [rad, m].

    Returns:
        Configurations (nq,) of the robot at the goal [rad, m].
    """
    solution = [q_goal]
    if scenario.task.q_goal is not None:
        return solution
    robot_plant, (_, R_WG) = make_robot_plant(robot_of(scenario)), end_rotations(scenario)
    chain = make_chain(robot_plant.plant, robot_plant.tool_frame, q_goal)
    X_WE = np.append(R_WG.matrix().ravel(), scenario.task.goal)
    near = q_goal[chain.q_index]
    for joints in inverse_kinematics(chain, X_WE, near, seeds=_GOAL_SEEDS, seed=scenario.seed):
        solution.append(q_goal.copy())
        solution[-1][chain.q_index] = joints
    return solution


def run_planner(
    scenario: Scenario, *, clearance: float = CLEARANCE, states: int = STATES
) -> dict[str, Any]:
    """Plans a motion of a scenario among its true obstacles, and evaluates the plan on ground
    truth.

    Args:
        scenario: scenario with a robot.
        clearance: minimum clearance between robot and resting obstacles [m].
        states: maximum number of checked states among resting obstacles.

    Returns:
        Dictionary with these keys. The first four keys are always present; a plan among resting
        obstacles has all others, a plan among moving obstacles only `goal_error` and `duration`:

        - stop_reason: "goal", or the reason in words for the missing plan.
        - ended: `MotionEnd.GOAL`, or `MotionEnd.MISSED` without a plan.
        - wall_time: time of planning [s].
        - states: number of checked configurations; among moving obstacles each path search to the
          goal counts as 20,000 (`_PATH_STATES`).
        - contacts, self_contacts: names of the pairs of bodies in contact, by true geometry.
        - tool_clearance_min, robot_clearance_min: minimum clearance of the tool and of the whole
          robot to obstacles [m]; None: no obstacle.
        - goal_error: distance from the end of the path to the goal [m].
        - duration: duration of the motion [s]; among resting obstacles at half the maximum joint
          speed.
        - path_length: length of the path of the tool point [m].

    Raises:
        ValueError: if no obstacle moves and OMPL is not installed.
    """
    begin = perf_counter()
    if last_change(scenario.obstacles) > 0.0:
        reason, solution = _plan_among_moving(scenario)
    else:
        reason, solution = _plan_at_rest(scenario, clearance, states)
    return {
        "stop_reason": reason or "goal",
        "ended": MotionEnd.MISSED if reason else MotionEnd.GOAL,
        "wall_time": perf_counter() - begin,
        **solution,
    }


def _plan_at_rest(scenario: Scenario, clearance: float, states: int) -> tuple[str, dict[str, Any]]:
    """Plans a path among resting obstacles by OMPL's RRT-Connect.

    Args:
        scenario: scenario with a robot.
        clearance: minimum clearance between robot and obstacles [m].
        states: maximum number of checked states.

    Returns:
        The reason for a missing plan ("" if there is a plan), and a dictionary: `states`, the
        number of checked configurations, and only with a plan its contacts, clearances [m], goal
        error [m], duration [s] and path length [m], with the keys of `run_planner`.
    """
    base, geometric, util = (
        import_extra(f"ompl.{name}", "baselines") for name in ("base", "geometric", "util")
    )
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(1 + scenario.seed)
    checker = make_collision_checker(scenario, tool_padding=clearance, link_padding=clearance)
    of_robot, n = make_robot_plant(robot_of(scenario)).limits, len(robot_of(scenario).q_seed)
    lower, upper, checked_count = of_robot.position_lower[:n], of_robot.position_upper[:n], 0

    def is_free(q: FloatArray) -> bool:
        nonlocal checked_count
        checked_count += 1
        return bool(checker.CheckConfigCollisionFree(q))

    q_start, q_goal = end_positions(scenario)
    goals = [q for q in goal_positions(scenario, q_goal) if is_free(q)]
    if not is_free(q_start):
        return "start configuration in collision", {"states": checked_count}
    if not goals:
        return "all goal configurations in collision", {"states": checked_count}
    last = checked_count + states
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
    information.setStateValidityCheckingResolution(_CHECK_STEP / space.getMaximumExtent())
    setup.setStartState(state_of(q_start))
    targets = base.GoalStates(information)
    for q in goals:
        targets.addState(state_of(q))
    setup.setGoal(targets)
    planner = geometric.RRTConnect(information)
    planner.setRange(_MAX_STEP)
    setup.setPlanner(planner)
    setup.solve(base.PlannerTerminationCondition(lambda: checked_count >= last))
    if not setup.haveExactSolutionPath():
        return f"no path found in {states} states", {"states": checked_count}
    setup.simplifySolution()
    solution = setup.getSolutionPath()
    solution.interpolate()
    solution.interpolate(_SUBSTEPS * solution.getStateCount())
    path = np.array([positions(solution.getState(row)) for row in range(solution.getStateCount())])
    metrics = robot_metrics(scenario, path)
    steps = np.abs(np.diff(path[:, :n], axis=0)) / (_SPEED_FRACTION * of_robot.velocity_limit[:n])
    return "", {
        "contacts": list(metrics.contacts),
        "self_contacts": list(metrics.self_contacts),
        "tool_clearance_min": min_clearance(metrics.tool_clearance),
        "robot_clearance_min": min_clearance(metrics.robot_clearance),
        "goal_error": math.dist(metrics.p_WE[-1], scenario.task.goal),
        # In each step, one of the joints moves at `_SPEED_FRACTION` of its maximum speed.
        "duration": float(steps.max(axis=1).sum()),
        "path_length": path_length(metrics.p_WE),
        "states": checked_count,
    }


def _plan_among_moving(scenario: Scenario) -> tuple[str, dict[str, Any]]:
    """Plans a motion among moving obstacles with known trajectories, by a tree of random joint
    motions over time (`find_motion`).

    Returns:
        The reason for a missing plan ("" if there is a plan), and a dictionary: `states`, the
        number of checked configurations, and only with a plan `goal_error` [m] and `duration` [s].
    """
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
    """Planned motion of the arm among moving obstacles, and a path to the goal after these
    obstacles have come to rest.

    Attributes:
        q: (T, n) joint positions, a row every 8 ms (`STEP`), until all obstacles are at rest [rad].
        path: (M, n) corners of the subsequent path to the goal [rad].
    """

    q: FloatArray
    path: FloatArray


def find_motion(
    world: TrueWorld, q_start: FloatArray, goals: FloatArray, seed: int
) -> tuple[JointMotion | None, int]:
    """Searches a collision-free motion among moving obstacles, from rest at time 0 to rest at a
    goal configuration.

    Args:
        world: the arm, its minimum clearance, and the collision geometries along their
            trajectories.
        q_start: (n,) joint positions at time 0 [rad].
        goals: (m, n) goal configurations [rad].
        seed: seed of the random motions.

    Returns:
        The motion (None if none was found), and the number of checked configurations, in which each
        path search to the goal counts as 20,000 (`_PATH_STATES`).
    """
    random, chain, n_configurations = np.random.default_rng(seed), world.arm.chain, 0
    if not any(is_collision_free(world.arm, q) for q in goals):
        return None, len(goals)
    nodes = new = [q_start[None]]
    while n_configurations < MOVING_STATES:
        for motion in new:
            stay = np.tile(motion[-1], (1, max(len(world.ball) - len(motion), 0) + 1, 1))
            clear = int(clear_steps(world, stay, np.array([len(motion) - 1]))[0])
            n_configurations += clear
            if clear == stay.shape[1]:
                n_configurations += _PATH_STATES
                path = plan_path(
                    world.arm, motion[-1], goals, max_configurations=_PATH_STATES, seed=seed
                )
                if len(path):
                    return JointMotion(np.vstack([motion, stay[0, 1:]]), path), n_configurations
        # Extend the later of two random nodes, so that the tree soon reaches the trajectories' end.
        pairs = random.integers(len(nodes), size=(_BATCH, 2)).tolist()
        longest_motions = [max((nodes[row] for row in pair), key=len) for pair in pairs]
        q = np.array([motion[-1] for motion in longest_motions])
        way = random.uniform(chain.lower, chain.upper, q.shape) - q
        way *= (
            _MAX_JOINT_MOTION * random.random((_BATCH, 1)) / np.abs(way).max(axis=1, keepdims=True)
        )
        legs = np.clip(np.stack([q, q + way], axis=1), chain.lower, chain.upper)
        switch = random.integers(0, _MAX_WAIT + 1, _BATCH)
        motions = bang_motions(world, q, np.zeros_like(q), legs, switch, _MOTION_STEPS)
        first = np.array([len(motion) - 1 for motion in longest_motions])
        counts = clear_steps(world, motions, first)
        n_configurations += _BATCH + int(counts.sum())
        grown = zip(longest_motions, motions, counts, strict=True)
        new = [
            np.vstack([before, more[1:]]) for before, more, count in grown if count > _MOTION_STEPS
        ]
        nodes = nodes + new
    return None, n_configurations
