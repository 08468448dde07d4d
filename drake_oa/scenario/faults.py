"""Configuration blocks of the faults that a simulation injects: the entries of a scenario's field
`faults`.
"""

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK, Vector3

_Time = Annotated[float, Field(ge=0.0, le=1e6)]
"""Type of a simulated time in the configuration block of a fault [s]."""
_Duration = Annotated[float, Field(gt=0.0, le=1e6)]
"""Type of the duration of a fault in its configuration block [s]."""


@dataclass(config=BLOCK)
class CameraDropout:
    """Fault block of a camera that delivers no new images for some time; its driver repeats the
    last image.
    """

    start: _Time = 1.0
    """Simulated time at which the camera stops delivering new images [s]."""
    duration: _Duration = 0.5
    """Time for which the camera delivers no new images [s]."""
    camera: str = ""
    """Name of the camera with the fault; empty: all cameras in use."""


@dataclass(config=BLOCK)
class TorqueSaturation:
    """Fault block of actuators with reduced effort limits, which the controller does not know."""

    start: _Time = 1.0
    """Simulated time at which the effort limits drop [s]."""
    duration: _Duration = 1.0
    """Time for which the effort limits are reduced [s]."""
    scale: float = Field(default=0.4, ge=0.0, le=1.0)
    """Fraction of the effort limits that remains during the fault [-]. Raising it makes the fault
    milder."""


@dataclass(config=BLOCK)
class ModelError:
    """Block of a scenario's `faults`: the controller's inertial parameters differ from those of the
    simulated robot.
    """

    inertias: str = "package://drake_oa/panda/uniform_density.yaml"
    """File of the controller's inertial parameters, as a package:// URL or a path. It is a YAML
    file with mass, center of mass and rotational inertia of each link. The default file describes a
    Panda with links of uniform density."""


@dataclass(config=BLOCK)
class Push:
    """Fault block of a constant external wrench that acts on a robot link for a limited time."""

    start: _Time = 1.0
    """Simulated time at which the wrench begins to act [s]."""
    duration: _Duration = 0.2
    """Time for which the wrench acts [s]. A longer push moves the arm farther from its path."""
    force: Vector3 = Field(default=[0.0, 20.0, 0.0])
    """Force of the wrench at the origin of the link's frame, in world axes [N]."""
    torque: Vector3 = Field(default=[0.0, 0.0, 0.0])
    """Torque of the wrench on the link, in world axes [N m]."""
    body: str = ""
    """Name of the link on which the wrench acts; empty: the robot's `hand_link`."""


Fault = CameraDropout | TorqueSaturation | ModelError | Push
"""Union type of the configuration blocks that are valid in the field `faults` of a scenario."""
