"""Joint trajectories: tracking of the tool, legs of maneuvers, and costs of proximity.

A maneuver consists of two legs. In each leg, every joint moves to its target with a trapezoidal
velocity profile, of bounded speed and acceleration, and rests there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import CORES, compiled, leaf, on_cores, parted
from drake_oa.common.latency import count
from drake_oa.common.messages import FloatArray
from drake_oa.planning.collision_model import (
    LINKS,
    SELF,
    TOOL,
    ArmCollisionModel,
    lower_clearance_margins,
)
from drake_oa.robot.arm import Chain, chain_poses, follow, scratch, step_toward

_VELOCITY_DAMPING = 1e-4
"""Damping of the differential inverse kinematics of the tracked velocity [m^2]."""
_CONTACT_DEPTH = 0.03
"""Penetration depth that doubles the cost of a contact [m]."""
_LIMIT_TOLERANCE = 1e-3
"""Violation of a joint limit that is tolerated as an interpolation error [rad]."""
_MIN_MOTIONS_PER_THREAD = 8
"""Minimum number of trajectories per additional thread."""


@compiled
def track(
    chain: Chain,
    q: FloatArray,
    X_WE: FloatArray,
    V_WE: FloatArray,
    posture: FloatArray,
    step: float,
    rate: float,
) -> tuple[FloatArray, FloatArray]:
    """Computes the joint state after one step in which the tool tracks a desired motion.

    Args:
        chain: kinematics of the arm.
        q: (n,) current configuration [rad].
        X_WE: (12,) current desired tool pose: rotation, row by row, and position [m].
        V_WE: (6,) mean desired tool velocity during the step: angular [rad/s], linear [m/s].
        posture: (2n,) nominal posture at the end of the step [rad], and its velocity [rad/s].
        step: duration of the step [s].
        rate: rate at which the null space converges to the nominal posture [1/s].

    Returns:
        (n,) positions [rad] and (n,) velocities [rad/s] after the step.
    """
    n, workspace, convergence = len(q), scratch(len(q)), 1.0 - math.exp(-rate * step)
    posture_samples = np.empty((2, n))
    posture_samples[1] = posture[:n]
    posture_samples[0] = posture[:n] - step * posture[n:]
    X_next = X_WE.copy()
    X_next[9:] += step * V_WE[3:]
    for k in range(3):
        X_next[k:9:3] += step * np.cross(V_WE[:3], X_WE[k:9:3])
    q_next = q.copy()
    follow(q_next, X_next, posture_samples, 1, convergence, chain, workspace)
    q_ahead = q_next.copy()
    workspace.e[:] = step * V_WE
    workspace.null_step[:] = step * (posture[n:] + rate * (posture[:n] - q_next))
    step_toward(q_ahead, _VELOCITY_DAMPING, chain, workspace)
    return q_next, (q_ahead - q_next) / step


@leaf
def advance_leg(
    q: FloatArray, v: FloatArray, target: FloatArray, speed: FloatArray, acceleration: FloatArray,
    step: float,
) -> None:  # fmt: skip
    """Advances joints, in place, by one step of a leg toward its target.

    Args:
        q, v: (n,) positions [rad] and velocities [rad/s].
        target: (n,) configuration in which the joints come to rest [rad].
        speed: (n,) maximum joint speeds of the leg [rad/s].
        acceleration: (n,) maximum joint accelerations [rad/s^2].
        step: duration of the step [s].
    """
    for i in range(len(q)):
        distance, max_change = target[i] - q[i], acceleration[i] * step
        # Maximum speed from which the joint stops at the target, in discrete steps.
        max_speed = (
            math.sqrt(0.25 * max_change * max_change + 2.0 * acceleration[i] * abs(distance))
            - 0.5 * max_change
        )
        target_speed = math.copysign(min(max_speed, speed[i]), distance)
        v_next = v[i] + min(max(target_speed - v[i], -max_change), max_change)
        displacement = 0.5 * (v[i] + v_next) * step
        if abs(distance) <= 0.25 * max_change * step and abs(v[i]) <= max_change:
            q[i], v[i] = target[i], 0.0
        else:
            q[i], v[i] = q[i] + displacement, v_next


_CONVERGENCE = 30.0
"""Rate at which joints converge to a path within their limits [1/s]."""


def approach(
    x: FloatArray, path: FloatArray, speed: FloatArray, acceleration: float, step: float
) -> FloatArray:
    """Computes the joint state after one step toward a moving path, within the limits.

    Args:
        x: (2n,) current positions [rad] and velocities [rad/s].
        path: (2n,) positions and velocities of the path after the step [rad, rad/s].
        speed: (n,) maximum joint speeds [rad/s].
        acceleration: maximum joint acceleration [rad/s^2].
        step: duration of the step [s].
    """
    n, max_change = len(speed), acceleration * step
    q, v = x[:n], x[n:]
    error = path[:n] - q - 0.5 * step * (v + path[n:])
    closing_speed = np.minimum(_CONVERGENCE * np.abs(error), np.sqrt(acceleration * np.abs(error)))
    target_speed = np.clip(path[n:] + np.copysign(closing_speed, error), -speed, speed)
    v_next = v + np.clip(target_speed - v, -max_change, max_change)
    return np.append(q + 0.5 * step * (v + v_next), v_next)


class Legs(NamedTuple):
    """N maneuvers of two legs each.

    Attributes:
        target: (N, 2, n) target configurations [rad].
        speed: (N, 2, n) maximum joint speeds [rad/s].
        switch: (N,) times from the start of the maneuver to that of the second leg [s].
    """

    target: FloatArray
    speed: FloatArray
    switch: FloatArray


@compiled
def roll_out_legs(
    q: FloatArray, v: FloatArray, legs: Legs, acceleration: FloatArray, step: float, every: int,
    samples: int,
) -> FloatArray:  # fmt: skip
    """Rolls out maneuvers to sampled configurations (N, samples, n) [rad].

    Args:
        q, v: (n,) joint state at the start [rad, rad/s].
        legs: N maneuvers.
        acceleration: (n,) maximum joint accelerations [rad/s^2].
        step: duration of a step [s].
        every: number of steps between two samples, and before the first one.
        samples: number of samples.
    """
    N, n = len(legs.target), len(q)
    rollouts = np.empty((N, samples, n))
    for i in range(N):
        p, w = q.copy(), v.copy()
        for k in range(samples * every):
            leg = 1 if k * step >= legs.switch[i] else 0
            advance_leg(p, w, legs.target[i, leg], legs.speed[i, leg], acceleration, step)
            if (k + 1) % every == 0:
                rollouts[i, k // every] = p
    return rollouts


_RESTING_MARGIN = 0.03
"""Clearance margin to resting obstacles below which proximity costs [m]."""
_MARGIN_GROWTH = 0.1
"""Growth rate of the margin of moving obstacles with the prediction time [m/s]."""
_CONTACT_DECAY = 0.8
"""Time constant with which costs decay with the prediction time [s]."""


class MotionCosts(NamedTuple):
    """Costs of contact and proximity of N trajectories, as (N,) arrays.

    With the clearance margins d(t) of a configuration, T = 0.8 s, D = 30 mm and the time t_1 of the
    first contact, at which the integrals end,

        contact      = T exp(-t_1 / T) (1 + min(-d(t_1) / D, 3))
        near_moving  = integral of exp(-t / T) max(1 - d(t) / (margin + 0.1 m/s t), 0)^2 dt
        near_resting = integral of max(1 - d(t) / 30 mm, 0)^2 dt

    Attributes:
        contact: cost of the first contact; 0: no contact [s].
        near_moving, near_resting: costs of proximity to moving and resting obstacles [s].
        first: time t_1 of the first contact, from the start; inf: no contact [s].
    """

    contact: FloatArray
    near_moving: FloatArray
    near_resting: FloatArray
    first: FloatArray


def evaluate_motions(
    resting: ArmCollisionModel, moving: ArmCollisionModel, q: FloatArray, step: float, margin: float
) -> MotionCosts:
    """Computes the costs of N trajectories among resting and moving obstacles.

    Args:
        resting: collision model with the clearances required from resting obstacles and between
            links; -inf for moving obstacles.
        moving: collision model with the clearances required from moving obstacles; -inf for others.
        q: (N, T, n) configurations, the first one a step after `moving.now` [rad].
        step: time between two configurations [s].
        margin: clearance margin to moving obstacles below which proximity costs, at time 0 [m].
    """
    table = np.zeros((len(q), 5))
    threads = min(CORES, len(q) // _MIN_MOTIONS_PER_THREAD + 1)
    on_cores(_evaluate_some, threads, resting, moving, q, step, margin, table)
    count(configurations=int(table[:, 4].sum()))
    return MotionCosts(*np.ascontiguousarray(table[:, :4].T))


@parted
def _evaluate_some(
    part: int, parts: int, resting: ArmCollisionModel, moving: ArmCollisionModel, q: FloatArray,
    step: float, margin: float, out: FloatArray,
) -> None:  # fmt: skip
    """Evaluates trajectories part, part + parts, ... (one thread's share).

    Writes the fields of `MotionCosts` and the number of checked configurations into out (N, 5).
    """
    chain, spheres = resting.chain, resting.spheres
    T, n = q.shape[1:]
    X, center = np.empty((n + 2, 12)), np.empty((len(spheres.group_joint), 3))
    resting_margins, moving_margins = np.empty(3), np.empty(3)
    for i in range(part, len(q), parts):
        first_contact, n_checked = np.inf, 0
        for k in range(T):
            elapsed = (k + 1) * step
            t, weight = moving.now + elapsed, math.exp(-elapsed / _CONTACT_DECAY)
            chain_poses(q[i, k], chain.X_PJ, X)
            max_margin = margin + _MARGIN_GROWTH * elapsed
            moving_margins[:] = max_margin
            lower_clearance_margins(
                X, t, spheres, moving.geometries, moving.required, center, moving_margins, -np.inf
            )
            resting_margins[:] = _RESTING_MARGIN
            lower_clearance_margins(
                X,
                t,
                spheres,
                resting.geometries,
                resting.required,
                center,
                resting_margins,
                -np.inf,
            )
            n_checked += 1
            moving_margin = min(moving_margins[TOOL], moving_margins[LINKS])
            resting_margin = min(resting_margins[TOOL], resting_margins[LINKS])
            violation = max_margin - moving_margin
            if violation > 0.0:
                ratio = violation / max_margin
                out[i, 1] += weight * step * ratio * ratio
            violation = _RESTING_MARGIN - resting_margin
            if violation > 0.0:
                ratio = violation / _RESTING_MARGIN
                out[i, 2] += step * ratio * ratio
            contact_margin = min(resting_margin, resting_margins[SELF])
            if moving_margin < 0.0:
                contact_margin = min(contact_margin, moving_margin)
            for j in range(n):
                excess = max(chain.lower[j] - q[i, k, j], q[i, k, j] - chain.upper[j])
                if excess > _LIMIT_TOLERANCE:
                    contact_margin = min(contact_margin, -_CONTACT_DEPTH)
            if contact_margin < 0.0:
                first_contact = elapsed
                out[i, 0] = (
                    _CONTACT_DECAY * weight * (1.0 + min(-contact_margin / _CONTACT_DEPTH, 3.0))
                )
                break
        out[i, 3], out[i, 4] = first_contact, n_checked
