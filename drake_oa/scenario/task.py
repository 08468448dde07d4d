"""Configuration block of a scenario's task: start, goal, nominal motion and requested clearance;
and functions for a goal that moves during the motion.
"""

import math
from collections.abc import Iterator
from typing import Annotated

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass
from pydrake.trajectories import PiecewisePolynomial

from drake_oa.common.config import BLOCK, Angles, Vector3, length
from drake_oa.common.messages import FloatArray

MAX_DURATION = 600.0
"""Maximum duration of a demonstrated or nominal motion [s]."""


@dataclass(config=BLOCK)
class Task:
    """Configuration block of a scenario's task: the nominal motion, which does not depend on
    obstacles, and the requested clearance.
    """

    start: Vector3 = Field(default=[0.45, -0.45, 0.3])
    """Position of the tool point at the start, in the world [m]."""
    goal: Vector3 = Field(default=[0.45, 0.45, 0.3])
    """Position of the tool point at the goal, in the world [m]."""
    goal_moves: list[Annotated[list[float], length(4)]] = Field(default_factory=list)
    """Moves of the goal during the motion, as rows t, x, y, z [s, m]: from time t on, the goal is
    at position x, y, z in the world."""
    duration: float = Field(default=5.0, gt=0.0, le=MAX_DURATION)
    """Duration T of the nominal motion [s]. The avoiding motion lasts tau T, where the temporal
    scaling tau is the factor by which it is slower. This field is ignored if the demonstration has
    times. Raising it makes the motion slower."""
    clearance: float = Field(default=0.15, gt=0.0, le=2.0)
    """Requested clearance Delta: minimum distance that is requested between the tool and the
    obstacles [m]. Raising it makes the detour around obstacles wider."""
    turn_limit: float | None = Field(default=None, ge=0.0, le=math.pi)
    """Maximum angle between the tool's orientation during a maneuver away from a moving obstacle
    and its orientation on the planned motion [rad]; null: no limit. Raising it allows more
    maneuvers."""
    rpy_start: Angles | None = None
    """Roll, pitch and yaw of the tool frame E in the world at the start [rad]; null: the
    demonstrated orientation, or `robot.rpy_WE` without demonstrated orientations."""
    rpy_goal: Angles | None = None
    """Roll, pitch and yaw of the tool frame E in the world at the goal [rad]; null: the
    demonstrated orientation, or `robot.rpy_WE` without demonstrated orientations."""
    q_start: list[float] | None = None
    """Configuration of the arm at the start, with as many joints as `robot.q_seed` [rad]; null: a
    solution of the inverse kinematics close to `robot.q_seed`. The fields `start` and `rpy_start`
    are computed from this configuration if they are missing; otherwise they must agree with it."""
    q_goal: list[float] | None = None
    """Configuration of the arm at the goal, with as many joints as `robot.q_seed` [rad]; null: a
    solution of the inverse kinematics. The fields `goal` and `rpy_goal` are computed from this
    configuration if they are missing; otherwise they must agree with it. The nominal posture,
    tracked in the null space, changes from `q_start` to `q_goal` along the motion."""
    demonstration: list[str] = Field(default_factory=list)
    """Demonstrations that the nominal motion reproduces: a file, or a list of files with
    repetitions of one motion, which are averaged. Files are package:// URLs or relative to the
    scenario file. Empty: a minimum-jerk motion on a straight line, with a rotation about a fixed
    axis.

    A .npz file has the array `path` (T, 3) [m], and for uneven sampling also the times `t` (T,)
    [s]. If the tool turns, it has the orientations R_WE as `quaternion` (T, 4), w first, or as `R`
    (T, 3, 3). The first line of a .csv file names its columns: x, y, z, for uneven sampling also t,
    and if the tool turns also qw, qx, qy, qz."""


_MIN_MOVE_INTERVAL = 1e-6
"""Minimum time between two successive moves of a task's goal, and before the first move [s]."""
_MIN_TRAVEL = 1e-3
"""Minimum distance between the start and each goal position of a task [m]."""


def goal_problems(task: Task) -> Iterator[str]:
    """Yields one error line for each invalid goal of a task.

    A goal is invalid if it is less than 1 mm from the start. A move is also invalid if its time is
    less than 1 us after the previous move, or after 0 for the first move.
    """
    if math.dist(task.start, task.goal) < _MIN_TRAVEL:
        yield f"task.goal: {task.goal} is the start; they must be at least 1 mm apart"
    before = 0.0
    for row, (time, *goal) in enumerate(task.goal_moves):
        where = f"task.goal_moves[{row}]"
        if time < before + _MIN_MOVE_INTERVAL:
            earlier = "0" if row == 0 else "that of the previous move"
            yield f"{where}: its time {time:g} s must be later than {earlier}, by at least 1 us"
        if math.dist(task.start, goal) < _MIN_TRAVEL:
            yield f"{where}: {goal} is the start; they must be at least 1 mm apart"
        before = time


def goal_steps(task: Task) -> FloatArray:
    """Returns all goal positions of a task, with the times from which they apply, as rows (N, 4) t,
    x, y, z in the world [s, m].

    The first row is the initial goal, with t = 0.
    """
    return np.array([[0.0, *task.goal], *task.goal_moves], dtype=float)


def goal_at(task: Task, time: float) -> FloatArray:
    """Returns the position (3,) of a task's goal at a simulated time [s], in the world [m]."""
    steps = goal_steps(task)
    row = int(np.searchsorted(steps[:, 0], time, side="right")) - 1
    return np.array(steps[max(row, 0), 1:])


def goal_trajectory(task: Task) -> PiecewisePolynomial:
    """Returns the position (3,) of a task's goal as a piecewise constant trajectory over simulated
    time, in the world [m].
    """
    steps = goal_steps(task)
    # Drake's last sample only ends the trajectory: it is repeated 1 s later.
    steps = np.vstack([steps, steps[-1] + [1.0, 0.0, 0.0, 0.0]])
    return PiecewisePolynomial.ZeroOrderHold(steps[:, 0], steps[:, 1:].T)


def last_move_time(task: Task) -> float:
    """Returns the simulated time of the last move of a task's goal [s]; 0 if the goal never
    moves.
    """
    return float(task.goal_moves[-1][0]) if task.goal_moves else 0.0
