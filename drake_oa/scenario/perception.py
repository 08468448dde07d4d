"""The blocks of a scenario that say where its obstacles come from."""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
from collections.abc import Sequence
from typing import Any

from pydrake.common.schema import Transform
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.scenario_fields import number, vector
from drake_oa.common.schema_check import ScenarioError
from drake_oa.perception.segmentation import SegmentationConfig
from drake_oa.scenario.camera_noise import (
    CameraNoise,
    noise_parameters,
)

_MOST_PIXELS = 4096
"""Most columns or rows of a simulated image."""


@dc.dataclass
class DepthCamera:
    """Obstacles as a depth camera of `cameras` sees them."""

    camera: str = "camera"
    # Noise of the camera, {} for the published figures; null: an ideal camera.
    noise: CameraNoise | None = None
    # Changes to the segmentation's defaults: see `SegmentationConfig`.
    segmentation: dict[str, float] = dc.field(default_factory=dict)


@dc.dataclass
class GroundTruth:
    """Obstacles as SceneGraph knows them."""

    period: float = number(1.0 / 15.0, "s", 1e-3, 10.0)


@dc.dataclass
class RecordedClouds:
    """Obstacles from a folder of recorded clouds or depth images."""

    # Folder with .npz, .pcd or .ply files; relative to the scenario file.
    folder: str = ""
    # Pose of the camera in the world, for files that hold none; {} is the identity,
    # for clouds already in the world frame.
    X_WC: Transform | None = None
    period: float = number(1.0 / 15.0, "s", 1e-3, 10.0)
    # Whether the recording starts again when it has ended.
    loop: bool = False
    segmentation: dict[str, float] = dc.field(default_factory=dict)


@dc.dataclass
class EllipsoidConfig:
    """One given ellipsoid, already dilated."""

    center: list[float] = vector([0.0, 0.0, 0.0], "m")
    semi_axes: list[float] = vector([0.1, 0.1, 0.1], "m")
    rpy: list[float] = vector([0.0, 0.0, 0.0], "rad")


@dc.dataclass
class GivenEllipsoids:
    """The descriptors themselves: the action level alone, without perception."""

    ellipsoids: list[EllipsoidConfig] = dc.field(default_factory=list)


def check_cameras(cameras: Sequence[CameraConfig]) -> None:
    """What Drake's schema of a camera does not tell.

    Raises:
        ScenarioError: naming the field and what would be valid.
    """
    names = [camera.name for camera in cameras]
    for row, camera in enumerate(cameras):
        if names.count(camera.name) > 1:
            raise ScenarioError(
                f"cameras: two cameras are named '{camera.name}'; each needs its own name"
            )
        for field in ("width", "height"):
            pixels = getattr(camera, field)
            if not 1 <= pixels <= _MOST_PIXELS:
                raise ScenarioError(
                    f"cameras[{row}].{field}: {pixels} is outside [1, {_MOST_PIXELS}] [pixel]"
                )


def check_perception(
    perception: DepthCamera | GroundTruth | RecordedClouds | GivenEllipsoids,
    cameras: Sequence[str],
) -> None:
    """What no single field of a `perception` block can tell.

    Args:
        perception: the block.
        cameras: names of the scenario's cameras.

    Raises:
        ScenarioError: naming the field and what would be valid.
    """
    if isinstance(perception, DepthCamera) and perception.camera not in cameras:
        raise ScenarioError(
            f"perception.camera: there is no camera '{perception.camera}'; "
            f"cameras has {', '.join(cameras) or 'none'}"
        )
    if isinstance(perception, DepthCamera) and perception.noise is not None:
        noise_parameters(perception.noise)
    if isinstance(perception, (DepthCamera, RecordedClouds)):
        segmentation_config(perception.segmentation)
    if isinstance(perception, RecordedClouds) and not perception.folder:
        raise ScenarioError("perception.folder: is empty; it must name a folder of recordings")
    if isinstance(perception, GivenEllipsoids):
        for row, item in enumerate(perception.ellipsoids):
            if min(item.semi_axes) <= 0.0:
                raise ScenarioError(
                    f"perception.ellipsoids[{row}].semi_axes: {item.semi_axes} "
                    "must all be positive [m]"
                )


def segmentation_config(changes: dict[str, float], **defaults: Any) -> SegmentationConfig:
    """The segmentation's parameters with a scenario's changes.

    Raises:
        ScenarioError: for an unknown field or a value out of range.
    """
    values: dict[str, Any] = defaults | {
        name: int(value) if float(value).is_integer() else value for name, value in changes.items()
    }
    try:
        return SegmentationConfig(**values)
    except (TypeError, ValueError) as error:
        valid = ", ".join(item.name for item in dc.fields(SegmentationConfig))
        raise ScenarioError(f"perception.segmentation: {error}; fields: {valid}") from None
