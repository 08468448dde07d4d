"""How the arm gets out of the way of what moves toward it.

Slowing and holding keep a motion off what rests; what moves comes at a held robot. Several
ways of the arm over the next second or so are looked at (`drake_oa.safety.lookout`),
among obstacles that go on at their velocities:

- the motion as it goes, which is left so while it keeps the margin for some time;
- the motion at full speed;
- the motion held;
- at full speed or held, and the arm turned in the null space of the tool's task;
- held, and the tool displaced at a velocity of a fixed set of directions and two speeds, at
  the greater one also for a short way only, and with the arm turned.

The first of them that keeps the margin is taken; full speed, where standing still is not
better, also with less. Of the displacements it is the one that keeps most, and among those
about as good the slowest and the nearest to what is in use. What the arm cannot follow within
its joints' limits of position and speed, what leaves the workspace, and what comes nearer
than standing still is not taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from drake_oa.common.messages import Evading, Evasion, FloatArray, PolicyState
from drake_oa.geometry.directions import DIRECTIONS
from drake_oa.geometry.solids import SURROUNDINGS
from drake_oa.safety.config import EvasionSettings
from drake_oa.safety.evasion_candidates import displaced, planned_shift, shortened, stopping_shift
from drake_oa.safety.lookout import FULL, GOES, HELD, Lookout, Ways

_WHOLE, _HALF = 1.0, 0.5

_Wanted: TypeAlias = tuple[FloatArray, FloatArray]
"""(C, m) velocities, and (C,) how far each leads; inf: as far as there is time."""
_FACES = DIRECTIONS[np.count_nonzero(DIRECTIONS, axis=1) == 1]
_LEFT: tuple[Evading, Evading] = ("going on", "waiting")
"""What becomes of the motion while only the arm turns, the better one first."""


NOTHING_MOVES = Evasion()
"""There is nothing to evade."""


def left_alone(before: Evasion) -> Evasion:
    """The motion goes on, and a posture that has left its plan stays where it is."""
    return replace(NOTHING_MOVES, turn=np.zeros_like(before.turn))


@dataclass(frozen=True, eq=False)
class _Now:
    """What is known of the arm and its motion; all ways have (K, .) displacements.

    Attributes:
        before: what was decided last.
        velocity, turning: what the displacement and the null space have now.
        policy: the motion under way.
        full, held: (K, 3) where the motion leads at full speed, and where it comes to rest.
        full_rate: normalised time a second at full speed [1/s].
        ahead: from where the arm is.
        parameters: what is kept.
    """

    before: Evasion
    velocity: FloatArray
    turning: FloatArray
    policy: PolicyState
    full: FloatArray
    held: FloatArray
    full_rate: float
    ahead: Lookout
    parameters: EvasionSettings

    def turned(self, turns: FloatArray, reach: FloatArray | float = math.inf) -> FloatArray:
        """(C, K, n) how far velocities (C, n) of the null space lead [rad]."""
        p = self.parameters
        ways = displaced(self.turning, turns, p.times, p.turn_acceleration)
        return shortened(ways, reach)

    def left(
        self, action: Evading, obstacle: int, clearance: float, turn: FloatArray | None = None
    ) -> Evasion:
        """A decision that leaves the tool to its motion, or to where that is held."""
        # A posture that has been left is not taken up again before the obstacle is past.
        turn = np.zeros_like(self.before.turn) if turn is None else turn
        return Evasion(action, np.zeros(3), obstacle, float(clearance), turn=turn)


def choose(
    before: Evasion,
    velocity: FloatArray,
    turning: FloatArray,
    ahead: Lookout,
    parameters: EvasionSettings,
) -> Evasion:
    """What to do now about what moves, see the module.

    Args:
        before: what was decided last.
        velocity: (3,) what the displacement has now [m/s].
        turning: (n,) velocity of the arm's joints; its part in the null space counts [rad/s].
        ahead: from where the arm is, and its motion.
        parameters: what is kept.
    """
    if not (ahead.scene.moves or before.action):
        return NOTHING_MOVES
    times, p, under = parameters.times, parameters, ahead.underway
    policy, motion, s = under.policy, under.motion, under.s
    rest = displaced(velocity, np.zeros((1, 3)), times, p.acceleration)[0]
    goes = rest + planned_shift(policy, motion, s, policy.speed, times)
    turning = ahead.free @ (ahead.free.T @ turning)
    # The planned posture may turn faster; that is brought to rest by its own law.
    turning *= min(1.0, p.turn_speed / max(float(np.linalg.norm(turning)), 1e-9))
    now = _Now(
        before,
        velocity,
        turning,
        policy,
        full=rest + planned_shift(policy, motion, s, under.full_rate, times),
        held=rest + stopping_shift(policy.speed * policy.z_W, times, p.hold_time),
        full_rate=under.full_rate,
        ahead=ahead,
        parameters=p,
    )
    steady = now.turned(np.zeros((1, len(turning))))
    least = p.margin + (p.release if before.action else 0.0)
    # What rests is the supervisor's; but what has come to rest close by is left room for.
    known = before.action != "" and before.obstacle != SURROUNDINGS
    watched = ahead.moving | (known & (ahead.scene.solids.layout[:, 5] == before.obstacle))
    as_it_goes = np.array([GOES])
    soon = ahead.look(goes[None], steady, as_it_goes, among=watched, until=min(p.notice, p.horizon))
    threat = ahead.nearest(soon, 0, watched)
    moves = threat >= 0 and bool(ahead.moving[threat])
    if threat >= 0 and not moves:
        least = p.margin
    if soon.clearance[0] >= least or threat < 0:
        if not len(before.turn):
            return NOTHING_MOVES
        later = ahead.look(goes[None], steady, as_it_goes, among=watched)
        return NOTHING_MOVES if ahead.nearest(later, 0, watched) < 0 else left_alone(before)
    shifts, led = np.stack([goes, now.full, now.held]), np.array([GOES, FULL, HELD])
    clear = ahead.look(shifts, np.repeat(steady, 3, axis=0), led).clearance
    name = ahead.name(threat)
    if clear[1] >= least:
        return now.left("going on", name, clear[1])
    if clear[2] >= least:
        return now.left("waiting", name, clear[2])
    if clear[1] >= max(p.passing * p.margin, float(clear[2])):
        return now.left("going on", name, clear[1])
    turned = _turned(now, name, least)
    if turned is not None:
        return turned
    v_WO = ahead.velocity(threat) if moves else None
    return _displaced(now, name, v_WO, float(clear[1]), float(clear[2]), least)


def _turned(now: _Now, obstacle: int, least: float) -> Evasion | None:
    """Turns the arm, at full speed or held, where that is enough; else None."""
    turns, reach = _turns(now)
    if not len(turns):
        return None
    shifts = np.repeat([now.full, now.held], len(turns), axis=0)
    turned = np.tile(now.turned(turns, reach), (2, 1, 1))
    led = np.repeat([FULL, HELD], len(turns))
    found = now.ahead.look(shifts, turned, led, enough=least)
    cost = _cost(turns, now.before.turn, now.parameters)
    for action, kept in zip(_LEFT, found.clearance.reshape(2, -1), strict=True):
        if kept.max() >= least:
            way = int(np.where(kept >= least, cost, np.inf).argmin())
            return now.left(action, obstacle, kept[way], turns[way])
    return None


def _displaced(
    now: _Now, obstacle: int, v_WO: FloatArray | None, goes_on: float, stands: float, least: float
) -> Evasion:
    """Displaces the tool where that is better than to go on or to stand still.

    Args:
        now: see there.
        obstacle: its name.
        v_WO: (3,) its velocity [m/s]; None: it has come to rest.
        goes_on, stands: the clearance at full speed and held [m].
        least: more is no better [m].
    """
    p = now.parameters
    (wanted, far), (turns, swing) = _candidates(now)
    shifts = shortened(displaced(now.velocity, wanted, p.times, p.acceleration), far)
    shifts += stopping_shift(now.policy.speed * now.policy.z_W, p.times, p.hold_time)
    # Beyond the margin more is not better; and what stands still can always do so.
    still = min(stands, least)
    ways = now.ahead.look(
        shifts,
        now.turned(turns, swing),
        np.full(len(shifts), HELD),
        enough=still - 1e-9,
        plenty=least,
        behind=p.as_good,
    )
    worth = np.minimum(ways.clearance, least)
    best = max(float(worth.max()), still)
    if not math.isfinite(best):
        return _at_its_limits(now, obstacle, ways)
    if min(goes_on, least) >= best - p.as_good and goes_on > 0.0:
        return now.left("going on", obstacle, goes_on)
    good = worth >= max(best - p.as_good, still)
    if not good.any():
        return now.left("waiting", obstacle, stands)
    cost = _cost(wanted, now.before.velocity, p) + p.turning * _cost(turns, now.before.turn, p)
    if v_WO is not None:
        # Who runs ahead of it is followed; who steps aside is passed.
        cost = cost + p.along * np.maximum(wanted @ (v_WO / np.linalg.norm(v_WO)), 0.0)
    way = int(np.where(good, cost, np.inf).argmin())
    if v_WO is None and not turns[way].any() and np.linalg.norm(wanted[way]) < p.slow:
        return NOTHING_MOVES
    turn = turns[way] if turns[way].any() else np.zeros_like(now.before.turn)
    contact = _contact(now, ways, way)
    action: Evading = "evading" if math.isinf(contact) else "caught"
    return Evasion(action, wanted[way], obstacle, float(ways.clearance[way]), contact, turn)


def _contact(now: _Now, ways: Ways, way: int) -> float:
    """In how long a way ends in a contact with what moves [s]; inf: it does not."""
    ahead = now.ahead
    row = ahead.nearest(ways, way)
    touches = row >= 0 and ahead.moving[row] and ahead.gap(ways, way, row) <= 0.0
    return float(ways.when[way]) if touches else math.inf


def _at_its_limits(now: _Now, obstacle: int, ways: Ways) -> Evasion:
    """Holds an arm that can go none of the ways, and tells what its first one would lead to."""
    held = now.left("waiting", obstacle, ways.distance[0])
    contact = _contact(now, ways, 0)
    return held if math.isinf(contact) else replace(held, action="caught", contact=contact)


def _cost(wanted: FloatArray, before: FloatArray, p: EvasionSettings) -> FloatArray:
    """(C,) of velocities (C, m): slow ones, and those like the last one, are cheap."""
    change = wanted - before if len(before) else wanted
    return np.asarray(np.linalg.norm(wanted, axis=1) + p.steady * np.linalg.norm(change, axis=1))


def _turns(now: _Now) -> _Wanted:
    """Velocities of the null space [rad/s] that are looked at, the last one first; or none."""
    free, most = now.ahead.free, now.parameters.turn_speed
    if most == 0.0 or not free.shape[1]:
        return np.zeros((0, len(now.turning))), np.zeros(0)
    both = np.concatenate([free.T, -free.T])
    shares, reach = (_WHOLE, _WHOLE, _HALF), (math.inf, now.parameters.short_turn, math.inf)
    turns = np.concatenate([share * most * both for share in shares])
    far = np.repeat(reach, len(both))
    if now.before.turn.any():
        last = free @ (free.T @ now.before.turn)
        return np.concatenate([last[None], turns]), np.concatenate([[math.inf], far])
    return turns, far


def _candidates(now: _Now) -> tuple[_Wanted, _Wanted]:
    """Velocities of the tool [m/s], and of the null space [rad/s], that are looked at.

    The first way has none at all, the second the last one of the tool.
    """
    p = now.parameters
    first = np.stack([np.zeros(3), now.before.velocity])
    along = now.full_rate * now.policy.z_W
    speed = float(np.linalg.norm(along))
    if speed > 1e-3:
        along = along * min(1.0, p.speed / speed)
    fast, slow = (share * p.speed * DIRECTIONS for share in (_WHOLE, _HALF))
    plain = np.concatenate([first, along[None], fast, slow, *[fast] * len(p.short_ways)])
    far = np.full(len(plain), np.inf)
    far[-len(fast) * len(p.short_ways) :] = np.repeat(p.short_ways, len(fast))
    turns, swing = _turns(now)
    with_turn = np.concatenate([first, p.speed * _FACES])
    none, both = np.zeros((len(plain), len(now.turning))), len(with_turn) * len(turns)
    return (
        np.concatenate([plain, np.repeat(with_turn, len(turns), axis=0)]),
        np.concatenate([far, np.full(both, p.short_ways[0])]),
    ), (
        np.concatenate([none, np.tile(turns, (len(with_turn), 1))]),
        np.concatenate([np.full(len(plain), np.inf), np.tile(swing, len(with_turn))]),
    )
