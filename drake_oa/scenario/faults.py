"""Faults injected into a simulation: the blocks of a scenario's field `faults`."""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK, Vector3

_Time = Annotated[float, Field(ge=0.0, le=1e6)]
"""Type of a simulated time [s]."""
_Duration = Annotated[float, Field(gt=0.0, le=1e6)]
"""Type of a duration [s]."""


@dataclass(config=BLOCK)
class CameraDropout:
    """Fault of a camera: no new images; the driver repeats the last image."""

    start: _Time = 1.0
    """Time at which the images stop [s]. Raising it makes the fault later."""
    duration: _Duration = 0.5
    """Time without new images [s]. Raising it makes the fault longer."""
    camera: str = ""
    """Name of the camera; empty: all cameras in use."""


@dataclass(config=BLOCK)
class TorqueSaturation:
    """Fault of the actuators: reduced effort limits, unknown to the controller."""

    start: _Time = 1.0
    """Time at which the limits drop [s]. Raising it makes the fault later."""
    duration: _Duration = 1.0
    """Time with reduced limits [s]. Raising it makes the fault longer."""
    scale: float = Field(default=0.4, ge=0.0, le=1.0)
    """Remaining fraction of the effort limits [1]. Raising it makes the fault milder."""


@dataclass(config=BLOCK)
class ModelError:
    """Fault of the controller: inertial parameters that differ from the simulated robot's."""

    inertias: str = "package://drake_oa/panda/uniform_density.yaml"
    """File of inertial parameters (see `drake_oa.robot.inertias`): a package:// URL or a path. The
    default is that of a Panda with links of uniform density."""


@dataclass(config=BLOCK)
class Push:
    """Fault of the environment: constant external wrench on a robot link for a limited time."""

    start: _Time = 1.0
    """Time at which the wrench begins [s]. Raising it makes the fault later."""
    duration: _Duration = 0.2
    """Duration of the wrench [s]. Raising it makes the fault longer."""
    force: Vector3 = Field(default=[0.0, 20.0, 0.0])
    """Force at the origin of the link, in the world [N]. Raising it makes the push stronger."""
    torque: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Torque on the link, in the world [N m]. Raising it makes the push stronger."""
    body: str = ""
    """Name of the link; empty: the robot's `hand_link`."""


Fault = CameraDropout | TorqueSaturation | ModelError | Push
"""Union of the fault blocks."""
