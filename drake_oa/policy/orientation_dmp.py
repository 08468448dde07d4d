"""A movement primitive for the orientation of the tool, on the phase of the position's.

The orientation is R_WE = R_WS exp([r]), with r the rotation vector from the start S in S, and
r obeys the linear system of `drake_oa.policy.dmp`, in normalised time s and with the same phase k,

    dz/ds = alpha_x (beta_x (g - r) - z) + f_0(k) g + f(k),    dr/ds = z,

with g the rotation vector of the goal. f_0 is learnt from the least-jerk share m(s) that rises
from 0 to 1, and f from what the demonstration has besides: r(s) - m(s) r(1). So a motion to
another goal is m(s) g + (r(s) - m(s) r(1)), also where start and goal have the same
orientation. A step is exact, as the position's is, and the exponential map has no
singularity: only learning from orientations, and naming a goal, take logarithms. Along r(t),

    w_S = r' + a r x r' + b r x (r x r'),   a = (1 - cos |r|) / |r|^2,
                                            b = (|r| - sin |r|) / |r|^3,

the left Jacobian of the exponential map applied to r', is the angular velocity in S.

Departure from Ude et al. (ICRA 2014), who let a spring act on 2 log(g q*): there the system
is not linear, so that it has no closed-form step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, Frozen
from drake_oa.geometry.rotation import rotation_of, rotation_vector
from drake_oa.policy.dmp import (
    ALPHA_K,
    ALPHA_X,
    BETA_X,
    N_BASIS,
    Dmp,
    imitate,
    minimum_jerk,
    minimum_jerk_share,
    spring_flow,
)

LARGEST_ANGLE = math.radians(300.0)
"""Furthest that a demonstration may turn from its start: rotation vectors end at 360 degrees."""
_HALF_TURN = math.pi - 1e-6
"""Rotations of more than this have no way round of their own [rad]."""
_NEARLY_OPPOSITE = -0.99
"""Trace of the rotation between two samples below which it is looked at: -1 at half a turn."""
_STEP = 1.0 / 500.0
"""Step of `orientation_along`, in normalised time."""


@dataclass(frozen=True, eq=False)
class OrientationDmp(Frozen):
    """A movement primitive of the orientation.

    Attributes:
        dmp: of four dimensions: the share f_0 of the goal's rotation vector, and f [rad].
        total: (3,) rotation vector from the demonstration's start to its end, continued
            from sample to sample; zero where nothing was demonstrated [rad].
        first: (3, 3) orientation that the demonstration starts with.
        last: (3, 3) orientation that it ends with.
        offset: (3,) rotation vector of the start from where they are counted; zero but for a
            demonstration that turns farther than `LARGEST_ANGLE` from its start, which is counted
            from its middle: then r is what comes to it, and all above holds for r [rad].

    Raises:
        ValueError: if the primitive does not have four dimensions.
    """

    dmp: Dmp
    total: FloatArray = field(default_factory=lambda: np.zeros(3))
    first: FloatArray = field(default_factory=lambda: np.eye(3))
    last: FloatArray = field(default_factory=lambda: np.eye(3))
    offset: FloatArray = field(default_factory=lambda: np.zeros(3))
    constants: FloatArray = field(init=False, repr=False, default_factory=lambda: np.zeros(3))
    basis: FloatArray = field(init=False, repr=False, default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        dmp = self.dmp
        if dmp.dimension != 4:
            raise ValueError(f"dmp must have 4 dimensions, not {dmp.dimension}")
        # As the kernels take them; they must stay writeable for those.
        super().__post_init__()
        constants = np.array([dmp.alpha_x, dmp.beta_x, dmp.alpha_k])
        object.__setattr__(self, "constants", constants)
        object.__setattr__(self, "basis", np.vstack([dmp.centers, dmp.widths, dmp.weights]))


def rotation_matrix(orientation: ArrayLike) -> FloatArray:
    """Rotation matrix (3, 3) of a quaternion (4,), w first, of either sign and any length.

    Raises:
        ValueError: for another shape, or a quaternion that is zero or not finite.
    """
    quaternion = np.array(orientation, dtype=float)
    if quaternion.shape != (4,):
        raise ValueError(f"a quaternion must be (4,), w first, not {quaternion.shape}")
    if not (np.isfinite(quaternion).all() and quaternion.any()):
        raise ValueError(f"a quaternion must be finite and not zero, not {quaternion.tolist()}")
    return np.asarray(rotation_of(quaternion))


def goal_vector(start: ArrayLike, goal: ArrayLike, near: ArrayLike | None = None) -> FloatArray:
    """Rotation vector from one orientation to another, in the frame of the first.

    Args:
        start: (3, 3) R_WS.
        goal: (3, 3) R_WG.
        near: (3,) which of the vectors that lead there is taken: the nearest to this one
            [rad]. None: the shortest.

    Returns:
        (3,) [rad].

    Raises:
        ValueError: if they are half a turn apart and `near` does not tell the way round.
    """
    R = np.ascontiguousarray(np.asarray(start, dtype=float).T @ np.asarray(goal, dtype=float))
    r = rotation_vector(R)
    angle = float(np.linalg.norm(r))
    if near is None:
        if angle > _HALF_TURN:
            raise ValueError(
                "start and goal orientation are half a turn apart, which leaves open which way "
                "round: demonstrate it, or give a goal that is nearer"
            )
        return r
    return _nearest(r, np.asarray(near, dtype=float))


def _nearest(r: FloatArray, near: FloatArray) -> FloatArray:
    """The rotation vector of the same rotation as r that is nearest to another one."""
    angle = float(np.linalg.norm(r))
    length = float(np.linalg.norm(near))
    # No rotation has no axis: any will do.
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
    if angles.max() > LARGEST_ANGLE:
        row = int(np.argmax(angles > LARGEST_ANGLE))
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
    """(T, 3) rotation vectors of orientations (T, 3, 3) from one of them, from sample to sample."""
    r = np.zeros((len(R), 3))
    for rows in (range(origin + 1, len(R)), range(origin - 1, -1, -1)):
        before = np.zeros(3)
        for row in rows:
            vector = rotation_vector(np.ascontiguousarray(R[origin].T @ R[row]))
            before = r[row] = _nearest(vector, before)
    return r


def origin_of(primitive: OrientationDmp, start: FloatArray) -> FloatArray:
    """(3, 3) orientation from which a motion from a start (3, 3) is counted."""
    return np.asarray(start @ rotation_of(exponential(primitive.offset)).T)


def minimum_jerk_orientation(
    *,
    n_basis: int = N_BASIS,
    alpha_x: float = ALPHA_X,
    beta_x: float = BETA_X,
    alpha_k: float = ALPHA_K,
) -> OrientationDmp:
    """The primitive of a turn about a fixed axis with least jerk: the default.

    Raises:
        ValueError: for constants that are not positive.
    """
    share, t = minimum_jerk([0.0], [1.0])
    path = np.column_stack([share, np.zeros((len(share), 3))])
    return OrientationDmp(
        imitate(path, t, n_basis=n_basis, alpha_x=alpha_x, beta_x=beta_x, alpha_k=alpha_k)
    )


def checked_rotations(orientations: ArrayLike) -> FloatArray:
    """(T, 3, 3) rotation matrices that can be imitated; raises as `imitate_orientation`."""
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
        there = given.any(axis=1)
        if not there.all():
            raise ValueError(f"orientations: the quaternion of sample {int(np.argmin(there))} is 0")
        given = np.array([rotation_of(row) for row in np.ascontiguousarray(given)])
    else:
        error = np.abs(given @ given.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        good = (error < 1e-6) & (np.linalg.det(given) > 0.0)
        if not good.all():
            raise ValueError(f"orientations: sample {int(np.argmin(good))} is no rotation matrix")
    for row in np.flatnonzero(np.einsum("tij,tij->t", given[1:], given[:-1]) < _NEARLY_OPPOSITE):
        turn = np.ascontiguousarray(given[row].T @ given[row + 1])
        if np.linalg.norm(rotation_vector(turn)) > _HALF_TURN:
            raise ValueError(
                f"orientations: samples {row} and {row + 1} are half a turn apart, which leaves "
                "open which way round; sample more often"
            )
    return given


def step(
    primitive: OrientationDmp,
    r: FloatArray,
    z: FloatArray,
    k: float,
    ds: float,
    goal: FloatArray,
) -> tuple[FloatArray, FloatArray, float]:
    """One step over ds = dt / (tau T), exact but for the forcing, held at its middle value.

    Args:
        primitive: the movement primitive.
        r: (3,) rotation vector from the start's orientation, in its frame [rad].
        z: (3,) its derivative by normalised time [rad].
        k: phase.
        ds: step of normalised time, at least 0.
        goal: (3,) rotation vector of the goal, see `goal_vector` [rad].

    Returns:
        r, z and k at the end of the step.

    Raises:
        ValueError: for a step that is negative or not finite.
    """
    if not 0.0 <= ds < math.inf:
        raise ValueError(f"ds must be finite and at least 0, not {ds}")
    state = np.concatenate([r, z, [k]])
    if ds > 0.0:
        target = np.array(goal, dtype=float)
        take_step(state, target, primitive.constants, primitive.basis, float(ds))
    return state[:3], state[3:6], float(state[6])


def orientation_along(
    primitive: OrientationDmp,
    start: ArrayLike,
    goal: ArrayLike,
    s: ArrayLike,
) -> FloatArray:
    """Orientations that the motion has at normalised times.

    Args:
        primitive: the movement primitive.
        start: (3, 3) R_WE at the start.
        goal: (3, 3) R_WE at the goal; the way round is the demonstration's.
        s: (T,) normalised times, at least 0 and not falling.

    Returns:
        (T, 3, 3) R_WE.

    Raises:
        ValueError: if the times fall or are not finite and at least 0, or as `goal_vector`.
    """
    times = np.atleast_1d(np.array(s, dtype=float))
    if times.ndim != 1 or not (
        np.isfinite(times).all() and (np.diff(times, prepend=0.0) >= 0.0).all()
    ):
        raise ValueError(f"s must be (T,), finite, at least 0 and not falling, not {times}")
    R_WS = np.asarray(start, dtype=float)
    target = demonstrated_goal(primitive, R_WS, goal)
    r = roll(target, primitive.constants, primitive.basis, times, _STEP)[:, :3]
    origin = origin_of(primitive, R_WS)
    return np.array([origin @ rotation_of(exponential(row + primitive.offset)) for row in r])


def demonstrated_goal(primitive: OrientationDmp, start: ArrayLike, goal: ArrayLike) -> FloatArray:
    """The target of r, the way round that was demonstrated; the shortest where nothing was."""
    if not primitive.total.any():
        return goal_vector(start, goal)
    offset = primitive.offset
    origin = origin_of(primitive, np.asarray(start, dtype=float))
    return np.asarray(goal_vector(origin, goal, primitive.total + offset) - offset)


# A motion between two steps of the policy: when it begins and how long it is, r and its rate
# at both ends.
BEGIN, LENGTH, R, RATE, R_END, RATE_END = 0, 1, 2, 5, 8, 11


OFFSET = 14
"""Where r is counted from, see `OrientationDmp.offset` (3,)."""
N_MOTION = 17


SUB_STEP = 5e-4
"""Forcing is held for this long, in normalised time: what it leaves of a saw-tooth in the
acceleration falls with its square."""


# What is evaluated of it at one instant.
QUATERNION, W, ALPHA = 0, 4, 7


N_EVALUATED = 10


@compiled
def forcing(basis: FloatArray, k: float) -> tuple[float, float, float, float]:
    """The four forcing terms at phase k, see `drake_oa.policy.dmp.Dmp.forcing`.

    Args:
        basis: (6, N) centres, widths and four rows of weights.
        k: phase.
    """
    most = 0.0
    for attempt in range(2):
        w = x = y = z = total = 0.0
        least = math.inf
        for i in range(basis.shape[1]):
            offset = k - basis[0, i]
            exponent = basis[1, i] * offset * offset
            least = min(least, exponent)
            weight = math.exp(most - exponent)
            total += weight
            w += basis[2, i] * weight
            x += basis[3, i] * weight
            y += basis[4, i] * weight
            z += basis[5, i] * weight
        if attempt == 1 or total >= 1e-200:
            break
        # Far from every centre: the quotient exists, its parts underflow.
        most = least
    share = k / total
    return w * share, x * share, y * share, z * share


@compiled
def take_step(
    state: FloatArray, goal: FloatArray, constants: FloatArray, basis: FloatArray, ds: float
) -> None:
    """A step over ds of normalised time, in place, see `drake_oa.policy.orientation_dmp.step`.

    Args:
        state: (7,) r, z = dr/ds and the phase k.
        goal: (3,) rotation vector of the goal.
        constants: (3,) alpha_x, beta_x, alpha_k.
        basis: as in `forcing`.
        ds: at least 0.
    """
    alpha, beta, decay = constants
    count = max(math.ceil(ds / SUB_STEP - 1e-9), 1)
    part = ds / count
    a, b, c, d = spring_flow(alpha, beta, part)
    own = np.empty(3)
    for _ in range(count):
        share, own[0], own[1], own[2] = forcing(basis, state[6] * math.exp(-0.5 * decay * part))
        for i in range(3):
            rest = goal[i] + (share * goal[i] + own[i]) / (alpha * beta)
            e, z = state[i] - rest, state[3 + i]
            state[i] = rest + a * e + b * z
            state[3 + i] = c * e + d * z
        state[6] *= math.exp(-decay * part)


@compiled
def roll(
    goal: FloatArray, constants: FloatArray, basis: FloatArray, s: FloatArray, step: float
) -> FloatArray:
    """(T, 6) r and dr/ds at normalised times s (T,), rising, from rest at s = 0.

    The steps are of the length `step`, but for those that end at an asked time.
    """
    samples = np.empty((len(s), 6))
    state = np.zeros(7)
    state[6] = 1.0
    now = 0.0
    for row in range(len(s)):
        count = math.ceil((s[row] - now) / step - 1e-9)
        for left in range(count, 0, -1):
            ds = min(step, s[row] - now) if left > 1 else s[row] - now
            take_step(state, goal, constants, basis, ds)
            now += ds
        now = max(now, s[row])
        samples[row] = state[:6]
    return samples


@compiled
def exponential(r: FloatArray) -> FloatArray:
    """Quaternion (4,) of a rotation vector (3,), continuous in it over every angle."""
    angle = math.sqrt(r[0] ** 2 + r[1] ** 2 + r[2] ** 2)
    scale = math.sin(0.5 * angle) / angle if angle > 1e-12 else 0.5
    return np.array([math.cos(0.5 * angle), scale * r[0], scale * r[1], scale * r[2]])


@compiled
def product(p: FloatArray, q: FloatArray) -> FloatArray:
    """Product of two quaternions (4,)."""
    return np.array(
        [
            p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
            p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
            p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
            p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
        ]
    )


@compiled
def cross(u: FloatArray, v: FloatArray) -> FloatArray:
    """u x v of (3,)."""
    return np.array(
        [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
    )


@compiled
def angular_motion(r: FloatArray, dr: FloatArray, ddr: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angular velocity and acceleration in S, of a rotation vector and its derivatives (3,)."""
    square = r[0] ** 2 + r[1] ** 2 + r[2] ** 2
    if square > 1e-3:
        angle = math.sqrt(square)
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
    once, twice = cross(r, dr), cross(r, cross(r, dr))
    w = dr + a * once + b * twice
    alpha = (
        ddr
        + da * radial * once
        + a * cross(r, ddr)
        + db * radial * twice
        + b * (cross(dr, once) + cross(r, cross(r, ddr)))
    )
    return w, alpha


@compiled
def evaluate(motion: FloatArray, start: FloatArray, time: float) -> FloatArray:
    """(10,) quaternion, w_WE and alpha_WE at a time of a motion.

    r is the cubic between the ends; after its end it goes on at its last rate.

    Args:
        motion: (17,) as laid out above.
        start: (4,) quaternion of the orientation that r is counted from.
        time: [s].
    """
    length = motion[LENGTH]
    since = min(max(time - motion[BEGIN], 0.0), length)
    beyond = time - motion[BEGIN] - length
    if beyond < 1e-9:
        # Rounding, which must not end the acceleration at the end of a step.
        beyond = 0.0
    r, dr, ddr = np.empty(3), np.empty(3), np.zeros(3)
    for i in range(3):
        r[i], dr[i] = motion[R_END + i], motion[RATE_END + i]
        if beyond > 0.0 or length == 0.0:
            r[i] += beyond * dr[i]
            continue
        u = since / length
        jump = motion[R_END + i] - motion[R + i]
        v, v_end = length * motion[RATE + i], length * motion[RATE_END + i]
        square, cube = 3.0 * jump - 2.0 * v - v_end, v + v_end - 2.0 * jump
        r[i] = motion[R + i] + u * (v + u * (square + u * cube))
        dr[i] = (v + u * (2.0 * square + 3.0 * u * cube)) / length
        ddr[i] = (2.0 * square + 6.0 * u * cube) / (length * length)
    for i in range(3):
        r[i] += motion[OFFSET + i]
    w_S, alpha_S = angular_motion(r, dr, ddr)
    R_WS = rotation_of(start)
    out = np.empty(N_EVALUATED)
    out[QUATERNION : QUATERNION + 4] = product(start, exponential(r))
    out[W:] = 0.0
    for i in range(3):
        for j in range(3):
            out[W + i] += R_WS[i, j] * w_S[j]
            out[ALPHA + i] += R_WS[i, j] * alpha_S[j]
    return out
