"""When a motion must be slowed, held or stopped: the decisions of the supervisor.

`drake_oa.safety.supervisor` evaluates the robot, each watch of `drake_oa.safety.monitors`
gives a `Demand`: the share of full speed, ds/dt = 1 / (tau T), at which the motion may go,
and why. The least one counts. The path is a function of normalised time s alone, so that
a motion at another speed keeps its path.

The watch of clearance asks of every sphere of the arm and every solid, at their distance d and
closing at the speed c at full speed,

    share * c + (speed of the solid towards the sphere) <= (d - d_stop) / T_reaction,

where T_reaction is the time in which the policy comes to rest from full speed, and the
controller with it. A resting obstacle is thereby approached exponentially, at a rate
that the policy can follow, and never nearer than d_stop.

A solid that rests, beside a motion that was verified among it, is no stranger: the policy, which
goes from a share x to rest in x hold, has only to brake in time,

    c * (share * step + share^2 * hold / 2) <= d - d_stop,

and d_stop is the least of the stop distance and what the motion keeps of it, less 5 mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

from drake_oa.common.messages import FloatArray, Frozen, PlannedMotion, zeros
from drake_oa.geometry.solids import SolidScene
from drake_oa.safety.config import SupervisorSettings

Action = Literal["run", "slow", "hold", "stop"]

_RUNNING, _SLOW = 0.99, 0.95
"""A motion is slow below the second, and again free above the first."""


@dataclass(frozen=True, eq=False)
class Supervision(Frozen):
    """What the supervisor has decided.

    Attributes:
        action: "run"; "slow"; "hold": at rest until it is safe; "stop": the same, where that
            is not to be expected.
        speed_scale: share of full speed asked of the policy, in [0, 1].
        reason: why it does not run; "" while it does.
        since: since when action and reason are these [s].
        link: the body nearest to a limit of clearance; "" where none is.
        obstacle: name of the obstacle it is near to; -1: the table, or none.
        distance: between them [m]; inf where nothing limits the motion.
    """

    action: Action = "run"
    speed_scale: float = 1.0
    reason: str = ""
    since: float = 0.0
    link: str = ""
    obstacle: int = -1
    distance: float = math.inf


@dataclass(frozen=True)
class Demand:
    """What one watch asks for.

    Attributes:
        scale: share of full speed, in [0, 1].
        cause: what the watch calls it; two demands of one cause are the same event.
        reason: the same with its figures.
        lasting: whether it stays while the motion is at rest.
        urgent: whether it is told even shortly after another event of the same action.
        link, obstacle, distance: see `Supervision`.
    """

    scale: float = 1.0
    cause: str = ""
    reason: str = ""
    lasting: bool = False
    urgent: bool = False
    link: str = ""
    obstacle: int = -1
    distance: float = math.inf


NO_DEMAND = Demand()
"""Of a watch that has nothing to say."""


@dataclass(frozen=True, eq=False)
class SupervisorState(Frozen):
    """What the supervisor keeps from step to step.

    Attributes:
        supervision: its decision.
        cause: what it was made for; see `Demand`.
        blocked_since: since when the motion is held for something lasting [s].
        saturated_since: since when a torque is saturated, or since it last slowed [s].
        torque_scale: share of full speed that torque saturation leaves.
        motion, scene: the verified motion and the solids that `kept` is of.
        kept: (G, K) what that motion keeps of them [m].
        broken: whether nothing can be watched any more; a stop for that is for good.
    """

    supervision: Supervision = field(default_factory=Supervision)
    cause: str = ""
    blocked_since: float = math.inf
    saturated_since: float = math.inf
    torque_scale: float = 1.0
    motion: PlannedMotion | None = None
    scene: SolidScene | None = None
    kept: FloatArray = zeros(0, 0)
    broken: bool = False


def broken(state: SupervisorState, reason: str, time: float) -> SupervisorState:
    """The state after a stop for good: what is to be watched cannot be."""
    return replace(_stopped(state, reason, time), broken=True)


def _stopped(state: SupervisorState, reason: str, time: float) -> SupervisorState:
    supervision = replace(
        state.supervision, action="stop", speed_scale=0.0, reason=reason, since=time
    )
    return replace(state, supervision=supervision, cause=reason)


def decide(
    state: SupervisorState,
    demands: list[Demand],
    time: float,
    elapsed: float,
    parameters: SupervisorSettings,
    *,
    waits: bool = False,
) -> SupervisorState:
    """What follows from the demands of all watches.

    The speed asked for falls at once (the policy ramps it) and rises at a bounded rate. A
    demand below `hold_below` holds the motion until all are above `resume_above`; held for
    something lasting for `patience`, it is stopped, and goes on by itself as from a hold.

    Args:
        state: before.
        demands: one at least.
        time: now [s].
        elapsed: time since the step before [s].
        parameters: what is kept.
        waits: whether the policy holds the motion for a reason of its own: then it is left
            to the policy, and no patience is lost.
    """
    before = state.supervision
    tightest = min(demands, key=lambda demand: demand.scale)
    held = before.action in ("hold", "stop")
    holds = tightest.scale < (parameters.resume_above if held else parameters.hold_below)
    if state.broken or (holds and before.action == "stop"):
        return state
    target = 0.0 if holds else tightest.scale
    scale = min(target, before.speed_scale + elapsed / parameters.recovery_time)
    action: Action = "run"
    if holds:
        action = "hold"
    elif before.action == "run":
        action = "slow" if scale < _SLOW else "run"
    elif scale < _RUNNING or held or time - before.since < parameters.dwell:
        action = "slow"
    blocked_since = math.inf
    if (
        holds
        and not waits
        and any(d.lasting and d.scale < parameters.resume_above for d in demands)
    ):
        blocked_since = min(state.blocked_since, time)
        if time - blocked_since >= parameters.patience:
            return _stopped(state, tightest.reason if tightest.lasting else before.reason, time)
    cause, reason = tightest.cause, tightest.reason
    if action == "run":
        cause = reason = ""
    elif tightest.scale >= 1.0 or (
        action == before.action
        and (
            cause == state.cause or (time - before.since < parameters.dwell and not tightest.urgent)
        )
    ):
        # The same event, or the way back from it: its first figures stay.
        cause, reason = state.cause, before.reason
    same = action == before.action and cause == state.cause
    if (
        same
        and scale == before.speed_scale
        and blocked_since == state.blocked_since
        and tightest.link == before.link
        and tightest.distance == before.distance
    ):
        return state
    supervision = Supervision(
        action=action,
        speed_scale=scale,
        reason=reason,
        since=before.since if same else time,
        link=tightest.link,
        obstacle=tightest.obstacle,
        distance=tightest.distance,
    )
    return replace(state, supervision=supervision, cause=cause, blocked_since=blocked_since)
