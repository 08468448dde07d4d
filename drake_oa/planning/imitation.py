"""Conversion of a planned joint-space path to a demonstration that movement primitives imitate.

Coupling terms, which steer a motion away from obstacles, can then act along the path. Position
and orientation of the tool become movement primitives (`drake_oa.policy`). The joint positions of
the path become the nominal posture, which the arm tracks in its null space; the phase of the
movement primitives determines the place on the path.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d

from drake_oa.common.messages import FloatArray
from drake_oa.planning.collision_model import ArmCollisionModel, min_clearance_margin
from drake_oa.policy.dmp import (
    ALPHA_K,
    Demonstration,
    imitate,
    imitate_orientation,
    minimum_jerk_profile,
)
from drake_oa.robot.arm import tool_poses

SAMPLES = 201
"""Number of configurations that sample a joint-space path for its conversion to a demonstration."""
MAX_DURATION_RATIO = 2.0
"""Maximum ratio of an imitated joint-space path's duration to the task's demonstrated duration [-].

It is exceeded if the path would otherwise require joint speeds above `SPEED_FRACTION` of their
limits."""
SPEED_FRACTION = 0.5
"""Maximum joint speed of an imitated joint-space path, as a fraction of the speed limits [-]."""
_FILTER_WIDTHS = (0.04, 0.02, 0.01)
"""Standard deviations of Gaussian filters that round the corners of a joint-space path [-].

They are fractions of the path's length. They are tried in this order, until the rounded path has
the required clearances, or a clearance margin (distance minus required clearance) no smaller than
that of the given path."""
_N_BASIS = 100
"""Number of basis functions of the movement primitives that imitate a joint-space path.

35 basis functions reproduce the corners of a path to 15 mm, 100 to 1 mm."""


def demonstration(
    world: ArmCollisionModel,
    corners: FloatArray,
    *,
    seconds_per_meter: float,
    max_duration: float = math.inf,
    alpha_k: float = ALPHA_K,
) -> Demonstration:
    """Converts a polyline in joint space to a demonstration of the tool, with minimum-jerk timing.

    Corners of the polyline are rounded as far as the required clearances permit.

    Args:
        world: collision model of the arm, with the required clearances.
        corners: (C, n) corners of the polyline [rad].
        seconds_per_meter: duration per meter of the tool's path [s/m].
        max_duration: maximum duration, unless the joint speeds require more [s].
        alpha_k: decay rate of the movement primitives' phase, per normalized time (time over
            duration) [-].

    Returns:
        Movement primitives of the tool's position and orientation, and joint positions over
        normalized time.

    Raises:
        ValueError: if the tool turns by more than 300 degrees from its orientation at the middle of
            the path, or if the tool has the same position at the start and at the end.
    """
    q = _smooth(world, _resample(corners))
    s = np.linspace(0.0, 1.0, SAMPLES)
    q = np.asarray(make_interp_spline(s, q, k=3)(minimum_jerk_profile(s)))
    X_WE = tool_poses(world.chain, q)
    length = float(np.linalg.norm(np.diff(X_WE[:, 9:], axis=0), axis=1).sum())
    duration = min(seconds_per_meter * length, max_duration)
    rate = np.abs(np.diff(q, axis=0)) / np.diff(s)[:, None]
    duration = max(duration, float((rate / (SPEED_FRACTION * world.chain.speed)).max()))
    t, R_WE = duration * s, X_WE[:, :9].reshape(-1, 3, 3)
    return Demonstration(
        imitate(X_WE[:, 9:], t, n_basis=_N_BASIS, alpha_k=alpha_k),
        imitate_orientation(R_WE, t, n_basis=_N_BASIS, alpha_k=alpha_k),
        R_WE[0],
        R_WE[-1],
        s,
        q,
    )


def _resample(corners: FloatArray) -> FloatArray:
    """Resamples a polyline in joint space at `SAMPLES` points, evenly spaced along the polyline.

    Args:
        corners: (C, n) corners of the polyline [rad].

    Returns:
        (SAMPLES, n) configurations [rad].
    """
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    corners = corners[np.append(True, steps > 1e-9)]
    u = np.append(0.0, np.cumsum(steps[steps > 1e-9]))
    positions = np.linspace(0.0, u[-1], SAMPLES)
    return np.stack([np.interp(positions, u, joint) for joint in corners.T], axis=1)


def _smooth(world: ArmCollisionModel, q: FloatArray) -> FloatArray:
    """Rounds the corners of a joint-space path by the widest filter that preserves the clearance.

    A filter preserves the clearance if the required clearances are achieved afterwards, or if the
    clearance margin (distance minus required clearance) is no smaller than that of the given path.
    The ends of the path do not change.

    Args:
        world: collision model of the arm, with the required clearances.
        q: (T, n) configurations of the path, evenly spaced [rad].

    Returns:
        (T, n) configurations of the rounded path; the given ones if no filter preserves the
        clearance [rad].
    """
    min_margin = min(min_clearance_margin(world, q), 0.0)
    for width in _FILTER_WIDTHS:
        sigma = width * len(q)
        pad = min(int(4.0 * sigma) + 1, len(q) - 1)
        # Point reflection at both ends leaves the ends fixed under the filter.
        padded = np.pad(q, ((pad, pad), (0, 0)), mode="reflect", reflect_type="odd")
        smooth = gaussian_filter1d(padded, sigma, axis=0)[pad:-pad]
        if min_clearance_margin(world, smooth) >= min_margin:
            return np.asarray(smooth)
    return q
