"""The watches of the supervisor: each says how fast a motion may go, and why."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from drake_oa.common.messages import Evasion, FloatArray, PlannedMotion
from drake_oa.geometry.solids import SolidScene
from drake_oa.robot.arm import Chain
from drake_oa.safety import approach_kernels as kernels
from drake_oa.safety.approach_kernels import SolidRules
from drake_oa.safety.config import SupervisorSettings
from drake_oa.safety.guarded_arm import GuardedArm
from drake_oa.safety.supervision import NO_DEMAND, Demand, SupervisorState


def watch_observation(scene: SolidScene, time: float, parameters: SupervisorSettings) -> Demand:
    """Slows by the age of the last good observation, and holds beyond `max_age`; time [s]."""
    why = f" ({scene.note})" if scene.note else ""
    if scene.stamp == -math.inf:
        return Demand(0.0, "unobserved", f"no observation yet{why}")
    age = time - scene.stamp
    fresh = min(parameters.stale_frames * parameters.frame_period, 0.9 * parameters.max_age)
    if age <= fresh:
        return NO_DEMAND
    reason = f"obstacles not seen since t = {scene.stamp:.2f} s{why}"
    if age > parameters.max_age:
        return Demand(0.0, "unseen", reason)
    # The hold itself begins at that age, where the policy's own does.
    scale = max(parameters.slowest, 1.0 - (age - fresh) / (parameters.max_age - fresh))
    return Demand(scale, "unseen", reason)


_JOINT_MARGIN = 0.005
"""How much nearer to its limit than the verified motion a joint may come [rad]."""
_MARGIN = 0.005
"""How much nearer than its motion will keep a link may come [m]."""


def remaining_distance(
    arm: GuardedArm, motion: PlannedMotion, scene: SolidScene, parameters: SupervisorSettings
) -> FloatArray:
    """(G, K) what a motion keeps of the solids that rest, known up to where it matters [m]."""
    most, q = parameters.stop_distance + _MARGIN, np.array(motion.q, order="C")
    when = scene.stamp if math.isfinite(scene.stamp) else 0.0
    return kernels.kept_along(arm.chain, arm.spheres, scene.solids, q, when, most)


def watch_solids(
    arm: GuardedArm,
    q: FloatArray,
    v: FloatArray,
    scene: SolidScene,
    time: float,
    parameters: SupervisorSettings,
    *,
    kept: FloatArray | None,
    passing: bool,
) -> Demand:
    """Slows an approach of any sphere of the arm to a solid: see `drake_oa.safety.supervision`.

    Args:
        arm: its chain and spheres.
        q: (n,) joints [rad].
        v: (n,) their velocities at full speed [rad/s].
        scene: the solids; they have moved on at their velocities since their stamp.
        time: now [s].
        parameters: what is kept.
        kept: what the verified motion keeps, see `remaining_distance`; None: none is verified.
        passing: whether what moves is left to who has looked ahead.
    """
    solids = scene.solids
    rests = ~solids.ball[:, 4:7].any(axis=1)
    stop = np.full((len(arm.bodies), len(solids.ball)), parameters.stop_distance)
    stop[:, ~rests] += parameters.padding
    if kept is not None:
        # Whatever a motion is said to keep, no shape is to touch another.
        least = np.maximum(kept - _MARGIN, -arm.overshoot[:, None])
        stop[:, rests] = np.minimum(stop, least)[:, rests]
    p = parameters
    rules = SolidRules(
        stop, p.reaction_time, p.period, p.hold_time, p.leave_scale, kept is not None, passing
    )
    now = min(time, scene.stamp + p.max_age)
    scale, group, row, distance, _ = kernels.solid_limit(
        arm.chain, arm.spheres, solids, q, v, now, rules
    )
    if row == kernels.NOTHING:
        return NO_DEMAND
    link, thing = arm.bodies[group], scene.labels[row]
    return Demand(
        scale=scale,
        cause=f"{link} near {thing}",
        reason=f"{link} within {max(distance, 0.0):.3f} m of {thing}",
        # What moves will be gone.
        lasting=not solids.ball[row, 4:7].any(),
        link=link,
        obstacle=int(solids.layout[row, 5]),
        distance=distance,
    )


def watch_joints(
    names: tuple[str, ...],
    limits: Chain,
    q: FloatArray,
    v: FloatArray,
    v_full: FloatArray,
    scale: float,
    parameters: SupervisorSettings,
    verified: FloatArray | None = None,
) -> Demand:
    """Slows a joint that approaches a position limit, or goes faster than its own.

    Along a verified motion it keeps what that keeps of the limit, if that is less than is asked,
    and is slowed as braking needs: see `watch_solids`.

    Args:
        names: of the n joints.
        limits: of their positions and speeds.
        q: (n,) positions [rad].
        v: (n,) velocities [rad/s].
        v_full: (n,) velocities at full speed, see `guarded_arm.full_speed_rates` [rad/s].
        scale: share of full speed asked for now.
        parameters: what is kept.
        verified: (T, n) joints along the verified motion [rad]; None: none is.
    """
    left = np.where(v_full > 0.0, limits.upper - q, q - limits.lower)
    speed, p = np.abs(v_full), parameters
    if verified is None:
        allowed = np.maximum(left - p.joint_margin, 0.0) / p.reaction_time
        share = allowed / np.maximum(speed, 1e-9)
    else:
        ahead = np.minimum(limits.upper - verified, verified - limits.lower).min(axis=0)
        room = np.maximum(left - np.minimum(p.joint_margin, ahead - _JOINT_MARGIN), 0.0)
        share = np.sqrt(p.period**2 + 2.0 * p.hold_time * room / np.maximum(speed, 1e-9))
        share = (share - p.period) / p.hold_time
    # As fast as the position limit lets it, and as the speed limit does.
    position = np.where(speed > kernels.APPROACH, share, 1.0)
    rate = limits.speed / np.maximum(speed, 1e-9)
    now = np.abs(v)
    over = now > limits.speed
    if over.any():
        rate = np.where(over, np.minimum(rate, scale * limits.speed / np.maximum(now, 1e-9)), rate)
    near, fast = int(position.argmin()), int(rate.argmin())
    if position[near] >= 1.0 and rate[fast] >= 1.0:
        return NO_DEMAND
    if position[near] <= rate[fast]:
        name = names[near]
        return Demand(
            float(position[near]),
            f"{name} near its limit",
            f"{name} {max(float(left[near]), 0.0):.3f} rad from its position limit",
            lasting=True,
        )
    name = names[fast]
    return Demand(
        max(float(rate[fast]), parameters.slowest),
        f"{name} fast",
        f"{name} would be faster than {limits.speed[fast]:.2f} rad/s",
    )


def watch_evasion(evading: Evasion) -> Demand:
    """Holds a motion while it waits for something that moves, or evades it, or cannot."""
    if evading.action in ("", "going on"):
        return NO_DEMAND
    what = f"obstacle {evading.obstacle}"
    held = Demand(0.0, "evasion", obstacle=evading.obstacle, distance=evading.clearance)
    if evading.certain:
        return replace(
            held, cause="caught", reason=f"{what} cannot be evaded by this arm", urgent=True
        )
    waits = evading.action == "waiting"
    return replace(held, reason=f"waits for {what}" if waits else f"evades {what}")


def watch_tracking(error: float, parameters: SupervisorSettings) -> Demand:
    """Slows from `tracking_slow` on, and holds from `tracking_hold`; error [m]."""
    least, most = parameters.tracking_slow, parameters.tracking_hold
    if error <= least:
        return NO_DEMAND
    scale = max(0.0, (most - error) / (most - least))
    return Demand(scale, "tracking", f"tracking error {error:.3f} m", lasting=True)


def watch_torque(
    state: SupervisorState,
    saturated: bool,
    time: float,
    elapsed: float,
    parameters: SupervisorSettings,
) -> tuple[SupervisorState, Demand]:
    """Slows while torques are saturated: by a factor each time, then linearly back.

    Args:
        state: of the supervisor.
        saturated: whether a joint is asked for more than its effort limit.
        time: now [s].
        elapsed: time since the step before [s].
        parameters: what is kept.
    """
    since, scale = state.saturated_since, state.torque_scale
    if not saturated:
        since, scale = math.inf, min(1.0, scale + elapsed / parameters.recovery_time)
    elif since == math.inf:
        since = time
    elif time - since >= parameters.saturation_time - 1e-9:
        since, scale = time, max(parameters.slowest, parameters.back_off * scale)
    if since != state.saturated_since or scale != state.torque_scale:
        state = replace(state, saturated_since=since, torque_scale=scale)
    if scale >= 1.0:
        return state, NO_DEMAND
    return state, Demand(scale, "torque", "a joint torque is at its limit")
