"""Conversion of a joint-space path to a demonstration that the movement primitives imitate.

A plan thus is a further demonstration, and coupling terms react to obstacles along it. Position and
orientation of the tool become movement primitives (`drake_oa.policy`), and their common phase moves
the nominal posture along the path.
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
    minimum_jerk_share,
)
from drake_oa.robot.arm import tool_poses

SAMPLES = 201
"""Number of samples of an imitated path."""
MAX_DURATION_RATIO = 2.0
"""Maximum duration of an imitated path over the task's demonstrated duration, unless the joint
speeds require more."""
SPEED_FRACTION = 0.5
"""Maximum joint speed of an imitated path, as a fraction of the speed limits."""
_FILTER_WIDTHS = (0.04, 0.02, 0.01)
"""Standard deviations of the filter that rounds corners, as fractions of the path, widest first."""
_N_BASIS = 100
"""Number of basis functions of an imitated path: 35 reproduce its corners to 15 mm, 100 to 1 mm."""


def demonstration(
    world: ArmCollisionModel,
    corners: FloatArray,
    *,
    seconds_per_meter: float,
    max_duration: float = math.inf,
    alpha_k: float = ALPHA_K,
) -> Demonstration:
    """Converts a polyline in joint space to a demonstration with minimum-jerk timing.

    Args:
        world: collision model that limits the rounding of corners.
        corners: (C, n) corners of the path [rad].
        seconds_per_meter: duration per meter of the tool's path [s/m].
        max_duration: maximum duration, unless the joint speeds require more [s].
        alpha_k: decay rate of the phase.

    Raises:
        ValueError: if the tool turns too far for an orientation primitive, or start and end of
            its path coincide.
    """
    q = _smooth(world, _resample(corners))
    s = np.linspace(0.0, 1.0, SAMPLES)
    q = np.asarray(make_interp_spline(s, q, k=3)(minimum_jerk_share(s)))
    X_WE = tool_poses(world.chain, q)
    duration = min(seconds_per_meter * _path_length(X_WE[:, 9:]), max_duration)
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
    """Resamples a polyline (C, n) at `SAMPLES` points of equal spacing."""
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    corners = corners[np.append(True, steps > 1e-9)]
    u = np.append(0.0, np.cumsum(steps[steps > 1e-9]))
    positions = np.linspace(0.0, u[-1], SAMPLES)
    return np.stack([np.interp(positions, u, joint) for joint in corners.T], axis=1)


def _smooth(world: ArmCollisionModel, q: FloatArray) -> FloatArray:
    """Rounds the corners of a path (T, n) by the widest filter that preserves the clearance margin.

    The ends do not change; without such a filter the path is returned unchanged.
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


def _path_length(p: FloatArray) -> float:
    """Computes the length of a polyline (T, 3) [m]."""
    return float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum())
