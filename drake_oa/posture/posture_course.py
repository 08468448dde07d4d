"""A planned posture as a smooth course of time, without jumps where the plan changes.

Between the samples the joints follow monotone cubic polynomials of normalised time (F. N.
Fritsch and J. Butland, SIAM J. Sci. Stat. Comput. 5(2), 1984), which do not overshoot: what
lies between two safe postures is not left. A new plan q*(t) is taken over critically damped,

    q(t) = q*(t) + (e_0 + (de_0/dt + w e_0) (t - t_0)) exp(-w (t - t_0)),

where e_0 is the distance of the old course from it at the change t_0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from drake_oa.common.messages import FloatArray, Frozen, PlannedMotion, zeros

TAKE_OVER = 4.0
"""Rate w at which a course converges to a new plan [1/s]."""


def monotone_slopes(s: FloatArray, q: FloatArray) -> FloatArray:
    """Computes slopes dq/ds (T, n) of a monotone cubic through samples, 0 at both ends.

    Args:
        s: (T,) increasing.
        q: (T, n) values there.
    """
    slopes = PchipInterpolator(s, q).derivative()(s)
    slopes[[0, -1]] = 0.0
    return np.asarray(slopes)


@dataclass(frozen=True, eq=False)
class PostureCourse(Frozen):
    """Positions and velocities of n joints over time.

    Attributes:
        rest: (n,) posture without a plan [rad].
        motion: the plan.
        since: time at which the plan was taken over [s].
        away: (2n,) state of the course before, less that of the plan, at that time [rad, rad/s].
    """

    rest: FloatArray
    motion: PlannedMotion = field(default_factory=PlannedMotion)
    since: float = 0.0
    away: FloatArray = zeros(0)

    @cached_property
    def _spline(self) -> CubicHermiteSpline:
        """Postures over normalised time; constant without a plan."""
        s, q = self.motion.s, self.motion.q
        if len(q) < 2:
            s, q = np.array([0.0, 1.0]), np.tile(q[0] if len(q) else self.rest, (2, 1))
        return CubicHermiteSpline(s, q, monotone_slopes(s, q))

    def at(self, s: float, speed: float, time: float) -> FloatArray:
        """Computes positions [rad] and velocities [rad/s], (2n,).

        Args:
            s: normalised time.
            speed: ds/dt [1/s].
            time: now [s].
        """
        spline = self._spline
        s = min(max(s, spline.x[0]), spline.x[-1])
        course = np.append(spline(s), speed * spline(s, 1))
        if len(self.away):
            e, de = np.split(self.away, 2)
            elapsed = time - self.since
            share, pushed = math.exp(-TAKE_OVER * elapsed), de + TAKE_OVER * e
            left = e + pushed * elapsed
            course += share * np.append(left, pushed - TAKE_OVER * left)
        return course

    def with_motion(
        self,
        motion: PlannedMotion,
        s: float,
        speed: float,
        time: float,
        left: FloatArray,
    ) -> PostureCourse:
        """Returns the course that takes over another plan now.

        Args:
            motion: the plan.
            s, speed, time: now, as of `at`.
            left: (2n,) state of this course now [rad, rad/s].

        Raises:
            ValueError: if the plan is of another number of joints.
        """
        if motion is self.motion or not (len(motion.q) or len(self.motion.q)):
            return self
        if len(motion.q) and motion.q.shape != (len(motion.s), len(self.rest)):
            raise ValueError(
                f"motion: q has shape {motion.q.shape}; it must be "
                f"{(len(motion.s), len(self.rest))}, or (0, n)"
            )
        anew = PostureCourse(self.rest, motion, time)
        return replace(anew, away=left - anew.at(s, speed, time))
