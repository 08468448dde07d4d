"""One motion of several recorded ones: a penalized spline (P-spline) through all their samples.

A hand trembles, samples come unevenly, and no two repetitions are alike. Each recording is put in
its own normalized time s = (t - t_0) / (t_1 - t_0) and, its positions, in its local frame L
divided by its baseline, as `drake_oa.policy.dmp` has it. The mean motion is the quintic spline of
evenly spaced knots whose coefficients c minimize

    mean_d sum_i ds_di |x_di - sum_m c_m B_m(s_di)|^2 + lambda sum_m |third difference of c at m|^2

(P. H. C. Eilers and B. D. Marx, Statistical Science 11(2), 1996), with the first three and the last
three coefficients at the recordings' mean ends: it begins and ends at rest, as a primitive does.
ds_di is the time that a sample stands for: each recording counts the same, however often it was
sampled. The forcing term is linear in a motion, so its regression over all recordings is that of
their mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from drake_oa.common.messages import FloatArray
from drake_oa.policy.dmp import (
    N_BASIS,
    checked_demonstration,
    checked_turn,
    in_local_frame,
    interpolant,
    local_frame,
    vectors_from,
)

POINTS = 201
"""Instants at which the mean motion is told."""
SPARSE = 100
"""Fewer samples than this are no recording but points to go through: a spline is put through."""
_SPANS_PER_BASIS = 0.4
"""Spans of the spline for each basis function: narrower details are no motion."""
_PENALTY = 1e-6
"""Weight lambda of the third differences, which bridges gaps of the recordings."""
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
        ValueError: as `imitate`; or for a baseline that is less than a twentieth of the extent.
    """
    local, ends, times = [], [], []
    for shown, given in zip(paths, stamps, strict=True):
        path, t = checked_demonstration(shown, given)
        local.append(in_local_frame(path, _SHORT if len(path) >= SPARSE else 1e-6))
        ends.append(path[[0, -1]])
        times.append(t)
    x, t = _regressed(local, times, n_basis)
    start, goal = np.mean(ends, axis=0)
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
        ValueError: as `imitate_orientation`; or where recordings
            differ by more than a quarter turn from their mean.
    """
    checked = [checked_turn(*pair) for pair in zip(orientations, stamps, strict=True)]
    rows = [int(np.searchsorted(t, 0.5 * (t[0] + t[-1]))) for _, t in checked]
    vectors = [vectors_from(R, row) for (R, _), row in zip(checked, rows, strict=True)]
    origins = Rotation.from_matrix([R[row] for (R, _), row in zip(checked, rows, strict=True)])
    mean = origins.mean()
    ends = np.array([r[[0, -1]] for r in vectors])
    off = np.linalg.norm(ends - ends.mean(axis=0), axis=2).max(axis=1)
    off = np.maximum(off, (mean.inv() * origins).magnitude())
    if off.max() > _UNLIKE:
        number = int(np.argmax(off > _UNLIKE))
        raise ValueError(
            f"orientations: demonstration {number + 1} of {len(checked)} is turned by "
            f"{math.degrees(off[number]):.0f} degrees from the mean of all; average those that "
            "turn the same way"
        )
    r, t = _regressed(vectors, [t for _, t in checked], n_basis)
    return (mean * Rotation.from_rotvec(r)).as_matrix(), t


def _regressed(
    values: Sequence[FloatArray], stamps: Sequence[FloatArray], n_basis: int
) -> tuple[FloatArray, FloatArray]:
    """Computes the regression (POINTS, D) of all values, each of (T_d, D), and its stamps."""
    at = np.linspace(0.0, 1.0, POINTS)
    times, parts, shares = [], [], []
    for x, t in zip(values, stamps, strict=True):
        s = (t - t[0]) / (t[-1] - t[0])
        if len(x) < SPARSE:
            x, s = interpolant(s, x)(at), at
        times.append(s)
        parts.append(x)
        # At the edges of a gap no more than of some samples.
        shares.append(np.minimum(np.gradient(s), 5.0 / len(s)))
    breaks = np.linspace(0.0, 1.0, max(round(_SPANS_PER_BASIS * n_basis), 1) + 1)
    knots = np.concatenate([np.zeros(5), breaks, np.ones(5)])
    count = len(breaks) + 4
    # At rest at the mean of the recordings' ends: three coefficients are one.
    coefficients = np.zeros((count, values[0].shape[1]))
    coefficients[:3] = np.mean([x[0] for x in values], axis=0)
    coefficients[-3:] = np.mean([x[-1] for x in values], axis=0)
    basis = BSpline.design_matrix(np.concatenate(times), knots, 5).toarray()
    root = np.sqrt(np.concatenate(shares) / len(values))[:, None]
    rows = np.concatenate([root * basis, math.sqrt(_PENALTY) * np.diff(np.eye(count), 3, axis=0)])
    target = -rows @ coefficients
    target[: len(root)] += root * np.concatenate(parts)
    coefficients[3:-3] = np.linalg.lstsq(rows[:, 3:-3], target, rcond=None)[0]
    mean_stamps = at * float(np.mean([t[-1] - t[0] for t in stamps]))
    return BSpline(knots, coefficients, 5)(at), mean_stamps
