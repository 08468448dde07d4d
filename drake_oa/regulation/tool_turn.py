"""Turning the tool about a fixed axis, so that a long one passes where it would not fit.

Of a few turns the one is taken whose verified motion, among the obstacles dilated by the
tool turned so, costs least: length of the way over the baseline, a price per radian, and some
hysteresis. The tool turns to it as far as what it sweeps on the spot is free, and the motion
is slowed so that it is not where a turn in between would touch; it is turned back as soon as
what lies ahead is free without it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numba import njit

from drake_oa.common.messages import EllipsoidSet, FloatArray, Frozen, ObstacleClouds, PolicyState
from drake_oa.common.thinking import count
from drake_oa.descriptor.descriptor import describe, merged_parts
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.geometry.rotation import turned_about, unit_axis
from drake_oa.geometry.voxels import thinned
from drake_oa.regulation.regulation import Regulation
from drake_oa.regulation.regulator import Regulator


@njit(cache=True, fastmath=False)
def tool_clearance(
    points: FloatArray,
    p_WE: FloatArray,
    turns: FloatArray,
    axis: FloatArray,
    center: FloatArray,
    R: FloatArray,
    half: FloatArray,
    most: float,
) -> FloatArray:
    """Least distance of a tool of boxes to points, at each place and turn.

    Args:
        points: (N, 3) in W [m].
        p_WE: (P, 3) places of the tool point [m].
        turns: (A,) turns about the axis through it [rad].
        axis: (3,) unit, in W.
        center: (B, 3) centres of the boxes from the tool point, at turn 0 [m].
        R: (B, 3, 3) their rotations R_WB at turn 0.
        half: (B, 3) half their edges [m].
        most: distances are not looked at beyond this [m].

    Returns:
        (P, A) distances, 0 inside, at most `most` [m].
    """
    P, A, N, B = len(p_WE), len(turns), len(points), len(center)
    reach = np.empty(B)
    for b in range(B):
        reach[b] = math.sqrt(half[b, 0] ** 2 + half[b, 1] ** 2 + half[b, 2] ** 2)
    largest = 0.0
    for b in range(B):
        middle = math.sqrt(center[b, 0] ** 2 + center[b, 1] ** 2 + center[b, 2] ** 2)
        largest = max(largest, middle + reach[b])
    found = np.empty((P, A))
    near = np.empty((N, 3))
    for p in range(P):
        count = 0
        for n in range(N):
            x = points[n, 0] - p_WE[p, 0]
            y = points[n, 1] - p_WE[p, 1]
            z = points[n, 2] - p_WE[p, 2]
            if x * x + y * y + z * z < (largest + most) ** 2:
                near[count, 0], near[count, 1], near[count, 2] = x, y, z
                count += 1
        for a in range(A):
            cos, sin = math.cos(turns[a]), math.sin(turns[a])
            least = most * most
            for n in range(count):
                x, y, z = near[n, 0], near[n, 1], near[n, 2]
                # Turned back: Rodrigues' formula with -turn.
                along = (axis[0] * x + axis[1] * y + axis[2] * z) * (1.0 - cos)
                u = cos * x - sin * (axis[1] * z - axis[2] * y) + along * axis[0]
                v = cos * y - sin * (axis[2] * x - axis[0] * z) + along * axis[1]
                w = cos * z - sin * (axis[0] * y - axis[1] * x) + along * axis[2]
                for b in range(B):
                    i, j, k = u - center[b, 0], v - center[b, 1], w - center[b, 2]
                    total = 0.0
                    for c in range(3):
                        q = abs(R[b, 0, c] * i + R[b, 1, c] * j + R[b, 2, c] * k) - half[b, c]
                        if q > 0.0:
                            total += q * q
                    least = min(least, total)
            found[p, a] = math.sqrt(least)
    return found


@dataclass(frozen=True)
class TurnParameters:
    """Which turns there are, and what they cost.

    Attributes:
        largest: largest turn either way [rad].
        step: between the turns that are tried [rad].
        speed: how fast the tool turns at most [rad/s].
        margin: distance that the tool keeps from obstacles while it turns [m].
        price: of a radian, in baselines.
        hysteresis: price of a radian away from the turn in use, in baselines.
        period: time between looks at other turns [s].

    Raises:
        ValueError: for a value that is not finite, negative, or 0 where that makes no sense.
    """

    largest: float = math.pi / 2.0
    step: float = math.pi / 12.0
    speed: float = 1.0
    margin: float = 0.03
    price: float = 0.1
    hysteresis: float = 0.02
    period: float = 0.25

    def __post_init__(self) -> None:
        for name in ("largest", "step", "speed", "period"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be finite and positive, not {getattr(self, name)}")
        for name in ("margin", "price", "hysteresis"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(
                    f"{name} must be finite and not negative, not {getattr(self, name)}"
                )

    @property
    def turns(self) -> list[float]:
        """Those that are tried, the smallest first, either way [rad]."""
        count = math.floor(self.largest / self.step + 1e-9)
        steps = [self.step * n for n in range(1, count + 1)]
        if self.largest - count * self.step > 1e-6:
            steps.append(self.largest)
        return [0.0, *(sign * turn for turn in steps for sign in (1.0, -1.0))]


@dataclass(frozen=True, eq=False)
class TurningTool(Frozen):
    """A tool of convex parts that is turned about an axis of the world through E.

    Attributes:
        parts: (K_i, 3) vertices of each part from E, in W, at turn 0 [m].
        axis: (3,) unit vector in W.
        center: (B, 3) centres of the boxes round the parts [m].
        R: (B, 3, 3) their rotations R_WB.
        half: (B, 3) half their edges [m].
    """

    parts: tuple[FloatArray, ...]
    axis: FloatArray
    center: FloatArray
    R: FloatArray
    half: FloatArray

    @classmethod
    def of(
        cls, parts: tuple[FloatArray, ...] | list[FloatArray], axis: FloatArray, R_WE: FloatArray
    ) -> TurningTool:
        """A tool by its parts.

        Args:
            parts: (K_i, 3) vertices from E in W [m].
            axis: (3,) in W, of any length but 0.
            R_WE: (3, 3) orientation of the tool at turn 0, along which its boxes are.

        Raises:
            ValueError: for an axis without direction, or no parts.
        """
        if not len(parts):
            raise ValueError("a tool needs at least one part")
        low = np.array([(part @ R_WE).min(axis=0) for part in parts])
        high = np.array([(part @ R_WE).max(axis=0) for part in parts])
        return cls(
            tuple(np.array(part, dtype=float) for part in parts),
            unit_axis(axis),
            np.ascontiguousarray(0.5 * (low + high) @ R_WE.T),
            np.ascontiguousarray(np.broadcast_to(R_WE, (len(parts), 3, 3))),
            0.5 * (high - low),
        )

    @property
    def corners(self) -> FloatArray:
        """(K, 3) vertices of all parts at turn 0 [m]."""
        return np.concatenate(self.parts)

    def clearance(
        self, points: FloatArray, places: FloatArray, turns: FloatArray, most: float
    ) -> FloatArray:
        """Least distance to points (N, 3) at places (P, 3) and turns (A,), (P, A).

        It is 0 inside, and `most` where it is more [m].
        """
        return np.asarray(
            tool_clearance(
                np.ascontiguousarray(points, dtype=float),
                np.ascontiguousarray(places, dtype=float),
                np.ascontiguousarray(turns, dtype=float),
                self.axis,
                self.center,
                self.R,
                self.half,
                most,
            )
        )


_MISSED = 5e-3
"""How far from the goal a motion may end that a turn is taken for [m]."""
_SHORT = 2e-3
"""How much of the feasible clearance it may lack [m]."""
_SAME = 5e-3
"""By how much an obstacle may seem to move or grow from frame to frame [m]."""
_VOXEL = 0.01
"""Obstacles are looked at by one point in each cube of this edge [m]."""
_ANGLE_STEP = math.radians(7.5)
"""Between the turns that a sweep is looked at in, at most [rad]."""
_NEARLY = 0.02
"""A tool is turned as it should be when it is this near to it [rad]."""
_LAG = 0.3
"""How long the motion and the turn take to follow what is decided [s]."""
_GUARD = 0.02
"""Distance that is left to where a turn in between would touch [m]."""
_PATIENCE = 4.0
"""How many times as long it waits for another look where no turn was found."""
_ROOM = 1e-3
"""By how much a sweep may come nearer than the tool is already [m]."""


@dataclass(frozen=True, eq=False)
class TurnChoice(Frozen):
    """What was decided last.

    Attributes:
        planned: turn in which the tool is to pass [rad]; the obstacles are dilated by the
            tool turned so.
        turn: turn that the tool may take now: as far towards it as the sweep is free [rad].
        speed_scale: share of full speed at which the motion may go meanwhile, in [0, 1].
        regulation: the motion that was verified with it.
        obstacles: among what.
        points: (N, 3) points of them [m].
        searched: time of the last look at other turns [s].
        blocked: whether no turn was found.
    """

    planned: float = 0.0
    turn: float = 0.0
    speed_scale: float = 1.0
    regulation: Regulation = field(default_factory=Regulation)
    obstacles: ObstacleClouds = field(default_factory=ObstacleClouds)
    points: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    searched: float = -math.inf
    blocked: bool = False


class ToolTurner:
    """Chooses turns of one tool in one world."""

    def __init__(
        self,
        tool: TurningTool,
        regulator: Regulator,
        duration: float,
        parameters: TurnParameters | None = None,
        *,
        quick: Regulator | None = None,
        turns: Sequence[float] | None = None,
        free_W: FloatArray | None = None,
    ) -> None:
        """Keeps what does not change.

        Args:
            tool: what turns.
            regulator: that verifies the motions.
            duration: T of the movement primitive [s].
            parameters: None: the defaults.
            quick: a regulator that searches less, asked about each turn first; None: the same.
            turns: those that are tried, the smallest first [rad]; None: all of the parameters.
            free_W: (F, 3) tool points that are known to be free besides the goal, see
                `descriptor.describe` [m].
        """
        self._tool = tool
        self._regulator = regulator
        self._parameters = parameters or TurnParameters()
        self._quick = quick
        self._turns = self._parameters.turns if turns is None else list(turns)
        self._duration = duration
        self._free_W = np.zeros((0, 3)) if free_W is None else np.asarray(free_W, dtype=float)

    @property
    def largest(self) -> float:
        """Largest turn that is tried [rad]."""
        return self._parameters.largest

    def update(
        self,
        before: TurnChoice,
        policy: PolicyState,
        p_WG: FloatArray,
        obstacles: ObstacleClouds,
        now: float,
    ) -> TurnChoice:
        """Looks at a motion under way.

        Args:
            before: what was decided last.
            policy: where the motion is.
            p_WG: (3,) its goal [m].
            obstacles: as they were seen last.
            now: turn that the tool has [rad].

        Returns:
            What to go by from now on: turn 0 while nothing has been seen.
        """
        if obstacles.stamp == -math.inf or math.dist(p_WG, policy.p_WS) == 0.0:
            return TurnChoice()
        first = before.searched == -math.inf
        same = not first and _same_clouds(before.obstacles, obstacles)
        here = replace(
            before,
            obstacles=obstacles,
            points=before.points if same else _thinned(obstacles),
        )
        seen = (
            before.regulation.ellipsoids if same else self.described(obstacles, here.planned, p_WG)
        )
        changed = not (
            _hardly_moved(before.regulation.ellipsoids, seen)
            and np.array_equal(before.regulation.p_WG, p_WG)
            and self._sweep_is_free(here.points, policy.p_WE, now, here.planned)
        )
        wait = self._parameters.period * (_PATIENCE if before.blocked else 1.0)
        due = policy.stamp >= before.searched + wait - 1e-6
        if first or (changed and due):
            here = self._reconsidered(here, policy, p_WG, seen, now, first=first)
        elif here.planned != 0.0 and due:
            here = self._turned_back(replace(here, searched=policy.stamp), policy, p_WG, now)
        return self._on_the_way(here, policy, p_WG, now)

    def described(self, obstacles: ObstacleClouds, turn: float, p_WG: FloatArray) -> EllipsoidSet:
        """The obstacles dilated by the turned tool."""
        parts = [turned_about(part, self._tool.axis, turn) for part in self._tool.parts]
        return describe(
            obstacles,
            np.concatenate(parts),
            free_W=np.vstack([self._free_W, p_WG]),
            tool_parts=[
                turned_about(part, self._tool.axis, turn) for part in merged_parts(self._tool.parts)
            ],
        )

    def _reconsidered(
        self,
        here: TurnChoice,
        policy: PolicyState,
        p_WG: FloatArray,
        seen: EllipsoidSet,
        now: float,
        *,
        first: bool,
    ) -> TurnChoice:
        here = replace(here, searched=policy.stamp)
        if not first:
            kept = self._regulator.update(here.regulation, policy, p_WG, seen, seen.table)
            if _will_do(kept, policy) and self._sweep_is_free(
                here.points, policy.p_WE, now, here.planned
            ):
                here = replace(here, regulation=kept, blocked=False)
                return here if here.planned == 0.0 else self._turned_back(here, policy, p_WG, now)
        found = self._search(here, policy, p_WG, now)
        if found is not None:
            return found
        kept = self._regulator.update(Regulation(), policy, p_WG, seen, seen.table)
        return replace(here, regulation=kept, blocked=True)

    def _search(
        self, here: TurnChoice, policy: PolicyState, p_WG: FloatArray, now: float
    ) -> TurnChoice | None:
        """The turn of least cost that will do, and can be turned to here and back at the goal.

        None is turned to because of a motion without a turn that a longer search would find.
        """
        thorough = [0.0] if here.planned == 0.0 else [0.0, here.planned]
        found = self._best(here, policy, p_WG, now, thorough)
        return found or self._best(here, policy, p_WG, now, self._turns)

    def _best(
        self,
        here: TurnChoice,
        policy: PolicyState,
        p_WG: FloatArray,
        now: float,
        thorough: Sequence[float],
    ) -> TurnChoice | None:
        """The turn of least cost; only some are looked at thoroughly."""
        p, best, found = self._parameters, math.inf, None
        baseline = math.dist(p_WG, policy.p_WS)
        straight = math.dist(p_WG, policy.p_WE) / baseline
        for turn in self._turns:
            cost = p.price * abs(turn) + p.hysteresis * abs(turn - here.planned)
            if cost + straight >= best:
                continue
            if not (
                self._sweep_is_free(here.points, policy.p_WE, now, turn)
                and self._sweep_is_free(here.points, p_WG, 0.0, turn)
            ):
                continue
            seen = self.described(here.obstacles, turn, p_WG)
            regulator = self._regulator
            if self._quick is not None and turn not in thorough:
                regulator = self._quick
            motion = regulator.update(Regulation(), policy, p_WG, seen, seen.table)
            cost += motion.remaining / baseline
            if cost < best and _will_do(motion, policy):
                best = cost
                found = replace(here, planned=turn, regulation=motion, blocked=False)
        return found

    def _turned_back(
        self, here: TurnChoice, policy: PolicyState, p_WG: FloatArray, now: float
    ) -> TurnChoice:
        """Without a turn, where what lies ahead is free so."""
        ahead = _ahead(here, policy, p_WG)
        clearance = self._clearance(here.points, ahead[1:], np.zeros(1))
        if clearance.min() < min(self._parameters.margin, float(clearance[-1, 0]) - _ROOM):
            return here
        if not self._sweep_is_free(here.points, policy.p_WE, now, 0.0):
            return here
        seen = self.described(here.obstacles, 0.0, p_WG)
        motion = self._regulator.update(Regulation(), policy, p_WG, seen, seen.table)
        if not _will_do(motion, policy):
            return here
        return replace(here, planned=0.0, regulation=motion)

    def _on_the_way(
        self, here: TurnChoice, policy: PolicyState, p_WG: FloatArray, now: float
    ) -> TurnChoice:
        """How far the tool may turn, and how fast the motion may go, while it is turning."""
        left = abs(here.planned - now)
        if left < _NEARLY:
            return replace(here, turn=here.planned, speed_scale=1.0)
        turns = _between(now, here.planned)
        clearance = self._clearance(here.points, policy.p_WE[None], turns)[0]
        free = clearance >= min(self._parameters.margin, clearance[0] - _ROOM)
        last = int(free.argmin()) - 1 if not free.all() else len(turns) - 1
        full = float(np.linalg.norm(policy.z_W)) / (policy.tau * self._duration)
        ahead = _ahead(here, policy, p_WG)
        room = self._way_to_blocked(here.points, ahead, turns)
        time = left / self._parameters.speed + _LAG
        scale = 1.0
        if room < math.inf and full > 0.0:
            scale = min(max(room - _GUARD, 0.0) / (time * full), 1.0)
        return replace(here, turn=float(turns[last]), speed_scale=scale)

    def _way_to_blocked(self, points: FloatArray, ahead: FloatArray, turns: FloatArray) -> float:
        """Length of the way to where the tool would touch in one of the turns [m]."""
        clearance = self._clearance(points, ahead, turns)
        # Who is nearer already, as it is turned now, need not go away.
        need = min(self._parameters.margin, float(clearance[0, 0]) - _ROOM)
        blocked = clearance.min(axis=1) < need
        if not blocked.any():
            return math.inf
        before = max(int(blocked.argmax()) - 1, 0)
        return float(np.linalg.norm(np.diff(ahead[: before + 1], axis=0), axis=1).sum())

    def _sweep_is_free(
        self, points: FloatArray, place: FloatArray, one: float, other: float
    ) -> bool:
        """Whether the tool keeps its margin on the spot, or is no nearer than with `one`."""
        clearance = self._clearance(points, place[None], _between(one, other))[0]
        return bool(clearance.min() >= min(self._parameters.margin, clearance[0] - _ROOM))

    def _clearance(self, points: FloatArray, places: FloatArray, turns: FloatArray) -> FloatArray:
        count(postures=len(places) * len(turns))
        return self._tool.clearance(points, places, turns, self._parameters.margin + 0.01)


def _will_do(motion: Regulation, policy: PolicyState) -> bool:
    """Whether a motion is verified, and neither its start nor its end inside an obstacle."""
    if motion.held or motion.shortfall > _SHORT or motion.goal_error > _MISSED:
        return False
    seen = motion.ellipsoids
    ends = np.array([policy.p_WE, motion.p_WG])[:, None]
    distance = signed_distance(ends, seen.p_WO, seen.R_WO, seen.semi_axes)
    return bool(distance.min(initial=math.inf) > 0.0)


def _ahead(here: TurnChoice, policy: PolicyState, p_WG: FloatArray) -> FloatArray:
    """(P, 3) the way from where the motion is to the goal [m]."""
    path = here.regulation.motion.p_WE
    if not len(path):
        return np.array([policy.p_WE, p_WG])
    nearest = int(((path - policy.p_WE) ** 2).sum(axis=1).argmin())
    return np.concatenate([policy.p_WE[None], path[nearest + 1 :], np.asarray(p_WG)[None]])


def _between(one: float, other: float) -> FloatArray:
    """Turns from one to another, both among them [rad]."""
    count = max(math.ceil(abs(other - one) / _ANGLE_STEP), 1)
    return np.linspace(one, other, count + 1)


def _thinned(obstacles: ObstacleClouds) -> FloatArray:
    """(N, 3) one point of the obstacles in each small cube [m]."""
    clouds = [np.asarray(cloud, dtype=float) for cloud in obstacles.clouds_W]
    points = np.concatenate([np.zeros((0, 3)), *clouds])
    points = points[np.isfinite(points).all(axis=1)]
    return thinned(points, _VOXEL)


def _same_clouds(one: ObstacleClouds, other: ObstacleClouds) -> bool:
    return one is other or (
        np.array_equal(one.ids, other.ids)
        and not other.v_WO.any()
        and all(
            a is b or np.array_equal(a, b)
            for a, b in zip(one.clouds_W, other.clouds_W, strict=True)
        )
    )


def _hardly_moved(before: EllipsoidSet, now: EllipsoidSet) -> bool:
    """Whether the same obstacles are where they were, and as large, up to what noise does."""
    if not np.array_equal(before.ids, now.ids):
        return False
    moved = np.abs(now.p_WO - before.p_WO).max(initial=0.0)
    grown = np.abs(now.semi_axes - before.semi_axes).max(initial=0.0)
    return bool(max(moved, grown) <= _SAME)
