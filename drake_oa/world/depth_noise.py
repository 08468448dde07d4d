"""What a structured-light depth camera (Kinect, Xtion) makes of a true depth image.

Sources of the model and its figures:

- C. V. Nguyen, S. Izadi, D. Lovell, "Modeling Kinect sensor noise for improved 3D
  reconstruction and tracking", 3DIMPVT 2012: axial and lateral deviation.
- K. Khoshelham, S. Oude Elberink, "Accuracy and resolution of Kinect depth data for
  indoor mapping applications", Sensors 12(2), 2012: depth from disparity in steps.
- The scans of docs/results/real_scans.md, where a figure has no published source.

A measured image holds NaN where the camera tells nothing, as the ROS drivers of these
cameras do for float images, whatever the reason.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem, ValueProducer
from pydrake.systems.sensors import CameraInfo, ImageDepth32F

from drake_oa.common.ports import read_value
from drake_oa.geometry.pinhole import pinhole
from drake_oa.perception.config import CameraNoise
from drake_oa.world.depth_noise_kernels import PATCH_BITS, Figures, add_noise

_FRAMES = 2**63


class NoiseRoom:
    """Arrays that `add_depth_noise` works in; what they hold before and after is of no meaning.

    Kept between images, they are allocated once.

    Args:
        height: of the images [pixel].
        width: of the images [pixel].
    """

    def __init__(self, height: int, width: int) -> None:
        patch = 1 << PATCH_BITS
        self.shape = (height, width)
        self.w = np.empty((height + 2, width + 2), dtype=np.float32)
        self.valid = np.empty((height, width), dtype=np.uint8)
        self.marks = np.empty((2, height, -(-width // patch) * patch), dtype=np.uint8)


def add_depth_noise(
    depth: NDArray[np.floating],
    K: ArrayLike,
    parameters: CameraNoise | None = None,
    *,
    seed: int = 0,
    frame: int = 0,
    out: NDArray[np.float32] | None = None,
    room: NoiseRoom | None = None,
) -> NDArray[np.float32]:
    """The depth image that a structured-light camera would have measured.

    The result depends on the arguments alone: the same seed, frame and image give the
    same noise, another frame gives another.

    Args:
        depth: (H, W) true depth along the optical axis [m]; 0 is too near, inf too far,
            NaN missing.
        K: (4,) fx, fy, cx, cy [pixel].
        parameters: of the camera; None for the defaults.
        seed: whole number in [0, 2^63).
        frame: whole number in [0, 2^63) that tells images apart, such as their time in
            microseconds.
        out: (H, W) float32 to be filled, C-contiguous; None makes one. It may be `depth`.
        room: to work in, for images of this size; None makes one.

    Returns:
        (H, W) measured depth [m]; NaN is missing.

    Raises:
        ValueError: for a wrong shape, intrinsics that are not finite or have a focal
            length that is not positive, a seed or frame out of range, or an unfit `out`
            or `room`.
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
    if out is None:
        out = np.empty(depth.shape, dtype=np.float32)
    elif out.shape != depth.shape or out.dtype != np.float32 or not out.flags.carray:
        raise ValueError(f"out must be a C-contiguous float32 image of shape {depth.shape}")
    np.copyto(out, depth, casting="same_kind")
    if room is None:
        room = NoiseRoom(*depth.shape)
    elif room.shape != depth.shape:
        raise ValueError(f"room is for images {room.shape}, not {depth.shape}")
    figures = _figures(p, float(camera[0]))
    add_noise(out, camera, int(seed), int(frame), figures, room.w, room.valid, room.marks)
    return out


class FrameNoise:
    """The noise of one camera, image after image; what time it was taken tells them apart."""

    def __init__(
        self, K: ArrayLike, parameters: CameraNoise | None = None, *, seed: int = 0
    ) -> None:
        """Keeps what all images have in common.

        Args:
            K: (4,) fx, fy, cx, cy [pixel].
            parameters: of the camera; None for the defaults.
            seed: of the noise.

        Raises:
            ValueError: for invalid intrinsics or a negative seed.
        """
        self._K = np.array(K, dtype=float)
        self._parameters = parameters or CameraNoise()
        self._seed = seed
        # Invalid arguments, and a kernel not compiled yet, tell here and not at the first frame.
        self(np.ones((2, 2), dtype=np.float32), 0.0)

    def __call__(
        self,
        depth: NDArray[np.floating],
        time: float,
        *,
        out: NDArray[np.float32] | None = None,
        room: NoiseRoom | None = None,
    ) -> NDArray[np.float32]:
        """`add_depth_noise` to the image of a time [s], counted in whole microseconds."""
        return add_depth_noise(
            depth,
            self._K,
            self._parameters,
            seed=self._seed,
            frame=max(round(1e6 * time), 0),
            out=out,
            room=room,
        )


def _figures(p: CameraNoise, focal: float) -> Figures:
    """The parameters as `add_noise` takes them; focal length [pixel]."""
    holes = min(max(p.edge_dropout, 1e-9), 1.0 - 1e-9)
    step, unit = np.float32(1.0 / (p.subpixels * focal * p.baseline)), np.float32(p.unit)
    figures = Figures(
        near=p.near,
        far=p.far,
        axial_offset=p.axial_offset,
        axial_growth=p.axial_growth,
        axial_depth=p.axial_depth,
        axial_angle=p.axial_angle,
        step=step,
        per_step=np.float32(1.0) / step,
        unit=unit,
        per_unit=np.float32(1.0) / unit,
        edge=p.edge_jump,
        grazing_start=math.cos(p.grazing_start),
        grazing_end=math.cos(p.grazing_end),
        lateral=p.lateral,
        holes=NormalDist().inv_cdf(holes),
        flying=p.flying,
        least=1.0 / p.far,
        shadow=focal * p.baseline if p.shadows else 0.0,
        spacing_u=p.correlation_u,
        spacing_v=p.correlation_v,
    )
    return Figures(*map(np.float32, figures))


class DepthNoise(LeafSystem):
    """Makes of a rendered depth image what a structured-light camera would have told.

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
    `drake_oa.perception.config.CameraNoise`. Nothing is kept: the noise is a function of
    the seed, the Context's time in whole microseconds, and the image. The output is computed when
    it is asked for, so that the camera renders as often as without this system.
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
        width, height = 1, 1
        if isinstance(camera, CameraInfo):
            width, height = camera.width(), camera.height()
            camera = pinhole(camera)
        self._noise = FrameNoise(camera, parameters, seed=seed)
        # Kept in the Context: it is allocated once, not with each image.
        self._room = self.DeclareCacheEntry(
            "room for the noise to work in",
            ValueProducer(
                allocate=lambda: Value(NoiseRoom(height, width)), calc=ValueProducer.NoopCalc
            ),
            prerequisites_of_calc={self.nothing_ticket()},
        )
        self._image_port = self.DeclareAbstractInputPort("depth_image", Value(ImageDepth32F()))
        self.DeclareAbstractOutputPort(
            "depth_image",
            lambda: Value(ImageDepth32F(width, height)),
            self._calc_image,
            prerequisites_of_calc={self._image_port.ticket(), self.time_ticket()},
        )

    def _calc_image(self, context: Context, output: AbstractValue) -> None:
        image: Any = read_value(self, self._image_port, context, ImageDepth32F)
        measured: Any = output.get_mutable_value()
        if (measured.width(), measured.height()) != (image.width(), image.height()):
            measured.resize(image.width(), image.height())
        depth = image.data[:, :, 0]
        room: Any = self._room.Eval(context)
        if room.shape != depth.shape:
            room = None
        self._noise(depth, context.get_time(), out=measured.mutable_data[:, :, 0], room=room)
