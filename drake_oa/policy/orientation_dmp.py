"""A movement primitive for the orientation of the tool, on the phase of the position's.

The orientation is R_WE = R_WA exp([r]), with r the rotation vector from an origin A, in A. The
origin is the orientation at the start S, so that r begins at zero, unless the demonstration turns
far (`OrientationDmp.offset`). r obeys the linear system of `drake_oa.policy.dmp`, in normalised
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

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.policy.dmp import (
    ALPHA_K,
    ALPHA_X,
    BETA_X,
    N_BASIS,
    Dmp,
    Trajectory,
    imitate,
    minimum_jerk,
    minimum_jerk_share,
    roll_out,
)

LARGEST_ANGLE = math.radians(300.0)
"""Largest angle from the start that can be imitated: rotation vectors end at 360 degrees."""
_HALF_TURN = math.pi - 1e-6
"""Angle above which a rotation has no unique direction [rad]."""
_STEP = 5e-4
"""Longest time for which forcing is held, in normalised time. The saw-tooth that it leaves in the
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
        offset: (3,) r(0), the rotation vector from the origin to the start: zero, except for a
            demonstration that turns farther than `LARGEST_ANGLE` from its start, whose origin is
            its middle [rad].

    Raises:
        ValueError: if the primitive does not have four dimensions.
    """

    dmp: Dmp
    total: FloatArray = field(default_factory=lambda: np.zeros(3))
    first: FloatArray = field(default_factory=lambda: np.eye(3))
    last: FloatArray = field(default_factory=lambda: np.eye(3))
    offset: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if self.dmp.dimension != 4:
            raise ValueError(f"dmp must have 4 dimensions, not {self.dmp.dimension}")
        super().__post_init__()


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
    orientations: ArrayLike,
    t: ArrayLike | None = None,
    *,
    n_basis: int = N_BASIS,
    alpha_x: float = ALPHA_X,
    beta_x: float = BETA_X,
    alpha_k: float = ALPHA_K,
    still: float = 0.0,
) -> OrientationDmp:
    """Learns a movement primitive of the orientation from one demonstration.

    Args:
        orientations: (T, 4) quaternions R_WE, w first, of any sign and length, each sign
            for itself; or (T, 3, 3) rotation matrices. T at least 2.
        t: (T,) stamps [s], increasing; None: evenly over one second.
        n_basis: number of basis functions.
        alpha_x: spring constant, per normalised time.
        beta_x: spring constant, per normalised time.
        alpha_k: decay of the phase; the position's.
        still: as in `imitate`.

    Raises:
        ValueError: for a wrong shape, fewer than two samples, a sample that is no
            rotation, stamps that do not increase, half a turn or more between two samples,
            or a motion that turns further than `LARGEST_ANGLE` from its start.
    """
    R = checked_rotations(orientations)
    r = vectors_from(R, 0)
    if np.linalg.norm(r, axis=1).max() > LARGEST_ANGLE:
        r = vectors_from(R, len(R) // 2)
    angles = np.linalg.norm(r, axis=1)
    row = int(np.argmax(angles > LARGEST_ANGLE))
    if angles[row] > LARGEST_ANGLE:
        raise ValueError(
            f"orientations: sample {row} has turned {math.degrees(angles[row]):.0f} degrees from "
            f"the middle; at most {math.degrees(LARGEST_ANGLE):.0f} can be imitated"
        )
    offset, r = r[0].copy(), r - r[0]
    count = len(R)
    stamps = np.linspace(0.0, 1.0, count) if t is None else np.asarray(t, dtype=float)
    s = np.linspace(0.0, 1.0, count)
    if stamps.shape == (count,) and stamps[-1] > stamps[0]:
        s = (stamps - stamps[0]) / (stamps[-1] - stamps[0])
    share = minimum_jerk_share(s)
    # A path whose baseline is the first axis, and 1: nothing is turned or scaled.
    path = np.column_stack([share, r - share[:, None] * r[-1]])
    constants = {"alpha_x": alpha_x, "beta_x": beta_x, "alpha_k": alpha_k, "still": still}
    dmp = imitate(path, stamps, n_basis=n_basis, **constants)
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


def origin_of(primitive: OrientationDmp, start: FloatArray) -> FloatArray:
    """Returns the origin R_WA (3, 3) of a motion from a start R_WS (3, 3)."""
    return np.asarray(start @ Rotation.from_rotvec(-primitive.offset).as_matrix())


def minimum_jerk_orientation(
    *,
    n_basis: int = N_BASIS,
    alpha_x: float = ALPHA_X,
    beta_x: float = BETA_X,
    alpha_k: float = ALPHA_K,
) -> OrientationDmp:
    """Returns the primitive of a turn about a fixed axis with least jerk: the default.

    Raises:
        ValueError: for constants that are not positive.
    """
    share, t = minimum_jerk([0.0], [1.0])
    path = np.column_stack([share, np.zeros((len(share), 3))])
    return OrientationDmp(
        imitate(path, t, n_basis=n_basis, alpha_x=alpha_x, beta_x=beta_x, alpha_k=alpha_k)
    )


def checked_rotations(orientations: ArrayLike) -> FloatArray:
    """Returns (T, 3, 3) rotation matrices that can be imitated; raises as `imitate_orientation`."""
    given = np.asarray(orientations, dtype=float)
    if given.shape[1:] not in ((4,), (3, 3)):
        raise ValueError(
            "orientations must be (T, 4) quaternions, w first, or (T, 3, 3) rotation matrices, "
            f"not {given.shape}"
        )
    if len(given) < 2:
        raise ValueError(f"orientations must have at least 2 samples, not {len(given)}")
    finite = np.isfinite(given).reshape(len(given), -1).all(axis=1)
    if not finite.all():
        raise ValueError(f"orientations must be finite: sample {int(np.argmin(finite))} is not")
    if given.ndim == 2:
        nonzero = given.any(axis=1)
        if not nonzero.all():
            raise ValueError(
                f"orientations: the quaternion of sample {int(np.argmin(nonzero))} is 0"
            )
        given = Rotation.from_quat(given, scalar_first=True).as_matrix()
    else:
        error = np.abs(given @ given.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        good = (error < 1e-6) & (np.linalg.det(given) > 0.0)
        if not good.all():
            raise ValueError(f"orientations: sample {int(np.argmin(good))} is no rotation matrix")
    between = Rotation.from_matrix(given[:-1].transpose(0, 2, 1) @ given[1:]).magnitude()
    row = int(np.argmax(between))
    if between[row] > _HALF_TURN:
        raise ValueError(
            f"orientations: samples {row} and {row + 1} are half a turn apart, which leaves "
            "open which way round; sample more often"
        )
    return given


def roll_orientation(
    primitive: OrientationDmp,
    goal: FloatArray,
    s: FloatArray,
    r: FloatArray,
    z: FloatArray,
    k: float = 1.0,
) -> Trajectory:
    """Integrates the primitive.

    Args:
        primitive: the movement primitive.
        goal: (3,) rotation vector of the goal from the origin, see `demonstrated_goal` [rad].
        s: (T,) normalised times of the samples, not falling; the first is that of the state.
        r: (3,) rotation vector at the first of them [rad].
        z: (3,) its derivative by normalised time there [rad].
        k: phase there.

    Returns:
        The rotation vectors r (T, 3) as `p`, their derivatives `z`, and the phases `k`.
    """
    spread = np.column_stack([goal - primitive.offset, np.eye(3)])
    return roll_out(primitive.dmp, spread, goal, s, r, z, k, longest=_STEP)


def orientation_along(
    primitive: OrientationDmp,
    start: ArrayLike,
    goal: ArrayLike,
    s: ArrayLike,
) -> FloatArray:
    """Computes the orientations of a motion at normalised times.

    Args:
        primitive: the movement primitive.
        start: (3, 3) R_WE at the start.
        goal: (3, 3) R_WE at the goal; the direction of turning is the demonstration's.
        s: (T,) normalised times, at least 0 and not falling.

    Returns:
        (T, 3, 3) R_WE.

    Raises:
        ValueError: if the times fall or are not finite and at least 0, or as `goal_vector`.
    """
    times = np.append(0.0, s)
    if not (np.isfinite(times).all() and (np.diff(times) >= 0.0).all()):
        raise ValueError(f"s must be (T,), finite, at least 0 and not falling, not {times[1:]}")
    R_WS = np.asarray(start, dtype=float)
    target = demonstrated_goal(primitive, R_WS, goal)
    r = roll_orientation(primitive, target, times, primitive.offset, np.zeros(3)).p[1:]
    return np.asarray(origin_of(primitive, R_WS) @ Rotation.from_rotvec(r).as_matrix())


def demonstrated_goal(primitive: OrientationDmp, start: ArrayLike, goal: ArrayLike) -> FloatArray:
    """Computes the rotation vector of a goal R_WG (3, 3) from the origin of a motion.

    It turns the way that was demonstrated; without a demonstration, the shortest.

    Raises:
        ValueError: as `goal_vector`.
    """
    near = primitive.offset + primitive.total
    origin = origin_of(primitive, np.asarray(start, dtype=float))
    return goal_vector(origin, goal, near if near.any() else None)


QUATERNION, W, ALPHA = slice(0, 4), slice(4, 7), slice(7, 10)
"""Parts of the result of `evaluate`."""


@compiled
def evaluate(ends: FloatArray, length: float, origin: FloatArray, time: float) -> FloatArray:
    """Evaluates the motion between two steps: quaternion, angular velocity and acceleration.

    r is the cubic between the ends; after its end it goes on at its last rate.

    Args:
        ends: (2, 2, 3) r [rad] and its rate [rad/s] at the begin and at the end.
        length: time between the two [s].
        origin: (4,) unit quaternion of the origin R_WA.
        time: time since the begin, at least 0 [s].

    Returns:
        (10,) quaternion of R_WE, continuous in r over every angle, w_WE [rad/s] and
        alpha_WE [rad/s^2] in W.
    """
    r, dr, ddr = ends[1, 0].copy(), ends[1, 1].copy(), np.zeros(3)
    # Less is rounding, which must not end the acceleration at the end of a step.
    if length > 0.0 and time - length < 1e-9:
        u = min(time / length, 1.0)
        for i in range(3):
            jump = ends[1, 0, i] - ends[0, 0, i]
            v, v_end = length * ends[0, 1, i], length * ends[1, 1, i]
            square, cube = 3.0 * jump - 2.0 * v - v_end, v + v_end - 2.0 * jump
            r[i] = ends[0, 0, i] + u * (v + u * (square + u * cube))
            dr[i] = (v + u * (2.0 * square + 3.0 * u * cube)) / length
            ddr[i] = (2.0 * square + 6.0 * u * cube) / (length * length)
    else:
        r += (time - length) * dr
    square = r[0] ** 2 + r[1] ** 2 + r[2] ** 2
    angle = math.sqrt(square)
    if square > 1e-3:
        a = (1.0 - math.cos(angle)) / square
        b = (angle - math.sin(angle)) / (square * angle)
        # Derivatives of a and b by |r|, over |r|.
        da = (math.sin(angle) / angle - 2.0 * a) / square
        db = (a - 3.0 * b) / square
    else:
        a = 0.5 - square / 24.0 * (1.0 - square / 30.0)
        b = 1.0 / 6.0 - square / 120.0 * (1.0 - square / 42.0)
        da = -1.0 / 12.0 + square / 180.0 * (1.0 - square / 56.0)
        db = -1.0 / 60.0 + square / 1260.0 * (1.0 - square / 72.0)
    radial = r[0] * dr[0] + r[1] * dr[1] + r[2] * dr[2]
    once, across = np.cross(r, dr), np.cross(r, ddr)
    twice = np.cross(r, once)
    rates = np.empty((2, 3))
    rates[0] = dr + a * once + b * twice
    rates[1] = ddr + radial * (da * once + db * twice) + a * across
    rates[1] += b * (np.cross(dr, once) + np.cross(r, across))
    out = np.empty(10)
    real, imaginary = math.cos(0.5 * angle), r * (0.5 * np.sinc(0.5 * angle / np.pi))
    w, axis = origin[0], origin[1:]
    out[0] = w * real
    for i in range(3):
        out[0] -= axis[i] * imaginary[i]
    out[1:4] = w * imaginary + real * axis + np.cross(axis, imaginary)
    for row in range(2):
        # Turned by the quaternion from A to W.
        half = np.cross(axis, rates[row])
        out[4 + 3 * row : 7 + 3 * row] = rates[row] + 2.0 * (w * half + np.cross(axis, half))
    return out
