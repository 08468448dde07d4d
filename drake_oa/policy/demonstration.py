"""A motion of the whole arm to imitate, as it travels between systems."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.policy.dmp import Dmp, OrientationDmp


@dataclass(frozen=True, eq=False)
class Demonstration(Frozen):
    """What the primitives imitate from where a motion begins; empty: what the task demonstrates.

    Attributes:
        position: of the tool point, three dimensions; its duration is the motion's [s].
        orientation: of the tool, from where it is to where it ends.
        R_WG: (3, 3) orientation at the end.
        s: (T,) normalised times of the posture, from 0 to 1.
        q: (T, n) positions of the arm's joints there [rad].
    """

    position: Dmp | None = None
    orientation: OrientationDmp | None = None
    R_WG: FloatArray = field(default_factory=lambda: np.eye(3))
    s: FloatArray = field(default_factory=lambda: np.zeros(0))
    q: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def posture(self, s: FloatArray) -> FloatArray:
        """(M, n) joints at normalised times (M,); beyond the ends those of the ends [rad]."""
        return np.stack([np.interp(s, self.s, joint) for joint in self.q.T], axis=1)
