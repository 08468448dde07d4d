"""A constant-velocity Kalman filter for each obstacle.

The state of one axis is (position, velocity). Acceleration is taken as white noise of
spectral density q, so that a step of dt adds

    Q = q [[dt^3/3, dt^2/2], [dt^2/2, dt]]

(Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, ch. 6: continuous white noise acceleration). The axes are those of the
world. They do not mix, since what is measured of them does not.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, Frozen

_FASTEST = 2.0
"""Largest deviation of a velocity that has become open [m/s]."""


@dataclass(frozen=True)
class FilterNoise:
    """What the filter takes as noise, and what as motion."""

    # Spectral density of the acceleration, each axis [m^2/s^3].
    acceleration: float = 0.01
    # Standard deviation of the measured place of one side of an obstacle [m].
    side: float = 0.0015
    # Standard deviation of the velocity of an obstacle that was not known before [m/s].
    initial_speed: float = 0.4
    # An obstacle moves when its speed is above `start_speed` [m/s] and significant: v^T P^-1 v
    # above `start` (chi-square of 3 degrees of freedom; 21.1 is exceeded once in 10,000),
    start_speed: float = 0.03
    start: float = 21.1
    # and rests again when it is below `floor` [m/s] or the statistic below `stop`.
    floor: float = 0.02
    stop: float = 7.8
    # So often in a row: frames to start, seconds to stop.
    start_frames: int = 2
    stop_time: float = 0.1
    # Where much is not where it was, a statistic above `stop` will do in `patience` times as
    # many frames.
    patience: int = 3
    # A measurement farther off than this many standard deviations is an outlier; the
    # second in a row is a manoeuvre.
    outlier: float = 5.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not np.isfinite(value) or value <= 0.0:
                raise ValueError(f"FilterNoise.{item.name} must be positive, not {value!r}")
        for low, high in (("floor", "start_speed"), ("stop", "start")):
            if getattr(self, low) > getattr(self, high):
                raise ValueError(f"FilterNoise.{low} must not be above {high}")


@dataclass(frozen=True, eq=False)
class MotionEstimate(Frozen):
    """Position and velocity of M obstacles.

    Attributes:
        p_W: (M, 3) positions [m].
        v_W: (M, 3) velocities [m/s].
        var_p: (M, 3) variances of the positions [m^2].
        cov_pv: (M, 3) covariances of position and velocity [m^2/s].
        var_v: (M, 3) variances of the velocities [m^2/s^2].
    """

    p_W: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    v_W: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    var_p: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    cov_pv: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    var_v: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.p_W)


def first_seen(p_W: FloatArray, noise: FilterNoise) -> MotionEstimate:
    """Obstacles at p_W (M, 3) [m] of unknown velocity."""
    shape = p_W.shape
    return MotionEstimate(
        p_W,
        np.zeros(shape),
        np.full(shape, noise.side**2),
        np.zeros(shape),
        np.full(shape, noise.initial_speed**2),
    )


def predicted(estimate: MotionEstimate, dt: float, noise: FilterNoise) -> MotionEstimate:
    """The estimate dt [s] >= 0 later."""
    q = noise.acceleration
    return MotionEstimate(
        estimate.p_W + dt * estimate.v_W,
        estimate.v_W,
        estimate.var_p + dt * (2.0 * estimate.cov_pv + dt * estimate.var_v) + q * dt**3 / 3.0,
        estimate.cov_pv + dt * estimate.var_v + q * dt**2 / 2.0,
        estimate.var_v + q * dt,
    )


def corrected(estimate: MotionEstimate, p_W: FloatArray, variance: FloatArray) -> MotionEstimate:
    """The estimate after a measurement.

    Args:
        estimate: the prediction.
        p_W: (M, 3) measured positions [m]; NaN where there is none.
        variance: (M, 3) of the measurement [m^2].
    """
    known = np.isfinite(p_W)
    innovation = np.where(known, p_W - estimate.p_W, 0.0)
    total = estimate.var_p + variance
    gain_p = np.where(known, estimate.var_p / total, 0.0)
    gain_v = np.where(known, estimate.cov_pv / total, 0.0)
    return MotionEstimate(
        estimate.p_W + gain_p * innovation,
        estimate.v_W + gain_v * innovation,
        (1.0 - gain_p) * estimate.var_p,
        (1.0 - gain_p) * estimate.cov_pv,
        estimate.var_v - gain_v * estimate.cov_pv,
    )


def is_outlier(
    estimate: MotionEstimate, p_W: FloatArray, variance: FloatArray, noise: FilterNoise
) -> BoolArray:
    """(M,) whether any axis of a measurement is farther off than noise explains.

    Args:
        estimate: the prediction.
        p_W: (M, 3) measured positions [m]; NaN where there is none.
        variance: (M, 3) of the measurement [m^2].
        noise: of the filter; `outlier` counts.
    """
    innovation = np.where(np.isfinite(p_W), p_W - estimate.p_W, 0.0)
    limit = noise.outlier**2 * (estimate.var_p + variance)
    return np.asarray((innovation**2 > limit).any(axis=1))


def unsettled(
    estimate: MotionEstimate, which: BoolArray, p_W: FloatArray, dt: float, noise: FilterNoise
) -> MotionEstimate:
    """Forgets how well some obstacles (M,) are known: they do what was not expected.

    The measured jump is what the position may be off. The velocity is as open as at first,
    or half the jump's speed if that is more, up to 2 m/s.

    Args:
        estimate: the prediction.
        which: (M,) the obstacles; the others stay as they are.
        p_W: (M, 3) measured positions [m]; NaN where there is none.
        dt: time since the last frame [s].
        noise: of the filter.
    """
    jump = np.where(np.isfinite(p_W), p_W - estimate.p_W, 0.0)
    wide = which[:, None]
    speed = np.maximum(noise.initial_speed, np.abs(jump) / max(dt, 1e-3) * 0.5)
    return replace(
        estimate,
        var_p=np.where(wide, estimate.var_p + jump**2, estimate.var_p),
        cov_pv=np.where(wide, 0.0, estimate.cov_pv),
        var_v=np.where(wide, np.minimum(speed, _FASTEST) ** 2, estimate.var_v),
    )


def speed_statistic(estimate: MotionEstimate) -> FloatArray:
    """(M,) v^T P_v^-1 v: chi-square of 3 degrees of freedom for an obstacle at rest."""
    return np.asarray((estimate.v_W**2 / estimate.var_v).sum(axis=1))
