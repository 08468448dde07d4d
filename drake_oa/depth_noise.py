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
from dataclasses import dataclass, fields
from statistics import NormalDist

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_oa.depth_noise_kernels import add_noise
from drake_oa.random_field_kernels import PATCH_BITS

_FRAMES = 2**63


@dataclass(frozen=True)
class DepthNoiseParameters:
    """The noise of a depth camera. Lengths in metres, angles in radians.

    The deviation along the optical axis, of what the camera tells, at depth z and incidence
    theta (Nguyen et al., who measured up to 80 deg):

        sigma_z = axial_offset + axial_growth (z - axial_depth)^2
                  + axial_angle / sqrt(z) (theta / (pi/2 - theta))^2

    Attributes:
        axial_offset: least deviation of depth [m] (Nguyen et al.).
        axial_growth: its growth with the square of depth [1/m] (Nguyen et al.).
        axial_depth: depth of the least deviation [m] (Nguyen et al.).
        axial_angle: its growth with incidence [m^1.5] (Nguyen et al.).
        lateral: deviation of an edge's place in the image [pixel] (Nguyen et al.: 0.8 at
            normal incidence; its growth with the angle, under 0.1 up to 65 deg, is left
            out). It acts at edges only, and at most 2 pixels far: on a plane it is part of
            sigma_z.
        correlation_u: pixels along a row over which the axial noise is smooth; 1 makes
            every pixel independent. The scans' residuals from the table, less their mean
            over 21 x 21 pixels, are correlated by 0.72 at one pixel, 0.38 at four, 0.08 at
            eight.
        correlation_v: the same along a column: 0.57 at one pixel, 0.12 at three, -0.02 at
            four.
        baseline: from camera to projector, which is on its right [m] (Khoshelham and Oude
            Elberink: 0.075).
        subpixels: steps of disparity a pixel (Khoshelham and Oude Elberink: 8). A step is
            z^2 / (subpixels f baseline) of depth: 2.9 mm at 1 m with f = 577 pixels.
        unit: of the depths that the driver hands out [m] (OpenNI: millimetres).
        near: what is nearer is missing [m] (the nearest points of the scans: 0.50).
        far: what is farther is missing [m] (Khoshelham and Oude Elberink: 5).
        grazing_start: incidence from which pixels begin to be missing [rad].
        grazing_end: incidence from which all are [rad] (Nguyen et al. measured up to 80 deg).
        edge_jump: difference of neighbouring depths that is an edge, as a share of depth: a
            plane seen at 85 deg.
        edge_dropout: share of the pixels beside an edge that are missing, in patches (a
            judgement by the scans).
        flying: share of the pixels beside an edge whose depth lies between the two
            surfaces (a judgement by the scans).
        shadows: whether what the projector does not light is missing: left of edges.
    """

    axial_offset: float = 0.0012
    axial_growth: float = 0.0019
    axial_depth: float = 0.4
    axial_angle: float = 0.0001
    lateral: float = 0.8
    correlation_u: int = 5
    correlation_v: int = 3
    baseline: float = 0.075
    subpixels: float = 8.0
    unit: float = 0.001
    near: float = 0.5
    far: float = 5.0
    grazing_start: float = math.radians(70.0)
    grazing_end: float = math.radians(80.0)
    edge_jump: float = 0.02
    edge_dropout: float = 0.2
    flying: float = 0.1
    shadows: bool = True

    def __post_init__(self) -> None:
        """Checks the ranges.

        Raises:
            ValueError: naming the field and what would be valid.
        """
        for item in fields(self):
            value = getattr(self, item.name)
            low, high = RANGES.get(item.name, (0.0, 1.0))
            if not low <= value <= high:
                raise ValueError(f"{item.name} must lie in [{low:g}, {high:g}], not {value}")
        for name in ("correlation_u", "correlation_v"):
            if getattr(self, name) != int(getattr(self, name)):
                raise ValueError(f"{name} must be a whole number, not {getattr(self, name)}")
        for first, second in (("near", "far"), ("grazing_start", "grazing_end")):
            low, high = getattr(self, first), getattr(self, second)
            if not low < high:
                raise ValueError(f"{first} must be below {second}, not {low} and {high}")


RANGES: dict[str, tuple[float, float]] = {
    "axial_offset": (0.0, 0.1),
    "axial_growth": (0.0, 0.1),
    "axial_depth": (0.0, 10.0),
    "axial_angle": (0.0, 0.01),
    "lateral": (0.0, 2.0),
    "correlation_u": (1, 64),
    "correlation_v": (1, 64),
    "baseline": (0.01, 1.0),
    "subpixels": (1.0, 1000.0),
    "unit": (1e-5, 0.1),
    "near": (0.05, 20.0),
    "far": (0.05, 20.0),
    "grazing_start": (0.0, 0.5 * math.pi),
    "grazing_end": (0.0, 0.5 * math.pi),
    "edge_jump": (0.001, 1.0),
    "edge_dropout": (0.0, 1.0),
    "flying": (0.0, 1.0),
}
"""Field of `DepthNoiseParameters` -> its lowest and highest value."""


def axial_deviation(
    depth: ArrayLike, incidence: ArrayLike, parameters: DepthNoiseParameters | None = None
) -> NDArray[np.float64]:
    """Standard deviation of measured depth [m]: sigma_z of `DepthNoiseParameters`.

    Args:
        depth: true depth [m], any shape.
        incidence: angle between the ray and the surface's normal [rad], below pi / 2.
        parameters: of the camera; None for the defaults.
    """
    p = parameters or DepthNoiseParameters()
    z, theta = np.asarray(depth, dtype=float), np.asarray(incidence, dtype=float)
    steep = theta / (0.5 * math.pi - theta)
    flat = p.axial_offset + p.axial_growth * (z - p.axial_depth) ** 2
    return np.asarray(flat + p.axial_angle / np.sqrt(z) * steep**2)


def disparity_step(
    depth: ArrayLike, focal: float, parameters: DepthNoiseParameters | None = None
) -> NDArray[np.float64]:
    """Difference of depth between two steps of disparity [m], z^2 / (subpixels f b).

    Args:
        depth: [m], any shape.
        focal: focal length of the camera [pixel].
        parameters: of the camera; None for the defaults.
    """
    p = parameters or DepthNoiseParameters()
    return np.asarray(np.asarray(depth, float) ** 2 / (p.subpixels * focal * p.baseline))


class NoiseRoom:
    """Arrays that `add_depth_noise` works in; what they hold before and after is of no meaning.

    Kept between images, their memory need not be asked of the operating system anew.

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
    parameters: DepthNoiseParameters | None = None,
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
    p = parameters or DepthNoiseParameters()
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
    packed = _packed(p, float(camera[0]))
    add_noise(out, camera, int(seed), int(frame), packed, room.w, room.valid, room.marks)
    return out


class FrameNoise:
    """The noise of one camera, image after image; what time it was taken tells them apart."""

    def __init__(
        self, K: ArrayLike, parameters: DepthNoiseParameters | None = None, *, seed: int = 0
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
        self._parameters = parameters or DepthNoiseParameters()
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


def _packed(p: DepthNoiseParameters, focal: float) -> NDArray[np.float32]:
    """The parameters in the order of `depth_noise_kernels.add_noise`."""
    holes = min(max(p.edge_dropout, 1e-9), 1.0 - 1e-9)
    return np.array(
        [
            p.near,
            p.far,
            p.axial_offset,
            p.axial_growth,
            p.axial_depth,
            p.axial_angle,
            1.0 / (p.subpixels * focal * p.baseline),
            p.unit,
            p.edge_jump,
            math.cos(p.grazing_start),
            math.cos(p.grazing_end),
            p.lateral,
            NormalDist().inv_cdf(holes),
            p.flying,
            1.0 / p.far,
            focal * p.baseline if p.shadows else 0.0,
            p.correlation_u,
            p.correlation_v,
        ],
        dtype=np.float32,
    )
