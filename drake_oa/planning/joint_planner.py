"""Joint-space planner: a path of the whole arm where no motion of the tool is clear.

RRT-Connect (J. J. Kuffner and S. M. LaValle, ICRA 2000), and random shortcuts of its path (R.
Geraerts and M. H. Overmars, IJRR 2007). A straight way between two configurations is checked in
steps as long as its clearance allows.

The same world, ends, seed and limit give the same path: the limit counts configurations.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.messages import FloatArray
from drake_oa.common.thinking import count
from drake_oa.planning.arm_world import ArmWorld, exceeds, share_clear

_RANGE, _LEAST = 0.8, 0.1
"""Longest and shortest step of the trees [rad]."""
_BESIDE, _WIDE = 0.8, 1.0
"""Share of the samples near the straight way, and their standard deviation from it [rad]."""
_SHORTCUTS = 100
"""Number of shortcuts that are tried on a path."""


class _Tree:
    """Tree of configurations (N, n), of which `used` are set [rad]."""

    def __init__(self, roots: FloatArray, size: int) -> None:
        self.q, self.used = np.empty((size, roots.shape[1])), len(roots)
        self.q[: self.used] = roots
        self.parent = [-1] * self.used

    def extend(self, world: ArmWorld, row: int, aim: FloatArray) -> tuple[int, bool, int]:
        """Adds a node toward `aim`, as far as the way is clear and no farther than `_RANGE`.

        Returns:
            The new node, or -1; whether it is the aim; and the number of checked configurations.
        """
        q = self.q[row]
        d = math.dist(q, aim)
        share = min(1.0, _RANGE / max(d, _RANGE))
        clear, checked = share_clear(world, q, q + share * (aim - q))
        if clear * share * d < min(_LEAST, 0.5 * d):
            return -1, False, checked
        self.q[self.used] = q + clear * share * (aim - q)
        self.parent.append(row)
        self.used += 1
        return self.used - 1, clear * share == 1.0, checked

    def nearest(self, q: FloatArray) -> int:
        """Returns the row of the nearest node."""
        return int(((self.q[: self.used] - q) ** 2).sum(axis=1).argmin())

    def branch(self, row: int) -> list[FloatArray]:
        """Returns the nodes from one back to its root."""
        found = []
        while row >= 0:
            found.append(self.q[row])
            row = self.parent[row]
        return found


def _shorten(world: ArmWorld, path: list[FloatArray], random: np.random.Generator) -> int:
    """Takes random shortcuts of a path; returns the number of checked configurations."""
    checked = 0
    for _ in range(_SHORTCUTS):
        length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
        places = np.sort(random.uniform(0.0, length[-1], 2))
        first, last = np.searchsorted(length[:-1], places, "right") - 1
        ends = np.stack([np.interp(places, length, q) for q in np.transpose(path)], axis=1)
        if first < last and math.dist(*ends) < places[1] - places[0] - 1e-3:
            share, looked_at = share_clear(world, *ends)
            checked += looked_at
            if share == 1.0:
                path[first + 1 : last + 1] = ends
    return checked


def plan_path(
    world: ArmWorld, q_start: FloatArray, goals: FloatArray, *, most: int, seed: int = 0
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
    goals = goals[[exceeds(world, q) for q in goals]]
    none, checked = np.zeros((0, len(q_start))), 0
    if not (len(goals) and exceeds(world, q_start)):
        return none
    random, size = np.random.default_rng(seed), most + len(goals) + 2
    start = tree = _Tree(q_start[None], size)
    other = _Tree(goals, size)
    aim = goals[0]
    while checked < most:
        new, _, looked_at = tree.extend(world, tree.nearest(aim), aim)
        checked += looked_at
        row, reached = other.nearest(tree.q[new]) if new >= 0 else -1, False
        while row >= 0 and not reached and checked < most:
            row, reached, looked_at = other.extend(world, row, tree.q[new])
            checked += looked_at
        if reached:
            halves = tree.branch(new)[::-1], other.branch(row)[1:]
            path = [*halves[0], *halves[1]]
            path = path if tree is start else path[::-1]
            count(configurations=checked + _shorten(world, path, random))
            return np.array(path)
        tree, other = other, tree
        aim = random.uniform(world.chain.lower, world.chain.upper)
        if random.random() < _BESIDE:
            aim = q_start + random.random() * (goals[0] - q_start)
            aim = aim + _WIDE * random.normal(size=len(q_start))
            aim = np.clip(aim, world.chain.lower, world.chain.upper)
    count(configurations=checked)
    return none
