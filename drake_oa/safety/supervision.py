"""Speed of the phase, slowed or held by monitors of the observations, the guard and the torques.

Each monitor returns a `SpeedLimit`: a share of full speed,
ds/dt = 1 / (tau T). The least one counts. The path is a function of normalized time s alone, so
that a motion at another speed keeps its path.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from drake_oa.common.messages import Frozen
from drake_oa.geometry.collision_scene import CollisionScene
from drake_oa.safety.maneuvers import GuardDecision

Action = Literal["run", "slow", "hold", "stop"]

_SATURATION_TIME, _BACK_OFF = 0.1, 0.7
"""Duration of torque saturation after which the motion slows down [s], and by which factor."""
_SLOWEST = 0.1
"""Minimum share of full speed to which old observations and torque saturation slow the motion."""
RECOVERY_TIME = 0.3
"""Time in which the speed rises from rest to full speed [s]."""
_HOLD_BELOW, _RESUME_ABOVE = 0.05, 0.3
"""Shares of full speed below which a motion is held, and above which it resumes."""
_PATIENCE = 3.0
"""Duration after which a hold that cannot end by itself becomes a stop [s]."""
_DWELL = 0.5
"""Minimum time between two logged events of the same action [s]."""
_RUNNING = 0.95
"""Share of full speed below which a motion is slow."""


@dataclass(frozen=True)
class SpeedLimit:
    """Speed that a monitor demands.

    Attributes:
        scale: share of full speed, in [0, 1].
        cause: name of the event; two demands of one cause are the same event.
        reason: the same with figures.
        lasting: whether the cause remains while the motion is at rest.
    """

    scale: float = 1.0
    cause: str = ""
    reason: str = ""
    lasting: bool = False


NO_LIMIT = SpeedLimit()
"""Full speed."""


@dataclass(frozen=True, eq=False)
class Supervision(Frozen):
    """Speed of the phase, and the state of its monitors.

    Attributes:
        action: "run"; "slow"; "hold": at rest until the cause has gone; "stop": the same, for a
            cause that is not expected to go.
        speed_scale: share of full speed, in [0, 1].
        reason, cause: of the demand; "" while the motion runs.
        since: time since which action and cause are these [s].
        blocked_since: time since which the motion is held for a lasting cause [s]; inf: it is not.
        saturated_since: time since which a torque is saturated, or of the last slowing for it [s].
        torque_scale: share of full speed that torque saturation leaves.
        is_broken: whether an input is not finite; such a stop is final.
    """

    action: Action = "run"
    speed_scale: float = 1.0
    reason: str = ""
    cause: str = ""
    since: float = 0.0
    blocked_since: float = math.inf
    saturated_since: float = math.inf
    torque_scale: float = 1.0
    is_broken: bool = False

    def faulted(self, reason: str, time: float) -> Supervision:
        """Returns the final stop for a reason; time [s]."""
        return replace(
            self, action="stop", speed_scale=0.0, reason=reason, cause=reason, since=time,
            is_broken=True,
        )  # fmt: skip


def supervise(
    before: Supervision,
    limits: list[SpeedLimit],
    time: float,
    elapsed: float,
    *,
    waits: bool = False,
) -> Supervision:
    """Computes action and speed from the demands of all monitors.

    The speed falls at once, as the motion primitive ramps it, and rises at a bounded rate. A demand
    below `_HOLD_BELOW` holds the motion until all are above `_RESUME_ABOVE`; held for a lasting
    cause for `_PATIENCE`, it is stopped until then.

    Args:
        before: result of the step before.
        limits: at least one.
        time: now [s].
        elapsed: time since the step before [s].
        waits: whether the motion primitive is held for another reason, so that no patience is lost.
    """
    tightest = min(limits, key=lambda limit: limit.scale)
    held = before.action in ("hold", "stop")
    holds = tightest.scale < (_RESUME_ABOVE if held else _HOLD_BELOW)
    if before.is_broken or (holds and before.action == "stop"):
        return before
    lasts = any(limit.lasting and limit.scale < _RESUME_ABOVE for limit in limits)
    blocked_since = min(before.blocked_since, time) if holds and lasts and not waits else math.inf
    target = 0.0 if holds else tightest.scale
    scale = min(target, before.speed_scale + elapsed / RECOVERY_TIME)
    early = time - before.since < _DWELL
    action: Action = "run"
    if holds:
        action = "stop" if time - blocked_since >= _PATIENCE else "hold"
    elif scale < _RUNNING or (before.action != "run" and (held or early)):
        action = "slow"
    cause, reason = tightest.cause, tightest.reason
    if action == "run":
        cause = reason = ""
    elif (
        tightest.scale >= 1.0
        or (action == before.action and (cause == before.cause or early))
        or (action == "stop" and not tightest.lasting)
    ):
        # The same event, or the recovery from it: its first figures stay.
        cause, reason = before.cause, before.reason
    same = (action, cause) == (before.action, before.cause)
    if same and (scale, blocked_since) == (before.speed_scale, before.blocked_since):
        return before
    return replace(
        before, action=action, speed_scale=scale, reason=reason, cause=cause,
        since=before.since if same else time, blocked_since=blocked_since,
    )  # fmt: skip


def monitor_observation(
    scene: CollisionScene, time: float, fresh: float, max_age: float
) -> SpeedLimit:
    """Slows by the age of the last good observation.

    Args:
        scene: the observation.
        time: now [s].
        fresh: age up to which it does not slow [s].
        max_age: age beyond which the motion is held [s].
    """
    why = f" ({scene.note})" if scene.note else ""
    if scene.stamp == -math.inf:
        return SpeedLimit(0.0, "unobserved", f"no observation{why}")
    age = time - scene.stamp
    if age <= fresh:
        return NO_LIMIT
    reason = f"obstacles not seen since t = {scene.stamp:.2f} s{why}"
    if age > max_age:
        return SpeedLimit(0.0, "unseen", reason)
    # The hold itself begins at that age, where the policy's own does.
    scale = max(_SLOWEST, 1.0 - (age - fresh) / (max_age - fresh))
    return SpeedLimit(scale, "unseen", reason)


def monitor_guard(decision: GuardDecision, time: float, *, late: bool, moves: bool) -> SpeedLimit:
    """Slows or holds the phase as the motion guard has decided.

    Args:
        decision: of the guard.
        time: now [s].
        late: whether the decision is too old.
        moves: whether an obstacle moves, so that waiting may end by itself.
    """
    if late:
        return SpeedLimit(
            0.0, "late decision", "no decision of the motion guard in time", lasting=True
        )
    if decision.action == "follow":
        return NO_LIMIT
    obstacle = decision.obstacle or "an obstacle"
    contact = f", contact in {decision.contact - time:.2f} s" if decision.contact < math.inf else ""
    said = {"slow": "near", "wait": "waits for", "evade": "evades", "brake": "brakes for"}
    claim = f", by claim ({decision.claim})" if decision.claim else ""
    reason = f"{said[decision.action]} {obstacle}{contact}{claim}"
    scale = decision.scale if decision.follows else 0.0
    return SpeedLimit(scale, f"guard: {decision.action}", reason, lasting=not moves)


_OFF_PATH, _FAR_OFF = 0.02, 0.1
"""Distances of a joint from the verified motion at which its phase slows down, and rests [rad]."""


def monitor_path(distance: float) -> SpeedLimit:
    """Slows the phase while joint accelerations limit how fast the arm follows; distance [rad]."""
    if distance <= _OFF_PATH:
        return NO_LIMIT
    scale = max(0.0, (_FAR_OFF - distance) / (_FAR_OFF - _OFF_PATH))
    return SpeedLimit(scale, "path", f"the arm is {distance:.3f} rad from its path")


def monitor_torque(
    state: Supervision,
    saturated: bool,
    time: float,
    elapsed: float,
) -> tuple[Supervision, SpeedLimit]:
    """Slows while torques are saturated: by a factor each time, then linearly back.

    Args:
        state: of the monitors.
        saturated: whether a joint is asked for more than its effort limit.
        time: now [s].
        elapsed: time since the step before [s].
    """
    since, scale = state.saturated_since, state.torque_scale
    if not saturated:
        since, scale = math.inf, min(1.0, scale + elapsed / RECOVERY_TIME)
    elif since == math.inf:
        since = time
    elif time - since >= _SATURATION_TIME - 1e-9:
        since, scale = time, max(_SLOWEST, _BACK_OFF * scale)
    if since != state.saturated_since or scale != state.torque_scale:
        state = replace(state, saturated_since=since, torque_scale=scale)
    if scale >= 1.0:
        return state, NO_LIMIT
    return state, SpeedLimit(scale, "torque", "a joint torque is at its limit")
