"""Where the goal of a task is: it may be moved, in steps, while the motion is under way."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from drake_oa.schema_check import ScenarioError
from drake_oa.values import FloatArray

if TYPE_CHECKING:
    from drake_oa.scenario import Task

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
        if move[0] <= before:
            than = "0" if row == 0 else "that of the one before"
            raise ScenarioError(f"{where}: its time {move[0]:g} s must be later than {than}")
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
