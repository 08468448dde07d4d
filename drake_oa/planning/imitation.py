"""A path of the whole arm as a demonstration, which the primitives imitate.

So a plan is one more demonstration, and the coupling terms stay the reaction around it: the tool's
position and orientation become primitives of their own (`drake_oa.policy`), and the posture is led
along the path by their common phase.
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
"""Number of samples of a path that is imitated."""
LONGEST = 2.0
"""Longest time of a motion that imitates a path, if the joints can, in demonstrated durations."""
SPEED_SHARE = 0.5
"""Greatest share of the speed limits of the joints in a motion that imitates a path."""
_SMOOTH = (0.04, 0.02, 0.01)
"""Widths of the filter that rounds a path's corners, in shares of it, the widest first."""
_N_BASIS = 100
"""Basis functions of a plan: it has corners where a demonstrated motion has none. 35 leave up to
15 mm, 100 up to 1 mm of the 21 paths that were tried."""


def demonstration(
    world: ArmCollisionModel,
    corners: FloatArray,
    *,
    pace: float,
    longest: float = math.inf,
    alpha_k: float = ALPHA_K,
) -> Demonstration:
    """Imitates a path of corners, rounded and in minimum-jerk time.

    Args:
        world: in which its corners may be rounded as far as the clearance is kept.
        corners: (C, n) of the path [rad].
        pace: time a meter of the tool's way [s/m].
        longest: it takes no longer where the joints can [s].
        alpha_k: decay of the phase.

    Raises:
        ValueError: if the tool turns too far for a primitive of its orientation, or ends where
            it began.
    """
    q = _rounded(world, _evenly(corners))
    s = np.linspace(0.0, 1.0, SAMPLES)
    q = np.asarray(make_interp_spline(s, q, k=3)(minimum_jerk_share(s)))
    X_WE = tool_poses(world.chain, q)
    seconds = min(pace * _length(X_WE[:, 9:]), longest)
    rate = np.abs(np.diff(q, axis=0)) / np.diff(s)[:, None]
    seconds = max(seconds, float((rate / (SPEED_SHARE * world.chain.speed)).max()))
    t, R_WE = seconds * s, X_WE[:, :9].reshape(-1, 3, 3)
    return Demonstration(
        imitate(X_WE[:, 9:], t, n_basis=_N_BASIS, alpha_k=alpha_k),
        imitate_orientation(R_WE, t, n_basis=_N_BASIS, alpha_k=alpha_k),
        R_WE[0],
        R_WE[-1],
        s,
        q,
    )


def _evenly(corners: FloatArray) -> FloatArray:
    """(SAMPLES, n) at equal distances along a polyline."""
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    corners = corners[np.append(True, steps > 1e-9)]
    u = np.append(0.0, np.cumsum(steps[steps > 1e-9]))
    at = np.linspace(0.0, u[-1], SAMPLES)
    return np.stack([np.interp(at, u, joint) for joint in corners.T], axis=1)


def _rounded(world: ArmCollisionModel, q: FloatArray) -> FloatArray:
    """The path with its corners rounded as much as the clearance allows, its ends as they are."""
    least = min(min_clearance_margin(world, q), 0.0)
    for width in _SMOOTH:
        sigma = width * len(q)
        far = min(int(4.0 * sigma) + 1, len(q) - 1)
        # Mirrored through the ends, so that these stay.
        longer = np.pad(q, ((far, far), (0, 0)), mode="reflect", reflect_type="odd")
        smooth = gaussian_filter1d(longer, sigma, axis=0)[far:-far]
        if min_clearance_margin(world, smooth) >= least:
            return np.asarray(smooth)
    return q


def _length(p: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum())
