"""The paper's training set, as recovered from its released network (sec. V-A).

A lattice of ellipses in the middle of a 1 m baseline, a lattice of parameters; a row for each
motion of the released code's action level, or of the running system's, that keeps 1 cm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray
from drake_oa.training.checkpoint import Report
from drake_oa.training.released_method import PaperLattice, roll_out
from drake_oa.training.rollouts import running_lattice

CHAINS = ("RC(lambda')", "RC(lambda', Delta)")
"""The two chains of Table I."""

PRINTED = {
    CHAINS[0]: {"kappa": (0.539, 0.543), "psi": (0.802, 0.802), "alpha": (0.893, 0.897)},
    CHAINS[1]: {"kappa": (0.251, 0.253), "psi": (0.244, 0.243), "alpha": (1.6e-4, 1.7e-4)},
}
"""Table I of the paper (tab:nn_training): NMSE on the train and on the test rows."""

KEPT = 0.01
"""Least clearance of a row [m]."""

NEAR_GOAL = 1.3
"""Where a motion must end, as a distance to the goal [m], to be a row to learn."""

SATURATED = 5e-4
"""How near a clearance is to the start's own distance where it says no more than that [m]."""


ActionLevelName = Literal["released", "running"]

ACTION_LEVELS = {
    "released": "released code: tau^2 on the spring, 1000 steps of 3 ms",
    "running": "the running system's: exact turns, 1000 steps",
}
"""What moves through the lattice."""

ALPHA_UNITS = {"released": "rad/s", "running": "1/T"}


@dataclass(frozen=True, eq=False)
class PaperSet(Frozen):
    """N motions that keep the least clearance.

    Attributes:
        index: (N, 5) place of lambda1', lambda2', kappa, psi and alpha in the lattice.
        values: (N, 5) what stands there.
        clearance: (N,) Delta [m].
        goal_error: (N,) distance to the goal at the end [m].
        rollouts: number of trajectories that it took.
    """

    index: IntArray
    values: FloatArray
    clearance: FloatArray
    goal_error: FloatArray
    rollouts: int

    def __len__(self) -> int:
        return len(self.index)

    @property
    def near_goal(self) -> BoolArray:
        """(N,) rows to learn: those that end near the goal."""
        return self.goal_error <= NEAR_GOAL

    @property
    def unsaturated(self) -> BoolArray:
        """(N,) rows whose clearance tells of the motion: less than the start's own."""
        return self.clearance < 0.5 - self.values[:, 0] - SATURATED


def build_paper_set(
    lattice: PaperLattice,
    report: Report | None = None,
    action_level: ActionLevelName = "released",
) -> PaperSet:
    """Rolls out the lattice.

    Args:
        lattice: what to explore.
        report: told how far it is.
        action_level: what moves through it; alpha is in its `ALPHA_UNITS`.

    Returns:
        The rows, in the lattice's order.

    Raises:
        ValueError: if no motion keeps the least clearance.
    """
    go = roll_out if action_level == "released" else running_lattice
    found = []
    for i in range(len(lattice.lambda1)):
        one = lattice._replace(lambda1=lattice.lambda1[i : i + 1])
        # Rows run over lambda', alpha, psi and kappa, the last the fastest.
        clearance, goal_error = (v.transpose(0, 1, 4, 3, 2) for v in go(one))
        kept = clearance >= KEPT
        first, j, *place = np.nonzero(kept)
        index = np.column_stack((first + i, j, *place[::-1]))
        found.append((index, clearance[kept], goal_error[kept]))
        if report is not None:
            report("roll out", (i + 1) / len(lattice.lambda1))
    index, clearance, goal_error = (np.concatenate(part) for part in zip(*found, strict=True))
    if not len(index):
        raise ValueError("no motion of the lattice keeps the least clearance")
    values = np.column_stack([axis[i] for axis, i in zip(lattice, index.T, strict=True)])
    return PaperSet(index, values, clearance, goal_error, math.prod(map(len, lattice)))


def group_means(
    index: IntArray, y: FloatArray, rows: BoolArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Rows of equal inputs as one: least squares on the means, weighted, is the same.

    Args:
        index: (N, k) inputs as places in a lattice.
        y: (N,) targets.
        rows: (N,) those to take.

    Returns:
        (G, k) distinct inputs, (G,) mean target and (G,) number of rows of each.
    """
    groups, group = np.unique(index[rows], axis=0, return_inverse=True)
    count = np.bincount(group.ravel(), minlength=len(groups)).astype(float)
    return groups, np.bincount(group.ravel(), y[rows], len(groups)) / count, count


def floor_of_means(index: IntArray, y: FloatArray, rows: BoolArray) -> float:
    """NMSE of the means over rows of equal inputs."""
    _, group = np.unique(index[rows], axis=0, return_inverse=True)
    count = np.bincount(group.ravel())
    mean = np.bincount(group.ravel(), y[rows]) / count
    return float(np.mean((y[rows] - mean[group.ravel()]) ** 2) / np.var(y[rows]))


def floor_of_windows(
    index: IntArray, clearance: FloatArray, y: FloatArray, rows: BoolArray, width: int
) -> float:
    """NMSE about the conditional mean, given discrete inputs and the clearance.

    Among the rows of equal discrete inputs, in the order of their clearance, the noise is
    what a line leaves of each `width` rows in turn.

    Args:
        index: (N, k) discrete inputs as places in a lattice.
        clearance: (N,) the continuous input.
        y: (N,) targets.
        rows: (N,) those to take.
        width: rows a window, at least 3. Neighbours come from different lines of the
            lattice and so differ by more than chance: few rows estimate too much.

    Returns:
        The estimate; NaN where no window is full.
    """
    chosen = np.flatnonzero(rows)
    order = chosen[np.lexsort((clearance[chosen], *index[chosen].T))]
    key = index[order]
    begins = np.flatnonzero(np.append(True, (key[1:] != key[:-1]).any(axis=1)))
    sizes = np.diff(np.append(begins, len(order)))
    place = np.arange(len(order)) - np.repeat(begins, sizes)
    whole = place < np.repeat(sizes // width * width, sizes)
    if not whole.any():
        return float("nan")
    t, v = (column[order][whole].reshape(-1, width) for column in (clearance, y))
    t, rest = t - t.mean(axis=1, keepdims=True), v - v.mean(axis=1, keepdims=True)
    spread = (t**2).sum(axis=1, keepdims=True)
    rest = rest - t * ((t * rest).sum(axis=1, keepdims=True) / np.where(spread > 0.0, spread, 1.0))
    return float((rest**2).sum() / (rest.size / width * (width - 2)) / np.var(y[rows]))
