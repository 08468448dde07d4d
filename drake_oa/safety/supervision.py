"""Supervision of the arm's motion: monitors that limit the speed at which the motion advances.

The speed scale is the fraction of the full rate ds/dt = 1 / (tau T) of normalized time s. T is the
demonstrated duration, and tau the temporal scaling. Each monitor returns a `SpeedLimit`, and the
smallest limit is active. The path is a function of s only, and therefore does not depend on the
speed. In a hold, the motion rests until the cause ends. A cause is lasting if it persists while the
motion is at rest; after 3 s, a hold with a lasting cause becomes a stop. The verified motion is the
joint motion that MotionVerifier checked by simulation.

===================  =====================================  ====================================
Monitor              slows                                  holds
===================  =====================================  ====================================
monitor_observation  observation older than                 observation older than `max_age`,
                     `max_fresh_age`                        or no observation
monitor_guard        the motion guard slows the verified    wait or maneuver (lasting if no
                     motion                                 obstacle moves); late decision
                                                            (lasting)
monitor_contact      never                                  contact of the arm less than
                                                            `contact_time` ago
monitor_path         command 0.02 rad from verified motion  command 0.1 rad from verified motion
monitor_torque       torque saturated for 0.1 s             never
===================  =====================================  ====================================

A state of the robot, a desired motion or an input of the controller that is not finite is a fault:
a stop that never ends. A collision scene that is not finite counts as no observation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from drake_oa.common.messages import Frozen
from drake_oa.geometry.collision_scene import CollisionScene
from drake_oa.safety.maneuvers import GuardDecision

Action = Literal["run", "slow", "hold", "stop"]

_SATURATION_TIME = 0.1
"""Duration of torque saturation after which the supervisor reduces the speed of the motion, and
again after each further such duration [s]."""
_SATURATION_FACTOR = 0.7
"""Factor by which the supervisor reduces the speed of the motion after each 0.1 s of torque
saturation [-]."""
_MIN_SPEED_SCALE = 0.1
"""Minimum fraction of full speed to which old observations or torque saturation slow the motion
down [-]."""
RECOVERY_TIME = 0.3
"""Time in which the supervisor raises the speed of the motion from rest to full speed [s]."""
_HOLD_BELOW = 0.05
"""Speed limit, as a fraction of full speed, below which the supervisor holds the motion, that is,
lets it rest until the cause ends [-]."""
_RESUME_ABOVE = 0.3
"""Minimum speed limit, as a fraction of full speed, at which the supervisor resumes a motion that
rests on its path [-]."""
_HOLD_TIMEOUT = 3.0
"""Duration after which the supervisor's action changes from "hold" to "stop", if the cause persists
while the arm rests [s]."""
_MIN_EVENT_DURATION = 0.5
"""Minimum time for which the supervisor keeps the action "slow", and the cause of an action, so
that rapid changes are not logged [s]."""
_FULL_SPEED_THRESHOLD = 0.95
"""Fraction of full speed below which the supervisor's action is "slow" instead of "run" [-]."""


@dataclass(frozen=True)
class SpeedLimit:
    """Limit that one monitor of the supervisor sets for the speed of the motion.

    Attributes:
        scale: maximum fraction of full speed, in [0, 1].
        cause: short name of the event, such as "torque"; limits with the same cause belong to the
            same event.
        reason: description of the event with numbers, for log and report.
        is_lasting: whether the cause persists while the motion is at rest; a hold then becomes a
            stop after 3 s.
    """

    scale: float = 1.0
    cause: str = ""
    reason: str = ""
    is_lasting: bool = False


NO_LIMIT = SpeedLimit()
"""Result of a monitor that has detected no event: full speed is allowed."""


@dataclass(frozen=True, eq=False)
class Supervision(Frozen):
    """State of the supervisor: its action, the speed scale of the motion, and the state of its
    monitors.

    Attributes:
        action: "run": full speed; "slow": reduced speed; "hold": at rest until the cause ends;
            "stop": at rest, for a cause that is not expected to end by itself.
        speed_scale: fraction of full speed at which the motion may run, in [0, 1].
        reason, cause: description with numbers, and short name, of the event that limits the speed;
            "" while the action is "run".
        since: start time of the current action and cause [s].
        blocked_since: start time of a hold with a lasting cause, that is, one that persists while
            the motion is at rest [s]; inf: no such hold.
        saturated_since: start time of the torque saturation or, once this has reduced the speed,
            time of the last reduction [s]; inf: not saturated.
        torque_scale: fraction of full speed that torque saturation allows, in [0, 1].
        is_faulted: whether an input was not finite; such a stop never ends.
    """

    action: Action = "run"
    speed_scale: float = 1.0
    reason: str = ""
    cause: str = ""
    since: float = 0.0
    blocked_since: float = math.inf
    saturated_since: float = math.inf
    torque_scale: float = 1.0
    is_faulted: bool = False

    def latch_fault(self, reason: str, time: float) -> Supervision:
        """Returns the supervisor's state after a fault at a given time [s]: a stop that never ends,
        with a reason for the log.
        """
        return replace(
            self, action="stop", speed_scale=0.0, reason=reason, cause=reason, since=time,
            is_faulted=True,
        )  # fmt: skip


def supervise(
    previous: Supervision,
    limits: list[SpeedLimit],
    time: float,
    elapsed: float,
    *,
    is_waiting: bool = False,
) -> Supervision:
    """Computes the supervisor's action and the speed scale of the motion from the limits of all
    monitors.

    The speed scale falls at once, since the movement primitive changes its speed gradually, and
    rises at a bounded rate. "Limit" is the smallest limit, "scale" the speed scale. A cause is
    lasting if it persists while the motion is at rest. Transitions, with hysteresis between hold
    and resume:

    ============  ===========================================  ==========
    Action        Condition                                    Next
    ============  ===========================================  ==========
    run, slow     limit < 0.05                                 hold
    hold          lasting cause for 3 s                        stop
    hold, stop    limit >= 0.3                                 slow
    run           scale < 0.95                                 slow
    slow          scale >= 0.95, at least 0.5 s after `since`  run
    ============  ===========================================  ==========

    The numbers are the constants `_HOLD_BELOW`, `_HOLD_TIMEOUT`, `_RESUME_ABOVE`,
    `_FULL_SPEED_THRESHOLD` and `_MIN_EVENT_DURATION`. The start time of the action and its cause is
    `since`.

    Args:
        previous: result of the previous step.
        limits: limits of the monitors, at least one.
        time: current time [s].
        elapsed: time since the previous step [s].
        is_waiting: whether the movement primitive is held for a reason other than its speed scale,
            such as unobserved obstacles; then a hold does not become a stop.
    """
    tightest = min(limits, key=lambda limit: limit.scale)
    was_held = previous.action in ("hold", "stop")
    is_held = tightest.scale < (_RESUME_ABOVE if was_held else _HOLD_BELOW)
    if previous.is_faulted or (is_held and previous.action == "stop"):
        return previous
    has_lasting_cause = any(limit.is_lasting and limit.scale < _RESUME_ABOVE for limit in limits)
    is_blocked = is_held and has_lasting_cause and not is_waiting
    blocked_since = min(previous.blocked_since, time) if is_blocked else math.inf
    target = 0.0 if is_held else tightest.scale
    scale = min(target, previous.speed_scale + elapsed / RECOVERY_TIME)
    is_early = time - previous.since < _MIN_EVENT_DURATION
    action: Action = "run"
    if is_held:
        action = "stop" if time - blocked_since >= _HOLD_TIMEOUT else "hold"
    elif scale < _FULL_SPEED_THRESHOLD or (previous.action != "run" and (was_held or is_early)):
        action = "slow"
    cause, reason = tightest.cause, tightest.reason
    if action == "run":
        cause = reason = ""
    elif (
        tightest.scale >= 1.0
        or (action == previous.action and (cause == previous.cause or is_early))
        or (action == "stop" and not tightest.is_lasting)
    ):
        # The same event, or the recovery from it: keep its first reason.
        cause, reason = previous.cause, previous.reason
    is_same_event = (action, cause) == (previous.action, previous.cause)
    if is_same_event and (scale, blocked_since) == (previous.speed_scale, previous.blocked_since):
        return previous
    return replace(
        previous, action=action, speed_scale=scale, reason=reason, cause=cause,
        since=previous.since if is_same_event else time, blocked_since=blocked_since,
    )  # fmt: skip


def monitor_observation(
    scene: CollisionScene, time: float, max_fresh_age: float, max_age: float
) -> SpeedLimit:
    """Limits the speed of the motion by the age of the last observation of obstacles.

    The limit falls linearly with the age from full speed at `max_fresh_age` to 0 at `max_age`, but
    not below 0.1 of full speed. Above `max_age`, or without an observation, it is 0.

    Args:
        scene: collision scene of the observation.
        time: current time [s].
        max_fresh_age: age up to which the speed is not limited [s].
        max_age: age above which the motion is held [s].
    """
    note = f" ({scene.note})" if scene.note else ""
    if scene.stamp == -math.inf:
        return SpeedLimit(0.0, "unobserved", f"no observation{note}")
    age = time - scene.stamp
    if age <= max_fresh_age:
        return NO_LIMIT
    reason = f"obstacles not seen since t = {scene.stamp:.2f} s{note}"
    if age > max_age:
        return SpeedLimit(0.0, "unseen", reason)
    # The hold starts only above max_age, as that of the policy does.
    scale = max(_MIN_SPEED_SCALE, 1.0 - (age - max_fresh_age) / (max_age - max_fresh_age))
    return SpeedLimit(scale, "unseen", reason)


def monitor_guard(
    decision: GuardDecision, time: float, *, is_late: bool, has_moving: bool
) -> SpeedLimit:
    """Limits the speed of the motion to the speed that the motion guard has decided; 0 during a
    maneuver.

    Args:
        decision: active decision of the guard.
        time: current time [s].
        is_late: whether the decision has expired because no newer one was completed in time.
        has_moving: whether an obstacle moves, or moved less than 2 s ago. If not, the limit during
            a wait or a maneuver is not expected to end by itself (a lasting cause of a hold).
    """
    if is_late:
        reason = "no decision of the motion guard in time"
        return SpeedLimit(0.0, "late decision", reason, is_lasting=True)
    if decision.action == "follow":
        return NO_LIMIT
    obstacle = decision.obstacle or "an obstacle"
    contact = f", contact in {decision.contact - time:.2f} s" if decision.contact < math.inf else ""
    verbs = {"slow": "near", "wait": "waits for", "evade": "evades", "brake": "brakes for"}
    claim = f", by claim ({decision.claim})" if decision.claim else ""
    reason = f"{verbs[decision.action]} {obstacle}{contact}{claim}"
    scale = decision.scale if decision.follows else 0.0
    return SpeedLimit(scale, f"guard: {decision.action}", reason, is_lasting=not has_moving)


def monitor_contact(is_recent: bool) -> SpeedLimit:
    """Limits the speed on the verified motion (checked by simulation) to 0 after a contact of the
    arm.

    Args:
        is_recent: whether a contact was detected less than `contact_time` ago, a parameter of the
            motion guard (0.5 s by default).
    """
    return SpeedLimit(0.0, "contact", "the arm was in contact") if is_recent else NO_LIMIT


_SLOW_DEVIATION = 0.02
"""Deviation of the commanded joints from the verified motion (checked by simulation) above which
the motion slows down [rad]."""
_HOLD_DEVIATION = 0.1
"""Deviation of the commanded joints from the verified motion (checked by simulation) at which the
allowed speed of the motion reaches 0 [rad]."""


def monitor_path(distance: float) -> SpeedLimit:
    """Limits the speed of the motion by the deviation of the commanded joints from the verified
    motion (checked by simulation).

    The command deviates if the limit of its joint acceleration prevents it from following. The
    limit of the speed falls linearly from full speed at 0.02 rad to 0 at 0.1 rad.

    Args:
        distance: maximum deviation of any joint [rad].
    """
    if distance <= _SLOW_DEVIATION:
        return NO_LIMIT
    scale = max(0.0, (_HOLD_DEVIATION - distance) / (_HOLD_DEVIATION - _SLOW_DEVIATION))
    return SpeedLimit(scale, "path", f"the arm is {distance:.3f} rad from its path")


def monitor_torque(
    state: Supervision, is_saturated: bool, time: float, elapsed: float
) -> tuple[Supervision, SpeedLimit]:
    """Limits the speed of the motion while joint torques are saturated; afterwards the limit rises
    linearly to full speed.

    The limit is multiplied by 0.7 for each 0.1 s of saturation, but not below 0.1 of full speed. It
    rises at a rate of full speed per 0.3 s.

    Args:
        state: state of the supervisor.
        is_saturated: whether a commanded joint torque exceeds its effort limit.
        time: current time [s].
        elapsed: time since the previous step [s].

    Returns:
        State of the supervisor with the updated saturation, and limit of the speed.
    """
    saturated_since, scale = state.saturated_since, state.torque_scale
    if not is_saturated:
        saturated_since, scale = math.inf, min(1.0, scale + elapsed / RECOVERY_TIME)
    elif saturated_since == math.inf:
        saturated_since = time
    elif time - saturated_since >= _SATURATION_TIME - 1e-9:
        saturated_since, scale = time, max(_MIN_SPEED_SCALE, _SATURATION_FACTOR * scale)
    if saturated_since != state.saturated_since or scale != state.torque_scale:
        state = replace(state, saturated_since=saturated_since, torque_scale=scale)
    if scale >= 1.0:
        return state, NO_LIMIT
    return state, SpeedLimit(scale, "torque", "a joint torque is at its limit")
