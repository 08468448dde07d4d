"""Trajectory of the nominal posture, continuous also when the plan changes.

Between the samples the joints follow monotone cubic polynomials of normalized time (F. N.
Fritsch and J. Butland, SIAM J. Sci. Stat. Comput. 5(2), 1984). They do not overshoot: each joint
stays between its positions at both samples. The transition to a new plan q*(t) is critically
damped,

    q(t) = q*(t) + (e_0 + (de_0/dt + w e_0) (t - t_0)) exp(-w (t - t_0)),

where e_0 is the difference of the old trajectory from q* at the change t_0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from drake_oa.common.messages import FloatArray, Frozen, PlannedMotion

TAKE_OVER = 4.0
"""Rate w at which the trajectory converges to a new plan [1/s]."""


@dataclass(frozen=True, eq=False)
class PostureTrajectory(Frozen):
    """Positions and velocities of n joints over time.

    Attributes:
        motion: plan of the motion.
        spline: joint positions over normalized time [rad]; constant without a plan.
        offset: (2n,) state of the previous trajectory minus that of the plan when the plan
            changed [rad, rad/s].
        since: time of this change [s].
    """

    motion: PlannedMotion
    spline: CubicHermiteSpline
    offset: FloatArray
    since: float = 0.0

    def at(self, s: float, speed: float, time: float) -> FloatArray:
        """Computes positions [rad] and velocities [rad/s] of the joints, (2n,).

        Args:
            s: normalized time.
            speed: ds/dt [1/s].
            time: current time [s].
        """
        s = min(max(s, self.spline.x[0]), self.spline.x[-1])
        e, de = np.split(self.offset, 2)
        elapsed = time - self.since
        decay, slope = math.exp(-TAKE_OVER * elapsed), de + TAKE_OVER * e
        linear = e + slope * elapsed
        q = self.spline(s) + decay * linear
        return np.append(q, speed * self.spline(s, 1) + decay * (slope - TAKE_OVER * linear))


def trajectory_of(motion: PlannedMotion, rest: FloatArray) -> PostureTrajectory:
    """Returns the trajectory of a plan; without a plan that of the posture `rest` (n,) [rad]."""
    s, q = motion.s, motion.q
    if len(q) < 2:
        s, q = np.array([0.0, 1.0]), np.tile(q[0] if len(q) else rest, (2, 1))
    slopes = PchipInterpolator(s, q).derivative()(s)
    slopes[[0, -1]] = 0.0
    return PostureTrajectory(motion, CubicHermiteSpline(s, q, slopes), np.zeros(2 * len(rest)))
