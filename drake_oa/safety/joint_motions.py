"""Joint motions in time: tracking of the tool's motion, legs of maneuvers, and their clearance.

A maneuver consists of two legs. In each leg every joint moves to its own target at bounded speed
and acceleration, and stays there: each leg ends at rest by itself.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from drake_oa.common.compiled import CORES, compiled, leaf, on_cores, parted
from drake_oa.common.messages import FloatArray
from drake_oa.common.thinking import count
from drake_oa.planning.arm_world import LINKS, SELF, TOOL, ArmWorld, lower_excess
from drake_oa.robot.arm import Chain, chain_poses, follow, scratch, step_toward

_DRAWN = 1e-4
"""Damping of the velocity of a tracked motion [m^2]."""
_DEPTH = 0.03
"""Depth of a contact that costs twice as much as a touch [m]."""
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
    room.lead[:] = step * (posture[n:] + rate * (posture[:n] - after))
    step_toward(ahead, _DRAWN, chain, room)
    return after, (ahead - after) / step


_CONVERGENCE = 30.0
"""Rate at which joints converge to a path that they can follow [1/s]."""


@leaf
def advance(
    q: FloatArray, v: FloatArray, q_path: FloatArray, v_path: FloatArray, speed: FloatArray,
    acceleration: float, step: float,
) -> None:  # fmt: skip
    """Moves joints, in place, by one step toward a path.

    Args:
        q, v: (n,) positions [rad] and velocities [rad/s].
        q_path, v_path: (n,) those of the path after the step.
        speed: (n,) limits of the speeds [rad/s].
        acceleration: limit of the accelerations [rad/s^2].
        step: length of the step [s].
    """
    change = acceleration * step
    for i in range(len(q)):
        way = q_path[i] - q[i] - 0.5 * step * (v[i] + v_path[i])
        closing = min(_CONVERGENCE * abs(way), math.sqrt(acceleration * abs(way)))
        wanted = v_path[i] + math.copysign(closing, way)
        wanted = min(max(wanted, -speed[i]), speed[i])
        after = v[i] + min(max(wanted - v[i], -change), change)
        q[i] += 0.5 * step * (v[i] + after)
        v[i] = after


@compiled
def roll_out_legs(
    q: FloatArray, v: FloatArray, target: FloatArray, speed: FloatArray, switch: float,
    acceleration: float, step: float, every: int, samples: int,
) -> FloatArray:  # fmt: skip
    """Computes joint positions (samples, n) along a maneuver, every so many steps [rad].

    Args:
        q, v: (n,) joint state at the beginning, changed in place [rad, rad/s].
        target: (2, n) ends of the legs [rad].
        speed: (2, n) limits of the joint speeds [rad/s].
        switch: time at which the second leg begins, from the beginning [s].
        acceleration: limit of the accelerations [rad/s^2].
        step: length of a step [s].
        every: number of steps between two samples, the first of which is after so many steps.
        samples: number of samples.
    """
    found, rest = np.empty((samples, len(q))), np.zeros(len(q))
    for k in range(samples * every):
        leg = 1 if k * step >= switch else 0
        advance(q, v, target[leg], rest, speed[leg], acceleration, step)
        found[k // every] = q
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


def judge_motions(
    resting: ArmWorld, moving: ArmWorld, q: FloatArray, step: float, margin: float
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
    table = np.zeros((len(q), 4))
    threads = min(CORES, len(q) // _EACH + 1)
    on_cores(_judge_some, threads, resting, moving, q, step, margin, table)
    count(configurations=q.shape[0] * q.shape[1])
    return Judged(*np.ascontiguousarray(table.T))


@parted
def _judge_some(
    part: int, parts: int, resting: ArmWorld, moving: ArmWorld, q: FloatArray, step: float,
    margin: float, out: FloatArray,
) -> None:  # fmt: skip
    """Judges motions part, part + parts, ...; out (N, 4): `Judged`."""
    chain, spheres = resting.chain, resting.spheres
    T, n = q.shape[1:]
    X, center = np.empty((n + 2, 12)), np.empty((len(spheres.group_joint), 3))
    least, near = np.empty(3), np.empty(3)
    for i in range(part, len(q), parts):
        out[i, 3] = np.inf
        for k in range(T):
            since = (k + 1) * step
            t, weight = moving.now + since, math.exp(-since / _DECAY)
            chain_poses(q[i, k], chain.X_PJ, X)
            most = margin + _GROWTH * since
            near[:] = most
            lower_excess(X, t, spheres, moving.solids, moving.asked, center, near, -np.inf)
            least[:] = _MARGIN_RESTING
            lower_excess(X, t, spheres, resting.solids, resting.asked, center, least, -np.inf)
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
            if within < 0.0:
                out[i, 3] = since
                out[i, 0] = _DECAY * weight * (1.0 + min(-within / _DEPTH, 3.0))
                break
