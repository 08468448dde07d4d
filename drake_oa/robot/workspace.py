"""Where the Panda's tool point can be with the tool pointing down.

A cheap stand-in for inverse kinematics, for costs that ask about many points.
"""

from __future__ import annotations

import numpy as np

from drake_oa.common.messages import FloatArray

# Tool-down radii from the base axis. Outer: the extended arm. Inner: 4 cm or more
# outside where the folded arm (joints 3 and 5 at zero) meets a joint limit.
_HEIGHT = np.array([-0.2, -0.1, 0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8])
_OUTER = np.array([0.72, 0.76, 0.78, 0.80, 0.79, 0.78, 0.74, 0.68, 0.60, 0.50, 0.32])
_INNER = np.array([0.30, 0.30, 0.30, 0.33, 0.32, 0.23, 0.15, 0.15, 0.15, 0.15, 0.15])
_AZIMUTH = 2.8973
"""Limit of the first joint either way [rad]."""


def tool_down_radii(height: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least and largest distance of the tool point from the base axis, tool down.

    Args:
        height: (...) above the base [m]; beyond -0.2 and 0.8 m the radii of those
            heights are returned.

    Returns:
        (...) inner and (...) outer radius [m].
    """
    return np.interp(height, _HEIGHT, _INNER), np.interp(height, _HEIGHT, _OUTER)


def tool_down_annulus() -> FloatArray:
    """(3, n) heights above the base, and the least and largest distances there [m].

    Between the heights `tool_down_radii` is linear. The sector that the first joint does
    not reach is not in it.
    """
    return np.array([_HEIGHT, _INNER, _OUTER])


def annulus_margin(p_WQ: FloatArray, annulus: FloatArray) -> FloatArray:
    """Horizontal distance of points to the radii of an annulus.

    Args:
        p_WQ: (..., 3) points in the world frame [m].
        annulus: (3, n) as `tool_down_annulus` gives it; (3, 0): there is none.

    Returns:
        (...) margin [m], positive inside; inf without annulus.
    """
    if not annulus.shape[1]:
        return np.full(p_WQ.shape[:-1], np.inf)
    heights, inner, outer = annulus
    radius = np.hypot(p_WQ[..., 0], p_WQ[..., 1])
    z = p_WQ[..., 2]
    return np.minimum(radius - np.interp(z, heights, inner), np.interp(z, heights, outer) - radius)


def tool_down_margin(p_WQ: FloatArray, p_WB: FloatArray | None = None) -> FloatArray:
    """Signed margin of tool points to the edge of the tool-down workspace.

    The workspace is an annulus round the base axis whose radii depend on the height,
    without the sector behind the base that the first joint does not reach. The margin
    is the least of the horizontal distances to its radii, of the arc to that sector and
    of the vertical distances to its lowest and highest plane.

    Args:
        p_WQ: (..., 3) points in the world frame [m].
        p_WB: (3,) base of the robot, z up and x ahead as in the world [m]; None: the
            origin.

    Returns:
        (...) margin [m], positive inside; NaN for a point that is not finite.
    """
    p_BQ = np.asarray(p_WQ, dtype=float)
    if p_BQ.shape[-1:] != (3,):
        raise ValueError(f"p_WQ has shape {p_BQ.shape}; it must be (..., 3)")
    if p_WB is not None:
        p_BQ = p_BQ - p_WB
    x, y, z = p_BQ[..., 0], p_BQ[..., 1], p_BQ[..., 2]
    radius = np.hypot(x, y)
    margin = annulus_margin(p_BQ, tool_down_annulus())
    margin = np.minimum(margin, np.minimum(z - _HEIGHT[0], _HEIGHT[-1] - z))
    arc = radius * (_AZIMUTH - np.abs(np.arctan2(y, x)))
    return np.asarray(np.minimum(margin, arc))
