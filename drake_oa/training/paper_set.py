"""The paper's training set, as recovered from its released network (sec. V-A).

A lattice of ellipses in the middle of a 1 m baseline, a lattice of parameters, the released
code's action level; a row for each motion that keeps 1 cm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, Frozen, IntArray
from drake_oa.training.networks import Report
from drake_oa.training.planar_rollout import released_rollouts

KEPT = 0.01
"""Least clearance of a row [m]."""

NEAR_GOAL = 1.3
"""Where a motion must end, as a distance to the goal [m], to be a row to learn."""

SATURATED = 5e-4
"""How near a clearance is to the start's own distance where it says no more than that [m]."""


def _axis(first: float, last: float, number: int) -> FloatArray:
    return np.linspace(first, last, number)


@dataclass(frozen=True, eq=False)
class PaperLattice(Frozen):
    """What was explored; SI units, a baseline of 1 m.

    Attributes:
        lambda1: semi-axes along the baseline [m].
        lambda2: semi-axes across it [m].
        kappa: [1/m^2].
        psi: [rad].
        alpha: [rad/s].
    """

    lambda1: FloatArray = field(default_factory=lambda: _axis(0.025, 0.25, 10))
    lambda2: FloatArray = field(default_factory=lambda: _axis(0.025, 0.25, 10))
    kappa: FloatArray = field(default_factory=lambda: _axis(0.0, 1000.0, 50))
    psi: FloatArray = field(default_factory=lambda: _axis(0.1, 1.0, 50))
    alpha: FloatArray = field(default_factory=lambda: _axis(0.01, 30000.0, 50))

    @property
    def axes(self) -> tuple[FloatArray, ...]:
        """lambda1', lambda2', kappa, psi, alpha."""
        return self.lambda1, self.lambda2, self.kappa, self.psi, self.alpha


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


def build_paper_set(lattice: PaperLattice, report: Report | None = None) -> PaperSet:
    """Rolls out the lattice.

    Args:
        lattice: what to explore.
        report: told how far it is.

    Returns:
        The rows, in the lattice's order.

    Raises:
        ValueError: if no motion keeps the least clearance.
    """
    axes = lattice.axes
    lambda1, lambda2, kappa, psi, alpha = axes
    # kappa is the fastest of the parameters.
    shape = (len(lambda2), len(alpha), len(psi), len(kappa))
    grid = np.meshgrid(lambda2, alpha, psi, kappa, indexing="ij")
    widths, parameters = grid[0].ravel(), np.stack([a.ravel() for a in grid[1:]], axis=1)
    found = []
    for i, length in enumerate(lambda1):
        # The released code looks at its samples, not between them.
        outcome = released_rollouts(
            np.column_stack((np.full_like(widths, length), widths)), parameters
        )
        kept = np.flatnonzero(outcome.clearance >= KEPT)
        j, *place = np.unravel_index(kept, shape)
        index = np.column_stack((np.full(len(kept), i), j, *place[::-1]))
        found.append((index, outcome.clearance[kept], outcome.goal_error[kept]))
        if report is not None:
            report("roll out", (i + 1) / len(lambda1))
    index, clearance, goal_error = (np.concatenate(part) for part in zip(*found, strict=True))
    if not len(index):
        raise ValueError("no motion of the lattice keeps the least clearance")
    values = np.column_stack([axis[i] for axis, i in zip(axes, index.T, strict=True)])
    return PaperSet(index, values, clearance, goal_error, math.prod(map(len, axes)))


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
