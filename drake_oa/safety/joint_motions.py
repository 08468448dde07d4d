"""Joint motions in time: tracking of the tool, legs, and clearance.

A maneuver consists of two legs. In each leg every joint moves to its own target at bounded speed
and acceleration (trapezoidal velocity), and stays there: each leg ends at rest by itself.
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

_DRAWN = 1e-4
"""Damping of the velocity of a tracked motion [m^2]."""
_DEPTH = 0.03
"""Depth of a contact that costs twice as much as a touch [m]."""
_AT_LIMIT = 1e-3
"""Distance beyond a joint's limit that is only an error of interpolation [rad]."""
_EACH = 8
"""Motions for which another thread pays."""


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
    """Computes the joint state with the tool at a pose and velocity one step later.

    Args:
        chain: the arm.
        q: (n,) joints now [rad].
        X_WE: (12,) pose of the tool now: rotation, row by row, and position [m].
        V_WE: (6,) its mean velocity in the step: angular [rad/s], linear [m/s].
        posture: (2n,) posture that the null space follows, then [rad], and its velocity [rad/s].
        step: length of the step [s].
        rate: at which the null space converges to the posture [1/s].

    Returns:
        (n,) positions [rad] and (n,) velocities [rad/s] after the step.
    """
    n, room, pull = len(q), scratch(len(q)), 1.0 - math.exp(-rate * step)
    guide = np.empty((2, n))
    guide[1] = posture[:n]
    guide[0] = posture[:n] - step * posture[n:]
    X_next = X_WE.copy()
    X_next[9:] += step * V_WE[3:]
    for k in range(3):
        X_next[k:9:3] += step * np.cross(V_WE[:3], X_WE[k:9:3])
    after = q.copy()
    follow(after, X_next, guide, 1, pull, chain, room)
    ahead = after.copy()
    room.e[:] = step * V_WE
    room.null_step[:] = step * (posture[n:] + rate * (posture[:n] - after))
    step_toward(ahead, _DRAWN, chain, room)
    return after, (ahead - after) / step


@leaf
def advance_leg(
    q: FloatArray, v: FloatArray, target: FloatArray, speed: FloatArray, acceleration: FloatArray,
    step: float,
) -> None:  # fmt: skip
    """Moves joints q (n,) at velocities v (n,), in place, by one step toward a target.

    Args:
        q, v: positions [rad] and velocities [rad/s].
        target: (n,) positions at which the joints come to rest [rad].
        speed: (n,) limits of the speeds in this leg [rad/s].
        acceleration: (n,) limits of the accelerations [rad/s^2].
        step: length of the step [s].
    """
    for i in range(len(q)):
        way, change = target[i] - q[i], acceleration[i] * step
        # Speed from which the joint still stops at the target, in steps of this length.
        most = math.sqrt(0.25 * change * change + 2.0 * acceleration[i] * abs(way)) - 0.5 * change
        wanted = math.copysign(min(most, speed[i]), way)
        after = v[i] + min(max(wanted - v[i], -change), change)
        moved = 0.5 * (v[i] + after) * step
        if abs(way) <= 0.25 * change * step and abs(v[i]) <= change:
            q[i], v[i] = target[i], 0.0
        else:
            q[i], v[i] = q[i] + moved, after


_CONVERGENCE = 30.0
"""Rate at which joints converge to a path that they can follow [1/s]."""


def approach(
    x: FloatArray, path: FloatArray, speed: FloatArray, acceleration: float, step: float
) -> FloatArray:
    """Computes the joint state one step later of joints that follow a path.

    Args:
        x: (2n,) positions [rad] and velocities [rad/s] now.
        path: (2n,) those of the path after the step.
        speed: (n,) limits of the speeds [rad/s].
        acceleration: limit of the accelerations [rad/s^2].
        step: length of the step [s].
    """
    n, change = len(speed), acceleration * step
    q, v = x[:n], x[n:]
    way = path[:n] - q - 0.5 * step * (v + path[n:])
    closing = np.minimum(_CONVERGENCE * np.abs(way), np.sqrt(acceleration * np.abs(way)))
    wanted = np.clip(path[n:] + np.copysign(closing, way), -speed, speed)
    after = v + np.clip(wanted - v, -change, change)
    return np.append(q + 0.5 * step * (v + after), after)


class Legs(NamedTuple):
    """N maneuvers of two legs each.

    Attributes:
        target: (N, 2, n) where each leg ends [rad].
        speed: (N, 2, n) limits of the joint speeds [rad/s].
        switch: (N,) time at which the second leg begins, from the beginning [s].
    """

    target: FloatArray
    speed: FloatArray
    switch: FloatArray


@compiled
def roll_out_legs(
    q: FloatArray, v: FloatArray, legs: Legs, acceleration: FloatArray, step: float, every: int,
    samples: int,
) -> FloatArray:  # fmt: skip
    """Computes joint positions (N, samples, n) along maneuvers, every so many steps [rad].

    Args:
        q, v: (n,) joint state at the beginning [rad, rad/s].
        legs: the maneuvers.
        acceleration: (n,) limits [rad/s^2].
        step: length of a step [s].
        every: number of steps between two samples, the first of which is after so many steps.
        samples: number of samples.
    """
    N, n = len(legs.target), len(q)
    found = np.empty((N, samples, n))
    for i in range(N):
        p, w = q.copy(), v.copy()
        for k in range(samples * every):
            leg = 1 if k * step >= legs.switch[i] else 0
            advance_leg(p, w, legs.target[i, leg], legs.speed[i, leg], acceleration, step)
            if (k + 1) % every == 0:
                found[i, k // every] = p
    return found


_MARGIN_RESTING = 0.03
"""Distance to resting obstacles below which nearness costs a maneuver [m]."""
_GROWTH = 0.1
"""Rate at which the margin of moving obstacles grows with the time ahead [m/s]."""
_DECAY = 0.8
"""Time ahead after which a contact costs 1 / e as much [s]."""


class Judged(NamedTuple):
    """Costs of N motions: (N,) arrays.

    Attributes:
        contact: 0 without a contact, else the more the earlier and the deeper it is [s].
        near_moving, near_resting: integrals of the squared relative violation of the margins [s].
        first: time of the first contact, from the beginning; inf: there is none [s].
    """

    contact: FloatArray
    near_moving: FloatArray
    near_resting: FloatArray
    first: FloatArray


def check_motions(
    resting: ArmCollisionModel, moving: ArmCollisionModel, q: FloatArray, step: float, margin: float
) -> Judged:
    """Computes the costs of N motions among resting and moving solids.

    Args:
        resting: the arm, with the clearance required of resting solids and of itself; -inf of
            others.
        moving: the same of moving solids.
        q: (N, T, n) configurations, the first one a step after `moving.now` [rad].
        step: time between two of them [s].
        margin: distance to moving obstacles below which nearness costs [m].
    """
    table = np.zeros((len(q), 5))
    threads = min(CORES, len(q) // _EACH + 1)
    on_cores(_check_some, threads, resting, moving, q, step, margin, table)
    count(configurations=int(table[:, 4].sum()))
    return Judged(*np.ascontiguousarray(table[:, :4].T))


@parted
def _check_some(
    part: int, parts: int, resting: ArmCollisionModel, moving: ArmCollisionModel, q: FloatArray, step: float,
    margin: float, out: FloatArray,
) -> None:  # fmt: skip
    """Judges motions part, part + parts, ...; out (N, 5): `Judged` and configurations."""
    chain, spheres = resting.chain, resting.spheres
    T, n = q.shape[1:]
    X, center = np.empty((n + 2, 12)), np.empty((len(spheres.group_joint), 3))
    least, near = np.empty(3), np.empty(3)
    for i in range(part, len(q), parts):
        first, looked = np.inf, 0
        for k in range(T):
            since = (k + 1) * step
            t, weight = moving.now + since, math.exp(-since / _DECAY)
            chain_poses(q[i, k], chain.X_PJ, X)
            most = margin + _GROWTH * since
            near[:] = most
            lower_clearance_margins(
                X, t, spheres, moving.geometries, moving.required, center, near, -np.inf
            )
            least[:] = _MARGIN_RESTING
            lower_clearance_margins(
                X, t, spheres, resting.geometries, resting.required, center, least, -np.inf
            )
            looked += 1
            free = min(near[TOOL], near[LINKS])
            rest = min(least[TOOL], least[LINKS])
            lack = most - free
            if lack > 0.0:
                share = lack / most
                out[i, 1] += weight * step * share * share
            lack = _MARGIN_RESTING - rest
            if lack > 0.0:
                share = lack / _MARGIN_RESTING
                out[i, 2] += step * share * share
            within = min(rest, least[SELF])
            if free < 0.0:
                within = min(within, free)
            for j in range(n):
                beyond = max(chain.lower[j] - q[i, k, j], q[i, k, j] - chain.upper[j])
                if beyond > _AT_LIMIT:
                    within = min(within, -_DEPTH)
            if within < 0.0:
                first = since
                out[i, 0] = _DECAY * weight * (1.0 + min(-within / _DEPTH, 3.0))
                break
        out[i, 3], out[i, 4] = first, looked
