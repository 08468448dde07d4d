"""Dynamic movement primitives (DMP) for the position and the orientation of the tool.

Time. T is the demonstrated duration in seconds and tau the temporal scaling of T. Normalized time
s = t / (tau T) is 1 at the end of the motion. The equations are

    dz/ds = alpha_x (beta_x (g - x) - z) + f(k) + C      (1)
    dx/ds = z                                            (2)
    dk/ds = -alpha_k k,  k(0) = 1                        (5)

with position x, scaled velocity z, goal g, phase k, forcing term f, and coupling term C. These are
the equations (1), (2) and (5) of Pairet et al. (RA-L 2019) with tau T in place of tau: z is in
meters, the velocity is z / (tau T), and the path does not depend on tau.

Space. The forcing term is learned in the demonstration's local frame L and divided by its baseline
(distance from start to goal). A new motion scales and rotates it: f_W = baseline R_WL f(k).

Orientation. The orientation is R_WE = R_WA exp([r]). A is a frame that is fixed during a motion,
and r the rotation vector from A to the tool, expressed in A. A is rotated relative to the start S
as the middle sample of the demonstration is relative to its first sample
(`OrientationDmp.offset`); without a demonstration A has the orientation of S. r obeys, with the
phase k of the position,

    dz/ds = alpha_x (beta_x (g - r) - z) + f_0(k) (g - r(0)) + f(k),    dr/ds = z,

with g the rotation vector of the goal. f_0 is fitted to the minimum-jerk profile m(s), which rises
from 0 to 1. With the demonstrated rotation vector r_d(s) minus its initial value, f is fitted to
the remainder r_d(s) - m(s) r_d(1). A motion to another goal is thus
r(s) = r(0) + m(s) (g - r(0)) + (r_d(s) - m(s) r_d(1)), also if start and goal have the same
orientation. As for the position, each integration step is exact for a forcing term that is constant
in the step. The exponential map has no singularity; logarithms are computed only when a primitive
is learned or a goal is set.
The angular velocity in A is the left Jacobian of the exponential map times r',

    w_A = r' + a r x r' + b r x (r x r'),   a = (1 - cos |r|) / |r|^2,
                                            b = (|r| - sin |r|) / |r|^3.

The equations for r differ from those of Ude et al. (ICRA 2014), where the spring acts on
2 log(g q*): that system is not linear, so that it has no closed-form step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, CubicHermiteSpline, PchipInterpolator, make_interp_spline
from scipy.spatial.transform import Rotation

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, Frozen, zeros
from drake_oa.policy.action_kernels import MotionSetup, advance, spring_flow
from drake_oa.policy.guidance import NO_OBSTACLES

ALPHA_X = 48.0
"""Default gain alpha_x of a movement primitive's spring and damper, per normalized time [-].

Normalized time is time over the planned duration of the motion."""
BETA_X = ALPHA_X / 4.0
"""Default gain beta_x of a movement primitive's spring, per normalized time [-].

A quarter of the gain alpha_x makes the spring critically damped. Normalized time is time over the
planned duration of the motion."""
ALPHA_K = math.log(100.0)
"""Default decay rate alpha_k of a movement primitive's phase, per normalized time [-].

With this rate the phase is 1 at the start of the motion and 0.01 at its planned end."""
N_BASIS = 35
"""Default number of basis functions of the forcing term, which reproduces a demonstration [-]."""
_STILL = 0.2
"""Length of the interval after the demonstration in which the forcing term is fitted to zero [-].

The unit is the demonstrated duration. Without this interval the forcing term does not vanish at the
end of the demonstration, and displaces the end of a recorded motion by 1 to 2 mm."""


@dataclass(frozen=True, eq=False)
class Dmp(Frozen):
    """Parameters of a dynamic movement primitive in D dimensions, scaled to a baseline of 1 m.

    The baseline is the distance from start to goal. Normalized time is time over planned duration.

    Attributes:
        alpha_x: gain of spring and damper, per normalized time.
        beta_x: gain of the spring, per normalized time; alpha_x / 4 for critical damping.
        alpha_k: decay rate of the phase, per normalized time.
        centers: (N,) centers c_i of the basis functions over the phase.
        widths: (N,) widths h_i of the basis functions exp(-h_i (k - c_i)^2), above 0; a larger h_i
            makes the function narrower.
        weights: (D, N) weights of the basis functions in the local frame (x from start to goal, z
            up), divided by the distance from start to goal.
        duration: duration T of the demonstration [s].
    """

    alpha_x: float
    beta_x: float
    alpha_k: float
    centers: FloatArray
    widths: FloatArray
    weights: FloatArray
    duration: float = 1.0

    def phase(self, s: ArrayLike) -> FloatArray:
        """Computes the phase k = exp(-alpha_k s) at normalized times s, an array of any shape."""
        return np.asarray(np.exp(-self.alpha_k * np.asarray(s, dtype=float)))

    def forcing(self, k: FloatArray) -> FloatArray:
        """Computes the forcing term (T, D) in the local frame at phases k (T,).

        The forcing term is f(k) = k sum_i w_i psi_i(k) / sum_i psi_i(k), with basis functions psi_i
        and their weights w_i, (3) of Pairet et al., RA-L 2019. It is that of a motion with a
        distance of 1 from start to goal.
        """
        return np.asarray(activations(k, self.centers, self.widths) @ self.weights.T)

    def setup(
        self, k: FloatArray, ds: float, goal: FloatArray, spread: FloatArray, **more: Any
    ) -> MotionSetup:
        """Computes the constants of an integration of this primitive over T steps.

        Args:
            k: (T,) phases in the middle of the T steps.
            ds: length of a step in normalized time.
            goal: (3,) goal position in the world frame [m], or rotation vector of the goal
                orientation [rad].
            spread: (3, D) matrix that converts the forcing term f_L, in the local frame and for a
                baseline of 1 m, to that of the motion: f = spread f_L(k).
            more: further fields of `MotionSetup`.
        """
        rest = goal + self.forcing(k) @ spread.T / (self.alpha_x * self.beta_x)
        flow = spring_flow(self.alpha_x, self.beta_x, 0.5 * ds)
        x, y, z = goal.tolist()
        return MotionSetup(
            np.ascontiguousarray(rest), flow, ds, (x, y, z), tuple(spread[:, 0].tolist()), **more
        )


def activations(k: FloatArray, centers: FloatArray, widths: FloatArray) -> FloatArray:
    """Computes the activations k psi_i(k) / sum_j psi_j(k) of N basis functions at phases k (T,).

    The basis functions are psi_i(k) = exp(-h_i (k - c_i)^2), (4) of Pairet et al., RA-L 2019. The
    forcing term is linear in the activations.

    Args:
        k: (T,) phases.
        centers: (N,) centers c_i.
        widths: (N,) widths h_i.

    Returns:
        (T, N) activations.
    """
    exponent = widths * (k[:, None] - centers) ** 2
    # The common factor prevents an underflow of all basis functions far from every center.
    basis = np.exp(exponent.min(axis=1, keepdims=True) - exponent)
    return np.asarray(basis * (k / basis.sum(axis=1))[:, None])


def normalized_time(k: float, alpha_k: float) -> float:
    """Computes the normalized time s = -ln(k) / alpha_k at phase k, the inverse of `Dmp.phase`.

    Args:
        k: phase of the movement primitive, 1 at the start and decaying to 0.
        alpha_k: decay rate of the phase.

    Returns:
        Time over the planned duration of the motion [-].
    """
    return -math.log(max(k, 1e-300)) / alpha_k


def local_frame(p_WS: ArrayLike, p_WG: ArrayLike) -> FloatArray:
    """Computes the orientation R_WL of the local frame L of a motion from its start and goal.

    x points from start to goal, z upward and orthogonal to x, and y completes the right-handed
    frame (section II-A of Pairet et al., RA-L 2019). If start and goal lie on a vertical line, y is
    the world's y axis.

    Args:
        p_WS: (3,) start [m].
        p_WG: (3,) goal [m].

    Returns:
        (3, 3) rotation matrix.

    Raises:
        ValueError: if start and goal coincide or are not finite.
    """
    p_SG = np.asarray(p_WG, dtype=float) - p_WS
    length = float(np.linalg.norm(p_SG))
    if not 0.0 < length < math.inf:
        raise ValueError(f"start and goal must be finite and apart, not {p_WS!r} and {p_WG!r}")
    x = p_SG / length
    y, flat = np.array([-x[1], x[0], 0.0]), math.hypot(x[0], x[1])
    y = y / flat if flat > 1e-12 else np.array([0.0, 1.0, 0.0])
    return np.column_stack([x, y, np.cross(x, y)])


def minimum_jerk(
    start: ArrayLike, goal: ArrayLike, *, duration: float = 1.0, samples: int = 201
) -> tuple[FloatArray, FloatArray]:
    """Computes the straight minimum-jerk motion from rest to rest, the default demonstration.

    Args:
        start: (D,) start position in the world frame [m].
        goal: (D,) goal position in the world frame [m].
        duration: duration of the motion [s].
        samples: number of samples, at least 2.

    Returns:
        Path (samples, D) [m] and its times (samples,) [s].
    """
    p_WS, p_SG = np.asarray(start, dtype=float), np.subtract(goal, start)
    s = np.linspace(0.0, 1.0, samples)
    return p_WS + minimum_jerk_profile(s)[:, None] * p_SG, duration * s


def minimum_jerk_profile(s: FloatArray) -> FloatArray:
    """Computes the minimum-jerk profile m(s) = 10 s^3 - 15 s^4 + 6 s^5.

    m(s) is the fraction of the way from start to goal at normalized times s in [0, 1].
    """
    return np.asarray(s**3 * (10.0 + s * (6.0 * s - 15.0)))


def imitate(path: ArrayLike, t: ArrayLike | None = None, **constants: Any) -> Dmp:
    """Learns a movement primitive of the position from one demonstrated path.

    Args:
        path: (T, 3) positions of the tool point in the world frame [m]; T at least 2.
        t: (T,) times [s], increasing, at any spacing; None: evenly over one second.
        constants: keyword arguments n_basis, alpha_x, beta_x and alpha_k of `fit_forcing`.

    Returns:
        Movement primitive with the duration of the demonstration.

    Raises:
        ValueError: for fewer than two samples, values that are not finite, times that
            do not increase, or a path that ends where it starts.
    """
    path, t = checked_demonstration(path, t)
    return fit_forcing(in_local_frame(path), t, **constants)


def in_local_frame(path: FloatArray, share: float = 1e-6) -> FloatArray:
    """Expresses a path relative to its end, in its local frame, divided by its baseline.

    The local frame has x from start to end of the path and z up. The baseline is the distance from
    start to end.

    Args:
        path: (T, 3) positions in the world frame [m].
        share: minimum ratio of the baseline to the extent of the path, the largest edge of its
            bounding box along the world's axes.

    Returns:
        (T, 3) scaled positions [-], zero at the end of the path.

    Raises:
        ValueError: if the baseline is at most `share` times the extent of the path.
    """
    baseline, extent = float(np.linalg.norm(path[-1] - path[0])), float(np.ptp(path, axis=0).max())
    if not baseline > share * extent:
        raise ValueError(
            "the path must end away from its start, as their distance scales it: its baseline is "
            f"{baseline:.3g} m, its extent {extent:.3g} m; demonstrate it in two parts"
        )
    return np.asarray((path - path[-1]) @ local_frame(path[0], path[-1]) / baseline)


def fit_forcing(
    local: FloatArray,
    t: FloatArray,
    *,
    n_basis: int = N_BASIS,
    alpha_x: float = ALPHA_X,
    beta_x: float = BETA_X,
    alpha_k: float = ALPHA_K,
) -> Dmp:
    """Fits the forcing term of a movement primitive to a demonstration.

    With the position x relative to the end, normalized time s and z = dx/ds, the primitive
    reproduces the demonstration for the forcing term f = dz/ds + alpha_x (z + beta_x x). This term
    is sampled on a spline through the demonstration and fitted by linear least squares over all
    basis functions at once.

    Args:
        local: (T, D) positions relative to the last position, in the local frame (x from start to
            goal, z up), divided by the distance from start to goal.
        t: (T,) times [s].
        n_basis: number of basis functions, at least 2, evenly spaced in time.
        alpha_x: gain of spring and damper, per normalized time.
        beta_x: gain of the spring, per normalized time.
        alpha_k: decay rate of the phase, per normalized time.

    Returns:
        Movement primitive with the duration of the demonstration.
    """
    duration = float(t[-1] - t[0])
    spline = interpolant((t - t[0]) / duration, local)
    s, centers, widths, inverse = _fit(n_basis, alpha_k)
    x, z, dz = (spline(s[s <= 1.0], derivative) for derivative in (0, 1, 2))
    target = np.zeros((len(s), local.shape[1]))
    target[s <= 1.0] = dz + alpha_x * (z + beta_x * x)
    weights = np.ascontiguousarray((inverse @ target).T)
    return Dmp(alpha_x, beta_x, alpha_k, centers, widths, weights, duration)


def interpolant(s: FloatArray, x: FloatArray) -> BSpline | PchipInterpolator:
    """Returns a spline through the samples x (T, D) of a demonstration at increasing times s (T,).

    The degree is 5, or lower for fewer than six samples. At uneven times such a spline may
    overshoot without limit. The result is therefore a monotone cubic interpolant if the spline, in
    any of the D components, leaves the range of the samples by more than a fifth of the range of
    the component that varies most.
    """
    spline = make_interp_spline(s, x, k=min(5, len(x) - 1) if len(x) != 5 else 3)
    low, high = x.min(axis=0), x.max(axis=0)
    margin = _OVERSHOOT * (high - low).max()
    between = spline(np.linspace(s[0], s[-1], 20 * len(s)))
    is_outside = (between < low - margin) | (between > high + margin)
    return PchipInterpolator(s, x) if is_outside.any() else spline


_OVERSHOOT = 0.2
"""Maximum overshoot of the spline through a demonstration beyond the range of the samples [-].

The overshoot is measured in each component. It is divided by the range of the component that varies
most. A monotone cubic interpolant replaces a spline with a larger overshoot."""


@lru_cache(maxsize=16)
def _fit(n_basis: int, alpha_k: float) -> tuple[FloatArray, ...]:
    """Computes basis functions of the forcing term and the matrix that fits their weights.

    They do not depend on the demonstration, and are cached because their computation requires
    15 ms.

    Args:
        n_basis: number of basis functions.
        alpha_k: decay rate of the phase, per normalized time.

    Returns:
        Normalized times (samples,) at which the forcing term is fitted; centers (n_basis,) and
        widths (n_basis,) of the basis functions over the phase; and the pseudo-inverse
        (n_basis, samples), which maps values of the forcing term at these times to weights.
    """
    # One center lies before the start: otherwise the fit is worst there, where an error
    # determines the first heading.
    gap = 1.0 / max(n_basis - 2, 1)
    centers = np.exp(-alpha_k * np.linspace(-gap, 1.0, n_basis))
    gaps = -np.diff(centers)
    widths = 0.7 / np.append(gaps, gaps[-1]) ** 2
    s = np.linspace(0.0, 1.0 + _STILL, max(601, 12 * n_basis))
    basis = activations(np.exp(-alpha_k * s), centers, widths)
    inverse = np.asarray(np.linalg.pinv(basis, rcond=2e-16 * len(basis)), dtype=float)
    for array in (s, centers, widths, inverse):
        array.setflags(write=False)
    return s, centers, widths, inverse


def checked_demonstration(path: ArrayLike, t: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
    """Checks a demonstrated path, and returns its positions and times as arrays.

    Args:
        path: (T, D) positions [m], or other quantities to be imitated; T at least 2.
        t: (T,) times [s], increasing; None: evenly over one second.

    Returns:
        Positions (T, D) and times (T,) [s].

    Raises:
        ValueError: for a wrong shape, fewer than two samples, values that are not finite, or times
            that do not increase.
    """
    path = np.asarray(path, dtype=float)
    if path.ndim != 2 or len(path) < 2:
        raise ValueError(f"path must be (T, D) with at least 2 samples, not {path.shape}")
    t = np.linspace(0.0, 1.0, len(path)) if t is None else np.asarray(t, dtype=float)
    if t.shape != (len(path),):
        raise ValueError(f"t must have one time per sample, ({len(path)},), not {t.shape}")
    bad = ~np.isfinite(np.column_stack([path, t])).all(axis=1)
    _refuse(bad, "path and t must be finite: sample {} is not")
    _refuse(np.diff(t, prepend=-np.inf) <= 0.0, "times t must increase: that of sample {} does not")
    return path, t


def _refuse(bad: Any, message: str) -> None:
    """Raises a ValueError if any sample of a demonstration is invalid.

    Args:
        bad: (T,) mask of the invalid samples.
        message: text of the error, with {} for the index of the first invalid sample.
    """
    if bad.any():
        raise ValueError(message.format(int(bad.argmax())))


class Trajectory(NamedTuple):
    """Motion of the tool's position or orientation, sampled at n + 1 normalized times.

    Attributes:
        s: (n + 1,) normalized times t / (tau T), with demonstrated duration T and temporal scaling
            tau.
        p: (n + 1, 3) positions of the tool point in the world frame [m], or rotation vectors r
            from a fixed frame A to the tool frame E, R_WE = R_WA exp([r]) [rad].
        z: (n + 1, 3) derivatives dp/ds [m or rad].
    """

    s: FloatArray
    p: FloatArray
    z: FloatArray


def roll_out(
    dmp: Dmp,
    spread: FloatArray,
    goal: FloatArray,
    p: FloatArray,
    z: FloatArray,
    k: float = 1.0,
    *,
    end: float,
    steps: int,
) -> Trajectory:
    """Integrates a movement primitive without coupling terms, that is, without avoidance.

    Each step is exact for a forcing term that is constant at its value in the middle of the step.

    Args:
        dmp: movement primitive of D dimensions.
        spread: (3, D) matrix that converts the primitive's forcing term f_L to that of the motion:
            f = spread f_L(k).
        goal: (3,) goal position in the world frame [m], or rotation vector of the goal orientation
            [rad].
        p: (3,) initial position in the world frame [m], or rotation vector from frame A [rad].
        z: (3,) initial derivative of p by normalized time [m or rad].
        k: initial phase.
        end: normalized time from the initial state to the end.
        steps: number of steps.

    Returns:
        Motion at steps + 1 normalized times, from 0 to `end`.
    """
    s, ds = np.linspace(0.0, end, steps + 1), end / steps
    setup = dmp.setup(k * dmp.phase(s[1:] - 0.5 * ds), ds, goal, spread)
    motion = np.empty((2, steps + 1, 3))
    motion[:, 0] = p, z
    advance(setup, NO_OBSTACLES, NO_OBSTACLES.terms, math.inf, *motion)
    return Trajectory(s, *motion)


def trajectory(
    dmp: Dmp, start: ArrayLike, goal: ArrayLike, *, steps: int = 500, end: float = 1.0
) -> Trajectory:
    """Computes the nominal motion of a movement primitive, from rest and without avoidance.

    Args:
        dmp: movement primitive of three dimensions.
        start: (3,) start in the world frame [m].
        goal: (3,) goal in the world frame [m].
        steps: number of steps, at least 1.
        end: normalized time at the end; 1: the planned end of the motion.

    Returns:
        Motion at steps + 1 normalized times, from 0 to `end`.

    Raises:
        ValueError: if start and goal coincide, or do not have three components.
    """
    p, g = np.array(start, dtype=float), np.array(goal, dtype=float)
    spread = float(np.linalg.norm(g - p)) * local_frame(p, g)
    return roll_out(dmp, spread, g, p, np.zeros(3), end=end, steps=steps)


LARGEST_ANGLE = math.radians(300.0)
"""Maximum rotation between the middle sample of a demonstration and any other sample [rad].

Demonstrations with larger rotations are refused, because rotation vectors become singular at
2 pi."""
_HALF_TURN = math.pi - 1e-6
"""Angle between two orientations above which the direction of rotation counts as ambiguous [rad].

Errors are then raised for consecutive samples of a demonstration, and for start and goal of a
motion without a demonstrated rotation."""
_STEP = 5e-4
"""Maximum step in normalized time for the integration of the orientation's movement primitive [-].

The forcing term is constant in a step. The resulting ripple of the angular acceleration is
proportional to the square of the step."""


@dataclass(frozen=True, eq=False)
class OrientationDmp(Frozen):
    """Movement primitive of the tool's orientation, learned from one demonstration.

    The orientation of the tool is R_WE = R_WA exp([r]), with the rotation vector r from a fixed
    frame A. A is rotated relative to the start of a motion as the middle sample of the
    demonstration is relative to its first sample. With goal g, phase k and normalized time s, r
    obeys dz/ds = alpha_x (beta_x (g - r) - z) + f_0(k) (g - r(0)) + f(k), dr/ds = z.

    Attributes:
        dmp: movement primitive of four dimensions: the forcing term f_0, which is multiplied by the
            difference of the rotation vectors of goal and start, and the forcing term f (3,) [rad].
        total: (3,) rotation vector at the end minus that at the start of the demonstration, both
            from its middle sample; zero without a demonstration [rad]. Rotation vectors are
            continuous along the samples, so that this difference may be longer than pi.
        first: (3, 3) orientation R_WE at the start of the demonstration; identity without one.
        last: (3, 3) orientation R_WE at the end of the demonstration; identity without one.
        offset: (3,) rotation vector r(0) from the middle sample of the demonstration to its first
            sample; zero without a demonstration [rad].
    """

    dmp: Dmp
    total: FloatArray
    first: FloatArray
    last: FloatArray
    offset: FloatArray


def rotation_matrix(orientation: ArrayLike) -> FloatArray:
    """Returns the rotation matrix (3, 3) of a quaternion (4,), w first, of either sign.

    Raises:
        ValueError: for another shape, or a quaternion that is zero or not finite.
    """
    quaternion = np.array(orientation, dtype=float)
    if quaternion.shape != (4,):
        raise ValueError(f"a quaternion must be (4,), w first, not {quaternion.shape}")
    if not (np.isfinite(quaternion).all() and quaternion.any()):
        raise ValueError(f"a quaternion must be finite and not zero, not {quaternion.tolist()}")
    return np.asarray(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())


def goal_vector(start: ArrayLike, goal: ArrayLike, near: ArrayLike | None = None) -> FloatArray:
    """Computes the rotation vector from one orientation S to another G, expressed in S.

    Args:
        start: (3, 3) orientation R_WS.
        goal: (3, 3) orientation R_WG.
        near: (3,) rotation vector [rad]. Of all rotation vectors that describe the rotation from S
            to G, the one nearest to `near` is returned; None: the shortest one is returned.

    Returns:
        (3,) rotation vector [rad].

    Raises:
        ValueError: if the orientations differ by 180 degrees and `near` is None.
    """
    r = Rotation.from_matrix(np.asarray(start, dtype=float).T @ goal).as_rotvec()
    if near is not None:
        return _nearest(r, np.asarray(near, dtype=float))
    if np.linalg.norm(r) > _HALF_TURN:
        raise ValueError(
            "start and goal orientation differ by 180 degrees, so that the direction of rotation "
            "is ambiguous: demonstrate the rotation, or set a nearer goal"
        )
    return np.asarray(r)


def _nearest(r: FloatArray, near: FloatArray) -> FloatArray:
    """Returns the rotation vector nearest to `near` (3,) of all that describe the rotation r [rad].

    Rotation vectors of the same rotation differ by multiples of 2 pi along their axis.
    """
    angle, length = float(np.linalg.norm(r)), float(np.linalg.norm(near))
    # The identity has no axis; that of `near`, or any other, gives the nearest vector.
    axis = r / angle if angle > 1e-9 else near / length if length > 0.0 else np.eye(3)[0]
    turns = round((float(axis @ near) - angle) / (2.0 * math.pi))
    return r if turns == 0 else np.asarray((angle + 2.0 * math.pi * turns) * axis)


def imitate_orientation(
    orientations: ArrayLike, t: ArrayLike | None = None, **constants: Any
) -> OrientationDmp:
    """Learns a movement primitive of the orientation from one demonstration.

    Args:
        orientations: (T, 4) quaternions of R_WE, w first, each of either sign and any nonzero
            length; or (T, 3, 3) rotation matrices. T at least 2.
        t: (T,) times [s], increasing; None: evenly over one second.
        constants: keyword arguments n_basis, alpha_x, beta_x and alpha_k of `fit_forcing`; alpha_k
            must equal that of the movement primitive of the position, whose phase the orientation
            follows.

    Returns:
        Movement primitive with the duration of the demonstration.

    Raises:
        ValueError: for a wrong shape, fewer than two samples, a sample that is no
            rotation, times that do not increase, 180 degrees between two consecutive samples, or a
            rotation of more than 300 degrees from the middle sample.
    """
    R, t = checked_turn(orientations, t)
    r = vectors_from(R, len(R) // 2)
    angles = np.linalg.norm(r, axis=1)
    _refuse(
        angles > LARGEST_ANGLE,
        "orientations: sample {} is rotated by more than 300 degrees, the maximum, from the middle "
        "sample; demonstrate the motion in parts",
    )
    offset, r = r[0].copy(), r - r[0]
    share = minimum_jerk_profile((t - t[0]) / (t[-1] - t[0]))
    # Rotation vectors are neither rotated into a local frame nor divided by a baseline.
    dmp = fit_forcing(np.column_stack([share - 1.0, r - share[:, None] * r[-1]]), t, **constants)
    return OrientationDmp(dmp, r[-1].copy(), R[0].copy(), R[-1].copy(), offset)


def vectors_from(R: FloatArray, origin: int) -> FloatArray:
    """Computes the rotation vectors from one orientation of a sequence to all of its orientations.

    The rotation vectors are continuous along the sequence, so that they may be longer than pi.

    Args:
        R: (T, 3, 3) orientations R_WE.
        origin: index of the orientation from which the rotation vectors are measured, and in which
            they are expressed.

    Returns:
        (T, 3) rotation vectors [rad].
    """
    r = Rotation.from_matrix(R[origin].T @ R).as_rotvec()
    r[origin] = 0.0
    for row in range(origin + 1, len(R)):
        r[row] = _nearest(r[row], r[row - 1])
    for row in range(origin - 1, -1, -1):
        r[row] = _nearest(r[row], r[row + 1])
    return np.asarray(r)


def origin_of(primitive: OrientationDmp, start: FloatArray) -> Rotation:
    """Computes the orientation R_WA from which the rotation vectors of a motion are measured.

    R_WA = R_WS exp(-[r(0)]), with the rotation vector r(0) from A to the start S, the `offset` of
    the primitive. A is the fixed reference frame of the motion.

    Args:
        primitive: movement primitive of the orientation.
        start: (3, 3) orientation R_WS at the start of the motion.
    """
    return Rotation.from_matrix(start) * Rotation.from_rotvec(-primitive.offset)


def minimum_jerk_orientation(**constants: Any) -> OrientationDmp:
    """Returns the default movement primitive of the orientation, used without a demonstration.

    Its rotation from start to goal has a fixed axis and an angle with minimum-jerk profile.

    Args:
        constants: keyword arguments n_basis, alpha_x, beta_x and alpha_k of `fit_forcing`.
    """
    return imitate_orientation(np.tile(np.eye(3), (201, 1, 1)), **constants)


def checked_turn(orientations: ArrayLike, t: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
    """Checks a demonstration of the orientation, and returns its samples as arrays.

    Args:
        orientations: (T, 4) quaternions, w first, or (T, 3, 3) rotation matrices.
        t: (T,) times [s], increasing; None: evenly over one second.

    Returns:
        Rotation matrices (T, 3, 3) and times (T,) [s].

    Raises:
        ValueError: for a wrong shape, fewer than two samples, a sample that is no rotation, 180
            degrees between two consecutive samples, values that are not finite, or times that do
            not increase.
    """
    R = checked_rotations(orientations)
    return R, checked_demonstration(np.zeros((len(R), 1)), t)[1]


def checked_rotations(orientations: ArrayLike) -> FloatArray:
    """Checks demonstrated orientations, and converts them to rotation matrices.

    Args:
        orientations: (T, 4) quaternions, w first, or (T, 3, 3) rotation matrices; T at least 2.

    Returns:
        (T, 3, 3) rotation matrices.

    Raises:
        ValueError: for a wrong shape, fewer than two samples, a sample that is no rotation, or 180
            degrees between two consecutive samples.
    """
    R = np.asarray(orientations, dtype=float)
    if R.shape[1:] not in ((4,), (3, 3)) or len(R) < 2:
        raise ValueError(
            "orientations must be (T, 4) quaternions, w first, or (T, 3, 3) rotation matrices, of "
            f"at least 2 samples, not {R.shape}"
        )
    bad = ~np.isfinite(R).reshape(len(R), -1).all(axis=1)
    _refuse(bad, "orientations must be finite: sample {} is not")
    if R.ndim == 2:
        _refuse(~R.any(axis=1), "orientations: the quaternion of sample {} is 0")
        R = Rotation.from_quat(R, scalar_first=True).as_matrix()
    else:
        error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        bad = (error >= 1e-6) | (np.linalg.det(R) <= 0.0)
        _refuse(bad, "orientations: sample {} is no rotation matrix")
    angles = Rotation.from_matrix(R[:-1].transpose(0, 2, 1) @ R[1:]).magnitude()
    _refuse(
        angles > _HALF_TURN,
        "orientations: sample {} and the next differ by 180 degrees, so that the direction of "
        "rotation is ambiguous; sample more often",
    )
    return R


def roll_orientation(
    primitive: OrientationDmp,
    goal: FloatArray,
    r: FloatArray,
    z: FloatArray,
    k: float = 1.0,
    *,
    end: float,
) -> Trajectory:
    """Integrates a movement primitive of the orientation without coupling terms.

    All rotation vectors are measured from the fixed reference frame A of the motion and expressed
    in A; `origin_of` computes its orientation R_WA.

    Args:
        primitive: movement primitive of the orientation.
        goal: (3,) rotation vector of the goal orientation [rad]; `demonstrated_goal` computes it.
        r: (3,) initial rotation vector [rad].
        z: (3,) initial derivative of r by normalized time [rad].
        k: initial phase.
        end: normalized time from the initial state to the end.

    Returns:
        Motion with the rotation vectors as `p`, and their derivatives by normalized time as `z`.
    """
    spread = np.column_stack([goal - primitive.offset, np.eye(3)])
    steps = max(math.ceil(end / _STEP), 1)
    return roll_out(primitive.dmp, spread, goal, r, z, k, end=end, steps=steps)


def orientation_along(
    primitive: OrientationDmp, start: ArrayLike, goal: ArrayLike, s: ArrayLike
) -> FloatArray:
    """Computes the orientations of the tool at given times of a motion that starts at rest.

    Args:
        primitive: movement primitive of the orientation.
        start: (3, 3) R_WE at the start.
        goal: (3, 3) R_WE at the goal; the direction of rotation is the demonstration's.
        s: (T,) normalized times (time over planned duration), at least 0.

    Returns:
        (T, 3, 3) orientations R_WE.

    Raises:
        ValueError: if start and goal orientation differ by 180 degrees and there is no
            demonstration.
    """
    R_WS, target = np.asarray(start, dtype=float), demonstrated_goal(primitive, start, goal)
    end = max(float(np.max(s)), _STEP)
    motion = roll_orientation(primitive, target, primitive.offset, np.zeros(3), end=end)
    r = CubicHermiteSpline(motion.s, motion.p, motion.z)(s)
    return np.asarray((origin_of(primitive, R_WS) * Rotation.from_rotvec(r)).as_matrix())


def demonstrated_goal(primitive: OrientationDmp, start: ArrayLike, goal: ArrayLike) -> FloatArray:
    """Computes the rotation vector of the goal orientation of a motion.

    Of all rotation vectors to the same orientation, the one in the demonstrated direction of
    rotation is returned; without a demonstration, the shortest one.

    Args:
        primitive: movement primitive of the orientation.
        start: (3, 3) orientation R_WS at the start of the motion.
        goal: (3, 3) orientation R_WG at the goal.

    Returns:
        (3,) rotation vector from A to the goal, expressed in A [rad]. A is the fixed reference
        frame of the motion; `origin_of` computes its orientation R_WA.

    Raises:
        ValueError: if both orientations differ by 180 degrees and there is no demonstration.
    """
    near = primitive.offset + primitive.total
    origin = origin_of(primitive, np.asarray(start, dtype=float)).as_matrix()
    return goal_vector(origin, goal, near if near.any() else None)


QUATERNION, W, ALPHA = slice(0, 4), slice(4, 7), slice(7, 10)
"""Slices of quaternion, angular velocity and acceleration of the tool in a result of `evaluate`.

The result is a vector (10,): quaternion of R_WE, w first, w_WE [rad/s] and alpha_WE [rad/s^2]."""
_DIFFERENCE = 1e-5
"""Time step of the central difference that computes the tool's angular acceleration [s]."""


def evaluate(ends: FloatArray, length: float, origin: Rotation, time: float) -> FloatArray:
    """Computes orientation, angular velocity and acceleration of the tool at a given time.

    The orientation is R_WE = R_WA exp([r]), with a fixed frame A. Between two steps of the
    integrator, the rotation vector r is a cubic polynomial in time; after the second step its time
    derivative is constant.

    Args:
        ends: (2, 2, 3) r [rad] and its time derivative [rad/s] at the first and at the second step
            of the integrator.
        length: time between the steps [s].
        origin: orientation R_WA from which r is measured.
        time: time since the first step, at least 0 [s].

    Returns:
        (10,) quaternion of R_WE, w first; w_WE [rad/s] and alpha_WE [rad/s^2] in the world frame.
        The quaternion is continuous in r for all angles.
    """
    (begin, rate), (end, rate_end) = ends
    cubic = np.array([end, rate_end, np.zeros(3), np.zeros(3)])
    # The tolerance prevents that rounding sets the acceleration to zero at the end of a step.
    if length > 0.0 and time - length < 1e-9:
        mean = (end - begin) / length
        square = (3.0 * mean - 2.0 * rate - rate_end) / length
        cubic = np.array([begin, rate, square, (rate + rate_end - 2.0 * mean) / length**2])
    else:
        time -= length
    before, now, after = (_rate(cubic, time + step) for step in (-_DIFFERENCE, 0.0, _DIFFERENCE))
    r = time ** np.arange(4) @ cubic
    turned = (origin * Rotation.from_rotvec(r)).as_quat(scalar_first=True)
    rates = origin.apply([now, (after - before) / (2.0 * _DIFFERENCE)])
    return np.concatenate([turned, *rates])


@compiled
def _rate(cubic: FloatArray, time: float) -> FloatArray:
    """Computes the angular velocity of a rotation whose rotation vector is a cubic polynomial.

    Args:
        cubic: (4, 3) coefficients of r(t) = c_0 + c_1 t + c_2 t^2 + c_3 t^3.
        time: time t [s].

    Returns:
        (3,) angular velocity in the frame from which r is measured [rad/s].
    """
    r = cubic[0] + time * (cubic[1] + time * (cubic[2] + time * cubic[3]))
    dr = cubic[1] + time * (2.0 * cubic[2] + 3.0 * time * cubic[3])
    square = (r * r).sum()
    angle = math.sqrt(square)
    a, b = 0.5, 1.0 / 6.0
    if angle > 1e-3:
        a, b = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
    once = np.cross(r, dr)
    return dr + a * once + b * np.cross(r, once)


@dataclass(frozen=True, eq=False)
class Demonstration(Frozen):
    """Demonstration that a new motion imitates: position and orientation of the tool, and posture.

    For a field that is None or empty, the motion imitates the demonstrations of the scenario (field
    `task.demonstration`) or, without any, a straight minimum-jerk motion.

    Attributes:
        position: movement primitive of the tool point, with the duration of the motion.
        orientation: movement primitive of the tool's orientation.
        R_WS: (3, 3) orientation of the tool at the start, used with `orientation`.
        R_WG: (3, 3) orientation of the tool at the goal, used with `orientation`.
        s: (T,) normalized times (time over planned duration) of the joint positions, from 0 to 1.
        q: (T, n) joint positions of the arm at these times [rad].
    """

    position: Dmp | None = None
    orientation: OrientationDmp | None = None
    R_WS: FloatArray = field(default_factory=lambda: np.eye(3))
    R_WG: FloatArray = field(default_factory=lambda: np.eye(3))
    s: FloatArray = zeros(0)
    q: FloatArray = zeros(0, 0)

    def posture(self, s: FloatArray) -> FloatArray:
        """Interpolates the demonstrated joint positions linearly at normalized times.

        Args:
            s: (M,) normalized times (time over planned duration), clipped to [0, 1].

        Returns:
            (M, n) joint positions [rad].
        """
        return np.stack([np.interp(s, self.s, joint) for joint in self.q.T], axis=1)
