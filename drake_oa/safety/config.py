"""Configuration of safety: a scenario's fields `supervisor` and `guard`.

`SupervisorSettings` adds the values that follow from the rest of a scenario.
"""

import dataclasses as dc
from typing import Annotated, Any

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK, above


@dataclass(config=BLOCK)
class SupervisorParameters:
    """Limits at which the supervisor slows, holds or stops the robot's motion."""

    stale_frames: float = Field(default=2.5, ge=1.0, le=1e6)
    """Number of missing frames after which the motion slows down [1]; at the age
    `policy.max_observation_age` it is held. Raising it tolerates longer gaps in perception."""
    saturation_time: float = Field(default=0.1, gt=0.0, le=10.0)
    """Duration of torque saturation after which the motion slows down [s]. Raising it tolerates
    longer saturation."""
    back_off: float = Field(default=0.7, gt=0.0, le=1.0)
    """Factor by which each period of torque saturation reduces the speed [1]. Raising it slows
    down less."""
    slowest: float = Field(default=0.1, gt=0.0, le=1.0)
    """Minimum fraction of full speed to which old frames, torque saturation and joint speed limits
    slow the motion [1]. Raising it slows down less."""
    recovery_time: float = Field(default=0.3, gt=0.0, le=60.0)
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

    frame_period: float = Field(default=1.0 / 15.0, gt=0.0, le=100.0)
    """Time between two observations [s]. Raising it expects fewer frames."""
    max_age: float = Field(default=0.5, gt=0.0, le=1e6)
    """Age of the last observation above which the motion is held [s]. Raising it tolerates longer
    gaps in perception."""


@dataclass(config=BLOCK)
class GuardParameters:
    """Search for joint motions among moving obstacles, and reaction to contact."""

    horizon: float = Field(default=1.4, gt=0.1, le=10.0)
    """Time over which motions are predicted [s]. Raising it reacts earlier and takes longer."""
    candidates: int = Field(default=96, ge=16, le=10_000)
    """Number of maneuvers in a decision [1]. Raising it finds more ways and takes longer."""
    refinements: int = Field(default=48, ge=0, le=10_000)
    """Number of variations of the best maneuvers [1]. Raising it finds better ones and takes
    longer."""
    speed_share: float = Field(default=0.5, gt=0.0, le=1.0)
    """Fraction of the joints' speed limits that maneuvers may use [1]. Raising it evades faster."""
    acceleration: float = Field(default=5.0, gt=0.0, le=100.0)
    """Maximum joint acceleration of maneuvers [rad/s^2]. Raising it evades faster."""
    acceleration_limit: float = Field(default=10.0, gt=0.0, le=1000.0)
    """Maximum joint acceleration of the commanded motion [rad/s^2]. Raising it follows sharp turns
    more closely."""
    margin_moving: float = Field(default=0.12, gt=0.0, le=1.0)
    """Distance to a moving obstacle below which nearness costs [m]. Raising it keeps farther
    away."""
    margin_resting: float = Field(default=0.03, gt=0.0, le=1.0)
    """Distance to resting obstacles below which nearness costs a maneuver [m]. Raising it keeps
    farther away."""
    touch_moving: float = Field(default=0.012, ge=0.0, le=1.0)
    """Distance to a moving obstacle below which a motion counts as contact [m]. Raising it keeps
    farther away."""
    touch_resting: float = Field(default=0.004, ge=0.0, le=1.0)
    """Distance to a resting obstacle below which a motion counts as contact, unless the verified
    motion keeps less [m]. Raising it keeps farther away."""
    growth: float = Field(default=0.1, ge=0.0, le=2.0)
    """Rate at which the margin of moving obstacles grows with the time ahead [m/s]. Raising it
    expects larger changes of their velocity."""
    decay: float = Field(default=0.8, gt=0.0, le=10.0)
    """Time ahead after which a contact costs 1 / e as much [s]. Raising it considers later
    contacts."""
    contact_weight: float = Field(default=60.0, ge=0.0, le=1e6)
    """Cost of a contact [1]. Raising it accepts longer delays to avoid one."""
    moving_weight: float = Field(default=6.0, ge=0.0, le=1e6)
    """Cost of nearness to moving obstacles [1]. Raising it keeps farther away."""
    resting_weight: float = Field(default=2.0, ge=0.0, le=1e6)
    """Cost of nearness to resting obstacles [1]. Raising it keeps farther away."""
    hysteresis: float = Field(default=0.1, ge=0.0, le=10.0)
    """Delay by which another maneuver must be better than the one in use [s]. Raising it changes
    less often."""
    contact_error: float = Field(default=0.05, gt=0.0, le=1.0)
    """Tracking error of a joint at which the arm counts as pushed, and the desired motion begins
    anew from the measured configuration [rad]. Raising it tolerates larger errors."""
    contact_time: float = Field(default=0.5, ge=0.0, le=60.0)
    """Time after a contact in which the arm moves slowly [s]. Raising it waits longer."""
    obstacle_speed: float = Field(default=0.0, ge=0.0, le=10.0)
    """Maximum speed V of obstacles for which passive motion safety is claimed [m/s]; 0: obstacles
    are taken to rest unless they are seen to move. Raising it keeps farther from moving obstacles
    and moves more slowly near space that is not seen."""
    v_unseen: float = Field(default=0.25, gt=0.0, le=2.0)
    """Maximum speed of any point of the arm toward space that is not seen, and after a contact
    [m/s]. Raising it moves faster."""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    """Seed of the random maneuvers [1]."""


def settings(parameters: Any, **derived: float) -> dict[str, Any]:
    """Returns the fields of a block by name, with other values added."""
    return {item.name: getattr(parameters, item.name) for item in dc.fields(parameters)} | derived
