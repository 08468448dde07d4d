"""Trajectory of the arm's nominal posture, which is continuous even if the planned motion changes.

Between the samples of a planned motion the joints follow monotone cubic polynomials of normalized
time (F. N. Fritsch and J. Butland, SIAM J. Sci. Stat. Comput. 5(2), 1984). These polynomials do not
overshoot: each joint stays between its positions at the two neighboring samples. The transition to
a new plan q*(t) is critically damped,

    q(t) = q*(t) + (e_0 + (de_0/dt + w e_0) (t - t_0)) exp(-w (t - t_0)),

where t_0 is the time of the change, e_0 the old trajectory minus q* at this time, and w a constant
rate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from drake_oa.common.messages import FloatArray, Frozen, PlannedMotion

TAKE_OVER = 4.0
"""Rate w with which the nominal posture approaches the plan after a change of plans [1/s]."""


@dataclass(frozen=True, eq=False)
class PostureTrajectory(Frozen):
    """Trajectory of the nominal posture: positions and velocities of n joints over time.

    Attributes:
        motion: planned motion that the trajectory follows.
        spline: planned joint positions over normalized time (time over tau T, with the demonstrated
            duration T and the temporal scaling tau) [rad]; constant if none are planned.
        offset: (2n,) positions and velocities of the previous trajectory minus those of the plan,
            at the time of the change to this plan [rad, rad/s].
        since: time of the change to this plan [s].
    """

    motion: PlannedMotion
    spline: CubicHermiteSpline
    offset: FloatArray
    since: float = 0.0

    def at(self, s: float, speed: float, time: float) -> FloatArray:
        """Computes the nominal positions and velocities of the arm's joints at a time.

        Args:
            s: normalized time in the planned motion, clipped to the planned range.
            speed: rate ds/dt of normalized time [1/s].
            time: current time [s].

        Returns:
            (2n,) positions [rad] and velocities [rad/s].
        """
        s = min(max(s, self.spline.x[0]), self.spline.x[-1])
        e, de = np.split(self.offset, 2)
        elapsed = time - self.since
        decay, slope = math.exp(-TAKE_OVER * elapsed), de + TAKE_OVER * e
        linear = e + slope * elapsed
        q = self.spline(s) + decay * linear
        return np.append(q, speed * self.spline(s, 1) + decay * (slope - TAKE_OVER * linear))


def trajectory_of(motion: PlannedMotion, rest: FloatArray) -> PostureTrajectory:
    """Returns the trajectory of the nominal posture for a planned motion, without a transition from
    a previous plan.

    Args:
        motion: planned motion.
        rest: (n,) constant posture of the trajectory if no joint positions are planned [rad].
    """
    s, q = motion.s, motion.q
    if len(q) < 2:
        s, q = np.array([0.0, 1.0]), np.tile(q[0] if len(q) else rest, (2, 1))
    slopes = PchipInterpolator(s, q).derivative()(s)
    slopes[[0, -1]] = 0.0
    return PostureTrajectory(motion, CubicHermiteSpline(s, q, slopes), np.zeros(2 * len(rest)))
