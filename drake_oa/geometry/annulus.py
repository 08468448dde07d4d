"""An annulus about a vertical axis, its radii depending on the height: where a tool may go."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from drake_oa.common.messages import FloatArray


class Annulus(NamedTuple):
    """Where the tool point may be.

    Attributes:
        radii: (3, n) heights in the world, increasing, and the least and largest distance from
            the axis there, linear between them [m]; (3, 0): it may be anywhere.
        axis: x and y of the vertical axis in the world [m].
    """

    radii: FloatArray
    axis: tuple[float, float] = (0.0, 0.0)


ANYWHERE = Annulus(np.zeros((3, 0)))


def annulus_margin(p_WQ: FloatArray, annulus: Annulus) -> FloatArray:
    """Horizontal distance of points to the radii of an annulus.

    Args:
        p_WQ: (..., 3) points in the world [m].
        annulus: which.

    Returns:
        (...) margin [m], positive inside; inf where there is no annulus.
    """
    if not annulus.radii.shape[1]:
        return np.full(p_WQ.shape[:-1], np.inf)
    heights, inner, outer = annulus.radii
    radius = np.hypot(p_WQ[..., 0] - annulus.axis[0], p_WQ[..., 1] - annulus.axis[1])
    z = p_WQ[..., 2]
    return np.minimum(radius - np.interp(z, heights, inner), np.interp(z, heights, outer) - radius)


def sector_margin(p_BQ: FloatArray, annulus: Annulus, most: float) -> FloatArray:
    """Signed margin to the edge of an annulus without the sector that the first joint leaves out.

    It is the least of the horizontal distances to its radii, of the arc to that sector and of the
    vertical distances to its lowest and highest plane.

    Args:
        p_BQ: (..., 3) tool points, in a frame whose z axis is the annulus' axis and whose x axis
            is where the first joint is at 0 [m].
        annulus: about that axis.
        most: limit of the first joint either way [rad].

    Returns:
        (...) margin [m], positive inside; NaN for a point that is not finite.

    Raises:
        ValueError: if the points are not (..., 3).
    """
    p_BQ = np.asarray(p_BQ, dtype=float)
    if p_BQ.shape[-1:] != (3,):
        raise ValueError(f"p_BQ has shape {p_BQ.shape}; it must be (..., 3)")
    x, y, z = p_BQ[..., 0], p_BQ[..., 1], p_BQ[..., 2]
    heights = annulus.radii[0]
    margin = np.minimum(annulus_margin(p_BQ, annulus), np.minimum(z - heights[0], heights[-1] - z))
    return np.asarray(np.minimum(margin, np.hypot(x, y) * (most - np.abs(np.arctan2(y, x)))))
