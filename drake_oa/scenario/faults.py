"""The faults that a scenario asks for: what goes wrong, and when."""

import dataclasses as dc
from collections.abc import Sequence
from typing import Any

from drake_oa.common.config import count, number, vector

_LATEST = 1e6
_CAMERA = ""
"""Name of the camera that it befalls; empty: all that perception sees by."""


def _start(default: float) -> Any:
    return number(default, "s", 0.0, _LATEST)


def _duration(default: float) -> Any:
    return number(default, "s", 0.0, _LATEST, open_low=True)


@dc.dataclass
class CameraDropout:
    """The camera delivers no new image; its driver goes on handing out the last one."""

    start: float = _start(1.0)
    duration: float = _duration(0.5)
    camera: str = _CAMERA


@dc.dataclass
class NanFrames:
    """No pixel of the images has a depth: all are NaN."""

    start: float = _start(1.0)
    duration: float = _duration(0.5)
    camera: str = _CAMERA


@dc.dataclass
class FrameBurst:
    """Images are withheld, then delivered late, in their order, a frame a period.

    The image at t in [start + duration, start + 2 duration) is that of t - duration;
    those taken in that time are lost, as from a driver's full queue.
    """

    start: float = _start(1.0)
    # The frames of this time are kept in memory.
    duration: float = number(0.4, "s", 0.0, 5.0, open_low=True)
    camera: str = _CAMERA


@dc.dataclass
class TableMissing:
    """The table's pixels are NaN in the first frames from `start` on."""

    start: float = _start(1.0)
    frames: int = count(1, 1, 1_000_000)
    camera: str = _CAMERA


@dc.dataclass
class GoalBlocked:
    """A ball comes over the goal from beyond it, stays for `duration`, and leaves again."""

    start: float = _start(1.0)
    duration: float = _duration(2.0)
    # Of the ball, whose centre comes to the goal [m].
    radius: float = number(0.06, "m", 0.0, 0.5, open_low=True)


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
class StartInContact:
    """A thin plate, fixed to the world, touches the tool where it starts.

    It stands behind the tool, on the side away from the goal.
    """

    # How far the plate and the tool overlap at the start [m].
    depth: float = number(0.0005, "m", 0.0, 0.01, open_low=True)


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


CameraFault = CameraDropout | NanFrames | FrameBurst | TableMissing


# Written out: yaml_load_typed reads the tags' types from it.
Fault = (
    CameraDropout
    | NanFrames
    | FrameBurst
    | TableMissing
    | GoalBlocked
    | TorqueSaturation
    | ModelError
    | StartInContact
    | Push
)


def camera_faults(faults: Sequence[Fault]) -> tuple[CameraFault, ...]:
    """Those that befall the camera."""
    return tuple(fault for fault in faults if isinstance(fault, CameraFault))
