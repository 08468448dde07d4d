"""Noise model of structured-light depth cameras (Kinect, Xtion), applied to true depth images.

The model and its parameter values are from these sources:

- C. V. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect sensor noise for improved 3D reconstruction
  and tracking", 3DIMPVT 2012: standard deviation of depth (axial) and of edge positions (lateral).
- K. Khoshelham, S. Oude Elberink, "Accuracy and resolution of Kinect depth data for indoor mapping
  applications", Sensors 12(2), 2012: quantized disparity, from which depth is computed.
- Measured depth images of real cameras, described in docs/results/real_scans.md, for values without
  a published source.

Missing pixels of a measured image are NaN, as in the float images of the ROS drivers of these
cameras. Edges and normals are computed from the inverse depth w = 1 / z. On a plane, it is a linear
function of the pixel coordinates. It is also proportional to the disparity, the image shift that
the camera measures.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

_AXIAL_OFFSET = 0.0012
"""Standard deviation of the measured depth at a true depth of 0.4 m and a view along the surface
normal (Nguyen et al.) [m]."""
_AXIAL_GROWTH = 0.0019
"""Coefficient of the term (z - 0.4 m)^2 in the standard deviation [m] of the measured depth, at the
true depth z [m] (Nguyen et al.) [1/m]."""
_AXIAL_DEPTH = 0.4
"""Depth at which the standard deviation of the measured depth is smallest (Nguyen et al.) [m]."""
_AXIAL_ANGLE = 0.0001
"""Coefficient of the term 1 / sqrt(z) (theta / (pi/2 - theta))^2 in the standard deviation [m] of
the measured depth (Nguyen et al.) [m^1.5]. The true depth is z [m], and theta [rad] is the angle of
incidence, from the surface normal."""
_LATERAL = 0.8
"""Standard deviation of the position of a depth edge in the image, for a view along the surface
normal (Nguyen et al.) [pixel]. The growth of this deviation with the angle of incidence, below 0.1
pixels up to 65 deg, is neglected. Only depth edges are displaced, because the standard deviation of
the depth on a plane already includes the effect of displaced pixels."""
_BASELINE = 0.075
"""Distance between the depth camera and its light projector, which is on the right of the camera
(Khoshelham and Oude Elberink) [m]."""
_SUBPIXELS = 8.0
"""Number of disparity steps per pixel, in which the camera quantizes depth (Khoshelham and Oude
Elberink) [1/pixel]. Disparity is the image shift that the camera measures. With the focal length f
[pixel] and the distance b = 0.075 m between camera and projector, one step changes the depth z by
z^2 / (8 f b): 2.9 mm at 1 m for f = 577 pixels."""
_UNIT = 0.001
"""Resolution of the depth values that the driver of the simulated camera outputs (OpenNI) [m]."""
_NEAR = 0.5
"""Depth below which the simulated camera outputs missing pixels [m]: the minimum depth in the
images of docs/results/real_scans.md."""
_FAR = 5.0
"""Depth above which the simulated camera outputs missing pixels (Khoshelham and Oude Elberink)
[m]."""
_GRAZING_START = math.radians(70.0)
"""Angle of incidence, from the surface normal, above which some pixels of the measured image are
missing [rad]."""
_GRAZING_END = math.radians(80.0)
"""Angle of incidence, from the surface normal, above which all pixels of the measured image are
missing (upper limit of the measurements of Nguyen et al.) [rad]."""
_EDGE_JUMP = 0.02
"""Minimum relative difference of inverse depth at which two neighboring pixels form a depth edge
[-]. A plane at an angle of incidence of 85 deg has this difference between neighboring pixels."""
_EDGE_DROPOUT = 0.2
"""Fraction of the pixels at depth edges that are missing in the measured image, in patches [-]. The
value is estimated from the real depth images of docs/results/real_scans.md."""
_FLYING = 0.1
"""Fraction of the pixels at depth edges whose measured depth is between both surfaces, called
flying pixels [-]. The value is estimated from the real depth images of
docs/results/real_scans.md."""
_SMOOTH = 3, 5
"""Widths, along columns and along rows, of the uniform filter that correlates the depth noise of
neighboring pixels [pixel]. The values reproduce correlations in the real depth images of
docs/results/real_scans.md, after the mean over 21 x 21 pixels was subtracted. The correlations at
distances along a row are 0.72 at one pixel, 0.38 at four and 0.08 at eight. Those along a column
are 0.57 at one pixel, 0.12 at three and -0.02 at four."""
_PATCH = 4
"""Side length of square patches of pixels [pixel]. At depth edges, all pixels of a patch are
displaced together or missing together."""
_BAND = 2
"""Maximum displacement of a depth edge along each image axis [pixel]."""

_Image = NDArray[np.float32]
"""Type of an image (H, W) of 32-bit floats."""


def add_depth_noise(
    depth: NDArray[np.floating], time: float, *, K: Iterable[float], seed: int = 0
) -> _Image:
    """Computes the depth image that a structured-light camera would measure, including missing
    pixels, for a true depth image.

    The standard deviation [m] of the depth z [m] at the angle of incidence theta [rad], measured
    from the surface normal (Nguyen et al. 2012, up to 80 deg), is

        0.0012 + 0.0019 (z - 0.4)^2 + 0.0001 / sqrt(z) (theta / (pi/2 - theta))^2

    The noise depends only on the arguments: the same seed, time and image give the same noise, and
    different times give independent noise.

    Args:
        depth: (H, W) true depths along the optical axis [m]; 0 is too near, inf is too far, NaN is
            missing.
        time: capture time of the image [s]; the noise depends on this time in whole microseconds.
        K: (4,) focal lengths fx, fy and principal point cx, cy of the camera [pixel].
        seed: seed of the random noise, an integer >= 0.

    Returns:
        (H, W) measured depths along the optical axis [m]; NaN is missing.
    """
    rng = np.random.default_rng([seed, max(round(1e6 * time), 0)])
    fx, fy, cx, cy = map(float, K)
    depth = np.asarray(depth, dtype=np.float32)
    row, column = (np.arange(count, dtype=np.float32) for count in depth.shape)
    row = row[:, None]
    # Pixels closer than `_NEAR` are missing, too, but still occlude the projector.
    w = np.where(depth <= _FAR, 1.0 / np.maximum(depth, _NEAR), 0.0).astype(np.float32)
    valid = (depth >= _NEAR) & (depth <= _FAR)
    # The projector is on the right of the camera. Along a row from right to left, the projector
    # lights a point only if the point is left of all previous ones in the projector's image.
    position = column - fx * _BASELINE * w
    valid &= position <= np.minimum.accumulate(position[:, ::-1], axis=1)[:, ::-1]
    (slope_x, jump_x), (slope_y, jump_y) = _differences(w, 1), _differences(w, 0)
    jump = np.where(np.abs(jump_x) > np.abs(jump_y), jump_x, jump_y)
    x, y = (column - cx) / fx, (row - cy) / fy
    normal = fx * slope_x, fy * slope_y, w - fx * slope_x * x - fy * slope_y * y
    length = sum(part * part for part in normal) * (1.0 + x * x + y * y)
    theta = np.arccos(np.clip(w / np.sqrt(length + 1e-20), 0.02, 1.0))
    # Pixels at grazing incidence are missing in patches of two by two pixels.
    width = _patches(rng.random, depth.shape, 2) * (_GRAZING_END - _GRAZING_START)
    valid &= (theta <= _GRAZING_START) | (theta < _GRAZING_START + width)

    at_edge = (np.abs(jump) > _EDGE_JUMP * w) & valid
    valid &= ~(at_edge & (_patches(rng.random, depth.shape, _PATCH) < _EDGE_DROPOUT))
    flying = np.flatnonzero(at_edge & (w + jump > 1.0 / _FAR))
    flying = flying[rng.random(len(flying)) < _FLYING]
    w.flat[flying] += rng.random(len(flying), dtype=np.float32) * jump.flat[flying]
    down, across = (
        np.clip(
            np.rint(_LATERAL * _patches(rng.standard_normal, depth.shape, _PATCH)), -_BAND, _BAND
        )
        for _ in range(2)
    )
    r = np.clip(row + down, 0, depth.shape[0] - 1)
    c = np.clip(column + across, 0, depth.shape[1] - 1)
    source = (r * depth.shape[1] + c).astype(np.int32)
    there, valid = w.ravel()[source], valid.ravel()[source]
    w = np.where(np.abs(there - w) > _EDGE_JUMP * np.maximum(w, there), there, w)

    z = 1.0 / np.maximum(w, 1.0 / _FAR)
    sigma = _AXIAL_OFFSET + _AXIAL_GROWTH * (z - _AXIAL_DEPTH) ** 2
    sigma += _AXIAL_ANGLE / np.sqrt(z) * (theta / (0.5 * np.pi - theta)) ** 2
    # The published deviation is that of measured depths, rounding included.
    step = 1.0 / (_SUBPIXELS * fx * _BASELINE)
    rounding = ((step * z * z) ** 2 + _UNIT**2) / 12.0
    g = rng.standard_normal(depth.shape, dtype=np.float32)
    g = uniform_filter(g, _SMOOTH, mode="wrap") * float(np.sqrt(np.prod(_SMOOTH)))
    z = np.maximum(z + g * np.sqrt(np.maximum(sigma**2 - rounding, 0.0)), 0.5 * z)
    levels = np.maximum(np.rint(1.0 / (step * z)), 1.0)
    measured_depth = np.rint(1.0 / (step * _UNIT * levels)) * _UNIT
    return np.where(valid, measured_depth, np.nan).astype(np.float32)


def _differences(w: _Image, axis: int) -> tuple[_Image, _Image]:
    """Computes, for each pixel of an image, the smaller and the larger difference to its two
    neighbors along an image axis.

    The smaller difference is the slope of the surface, because it is not across a depth edge.

    Args:
        w: (H, W) image of inverse depths [1/m].
        axis: image axis along which neighbors are compared: 0 along columns, 1 along rows.

    Returns:
        (H, W) slope [1/m per pixel]: the smaller difference, positive if w grows along the axis;
        (H, W) jump [1/m]: value of the neighbor that differs more, minus value of the pixel.
    """
    change = np.diff(w, axis=axis)
    before, after = (
        np.pad(change, [side if k == axis else (0, 0) for k in range(2)], "edge")
        for side in ((1, 0), (0, 1))
    )
    # The smaller difference is not across an edge. A product is faster than `np.where`.
    smaller = np.abs(before) < np.abs(after)
    return after + smaller * (before - after), smaller * (before + after) - before


def _patches(draw: Any, shape: tuple[int, ...], size: int) -> _Image:
    """Draws an image (H, W) of random numbers, with one number per square patch of pixels.

    Args:
        draw: method of a NumPy generator that draws random numbers of a given shape and type, such
            as `Generator.random`.
        shape: shape (H, W) of the image.
        size: side length of the patches [pixel].
    """
    count = [side // size + 1 for side in shape]
    drawn = draw(count, dtype=np.float32).repeat(size, axis=0).repeat(size, axis=1)
    return np.asarray(drawn[: shape[0], : shape[1]])
