"""Configuration of the motion guard, which commands the joints of the arm: the block `guard` of a
scenario file.
"""

from pydantic import Field
from pydantic.dataclasses import dataclass

from drake_oa.common.config import BLOCK


@dataclass(config=BLOCK)
class GuardParameters:
    """Parameters of the motion guard: search for evasive maneuvers, reaction to contact, and limits
    of the speed.

    The motion guard commands the joints of the arm. They follow the verified motion (checked by
    simulation), or a maneuver that evades moving obstacles.
    """

    candidates: int = Field(default=96, ge=16, le=10_000)
    """Number of candidate maneuvers (joint motions that evade obstacles) that the motion guard
    compares in each decision [-]. Raising it searches more widely and takes longer."""
    refinements: int = Field(default=48, ge=0, le=10_000)
    """Number of random variations of the best evasive maneuvers that the motion guard compares in
    each decision [-]. Raising it finds better maneuvers and takes longer."""
    speed_fraction: float = Field(default=0.5, gt=0.0, le=1.0)
    """Fraction of the joint speed limits that evasive maneuvers may use [-]. Raising it makes the
    arm evade faster."""
    acceleration: float = Field(default=5.0, gt=0.0, le=100.0)
    """Maximum joint acceleration of evasive maneuvers, braking included [rad/s^2]. Raising it makes
    the arm evade and brake faster."""
    acceleration_limit: float = Field(default=10.0, gt=0.0, le=1000.0)
    """Maximum joint acceleration of the command while it follows the verified motion (checked by
    simulation) [rad/s^2]. Raising it makes the command deviate less in sharp turns."""
    margin_moving: float = Field(default=0.12, gt=0.0, le=2.0)
    """Distance to moving obstacles, in addition to the required clearance, below which a predicted
    trajectory is penalized for proximity [m]. The diagram of a scenario replaces it by
    `task.clearance` if that is larger. Raising it makes the arm avoid moving obstacles at a larger
    distance."""
    contact_error: float = Field(default=0.05, gt=0.0, le=1.0)
    """Error between measured and commanded position of a joint above which a contact is detected
    [rad]. A contact is also detected if the feedback torque exceeds that of a constant error of 0.6
    times this value. The arm is then commanded to rest at its measured configuration. Raising it
    avoids false contacts, but detects contacts later."""
    contact_time: float = Field(default=0.5, ge=0.0, le=60.0)
    """Time after a contact during which the arm does not advance on the verified motion (checked by
    simulation), and maneuvers move no point of the arm faster than `v_unseen`, the maximum speed
    toward unobserved space [s]. Raising it makes the arm return to this motion more slowly."""
    obstacle_speed: float = Field(default=0.0, ge=0.0, le=10.0)
    """Maximum speed of obstacles that the checks of passive motion safety assume [m/s]; 0: no
    checks. With these checks, a part of the arm that a moving obstacle may reach at this speed is
    at rest or moves away from the obstacle. Raising it increases the distance to moving obstacles,
    and reduces the speed near unobserved space."""
    v_unseen: float = Field(default=0.25, gt=0.0, le=2.0)
    """Maximum speed of any point of the arm toward unobserved space, checked if `obstacle_speed` is
    not 0 [m/s]. In maneuvers after a contact, the limit applies in all directions. Raising it makes
    the arm faster in both cases."""
    stale_frames: float = Field(default=2.5, ge=1.0, le=1e6)
    """Age of the last observation, in periods of perception, above which the motion of the arm
    slows down [-]; more than 0.9 `policy.max_observation_age` has no effect. Above the age
    `policy.max_observation_age` the arm stops on its path until a new observation. Raising it
    tolerates longer gaps in perception."""
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    """Seed of the random numbers from which candidate maneuvers are drawn [-]; equal seeds
    reproduce the maneuvers."""
