"""A search for a motion of the arm among the true courses of all obstacles, to tell which scenes
have a solution at all.

A tree of configurations at rest, each at a time, grows from the start by random motions: the arm
waits, and then goes to another configuration as fast as its joints can (`bang_motions`). From each
node at which it could stay until all obstacles rest, RRT-Connect (`plan_path`) looks for a path
among them to the goal. A motion that is found is within the limits of position, velocity and
acceleration and, by enclosing spheres, clear: a proof. That none is found proves nothing.

The same scenario, seed and limit give the same motion: the limit counts configurations, not
seconds.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.planning.arm_world import exceeds
from drake_oa.planning.joint_planner import plan_path
from drake_oa.runs.motion_log import MotionEnd
from drake_oa.scenario.end_poses import end_positions
from drake_oa.scenario.scenario import Scenario
from drake_oa.studies.panda.planner import goal_positions
from drake_oa.studies.panda.true_world import (
    STEP,
    TrueWorld,
    bang_motions,
    clear_steps,
    make_true_world,
)

STATES = 3_000_000
"""Maximum number of configurations that are checked: 10 to 25 s of processor time."""
CLEARANCE = 0.005
"""Clearance of the whole robot to all solids and itself [m]."""
_PATH_STATES = 20_000
"""Maximum number of configurations that one search among resting obstacles checks."""
_MOTIONS, _STEPS = 64, 150
"""Number of motions that are tried at once, and of their steps: within them each comes to rest."""
_RANGE = 1.0
"""Maximum way of a joint in one motion [rad]."""
_WAIT = 50
"""Maximum number of steps for which the arm waits before a motion."""


def run_oracle(scenario: Scenario) -> dict[str, Any]:
    """Searches a motion in a scenario with a robot.

    Returns:
        What `planner.run_planner` returns, but for clearances, path length and goal error.
    """
    begin, (q_start, q_goal) = perf_counter(), end_positions(scenario)
    world = make_true_world(scenario, CLEARANCE)
    chain, goals = world.arm.chain, np.array(goal_positions(scenario, q_goal))
    motion, states = find_motion(
        world, q_start[chain.q_index], goals[:, chain.q_index], seed=scenario.seed
    )
    found = {"states": states, "wall_time": perf_counter() - begin}
    if motion is None:
        return {"stop_reason": "no motion found", "ended": MotionEnd.MISSED, **found}
    seconds = (np.abs(np.diff(motion.path, axis=0)) / chain.speed).max(axis=1).sum()
    return {
        "contacts": [],
        "self_contacts": [],
        "goal_error": 0.0,
        "duration": STEP * (len(motion.q) - 1) + float(seconds),
        "stop_reason": "goal",
        "ended": MotionEnd.GOAL,
        **found,
    }


class JointMotion(NamedTuple):
    """Motion (T, n) of the arm, a row every `STEP`, then a path (M, n) among resting obstacles."""

    q: FloatArray
    path: FloatArray


def find_motion(
    world: TrueWorld, q_start: FloatArray, goals: FloatArray, *, states: int = STATES, seed: int = 0
) -> tuple[JointMotion | None, int]:
    """Searches a motion from rest at time 0 to rest at a goal.

    Args:
        world: the arm, its clearance and the solids.
        q_start: (n,) positions at first [rad].
        goals: (m, n) positions at the goal [rad].
        states: maximum number of configurations to check.
        seed: of the random motions.

    Returns:
        The motion, or None, and the number of configurations that were checked.
    """
    random, chain, checked = np.random.default_rng(seed), world.arm.chain, 0
    if not any(exceeds(world.arm, q) for q in goals):
        return None, len(goals)
    nodes = new = [q_start[None]]
    while checked < states:
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
        way *= _RANGE * random.random((_MOTIONS, 1)) / np.abs(way).max(axis=1, keepdims=True)
        legs = np.clip(np.stack([q, q + way], axis=1), chain.lower, chain.upper)
        switch = random.integers(0, _WAIT + 1, _MOTIONS)
        motions = bang_motions(world, q, np.zeros_like(q), legs, switch, _STEPS)
        counts = clear_steps(world, motions, np.array([len(motion) - 1 for motion in picked]))
        checked += _MOTIONS + int(counts.sum())
        grown = zip(picked, motions, counts, strict=True)
        new = [np.vstack([before, more[1:]]) for before, more, count in grown if count > _STEPS]
        nodes = nodes + new
    return None, checked
