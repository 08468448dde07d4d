"""Configuration block that gives obstacles as ellipsoids, without perception, and checks of the
fields `cameras` and `perception` of a scenario.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass
from pydrake.systems.sensors import CameraConfig

from drake_oa.common.config import BLOCK, Angles, Vector3, length
from drake_oa.perception.config import CameraSource, DepthCamera, RecordedBag

_MAX_PIXELS = 4096
"""Maximum width and height of a simulated image [pixel]."""


@dataclass(config=BLOCK)
class EllipsoidConfig:
    """Configuration block of one ellipsoid, which contains an obstacle dilated by the tool, so that
    the tool counts as a point.
    """

    center: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Position of the ellipsoid's center in the world [m]."""
    semi_axes: Annotated[list[Annotated[float, Field(gt=0.0)]], length(3)] = Field(
        default=[0.1, 0.1, 0.1]
    )
    """Lengths of the ellipsoid's three semi-axes [m]."""
    rpy: Angles = Field(default=[0.0, 0.0, 0.0])
    """Roll, pitch and yaw of the ellipsoid's semi-axes in the world [rad]."""


@dataclass(config=BLOCK)
class GivenEllipsoids:
    """Perception block that states the ellipsoids around the obstacles directly, without cameras or
    other perception.
    """

    ellipsoids: list[EllipsoidConfig] = Field(default_factory=list)
    """Ellipsoids around the obstacles, one per obstacle, already dilated by the tool."""


def perception_problems(perception: object, cameras: Sequence[CameraConfig]) -> Iterator[str]:
    """Yields one error line for each invalid field of a camera configuration, and for each invalid
    field `camera`, `cameras` or `noise` of the perception block.

    Args:
        perception: perception block of the scenario.
        cameras: field `cameras` of the scenario.
    """
    names = [camera.name for camera in cameras]
    for row, camera in enumerate(cameras):
        if camera.name in names[:row]:
            yield f"cameras[{row}].name: two cameras are named '{camera.name}'"
        for field in ("width", "height"):
            pixels = getattr(camera, field)
            if not 1 <= pixels <= _MAX_PIXELS:
                yield f"cameras[{row}].{field}: {pixels} is outside [1, {_MAX_PIXELS}] [pixel]"
        if not 0.0 < camera.fps < math.inf:
            yield f"cameras[{row}].fps: {camera.fps:g} must be positive and finite [Hz]"
    if isinstance(perception, CameraSource):
        yield from _camera_problems(perception, cameras)
        if type(perception) is not DepthCamera and perception.noise is not None:
            yield "perception.noise: only images of !DepthCamera have it; remove it, or set null"
    if isinstance(perception, RecordedBag) and perception.cameras:
        yield "perception.cameras: !RecordedBag replays one camera; set perception.camera"


def _camera_problems(perception: CameraSource, cameras: Sequence[CameraConfig]) -> Iterator[str]:
    """Yields one error line for each camera of a perception block that is missing in the scenario,
    repeated, or differs from the first camera in frame rate or delay, and one line if the block
    sets `camera` and `cameras`.
    """
    names = perception.cameras
    if names and perception.camera != CameraSource.camera:
        yield (
            f"perception.camera: '{perception.camera}' and perception.cameras: {names} exclude "
            "each other: name one camera or several"
        )
    known = {camera.name: row for row, camera in enumerate(cameras)}
    used = []
    for row, name in enumerate(perception.names):
        field = f"perception.cameras[{row}]" if names else "perception.camera"
        if name not in known:
            yield f"{field}: there is no camera '{name}'; cameras has {', '.join(known) or 'none'}"
        elif name in names[:row]:
            yield f"{field}: '{name}' is named twice"
        else:
            used.append(name)
    for name in used[1:]:
        for field, unit in (("fps", "1/s"), ("output_delay", "s")):
            value, first = (getattr(cameras[known[each]], field) for each in (name, used[0]))
            if value != first:
                yield (
                    f"cameras[{known[name]}].{field}: '{name}' has {value:g}, '{used[0]}' has "
                    f"{first:g} [{unit}]; all cameras of perception must have the same value"
                )
