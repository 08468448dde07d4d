"""Ways that lead on from now, as arrays: what `drake_oa.safety.evasion` looks at and goes by."""

from __future__ import annotations

import numpy as np

from drake_oa.common.messages import FloatArray, PlannedMotion, PolicyState


def displaced(
    velocity: FloatArray, wanted: FloatArray, times: FloatArray, acceleration: float
) -> FloatArray:
    """How far a displacement has led.

    Args:
        velocity: (m,) what it has now [m/s, rad/s].
        wanted: (C, m) velocities that it is brought to at a constant acceleration.
        times: (K,) [s].
        acceleration: [m/s^2, rad/s^2].

    Returns:
        (C, K, m) [m, rad].
    """
    change = wanted - velocity
    size = np.linalg.norm(change, axis=1)
    until = (size / acceleration)[:, None, None]
    t = times[None, :, None]
    ramp = np.minimum(t, until)
    rate = (change / np.maximum(size, 1e-12)[:, None] * acceleration)[:, None]
    return np.asarray(velocity * t + rate * ramp * (0.5 * ramp + np.maximum(t - until, 0.0)))


def shortened(ways: FloatArray, reach: FloatArray | float) -> FloatArray:
    """(C, K, m) ways that end where they have led as far as `reach`, (C,) or of all."""
    far = np.maximum(np.linalg.norm(ways, axis=2), 1e-12)
    share = np.minimum(1.0, np.reshape(reach, (-1, 1)) / far)
    return np.asarray(ways * share[:, :, None])


def planned_shift(
    policy: PolicyState,
    motion: PlannedMotion | None,
    s: float,
    rate: float,
    times: FloatArray,
) -> FloatArray:
    """How far the motion leads the tool at a rate of normalised time.

    Args:
        policy: where it is.
        motion: what is expected of it, or None: it goes straight on.
        s: normalised time now.
        rate: ds/dt [1/s].
        times: (K,) [s].

    Returns:
        (K, 3) [m].
    """
    if motion is None or len(motion) < 2 or s >= motion.s[-1]:
        left = np.minimum(rate * times, max(1.0 - s, 0.0))
        return np.asarray(left[:, None] * policy.z_W)
    return _led(motion.s, motion.p_WE, s, s + rate * times)


def stopping_shift(v_WE: FloatArray, times: FloatArray, hold_time: float) -> FloatArray:
    """(K, 3) how far a motion at v_WE (3,) still leads while it is brought to rest [m]."""
    t = np.minimum(times, hold_time)
    return np.asarray((t - 0.5 * t * t / hold_time)[:, None] * v_WE)


def planned_joints(
    motion: PlannedMotion | None, q: FloatArray, s: float, rate: float, times: FloatArray
) -> FloatArray:
    """(K, n) where a motion leads the joints from q (n,), at a rate of normalised time [rad].

    Without planned joints, and at a rate of 0, they stay. See `planned_shift`.
    """
    if motion is None or len(motion) < 2 or motion.q.shape[1] != len(q) or rate == 0.0:
        return np.tile(q, (len(times), 1))
    return np.asarray(q + _led(motion.s, motion.q, s, s + rate * times))


def _led(s: FloatArray, path: FloatArray, now: float, at: FloatArray) -> FloatArray:
    """(K, m) how far a path (T, m) at times s (T,) leads from now to others (K,)."""
    times = np.clip(np.append(now, at), s[0], s[-1])
    row = np.clip(np.searchsorted(s, times) - 1, 0, len(s) - 2)
    share = ((times - s[row]) / (s[row + 1] - s[row]))[:, None]
    found = path[row] + share * (path[row + 1] - path[row])
    return np.asarray(found[1:] - found[0])
