"""Dynamic movement primitives: the motion that the coupling terms bend.

Time. T is the demonstrated duration in seconds and tau the temporal scaling
relative to it; s = t / (tau T) is normalised time, 1 at the end of the motion. In it

    dz/ds = alpha_x (beta_x (g - x) - z) + f(k) + C      (eq. 1)
    dx/ds = z                                            (eq. 2)
    dk/ds = -alpha_k k,  k(0) = 1                        (eq. 5)

which are the paper's equations with tau T for its tau. So z is in metres, the
velocity is z / (tau T), and nothing here depends on tau.

Space. The forcing term is learnt in the demonstration's local frame L and divided by
its baseline, and is placed along the baseline at hand: f_W = baseline R_WL f(k).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import make_interp_spline

from drake_oa.common.compiled import compiled
from drake_oa.common.messages import FloatArray, Frozen

ALPHA_X = 48.0
"""Default spring constant alpha_x, per normalised time."""
BETA_X = ALPHA_X / 4.0
"""Default spring constant beta_x: critical damping."""
ALPHA_K = math.log(100.0)
"""Default decay of the phase: 1 % is left at the end of the motion."""
N_BASIS = 35
"""Default number of basis functions."""


class Primitive(NamedTuple):
    """A `Dmp` as kernels take it; basis (2 + D, N): centres, widths, and a row of weights each."""

    alpha_x: float
    beta_x: float
    alpha_k: float
    duration: float
    basis: FloatArray


@compiled
def forcing(basis: FloatArray, k: float, force: FloatArray) -> None:
    """Forcing term (eq. 3) at phase k, into force (D,): sum psi_i w_i k / sum psi_i."""
    most, D = 0.0, len(force)
    for attempt in range(2):
        total, least = 0.0, math.inf
        force[:] = 0.0
        for i in range(basis.shape[1]):
            offset = k - basis[0, i]
            exponent = basis[1, i] * offset * offset
            least = min(least, exponent)
            weight = math.exp(most - exponent)
            total += weight
            for row in range(D):
                force[row] += basis[2 + row, i] * weight
        if attempt == 1 or total >= 1e-200:
            break
        # Far from every centre: the quotient exists, its parts underflow.
        most = least
    for row in range(D):
        force[row] *= k / total


@compiled
def spring_flow(alpha_x: float, beta_x: float, step: float) -> tuple[float, float, float, float]:
    """Exact flow of the spring dz/ds = -alpha_x (beta_x e + z), de/ds = z over a step.

    Args:
        alpha_x: spring constant.
        beta_x: spring constant; any damping.
        step: length of the step, at least 0.

    Returns:
        a, b, c, d with e <- a e + b z and z <- c e + d z.
    """
    stiffness, half = alpha_x * beta_x, 0.5 * alpha_x
    square = half * half - stiffness
    if abs(square) <= 1e-14 * half * half:
        cosine = math.exp(-half * step)
        sine = cosine * step
    elif square < 0.0:
        omega = math.sqrt(-square)
        decay = math.exp(-half * step)
        cosine = decay * math.cos(omega * step)
        sine = decay * math.sin(omega * step) / omega
    else:
        omega = math.sqrt(square)
        # half - omega without cancellation.
        slow = math.exp(-step * stiffness / (half + omega))
        fast = math.exp(-step * (half + omega))
        cosine = 0.5 * (slow + fast)
        sine = 0.5 * (slow - fast) / omega
    return cosine + half * sine, sine, -stiffness * sine, cosine - half * sine


@dataclass(frozen=True, eq=False)
class Dmp(Frozen):
    """A movement primitive of D dimensions, for a baseline of length 1.

    Attributes:
        alpha_x: spring constant, per normalised time.
        beta_x: spring constant; alpha_x / 4 for critical damping.
        alpha_k: decay of the phase, per normalised time.
        centers: (N,) centres c_i of the basis functions over the phase.
        widths: (N,) widths h_i, above 0.
        weights: (D, N) weights in the local frame, divided by the baseline.
        duration: T, how long the demonstration took [s].

    Raises:
        ValueError: for wrong shapes, values that are not finite, or constants that
            are not positive.
    """

    alpha_x: float
    beta_x: float
    alpha_k: float
    centers: FloatArray
    widths: FloatArray
    weights: FloatArray
    duration: float = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("alpha_x", "beta_x", "alpha_k", "duration"):
            _check_positive(name, getattr(self, name))
        N = self.centers.size
        if self.centers.shape != (N,) or self.widths.shape != (N,) or N == 0:
            raise ValueError(
                f"centers and widths must be (N,) with N >= 1, not {self.centers.shape} "
                f"and {self.widths.shape}"
            )
        if self.weights.ndim != 2 or self.weights.shape[1] != N:
            raise ValueError(f"weights must be (D, {N}), not {self.weights.shape}")
        if not (np.isfinite(self.centers).all() and np.isfinite(self.weights).all()):
            raise ValueError("centers and weights must be finite")
        if not (np.isfinite(self.widths).all() and self.widths.min() > 0.0):
            raise ValueError("widths must be finite and positive")

    @cached_property
    def kernel(self) -> Primitive:
        """As the kernels take it."""
        basis = np.vstack([self.centers, self.widths, self.weights])
        alpha_x, beta_x, alpha_k = map(float, (self.alpha_x, self.beta_x, self.alpha_k))
        return Primitive(alpha_x, beta_x, alpha_k, float(self.duration), basis)

    @property
    def dimension(self) -> int:
        """D, the number of dimensions."""
        return len(self.weights)

    def phase(self, s: ArrayLike) -> FloatArray:
        """Phase k at normalised time s, (eq. 5): exp(-alpha_k s)."""
        return np.asarray(np.exp(-self.alpha_k * np.asarray(s, dtype=float)))

    def forcing(self, k: float) -> FloatArray:
        """Forcing term f(k), (eq. 3), in the local frame, (D,).

        Args:
            k: phase, in [0, 1].

        Returns:
            (D,) force for a baseline of 1 m [m].
        """
        force = np.empty(self.dimension)
        forcing(self.kernel.basis, k, force)
        return force


def normalised_time(k: float, alpha_k: float) -> float:
    """Normalised time s at phase k: the inverse of `Dmp.phase`."""
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
    x, y, z = _direction(p_WS, p_WG, 3)
    flat = math.hypot(x, y)
    if flat > 1e-12:
        yx, yy = -y / flat, x / flat
    else:
        yx, yy = 0.0, 1.0
    return np.array(
        (
            (x, yx, -z * yy),
            (y, yy, z * yx),
            (z, 0.0, x * yy - y * yx),
        )
    )


def baseline_frame(start: ArrayLike, goal: ArrayLike) -> FloatArray:
    """Rotation of the local frame of a motion in D dimensions.

    In three dimensions this is `local_frame`. In others it is the rotation that takes
    the first axis to the baseline and leaves alone all that is orthogonal to both (in
    the plane of the first two axes where they are opposite); in one dimension, the sign.

    Args:
        start: (D,).
        goal: (D,).

    Returns:
        (D, D); its first column is the unit vector from start to goal.

    Raises:
        ValueError: if start and goal coincide or are not finite.
    """
    D = np.size(start)
    if D == 3:
        return local_frame(start, goal)
    u = np.array(_direction(start, goal, D))
    if D == 1:
        return u[:, None]
    first = np.eye(D)[0]
    if u[0] < -1.0 + 1e-12:
        return np.diag([-1.0, -1.0, *np.ones(D - 2)])
    both = first + u
    return np.asarray(np.eye(D) - np.outer(both, both) / (1.0 + u[0]) + 2.0 * np.outer(u, first))


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

    Raises:
        ValueError: for shapes that differ, a duration that is not positive, or fewer
            than two samples.
    """
    start, goal = np.atleast_1d(start).astype(float), np.atleast_1d(goal).astype(float)
    if start.ndim != 1 or start.shape != goal.shape:
        raise ValueError(f"start and goal must both be (D,), not {start.shape} and {goal.shape}")
    _check_positive("duration", duration)
    if samples < 2:
        raise ValueError(f"samples must be at least 2, not {samples}")
    s = np.linspace(0.0, 1.0, samples)
    return start + minimum_jerk_share(s)[:, None] * (goal - start), duration * s


def minimum_jerk_share(s: FloatArray) -> FloatArray:
    """Share of its way that a minimum-jerk motion has gone at normalised times in [0, 1]."""
    return np.asarray(s**3 * (10.0 + s * (6.0 * s - 15.0)))


def imitate(
    path: ArrayLike,
    t: ArrayLike | None = None,
    *,
    n_basis: int = N_BASIS,
    alpha_x: float = ALPHA_X,
    beta_x: float = BETA_X,
    alpha_k: float = ALPHA_K,
    still: float = 0.0,
) -> Dmp:
    """Learns a movement primitive from one demonstrated path.

    The forcing term that makes (eq. 1) follow the demonstration is sampled on a
    quintic (or for few samples lower) interpolating spline and fitted by linear least
    squares over all basis functions at once.

    Args:
        path: (T, D) positions; T at least 2.
        t: (T,) stamps [s], increasing, at any spacing; None: evenly over one second.
        n_basis: number of basis functions, evenly spaced in time.
        alpha_x: spring constant, per normalised time.
        beta_x: spring constant, per normalised time.
        alpha_k: decay of the phase, per normalised time.
        still: normalised time after the end for which no force is to be left: where it ends at
            rest, it stays there the better.

    Returns:
        The primitive; its duration is that of the demonstration.

    Raises:
        ValueError: for fewer than two samples, values that are not finite, stamps that
            do not increase, a path that ends where it starts, or constants that are
            not positive.
    """
    path, t = checked_demonstration(path, t)
    if n_basis < 2:
        raise ValueError(f"n_basis must be at least 2, not {n_basis}")
    for name, value in (("alpha_x", alpha_x), ("beta_x", beta_x), ("alpha_k", alpha_k)):
        _check_positive(name, value)
    if not 0.0 <= still <= 1.0:
        raise ValueError(f"still must be in [0, 1], not {still}")
    duration = float(t[-1] - t[0])
    baseline = float(np.linalg.norm(path[-1] - path[0]))
    extent = float(np.ptp(path, axis=0).max())
    if not baseline > 1e-6 * extent:
        raise ValueError(
            f"the path must end away from where it starts: its baseline is {baseline} m, "
            f"its extent {extent} m"
        )
    local = (path - path[-1]) @ baseline_frame(path[0], path[-1]) / baseline

    degree = min(5, len(path) - 1) if len(path) != 5 else 3
    spline = make_interp_spline((t - t[0]) / duration, local, k=degree)
    s = _fitted_at(n_basis, still)
    x, z, dz = (spline(s[s <= 1.0], derivative) for derivative in (0, 1, 2))
    target = np.zeros((len(s), path.shape[1]))
    target[s <= 1.0] = dz + alpha_x * (z + beta_x * x)

    centers, widths, inverse = _fit(n_basis, float(alpha_k), float(still))
    weights = (inverse @ target).T
    return Dmp(
        alpha_x=float(alpha_x),
        beta_x=float(beta_x),
        alpha_k=float(alpha_k),
        centers=centers,
        widths=widths,
        weights=np.ascontiguousarray(weights),
        duration=duration,
    )


def _fitted_at(n_basis: int, still: float) -> FloatArray:
    """Normalised times at which a forcing term is fitted, to 1 + still."""
    s = np.linspace(0.0, 1.0, max(501, 10 * n_basis))
    return np.append(s, 1.0 + s[1 : 1 + round(still * (len(s) - 1))])


@lru_cache(maxsize=16)
def _fit(n_basis: int, alpha_k: float, still: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres and widths of the basis functions, and (n_basis, samples) what fits their weights.

    The least squares of a plan take 15 ms anew, and the same matrix each time.
    """
    # One centre before the start: without it the fit is poorest there, where an error
    # decides the first heading.
    gap = 1.0 / max(n_basis - 2, 1)
    centers = np.exp(-alpha_k * np.linspace(-gap, 1.0, n_basis))
    gaps = -np.diff(centers)
    widths = 0.7 / np.append(gaps, gaps[-1]) ** 2
    k = np.exp(-alpha_k * _fitted_at(n_basis, still))[:, None]
    basis = np.exp(-widths * (k - centers) ** 2)
    basis *= k / basis.sum(axis=1, keepdims=True)
    inverse = np.linalg.pinv(basis, rcond=float(np.finfo(float).eps) * len(basis))
    for array in (centers, widths, inverse):
        array.setflags(write=False)
    return centers, widths, inverse


def checked_demonstration(path: ArrayLike, t: ArrayLike | None) -> tuple[FloatArray, FloatArray]:
    """(T, D) positions and (T,) stamps that can be imitated; raises as `imitate`."""
    path = np.asarray(path, dtype=float)
    if path.ndim != 2 or path.shape[1] == 0:
        raise ValueError(f"path must be (T, D) with D >= 1, not {path.shape}")
    if len(path) < 2:
        raise ValueError(f"path must have at least 2 samples, not {len(path)}")
    t = np.linspace(0.0, 1.0, len(path)) if t is None else np.asarray(t, dtype=float)
    if t.shape != (len(path),):
        raise ValueError(f"t must be one stamp a sample, ({len(path)},), not {t.shape}")
    for name, values in (("path", path), ("t", t)):
        finite = np.isfinite(values).reshape(len(path), -1).all(axis=1)
        if not finite.all():
            raise ValueError(f"{name} must be finite: sample {int(np.argmin(finite))} is not")
    rising = np.diff(t) > 0.0
    if not rising.all():
        row = int(np.argmin(rising))
        raise ValueError(
            f"stamps must increase: sample {row + 1} at {t[row + 1]} s follows {t[row]} s"
        )
    return path, t


class Trajectory(NamedTuple):
    """A motion sampled in normalised time.

    Attributes:
        s: (n + 1,) normalised time.
        p: (n + 1, D) position [m].
        z: (n + 1, D) scaled velocity dp/ds [m].
        k: (n + 1,) phase.
    """

    s: FloatArray
    p: FloatArray
    z: FloatArray
    k: FloatArray


@compiled
def _roll(
    primitive: Primitive,
    spread: FloatArray,
    goal: FloatArray,
    s: FloatArray,
    longest: float,
    p: FloatArray,
    z: FloatArray,
    k: FloatArray,
) -> None:
    """Fills p, z (T, D) and k (T,) from their first rows on, see `roll_out`."""
    force = np.empty(spread.shape[1])
    stiffness = primitive.alpha_x * primitive.beta_x
    for row in range(1, len(s)):
        p[row], z[row], k[row] = p[row - 1], z[row - 1], k[row - 1]
        span = s[row] - s[row - 1]
        count = max(math.ceil(span / longest - 1e-9), 1)
        a, b, c, d = spring_flow(primitive.alpha_x, primitive.beta_x, span / count)
        decay = math.exp(-0.5 * primitive.alpha_k * span / count)
        for _ in range(count):
            forcing(primitive.basis, k[row] * decay, force)
            for i in range(len(goal)):
                rest = 0.0
                for j in range(len(force)):
                    rest += spread[i, j] * force[j]
                rest = goal[i] + rest / stiffness
                offset, rate = p[row, i] - rest, z[row, i]
                p[row, i] = rest + a * offset + b * rate
                z[row, i] = c * offset + d * rate
            k[row] *= decay * decay


def roll_out(
    dmp: Dmp,
    spread: FloatArray,
    goal: FloatArray,
    s: FloatArray,
    p: FloatArray,
    z: FloatArray,
    k: float = 1.0,
    *,
    longest: float = math.inf,
) -> Trajectory:
    """Integrates a movement primitive without coupling terms.

    A step is exact but for the forcing term, which is held at its value in the middle.

    Args:
        dmp: the movement primitive, of F dimensions.
        spread: (D, F) factors on its forcing term: f = spread f_L(k).
        goal: (D,) goal.
        s: (T,) normalised times of the samples, not falling; the first is that of the state.
        p: (D,) position at the first of them.
        z: (D,) its derivative by normalised time.
        k: phase there.
        longest: longest step in normalised time; the time between two samples is divided evenly.

    Returns:
        The motion at the T times.
    """
    path, rate, phase = np.empty((len(s), len(p))), np.empty((len(s), len(p))), np.empty(len(s))
    path[0], rate[0], phase[0] = p, z, k
    inputs = (np.array(array, dtype=float, order="C") for array in (spread, goal, s))
    _roll(dmp.kernel, *inputs, longest, path, rate, phase)
    return Trajectory(s, path, rate, phase)


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
        dmp: the movement primitive, of D dimensions.
        start: (D,) start [m].
        goal: (D,) goal [m].
        steps: number of steps, at least 1.
        end: normalised time at the end.

    Returns:
        The motion at steps + 1 instants.

    Raises:
        ValueError: if start and goal coincide, or do not fit the primitive.
    """
    p, g = np.array(start, dtype=float), np.array(goal, dtype=float)
    if p.shape != (dmp.dimension,) or g.shape != p.shape:
        raise ValueError(f"start and goal must be ({dmp.dimension},), not {p.shape} and {g.shape}")
    if steps < 1:
        raise ValueError(f"steps must be at least 1, not {steps}")
    _check_positive("end", end)
    spread = float(np.linalg.norm(g - p)) * baseline_frame(p, g)
    return roll_out(dmp, spread, g, np.linspace(0.0, end, steps + 1), p, np.zeros(len(p)))


def _direction(start: ArrayLike, goal: ArrayLike, D: int) -> list[float]:
    a, b = np.asarray(start, dtype=float), np.asarray(goal, dtype=float)
    if a.shape != (D,) or b.shape != (D,):
        raise ValueError(f"start and goal must be ({D},), not {a.shape} and {b.shape}")
    way = (b - a).tolist()
    length = math.hypot(*way)
    if not 0.0 < length < math.inf:
        raise ValueError(
            f"start and goal must be finite and apart, not {a.tolist()} and {b.tolist()}"
        )
    return [component / length for component in way]


def _check_positive(name: str, value: float) -> None:
    if not 0.0 < value < math.inf:
        raise ValueError(f"{name} must be positive and finite, not {value}")
