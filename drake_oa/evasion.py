"""How the tool gets out of the way of what moves toward the arm.

Slowing and holding keep a motion off what rests; what moves comes at a held robot. Several
ways of the tool over the next second or so are followed with the whole arm
(`drake_oa.evasion_kernels`), among obstacles that go on at their velocities:

- the motion as it goes, which is left so while it keeps the margin for some time;
- the motion at full speed;
- the motion held;
- held, and the tool displaced at a velocity of a fixed set of directions and two speeds.

The first of them that keeps the margin is taken; full speed, where standing still is not
better, also with less. Of the displacements it is the one that keeps most, and among those
about as good the slowest and the nearest to what is in use. What the arm cannot follow within
its joints' limits of position and speed, what leaves the workspace, and what comes nearer
than standing still is not taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from drake_oa.lookout import EvasionParameters, Lookout
from drake_oa.supervision_geometry import ObstaclePoints
from drake_oa.values import FloatArray, Frozen, PlannedMotion, PolicyState

Evading = Literal["", "going on", "waiting", "evading", "caught"]

_PASSING = 0.6
"""Share of the margin with which the motion goes on rather than evades."""
_AS_GOOD = 5e-3
"""Clearances that differ by less are alike [m]."""
_STEADY = 0.5
"""What a change of velocity costs, as a share of the velocity."""
_FULL, _HALF = 1.0, 0.5
_CERTAIN = 0.4
"""A contact that cannot be evaded is certain when it is no farther ahead than this [s]."""
_AHEAD = 1.0
"""What a velocity along that of the obstacle costs besides, as a share of it."""
_SLOW = 0.03
"""A displacement below this does not lead away from what has come to rest [m/s]."""


def _directions() -> FloatArray:
    """(26, 3) unit vectors to the faces, edges and corners of a cube."""
    grid = np.array(np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3, indexing="ij")).reshape(3, -1).T
    grid = grid[np.any(grid != 0.0, axis=1)]
    return np.asarray(grid / np.linalg.norm(grid, axis=1, keepdims=True))


DIRECTIONS = _directions()


@dataclass(frozen=True, eq=False)
class Evasion(Frozen):
    """What has been decided against what moves.

    Attributes:
        action: ""; "going on": the motion goes on at full speed past what comes near;
            "waiting": it is held; "evading": it is held, and the tool displaced; "caught":
            the same, but no way was found without a contact.
        velocity: (3,) wanted of the displacement, in the world [m/s].
        obstacle: name of the obstacle; -1: none.
        clearance: least distance that is expected [m].
        contact: in how long the contact is expected, of "caught" [s]; else inf.
    """

    action: Evading = ""
    velocity: FloatArray = field(default_factory=lambda: np.zeros(3))
    obstacle: int = -1
    clearance: float = math.inf
    contact: float = math.inf

    @property
    def certain(self) -> bool:
        """Whether a contact is near that cannot be evaded."""
        return self.action == "caught" and self.contact <= _CERTAIN


NOTHING_MOVES = Evasion()
"""There is nothing to evade."""


def displaced(
    velocity: FloatArray, wanted: FloatArray, times: FloatArray, acceleration: float
) -> FloatArray:
    """How far a displacement has led.

    Args:
        velocity: (3,) what it has now [m/s].
        wanted: (C, 3) velocities that it is brought to at a constant acceleration [m/s].
        times: (K,) [s].
        acceleration: [m/s^2].

    Returns:
        (C, K, 3) [m].
    """
    change = wanted - velocity
    size = np.linalg.norm(change, axis=1)
    until = (size / acceleration)[:, None, None]
    t = times[None, :, None]
    ramp = np.minimum(t, until)
    rate = (change / np.maximum(size, 1e-12)[:, None] * acceleration)[:, None]
    return np.asarray(velocity * t + rate * ramp * (0.5 * ramp + np.maximum(t - until, 0.0)))


def ramped(
    velocity: FloatArray, wanted: FloatArray, acceleration: float, step: float
) -> FloatArray:
    """(3,) the velocity a step [s] later, on its way to the wanted one [m/s]."""
    change = wanted - velocity
    size = float(np.linalg.norm(change))
    most = acceleration * step
    return np.array(wanted if size <= most else velocity + change * (most / size))


def planned_shift(
    policy: PolicyState,
    motion: PlannedMotion | None,
    s: float,
    rate: float,
    times: FloatArray,
) -> FloatArray:
    """How far the motion leads the tool at a rate of normalised time.

    Args:
        policy: where it is.
        motion: what is expected of it, or None: it goes straight on.
        s: normalised time now.
        rate: ds/dt [1/s].
        times: (K,) [s].

    Returns:
        (K, 3) [m].
    """
    if motion is None or len(motion) < 2 or s >= motion.s[-1]:
        left = np.minimum(rate * times, max(1.0 - s, 0.0))
        return np.asarray(left[:, None] * policy.z_W)
    at = s + rate * times
    path = np.stack([np.interp(at, motion.s, axis) for axis in motion.p_WE.T], axis=-1)
    here = np.array([np.interp(s, motion.s, axis) for axis in motion.p_WE.T])
    return np.asarray(path - here)


def stopping_shift(v_WE: FloatArray, times: FloatArray, hold_time: float) -> FloatArray:
    """(K, 3) how far a motion at v_WE (3,) still leads while it is brought to rest [m]."""
    t = np.minimum(times, hold_time)
    return np.asarray((t - 0.5 * t * t / hold_time)[:, None] * v_WE)


def choose(
    before: Evasion,
    velocity: FloatArray,
    policy: PolicyState,
    motion: PlannedMotion | None,
    s: float,
    full_rate: float,
    ahead: Lookout,
    obstacles: ObstaclePoints,
    parameters: EvasionParameters,
) -> Evasion:
    """What to do now about what moves, see the module.

    Args:
        before: what was decided last.
        velocity: (3,) what the displacement has now [m/s].
        policy: the motion under way.
        motion: what is expected of it, or None.
        s: normalised time now.
        full_rate: its rate at full speed, 1 / (tau T) [1/s].
        ahead: from where the arm is.
        obstacles: what it looks at.
        parameters: what is kept.
    """
    if not (obstacles.v_WO.any() or before.action):
        return NOTHING_MOVES
    times, p = parameters.times, parameters
    rest = displaced(velocity, np.zeros((1, 3)), times, p.acceleration)[0]
    goes = rest + planned_shift(policy, motion, s, policy.speed, times)
    full = rest + planned_shift(policy, motion, s, full_rate, times)
    held = rest + stopping_shift(policy.speed * policy.z_W, times, p.hold_time)
    least = p.margin + (p.release if before.action else 0.0)
    # What of the world rests is the supervisor's; nothing is done for it here.
    soon = ahead.look(goes[None], until=p.notice)
    threat = int(soon.row[0])
    moves = _moves(obstacles, threat)
    # What has come to rest close by is left room for.
    stopped = not moves and before.action != "" and _name(obstacles, threat) == before.obstacle
    if stopped:
        least = p.margin
    if soon.clearance[0] >= least or not (moves or (stopped and threat >= 0)):
        return NOTHING_MOVES
    found = ahead.look(np.stack([goes, full, held]))
    clear = found.clearance
    name = _name(obstacles, threat)

    def told(action: Evading, way: int) -> Evasion:
        return Evasion(action, np.zeros(3), name, float(clear[way]))

    if clear[1] >= least:
        return told("going on", 1)
    if clear[2] >= least:
        return told("waiting", 2)
    if clear[1] >= max(_PASSING * p.margin, float(clear[2])):
        return told("going on", 1)
    wanted = _candidates(before, policy, full_rate, p)
    shifts = displaced(velocity, wanted, times, p.acceleration)
    shifts += stopping_shift(policy.speed * policy.z_W, times, p.hold_time)
    ways = ahead.look(shifts, plenty=least, behind=_AS_GOOD)
    # Beyond the margin more is not better; and what stands still can always do so.
    worth = np.minimum(ways.clearance, least)
    still = min(float(clear[2]), least) if math.isfinite(clear[2]) else float(worth[0])
    best = max(float(worth.max()), still)
    if min(float(clear[1]), least) >= best - _AS_GOOD and clear[1] > 0.0:
        return told("going on", 1)
    good = worth >= max(best - _AS_GOOD, still)
    if not good.any():
        return told("waiting", 2)
    cost = np.linalg.norm(wanted, axis=1)
    cost = cost + _STEADY * np.linalg.norm(wanted - before.velocity, axis=1)
    if moves:
        # Who runs ahead of it is followed; who steps aside is passed.
        v_WO = obstacles.v_WO[threat]
        cost = cost + _AHEAD * np.maximum(wanted @ (v_WO / np.linalg.norm(v_WO)), 0.0)
    way = int(np.where(good, cost, np.inf).argmin())
    if stopped and np.linalg.norm(wanted[way]) < _SLOW:
        return NOTHING_MOVES
    clearance = float(ways.clearance[way])
    caught = clearance + p.growth * float(ways.when[way]) + p.padding <= 0.0 and moves
    return Evasion(
        "caught" if caught else "evading",
        wanted[way],
        name,
        clearance,
        float(ways.when[way]) if caught else math.inf,
    )


def _name(obstacles: ObstaclePoints, row: int) -> int:
    return int(obstacles.ids[row]) if row >= 0 else -1


def _moves(obstacles: ObstaclePoints, row: int) -> bool:
    return row >= 0 and bool(obstacles.v_WO[row].any())


def _candidates(
    before: Evasion, policy: PolicyState, full_rate: float, parameters: EvasionParameters
) -> FloatArray:
    """(C, 3) velocities of displacements [m/s]; the first is none, the second the last one."""
    along = full_rate * policy.z_W
    speed = float(np.linalg.norm(along))
    wanted = [np.zeros((1, 3)), before.velocity[None]]
    if speed > 1e-3:
        wanted.append(along[None] * min(1.0, parameters.speed / speed))
    wanted += [share * parameters.speed * DIRECTIONS for share in (_FULL, _HALF)]
    return np.concatenate(wanted)
