"""Task block of a scenario, and positions of a goal that moves during the motion."""

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
"""Maximum duration of a demonstrated motion [s]."""


@dataclass(config=BLOCK)
class Task:
    """Block of the nominal motion, which is planned without knowledge of the obstacles."""

    start: Vector3 = Field(default=[0.45, -0.45, 0.3])
    """Start of the tool point in the world [m]. Raising it moves the start along the axis."""
    goal: Vector3 = Field(default=[0.45, 0.45, 0.3])
    """Goal of the tool point in the world [m]. Raising it moves the goal along the axis."""
    goal_moves: list[Annotated[list[float], length(4)]] = Field(default_factory=list)
    """Moves of the goal during the motion: rows t, x, y, z [s, m]; from time t on, the goal is at
    this position in the world."""
    duration: float = Field(default=5.0, gt=0.0, le=MAX_DURATION)
    """Duration T of the nominal motion [s]; the avoiding motion lasts tau T, with temporal scaling
    tau. Ignored if the demonstration has times. Raising it makes the motion slower."""
    clearance: float = Field(default=0.15, gt=0.0, le=2.0)
    """Requested clearance Delta between the tool and the obstacles [m]. Raising it makes the detour
    around obstacles wider."""
    turn_limit: float | None = Field(default=None, ge=0.0, le=math.pi)
    """Maximum rotation of the tool in a maneuver away from an obstacle [rad]; null: no limit.
    Raising it allows more maneuvers."""
    rpy_start: Angles | None = None
    """Roll, pitch and yaw of the tool frame E in the world at the start [rad]; null: those of the
    demonstration, or `robot.rpy_WE`."""
    rpy_goal: Angles | None = None
    """Roll, pitch and yaw of the tool frame E in the world at the goal [rad]; null: those of the
    demonstration, or `robot.rpy_WE`."""
    q_start: list[float] | None = None
    """Configuration of the arm at the start, as many joints as in `robot.q_seed` [rad]; null: a
    solution of the inverse kinematics close to `robot.q_seed`. Missing fields `start` and
    `rpy_start` follow from it; given ones must agree with it."""
    q_goal: list[float] | None = None
    """Configuration of the arm at the goal [rad]; null: a solution of the inverse kinematics.
    Missing fields `goal` and `rpy_goal` follow from it; given ones must agree with it. The nominal
    posture changes from `q_start` to `q_goal` along the motion."""
    demonstration: list[str] = Field(default_factory=list)
    """Demonstrations to reproduce: a file, or a list of files with repetitions of one motion, which
    are averaged; relative to the scenario file, or package:// URLs. Empty: a minimum-jerk motion on
    a straight line with a rotation about a fixed axis.

    A .npz file has the array `path` (T, 3) [m], for uneven sampling `t` (T,) [s], and for a turning
    tool the orientations R_WE as `quaternion` (T, 4), w first, or `R` (T, 3, 3). A .csv file names
    its columns in the first line: x, y, z, for uneven sampling t, and for a turning tool
    qw, qx, qy, qz."""


_MIN_MOVE_INTERVAL = 1e-6
"""Minimum time between two moves of the goal [s]."""
_MIN_TRAVEL = 1e-3
"""Minimum distance between start and goal [m]."""


def goal_problems(task: Task) -> Iterator[str]:
    """Yields one error line for each goal too close to the start or out of temporal order."""
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
    """Returns rows (N, 4) t, x, y, z: position of the goal from time t on; t = 0 first [s, m]."""
    return np.array([[0.0, *task.goal], *task.goal_moves], dtype=float)


def goal_at(task: Task, time: float) -> FloatArray:
    """Returns the goal position (3,) at a time [s] in the world [m]."""
    steps = goal_steps(task)
    row = int(np.searchsorted(steps[:, 0], time, side="right")) - 1
    return np.array(steps[max(row, 0), 1:])


def goal_trajectory(task: Task) -> PiecewisePolynomial:
    """Returns the goal position (3,) as a piecewise constant trajectory in the world [m]."""
    steps = goal_steps(task)
    # Drake's last sample only ends the trajectory: it is repeated 1 s later.
    steps = np.vstack([steps, steps[-1] + [1.0, 0.0, 0.0, 0.0]])
    return PiecewisePolynomial.ZeroOrderHold(steps[:, 0], steps[:, 1:].T)


def last_move_time(task: Task) -> float:
    """Returns the time of the last move of the goal [s]; 0 for a goal at rest."""
    return float(task.goal_moves[-1][0]) if task.goal_moves else 0.0
