"""Mean of several recorded demonstrations, by a penalized spline (P-spline) fitted to all samples.

The spline removes hand tremor and averages repetitions sampled at different, uneven times. Each
recording is expressed over normalized time s = (t - t_0) / (t_1 - t_0), from 0 at its start t_0 to
1 at its end t_1. Positions are expressed in the recording's local frame L (x from start to goal, z
up) and divided by the distance from start to goal, as in `drake_oa.policy.dmp`. The mean motion is
the quintic spline with evenly spaced knots whose coefficients c minimize

    mean_d sum_i ds_di |x_di - sum_m c_m B_m(s_di)|^2 + lambda sum_m |third difference of c at m|^2

(P. H. C. Eilers and B. D. Marx, Statistical Science 11(2), 1996). x_di is sample i of recording d
at s_di, mean_d the mean over the recordings, B_m the quintic B-spline with coefficient c_m, and
lambda the weight of the penalty. The first three coefficients equal the mean first sample of the
recordings, and the last three the mean last sample. The motion thus starts and ends at rest, as a
movement primitive does. ds_di is the sampling interval of sample i: all recordings have equal
weight, whatever their number of samples. The forcing term of a primitive is linear in the motion,
so fitting it to the mean equals fitting it to all recordings.
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
"""Number of samples at which the mean of recorded demonstrations is evaluated."""
SPARSE = 100
"""Number of samples below which a demonstration counts as a list of waypoints.

Before the mean spline is fitted, a spline through the waypoints is sampled at `POINTS` times, so
that there are samples between the waypoints. Longer recordings enter the fit as they are."""
_SPANS_PER_BASIS = 0.4
"""Number of polynomial pieces of the mean spline per basis function of the movement primitive [-].

More pieces would fit hand tremor."""
_PENALTY = 1e-6
"""Weight lambda of the penalty on third differences of the mean spline's coefficients [-].

The mean spline averages recorded demonstrations. The penalty determines its shape in gaps between
their samples."""
_SHORT = 0.05
"""Minimum distance from start to end of a recorded path, divided by the extent of the path [-].

The extent is the largest edge of the path's bounding box along the world's axes. Paths of at least
`SPARSE` samples with a smaller ratio are refused, because a movement primitive is scaled by the
distance from start to end."""
_UNLIKE = math.pi / 2.0
"""Maximum difference between the rotations of a recording and the mean of all recordings [rad].

Three quantities are compared: the orientation in the middle of the duration, and the rotation
vectors from this orientation to the first and to the last one. Recordings with a larger difference
are refused, because they probably rotate in another direction."""


def average_paths(
    paths: Sequence[ArrayLike], stamps: Sequence[ArrayLike], *, n_basis: int = N_BASIS
) -> tuple[FloatArray, FloatArray]:
    """Computes the mean of recorded paths without tremor, from their mean start to their mean goal.

    Args:
        paths: for each recording d, positions (T_d, 3) in the world frame [m].
        stamps: for each recording, times (T_d,) [s], increasing.
        n_basis: number of basis functions of the movement primitive that will be fitted to the
            mean; more preserve finer details of the recordings.

    Returns:
        Path (POINTS, 3) in the world frame [m], at rest at both ends, and times (POINTS,) from 0 to
        the mean duration [s]; POINTS is 201.

    Raises:
        ValueError: for fewer than two samples, values that are not finite, times that do not
            increase, a path that ends where it starts, or a path of at least 100 samples whose
            distance from start to end is at most a twentieth of its extent.
    """
    local, ends, times = [], [], []
    for positions, t_d in zip(paths, stamps, strict=True):
        path, t = checked_demonstration(positions, t_d)
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
    """Computes the mean of recorded tool orientations without tremor.

    Each recording is expressed by rotation vectors from the orientation in the middle of its
    duration, and these vectors are averaged.

    Args:
        orientations: for each recording d, quaternions (T_d, 4) of R_WE, w first, of either sign
            and any nonzero length, or rotation matrices (T_d, 3, 3).
        stamps: for each recording, times (T_d,) [s], increasing.
        n_basis: number of basis functions of the movement primitive that will be fitted to the
            mean; more preserve finer details of the recordings.

    Returns:
        Orientations R_WE (POINTS, 3, 3), at rest at both ends, and times (POINTS,) from 0 to the
        mean duration [s]; POINTS is 201.

    Raises:
        ValueError: for fewer than two samples, a sample that is no rotation, 180 degrees between
            two consecutive samples, or times that do not increase; or if a recording differs from
            the mean by more than 90 degrees at its start, middle or end.
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
            f"orientations: demonstration {number + 1} of {len(checked)} differs from the mean by "
            f"{math.degrees(off[number]):.0f} degrees, more than 90; average only demonstrations "
            "that rotate in the same direction"
        )
    r, t = _regressed(vectors, [t for _, t in checked], n_basis)
    return (mean * Rotation.from_rotvec(r)).as_matrix(), t


def _regressed(
    values: Sequence[FloatArray], stamps: Sequence[FloatArray], n_basis: int
) -> tuple[FloatArray, FloatArray]:
    """Computes the mean of several recordings as a penalized spline fitted to all their samples.

    The spline starts at rest at the mean first sample of the recordings, and ends at rest at the
    mean last sample.

    Args:
        values: for each recording d, samples (T_d, D) of D quantities: scaled positions [-], or
            rotation vectors [rad].
        stamps: for each recording, times (T_d,) [s], increasing.
        n_basis: number of basis functions of the movement primitive, which determines the knots.

    Returns:
        Samples (POINTS, D) of the spline, and times (POINTS,) from 0 to the mean duration [s];
        POINTS is 201.
    """
    at = np.linspace(0.0, 1.0, POINTS)
    times, parts, shares = [], [], []
    for x, t in zip(values, stamps, strict=True):
        s = (t - t[0]) / (t[-1] - t[0])
        if len(x) < SPARSE:
            x, s = interpolant(s, x)(at), at
        times.append(s)
        parts.append(x)
        # The bound prevents that samples beside a gap of the recording get a large weight.
        shares.append(np.minimum(np.gradient(s), 5.0 / len(s)))
    breaks = np.linspace(0.0, 1.0, max(round(_SPANS_PER_BASIS * n_basis), 1) + 1)
    knots = np.concatenate([np.zeros(5), breaks, np.ones(5)])
    count = len(breaks) + 4
    # With three equal coefficients at each end, the spline is at rest there.
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
