"""Dynamic movement primitives: the motion that the coupling terms bend.

Time. T is the demonstrated duration in seconds and tau the temporal scaling
relative to it; s = t / (tau T) is normalized time, 1 at the end of the motion. In it

    dz/ds = alpha_x (beta_x (g - x) - z) + f(k) + C      (eq. 1)
    dx/ds = z                                            (eq. 2)
    dk/ds = -alpha_k k,  k(0) = 1                        (eq. 5)

which are the paper's equations with tau T for its tau. So z is in meters, the
velocity is z / (tau T), and nothing here depends on tau.

Space. The forcing term is learnt in the demonstration's local frame L and divided by
its baseline, and is placed along the baseline at hand: f_W = baseline R_WL f(k).

A movement primitive for the orientation of the tool, on the phase of the position's.

The orientation is R_WE = R_WA exp([r]), with r the rotation vector from an origin A, in A. The
origin is the orientation at the start S, so that r begins at zero, unless the demonstration turns
far (`OrientationDmp.offset`). r obeys the linear system above, in normalized
time s and with the same phase k,

    dz/ds = alpha_x (beta_x (g - r) - z) + f_0(k) (g - r(0)) + f(k),    dr/ds = z,

with g the rotation vector of the goal. f_0 is learnt from the least-jerk share m(s) that rises
from 0 to 1, and f from the rest of the demonstration: r(s) - m(s) r(1), r counted from r(0). So a
motion to another goal is r(0) + m(s) (g - r(0)) + (r(s) - m(s) r(1)), also where start and goal
have the same orientation. A step is exact, as the position's is, and the exponential map has no
singularity: only learning from orientations, and naming a goal, take logarithms. Along r(t),

    w_A = r' + a r x r' + b r x (r x r'),   a = (1 - cos |r|) / |r|^2,
                                            b = (|r| - sin |r|) / |r|^3,

the left Jacobian of the exponential map applied to r', is the angular velocity in A.

Departure from Ude et al. (ICRA 2014), who let a spring act on 2 log(g q*): there the system
is not linear, so that it has no closed-form step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, CubicHermiteSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, Frozen, zeros
from drake_oa.policy.action_kernels import MotionSetup, advance, spring_flow
from drake_oa.policy.guidance import NO_OBSTACLES

ALPHA_X = 48.0
"""Default spring constant alpha_x, per normalized time."""
BETA_X = ALPHA_X / 4.0
"""Default spring constant beta_x: critical damping."""
ALPHA_K = math.log(100.0)
"""Default decay of the phase: 1 % is left at the end of the motion."""
N_BASIS = 35
"""Default number of basis functions."""
_STILL = 0.2
"""Normalized time after the end for which no force is to be left: where a motion ends at rest, it
stays there the better. Without it a force leads a recorded motion off by 1 to 2 mm."""


@dataclass(frozen=True, eq=False)
class Dmp(Frozen):
    """A movement primitive of D dimensions, for a baseline of length 1.

    Attributes:
        alpha_x: spring constant, per normalized time.
        beta_x: spring constant; alpha_x / 4 for critical damping.
        alpha_k: decay of the phase, per normalized time.
        centers: (N,) centers c_i of the basis functions over the phase.
        widths: (N,) widths h_i, above 0.
        weights: (D, N) weights in the local frame, divided by the baseline.
        duration: T, how long the demonstration took [s].
    """

    alpha_x: float
    beta_x: float
    alpha_k: float
    centers: FloatArray
    widths: FloatArray
    weights: FloatArray
    duration: float = 1.0

    def phase(self, s: ArrayLike) -> FloatArray:
        """Phase k at normalized time s, (eq. 5): exp(-alpha_k s)."""
        return np.asarray(np.exp(-self.alpha_k * np.asarray(s, dtype=float)))

    def forcing(self, k: FloatArray) -> FloatArray:
        """Forcing term (eq. 3) at phases (T,), for a baseline of length 1, (T, D)."""
        return np.asarray(activations(k, self.centers, self.widths) @ self.weights.T)

    def course(
        self, k: FloatArray, ds: float, goal: FloatArray, spread: FloatArray, **more: Any
    ) -> MotionSetup:
        """Constants of a motion.

        Args:
            k: (T,) phases in the middle of its steps.
            ds: length of a step in normalized time.
            goal: (3,) goal.
            spread: (3, D) factors on the forcing term: f = spread f_L(k).
            more: further fields of `MotionSetup`.
        """
        rest = goal + self.forcing(k) @ spread.T / (self.alpha_x * self.beta_x)
        flow = spring_flow(self.alpha_x, self.beta_x, 0.5 * ds)
        x, y, z = goal.tolist()
        return MotionSetup(
            np.ascontiguousarray(rest), flow, ds, (x, y, z), tuple(spread[:, 0].tolist()), **more
        )


def activations(k: FloatArray, centers: FloatArray, widths: FloatArray) -> FloatArray:
    """Normalized basis functions (eq. 4) times the phase, (T, N) at phases (T,)."""
    exponent = widths * (k[:, None] - centers) ** 2
    # Far from every center the quotient exists, its parts would underflow.
    basis = np.exp(exponent.min(axis=1, keepdims=True) - exponent)
    return np.asarray(basis * (k / basis.sum(axis=1))[:, None])


def normalized_time(k: float, alpha_k: float) -> float:
    """Normalized time s at phase k: the inverse of `Dmp.phase`."""
    return -math.log(max(k, 1e-300)) / alpha_k


def local_frame(p_WS: ArrayLike, p_WG: ArrayLike) -> FloatArray:
    """Orientation R_WL of the local frame of a motion (section II-A).

    x points from start to goal, z upward and orthogonal to it, y completes the
    right-handed frame. For a vertical baseline y is the world's y axis, which is the
    limit of baselines in the world's xz plane that point toward +x.

    Args:
        p_WS: (3,) start [m].
        p_WG: (3,) goal [m].

    Returns:
        (3, 3) rotation matrix.

    Raises:
        ValueError: if start and goal coincide or are not finite.
    """
    way = np.asarray(p_WG, dtype=float) - p_WS
    length = float(np.linalg.norm(way))
    if not 0.0 < length < math.inf:
        raise ValueError(f"start and goal must be finite and apart, not {p_WS!r} and {p_WG!r}")
    x = way / length
    y, flat = np.array([-x[1], x[0], 0.0]), math.hypot(x[0], x[1])
    y = y / flat if flat > 1e-12 else np.array([0.0, 1.0, 0.0])
    return np.column_stack([x, y, np.cross(x, y)])


def minimum_jerk(
    start: ArrayLike, goal: ArrayLike, *, duration: float = 1.0, samples: int = 201
) -> tuple[FloatArray, FloatArray]:
    """The straight, rest-to-rest path of least jerk: the default demonstration.

    Args:
        start: (D,) start [m].
        goal: (D,) goal [m].
        duration: [s].
        samples: number of samples, at least 2.

    Returns:
        path (samples, D) [m] and its stamps (samples,) [s].
    """
    begin, way = np.asarray(start, dtype=float), np.subtract(goal, start)
    s = np.linspace(0.0, 1.0, samples)
    return begin + minimum_jerk_share(s)[:, None] * way, duration * s


def minimum_jerk_share(s: FloatArray) -> FloatArray:
    """Share of its way that a minimum-jerk motion has gone at normalized times in [0, 1]."""
    return np.asarray(s**3 * (10.0 + s * (6.0 * s - 15.0)))


def imitate(path: ArrayLike, t: ArrayLike | None = None, **constants: Any) -> Dmp:
    """Learns a movement primitive from one demonstrated path.

    Args:
        path: (T, 3) positions; T at least 2.
        t: (T,) stamps [s], increasing, at any spacing; None: evenly over one second.
        constants: keyword arguments of `fit_forcing`.

    Returns:
        The primitive; its duration is that of the demonstration.

    Raises:
        ValueError: for fewer than two samples, values that are not finite, stamps that
            do not increase, or a path that ends where it starts.
    """
    path, t = checked_demonstration(path, t)
    return fit_forcing(in_local_frame(path), t, **constants)


def in_local_frame(path: FloatArray, share: float = 1e-6) -> FloatArray:
    """Returns a path (T, 3) from its end, in its local frame, divided by its baseline.

    Raises:
        ValueError: if the baseline is not longer than a share of the extent.
    """
    baseline, extent = float(np.linalg.norm(path[-1] - path[0])), float(np.ptp(path, axis=0).max())
    if not baseline > share * extent:
        raise ValueError(
            "the path must end away from where it starts, which it is scaled by: its baseline is "
            f"{baseline:.3g} m, its extent {extent:.3g} m; show it in two parts"
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
    """Fits the forcing term of a path that is given from its end.

    The forcing term that makes (eq. 1) follow the demonstration is sampled on its `interpolant`
    and fitted by linear least squares over all basis functions at once.

    Args:
        local: (T, D) positions from the last one, in the local frame, divided by the baseline.
        t: (T,) stamps [s].
        n_basis: number of basis functions, at least 2, evenly spaced in time.
        alpha_x: spring constant, per normalized time.
        beta_x: spring constant, per normalized time.
        alpha_k: decay of the phase, per normalized time.
    """
    duration = float(t[-1] - t[0])
    spline = interpolant((t - t[0]) / duration, local)
    s, centers, widths, inverse = _fit(n_basis, alpha_k)
    x, z, dz = (spline(s[s <= 1.0], derivative) for derivative in (0, 1, 2))
    target = np.zeros((len(s), local.shape[1]))
    target[s <= 1.0] = dz + alpha_x * (z + beta_x * x)
    weights = np.ascontiguousarray((inverse @ target).T)
    return Dmp(alpha_x, beta_x, alpha_k, centers, widths, weights, duration)


def interpolant(s: FloatArray, x: FloatArray) -> BSpline:
    """Quintic, or for few samples lower, spline through values (T, D) at times (T,)."""
    return make_interp_spline(s, x, k=min(5, len(x) - 1) if len(x) != 5 else 3)


@lru_cache(maxsize=16)
def _fit(n_basis: int, alpha_k: float) -> tuple[FloatArray, ...]:
    """Returns the normalized times of a fit, the centers and widths of the basis functions, and
    (n_basis, samples) the matrix that fits their weights.

    The least squares of a plan take 15 ms, and the same matrix each time.
    """
    # One center before the start: without it the fit is poorest there, where an error
    # decides the first heading.
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
    """(T, D) positions and (T,) stamps that can be imitated; raises as `imitate`."""
    path = np.asarray(path, dtype=float)
    if path.ndim != 2 or len(path) < 2:
        raise ValueError(f"path must be (T, D) with at least 2 samples, not {path.shape}")
    t = np.linspace(0.0, 1.0, len(path)) if t is None else np.asarray(t, dtype=float)
    if t.shape != (len(path),):
        raise ValueError(f"t must be one stamp a sample, ({len(path)},), not {t.shape}")
    bad = ~np.isfinite(np.column_stack([path, t])).all(axis=1)
    _refuse(bad, "path and t must be finite: sample {} is not")
    _refuse(np.diff(t, prepend=-np.inf) <= 0.0, "stamps must increase: that of sample {} does not")
    return path, t


def _refuse(bad: Any, message: str) -> None:
    """Raises a ValueError that names the first bad sample, if one is."""
    if bad.any():
        raise ValueError(message.format(int(bad.argmax())))


class Trajectory(NamedTuple):
    """A motion sampled in normalized time.

    Attributes:
        s: (n + 1,) normalized time.
        p: (n + 1, D) position [m].
        z: (n + 1, D) scaled velocity dp/ds [m].
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
    """Integrates a movement primitive without coupling terms.

    A step is exact but for the forcing term, which is held at its value in the middle.

    Args:
        dmp: the movement primitive, of D dimensions.
        spread: (3, D) factors on its forcing term: f = spread f_L(k).
        goal: (3,) goal.
        p: (3,) position at the beginning.
        z: (3,) its derivative by normalized time.
        k: phase there.
        end: length in normalized time.
        steps: number of steps.
    """
    s, ds = np.linspace(0.0, end, steps + 1), end / steps
    course = dmp.course(k * dmp.phase(s[1:] - 0.5 * ds), ds, goal, spread)
    motion = np.empty((2, steps + 1, 3))
    motion[:, 0] = p, z
    advance(course, NO_OBSTACLES, NO_OBSTACLES.terms, math.inf, *motion)
    return Trajectory(s, *motion)


def trajectory(
    dmp: Dmp,
    start: ArrayLike,
    goal: ArrayLike,
    *,
    steps: int = 500,
    end: float = 1.0,
) -> Trajectory:
    """Rolls the movement primitive forward from rest: the planned motion.

    Args:
        dmp: the movement primitive, of three dimensions.
        start: (3,) start [m].
        goal: (3,) goal [m].
        steps: number of steps, at least 1.
        end: normalized time at the end.

    Returns:
        The motion at steps + 1 instants.

    Raises:
        ValueError: if start and goal coincide, or do not fit the primitive.
    """
    p, g = np.array(start, dtype=float), np.array(goal, dtype=float)
    spread = float(np.linalg.norm(g - p)) * local_frame(p, g)
    return roll_out(dmp, spread, g, p, np.zeros(3), end=end, steps=steps)


LARGEST_ANGLE = math.radians(300.0)
"""Largest angle from the middle that can be imitated: rotation vectors end at 360 degrees."""
_HALF_TURN = math.pi - 1e-6
"""Angle above which a rotation has no unique direction [rad]."""
_STEP = 5e-4
"""Longest time for which forcing is held, in normalized time. The saw-tooth that it leaves in the
acceleration falls with its square."""


@dataclass(frozen=True, eq=False)
class OrientationDmp(Frozen):
    """A movement primitive of the orientation.

    Attributes:
        dmp: of four dimensions: the share f_0 of the goal's rotation vector, and f [rad].
        total: (3,) rotation vector from the demonstration's start to its end, continued
            from sample to sample; zero without a demonstration [rad].
        first: (3, 3) orientation at the start of the demonstration.
        last: (3, 3) orientation at its end.
        offset: (3,) r(0), the rotation vector from the origin, which is the middle of the
            demonstration, to the start; zero without a demonstration [rad].
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
    """Returns the rotation vector from one orientation to another, in the frame of the first.

    Args:
        start: (3, 3) R_WS.
        goal: (3, 3) R_WG.
        near: (3,) vector to which the returned one is the nearest [rad]. None: the shortest is
            returned.

    Returns:
        (3,) [rad].

    Raises:
        ValueError: if they are half a turn apart and `near` is None.
    """
    r = Rotation.from_matrix(np.asarray(start, dtype=float).T @ goal).as_rotvec()
    if near is not None:
        return _nearest(r, np.asarray(near, dtype=float))
    if np.linalg.norm(r) > _HALF_TURN:
        raise ValueError(
            "start and goal orientation are half a turn apart, which leaves open which way "
            "round: demonstrate it, or give a goal that is nearer"
        )
    return np.asarray(r)


def _nearest(r: FloatArray, near: FloatArray) -> FloatArray:
    """Returns the rotation vector of the same rotation as r that is nearest to another one."""
    angle, length = float(np.linalg.norm(r)), float(np.linalg.norm(near))
    # The identity has no axis: any will do.
    axis = r / angle if angle > 1e-9 else near / length if length > 0.0 else np.eye(3)[0]
    turns = round((float(axis @ near) - angle) / (2.0 * math.pi))
    return r if turns == 0 else np.asarray((angle + 2.0 * math.pi * turns) * axis)


def imitate_orientation(
    orientations: ArrayLike, t: ArrayLike | None = None, **constants: Any
) -> OrientationDmp:
    """Learns a movement primitive of the orientation from one demonstration.

    Args:
        orientations: (T, 4) quaternions R_WE, w first, of any sign and length, each sign
            for itself; or (T, 3, 3) rotation matrices. T at least 2.
        t: (T,) stamps [s], increasing; None: evenly over one second.
        constants: keyword arguments of `fit_forcing`; the decay of the phase is the position's.

    Raises:
        ValueError: for a wrong shape, fewer than two samples, a sample that is no
            rotation, stamps that do not increase, half a turn or more between two samples,
            or a motion that turns further than `LARGEST_ANGLE` from its middle.
    """
    R, t = checked_turn(orientations, t)
    r = vectors_from(R, len(R) // 2)
    angles = np.linalg.norm(r, axis=1)
    _refuse(
        angles > LARGEST_ANGLE,
        "orientations: sample {} has turned too far from the middle; at most 300 degrees can be "
        "imitated",
    )
    offset, r = r[0].copy(), r - r[0]
    share = minimum_jerk_share((t - t[0]) / (t[-1] - t[0]))
    # The baseline is the first axis, and 1: nothing is turned or scaled.
    dmp = fit_forcing(np.column_stack([share - 1.0, r - share[:, None] * r[-1]]), t, **constants)
    return OrientationDmp(dmp, r[-1].copy(), R[0].copy(), R[-1].copy(), offset)


def vectors_from(R: FloatArray, origin: int) -> FloatArray:
    """Computes rotation vectors (T, 3) from one of (T, 3, 3) orientations to each, continuously."""
    r = Rotation.from_matrix(R[origin].T @ R).as_rotvec()
    r[origin] = 0.0
    for row in range(origin + 1, len(R)):
        r[row] = _nearest(r[row], r[row - 1])
    for row in range(origin - 1, -1, -1):
        r[row] = _nearest(r[row], r[row + 1])
    return np.asarray(r)


def origin_of(primitive: OrientationDmp, start: FloatArray) -> Rotation:
    """Returns the origin R_WA of a motion from a start R_WS (3, 3)."""
    return Rotation.from_matrix(start) * Rotation.from_rotvec(-primitive.offset)


def minimum_jerk_orientation(**constants: Any) -> OrientationDmp:
    """Returns the primitive of a turn about a fixed axis with least jerk: the default.

    Args:
        constants: keyword arguments of `fit_forcing`.
    """
    return imitate_orientation(np.tile(np.eye(3), (201, 1, 1)), **constants)


def checked_turn(orientations: ArrayLike, t: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
    """Checks orientations (T, 3, 3) and stamps (T,); raises as `imitate_orientation`."""
    R = checked_rotations(orientations)
    return R, checked_demonstration(np.zeros((len(R), 1)), t)[1]


def checked_rotations(orientations: ArrayLike) -> FloatArray:
    """Returns (T, 3, 3) rotation matrices that can be imitated; raises as `imitate_orientation`."""
    given = np.asarray(orientations, dtype=float)
    if given.shape[1:] not in ((4,), (3, 3)) or len(given) < 2:
        raise ValueError(
            "orientations must be (T, 4) quaternions, w first, or (T, 3, 3) rotation matrices, of "
            f"at least 2 samples, not {given.shape}"
        )
    bad = ~np.isfinite(given).reshape(len(given), -1).all(axis=1)
    _refuse(bad, "orientations must be finite: sample {} is not")
    if given.ndim == 2:
        _refuse(~given.any(axis=1), "orientations: the quaternion of sample {} is 0")
        given = Rotation.from_quat(given, scalar_first=True).as_matrix()
    else:
        error = np.abs(given @ given.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        bad = (error >= 1e-6) | (np.linalg.det(given) <= 0.0)
        _refuse(bad, "orientations: sample {} is no rotation matrix")
    between = Rotation.from_matrix(given[:-1].transpose(0, 2, 1) @ given[1:]).magnitude()
    _refuse(
        between > _HALF_TURN,
        "orientations: sample {} and the next are half a turn apart, which leaves open which way "
        "round; sample more often",
    )
    return given


def roll_orientation(
    primitive: OrientationDmp,
    goal: FloatArray,
    r: FloatArray,
    z: FloatArray,
    k: float = 1.0,
    *,
    end: float,
) -> Trajectory:
    """Integrates the primitive.

    Args:
        primitive: the movement primitive.
        goal: (3,) rotation vector of the goal from the origin, see `demonstrated_goal` [rad].
        r: (3,) rotation vector at the beginning [rad].
        z: (3,) its derivative by normalized time there [rad].
        k: phase there.
        end: length in normalized time.

    Returns:
        The rotation vectors r as `p`, and their derivatives `z`.
    """
    spread = np.column_stack([goal - primitive.offset, np.eye(3)])
    steps = max(math.ceil(end / _STEP), 1)
    return roll_out(primitive.dmp, spread, goal, r, z, k, end=end, steps=steps)


def orientation_along(
    primitive: OrientationDmp, start: ArrayLike, goal: ArrayLike, s: ArrayLike
) -> FloatArray:
    """Computes the orientations of a motion at normalized times.

    Args:
        primitive: the movement primitive.
        start: (3, 3) R_WE at the start.
        goal: (3, 3) R_WE at the goal; the direction of turning is the demonstration's.
        s: (T,) normalized times, at least 0.

    Returns:
        (T, 3, 3) R_WE.

    Raises:
        ValueError: as `goal_vector`.
    """
    R_WS, target = np.asarray(start, dtype=float), demonstrated_goal(primitive, start, goal)
    end = max(float(np.max(s)), _STEP)
    motion = roll_orientation(primitive, target, primitive.offset, np.zeros(3), end=end)
    r = CubicHermiteSpline(motion.s, motion.p, motion.z)(s)
    return np.asarray((origin_of(primitive, R_WS) * Rotation.from_rotvec(r)).as_matrix())


def demonstrated_goal(primitive: OrientationDmp, start: ArrayLike, goal: ArrayLike) -> FloatArray:
    """Computes the rotation vector of a goal R_WG (3, 3) from the origin of a motion.

    It turns the way that was demonstrated; without a demonstration, the shortest.

    Raises:
        ValueError: as `goal_vector`.
    """
    near = primitive.offset + primitive.total
    origin = origin_of(primitive, np.asarray(start, dtype=float)).as_matrix()
    return goal_vector(origin, goal, near if near.any() else None)


QUATERNION, W, ALPHA = slice(0, 4), slice(4, 7), slice(7, 10)
"""Parts of the result of `evaluate`."""
_DIFFERENCE = 1e-5
"""Time between the samples of the central difference of the angular velocity [s]."""


def evaluate(ends: FloatArray, length: float, origin: Rotation, time: float) -> FloatArray:
    """Evaluates the motion between two steps: quaternion, angular velocity and acceleration.

    r is the cubic between the ends; after its end it goes on at its last rate.

    Args:
        ends: (2, 2, 3) r [rad] and its rate [rad/s] at the begin and at the end.
        length: time between the two [s].
        origin: R_WA.
        time: time since the begin, at least 0 [s].

    Returns:
        (10,) quaternion of R_WE, continuous in r over every angle, w_WE [rad/s] and
        alpha_WE [rad/s^2] in W.
    """
    (begin, rate), (end, rate_end) = ends
    cubic = np.array([end, rate_end, np.zeros(3), np.zeros(3)])
    # Less is rounding, which must not end the acceleration at the end of a step.
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
    """Angular velocity (3,) in A at a time along a cubic (4, 3) of the rotation vector."""
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
    """What the primitives imitate from where a motion begins; empty: what the task demonstrates.

    Attributes:
        position: of the tool point, three dimensions; its duration is the motion's [s].
        orientation: of the tool, from where it is to where it ends.
        R_WS, R_WG: (3, 3) orientation at its begin and at its end.
        s: (T,) normalized times of the posture, from 0 to 1.
        q: (T, n) positions of the arm's joints there [rad].
    """

    position: Dmp | None = None
    orientation: OrientationDmp | None = None
    R_WS: FloatArray = field(default_factory=lambda: np.eye(3))
    R_WG: FloatArray = field(default_factory=lambda: np.eye(3))
    s: FloatArray = zeros(0)
    q: FloatArray = zeros(0, 0)

    def posture(self, s: FloatArray) -> FloatArray:
        """(M, n) joints at normalized times (M,); beyond the ends those of the ends [rad]."""
        return np.stack([np.interp(s, self.s, joint) for joint in self.q.T], axis=1)
