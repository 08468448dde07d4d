"""A planned posture as a smooth course of time, without jumps where the plan changes.

Between the samples the joints follow monotone cubic polynomials of normalized time (F. N.
Fritsch and J. Butland, SIAM J. Sci. Stat. Comput. 5(2), 1984), which do not protrusion: what
lies between two safe postures is not left. A new plan q*(t) is taken over critically damped,

    q(t) = q*(t) + (e_0 + (de_0/dt + w e_0) (t - t_0)) exp(-w (t - t_0)),

where e_0 is the distance of the old course from it at the change t_0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from drake_oa.common.messages import FloatArray, Frozen, PlannedMotion

TAKE_OVER = 4.0
"""Rate w at which a course converges to a new plan [1/s]."""


@dataclass(frozen=True, eq=False)
class PostureTrajectory(Frozen):
    """Positions and velocities of n joints over time.

    Attributes:
        motion: the plan.
        spline: postures over normalized time; constant without a plan.
        away: (2n,) state of the course before, less that of the plan, when the plan was taken over
            [rad, rad/s].
        since: that time [s].
    """

    motion: PlannedMotion
    spline: CubicHermiteSpline
    away: FloatArray
    since: float = 0.0

    def at(self, s: float, speed: float, time: float) -> FloatArray:
        """Computes positions [rad] and velocities [rad/s], (2n,).

        Args:
            s: normalized time.
            speed: ds/dt [1/s].
            time: now [s].
        """
        s = min(max(s, self.spline.x[0]), self.spline.x[-1])
        e, de = np.split(self.away, 2)
        elapsed = time - self.since
        share, pushed = math.exp(-TAKE_OVER * elapsed), de + TAKE_OVER * e
        left = e + pushed * elapsed
        q = self.spline(s) + share * left
        return np.append(q, speed * self.spline(s, 1) + share * (pushed - TAKE_OVER * left))


def trajectory_of(motion: PlannedMotion, rest: FloatArray) -> PostureTrajectory:
    """Returns the course of a plan, or of the posture (n,) at rest without one [rad]."""
    s, q = motion.s, motion.q
    if len(q) < 2:
        s, q = np.array([0.0, 1.0]), np.tile(q[0] if len(q) else rest, (2, 1))
    slopes = PchipInterpolator(s, q).derivative()(s)
    slopes[[0, -1]] = 0.0
    return PostureTrajectory(motion, CubicHermiteSpline(s, q, slopes), np.zeros(2 * len(rest)))
