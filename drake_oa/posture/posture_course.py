"""A planned posture as a smooth course of time, without jumps where the plan changes.

Between the samples the joints follow monotone cubic polynomials of normalised time (F. N.
Fritsch and J. Butland, SIAM J. Sci. Stat. Comput. 5(2), 1984), which do not overshoot: what
lies between two safe postures is not left. A new plan q*(t) is taken over critically damped,

    q(t) = q*(t) + (e_0 + (de_0/dt + w e_0) (t - t_0)) exp(-w (t - t_0)),

where e_0 is what the old course was away from it at the change t_0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from drake_oa.common.compiled import compiled, kernel_arrays
from drake_oa.common.messages import FloatArray, Frozen, PlannedMotion, zeros

_SETTLED = 12.0
"""After this many times 1 / w nothing of the old one is left."""


@compiled
def course_at(
    times: FloatArray,
    q: FloatArray,
    slopes: FloatArray,
    away: FloatArray,
    rate: float,
    s: float,
    speed: float,
    elapsed: float,
) -> FloatArray:
    """`drake_oa.posture.posture_course.PostureCourse.at` on plain arrays.

    Args:
        times: (T,) samples of normalised time, one at least.
        q: (T, n) positions there [rad].
        slopes: (T, n) dq/ds there [rad].
        away: (2n,) what was left of another course, e_0 and de_0/dt [rad, rad/s].
        rate: how fast it is taken over, w [1/s].
        s: normalised time.
        speed: ds/dt [1/s].
        elapsed: since that other course was left [s].

    Returns:
        (2n,) positions [rad] and velocities [rad/s].
    """
    n = q.shape[1]
    course = np.zeros(2 * n)
    last = len(times) - 1
    if last == 0 or not times[0] < s < times[last]:
        course[:n] = q[0 if s <= times[0] else last]
    else:
        i = np.searchsorted(times, s, side="right") - 1
        h = times[i + 1] - times[i]
        x = (s - times[i]) / h
        for j in range(n):
            step = q[i + 1, j] - q[i, j]
            a, b = h * slopes[i, j], h * slopes[i + 1, j]
            c2, c3 = 3.0 * step - 2.0 * a - b, a + b - 2.0 * step
            course[j] = q[i, j] + x * (a + x * (c2 + x * c3))
            course[n + j] = (speed / h) * (a + x * (2.0 * c2 + 3.0 * x * c3))
    if rate * elapsed <= _SETTLED:
        share = math.exp(-rate * elapsed)
        for j in range(n):
            pushed = away[n + j] + rate * away[j]
            left = away[j] + pushed * elapsed
            course[j] += share * left
            course[n + j] += share * (pushed - rate * left)
    return course


TAKE_OVER = 4.0
"""How fast a new plan is taken over, w [1/s]."""


def monotone_slopes(s: FloatArray, q: FloatArray) -> FloatArray:
    """(T, n) slopes dq/ds of a monotone cubic through samples, 0 at both ends.

    Args:
        s: (T,) increasing.
        q: (T, n) values there.
    """
    slopes = np.zeros_like(q)
    if len(s) > 2:
        h = np.diff(s)[:, None]
        d = np.diff(q, axis=0) / h
        one, other = (h[:-1] + 2.0 * h[1:]), (2.0 * h[:-1] + h[1:])
        same = d[:-1] * d[1:] > 0.0
        below = np.where(same, other / np.where(same, d[:-1], 1.0), 1.0)
        above = np.where(same, one / np.where(same, d[1:], 1.0), 1.0)
        slopes[1:-1] = np.where(same, (one + other) / (below + above), 0.0)
    return slopes


@dataclass(frozen=True, eq=False)
class PostureCourse(Frozen):
    """The course of n joints.

    Attributes:
        rest: (n,) where they are drawn to without a plan [rad].
        motion: the plan.
        slopes: (T, n) dq/ds at its samples [rad].
        since: when it was taken over [s].
        away: (2n,) what was left of the course before then [rad, rad/s].
    """

    rest: FloatArray
    motion: PlannedMotion = field(default_factory=PlannedMotion)
    slopes: FloatArray = zeros(0, 0)
    since: float = 0.0
    away: FloatArray = zeros(0)

    @cached_property
    def _arrays(self) -> list[FloatArray]:
        """What `course_at` takes first; without a plan the rest is its only sample."""
        away = self.away if len(self.away) else np.zeros(2 * len(self.rest))
        if not len(self.motion.q):
            return kernel_arrays([0.0], self.rest[None], np.zeros((1, len(self.rest))), away)
        return kernel_arrays(self.motion.s, self.motion.q, self.slopes, away)

    def at(self, s: float, speed: float, time: float) -> FloatArray:
        """(2n,) positions [rad] and velocities [rad/s].

        Args:
            s: normalised time.
            speed: ds/dt [1/s].
            time: now [s].
        """
        return course_at(*self._arrays, TAKE_OVER, s, speed, time - self.since)

    def with_motion(
        self,
        motion: PlannedMotion,
        s: float,
        speed: float,
        time: float,
        left: FloatArray | None = None,
    ) -> PostureCourse:
        """The course that takes over another plan now.

        Args:
            motion: with the plan.
            s, speed, time: now, as of `at`.
            left: (2n,) what this course is at now; None: what it is at s.

        Raises:
            ValueError: if the plan is of another number of joints.
        """
        if motion is self.motion:
            return self
        if len(motion.q) and motion.q.shape != (len(motion.s), len(self.rest)):
            raise ValueError(
                f"motion: q has shape {motion.q.shape}; it must be "
                f"{(len(motion.s), len(self.rest))}, or (0, n)"
            )
        if not len(motion.q) and not len(self.motion.q):
            return self
        slopes = monotone_slopes(motion.s, motion.q) if len(motion.q) else motion.q
        left = self.at(s, speed, time) if left is None else left
        return PostureCourse(self.rest, motion, slopes)._from(left, s, speed, time)

    def _from(self, here: FloatArray, s: float, speed: float, time: float) -> PostureCourse:
        """The course to the same plan from positions and velocities (2n,) now."""
        anew = replace(self, since=time, away=np.zeros(0))
        return replace(anew, away=here - anew.at(s, speed, time))
