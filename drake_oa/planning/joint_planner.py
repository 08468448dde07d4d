"""A path of the whole arm from one configuration to another, where no motion of the tool clears.

OMPL's RRT-Connect (J. J. Kuffner and S. M. LaValle, ICRA 2000; I. A. Sucan et al., IEEE RAM 2012)
in the joints, made shorter and smooth by OMPL's path simplifier. A way between two configurations
is looked at in steps as long as the clearance it keeps allows (`ways_clear`), compiled; so a
decision of a table-top scene takes some ten milliseconds.

The same world, ends, seed and limit give the same path: the limit counts configurations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.common.thinking import count
from drake_oa.planning.arm_world import ArmWorld, exceeds, share_clear

_RANGE = 0.4
"""Longest step of the trees [rad]: of ten cages from MotionBenchMaker 5 are solved among 100,000
configurations, 4 with 0.8, one with 1.6; shelves and boxes take the same time."""


@dataclass(frozen=True, eq=False)
class JointPath(Frozen):
    """What was found.

    Attributes:
        q: (T, n) corners of the path, from start to goal [rad]; (0, n): none was found.
        reason: "" or why none was.
        looked_at: how many configurations were.
    """

    q: FloatArray
    reason: str = ""
    looked_at: int = 0


class _Count:
    """How many configurations have been looked at."""

    def __init__(self) -> None:
        self.total = 0


def plan_path(
    world: ArmWorld, q_start: FloatArray, goals: FloatArray, *, most: int, seed: int = 0
) -> JointPath:
    """A path that keeps what is asked.

    Args:
        world: what is to be kept clear of, and what is asked.
        q_start: (n,) where it begins [rad].
        goals: (m, n) where it may end [rad].
        most: configurations that may be looked at.
        seed: of the random trees, above 0.

    Returns:
        The path, or why there is none.
    """
    n, counted = len(q_start), _Count()
    if not exceeds(world, q_start):
        return JointPath(np.zeros((0, n)), "the start does not keep the clearance")
    free = [q for q in goals if exceeds(world, q)]
    if not free:
        return JointPath(np.zeros((0, n)), "no configuration at the goal keeps the clearance")
    from ompl import base, geometric, util

    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(seed)
    space, bounds = base.RealVectorStateSpace(n), base.RealVectorBounds(n)
    for joint in range(n):
        bounds.setLow(joint, float(world.chain.lower[joint]))
        bounds.setHigh(joint, float(world.chain.upper[joint]))
    space.setBounds(bounds)
    information = base.SpaceInformation(space)

    def values(state: Any) -> FloatArray:
        return np.array([state[joint] for joint in range(n)])

    def state_of(q: FloatArray) -> Any:
        state = information.allocState()
        for joint in range(n):
            state[joint] = float(q[joint])
        return state

    def is_free(state: Any) -> bool:
        counted.total += 1
        return exceeds(world, values(state))

    class Ways(base.MotionValidator):
        def checkMotion(self, one: Any, other: Any, *_: Any) -> bool:
            share, looked_at = share_clear(world, values(one), values(other))
            counted.total += looked_at
            return bool(share == 1.0)

    information.setStateValidityChecker(is_free)
    information.setMotionValidator(Ways(information))
    information.setup()
    problem, targets = base.ProblemDefinition(information), base.GoalStates(information)
    problem.addStartState(state_of(q_start))
    for q in free:
        targets.addState(state_of(q))
    problem.setGoal(targets)
    planner = geometric.RRTConnect(information)
    planner.setRange(_RANGE)
    planner.setProblemDefinition(problem)
    planner.setup()
    planner.solve(base.PlannerTerminationCondition(lambda: counted.total >= most))
    found = JointPath(np.zeros((0, n)), f"no path among {most} configurations", counted.total)
    if problem.hasExactSolution():
        path = problem.getSolutionPath()
        simplifier = geometric.PathSimplifier(information)
        simplifier.reduceVertices(path)
        simplifier.partialShortcutPath(path)
        corners = [values(path.getState(k)) for k in range(path.getStateCount())]
        found = JointPath(np.array(corners), "", counted.total)
    count(configurations=counted.total)
    return found
