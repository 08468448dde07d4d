"""The configuration of safety: the blocks `supervisor` and `evasion` of a scenario.

Every field has its unit and range, which `drake_oa.common.config` holds a file's blocks
against, and with `check_values` what Python code makes. What follows from the rest of a scenario
is added by the systems: `SupervisorSettings`, `EvasionSettings`.
"""

# No postponed annotations here: yaml_load_typed reads the fields' types.
import dataclasses as dc
from typing import Any

import numpy as np

from drake_oa.common.config import count, number, vector
from drake_oa.common.messages import FloatArray


@dc.dataclass
class SupervisorParameters:
    """What slows, holds or stops a motion of the robot that is not safe."""

    # Distance of a link to an obstacle or the table at which an approach is at rest [m].
    stop_distance: float = number(0.025, "m", 0.0, 1.0)
    # The controller comes to rest this much later than the policy, whose own time
    # is `policy.hold_time` [s].
    lag: float = number(0.05, "s", 0.0, 10.0)
    # Share of full speed at which a link that is nearer may leave; one where the motion is held
    # leaves only with `resume_above` or more.
    leave_scale: float = number(0.3, "1", 0.0, 1.0, open_low=True)
    # Frames that may be missed before the motion slows; it is held at the age
    # `policy.max_observation_age`.
    stale_frames: float = number(2.5, "1", 1.0, 1e6)
    # Distance of a joint from its position limit at which an approach is at rest [rad].
    joint_margin: float = number(0.02, "rad", 0.0, 3.0)
    # Tracking error of the tool point that begins to slow the motion, and that holds it [m].
    tracking_slow: float = number(0.02, "m", 0.0, 1.0, open_low=True, below="tracking_hold")
    tracking_hold: float = number(0.05, "m", 0.0, 1.0, open_low=True)
    # Torque saturation that lasts longer slows the motion [s], each time by this factor.
    saturation_time: float = number(0.1, "s", 0.0, 10.0, open_low=True)
    back_off: float = number(0.7, "1", 0.0, 1.0, open_low=True)
    # Old frames, torque saturation and speed limits of joints do not slow it below this share
    # of full speed.
    slowest: float = number(0.1, "1", 0.0, 1.0, open_low=True)
    # Time in which the speed rises from rest to full [s].
    recovery_time: float = number(1.0, "s", 0.0, 60.0, open_low=True)
    # A demand below the first share of full speed holds the motion, until all are above the
    # second.
    hold_below: float = number(0.05, "1", 0.0, 1.0, open_low=True, below="resume_above")
    resume_above: float = number(0.3, "1", 0.0, 0.999, open_low=True)
    # A hold that cannot end by itself becomes a stop after this time [s].
    patience: float = number(3.0, "s", 0.0, 600.0, open_low=True)
    # An event lasts this long at least before another of the same action is told [s].
    dwell: float = number(0.5, "s", 0.0, 60.0)


@dc.dataclass
class SupervisorSettings(SupervisorParameters):
    """The block, and what follows from the rest of the scenario."""

    # How much nearer what moves may be than it was seen [m].
    padding: float = number(0.005, "m", 0.0, 1.0)
    # Time in which the motion comes to rest from full speed [s].
    reaction_time: float = number(0.3, "s", 0.0, 100.0, open_low=True)
    # Of it what the policy takes, and how often it looks [s].
    hold_time: float = number(0.25, "s", 0.0, 10.0, open_low=True)
    period: float = number(0.008, "s", 0.0, 100.0, open_low=True)
    # Time between observations, and the age from which on one holds the motion [s].
    frame_period: float = number(1.0 / 15.0, "s", 0.0, 100.0, open_low=True)
    max_age: float = number(0.5, "s", 0.0, 1e6, open_low=True)


@dc.dataclass
class EvasionParameters:
    """What gets the arm out of the way of what moves."""

    # Distance of any link to what moves below which the motion is not left as it is, and how
    # much more it has to be before it is left to itself again [m].
    margin: float = number(0.05, "m", 0.0, 1.0, open_low=True)
    release: float = number(0.02, "m", 0.0, 1.0)
    # The motion is left as it is while it keeps the margin for this long [s].
    notice: float = number(0.7, "s", 0.0, 10.0, open_low=True)
    # How far ahead other ways are looked at, at least that [s], and at how many instants.
    horizon: float = number(1.2, "s", 0.7, 10.0)
    instants: int = count(12, 2, 1000)
    # Greatest speed [m/s] and acceleration [m/s^2] of the tool while it evades.
    speed: float = number(0.6, "m/s", 0.0, 5.0, open_low=True)
    acceleration: float = number(6.0, "m/s^2", 0.0, 50.0, open_low=True)
    # Of the joints in the null space of the tool's task, the norm of all; 0: none.
    turn_speed: float = number(1.5, "rad/s", 0.0, 10.0)
    turn_acceleration: float = number(10.0, "rad/s^2", 0.0, 100.0, open_low=True)
    # How much nearer an obstacle that moves may be, a second ahead [m/s].
    growth: float = number(0.02, "m/s", 0.0, 1.0)
    # A distance to the table counts as this much more than one to an obstacle [m].
    table_allowance: float = number(0.06, "m", 0.0, 1.0)
    # What a way keeps from the joints' limits [rad], and the share of their speed limits that
    # it may take.
    joint_margin: float = number(0.1, "rad", 0.0, 3.0)
    speed_share: float = number(0.9, "1", 0.0, 1.0, open_low=True)
    # Share of the margin with which the motion goes on rather than evades.
    passing: float = number(0.6, "1", 0.0, 1.0)
    # Clearances that differ by less are alike [m].
    as_good: float = number(5e-3, "m", 0.0, 1.0)
    # So far the tool goes where the arm may not reach farther [m], and so far the joints turn
    # where they may not turn farther, the norm of all [rad].
    short_ways: list[float] = vector([0.2, 0.08], "m")
    short_turn: float = number(0.7, "rad", 0.0, 10.0, open_low=True)
    # A change of velocity costs this share of it, turning the arm this much beside displacing
    # the tool [m/rad], and a velocity along that of the obstacle this share of it besides.
    steady: float = number(0.5, "1", 0.0, 100.0)
    turning: float = number(0.2, "m/rad", 0.0, 100.0)
    along: float = number(1.0, "1", 0.0, 100.0)
    # A displacement below this does not lead away from what has come to rest [m/s].
    slow: float = number(0.03, "m/s", 0.0, 1.0)

    @property
    def times(self) -> FloatArray:
        """(K,) instants that are looked at [s]."""
        return np.linspace(0.0, self.horizon, self.instants + 1)[1:]


@dc.dataclass
class EvasionSettings(EvasionParameters):
    """The block, and what follows from the rest of the scenario."""

    # How much nearer what moves may be than it was seen [m].
    padding: float = number(0.01, "m", 0.0, 1.0)
    # Time in which the motion comes to rest [s].
    hold_time: float = number(0.25, "s", 0.0, 10.0, open_low=True)


def settings(parameters: Any, **derived: float) -> dict[str, Any]:
    """The fields of a block, with others beside them."""
    return {item.name: getattr(parameters, item.name) for item in dc.fields(parameters)} | derived
