"""The task block of a scenario, and where its goal is, which may be moved during the motion."""

import dataclasses as dc
import math
from collections.abc import Sequence

import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from drake_oa.common.config import ScenarioError, roll_pitch_yaw
from drake_oa.common.config import number as _number
from drake_oa.common.config import vector as _vector
from drake_oa.common.messages import FloatArray

LONGEST = 600.0
"""Longest that a demonstrated motion may take [s]."""


@dc.dataclass
class Task:
    """The motion that was planned without knowing the obstacles."""

    # Where the tool point starts, and should end, in the world frame [m].
    start: list[float] = _vector([0.45, -0.45, 0.3], "m")
    goal: list[float] = _vector([0.45, 0.45, 0.3], "m")
    # Where the goal is moved to, and when: rows [t, x, y, z]; from time t on it is there, in
    # the world [s, m].
    goal_moves: list[list[float]] = dc.field(default_factory=list)
    # Duration T of the demonstrated motion; the avoiding one takes tau T [s]. Ignored
    # where the demonstration brings its own `t`: then T is what that spans.
    duration: float = _number(5.0, "s", 0.0, LONGEST, open_low=True)
    # Asked distance between tool and obstacle, Delta [m].
    clearance: float = _number(0.15, "m", 0.0, 2.0, open_low=True)
    # Roll, pitch and yaw of R_WE at start and goal [rad]; null: what the demonstration has
    # there, or without orientations in it `robot.rpy_WE`.
    rpy_start: list[float] | None = roll_pitch_yaw()
    rpy_goal: list[float] | None = roll_pitch_yaw()
    # Joints of the arm at start and goal, as many as `robot.q_seed` has [rad]; null: what
    # inverse kinematics finds near that. What is not stated of start, goal and their
    # orientations follows from them, and what is must agree. The posture leads from one to
    # the other.
    q_start: list[float] | None = dc.field(default=None, metadata={"unit": "rad"})
    q_goal: list[float] | None = dc.field(default=None, metadata={"unit": "rad"})
    # Demonstrations to imitate: a file, or a list of files of one motion shown several times,
    # which are averaged. .npz with `path` (T, 3) and, if uneven in time, `t` (T,) [s]; and, if
    # the tool turns, its orientations R_WE as `quaternion` (T, 4), w first and of either sign,
    # or `R` (T, 3, 3). Or .csv whose first line names its columns: x, y, z, if uneven in time t,
    # and if the tool turns qw, qx, qy, qz. Relative to the scenario file, or a package:// URL.
    # Empty: minimum jerk along the straight line and about a fixed axis.
    demonstration: list[str] = dc.field(default_factory=list)


_LATER = 1e-6
"""Least time between two moves of the goal [s]."""
_APART = 1e-3
"""Least distance of a goal from the start [m]."""


def check_goals(
    start: Sequence[float], goal: Sequence[float], moves: Sequence[Sequence[float]]
) -> None:
    """Refuses goals that no motion from the start can have.

    Args:
        start: (3,) of the task [m].
        goal: (3,) of the task [m].
        moves: rows t, x, y, z [s, m].

    Raises:
        ScenarioError: naming the field.
    """
    if math.dist(start, goal) < _APART:
        raise ScenarioError(
            f"task.goal: {list(goal)} is the start; they must be at least 1 mm apart"
        )
    before = 0.0
    for row, move in enumerate(moves):
        where = f"task.goal_moves[{row}]"
        if len(move) != 4:
            raise ScenarioError(
                f"{where}: expected 4 numbers, t [s], x, y, z [m], not {list(move)}"
            )
        if move[0] < before + _LATER:
            than = "0" if row == 0 else "that of the one before"
            raise ScenarioError(
                f"{where}: its time {move[0]:g} s must be later than {than}, by 1 us at least"
            )
        if math.dist(start, move[1:]) < _APART:
            raise ScenarioError(
                f"{where}: {list(move[1:])} is the start; they must be at least 1 mm apart"
            )
        before = move[0]


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
