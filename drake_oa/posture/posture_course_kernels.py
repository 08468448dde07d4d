"""Compiled arithmetic behind `drake_oa.posture.posture_course`; call its functions instead."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from drake_oa.common.messages import FloatArray

_SETTLED = 12.0
"""After this many times 1 / w nothing of the old one is left."""


@njit(cache=True, error_model="numpy")
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
        rate: how fast it is taken over, w [1/s]; 0: what is left stays, at its velocity.
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
