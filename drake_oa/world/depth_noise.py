"""Noise of structured-light depth cameras (Kinect, Xtion) on true depth images.

Sources of the model and its values:

- C. V. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect sensor noise for improved 3D
  reconstruction and tracking", 3DIMPVT 2012: axial and lateral deviation.
- K. Khoshelham, S. Oude Elberink, "Accuracy and resolution of Kinect depth data for
  indoor mapping applications", Sensors 12(2), 2012: depth from disparity in steps.
- The scans of docs/results/real_scans.md, for values without a published source.

Missing pixels of a measured image are NaN, as in the float images of the ROS drivers of these
cameras. Edges and normals are computed from the inverse depth w = 1 / z, which is linear in the
image over a plane and proportional to the disparity.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import CameraInfo, ImageDepth32F
from scipy.ndimage import uniform_filter

from drake_oa.common.ports import AbstractInput
from drake_oa.geometry.pinhole import pinhole
from drake_oa.perception.config import CameraNoise

_PATCH = 4
"""Side of the patches of pixels whose edges move, and are missing, together [pixel]."""
_BAND = 2
"""Maximum distance by which an edge moves along each axis [pixel]."""

_Image = NDArray[np.float32]


def add_depth_noise(
    depth: NDArray[np.floating],
    time: float,
    *,
    K: Iterable[float],
    parameters: CameraNoise | None = None,
    seed: int = 0,
) -> _Image:
    """Returns the depth image that a structured-light camera would have measured.

    The result depends on the arguments only: the same seed, time and image have the same
    noise; other times have independent noise.

    Args:
        depth: (H, W) true depth along the optical axis [m]; 0 is too near, inf too far,
            NaN missing.
        time: time of the image, counted in whole microseconds [s].
        K: (4,) fx, fy, cx, cy [pixel].
        parameters: of the camera; None for the defaults.
        seed: integer >= 0.

    Returns:
        (H, W) measured depth [m]; NaN is missing.
    """
    p = parameters or CameraNoise()
    rng = np.random.default_rng([seed, max(round(1e6 * time), 0)])
    fx, fy, cx, cy = map(float, K)
    depth = np.asarray(depth, dtype=np.float32)
    row, column = (np.arange(count, dtype=np.float32) for count in depth.shape)
    row = row[:, None]
    # Pixels closer than `near` are missing, too, but still cast a shadow.
    w = np.where(depth <= p.far, 1.0 / np.maximum(depth, p.near), 0.0).astype(np.float32)
    valid = (depth >= p.near) & (depth <= p.far)
    if p.shadows:
        # From the right, points are further and further left in the image of the projector on
        # the right; otherwise a nearer surface intercepts its light.
        position = column - fx * p.baseline * w
        valid &= position <= np.minimum.accumulate(position[:, ::-1], axis=1)[:, ::-1]
    (slope_x, jump_x), (slope_y, jump_y) = _differences(w, 1), _differences(w, 0)
    jump = np.where(np.abs(jump_x) > np.abs(jump_y), jump_x, jump_y)
    x, y = (column - cx) / fx, (row - cy) / fy
    normal = fx * slope_x, fy * slope_y, w - fx * slope_x * x - fy * slope_y * y
    length = sum(part * part for part in normal) * (1.0 + x * x + y * y)
    theta = np.arccos(np.clip(w / np.sqrt(length + 1e-20), 0.02, 1.0))
    # Pixels of grazing incidence are lost in squares of two by two.
    lost = _patches(rng.random, depth.shape, 2) * (p.grazing_end - p.grazing_start)
    valid &= (theta <= p.grazing_start) | (theta < p.grazing_start + lost)

    at_edge = (np.abs(jump) > p.edge_jump * w) & valid
    valid &= ~(at_edge & (_patches(rng.random, depth.shape, _PATCH) < p.edge_dropout))
    flying = np.flatnonzero(at_edge & (w + jump > 1.0 / p.far))
    flying = flying[rng.random(len(flying)) < p.flying]
    w.flat[flying] += rng.random(len(flying), dtype=np.float32) * jump.flat[flying]
    down, across = (
        np.clip(
            np.rint(p.lateral * _patches(rng.standard_normal, depth.shape, _PATCH)), -_BAND, _BAND
        )
        for _ in range(2)
    )
    r = np.clip(row + down, 0, depth.shape[0] - 1)
    c = np.clip(column + across, 0, depth.shape[1] - 1)
    moved = (r * depth.shape[1] + c).astype(np.int32)
    there, valid = w.ravel()[moved], valid.ravel()[moved]
    w = np.where(np.abs(there - w) > p.edge_jump * np.maximum(w, there), there, w)

    z = 1.0 / np.maximum(w, 1.0 / p.far)
    sigma = p.axial_offset + p.axial_growth * (z - p.axial_depth) ** 2
    sigma += p.axial_angle / np.sqrt(z) * (theta / (0.5 * np.pi - theta)) ** 2
    # The published deviation is that of measured depths, rounding included.
    step = 1.0 / (p.subpixels * fx * p.baseline)
    rounding = ((step * z * z) ** 2 + p.unit**2) / 12.0
    smooth = p.correlation_v, p.correlation_u
    g = rng.standard_normal(depth.shape, dtype=np.float32)
    g = uniform_filter(g, smooth, mode="wrap") * float(np.sqrt(np.prod(smooth)))
    z = np.maximum(z + g * np.sqrt(np.maximum(sigma**2 - rounding, 0.0)), 0.5 * z)
    levels = np.maximum(np.rint(1.0 / (step * z)), 1.0)
    measured = np.rint(1.0 / (step * p.unit * levels)) * p.unit
    return np.where(valid, measured, np.nan).astype(np.float32)


def _differences(w: _Image, axis: int) -> tuple[_Image, _Image]:
    """Returns the smaller difference between neighbors, and that to the most different neighbor."""
    change = np.diff(w, axis=axis)
    before, after = (
        np.pad(change, [side if k == axis else (0, 0) for k in range(2)], "edge")
        for side in ((1, 0), (0, 1))
    )
    # The smaller one is not across an edge. A product is quicker than a choice by pixel.
    smaller = np.abs(before) < np.abs(after)
    return after + smaller * (before - after), smaller * (before + after) - before


def _patches(draw: Any, shape: tuple[int, ...], size: int) -> _Image:
    """Returns random numbers (H, W), one for each square of so many pixels."""
    count = [side // size + 1 for side in shape]
    drawn = draw(count, dtype=np.float32).repeat(size, axis=0).repeat(size, axis=1)
    return np.asarray(drawn[: shape[0], : shape[1]])


class DepthNoise(LeafSystem):
    """Noise of a structured-light camera on a rendered depth image.

    .. pydrake_system::

      name: DepthNoise
      input_ports:
      - depth_image
      output_ports:
      - depth_image

    Input port `depth_image`: ImageDepth32F, true depth along the optical axis [m]; 0 is
    too near, inf too far, NaN missing.

    Output port `depth_image`: ImageDepth32F, measured depth [m]; NaN is missing, for
    whatever reason.

    The model, its parameters and their sources are
    `drake_oa.perception.config.CameraNoise`. The system has no state: the noise is a function of
    the seed, the Context's time in whole microseconds, and the image. The output is computed on
    demand, so that the camera renders as often as without this system.
    """

    def __init__(
        self,
        camera: CameraInfo,
        *,
        parameters: CameraNoise | None = None,
        seed: int = 0,
    ) -> None:
        """Declares the ports.

        Args:
            camera: the depth camera's intrinsics.
            parameters: of the noise; None for the defaults.
            seed: of the noise.
        """
        super().__init__()
        self._noise = partial(add_depth_noise, K=pinhole(camera), parameters=parameters, seed=seed)
        self._image_port = AbstractInput(self, "depth_image", ImageDepth32F)
        self.DeclareAbstractOutputPort(
            "depth_image",
            lambda: Value(ImageDepth32F()),
            self._calc_image,
            prerequisites_of_calc={self._image_port.ticket(), self.time_ticket()},
        )

    def _calc_image(self, context: Context, output: AbstractValue) -> None:
        image: Any = self._image_port.read(context)
        measured: Any = output.get_mutable_value()
        measured.resize(image.width(), image.height())
        measured.mutable_data[:, :, 0] = self._noise(image.data[:, :, 0], context.get_time())
