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

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from drake_oa.common.messages import IntArray
from drake_oa.common.ports import read_value
from drake_oa.geometry.pinhole import pinhole
from drake_oa.perception.config import CameraNoise

_FRAMES = 2**63
_PATCH = 4
"""Side of the patches of pixels whose edges move, and are missing, together [pixel]."""
_BAND = 2
"""Distance from an edge up to which its uncertain position changes pixels [pixel]."""

_ROWS = 32
"""Rows of an image whose intermediate results stay in the processor's cache."""

_Image = NDArray[np.float32]


def add_depth_noise(
    depth: NDArray[np.floating],
    K: ArrayLike,
    parameters: CameraNoise | None = None,
    *,
    seed: int = 0,
    frame: int = 0,
) -> _Image:
    """Returns the depth image that a structured-light camera would have measured.

    The result depends on the arguments only: the same seed, frame and image have the same
    noise; other frames have independent noise.

    Args:
        depth: (H, W) true depth along the optical axis [m]; 0 is too near, inf too far,
            NaN missing.
        K: (4,) fx, fy, cx, cy [pixel].
        parameters: of the camera; None for the defaults.
        seed: integer in [0, 2^63).
        frame: integer in [0, 2^63) that distinguishes images, such as their time in
            microseconds.

    Returns:
        (H, W) measured depth [m]; NaN is missing.

    Raises:
        ValueError: for a wrong shape, intrinsics that are not finite or have a focal
            length that is not positive, or a seed or frame out of range.
    """
    p = parameters or CameraNoise()
    if depth.ndim != 2 or min(depth.shape) < 1:
        raise ValueError(f"depth must be an image (H, W), not of shape {depth.shape}")
    camera = np.array(K, dtype=np.float32)
    if camera.shape != (4,) or not np.isfinite(camera).all() or (camera[:2] <= 0.0).any():
        raise ValueError(f"K must be [fx, fy, cx, cy] in pixels, not {K!r}")
    for name, value in (("seed", seed), ("frame", frame)):
        if not 0 <= value < _FRAMES:
            raise ValueError(f"{name} must lie in [0, 2^63), not {value}")
    rng = np.random.default_rng([int(seed), int(frame)])
    depth = np.asarray(depth, dtype=np.float32)
    height, width = depth.shape
    in_reach = depth <= p.far
    # Pixels closer than `near` are missing, too, but still cast a shadow.
    w = 1.0 / np.maximum(depth, p.near)
    w[~in_reach] = 0.0
    w = np.pad(w, 1, "reflect", reflect_type="odd")
    valid = in_reach & (depth >= p.near)
    edges, measured = np.empty_like(valid), np.empty_like(depth)
    disparity = float(camera[0]) * p.baseline
    step = 1.0 / (p.subpixels * disparity)
    # The axial noise is interpolated between the nodes of a lattice.
    row, down = _lattice(rng, height, p.correlation_v)
    column, across = _lattice(rng, width, p.correlation_u)
    nodes = rng.standard_normal((row[-1] + 2, column[-1] + 2), dtype=np.float32)
    lines = across[0] * nodes[:, column] + across[1] * nodes[:, column + 1]
    # Pixels of grazing incidence are lost in squares of two by two.
    kept = rng.random((height // 2 + 1, width // 2 + 1), dtype=np.float32)
    start, end = math.cos(p.grazing_start), math.cos(p.grazing_end)
    for first in range(0, height, _ROWS):
        block = slice(first, min(first + _ROWS, height))
        around = w[block.start : block.stop + 2]
        middle = around[1:-1, 1:-1]
        if p.shadows:
            valid[block] &= _illuminated(middle, disparity)
        cosine, contrast = _incidence(around, camera, first)
        edges[block] = contrast > p.edge_jump * middle
        steepness = 0.5 * np.pi / np.arcsin(np.clip(cosine, 0.02, 1.0)) - 1.0
        above, below = lines[row[block]], lines[row[block] + 1]
        g = down[0, block, None] * above + down[1, block, None] * below
        part = _measured(middle, steepness, g, step, p)
        part[~valid[block]] = np.nan
        r, c = _places(valid[block] & (cosine < start))
        lost = kept[(first + r) // 2, c // 2] < (start - cosine[r, c]) / (start - end)
        part[r[lost], c[lost]] = np.nan
        measured[block] = part
    _disturb_edges(rng, measured, w, valid, edges, step, p)
    return measured


def _places(mask: NDArray[np.bool_]) -> tuple[IntArray, IntArray]:
    """Returns rows and columns of a mask's pixels, several times faster than `np.nonzero`."""
    return np.divmod(np.flatnonzero(mask), mask.shape[1])


def _illuminated(w: _Image, disparity: float) -> NDArray[np.bool_]:
    """Returns whether the projector, on the right, illuminates each pixel.

    Along a row from the right an illuminated point is further left in the projector's image
    than all points before it; otherwise a nearer surface intercepts the light.

    Args:
        w: (H, W) inverse depth [1/m].
        disparity: focal length times baseline [pixel m].
    """
    position = np.arange(w.shape[1], dtype=np.float32) - disparity * w
    leftmost = np.minimum.accumulate(position[:, ::-1], axis=1)[:, ::-1]
    return position <= leftmost


def _incidence(w: _Image, camera: _Image, first: int) -> tuple[_Image, _Image]:
    """Returns the cosine of incidence and the largest difference to a neighbor, (H, W) each.

    Args:
        w: (H + 2, W + 2) inverse depth, with a pixel more on each side [1/m].
        camera: (4,) fx, fy, cx, cy [pixel].
        first: row of the image at which the result begins.
    """
    across, down = np.diff(w[1:-1], axis=1), np.diff(w[:, 1:-1], axis=0)
    before, after = np.stack([across[:, :-1], down[:-1]]), np.stack([across[:, 1:], down[1:]])
    # The smaller one of both differences: the other one may be across an edge.
    size, size_after = np.abs(before), np.abs(after)
    slope_x, slope_y = np.where(size < size_after, before, after)
    middle = w[1:-1, 1:-1]
    height, width = middle.shape
    x = (np.arange(width, dtype=np.float32) - camera[2]) / camera[0]
    y = (np.arange(first, first + height, dtype=np.float32)[:, None] - camera[3]) / camera[1]
    normal_x, normal_y = camera[0] * slope_x, camera[1] * slope_y
    normal_z = middle - normal_x * x - normal_y * y
    length = (normal_x**2 + normal_y**2 + normal_z**2) * (1.0 + x**2 + y**2)
    contrast = np.maximum(size, size_after).max(axis=0)
    return middle / np.sqrt(length + np.float32(1e-20)), contrast


def _lattice(
    rng: np.random.Generator, size: int, spacing: int
) -> tuple[IntArray, NDArray[np.float32]]:
    """Returns the nodes (size,) before the pixels along an axis, and the weights (2, size) of
    these nodes and the next ones, with which interpolated noise has unit variance."""
    # A lattice at rest would be visible in a mean over frames.
    node, offset = np.divmod(np.arange(size) + rng.integers(spacing), spacing)
    t = (offset / spacing).astype(np.float32)
    return node, np.stack([1.0 - t, t]) / np.hypot(1.0 - t, t)


def _measured(w: _Image, steepness: Any, g: Any, step: float, p: CameraNoise) -> _Image:
    """Returns the measured depth [m]: noise, then steps of the disparity and of the unit.

    Args:
        w: (...) inverse depth, 0 beyond reach [1/m].
        steepness: theta / (pi/2 - theta) at angles of incidence theta, of w's shape or one.
        g: standard normal numbers, of w's shape or one.
        step: of the inverse depth between neighboring disparities [1/m].
        p: of the camera.
    """
    z = 1.0 / np.maximum(w, 1.0 / p.far)
    sigma = p.axial_offset + p.axial_growth * (z - p.axial_depth) ** 2
    sigma += p.axial_angle / np.sqrt(z) * steepness**2
    # The published deviation is that of measured depths, rounding included.
    rounding = ((step * z * z) ** 2 + p.unit**2) / 12.0
    noisy = z + g * np.sqrt(np.maximum(sigma**2 - rounding, 0.0))
    levels = np.maximum(np.rint(1.0 / (step * np.maximum(noisy, 0.5 * z))), 1.0)
    return np.rint(1.0 / (step * p.unit * levels)) * np.float32(p.unit)


def _disturb_edges(
    rng: np.random.Generator,
    measured: _Image,
    w: _Image,
    valid: NDArray[np.bool_],
    edges: NDArray[np.bool_],
    step: float,
    p: CameraNoise,
) -> None:
    """Moves edges by patches, and adds missing and flying pixels, in the measured image."""
    near = np.pad(edges, _BAND)
    for _ in range(_BAND):
        near[1:-1] |= near[:-2] | near[2:]
        near[:, 1:-1] |= near[:, :-2] | near[:, 2:]
    height, width = valid.shape
    rows, columns = _places(near[_BAND:-_BAND, _BAND:-_BAND])
    patches = height // _PATCH + 1, width // _PATCH + 1
    patch = rows // _PATCH, columns // _PATCH
    down = rng.standard_normal(patches, dtype=np.float32)[patch]
    across = rng.standard_normal(patches, dtype=np.float32)[patch]
    hole = rng.random(patches, dtype=np.float32)[patch] < p.edge_dropout
    r = np.clip(rows + np.rint(p.lateral * down).astype(int), 0, height - 1)
    c = np.clip(columns + np.rint(p.lateral * across).astype(int), 0, width - 1)
    here, there = w[rows + 1, columns + 1], w[r + 1, c + 1]
    moved = np.abs(there - here) > p.edge_jump * np.maximum(here, there)
    moved |= valid[r, c] != valid[rows, columns]
    g = rng.standard_normal(len(there), dtype=np.float32)
    seen = np.where(valid[r, c], _measured(there, 0.0, g, step, p), np.nan)
    measured[rows[moved], columns[moved]] = seen[moved]

    at_edge = edges[rows, columns] & valid[rows, columns]
    flying = at_edge & (rng.random(len(rows)) < p.flying)
    r, c, here = rows[flying], columns[flying], here[flying]
    neighbors = np.stack([w[r, c + 1], w[r + 2, c + 1], w[r + 1, c], w[r + 1, c + 2]])
    neighbors = np.where(neighbors >= 1.0 / p.far, neighbors, here)
    other = np.argmax(np.abs(neighbors - here), axis=0)
    change = neighbors[other, np.arange(len(r))] - here
    between = here + rng.random(len(r), dtype=np.float32) * change
    measured[r, c] = _measured(between, 0.0, 0.0, step, p)
    hole &= at_edge
    measured[rows[hole], columns[hole]] = np.nan


class FrameNoise:
    """Noise of the images of one camera, which differs with their time."""

    def __init__(
        self, K: ArrayLike, parameters: CameraNoise | None = None, *, seed: int = 0
    ) -> None:
        """Keeps the arguments of `add_depth_noise` that all images share.

        Args:
            K: (4,) fx, fy, cx, cy [pixel].
            parameters: of the camera; None for the defaults.
            seed: of the noise.

        Raises:
            ValueError: for invalid intrinsics or a negative seed.
        """
        self._shared: dict[str, Any] = {"K": K, "parameters": parameters, "seed": seed}
        # Raises errors here and not at the first frame.
        self(np.ones((2, 2), dtype=np.float32), 0.0)

    def __call__(self, depth: NDArray[np.floating], time: float) -> _Image:
        """Returns the measured image of a time [s], counted in whole microseconds."""
        return add_depth_noise(depth, frame=max(round(1e6 * time), 0), **self._shared)


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
        camera: CameraInfo | Sequence[float],
        *,
        parameters: CameraNoise | None = None,
        seed: int = 0,
    ) -> None:
        """Declares the ports.

        Args:
            camera: the depth camera's intrinsics, or [fx, fy, cx, cy] [pixel].
            parameters: of the noise; None for the defaults.
            seed: of the noise.

        Raises:
            ValueError: for invalid intrinsics or a negative seed.
        """
        super().__init__()
        K = pinhole(camera) if isinstance(camera, CameraInfo) else camera
        self._noise = FrameNoise(K, parameters, seed=seed)
        self._image_port = self.DeclareAbstractInputPort("depth_image", Value(ImageDepth32F()))
        self.DeclareAbstractOutputPort(
            "depth_image",
            lambda: Value(ImageDepth32F()),
            self._calc_image,
            prerequisites_of_calc={self._image_port.ticket(), self.time_ticket()},
        )

    def _calc_image(self, context: Context, output: AbstractValue) -> None:
        image: Any = read_value(self, self._image_port, context, ImageDepth32F)
        measured: Any = output.get_mutable_value()
        measured.resize(image.width(), image.height())
        measured.mutable_data[:, :, 0] = self._noise(image.data[:, :, 0], context.get_time())
