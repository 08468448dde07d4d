"""A planned posture as a smooth course of time, without jumps where the plan changes.

Between the samples the joints follow monotone cubic polynomials of normalised time (F. N.
Fritsch and J. Butland, SIAM J. Sci. Stat. Comput. 5(2), 1984), which do not overshoot: what
lies between two safe postures is not left. A new plan q*(t) is taken over critically damped,

    q(t) = q*(t) + (e_0 + (de_0/dt + w e_0) (t - t_0)) exp(-w (t - t_0)),

where e_0 is what the old course was away from it at the change t_0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from drake_oa.values import FloatArray, Frozen, PlannedMotion

_RATE = 4.0
"""How fast a new plan is taken over, w [1/s]."""
_SETTLED = 12.0
"""After this many times 1 / w nothing of the old one is left."""


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
        away, drift: (n,) what was left of the course before then [rad, rad/s].
    """

    rest: FloatArray
    motion: PlannedMotion = field(default_factory=PlannedMotion)
    slopes: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    since: float = 0.0
    away: FloatArray = field(default_factory=lambda: np.zeros(0))
    drift: FloatArray = field(default_factory=lambda: np.zeros(0))

    def at(self, s: float, speed: float, time: float) -> tuple[FloatArray, FloatArray]:
        """Positions [rad] and velocities [rad/s], (n,) each.

        Args:
            s: normalised time.
            speed: ds/dt [1/s].
            time: now [s].
        """
        q, v = self._planned(s, speed)
        tau = time - self.since
        if not len(self.away) or _RATE * tau > _SETTLED:
            return q, v
        share = math.exp(-_RATE * tau)
        pushed = self.drift + _RATE * self.away
        left = self.away + pushed * tau
        return q + share * left, v + share * (pushed - _RATE * left)

    def _planned(self, s: float, speed: float) -> tuple[FloatArray, FloatArray]:
        times, q = self.motion.s, self.motion.q
        if not len(q):
            return self.rest, np.zeros(len(self.rest))
        if len(times) == 1 or not times[0] < s < times[-1]:
            return q[0 if s <= times[0] else -1], np.zeros(q.shape[1])
        i = int(np.searchsorted(times, s, side="right")) - 1
        h = float(times[i + 1] - times[i])
        x = (s - float(times[i])) / h
        step = q[i + 1] - q[i]
        a, b = h * self.slopes[i], h * self.slopes[i + 1]
        c2, c3 = 3.0 * step - 2.0 * a - b, a + b - 2.0 * step
        position = q[i] + x * (a + x * (c2 + x * c3))
        return position, (speed / h) * (a + x * (2.0 * c2 + 3.0 * x * c3))

    def with_motion(
        self, motion: PlannedMotion, s: float, speed: float, time: float
    ) -> PostureCourse:
        """The course that takes over another plan now; arguments as of `at`.

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
        q, v = self.at(s, speed, time)
        if not len(motion.q) and not len(self.motion.q):
            return self
        after = PostureCourse(
            self.rest, motion, monotone_slopes(motion.s, motion.q) if len(motion.q) else motion.q
        )
        q_new, v_new = after._planned(s, speed)
        return PostureCourse(
            self.rest, motion, after.slopes, since=time, away=q - q_new, drift=v - v_new
        )
