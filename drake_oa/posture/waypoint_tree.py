"""A tree of straight legs of the tool that the arm can go, to get past what it is stuck beside.

A rapidly exploring random tree (S. M. LaValle, Iowa State University TR 98-11, 1998) over the
tool's position, in which each edge is a leg whose posture has been planned, and each node has
the posture that it is reached in. A leg that is blocked counts as far as it leads. From each
new node the goal is tried (the greedy step of J. J. Kuffner and S. M. LaValle, ICRA 2000).
The points that it grows toward are those of J. H. Halton (Numerische Mathematik 2, 1960), so
that the same tree grows each time.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache

import numpy as np
from scipy.stats import qmc

from drake_oa.common.messages import (
    BoolArray,
    EllipsoidSet,
    FloatArray,
    Frozen,
    IntArray,
    PlannedMotion,
)
from drake_oa.geometry.directions import DIRECTIONS
from drake_oa.posture.posture_plan import PlanMotion

_LENGTH = 0.25
"""A leg toward a point leads no farther [m]."""
_FIRST = 0.2
"""How far the first legs lead [m],"""
_FIRST_LEGS = 8
"""and how many of them there are: away from what is near, and up."""
_UP = 0.5
"""What a way up counts beside one away from the obstacle: most things stand on the table."""
_LEAST = 0.04
"""A node so near another is of no use [m]."""
_AROUND = 0.4
"""How far beside start and goal points lie [m]."""
_APART = 0.025
"""Distance between the samples of a straight way [m]."""
_POINTS = 4096
"""So many of the points there are."""


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

    def is_new(self, p_WV: FloatArray) -> bool:
        """Whether a point is no node yet, nor near one."""
        return float(np.linalg.norm(self.p_WV - p_WV, axis=1).min()) >= _LEAST

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


@dataclass(frozen=True)
class Legs:
    """What a leg may be.

    Attributes:
        plan: plans the arm's posture along it.
        inside: which points (N, 3) the tool may be at.
    """

    plan: PlanMotion
    inside: Callable[[FloatArray], BoolArray]

    def gone(
        self, p_WE: FloatArray, q: FloatArray, p_WV: FloatArray
    ) -> tuple[FloatArray, FloatArray, bool]:
        """How far the arm can go a leg, if need be slowly.

        Args:
            p_WE, q: (3,) and (n,) from where and in which posture [m, rad].
            p_WV: (3,) where to [m].

        Returns:
            (3,) and (n,) where it gets to and in which posture, and whether that is the end.
        """
        motion = straight_motion(p_WE, p_WV)
        found = self.plan(q, motion)
        may = np.array(self.inside(motion.p_WE))
        # Who is outside may come in.
        may[: int(may.argmax())] = True
        count = min(found.free, len(may) if may.all() else int(may.argmin()))
        if count < 2:
            return p_WE, q, False
        return motion.p_WE[count - 1], found.q[count - 1], count == len(motion)


def grown(tree: LegTree, legs: Legs, count: int) -> tuple[LegTree, int]:
    """Grows a tree until a leg leads to the goal.

    Args:
        tree: as it is.
        legs: what a leg may be.
        count: about so many are looked at.

    Returns:
        The tree, and the node from which a leg leads to the goal; -1: there is none.
    """
    aims = tree.aims()
    allowed = legs.inside(aims)
    looked_at = 0
    while looked_at < count and tree.tried < len(aims):
        aim, may = aims[tree.tried], allowed[tree.tried]
        tree = replace(tree, tried=tree.tried + 1)
        if not may:
            continue
        off = np.linalg.norm(tree.p_WV - aim, axis=1)
        row = int(off.argmin())
        share = min(1.0, _LENGTH / max(float(off[row]), 1e-9))
        end = tree.p_WV[row] + share * (aim - tree.p_WV[row])
        p_WV, q, _ = legs.gone(tree.p_WV[row], tree.q[row], end)
        looked_at += 1
        while tree.is_new(p_WV):
            tree, row = tree.with_node(row, p_WV, q), len(tree)
            p_WV, q, whole = legs.gone(p_WV, q, tree.p_WG)
            looked_at += 1
            if whole:
                return tree, row
    return tree, -1


def shortened_way(tree: LegTree, row: int, legs: Legs) -> tuple[FloatArray, FloatArray]:
    """The points of the way to a node that the arm needs to get to it and on to the goal.

    Args:
        tree: grown so that a leg leads from the node to the goal.
        row: the node, not the first one.
        legs: what a leg may be.

    Returns:
        (k, 3) the points [m] and (n,) the posture at the last one [rad]; no points where the
        way cannot be gone any more.
    """
    whole = tree.way(row)
    for skips in (True, False):
        found = _walked(tree, whole, legs, skips=skips)
        if found is not None:
            return found
    return np.zeros((0, 3)), tree.q[0]


def _walked(
    tree: LegTree, whole: FloatArray, legs: Legs, *, skips: bool
) -> tuple[FloatArray, FloatArray] | None:
    """Goes by points (k, 3) to the goal; `skips`: from each on to the farthest that it can."""
    p_WE, q, kept, at = tree.p_WV[0], tree.q[0], [], 0
    while at < len(whole):
        for ahead in range(len(whole) - 1 if skips else at, at - 1, -1):
            reached, posture, goes = legs.gone(p_WE, q, whole[ahead])
            if goes:
                break
        else:
            return None
        p_WE, q, at = reached, posture, ahead + 1
        kept.append(p_WE)
    return (np.array(kept), q) if legs.gone(p_WE, q, tree.p_WG)[2] else None


def _nowhere() -> FloatArray:
    return field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class Aside(Frozen):
    """A step aside, and what has been tried for one; positions in the world frame.

    Attributes:
        p_WV: (3,) point V that the tool goes to first [m]; (0,): none.
        further: (k, 3) points that it goes to from there, in turn [m].
        p_WG: (3,) goal that they were chosen for [m]; (0,) without one.
        tree: of the legs that were looked at where the tool was stuck last.
        seen: the obstacles then.
    """

    p_WV: FloatArray = _nowhere()
    further: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    p_WG: FloatArray = _nowhere()
    tree: LegTree = field(default_factory=LegTree)
    seen: EllipsoidSet = field(default_factory=EllipsoidSet)

    def by(self, points: FloatArray, p_WG: FloatArray) -> Aside:
        """That leads by points (k, 3), one at least, to a goal (3,) [m]."""
        p_WG = np.array(p_WG, dtype=float)
        return replace(self, p_WV=points[0], further=points[1:], p_WG=p_WG)

    def reached(self) -> Aside:
        """That goes on from V; with no further point there is none."""
        if len(self.further):
            return replace(self, p_WV=self.further[0], further=self.further[1:])
        return self.given_up()

    def given_up(self) -> Aside:
        """None; what has been tried is not forgotten."""
        return Aside(tree=self.tree, seen=self.seen)
