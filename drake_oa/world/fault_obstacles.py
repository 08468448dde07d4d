"""The obstacles that faults bring into the world."""

from __future__ import annotations

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.geometry.shapes import Box, Sphere
from drake_oa.scenario.faults import GoalBlocked, StartInContact
from drake_oa.scenario.obstacles import Obstacle

PARKED_BEYOND = 1.2
"""How far beyond the goal the ball of `GoalBlocked` waits [m].

From a goal in reach that is farther from the robot than the start, it is out of reach.
"""
_TRAVEL = 0.4
"""Time of the ball's way to the goal, and of that back [s]."""
_PLATE = (0.006, 0.05, 0.03)  # thickness, width, height [m]
_NEAR = 0.005
"""Corners of the tool this near to its farthest one face the plate [m]."""
_FOAM = 1000.0
"""Stiffness of the plate, below that of the held tool [N/m]."""
_COLOR = [0.75, 0.2, 0.2, 1.0]


def goal_ball(fault: GoalBlocked, start: FloatArray, goal: FloatArray, name: str) -> Obstacle:
    """The ball of a `GoalBlocked`, which takes 0.4 s for each of its ways, there and back.

    It comes from beyond the goal, level, along the line from the start, and is over the goal
    from `start` to `start + duration`; one that starts sooner than 0.4 s comes faster, or is
    there at time 0.

    Args:
        fault: when, and how large.
        start: (3,) of the task, in the world [m].
        goal: (3,) of the task, in the world [m].
        name: of the obstacle.
    """
    begin, end = fault.start, fault.start + fault.duration
    beyond = (-PARKED_BEYOND * _backward(start, goal)).tolist()
    coming = [[max(0.0, begin - _TRAVEL), *beyond]] if begin > 0.0 else []
    there = [[begin, 0.0, 0.0, 0.0], [end, 0.0, 0.0, 0.0]]
    return Obstacle(
        name=name,
        shapes=[Sphere(radius=fault.radius)],
        translation=[float(x) for x in goal],
        color=_COLOR,
        waypoints=[*coming, *there, [end + _TRAVEL, *beyond]],
    )


def _backward(start: FloatArray, goal: FloatArray) -> FloatArray:
    """(3,) the level direction from goal to start; towards the robot where there is none."""
    away = np.array([start[0] - goal[0], start[1] - goal[1], 0.0])
    length = np.linalg.norm(away)
    return np.array([-1.0, 0.0, 0.0]) if length < 1e-6 else away / length


def start_plate(
    fault: StartInContact, corners: FloatArray, start: FloatArray, goal: FloatArray, name: str
) -> Obstacle:
    """The plate of a `StartInContact`: upright, behind the tool, and soft.

    A hard one would throw the tool off at once, and the motion would not start in contact.

    Args:
        fault: how far it overlaps.
        corners: (K, 3) of the tool about its point E at the start, in the world's
            orientation [m].
        start: (3,) where E starts [m].
        goal: (3,) where it should go [m].
        name: of the obstacle.
    """
    away = _backward(start, goal)
    reach = corners @ away
    touched = corners[reach >= reach.max() - _NEAR]
    middle = 0.5 * (touched.min(axis=0) + touched.max(axis=0))
    p_EO = middle + (reach.max() - middle @ away - fault.depth + 0.5 * _PLATE[0]) * away
    return Obstacle(
        name=name,
        shapes=[Box(size=list(_PLATE))],
        translation=[float(x) for x in np.asarray(start) + p_EO],
        rpy=[0.0, 0.0, float(np.arctan2(away[1], away[0]))],
        stiffness=_FOAM,
        color=_COLOR,
    )
