"""Regulation that looks to the whole arm: a verified motion that it can follow, and its posture.

Where no posture passes along the motion that the regulator chose, others of its motions are
tried: `Regulator.others`, then those that begin anew where the arm rests.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from drake_oa.dmp import Dmp, normalised_time
from drake_oa.regulation import Regulation
from drake_oa.values import EllipsoidSet, FloatArray, ObstacleClouds, PolicyState, TablePlane
from drake_oa.verified_regulation import SEEK_AGAIN, Regulator
from drake_oa.whole_arm import ArmSight, ArmWay, WholeArm

_TRIED = 16
"""So many other motions are tried in the place of one that the arm cannot follow,"""
_LOOKED_INTO = 4
"""and the best so many of them once more, thoroughly."""


class ArmRegulator:
    """Verifies motions, and plans the posture of the arm along them."""

    def __init__(self, regulator: Regulator, arm: WholeArm, dmp: Dmp) -> None:
        """Keeps what does not change.

        Args:
            regulator: verifies the motions of the tool.
            arm: plans the postures.
            dmp: the movement primitive.
        """
        self._regulator, self._arm, self._dmp = regulator, arm, dmp

    def update(
        self,
        before: Regulation,
        policy: PolicyState,
        p_WG: FloatArray,
        ellipsoids: EllipsoidSet,
        table: TablePlane | None,
        sight: ArmSight,
    ) -> Regulation:
        """As `Regulator.update`, with the arm's positions in the motion.

        Where the arm cannot follow it, it is another one, which may keep less of the clearance.

        Args:
            before, policy, p_WG, ellipsoids, table: see there.
            sight: what is known of the arm and of what it must not touch. Points that are not
                finite are as if nothing new had been seen.
        """
        if sight.obstacles is not before.way.seen and not _is_finite(sight.obstacles):
            sight = replace(sight, obstacles=before.way.seen or ObstacleClouds())
        # tau as it is for the tool alone.
        of_tool = replace(before, tau=before.tau / before.way.slower)
        after = self._regulator.update(of_tool, policy, p_WG, ellipsoids, table)
        if not len(after.motion):
            return after
        s = normalised_time(policy.phase, self._dmp.alpha_k)
        seconds = self._dmp.duration * after.tau
        way = self._arm.kept(
            before.way,
            after.motion,
            sight,
            table,
            s=s,
            seconds=seconds * before.way.slower,
            time=policy.stamp,
        )
        if way is None:
            way = self._arm.planned(after.motion, sight, table, seconds=seconds, time=policy.stamp)
            if way.failed and len(before.way.plan):
                # Better the posture of before than that of the start.
                way = replace(before.way, seen=way.seen, since=way.since, failed=True)
        if way.concern and policy.stamp - after.sought >= SEEK_AGAIN:
            after, way = self._sought(after, way, policy, sight, table)
        return replace(after, motion=way.motion, way=way, tau=after.tau * way.slower)

    def _sought(
        self,
        after: Regulation,
        way: ArmWay,
        policy: PolicyState,
        sight: ArmSight,
        table: TablePlane | None,
    ) -> tuple[Regulation, ArmWay]:
        """Another motion of the tool, which the arm can follow, if there is one."""
        # A motion that is only too fast for the arm is slowed: no clearance is given for that.
        slow = way.plan.short == 0.0 and not way.failed
        most = after.shortfall if slow else math.inf

        def followed(others: Iterator[Regulation]) -> tuple[Regulation, ArmWay] | None:
            keep = (other for other in others if other.shortfall <= most)
            return self._followed(keep, policy, sight, table)

        found = followed(self._regulator.others(after, policy))
        if found is not None:
            return found
        begun = followed(self._regulator.others_anew(after, policy))
        return replace(after, sought=policy.stamp, anew=after.anew or begun is not None), way

    def _followed(
        self,
        others: Iterator[Regulation],
        policy: PolicyState,
        sight: ArmSight,
        table: TablePlane | None,
    ) -> tuple[Regulation, ArmWay] | None:
        """The first of some motions that the arm can follow."""
        short, time = [], policy.stamp
        for other in islice(others, _TRIED):
            way = self._planned(other, sight, table, time, thorough=False)
            if way.plan.works:
                return other, way
            short.append((way.plan.short, other))
        if policy.speed > 0.0:
            return None
        # Who is held has the time to look further.
        for _, other in sorted(short, key=lambda one: one[0])[:_LOOKED_INTO]:
            way = self._planned(other, sight, table, time, thorough=True)
            if way.plan.works:
                return other, way
        return None

    def _planned(
        self,
        other: Regulation,
        sight: ArmSight,
        table: TablePlane | None,
        time: float,
        *,
        thorough: bool,
    ) -> ArmWay:
        seconds = self._dmp.duration * other.tau
        return self._arm.planned(
            other.motion, sight, table, seconds=seconds, time=time, thorough=thorough
        )


def _is_finite(obstacles: ObstacleClouds) -> bool:
    return bool(
        np.isfinite(obstacles.v_WO).all()
        and all(np.isfinite(cloud).all() for cloud in obstacles.clouds_W)
    )
