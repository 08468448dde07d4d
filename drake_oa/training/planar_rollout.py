"""Many action-level trajectories in the plane at once, compiled and on all cores.

The kernels do what `drake_oa.policy.dmp.step` does with one `drake_oa.policy.coupling` term, in the
plane of actuation and in normalised units: lengths in baselines L, time in
s = t / (tau T). With z = tau T dx/dt in the coupling term the path does not depend on
tau, so one roll-out stands for every duration::

    dz/ds = alpha_x (beta_x (g - x) - z) + f(k) + R z dtheta       (eq. oa_complete)
    dx/ds = z

One step is half a step of the spring in closed form, an exact rotation of z by the
turn of `drake_oa.policy.coupling` (linearly implicit), and the spring's other half.
`released_rollouts` is the motion of the authors' released code instead.

Rows are computed in float32 (`drake_oa.training.planar_kernels`,
`drake_oa.training.released_kernels`); those that it cannot tell for certain from a contact, or from
a threshold of the caller's, once more in float64.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_oa.common.messages import BoolArray, FloatArray, Frozen
from drake_oa.policy.dmp import Dmp, imitate, minimum_jerk, spring_flow
from drake_oa.training import planar_double, planar_kernels, released_kernels

Precision = Literal["single", "double"]

STEPS = 1000
"""Default number of steps a unit of s; with four times as many a path that converges
keeps 0.4 mm a metre more (median; docs/equations.md)."""

BAND = 2e-4
"""Clearances this near to a contact or threshold are settled in float64."""

FAR_REACHING = 10.0
"""Rows of the released code's motion whose kappa is below this, and that end further
than `STRAY` from the goal, are settled in float64: the explicit push, strong all the way,
amplifies rounding. In some of them the last bit of alpha moves the clearance by 5e-4 m
in float64 as well, and the goal error without bound."""

STRAY = 0.02


@dataclass(frozen=True, eq=False)
class PlanarRollouts(Frozen):
    """What N trajectories came to; lengths in baselines.

    Attributes:
        clearance: (N,) least distance to the ellipse, 0 where it was touched.
        goal_error: (N,) distance to the goal at the end; inf where it was touched.
        path_length: (N,) length of the path; inf where it was touched.
        contact: (N,) whether the ellipse was touched (the trajectory ends there).
    """

    clearance: FloatArray
    goal_error: FloatArray
    path_length: FloatArray
    contact: BoolArray


def default_dmp() -> Dmp:
    """The primitive of a straight minimum-jerk motion over a unit baseline and time."""
    return imitate(*minimum_jerk(0.0, 1.0))


def forcing_table(dmp: Dmp, steps: int = STEPS, end: float = 1.0) -> FloatArray:
    """Forcing term along the baseline at the middle of each step of s in [0, end].

    Args:
        dmp: the primitive.
        steps: number of steps in all.
        end: s after the last step.

    Returns:
        (steps,) forcing for a unit baseline.
    """
    middles = dmp.phase((np.arange(steps) + 0.5) * (end / steps))
    return np.array([dmp.forcing(k)[0] for k in middles.tolist()])


def released_forcing(
    steps: int = STEPS, dt: float = 0.003, *, alpha_x: float = 10.0, beta_x: float = 2.5
) -> FloatArray:
    """Forcing term of a straight demonstration at constant speed, a baseline of 1 m.

    What the released code's 35 basis functions fit, to 2e-4 m/s^2: the demonstration
    ends with the last step.

    Args:
        steps: number of steps, at least 2.
        dt: length of a step [s].
        alpha_x: spring constant.
        beta_x: spring constant.

    Returns:
        (steps,) forcing term at the beginning of each step [m/s^2].

    Raises:
        ValueError: if there are fewer than two steps or dt is not positive.
    """
    if steps < 2 or not 0.0 < dt < math.inf:
        raise ValueError(f"steps must be at least 2 and dt positive, not {steps} and {dt}")
    duration = dt * (steps - 1)
    s = np.arange(steps) / (steps - 1)
    return np.asarray(alpha_x / duration - alpha_x * beta_x * (1.0 - s))


def planar_rollouts(
    extents: ArrayLike,
    parameters: ArrayLike,
    *,
    centers: ArrayLike | None = None,
    dmp: Dmp | None = None,
    steps: int = STEPS,
    end: float = 1.0,
    fade: float = 0.0,
    precision: Precision = "single",
    threshold: ArrayLike | None = None,
) -> PlanarRollouts:
    """Rolls out one trajectory a row, from rest at (0, 0) to (1, 0).

    A heading exactly at the centre turns to the left.

    Args:
        extents: (N, 2) semi-axes of the ellipse along and across the baseline, in L.
        parameters: (N, 3) alpha, psi, kappa L^2.
        centers: (N, 2) centre of the ellipse in L; None: (0.5, 0).
        dmp: the primitive, straight along its first dimension; None: `default_dmp`.
        steps: number of steps a unit of s; where end is no whole number of them, all are
            a little shorter.
        end: s at the end of the motion.
        fade: alpha fades within this many baselines of the goal, by the fourth power of
            the distance left (`drake_oa.policy.action.goal_fade`); 0: it does not.
        precision: "single" computes in float32 and settles in float64 the rows within
            `BAND` of a contact or threshold; "double" computes all in float64.
        threshold: clearance, or (N,) clearances, from which rows must be told for certain.

    Returns:
        Clearance (to 1e-4 of a baseline), goal error at s = end and path length a row.

    Raises:
        ValueError: if shapes disagree, a value is not finite, a semi-axis or psi is
            not positive, alpha, kappa or fade is negative, steps or end is not positive,
            or for an unknown precision.
    """
    extents, parameters = _scenes("extents", extents, parameters)
    if centers is None:
        centers = np.tile((0.5, 0.0), (len(extents), 1))
    centers = _rows("centers", centers, 2)
    if len(extents) != len(centers):
        raise ValueError(
            f"extents and centers have {len(extents)} and {len(centers)} rows; "
            f"they must have as many"
        )
    if steps < 1:
        raise ValueError(f"steps must be at least 1, not {steps}")
    if not 0.0 <= fade < math.inf:
        raise ValueError(f"fade must be finite and not negative, not {fade}")
    if not 0.0 < end < math.inf:
        raise ValueError(f"end must be finite and positive, not {end}")
    dmp = default_dmp() if dmp is None else dmp
    # 0.07 x 100 is a little more than 7 in floating point.
    n_steps = math.ceil(steps * end * (1.0 - 1e-12))
    rest = 1.0 + forcing_table(dmp, n_steps, end) / (dmp.alpha_x * dmp.beta_x)
    flow = np.array(spring_flow(dmp.alpha_x, dmp.beta_x, 0.5 * end / n_steps))
    inverse_fade2 = 1.0 / fade**2 if fade > 0.0 else 1e30
    out = np.empty((3, len(extents)))
    rows: slice | NDArray[np.intp] = slice(None)
    if _is_single(precision):
        single = np.empty(out.shape, np.float32)
        planar_kernels.project_batch(
            *(np.ascontiguousarray(a, np.float32) for a in (extents, parameters, centers, rest)),
            tuple(np.float32(c) for c in (*flow, inverse_fade2, n_steps / end)),
            single,
        )
        out[:] = single
        rows = np.flatnonzero(_uncertain(out, threshold))
    settled = np.empty((3, len(extents[rows])))
    if settled.size:
        planar_double.project_rows(
            extents[rows],
            parameters[rows],
            centers[rows],
            rest,
            flow,
            inverse_fade2,
            n_steps / end,
            settled,
        )
    return _outcome(out, rows, settled)


def released_rollouts(
    semi_axes: ArrayLike,
    parameters: ArrayLike,
    *,
    steps: int = STEPS,
    dt: float = 0.003,
    alpha_x: float = 10.0,
    beta_x: float = 2.5,
    between: bool = False,
    precision: Precision = "single",
    threshold: ArrayLike | None = None,
) -> PlanarRollouts:
    """Rolls out the released code's motion, as in the paper's training set.

    From rest at (0, 0) to (1, 0) around an ellipse at (0.5, 0), as
    `drake_oa.training.released_code.euler_trajectory` goes: tau = sqrt(1 + 4 lambda2'^2) + 0.1
    scales the spring by its square, the forcing term is unscaled, the coupling term is an
    explicit push, the step semi-implicit Euler. A heading exactly at the centre turns
    to the left.

    Args:
        semi_axes: (N, 2) lambda1', lambda2' along and across the baseline [m].
        parameters: (N, 3) alpha [1/s], psi [rad], kappa [1/m^2].
        steps: number of steps, at least 2.
        dt: length of a step [s].
        alpha_x: spring constant.
        beta_x: spring constant.
        between: whether the clearance is also taken between the samples of the path. The
            paper's set has it at the samples: then, and only then, 1,249,134 of its 12.5
            million rows keep 0.01 m, as many as the paper's set.
        precision: see `planar_rollouts`; rows that are `FAR_REACHING` are settled too.
        threshold: see `planar_rollouts`.

    Returns:
        Clearance (to 1e-4 m, but see `FAR_REACHING`), goal error after the last step and
        path length a row [m].

    Raises:
        ValueError: as `planar_rollouts` does.
    """
    semi_axes, parameters = _scenes("semi_axes", semi_axes, parameters)
    drive = released_forcing(steps, dt, alpha_x=alpha_x, beta_x=beta_x)
    constants = (dt, alpha_x * beta_x, alpha_x)
    out = np.empty((3, len(semi_axes)))
    rows: slice | NDArray[np.intp] = slice(None)
    if _is_single(precision):
        single = np.empty(out.shape, np.float32)
        released_kernels.released_batch(
            *(np.ascontiguousarray(a, np.float32) for a in (semi_axes, parameters)),
            *_for_the_kernel(drive, constants, np.float32),
            between,
            single,
        )
        out[:] = single
        far_reaching = parameters[:, 2] < FAR_REACHING
        rows = np.flatnonzero(_uncertain(out, threshold) | (far_reaching & _stray(out)))
        settled = _settled_released(semi_axes[rows], parameters[rows], drive, constants, between)
    else:
        settled = np.empty(out.shape)
        planar_double.released_rows(semi_axes, parameters, drive, *constants, between, settled)
    return _outcome(out, rows, settled)


def released_lattice(
    lambda1: ArrayLike,
    lambda2: ArrayLike,
    alpha: ArrayLike,
    psi: ArrayLike,
    kappa: ArrayLike,
    *,
    rows: tuple[int, int] | None = None,
    steps: int = STEPS,
    dt: float = 0.003,
    between: bool = False,
    threshold: float | None = None,
) -> PlanarRollouts:
    """`released_rollouts` over a lattice, without writing out its rows.

    Args:
        lambda1: (A,) semi-axes along the baseline [m].
        lambda2: (B,) semi-axes across it [m].
        alpha: (C,) [1/s].
        psi: (D,) [rad].
        kappa: (E,) [1/m^2].
        rows: first and last + 1 of the rows wanted; None: all A B C D E.
        steps: number of steps, at least 2.
        dt: length of a step [s].
        between: see `released_rollouts`.
        threshold: clearance from which rows must be told for certain.

    Returns:
        One value a row; rows run over (lambda1, lambda2, alpha, psi, kappa), the last
        fastest.

    Raises:
        ValueError: as `released_rollouts` does, or for rows outside the lattice.
    """
    axes = [np.ascontiguousarray(a, dtype=float) for a in (lambda1, lambda2, alpha, psi, kappa)]
    names = ("lambda1", "lambda2", "alpha", "psi", "kappa")
    for name, axis in zip(names, axes, strict=True):
        low = axis.min() if axis.ndim == 1 and axis.size else math.nan
        positive = name not in ("alpha", "kappa")
        if not (np.isfinite(axis).all() and (low > 0.0 if positive else low >= 0.0)):
            kind = "positive" if positive else "not negative"
            raise ValueError(f"{name} must be a row of finite numbers, {kind}")
    shape = tuple(axis.size for axis in axes)
    first, end = (0, math.prod(shape)) if rows is None else rows
    if not 0 <= first <= end <= math.prod(shape):
        raise ValueError(f"rows must lie in 0 ... {math.prod(shape)}, not {rows}")
    drive = released_forcing(steps, dt)
    out = np.empty((3, end - first), np.float32)
    constants = (dt, 25.0, 10.0)
    released_kernels.released_lattice_batch(
        *(axis.astype(np.float32) for axis in axes),
        first,
        *_for_the_kernel(drive, constants, np.float32),
        between,
        out,
    )
    doubt = _uncertain(out, threshold)
    stray = np.flatnonzero(_stray(out))
    doubt[stray[axes[4][(first + stray) % shape[4]] < FAR_REACHING]] = True
    doubtful = np.flatnonzero(doubt)
    places = np.unravel_index(first + doubtful, shape)
    values = np.stack([axis[place] for axis, place in zip(axes, places, strict=True)], axis=1)
    settled = _settled_released(values[:, :2], values[:, 2:], drive, constants, between)
    return _outcome(out.astype(float), doubtful, settled)


def _settled_released(
    semi_axes: FloatArray,
    parameters: FloatArray,
    drive: FloatArray,
    constants: tuple[float, float, float],
    between: bool,
) -> FloatArray:
    settled = np.empty((3, len(semi_axes)))
    if settled.size:
        released_kernels.released_batch(
            np.ascontiguousarray(semi_axes),
            np.ascontiguousarray(parameters),
            *_for_the_kernel(drive, constants, np.float64),
            between,
            settled,
        )
    return settled


def _for_the_kernel(
    drive: FloatArray,
    constants: tuple[float, float, float],
    dtype: type[np.float32] | type[np.float64],
) -> tuple[int, int, tuple[float, ...], tuple[np.floating, ...], np.floating]:
    """Steps, steps a look, constants in float64 and in dtype, band; the drive is linear."""
    steps = len(drive)
    tile = max(d for d in range(1, released_kernels.LONGEST_TILE + 1) if steps % d == 0)
    growth = (drive[-1] - drive[0]) / (steps - 1)
    double = tuple(float(c) for c in (*constants, drive[0], growth))
    band = dtype(BAND if dtype is np.float32 else 0.0)
    return steps, tile, double, tuple(dtype(c) for c in double), band


def _is_single(precision: str) -> bool:
    if precision not in ("single", "double"):
        raise ValueError(f'precision must be "single" or "double", not {precision!r}')
    return precision == "single"


def _uncertain(out: NDArray[np.floating], threshold: ArrayLike | None) -> BoolArray:
    """Rows whose float32 clearance does not decide; certain contacts are at -BAND."""
    clearance, _, length = out
    doubt = clearance < BAND
    if threshold is not None:
        doubt |= np.abs(clearance - np.asarray(threshold, dtype=out.dtype)) < BAND
    return np.asarray(doubt & np.isfinite(length))


def _stray(out: NDArray[np.floating]) -> BoolArray:
    return np.asarray(np.isfinite(out[2]) & ~(out[1] < STRAY))


def _outcome(
    out: FloatArray, rows: slice | NDArray[np.intp], settled: FloatArray
) -> PlanarRollouts:
    out[:, rows] = settled
    np.maximum(out[0], 0.0, out=out[0])
    return PlanarRollouts(out[0], out[1], out[2], np.isinf(out[1]))


def _scenes(name: str, extents: ArrayLike, parameters: ArrayLike) -> tuple[FloatArray, FloatArray]:
    extents, parameters = _rows(name, extents, 2), _rows("parameters", parameters, 3)
    if len(extents) != len(parameters):
        raise ValueError(
            f"{name} and parameters have {len(extents)} and {len(parameters)} rows; "
            f"they must have as many"
        )
    if not (extents > 0.0).all():
        raise ValueError(f"{name} must be positive")
    if not ((parameters[:, 1] > 0.0).all() and (parameters >= 0.0).all()):
        raise ValueError("parameters: psi must be positive, alpha and kappa not negative")
    return extents, parameters


def _rows(name: str, value: ArrayLike, width: int) -> FloatArray:
    array = np.ascontiguousarray(value, dtype=float)
    if array.ndim != 2 or array.shape[1] != width:
        raise ValueError(f"{name} must have the shape (N, {width}), not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must hold finite numbers")
    return array
