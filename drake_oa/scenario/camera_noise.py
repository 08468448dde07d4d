"""The noise of a structured-light depth camera: its parameters."""

import dataclasses as dc
import math
from dataclasses import dataclass, fields
from typing import Any

from drake_oa.common.scenario_fields import count, number
from drake_oa.common.schema_check import ScenarioError


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


_NOISE = DepthNoiseParameters()


def _noise(name: str, unit: str) -> Any:
    return number(getattr(_NOISE, name), unit, *RANGES[name])


@dc.dataclass
class CameraNoise:
    """Noise of a structured-light camera: see `DepthNoiseParameters` for the model."""

    # Deviation along the optical axis: offset + growth (z - depth)^2, and more at an angle.
    axial_offset: float = _noise("axial_offset", "m")
    axial_growth: float = _noise("axial_growth", "1/m")
    axial_depth: float = _noise("axial_depth", "m")
    axial_angle: float = _noise("axial_angle", "m^1.5")
    # Deviation of an edge's place in the image [pixel].
    lateral: float = _noise("lateral", "pixel")
    # Pixels over which the axial noise is smooth, along rows and columns.
    correlation_u: int = count(_NOISE.correlation_u, 1, 64)
    correlation_v: int = count(_NOISE.correlation_v, 1, 64)
    # From camera to projector [m], and steps of disparity a pixel.
    baseline: float = _noise("baseline", "m")
    subpixels: float = _noise("subpixels", "1/pixel")
    # Unit in which the driver hands out depths [m].
    unit: float = _noise("unit", "m")
    # What is nearer or farther is missing [m]; so is what the camera's own range leaves out.
    near: float = _noise("near", "m")
    far: float = _noise("far", "m")
    # Incidence at which pixels begin to be missing, and from which all are [rad].
    grazing_start: float = _noise("grazing_start", "rad")
    grazing_end: float = _noise("grazing_end", "rad")
    # Difference between neighbours that is an edge, as a share of depth.
    edge_jump: float = _noise("edge_jump", "1")
    # Shares of the pixels beside an edge: missing, and between both surfaces.
    edge_dropout: float = _noise("edge_dropout", "1")
    flying: float = _noise("flying", "1")
    # Whether what the projector does not light is missing.
    shadows: bool = _NOISE.shadows


def noise_parameters(noise: CameraNoise) -> DepthNoiseParameters:
    """The camera's noise as the model takes it.

    Raises:
        ScenarioError: for limits that do not fit each other.
    """
    try:
        return DepthNoiseParameters(**vars(noise))
    except ValueError as error:
        raise ScenarioError(f"perception.noise.{error}") from None
