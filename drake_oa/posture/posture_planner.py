"""The arm's posture along a motion that is regulated: when it is planned anew."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from drake_oa.common.messages import (
    PART,
    FloatArray,
    Frozen,
    ObstacleClouds,
    PlannedMotion,
    TablePlane,
)
from drake_oa.posture.arm_surroundings import ArmSurroundings
from drake_oa.posture.posture_plan import (
    PlanMotion,
    PostureParameters,
    PosturePlan,
    plan_posture,
    reviewed,
)
from drake_oa.robot.arm import ArmModel

_MOVED = 0.01
"""A path of the tool that stays so near to the one that was planned along is the same [m]."""
_CHANGED = 0.015
"""Distances of the links may change by so much before the posture is planned anew [m]: a
cloud of noisy points, thinned to voxels of 2 cm, changes them by less."""
_SLOWER = (1.0, 1.5, 2.5)
"""Shares by which a motion is made longer, in turn, until the arm can follow."""
_RETRY = 0.5
"""A posture that could not be found is looked for again after this time [s]."""
_AT_EASE = 0.9
"""Share of its allowed speed below which the arm is not short of time."""
_GAINED = 0.002
"""Where none works, what a slower motion has to gain [m]."""
_THERE = 0.02
"""So near to the goal there is no way left to plan along [m]."""
_ASTRAY = 0.35
"""The arm may be so far from the planned posture [rad]."""


@dataclass(frozen=True, eq=False)
class ArmSight(Frozen):
    """What is known when a posture is planned.

    Attributes:
        q: (n,) positions of the arm [rad].
        obstacles: what is seen.
        viewpoint_W: (3,) from where: what is behind is not seen; (0,): from all sides [m].
    """

    q: FloatArray
    obstacles: ObstacleClouds
    viewpoint_W: FloatArray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, eq=False)
class ArmWay(Frozen):
    """A planned posture, and what it was planned for.

    Attributes:
        plan: the postures.
        motion: the tool's motion, with them.
        slower: share by which the motion has to take longer for the arm to follow; below 1
            where it may take less.
        seen, table, viewpoint_W: the obstacles, the table and from where they were seen [m],
            when it was looked at last.
        since: when it was planned, or last tried to [s].
        failed: whether then no posture reached all of the path; the plan is the one before.
    """

    plan: PosturePlan = field(default_factory=PosturePlan)
    motion: PlannedMotion = field(default_factory=PlannedMotion)
    slower: float = 1.0
    seen: ObstacleClouds | None = None
    table: TablePlane | None = None
    viewpoint_W: FloatArray = field(default_factory=lambda: np.zeros(0))
    since: float = -math.inf
    failed: bool = False

    @property
    def follows(self) -> bool:
        """Whether the arm can follow the motion, as far as there is one."""
        return not len(self.motion) or self.seen is None or (self.plan.works and not self.failed)

    @property
    def concern(self) -> str:
        """Why the arm cannot follow, or ""."""
        plan = self.plan
        if self.follows or self.seen is None:
            return ""
        if self.failed:
            return "no posture of the arm reaches all of the path"
        if not plan.short:
            return "no posture of the arm is fast enough for the path"
        row = int(plan.obstacle[int(plan.distance.argmin())])
        what = "the table or itself" if row < 0 else f"obstacle {self.seen.ids[row] % PART}"
        return f"no posture of the arm clears {what}: short by {1e3 * plan.short:.0f} mm"


class WholeArm:
    """Plans the posture of one arm."""

    def __init__(
        self,
        arm: ArmModel,
        parameters: PostureParameters | None = None,
        orientation: Callable[[FloatArray], FloatArray] | None = None,
        posture: Callable[[FloatArray], FloatArray] | None = None,
    ) -> None:
        """Keeps what does not change.

        Args:
            arm: of seven joints.
            parameters: what is kept; None: the defaults.
            orientation: (T, 3, 3) orientations of the tool at normalised times (T,); None:
                the tool keeps the arm's.
            posture: (T, 7) postures that the null space is drawn to at normalised times (T,)
                [rad]; None: the arm's.

        Raises:
            ValueError: for another number of joints.
        """
        if len(arm.posture) != 7:
            raise ValueError(f"arm must have 7 joints, not {len(arm.posture)}")
        self._arm = arm
        self._parameters = parameters or PostureParameters()
        self._orientation = orientation
        self._posture = posture

    def leg_planner(
        self, sight: ArmSight, table: TablePlane | None, *, seconds: float, time: float
    ) -> PlanMotion:
        """What plans the posture along motions from given postures, as of `planned`."""
        around = ArmSurroundings.of(sight.obstacles, table, sight.viewpoint_W)

        def plan(q: FloatArray, motion: PlannedMotion) -> PosturePlan:
            return self._plan(around, q, motion, seconds, time, thorough=False)

        return plan

    def _plan(
        self,
        around: ArmSurroundings,
        q: FloatArray,
        motion: PlannedMotion,
        seconds: float,
        time: float,
        *,
        thorough: bool,
    ) -> PosturePlan:
        return plan_posture(
            self._arm,
            around,
            q,
            motion.s,
            motion.p_WE,
            seconds=seconds,
            age=around.lag(time),
            R_WE=None if self._orientation is None else self._orientation(motion.s),
            posture=None if self._posture is None else self._posture(motion.s),
            parameters=self._parameters,
            thorough=thorough,
        )

    def kept(
        self,
        before: ArmWay,
        motion: PlannedMotion,
        sight: ArmSight,
        table: TablePlane | None,
        *,
        s: float,
        seconds: float,
        time: float,
    ) -> ArmWay | None:
        """The posture that is planned, while it will do.

        Args:
            before: what is planned.
            motion: the motion that is wanted now.
            sight: what is known.
            table: the supporting plane, or None.
            s: normalised time.
            seconds: duration of a unit of it [s].
            time: now [s].

        Returns:
            It, or None where it must be planned anew.
        """
        plan = before.plan
        if before.failed:
            # What was not possible need not be tried again with every frame.
            return before if time - before.since <= _RETRY else None
        if not len(plan) or not len(motion):
            return None
        if math.dist(motion.p_WE[0], motion.p_WE[-1]) < _THERE:
            return before
        if motion is not before.motion:
            columns = [np.interp(motion.s, plan.s, p) for p in before.motion.p_WE.T]
            apart = np.linalg.norm(np.column_stack(columns) - motion.p_WE, axis=1)
            if apart.max() > _MOVED:
                return None
        joint = self._parameters.redundant
        wanted = np.interp(s, plan.s, plan.q[:, joint])
        if abs(sight.q[joint] - wanted) > _ASTRAY:
            return None
        if _unchanged(before, sight, table):
            return before
        around = ArmSurroundings.of(sight.obstacles, table, sight.viewpoint_W)
        again = reviewed(
            plan,
            self._arm,
            around,
            s=s,
            seconds=seconds,
            age=around.lag(time),
            parameters=self._parameters,
        )
        was = plan.distance[len(plan) - len(again) :]
        # The first two samples answer for nothing before them.
        changed = np.abs(again.distance - was)[2:].max(initial=0.0) > _CHANGED
        if changed or (plan.works and again.hurry > 1.1):
            return None
        return replace(before, seen=sight.obstacles, table=table, viewpoint_W=sight.viewpoint_W)

    def planned(
        self,
        motion: PlannedMotion,
        sight: ArmSight,
        table: TablePlane | None,
        *,
        seconds: float,
        time: float,
        thorough: bool = True,
        pace: float = 1.0,
    ) -> ArmWay:
        """Plans the posture along a motion; other arguments as of `kept` and `plan_posture`.

        Where the arm is too slow for it among resting obstacles, it is to be made slower.

        Args:
            pace: share of its duration that it may take, if the arm can; at most 1.
        """
        now = ArmWay(
            motion=motion,
            seen=sight.obstacles,
            table=table,
            viewpoint_W=sight.viewpoint_W,
            since=time,
        )
        if not len(motion):
            return now
        around = ArmSurroundings.of(sight.obstacles, table, sight.viewpoint_W)
        best = replace(now, plan=PosturePlan(short=math.inf), failed=True)
        shares = (pace, *_SLOWER) if pace < 1.0 else _SLOWER
        # Among moving obstacles a motion is verified at its own pace.
        for slower in _SLOWER[:1] if around.points.v_WO.any() else shares:
            plan = self._plan(around, sight.q, motion, slower * seconds, time, thorough=thorough)
            if plan.works or plan.short < best.plan.short - _GAINED:
                best = replace(now, plan=plan, motion=replace(motion, q=plan.q), slower=slower)
            # Where the arm is not short of time, more of it is no help.
            if plan.works or plan.hurry < _AT_EASE or not len(plan):
                break
        return best


def _unchanged(before: ArmWay, sight: ArmSight, table: TablePlane | None) -> bool:
    """Whether nothing moves, and all is where it was when the posture was looked at.

    Perception from depth hands on the clouds that it holds: the same arrays.
    """
    one, other = before.seen, sight.obstacles
    if one is None or before.table is not table or len(one) != len(other):
        return False
    if one is not other and (one.v_WO.any() or other.v_WO.any()):
        return False
    return (
        np.array_equal(before.viewpoint_W, sight.viewpoint_W)
        and np.array_equal(one.ids, other.ids)
        and all(a is b for a, b in zip(one.clouds_W, other.clouds_W, strict=True))
    )
