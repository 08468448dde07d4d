"""One motion of several recorded ones: locally weighted regression over all their samples.

A hand trembles, samples come unevenly, and no two repetitions are alike. Each recording is put in
its own normalised time s = (t - t_0) / (t_1 - t_0) and, its positions, in its local frame L
divided by its baseline, as `drake_oa.policy.dmp` has it. At each of `POINTS` instants s_j a
polynomial of degree 5 is fitted to the samples x_di of all recordings d,

    min over c of  sum_d sum_i ds_di w((s_di - s_j) / h) |x_di - sum_m c_m (s_di - s_j)^m|^2,

with the tricube w(u) = (1 - |u|^3)^3 (Cleveland 1979; Atkeson, Moore and Schaal 1997), and c_0 is
the mean motion there. ds_di is the time that a sample stands for: each recording counts the same,
however often it was sampled. The forcing term is linear in a motion, so its regression over all
recordings is that of their mean.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import (
    LARGEST_ANGLE,
    N_BASIS,
    checked_demonstration,
    checked_turn,
    interpolant,
    local_frame,
    vectors_from,
)

POINTS = 201
"""Instants at which the mean motion is told."""
SPARSE = 100
"""Fewer samples than this are no recording but points to go through: a spline is put through."""
_MOST = 5000
"""Of a recording of more samples this many are used, evenly."""
STILL = 0.2
"""Of `imitate`, for what was averaged: without it a force is left that leads off by 1 to 2 mm."""
_DEGREE = 5
_HALF_WIDTH = 0.2 * N_BASIS
"""h times the number of basis functions: what is narrower than they are is no motion."""
_FEWEST = 2 * (_DEGREE + 1)
"""So many samples are to be within h at least; else h is larger there."""
_REST = 0.1
"""Normalised time in which the mean motion comes to rest."""
_SHORT = 0.05
"""A baseline of less than this share of the extent says nothing of frame and scale."""
_UNLIKE = math.pi / 2.0
"""Recordings that differ by more than this from their mean turn different ways [rad]."""


def average_paths(
    paths: Sequence[ArrayLike], stamps: Sequence[ArrayLike], *, n_basis: int = N_BASIS
) -> tuple[FloatArray, FloatArray]:
    """The mean of recorded paths, without their tremor.

    Args:
        paths: of each recording (T_d, 3) positions [m]; from a mean start to a mean goal.
        stamps: of each (T_d,) [s], increasing.
        n_basis: number of basis functions that are to imitate it: the more, the more is kept.

    Returns:
        path (POINTS, 3) [m] and t (POINTS,) from 0 to the mean duration [s]; at both ends at rest.

    Raises:
        ValueError: naming recording and sample, as `imitate`; or for a baseline that is less than
            a twentieth of the extent.
    """
    checked = _each(checked_demonstration, paths, stamps)
    local, ends = [], []
    for number, (path, _) in enumerate(checked):
        baseline = float(np.linalg.norm(path[-1] - path[0]))
        extent = float(np.ptp(path, axis=0).max())
        if not baseline > (_SHORT * extent if len(path) >= SPARSE else 1e-6 * extent):
            raise ValueError(
                f"{_recording(number, len(checked))}the path must end away from where it starts, "
                f"which is what it is scaled by: its baseline is {baseline:.3g} m, its extent "
                f"{extent:.3g} m; show it in two parts"
            )
        local.append((path - path[-1]) @ local_frame(path[0], path[-1]) / baseline)
        ends.append(path[[0, -1]])
    x, t = _regressed(local, [t for _, t in checked], n_basis)
    start, goal = np.mean(ends, axis=0)
    if not np.any(start != goal):
        raise ValueError("the demonstrations' mean start is their mean goal: they lead back")
    path = goal + float(np.linalg.norm(goal - start)) * x @ local_frame(start, goal).T
    return path, t


def average_orientations(
    orientations: Sequence[ArrayLike], stamps: Sequence[ArrayLike], *, n_basis: int = N_BASIS
) -> tuple[FloatArray, FloatArray]:
    """The mean of recorded orientations: of their rotation vectors from where each began.

    Args:
        orientations: of each recording (T_d, 4) quaternions R_WE, w first, each of either sign and
            any length, or (T_d, 3, 3) rotation matrices.
        stamps: of each (T_d,) [s], increasing.
        n_basis: as in `average_paths`.

    Returns:
        R_WE (POINTS, 3, 3) and t (POINTS,) [s]; at both ends at rest.

    Raises:
        ValueError: naming recording and sample, as `imitate_orientation`; or where recordings
            differ by more than a quarter turn from their mean.
    """
    checked = _each(checked_turn, orientations, stamps)
    rows = np.zeros(len(checked), dtype=int)
    vectors = [vectors_from(R, 0) for R, _ in checked]
    if max(np.linalg.norm(r, axis=1).max() for r in vectors) > LARGEST_ANGLE:
        # All are counted from their middle, as `imitate_orientation` would.
        rows = np.array([np.searchsorted(t, 0.5 * (t[0] + t[-1])) for _, t in checked])
        vectors = [vectors_from(R, row) for (R, _), row in zip(checked, rows, strict=True)]
    origins = Rotation.from_matrix([R[row] for (R, _), row in zip(checked, rows, strict=True)])
    mean = origins.mean()
    ends = np.array([r[[0, -1]] for r in vectors])
    off = np.linalg.norm(ends - ends.mean(axis=0), axis=2).max(axis=1)
    off = np.maximum(off, (mean.inv() * origins).magnitude())
    if off.max() > _UNLIKE:
        number = int(np.argmax(off > _UNLIKE))
        raise ValueError(
            f"{_recording(number, len(checked))}orientations: it is turned by "
            f"{math.degrees(off[number]):.0f} degrees from the mean of all; average those that "
            "turn the same way"
        )
    r, t = _regressed(vectors, [t for _, t in checked], n_basis)
    return (mean * Rotation.from_rotvec(r)).as_matrix(), t


def _each(
    check: Callable[[ArrayLike, ArrayLike], tuple[FloatArray, FloatArray]],
    values: Sequence[ArrayLike],
    stamps: Sequence[ArrayLike],
) -> list[tuple[FloatArray, FloatArray]]:
    """What a check makes of each recording; its error says of which."""
    if not len(values) or len(values) != len(stamps):
        raise ValueError(f"{len(values)} demonstrations with {len(stamps)} rows of stamps")
    found = []
    for number, (value, t) in enumerate(zip(values, stamps, strict=True)):
        try:
            found.append(check(value, t))
        except ValueError as error:
            raise ValueError(f"{_recording(number, len(values))}{error}") from None
    return found


def _recording(number: int, count: int) -> str:
    return f"demonstration {number + 1} of {count}: " if count > 1 else ""


def _regressed(
    values: Sequence[FloatArray], stamps: Sequence[FloatArray], n_basis: int
) -> tuple[FloatArray, FloatArray]:
    """Computes the regression (POINTS, D) of all values, each of (T_d, D), and its stamps."""
    at = np.linspace(0.0, 1.0, POINTS)
    mean_stamps = at * float(np.mean([t[-1] - t[0] for t in stamps]))
    times, parts, shares = [], [], []
    for x, t in zip(values, stamps, strict=True):
        s = (t - t[0]) / (t[-1] - t[0])
        if len(x) < SPARSE:
            x, s = interpolant(s, x)(at), at
        rows = np.linspace(0, len(x) - 1, min(len(x), _MOST)).astype(int)
        times.append(s[rows])
        parts.append(x[rows])
        # At the edges of a gap no more than of some samples.
        shares.append(np.minimum(np.gradient(times[-1]), 5.0 / len(times[-1])))
    if len(values) == 1 and len(values[0]) < SPARSE:
        return _at_rest(at, parts[0]), mean_stamps
    s, x, share = np.concatenate(times), np.concatenate(parts), np.concatenate(shares)
    order = np.argsort(s, kind="stable")
    s, x, root = s[order], x[order], np.sqrt(share[order])
    mean = np.empty((POINTS, x.shape[1]))
    for row, s_j in enumerate(at):
        away = np.abs(s - s_j)
        near = np.partition(away, _FEWEST - 1)[_FEWEST - 1]
        h = max(min(_HALF_WIDTH / n_basis, 1.0), 1.01 * float(near))
        inside = slice(np.searchsorted(s, s_j - h), np.searchsorted(s, s_j + h, "right"))
        u = (s[inside] - s_j) / h
        weight = root[inside] * np.sqrt((1.0 - np.minimum(np.abs(u), 1.0) ** 3) ** 3)
        powers = np.vander(u, _DEGREE + 1, increasing=True) * weight[:, None]
        mean[row] = np.linalg.lstsq(powers, x[inside] * weight[:, None], rcond=None)[0][0]
    return _at_rest(at, mean), mean_stamps


def _at_rest(s: FloatArray, x: FloatArray) -> FloatArray:
    """A motion that begins and ends at rest, as a primitive does, within `_REST` of either end.

    What a hand's tremor leaves of velocity v and acceleration a there would be learnt as a force
    that goes on after the end. From either end inwards, u = |s - end| / d, what is taken away is
    the polynomial of degree 5 that has v and a at the end, and nothing of x there, and is gone
    with both derivatives at u = 1.
    """
    spline = interpolant(s, x)
    for end, inward in ((0.0, 1.0), (1.0, -1.0)):
        u = np.minimum(np.abs(s - end) / _REST, 1.0)[:, None]
        v, a = inward * _REST * spline(end, 1), _REST**2 * spline(end, 2)
        x = x - v * u * (1.0 - u) ** 3 * (1.0 + 3.0 * u) - 0.5 * a * u**2 * (1.0 - u) ** 3
    return x
