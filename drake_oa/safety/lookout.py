"""How near an arm will come to what is around it on ways of it, for `drake_oa.safety.evasion`.

A way is where the tool is displaced to over about a second, whether the motion goes on meanwhile,
and how far the joints turn in the null space. It is rolled out as any motion of the whole arm
(`drake_oa.planning.search`), in seconds in place of normalised time, among solids that go on at
their velocities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from drake_oa.common.messages import BoolArray, FloatArray, IntArray, PlannedMotion, PolicyState
from drake_oa.common.thinking import count
from drake_oa.geometry.solids import HALF_SPACE, SURROUNDINGS, SolidScene
from drake_oa.planning.arm_world import (
    FAR,
    SELF,
    TOOL,
    ArmWorld,
    Asked,
    group_distances,
)
from drake_oa.planning.search import ToolPaths, roll_out_arm
from drake_oa.robot.arm import tool_poses
from drake_oa.safety.config import EvasionSettings
from drake_oa.safety.evasion_candidates import planned_joints
from drake_oa.safety.guarded_arm import GuardedArm, tool_jacobian

HELD, GOES, FULL = range(3)
"""Whether a motion is held, goes on as fast as it does, or at full speed."""

_MISSED = 0.015
"""How far the tool may be from where it is wanted [m, rad]."""
_ROOM = 0.03
"""Distances are known by so much beyond what is kept [m]."""
_OWN = 0.005
"""What the arm keeps of itself [m]."""
_BATCH = 32
"""Ways that are rolled out before the worse of the others are known to be none."""
_SINGULAR = 1e-6
"""Share of the greatest singular value of a Jacobian below which one counts as zero."""


def null_space_basis(J: FloatArray) -> FloatArray:
    """(n, n - rank) orthonormal columns Z with J Z = 0."""
    _, values, rows = np.linalg.svd(J)
    rank = int(np.count_nonzero(values > _SINGULAR * values[0])) if len(values) else 0
    return np.asarray(rows[rank:].T)


@dataclass(frozen=True)
class Underway:
    """A motion that may have to be left.

    Attributes:
        policy: where it is.
        s: normalised time now.
        full_rate: its rate at full speed, 1 / (tau T) [1/s].
        motion: what is expected of it; None: that it goes straight on.
    """

    policy: PolicyState
    s: float
    full_rate: float
    motion: PlannedMotion | None = None


@dataclass(frozen=True, eq=False)
class Ways:
    """What is expected of C ways of the arm.

    Attributes:
        clearance: (C,) least distance on each, less what it may be less by [m]; -inf where the
            arm cannot go it, or it was not looked at to its end.
        distance: (C,) the same as far as it was looked at, whether or not the arm can go it [m].
        when: (C,) when it is least [s].
        q: (C, n) the joints then [rad].
    """

    clearance: FloatArray
    distance: FloatArray
    when: FloatArray
    q: FloatArray


class Lookout:
    """Looks ahead from one instant of a motion."""

    def __init__(
        self,
        arm: GuardedArm,
        q: FloatArray,
        scene: SolidScene,
        now: float,
        underway: Underway,
        parameters: EvasionSettings,
        *,
        table_height: float = -math.inf,
    ) -> None:
        """Takes what does not depend on the way.

        Args:
            arm: what is to stay clear.
            q: (n,) its joints [rad].
            scene: what it is to stay clear of.
            now: the time [s].
            underway: the motion.
            parameters: what is kept.
            table_height: least height of the tool point over the table, where it is known [m].
        """
        self.scene, self.underway = scene, underway
        self._arm, self._q, self._now, self._parameters = arm, q, now, parameters
        self._height = table_height
        self._times = np.append(0.0, parameters.times)
        self.free = null_space_basis(tool_jacobian(arm.chain, q))
        margin, chain = parameters.joint_margin, arm.chain
        self._chain = chain._replace(
            lower=np.minimum(chain.lower + margin, q), upper=np.maximum(chain.upper - margin, q)
        )
        self._most = parameters.margin + parameters.release + parameters.padding + _ROOM
        self._less = self._lessened()
        self._joints, self._R_WE = self._led()
        (X_WE,) = tool_poses(chain, q[None])
        self._p_WE = X_WE[9:]
        # What touches itself already may stay as near to itself.
        none = np.zeros((1, 0, 3)), np.zeros((1, 0, len(q))), np.zeros(1, dtype=np.int64)
        alone = self._world(np.zeros(len(scene), dtype=bool))
        now_apart = roll_out_arm(alone, q, self._paths(*none)).excess[0, SELF]
        self._own = min(float(now_apart), FAR) - 1e-9

    def _lessened(self) -> FloatArray:
        """(K,) by how much less than their distances the solids count [m]."""
        solids, p = self.scene.solids, self._parameters
        less = np.where(self.moving, p.padding, 0.0)
        return np.where(solids.layout[:, 5] == SURROUNDINGS, less - p.table_allowance, less)

    def _led(self) -> tuple[FloatArray, FloatArray]:
        """(3, T, n) joints and (3, T, 9) orientations: held, as it goes, at full speed."""
        under = self.underway
        joints = [
            planned_joints(under.motion, self._q, under.s, rate, self._times)
            for rate in (0.0, under.policy.speed, under.full_rate)
        ]
        R_WE = np.array([tool_poses(self._arm.chain, q)[:, :9] for q in joints])
        return np.array(joints), R_WE

    @property
    def moving(self) -> BoolArray:
        """(K,) whether the solids move."""
        return np.asarray(self.scene.solids.ball[:, 4:7].any(axis=1))

    def velocity(self, row: int) -> FloatArray:
        """(3,) of a solid [m/s]."""
        return np.array(self.scene.solids.ball[row, 4:7])

    def name(self, row: int) -> int:
        """Of a solid's obstacle; -1: of what belongs to the cell, or none."""
        return int(self.scene.solids.layout[row, 5]) if row >= 0 else SURROUNDINGS

    def look(
        self,
        shifts: FloatArray,
        turns: FloatArray,
        led: IntArray,
        *,
        among: BoolArray | None = None,
        enough: float = -math.inf,
        plenty: float = math.inf,
        behind: float = math.inf,
        until: float = math.inf,
    ) -> Ways:
        """What is expected of ways of the arm.

        Args:
            shifts: (C, K, 3) of the tool from where it is, at the times that are looked at [m].
            turns: (C, K, n) how far the joints turn besides, of which what does not move
                the tool counts [rad].
            led: (C,) `HELD`, `GOES` or `FULL`: how the motion leads orientation and posture.
            among: (K,) which solids are looked at; None: all.
            enough: a way that comes nearer is looked at no further, and is none [m].
            plenty, behind: so is one that comes nearer than the best, or than `plenty`, by more
                than this [m].
            until: only so far ahead [s].
        """
        T = int(np.count_nonzero(self._times <= until + 1e-9))
        shifts, turns = shifts[:, : T - 1], turns[:, : T - 1]
        world, inside = self._world(among), np.flatnonzero(self._inside(shifts))
        number, n = len(shifts), len(self._q)
        found = np.full((number, 3), -np.inf)
        found[:, 2] = 0.0
        q = np.tile(self._q, (number, 1))
        for begin in range(0, len(inside), _BATCH):
            rows = inside[begin : begin + _BATCH]
            paths = self._paths(shifts[rows], turns[rows], led[rows])
            arms = roll_out_arm(world, self._q, paths, enough + FAR - self._most)
            count(poses=int(arms.samples.sum()))
            distance = arms.excess[:, TOOL] - FAR + self._most
            able = (arms.error <= _MISSED) & (arms.hurry <= self._parameters.speed_share)
            able &= (arms.samples == T) & (arms.excess[:, SELF] >= self._own)
            found[rows, 0] = np.where(able, distance, -np.inf)
            found[rows, 1] = distance
            found[rows, 2] = self._times[arms.when]
            q[rows] = arms.q[np.arange(len(rows)), arms.when].reshape(-1, n)
            best = min(float(found[:, 0].max()), plenty)
            enough = max(enough, best - behind)
        return Ways(found[:, 0], found[:, 1], found[:, 2], q)

    def nearest(self, ways: Ways, way: int, among: BoolArray | None = None) -> int:
        """The solid that a way comes nearest to; -1: to none."""
        if not ways.distance[way] < self._most - 1e-9:
            return -1
        world, t = self._world(among), self._now + float(ways.when[way])
        found = group_distances(world.chain, world.spheres, world.solids, ways.q[way], t)
        found = np.where(np.isneginf(world.asked.of_solids), np.inf, found - self._less)
        found -= world.asked.growth * (t - world.solids.ball[:, 7])
        return int(found.min(axis=0).argmin())

    def gap(self, ways: Ways, way: int, row: int) -> float:
        """Distance to a solid where a way comes nearest to it, as it is expected [m]."""
        t = self._now + float(ways.when[way])
        grown = self._world(None).asked.growth[row] * (t - self.scene.solids.ball[row, 7])
        return float(ways.distance[way] + self._less[row] + grown)

    def _world(self, among: BoolArray | None) -> ArmWorld:
        """The arm among solids; beyond what is looked at all distances are alike."""
        spheres, solids, p = self._arm.spheres, self.scene.solids, self._parameters
        table = np.tile(self._less - FAR + self._most, (len(spheres.group_joint), 1))
        table[spheres.group_joint < 0] = -np.inf
        if among is not None:
            table[:, ~among] = -np.inf
        asked = Asked(
            of_solids=table,
            # More than its own is never short of anything.
            of_self=_OWN - FAR,
            is_tool=np.ones(len(table), dtype=bool),
            growth=np.where(self.moving, p.growth, 0.0),
        )
        return ArmWorld(self._chain, spheres, solids, asked, self._now)

    def _paths(self, shifts: FloatArray, turns: FloatArray, led: IntArray) -> ToolPaths:
        C, T = len(shifts), shifts.shape[1] + 1
        p_WE = np.tile(self._p_WE, (C, T, 1))
        p_WE[:, 1:] += shifts
        posture = self._joints[led, :T].copy()
        posture[:, 1:] += turns
        return ToolPaths(self._times[:T], p_WE, self._R_WE[led, :T], posture, np.ones(C))

    def _inside(self, shifts: FloatArray) -> BoolArray:
        """Whether ways stay above the table, or at least go no lower."""
        p_WE = self._p_WE + shifts
        return np.asarray(
            (self._margin(p_WE) >= min(float(self._margin(self._p_WE)), 0.0) - 1e-9).all(axis=1)
        )

    def _margin(self, p_WE: FloatArray) -> FloatArray:
        margin, solids = np.full(p_WE.shape[:-1], np.inf), self.scene.solids
        for row in np.flatnonzero(solids.layout[:, 0] == HALF_SPACE):
            X_WO = solids.X_WO[row]
            margin = np.minimum(margin, (p_WE - X_WO[:, 3]) @ X_WO[:, 2] - self._height)
        return margin
