"""Configuration of safety: a scenario's fields `supervisor` and `evasion`.

The systems add the values that follow from the rest of a scenario: `SupervisorSettings`,
`EvasionSettings`.
"""

import dataclasses as dc
from typing import Annotated, Any

import numpy as np
from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK, above, length
from drake_oa.common.messages import FloatArray


@dataclass(config=BLOCK)
class SupervisorParameters:
    """Limits at which the supervisor slows, holds or stops the robot's motion."""

    stop_distance: float = Field(default=0.025, ge=0.0, le=1.0)
    """Distance of a link to an obstacle or the table at which its approach has come to rest [m].
    Raising it stops farther away."""
    lag: float = Field(default=0.05, ge=0.0, le=10.0)
    """Time by which the controller comes to rest later than the motion, which takes
    `policy.hold_time` [s]. Raising it slows down earlier."""
    leave_scale: float = Field(default=0.3, gt=0.0, le=1.0)
    """Maximum fraction of full speed at which a link inside the stop distance moves away [1]; a
    held motion needs `resume_above`. Raising it moves away faster."""
    stale_frames: float = Field(default=2.5, ge=1.0, le=1e6)
    """Number of missing frames after which the motion slows down [1]; at the age
    `policy.max_observation_age` it is held. Raising it tolerates longer gaps in perception."""
    joint_margin: float = Field(default=0.02, ge=0.0, le=3.0)
    """Distance to a joint's position limit at which the approach to it has come to rest [rad].
    Raising it stops farther from the limit."""
    tracking_slow: float = Field(default=0.02, gt=0.0, le=1.0)
    """Tracking error of the tool point above which the motion slows down [m]. Raising it tolerates
    larger errors."""
    tracking_hold: Annotated[float, above("tracking_slow")] = Field(default=0.05, gt=0.0, le=1.0)
    """Tracking error of the tool point above which the motion is held [m]. Raising it tolerates
    larger errors."""
    saturation_time: float = Field(default=0.1, gt=0.0, le=10.0)
    """Duration of torque saturation after which the motion slows down [s]. Raising it tolerates
    longer saturation."""
    back_off: float = Field(default=0.7, gt=0.0, le=1.0)
    """Factor by which each period of torque saturation reduces the speed [1]. Raising it slows
    down less."""
    slowest: float = Field(default=0.1, gt=0.0, le=1.0)
    """Minimum fraction of full speed to which old frames, torque saturation and joint speed limits
    slow the motion [1]. Raising it slows down less."""
    recovery_time: float = Field(default=1.0, gt=0.0, le=60.0)
    """Time in which the speed rises from rest to full speed [s]. Raising it resumes more gently."""
    hold_below: float = Field(default=0.05, gt=0.0, le=1.0)
    """Allowed fraction of full speed below which the motion is held [1]. Raising it holds
    earlier."""
    resume_above: Annotated[float, above("hold_below")] = Field(default=0.3, gt=0.0, le=0.999)
    """Allowed fraction of full speed above which a held motion resumes [1]. Raising it resumes
    later."""
    patience: float = Field(default=3.0, gt=0.0, le=600.0)
    """Duration after which a hold that cannot end by itself becomes a stop [s]. Raising it waits
    longer."""
    dwell: float = Field(default=0.5, ge=0.0, le=60.0)
    """Minimum time between two logged events of the same action [s]. Raising it logs fewer
    events."""


@dataclass(config=BLOCK)
class SupervisorSettings(SupervisorParameters):
    """Parameters of the supervisor with the values that follow from the rest of the scenario."""

    padding: float = Field(default=0.005, ge=0.0, le=1.0)
    """Distance by which moving obstacles may be closer than observed [m]. Raising it stops
    farther away."""
    reaction_time: float = Field(default=0.3, gt=0.0, le=100.0)
    """Time in which the motion comes to rest from full speed [s]. Raising it slows down earlier."""
    hold_time: float = Field(default=0.25, gt=0.0, le=10.0)
    """Part of the reaction time that the motion takes [s]. Raising it slows down earlier."""
    period: float = Field(default=0.008, gt=0.0, le=100.0)
    """Time between two checks [s]. Raising it reacts later."""
    frame_period: float = Field(default=1.0 / 15.0, gt=0.0, le=100.0)
    """Time between two observations [s]. Raising it expects fewer frames."""
    max_age: float = Field(default=0.5, gt=0.0, le=1e6)
    """Age of the last observation above which the motion is held [s]. Raising it tolerates longer
    gaps in perception."""


@dataclass(config=BLOCK)
class EvasionParameters:
    """Parameters of the evasive motion in front of moving obstacles."""

    margin: float = Field(default=0.05, gt=0.0, le=1.0)
    """Predicted distance of a link to a moving obstacle below which the arm evades [m]. Raising it
    evades earlier and more often."""
    release: float = Field(default=0.02, ge=0.0, le=1.0)
    """Additional distance at which the evasion ends [m]. Raising it ends later."""
    notice: float = Field(default=0.7, gt=0.0, le=10.0)
    """Prediction horizon in which the nominal motion must keep the margin [s]. Raising it evades
    earlier."""
    horizon: float = Field(default=1.2, ge=0.7, le=10.0)
    """Minimum prediction horizon of the evasive motions [s]. Raising it looks farther ahead."""
    instants: int = Field(default=12, ge=2, le=1000)
    """Number of predicted instants [1]. Raising it predicts more accurately and more slowly."""
    speed: float = Field(default=0.6, gt=0.0, le=5.0)
    """Maximum speed of the tool during evasion [m/s]. Raising it evades faster."""
    acceleration: float = Field(default=6.0, gt=0.0, le=50.0)
    """Maximum acceleration of the tool during evasion [m/s^2]. Raising it evades sooner and
    jerkier."""
    turn_speed: float = Field(default=1.5, ge=0.0, le=10.0)
    """Maximum norm of the joint velocity in the null space of the tool's task [rad/s]; 0: no such
    motion. Raising it moves the links aside faster."""
    turn_acceleration: float = Field(default=10.0, gt=0.0, le=100.0)
    """Maximum norm of the joint acceleration in the null space [rad/s^2]. Raising it moves the
    links aside sooner."""
    growth: float = Field(default=0.02, ge=0.0, le=1.0)
    """Growth of the uncertainty of a moving obstacle's predicted position [m/s]. Raising it keeps
    a larger distance to distant predictions."""
    table_allowance: float = Field(default=0.06, ge=0.0, le=1.0)
    """Amount by which a distance to the table counts more than one to an obstacle [m]. Raising it
    evades closer to the table."""
    joint_margin: float = Field(default=0.1, ge=0.0, le=3.0)
    """Minimum distance of evasive motions to the joints' position limits [rad]. Raising it leaves
    fewer motions."""
    speed_share: float = Field(default=0.9, gt=0.0, le=1.0)
    """Fraction of the joints' speed limits that evasive motions may use [1]. Raising it evades
    faster."""
    passing: float = Field(default=0.6, ge=0.0, le=1.0)
    """Fraction of the margin with which the nominal motion continues if no evasive motion is
    better [1]. Raising it evades more often."""
    as_good: float = Field(default=5e-3, ge=0.0, le=1.0)
    """Difference between clearances that are considered equal [m]. Raising it prefers shorter
    motions."""
    short_ways: Annotated[list[float], length(2)] = Field(default=[0.2, 0.08])
    """Displacements of the tool that are tried where larger ones leave the workspace [m]. Raising
    them moves farther aside."""
    short_turn: float = Field(default=0.7, gt=0.0, le=10.0)
    """Norm of the joint motion in the null space that is tried where larger ones leave the position
    limits [rad]. Raising it moves the links farther aside."""
    steady: float = Field(default=0.5, ge=0.0, le=100.0)
    """Cost of a change of velocity, relative to the velocity [1]. Raising it keeps the current
    evasive motion."""
    turning: float = Field(default=0.2, ge=0.0, le=100.0)
    """Cost of motion in the null space, relative to a displacement of the tool [m/rad]. Raising it
    prefers displacements of the tool."""
    along: float = Field(default=1.0, ge=0.0, le=100.0)
    """Cost of a velocity along that of the obstacle, relative to the velocity [1]. Raising it
    prefers to move sideways."""
    slow: float = Field(default=0.03, ge=0.0, le=1.0)
    """Speed below which a displacement does not count as leaving an obstacle at rest [m/s]. Raising
    it ignores slow motions."""

    @property
    def times(self) -> FloatArray:
        """(K,) predicted instants [s]."""
        return np.linspace(0.0, self.horizon, self.instants + 1)[1:]


@dataclass(config=BLOCK)
class EvasionSettings(EvasionParameters):
    """Parameters of the evasion with the values that follow from the rest of the scenario."""

    padding: float = Field(default=0.01, ge=0.0, le=1.0)
    """Distance by which moving obstacles may be closer than observed [m]. Raising it evades
    earlier."""
    hold_time: float = Field(default=0.25, gt=0.0, le=10.0)
    """Time in which the motion comes to rest [s]. Raising it evades earlier."""


def settings(parameters: Any, **derived: float) -> dict[str, Any]:
    """Returns the fields of a block by name, with other values added."""
    return {item.name: getattr(parameters, item.name) for item in dc.fields(parameters)} | derived
