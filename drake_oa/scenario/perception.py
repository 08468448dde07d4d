"""Given obstacles, and what no single field of a scenario's cameras and perception can tell."""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
from collections.abc import Sequence

from pydrake.systems.sensors import CameraConfig

from drake_oa.common.config import ScenarioError, check_values, vector
from drake_oa.perception.config import DepthCamera, GroundTruth, RecordedClouds

_MOST_PIXELS = 4096
"""Most columns or rows of a simulated image."""


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
    check_values(perception, "perception")
    if isinstance(perception, RecordedClouds) and not perception.folder:
        raise ScenarioError("perception.folder: is empty; it must name a folder of recordings")
    if isinstance(perception, GivenEllipsoids):
        for row, item in enumerate(perception.ellipsoids):
            if min(item.semi_axes) <= 0.0:
                raise ScenarioError(
                    f"perception.ellipsoids[{row}].semi_axes: {item.semi_axes} "
                    "must all be positive [m]"
                )
