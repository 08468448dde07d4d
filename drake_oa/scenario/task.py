"""The task block of a scenario, and where its goal is, which may be moved during the motion."""

import math
from collections.abc import Iterator
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass
from pydrake.trajectories import PiecewisePolynomial

from drake_oa.common.config import BLOCK, Angles, Vector3, length
from drake_oa.common.messages import FloatArray

LONGEST = 600.0
"""Maximum duration of a demonstrated motion [s]."""


@dataclass(config=BLOCK)
class Task:
    """The nominal motion, planned without knowledge of the obstacles."""

    start: Vector3 = Field(default=[0.45, -0.45, 0.3])
    """Start of the tool point in the world [m]. Raising it moves the start along the axis."""
    goal: Vector3 = Field(default=[0.45, 0.45, 0.3])
    """Goal of the tool point in the world [m]. Raising it moves the goal along the axis."""
    goal_moves: list[Annotated[list[float], length(4)]] = Field(default_factory=list)
    """Moves of the goal during the motion: rows t, x, y, z [s, m]; from time t on, the goal is at
    this position in the world."""
    duration: float = Field(default=5.0, gt=0.0, le=LONGEST)
    """Duration T of the nominal motion [s]; the avoiding motion takes tau T. Ignored if the
    demonstration has its own times. Raising it moves more slowly."""
    clearance: float = Field(default=0.15, gt=0.0, le=2.0)
    """Requested clearance Delta between the tool and the obstacles [m]. Raising it makes the detour
    around obstacles wider."""
    turn_limit: float | None = Field(default=None, ge=0.0, le=math.pi)
    """Maximum angle by which a maneuver away from an obstacle turns the tool [rad]; null: any.
    Raising it allows more maneuvers."""
    rpy_start: Angles | None = None
    """Roll, pitch and yaw of the tool frame E in the world at the start [rad]; null: those of the
    demonstration, or `robot.rpy_WE`."""
    rpy_goal: Angles | None = None
    """Roll, pitch and yaw of the tool frame E in the world at the goal [rad]; null: those of the
    demonstration, or `robot.rpy_WE`."""
    q_start: list[float] | None = None
    """Positions of the arm's joints at the start, as many as `robot.q_seed` has [rad]; null: a
    solution of the inverse kinematics close to it. Start position and orientation that are not
    given follow from the joints; given ones must agree."""
    q_goal: list[float] | None = None
    """Positions of the arm's joints at the goal [rad]; null: a solution of the inverse kinematics.
    Goal position and orientation that are not given follow from the joints; given ones must agree.
    The posture changes from `q_start` to `q_goal` along the motion."""
    demonstration: list[str] = Field(default_factory=list)
    """Demonstrations to reproduce: a file, or a list of files with repetitions of one motion, which
    are averaged; relative to the scenario file, or package:// URLs. Empty: a minimum-jerk motion on
    a straight line with a rotation about a fixed axis.

    A .npz file has the array `path` (T, 3) [m], for uneven sampling `t` (T,) [s], and for a turning
    tool the orientations R_WE as `quaternion` (T, 4), w first, or `R` (T, 3, 3). A .csv file names
    its columns in the first line: x, y, z, for uneven sampling t, and for a turning tool
    qw, qx, qy, qz."""


_LATER = 1e-6
"""Least time between two moves of the goal [s]."""
_APART = 1e-3
"""Least distance of a goal from the start [m]."""


def goal_problems(task: Task) -> Iterator[str]:
    """Yields one line for each goal that no motion from the start can have."""
    if math.dist(task.start, task.goal) < _APART:
        yield f"task.goal: {task.goal} is the start; they must be at least 1 mm apart"
    before = 0.0
    for row, (time, *goal) in enumerate(task.goal_moves):
        where = f"task.goal_moves[{row}]"
        if time < before + _LATER:
            earlier = "0" if row == 0 else "that of the previous move"
            yield f"{where}: its time {time:g} s must be later than {earlier}, by at least 1 us"
        if math.dist(task.start, goal) < _APART:
            yield f"{where}: {goal} is the start; they must be at least 1 mm apart"
        before = time


def goal_steps(task: Task) -> FloatArray:
    """(N, 4) rows t, x, y, z from which times on the goal is where; the first t is 0 [s, m]."""
    return np.array([[0.0, *task.goal], *task.goal_moves], dtype=float)


def goal_at(task: Task, time: float) -> FloatArray:
    """(3,) the goal at a time [s]: that of the last step at or before it [m]."""
    steps = goal_steps(task)
    row = int(np.searchsorted(steps[:, 0], time, side="right")) - 1
    return np.array(steps[max(row, 0), 1:])


def goal_trajectory(task: Task) -> PiecewisePolynomial:
    """The goal as a trajectory of steps (3,), which is constant after the last one [m]."""
    steps = goal_steps(task)
    # Drake's last sample holds for no time at all.
    steps = np.vstack([steps, steps[-1] + [1.0, 0.0, 0.0, 0.0]])
    return PiecewisePolynomial.ZeroOrderHold(steps[:, 0], steps[:, 1:].T)


def last_move(task: Task) -> float:
    """When the goal moves for the last time [s]; 0: it never does."""
    return float(task.goal_moves[-1][0]) if task.goal_moves else 0.0
