"""Joint-space planner for the whole arm, used at rest if no motion with coupling terms is feasible,
or if the arm has left its motion.

The planner is RRT-Connect (J. J. Kuffner and S. M. LaValle, ICRA 2000) with random shortcuts (R.
Geraerts and M. H. Overmars, IJRR 2007). Edges are checked for collisions in steps, which are longer
where the clearance margin (distance minus required clearance) is larger. While the trees grow,
edges are checked in coarse steps. When the trees meet, the path is checked in fine steps (lazy
collision checking). If an edge of the path is then found in collision, it is removed from its tree
together with all nodes beyond it, as seen from the root.

The effort is limited by the number of checked configurations, not by time. The same collision
model, ends, seed and limit therefore give the same path.
"""

from __future__ import annotations

import math

import numpy as np

from drake_oa.common.latency import count, counted
from drake_oa.common.messages import FloatArray
from drake_oa.planning.collision_model import (
    SPHERE_STRIDE,
    ArmCollisionModel,
    free_fraction,
    is_collision_free,
)

_MAX_STEP = 0.8
"""Maximum length in joint space of an edge of the planner's trees [rad]."""
_MIN_STEP = 0.05
"""Minimum length in joint space of an edge of the planner's trees [rad].

A shorter edge is added only if it covers at least half the distance from its start to the
configuration toward which the tree is extended."""
_COARSE_STRIDE = 0.1
"""Maximum motion of the arm's covering spheres between two successive coarse collision checks [m].

Edges in joint space are checked coarsely while the trees of the planner grow. The spheres may move
farther where the clearance margin (distance minus required clearance) is larger than this value."""
_NEAR_LINE_FRACTION = 0.8
"""Fraction of the planner's random samples that lie near a straight joint-space line [-].

The line leads from the start to the first collision-free one of the given goal configurations. The
other samples are uniform within the joint limits."""
_LINE_DEVIATION = 1.0
"""Standard deviation, per joint, of the planner samples that lie near a joint-space line [rad].

Each of these samples is a random configuration on the line plus a normally distributed deviation.
The line leads from the start to the first collision-free one of the given goal configurations."""
_MAX_SHORTCUTS = 100
"""Number of random shortcuts that the planner tries on each path from start to goal."""


def _counted_free_fraction(
    world: ArmCollisionModel, q_start: FloatArray, q_end: FloatArray, stride: float = SPHERE_STRIDE
) -> float:
    """Computes the collision-free fraction of a joint-space edge, and counts its checks.

    The number of checked configurations is added to the work counters of
    `drake_oa.common.latency`, from which the simulated compute latency is determined.

    Args:
        world: collision model of the arm, with the required clearances.
        q_start: (n,) configuration at the start of the edge [rad].
        q_end: (n,) configuration at the end of the edge [rad].
        stride: maximum displacement of the covering spheres between two checked configurations,
            where the clearance margin (distance minus required clearance) is smaller than this
            value [m].

    Returns:
        Fraction of the edge that is collision-free from its start on; 1: the entire edge.
    """
    fraction, checked = free_fraction(world, q_start, q_end, stride)
    count(configurations=checked)
    return fraction


class _Tree:
    """Tree of configurations in joint space, which the planner grows from the start or the goals.

    Attributes:
        world: collision model of the arm, with the required clearances.
        size: number of nodes.
        q: (capacity, n) configurations of the nodes; the first `size` rows are used [rad].
        parent: index of each node's parent; -1 for a root.
    """

    def __init__(self, world: ArmCollisionModel, roots: FloatArray, capacity: int) -> None:
        self.world, self.size = world, len(roots)
        self.q = np.empty((capacity, roots.shape[1]))
        self.q[: self.size] = roots
        self.parent = [-1] * self.size

    def extend(self, row: int, target: FloatArray) -> tuple[int, bool]:
        """Extends the tree from a node toward a target, as far as the edge is collision-free.

        The edge is a straight line, at most `_MAX_STEP` long, and is checked in coarse steps
        (`_COARSE_STRIDE`). A new node is added at the end of its collision-free part. No node is
        added if this part is shorter than both `_MIN_STEP` and half the distance to the target.

        Args:
            row: index of the node at which the edge starts.
            target: (n,) configuration toward which the edge leads [rad].

        Returns:
            Index of the new node, -1 if none was added; and whether the new node is the target.
        """
        q = self.q[row]
        distance = math.dist(q, target)
        fraction = min(1.0, _MAX_STEP / max(distance, _MAX_STEP))
        fraction *= _counted_free_fraction(
            self.world, q, q + fraction * (target - q), _COARSE_STRIDE
        )
        if fraction * distance < min(_MIN_STEP, 0.5 * distance):
            return -1, False
        self.q[self.size] = q + fraction * (target - q)
        self.parent.append(row)
        self.size += 1
        return self.size - 1, fraction == 1.0

    def nearest(self, q: FloatArray) -> int:
        """Returns the index of the tree's node nearest to a configuration (n,) in joint space."""
        return int(((self.q[: self.size] - q) ** 2).sum(axis=1).argmin())

    def branch(self, row: int) -> list[int]:
        """Returns the indices of the nodes from a node to its root, if no edge is in collision.

        The edges between these nodes are checked for collisions in fine steps (`SPHERE_STRIDE`). At
        the first edge in collision the check ends, and the result is empty. All nodes beyond that
        edge, as seen from the root, then get the configuration inf, so that `nearest` never returns
        them.

        Args:
            row: index of the node at which the branch begins.
        """
        rows = [row]
        while self.parent[rows[-1]] >= 0:
            row = rows[-1]
            rows.append(self.parent[row])
            if _counted_free_fraction(self.world, self.q[rows[-1]], self.q[row]) < 1.0:
                invalid = {row}
                for k in range(row, self.size):
                    if self.parent[k] in invalid:
                        invalid.add(k)
                self.q[list(invalid)] = np.inf
                return []
        return rows


def _shorten(world: ArmCollisionModel, path: list[FloatArray], rng: np.random.Generator) -> None:
    """Shortens a joint-space path, in place, by random collision-free straight shortcuts.

    Args:
        world: collision model of the arm, with the required clearances.
        path: corners (n,) of the path [rad].
        rng: generator of the random shortcuts.
    """
    for _ in range(_MAX_SHORTCUTS):
        length = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)))
        places = np.sort(rng.uniform(0.0, length[-1], 2))
        first, last = np.searchsorted(length[:-1], places, "right") - 1
        ends = np.stack([np.interp(places, length, q) for q in np.transpose(path)], axis=1)
        is_shorter = first < last and math.dist(*ends) < places[1] - places[0] - 1e-3
        if is_shorter and _counted_free_fraction(world, *ends) == 1.0:
            path[first + 1 : last + 1] = ends


def plan_path(
    world: ArmCollisionModel,
    q_start: FloatArray,
    goals: FloatArray,
    *,
    max_configurations: int,
    seed: int = 0,
) -> FloatArray:
    """Plans a joint-space path with the required clearances from the start to one of m goals.

    Args:
        world: collision model of the arm, with the required clearances.
        q_start: (n,) start configuration [rad].
        goals: (m, n) possible goal configurations [rad].
        max_configurations: maximum number of checked configurations.
        seed: seed of the random samples.

    Returns:
        (C, n) corners of the path, from start to goal [rad]; (0, n): no path was found.
    """
    goals = goals[[is_collision_free(world, q) for q in goals]]
    path: list[FloatArray] = []
    if not (len(goals) and is_collision_free(world, q_start)):
        return np.zeros((0, len(q_start)))
    rng, capacity = np.random.default_rng(seed), max_configurations + len(goals) + 2
    start_tree = tree = _Tree(world, q_start[None], capacity)
    other_tree = _Tree(world, goals, capacity)
    target = goals[0]
    with counted() as work:
        while work["configurations"] < max_configurations and not path:
            new, _ = tree.extend(tree.nearest(target), target)
            row, is_reached = other_tree.nearest(tree.q[new]) if new >= 0 else -1, False
            while row >= 0 and not is_reached and work["configurations"] < max_configurations:
                row, is_reached = other_tree.extend(row, tree.q[new])
            if (
                is_reached
                and (branch := tree.branch(new))
                and (other_branch := other_tree.branch(row))
            ):
                path = [*tree.q[branch[::-1]], *other_tree.q[other_branch[1:]]]
                path = path if tree is start_tree else path[::-1]
                _shorten(world, path, rng)
            tree, other_tree = other_tree, tree
            target = rng.uniform(world.chain.lower, world.chain.upper)
            if rng.random() < _NEAR_LINE_FRACTION:
                target = q_start + rng.random() * (goals[0] - q_start)
                target = target + _LINE_DEVIATION * rng.normal(size=len(q_start))
                target = np.clip(target, world.chain.lower, world.chain.upper)
    return np.array(path).reshape(-1, len(q_start))
