"""The faults that a scenario asks for: what goes wrong, and when."""

import dataclasses as dc
from typing import Any

from drake_oa.common.config import number, vector

_LATEST = 1e6


def _start(default: float) -> Any:
    return number(default, "s", 0.0, _LATEST)


def _duration(default: float) -> Any:
    return number(default, "s", 0.0, _LATEST, open_low=True)


@dc.dataclass
class CameraDropout:
    """The camera delivers no new image; its driver goes on handing out the last one."""

    start: float = _start(1.0)
    duration: float = _duration(0.5)
    # Name of the camera that fails; empty: all that perception sees by.
    camera: str = ""


@dc.dataclass
class TorqueSaturation:
    """The actuators give no more than `scale` of their effort limits, and nobody is told."""

    start: float = _start(1.0)
    duration: float = _duration(1.0)
    scale: float = number(0.4, "1", 0.0, 1.0)


@dc.dataclass
class ModelError:
    """The controller takes the robot's links for others; the plant keeps the model's own."""

    # URL or name of a file of inertias, see `drake_oa.robot.inertias`. The default takes the
    # Panda's links for bodies of uniform density.
    inertias: str = "package://drake_oa/panda/uniform_density.yaml"


@dc.dataclass
class Push:
    """Somebody pushes a link of the robot, with a wrench that is constant while it lasts."""

    start: float = _start(1.0)
    duration: float = _duration(0.2)
    # In the world, at the origin of the link.
    force: list[float] = vector([0.0, 20.0, 0.0], "N")
    torque: list[float] = vector([0.0, 0.0, 0.0], "N m")
    # The link; empty: the robot's `hand_link`.
    body: str = ""


# Written out: yaml_load_typed reads the tags' types from it.
Fault = CameraDropout | TorqueSaturation | ModelError | Push
