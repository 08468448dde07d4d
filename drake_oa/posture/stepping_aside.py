"""A step aside of the tool, so that the arm gets past what it is stuck beside."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from drake_oa.common.messages import EllipsoidSet, FloatArray, Frozen
from drake_oa.posture.waypoint_tree import LegTree


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
