"""A tree of straight legs of the tool that the arm can go, to get past what it is stuck beside.

A rapidly exploring random tree (S. M. LaValle, Iowa State University TR 98-11, 1998) over the
tool's position, in which each edge is a leg whose posture has been planned, and each node has
the posture that it is reached in. A leg that is blocked counts as far as it leads. From each
new node the goal is tried (the greedy step of J. J. Kuffner and S. M. LaValle, ICRA 2000).
The points that it grows toward are those of J. H. Halton (Numerische Mathematik 2, 1960), so
that the same tree grows each time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scipy.stats import qmc

from drake_oa.evasion import DIRECTIONS
from drake_oa.posture_plan import PosturePlan
from drake_oa.values import BoolArray, FloatArray, Frozen, IntArray, PlannedMotion

_LENGTH = 0.25
"""A leg toward a point leads no farther [m]."""
_FIRST = 0.2
"""How far the first legs lead [m],"""
_FIRST_LEGS = 8
"""and how many of them there are: away from what is near, and up."""
_UP = 0.5
"""What a way up counts beside one away from the obstacle: most things stand on the table."""
_LEAST = 0.04
"""A leg that is blocked sooner is of no use, nor is a node so near another [m]."""
_AROUND = 0.4
"""How far beside start and goal points lie [m]."""
_APART = 0.025
"""Distance between the samples of a straight way [m]."""
_POINTS = 4096

PlanLeg = Callable[[FloatArray, PlannedMotion], PosturePlan]
"""Plans the posture along a straight motion from a posture (n,) on."""


def straight_motion(p_WE: FloatArray, p_WV: FloatArray) -> PlannedMotion:
    """The motion of the tool straight from E to V, (3,) each [m]."""
    way = p_WV - p_WE
    count = 2 + int(np.linalg.norm(way) / _APART)
    s = np.linspace(0.0, 1.0, count)
    return PlannedMotion(s, p_WE + s[:, None] * way)


@dataclass(frozen=True, eq=False)
class LegTree(Frozen):
    """Points that the tool can reach from where it rests, in the world frame.

    Attributes:
        p_WG: (3,) the goal that they are to lead to [m].
        p_WO: (3,) what is near where it rests [m].
        p_WV: (N, 3) the points, the first being where it rests [m].
        q: (N, n) postures there [rad].
        parent: (N,) rows that they are reached from; -1 of the first.
        tried: how many points it has grown toward.
    """

    p_WG: FloatArray = field(default_factory=lambda: np.zeros(0))
    p_WO: FloatArray = field(default_factory=lambda: np.zeros(0))
    p_WV: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    q: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    parent: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    tried: int = 0

    def __len__(self) -> int:
        return len(self.p_WV)

    @staticmethod
    def at(p_WE: FloatArray, q: FloatArray, p_WG: FloatArray, p_WO: FloatArray) -> LegTree:
        """The tree before it has grown, see the attributes."""
        root = np.array([-1])
        return LegTree(np.array(p_WG), np.array(p_WO), np.array([p_WE]), np.array([q]), root)

    def way(self, row: int) -> FloatArray:
        """(k, 3) the points from the first leg's end to a node [m]; (0, 3) to the root."""
        rows = []
        while row > 0:
            rows.append(row)
            row = int(self.parent[row])
        return np.array(self.p_WV[rows[::-1]]).reshape(-1, 3)

    def aims(self) -> FloatArray:
        """(M, 3) points that it grows toward, in turn [m]."""
        root = self.p_WV[0]
        away = root - self.p_WO
        wanted = away / max(float(np.linalg.norm(away)), 1e-9) + [0.0, 0.0, _UP]
        order = np.argsort(-(DIRECTIONS @ wanted), kind="stable")[:_FIRST_LEGS]
        low = np.minimum(root, self.p_WG) - _AROUND
        high = np.maximum(root, self.p_WG) + _AROUND
        spread = low + _halton() * (high - low)
        return np.concatenate([root + _FIRST * DIRECTIONS[order], spread])

    def with_node(self, parent: int, p_WV: FloatArray, q: FloatArray) -> LegTree:
        """The tree with one node more."""
        return replace(
            self,
            p_WV=np.concatenate([self.p_WV, p_WV[None]]),
            q=np.concatenate([self.q, q[None]]),
            parent=np.append(self.parent, parent),
        )


@cache
def _halton() -> FloatArray:
    """(M, 3) of the unit cube."""
    points = np.asarray(qmc.Halton(3, scramble=False).random(_POINTS))
    points.flags.writeable = False
    return points


def grown(
    tree: LegTree,
    plan: PlanLeg,
    inside: Callable[[FloatArray], BoolArray],
    stop_distance: float,
    legs: int,
) -> tuple[LegTree, int]:
    """Grows a tree until a leg leads to the goal.

    Args:
        tree: as it is.
        plan: plans a leg.
        inside: which points (N, 3) the tool may be at.
        stop_distance: what a blocked leg keeps as far as it is gone [m].
        legs: about so many are planned.

    Returns:
        The tree, and the node from which a leg leads to the goal; -1: there is none.
    """
    aims = tree.aims()
    allowed = inside(aims)
    planned = 0
    while planned < legs and tree.tried < len(aims):
        aim, may = aims[tree.tried], allowed[tree.tried]
        tree = replace(tree, tried=tree.tried + 1)
        if not may:
            continue
        off = np.linalg.norm(tree.p_WV - aim, axis=1)
        row = int(off.argmin())
        share = min(1.0, _LENGTH / max(float(off[row]), 1e-9))
        end = tree.p_WV[row] + share * (aim - tree.p_WV[row])
        if not inside(end[None])[0]:
            continue
        planned += 1
        tree, new = _extended(tree, row, end, plan, stop_distance)
        while new >= 0 and planned < legs:
            planned += 1
            motion = straight_motion(tree.p_WV[new], tree.p_WG)
            found = plan(tree.q[new], motion)
            if found.works:
                return tree, new
            tree, new = _added(tree, new, motion, found, stop_distance)
    return tree, -1


def _extended(
    tree: LegTree, row: int, end: FloatArray, plan: PlanLeg, stop_distance: float
) -> tuple[LegTree, int]:
    motion = straight_motion(tree.p_WV[row], end)
    return _added(tree, row, motion, plan(tree.q[row], motion), stop_distance)


def _added(
    tree: LegTree, row: int, motion: PlannedMotion, found: PosturePlan, stop_distance: float
) -> tuple[LegTree, int]:
    """The tree with what of a leg can be gone, and the new node; -1: none of it."""
    last = len(found) - 1 if found.works else _free(found, stop_distance) - 1
    if last < 1:
        return tree, -1
    end = motion.p_WE[last]
    if float(np.linalg.norm(tree.p_WV - end, axis=1).min()) < _LEAST:
        return tree, -1
    return tree.with_node(row, end, found.q[last]), len(tree)


def _free(found: PosturePlan, stop_distance: float) -> int:
    """How many samples of a plan come before what is too near or too fast."""
    if not len(found) or not math.isfinite(found.hurry):
        return 0
    free = (found.distance >= stop_distance) & (found.apart > 0.0)
    free[0] = True
    return int(len(free) if free.all() else free.argmin())


def shortened_way(tree: LegTree, row: int, plan: PlanLeg) -> tuple[FloatArray, FloatArray]:
    """The points of the way to a node that the arm needs to get to it and on to the goal.

    Args:
        tree: grown so that a leg leads from the node to the goal.
        row: the node, not the first one.
        plan: plans a leg.

    Returns:
        (k, 3) the points [m], one at least, and (n,) the posture at the last one [rad].
    """
    whole = tree.way(row)
    p_WE, q, kept, at = tree.p_WV[0], tree.q[0], [], -1
    while at < len(whole) - 1:
        for ahead in range(len(whole) - 1, at, -1):
            found = plan(q, straight_motion(p_WE, whole[ahead]))
            if found.works:
                break
        else:
            return whole, tree.q[row]
        p_WE, q, at = whole[ahead], found.q[-1], ahead
        kept.append(p_WE)
    if not plan(q, straight_motion(p_WE, tree.p_WG)).works:
        return whole, tree.q[row]
    return np.array(kept), q
