"""Given obstacles, and what no single field of a scenario's cameras and perception can tell."""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
from collections.abc import Sequence

from pydrake.systems.sensors import CameraConfig

from drake_oa.common.config import (
    ScenarioError,
    check_lcm_url,
    check_values,
    roll_pitch_yaw,
    vector,
)
from drake_oa.perception.config import (
    CameraSource,
    LcmCamera,
    LiveCameras,
    RealSense,
    RecordedClouds,
)

_MOST_PIXELS = 4096
"""Most columns or rows of a simulated image."""


@dc.dataclass
class EllipsoidConfig:
    """One given ellipsoid, already dilated."""

    center: list[float] = vector([0.0, 0.0, 0.0], "m")
    semi_axes: list[float] = vector([0.1, 0.1, 0.1], "m")
    rpy: list[float] = roll_pitch_yaw([0.0, 0.0, 0.0])


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


def check_perception(perception: object, cameras: Sequence[CameraConfig]) -> None:
    """What no single field of a `perception` block can tell.

    Args:
        perception: the block.
        cameras: of the scenario.

    Raises:
        ScenarioError: naming the field and what would be valid.
    """
    if isinstance(perception, CameraSource):
        _check_seeing(perception, cameras)
    check_values(perception, "perception")
    if isinstance(perception, LiveCameras) and perception.noise is not None:
        raise ScenarioError(
            f"perception.noise: images of !{type(perception).__name__} have their own; "
            "leave it out, or null"
        )
    if isinstance(perception, LcmCamera):
        check_lcm_url(perception.lcm_url, "perception.lcm_url")
    if isinstance(perception, RealSense):
        _check_serials(perception)
    if isinstance(perception, RecordedClouds) and not perception.folder:
        raise ScenarioError("perception.folder: is empty; it must name a folder of recordings")
    if isinstance(perception, GivenEllipsoids):
        for row, item in enumerate(perception.ellipsoids):
            if min(item.semi_axes) <= 0.0:
                raise ScenarioError(
                    f"perception.ellipsoids[{row}].semi_axes: {item.semi_axes} "
                    "must all be positive [m]"
                )


def _check_serials(perception: RealSense) -> None:
    """Whether each camera is one device, which is another's at most."""
    names, serials = perception.names, perception.serials
    for name in serials:
        if name not in names:
            raise ScenarioError(
                f"perception.serials.{name}: perception does not see by '{name}', but by "
                f"{', '.join(names)}"
            )
    missing = [name for name in names if not serials.get(name)]
    if missing and len(names) > 1:
        raise ScenarioError(
            f"perception.serials: '{missing[0]}' has none; of several cameras each needs the "
            "serial number of its device"
        )
    if len(set(serials.values())) < len(serials):
        raise ScenarioError("perception.serials: two cameras have the same; each is a device")


def _check_seeing(perception: CameraSource, cameras: Sequence[CameraConfig]) -> None:
    """Whether the cameras that perception names are there, and go together."""
    names = perception.cameras
    if names and perception.camera != CameraSource.camera:
        raise ScenarioError(
            f"perception.camera: '{perception.camera}' and perception.cameras: {names} exclude "
            "each other: name one camera or several"
        )
    known = {camera.name: row for row, camera in enumerate(cameras)}
    for row, name in enumerate(perception.names):
        field = f"perception.cameras[{row}]" if names else "perception.camera"
        if name not in known:
            raise ScenarioError(
                f"{field}: there is no camera '{name}'; cameras has {', '.join(known) or 'none'}"
            )
        if names.count(name) > 1:
            raise ScenarioError(f"{field}: '{name}' is named twice")
    first = cameras[known[perception.names[0]]]
    for name in perception.names[1:]:
        for field, unit in (("fps", "1/s"), ("output_delay", "s")):
            own, other = getattr(cameras[known[name]], field), getattr(first, field)
            if own != other:
                raise ScenarioError(
                    f"cameras[{known[name]}].{field}: '{name}' has {own:g}, '{first.name}' "
                    f"{other:g} [{unit}]; cameras that perception.cameras names take their images "
                    "at the same times"
                )
