"""Joint-space planner: a path of the whole arm where no motion of the tool is clear.

RRT-Connect (J. J. Kuffner and S. M. LaValle, ICRA 2000), and random shortcuts of its path (R.
Geraerts and M. H. Overmars, IJRR 2007). A straight way between two configurations is checked in
steps as long as its clearance allows. While the trees grow the steps are coarse; a path is checked
in full where the trees meet, and what is not clear is cut off.

The same world, ends, seed and limit give the same path: the limit counts configurations.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.latency import count, counted
from drake_oa.common.messages import FloatArray
from drake_oa.planning.collision_model import (
    STRIDE,
    ArmCollisionModel,
    is_collision_free,
    share_clear,
)

_RANGE, _LEAST = 0.8, 0.05
"""Longest and shortest step of the trees [rad]."""
_COARSE = 0.1
"""Distance between two checked configurations of an edge while the trees grow [m]."""
_BESIDE, _WIDE = 0.8, 1.0
"""Share of the samples near the straight way, and their standard deviation from it [rad]."""
_SHORTCUTS = 100
"""Number of shortcuts that are tried on a path."""


def _share_clear(
    world: ArmCollisionModel, one: FloatArray, other: FloatArray, stride: float = STRIDE
) -> float:
    """Returns the share of a straight way that is clear, and counts the checked configurations."""
    share, checked = share_clear(world, one, other, stride)
    count(configurations=checked)
    return share


class _Tree:
    """Tree of configurations (N, n), of which `used` are set [rad]."""

    def __init__(self, world: ArmCollisionModel, roots: FloatArray, size: int) -> None:
        self.world, self.used = world, len(roots)
        self.q = np.empty((size, roots.shape[1]))
        self.q[: self.used] = roots
        self.parent = [-1] * self.used

    def extend(self, row: int, aim: FloatArray) -> tuple[int, bool]:
        """Adds a node toward `aim`, as far as the way is clear and no farther than `_RANGE`.

        Returns:
            The new node, or -1, and whether it is the aim.
        """
        q = self.q[row]
        d = math.dist(q, aim)
        share = min(1.0, _RANGE / max(d, _RANGE))
        share *= _share_clear(self.world, q, q + share * (aim - q), _COARSE)
        if share * d < min(_LEAST, 0.5 * d):
            return -1, False
        self.q[self.used] = q + share * (aim - q)
        self.parent.append(row)
        self.used += 1
        return self.used - 1, share == 1.0

    def nearest(self, q: FloatArray) -> int:
        """Returns the row of the nearest node."""
        return int(((self.q[: self.used] - q) ** 2).sum(axis=1).argmin())

    def branch(self, row: int) -> list[int]:
        """Returns the nodes from one back to its root; empty if a way between them is not clear.

        Nodes beyond such a way are moved to infinity.
        """
        rows = [row]
        while self.parent[rows[-1]] >= 0:
            row = rows[-1]
            rows.append(self.parent[row])
            if _share_clear(self.world, self.q[rows[-1]], self.q[row]) < 1.0:
                lost = {row}
                for k in range(row, self.used):
                    if self.parent[k] in lost:
                        lost.add(k)
                self.q[list(lost)] = np.inf
                return []
        return rows


def _shorten(world: ArmCollisionModel, path: list[FloatArray], random: np.random.Generator) -> None:
    """Takes random shortcuts of a path."""
    for _ in range(_SHORTCUTS):
        length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
        places = np.sort(random.uniform(0.0, length[-1], 2))
        first, last = np.searchsorted(length[:-1], places, "right") - 1
        ends = np.stack([np.interp(places, length, q) for q in np.transpose(path)], axis=1)
        is_shorter = first < last and math.dist(*ends) < places[1] - places[0] - 1e-3
        if is_shorter and _share_clear(world, *ends) == 1.0:
            path[first + 1 : last + 1] = ends


def plan_path(
    world: ArmCollisionModel, q_start: FloatArray, goals: FloatArray, *, most: int, seed: int = 0
) -> FloatArray:
    """Plans a path that keeps the requested clearances.

    Args:
        world: the arm among the solids, with the requested clearances.
        q_start: (n,) start [rad].
        goals: (m, n) possible ends [rad].
        most: number of configurations that may be checked.
        seed: of the random trees.

    Returns:
        (T, n) corners of the path, from start to goal [rad]; (0, n): none was found.
    """
    goals = goals[[is_collision_free(world, q) for q in goals]]
    path: list[FloatArray] = []
    if not (len(goals) and is_collision_free(world, q_start)):
        return np.zeros((0, len(q_start)))
    random, size = np.random.default_rng(seed), most + len(goals) + 2
    start = tree = _Tree(world, q_start[None], size)
    other = _Tree(world, goals, size)
    aim = goals[0]
    with counted() as work:
        while work["configurations"] < most and not path:
            new, _ = tree.extend(tree.nearest(aim), aim)
            row, reached = other.nearest(tree.q[new]) if new >= 0 else -1, False
            while row >= 0 and not reached and work["configurations"] < most:
                row, reached = other.extend(row, tree.q[new])
            if reached and (one := tree.branch(new)) and (two := other.branch(row)):
                path = [*tree.q[one[::-1]], *other.q[two[1:]]]
                path = path if tree is start else path[::-1]
                _shorten(world, path, random)
            tree, other = other, tree
            aim = random.uniform(world.chain.lower, world.chain.upper)
            if random.random() < _BESIDE:
                aim = q_start + random.random() * (goals[0] - q_start)
                aim = aim + _WIDE * random.normal(size=len(q_start))
                aim = np.clip(aim, world.chain.lower, world.chain.upper)
    return np.array(path).reshape(-1, len(q_start))
