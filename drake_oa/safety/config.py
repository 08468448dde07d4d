"""Configuration of safety: the block `guard` of a scenario."""

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK


@dataclass(config=BLOCK)
class GuardParameters:
    """Parameters of the motion guard: search, contact reaction, and old observations."""

    candidates: int = Field(default=96, ge=16, le=10_000)
    """Number of candidate maneuvers in a decision [1]. Raising it searches more widely and takes
    longer."""
    refinements: int = Field(default=48, ge=0, le=10_000)
    """Number of variations of the best maneuvers in a decision [1]. Raising it finds better
    maneuvers and takes longer."""
    speed_fraction: float = Field(default=0.5, gt=0.0, le=1.0)
    """Fraction of the joint speed limits that maneuvers may use [1]. Raising it evades faster."""
    acceleration: float = Field(default=5.0, gt=0.0, le=100.0)
    """Maximum joint acceleration of maneuvers [rad/s^2]. Raising it evades faster."""
    acceleration_limit: float = Field(default=10.0, gt=0.0, le=1000.0)
    """Maximum joint acceleration of the commanded motion [rad/s^2]. Raising it follows sharp turns
    more closely."""
    margin_moving: float = Field(default=0.12, gt=0.0, le=1.0)
    """Clearance margin to moving obstacles below which proximity costs [m]. Raising it increases
    the distance to them."""
    contact_error: float = Field(default=0.05, gt=0.0, le=1.0)
    """Tracking error of a joint at which a contact is detected, and the command restarts from the
    measured configuration [rad]; a feedback torque equivalent to 0.6 times this error is a contact
    too. Raising it tolerates larger errors."""
    contact_time: float = Field(default=0.5, ge=0.0, le=60.0)
    """Time after a contact in which the speed is limited [s]. Raising it limits longer."""
    obstacle_speed: float = Field(default=0.0, ge=0.0, le=10.0)
    """Maximum speed V of obstacles for which passive motion safety is claimed [m/s]; 0: no claim,
    obstacles count as at rest unless they are observed to move. Raising it increases the distance
    to moving obstacles, and reduces the speed near unobserved space."""
    v_unseen: float = Field(default=0.25, gt=0.0, le=2.0)
    """Maximum speed of any point of the arm toward unobserved space, and after a contact [m/s].
    Raising it moves faster."""
    stale_frames: float = Field(default=2.5, ge=1.0, le=1e6)
    """Number of missing frames after which the motion slows down [1]; above the age
    `policy.max_observation_age` it is held. Raising it tolerates longer gaps in perception."""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    """Seed of the random candidate maneuvers [1]."""
