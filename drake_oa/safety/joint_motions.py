"""Compiled functions for joint trajectories of the motion guard: tracking of a tool motion, evasive
maneuvers, and costs of contact and proximity.

A maneuver is a joint trajectory that leaves the verified motion (checked by simulation) to evade
obstacles. A maneuver consists of two legs. In each leg, every joint moves to its target with a
trapezoidal velocity profile, of bounded speed and acceleration, and rests there.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import CORES, compiled, leaf, on_cores, parted
from drake_oa.common.latency import count
from drake_oa.common.messages import FloatArray, IntArray
from drake_oa.planning.collision_model import (
    LINKS,
    SELF,
    TOOL,
    ArmCollisionModel,
    lower_clearance_margins,
)
from drake_oa.robot.arm import Chain, chain_poses, follow, scratch, step_toward

_VELOCITY_DAMPING = 1e-4
"""Damping of the differential inverse kinematics that computes joint velocities from the desired
tool velocity [m^2]."""
_CONTACT_DEPTH = 0.03
"""Depth of a predicted contact at which its cost is twice that of a contact without depth [m]. The
depth is the amount by which the required clearance is violated."""
_LIMIT_TOLERANCE = 1e-3
"""Violation of a joint limit that is tolerated in predicted trajectories as an interpolation error
[rad]. A larger violation counts as a contact."""
_MIN_MOTIONS_PER_THREAD = 8
"""Minimum number of trajectories for each additional thread, if trajectories are evaluated in
parallel [-]."""


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
    """Computes the joint state of the arm after one time step in which the tool tracks a desired
    motion.

    Args:
        chain: kinematics of the arm.
        q: (n,) current configuration [rad].
        X_WE: (12,) current desired tool pose in the world: rotation matrix, row by row, and
            position [m].
        V_WE: (6,) mean desired tool velocity in the world during the step: angular [rad/s], linear
            [m/s].
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
    """Advances a joint state, in place, by one time step of a leg: a motion in which each joint
    moves to a target and rests there.

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
"""Maximum rate at which the error between the commanded joints and a desired joint trajectory is
reduced [1/s]."""


def approach(
    x: FloatArray, path: FloatArray, speed: FloatArray, acceleration: float, step: float
) -> FloatArray:
    """Computes the joint state after one time step in which the joints converge to a desired joint
    trajectory, with bounded speed and acceleration.

    Args:
        x: (2n,) current positions [rad] and velocities [rad/s].
        path: (2n,) desired positions [rad] and velocities [rad/s] after the step.
        speed: (n,) maximum joint speeds [rad/s].
        acceleration: maximum joint acceleration [rad/s^2].
        step: duration of the step [s].

    Returns:
        (2n,) positions [rad] and velocities [rad/s] after the step.
    """
    n, max_change = len(speed), acceleration * step
    q, v = x[:n], x[n:]
    error = path[:n] - q - 0.5 * step * (v + path[n:])
    closing_speed = np.minimum(_CONVERGENCE * np.abs(error), np.sqrt(acceleration * np.abs(error)))
    target_speed = np.clip(path[n:] + np.copysign(closing_speed, error), -speed, speed)
    v_next = v + np.clip(target_speed - v, -max_change, max_change)
    return np.append(q + 0.5 * step * (v + v_next), v_next)


class Legs(NamedTuple):
    """Arrays of N joint maneuvers of two legs each; in a leg every joint moves to a target and
    rests there.

    Attributes:
        target: (N, 2, n) target configurations of both legs [rad].
        speed: (N, 2, n) maximum joint speeds in both legs [rad/s].
        switch: (N,) times at which the second leg begins, from the start of the maneuver [s]; inf:
            the second leg never begins.
    """

    target: FloatArray
    speed: FloatArray
    switch: FloatArray

    def rows(self, rows: IntArray | slice) -> Legs:
        """Returns the maneuvers at the given row indices, or in a slice of rows."""
        return Legs(*(array[rows] for array in self))


@compiled
def roll_out_legs(
    q: FloatArray, v: FloatArray, legs: Legs, acceleration: FloatArray, step: float, every: int,
    samples: int,
) -> FloatArray:  # fmt: skip
    """Simulates N joint maneuvers of two legs each, all from the same joint state, and samples
    their configurations.

    Args:
        q, v: (n,) positions [rad] and velocities [rad/s] at the start.
        legs: targets, speeds and switch times of the N maneuvers.
        acceleration: (n,) maximum joint accelerations [rad/s^2].
        step: duration of a time step [s].
        every: number of steps between two samples, and before the first one.
        samples: number of samples.

    Returns:
        (N, samples, n) configurations [rad].
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
"""Distance beyond the required clearance to resting obstacles within which a trajectory is
penalized for proximity [m]."""
_MARGIN_GROWTH = 0.1
"""Rate at which the margin for moving obstacles grows with the prediction time, because predictions
become less accurate [m/s]. A predicted trajectory is penalized for proximity if it is closer to an
obstacle than the required clearance plus this margin."""
_CONTACT_DECAY = 0.8
"""Time constant with which the costs of contact and of proximity to moving obstacles decrease with
the prediction time [s]."""


class MotionCosts(NamedTuple):
    """Costs of predicted contact and proximity of N joint trajectories, each an array (N,).

    Let d(t) be the clearance margin at time t: distance to obstacles minus required clearance, at
    the obstacle where this is least. `contact` is computed from all obstacles, `near_moving` from
    the moving ones, and `near_resting` from the resting ones. The integrals end at the time t_1 of
    the first contact. With T = 0.8 s and D = 30 mm,

        contact      = T exp(-t_1 / T) (1 + min(-d(t_1) / D, 3))
        near_moving  = integral of exp(-t / T) max(1 - d(t) / (margin + 0.1 m/s t), 0)^2 dt
        near_resting = integral of max(1 - d(t) / 30 mm, 0)^2 dt

    where margin is the parameter `margin_moving` of the motion guard. Two other events also count
    as contact. If two links are closer to each other than required, d is their distance minus the
    required one. If a joint is more than 1e-3 rad beyond its limit, d is -D.

    Attributes:
        contact: cost of the first contact [s]; 0: no contact.
        near_moving, near_resting: costs of proximity to moving and resting obstacles [s].
        first: time t_1 of the first contact, from the start [s]; inf: no contact.
    """

    contact: FloatArray
    near_moving: FloatArray
    near_resting: FloatArray
    first: FloatArray


def evaluate_motions(
    resting: ArmCollisionModel, moving: ArmCollisionModel, q: FloatArray, step: float, margin: float
) -> MotionCosts:
    """Computes the costs of contact and proximity of N joint trajectories among resting and moving
    obstacles.

    Args:
        resting: collision model with the clearances required from resting obstacles and between
            links; -inf (no requirement) for moving obstacles.
        moving: collision model with the clearances required from moving obstacles; -inf for others.
            Its time `moving.now` is the start of the trajectories.
        q: (N, T, n) configurations, the first one a step after the start [rad].
        step: time between two configurations [s].
        margin: distance beyond the clearance required from moving obstacles within which proximity
            is penalized at time 0 [m].

    Returns:
        Costs and times of the first contact, (N,) each.
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
    """Computes the costs of contact and proximity of the trajectories part, part + parts, ..., the
    work of one thread.

    Args:
        part, parts: index of the thread, and number of threads.
        resting: collision model with the clearances required from resting obstacles and between
            links; -inf (no requirement) for moving obstacles.
        moving: collision model with the clearances required from moving obstacles; -inf for others.
        q: (N, T, n) configurations, the first one a step after the time `moving.now` [rad].
        step: time between two configurations [s].
        margin: distance beyond the clearance required from moving obstacles within which proximity
            is penalized at time 0 [m].
        out: (N, 5) results, initially 0, set in place: costs of contact and of proximity to moving
            and to resting obstacles, time of the first contact [s], and number of checked
            configurations.
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
            # Only contact between links is a cost, not their proximity.
            resting_margins[:], resting_margins[SELF] = _RESTING_MARGIN, 0.0
            lower_clearance_margins(
                X, t, spheres, resting.geometries, resting.required, center, resting_margins,
                -np.inf,
            )  # fmt: skip
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
