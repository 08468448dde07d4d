"""Regulation that looks to the whole arm: a verified motion that it can follow, and its posture.

Where no posture passes along the motion that the regulator chose, others of its motions are
tried: `Regulator.others`, then those that begin anew where the arm rests, and, among obstacles
at rest, those that begin at a point to which the tool then goes first, in one or more legs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice

import numpy as np

from drake_oa.common.messages import (
    BoolArray,
    EllipsoidSet,
    FloatArray,
    HoldCause,
    ObstacleClouds,
    PlannedMotion,
    PolicyState,
    TablePlane,
)
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.policy.dmp import Dmp, normalised_time
from drake_oa.posture.posture_planner import ArmSight, ArmWay, WholeArm
from drake_oa.posture.waypoint_tree import (
    Aside,
    Legs,
    LegTree,
    grown,
    shortened_way,
    straight_motion,
)
from drake_oa.regulation.config import Following
from drake_oa.regulation.regulation import Hold, Regulation, hardly_moved
from drake_oa.regulation.regulator import Regulator


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
        self._following = regulator.parameters.following

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
        before = replace(before, rests_since=_rests_since(before, policy))
        goal, aside = p_WG, before.aside
        if len(aside.p_WV):
            if math.dist(policy.p_WE, aside.p_WV) <= self._following.there:
                return _held_for(before, policy, Hold.AT_WAYPOINT, aside.reached())
            held = policy.hold is HoldCause.OBSTACLES
            held = held and policy.stamp - before.rests_since >= self._following.stuck
            if held or not np.array_equal(aside.p_WG, p_WG):
                return _held_for(before, policy, Hold.WAYPOINT_LOST, aside.given_up())
            goal = aside.p_WV
        # tau as it is for the tool alone.
        of_tool = replace(before, tau=before.tau / before.way.slower)
        after = self._regulator.update(of_tool, policy, goal, ellipsoids, table)
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
            way = self._arm.planned(
                after.motion,
                sight,
                table,
                seconds=seconds,
                time=policy.stamp,
                pace=self._following.leg_pace if len(aside.p_WV) else 1.0,
            )
            if way.failed:
                way = _as_before(
                    way, before.way, after.motion, policy, sight, self._following.near_old
                )
        if policy.stamp - after.sought >= self._regulator.parameters.seek_period:
            if not way.follows:
                after, way = self._sought(after, way, policy, p_WG, sight, table)
            elif (
                policy.hold is HoldCause.SPEED_SCALE
                and policy.stamp - after.rests_since >= self._following.stuck
            ):
                after = self._aside(after, policy, p_WG, sight, table, near=self._following.beside)
        return replace(after, motion=way.motion, way=way, tau=after.tau * way.slower)

    def _sought(
        self,
        after: Regulation,
        way: ArmWay,
        policy: PolicyState,
        p_WG: FloatArray,
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
        if followed(self._regulator.others_anew(after, policy)) is not None:
            return replace(after, anew=True, sought=policy.stamp), way
        return self._aside(after, policy, p_WG, sight, table), way

    def _aside(
        self,
        after: Regulation,
        policy: PolicyState,
        p_WG: FloatArray,
        sight: ArmSight,
        table: TablePlane | None,
        *,
        near: float = math.inf,
    ) -> Regulation:
        """Where the tool is to go first, if there is a point from which the arm can go on.

        Args:
            near: only where a link is nearer than this to something [m].
        """
        seen, time = after.ellipsoids, policy.stamp
        after = replace(after, sought=time)
        rests = policy.speed == 0.0 and not seen.v_WO.any()
        if not (rests and self._regulator.begins_anew and len(seen)):
            return after
        if time - seen.stamp > self._following.recent:
            return after
        plan = self._arm.leg_planner(sight, table, seconds=self._dmp.duration, time=time)
        if math.isfinite(near):
            here = plan(sight.q, straight_motion(policy.p_WE, policy.p_WE))
            if len(here) and here.distance[0] > near:
                return after
        aside = after.aside
        if not _same_place(aside, policy.p_WE, sight.q, p_WG, seen, self._following):
            nearest = np.linalg.norm(seen.p_WO - policy.p_WE, axis=1).argmin()
            tree = LegTree.at(policy.p_WE, sight.q, p_WG, seen.p_WO[nearest])
            aside = Aside(tree=tree, seen=seen)
        legs = Legs(
            plan,
            lambda points: (
                self._regulator.inside(points, table) & _clear(points, seen, self._following.clear)
            ),
        )
        tree, row = grown(aside.tree, legs, self._following.legs)
        aside = replace(aside, tree=tree)
        after = replace(after, aside=aside)
        if row < 0:
            return after
        points, q = shortened_way(tree, row, legs)
        if not len(points):
            return after
        there = replace(sight, q=q)
        others = self._regulator.others_from(after, policy, points[-1], p_WG)
        for other in islice(others, self._following.tried_there):
            if self._planned(other, there, table, time, thorough=False).plan.works:
                return replace(after, anew=True, aside=aside.by(points, p_WG))
        return after

    def _followed(
        self,
        others: Iterator[Regulation],
        policy: PolicyState,
        sight: ArmSight,
        table: TablePlane | None,
    ) -> tuple[Regulation, ArmWay] | None:
        """The first of some motions that the arm can follow."""
        short, time = [], policy.stamp
        for other in islice(others, self._following.tried):
            way = self._planned(other, sight, table, time, thorough=False)
            if way.plan.works:
                return other, way
            short.append((way.plan.short, other))
        if policy.speed > 0.0:
            return None
        # Who is held has the time to look further.
        for _, other in sorted(short, key=lambda one: one[0])[: self._following.looked_into]:
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


def _held_for(before: Regulation, policy: PolicyState, why: Hold, aside: Aside) -> Regulation:
    """Holds a motion to a point; once it rests, another is to begin where it is."""
    if policy.speed > 0.0:
        return replace(before, p_WE=policy.p_WE, hold=why)
    return replace(before, p_WE=policy.p_WE, hold=Hold.NONE, anew=True, aside=aside)


def _as_before(
    way: ArmWay,
    before: ArmWay,
    motion: PlannedMotion,
    policy: PolicyState,
    sight: ArmSight,
    near: float,
) -> ArmWay:
    """A way without a posture: with that of before, while it belongs to where the tool is."""
    old = before.motion
    if len(before.plan) and len(old):
        off = np.linalg.norm(old.p_WE - policy.p_WE, axis=1)
        if np.array_equal(old.p_WS, policy.p_WS) and off.min() <= near:
            return replace(way, plan=before.plan, motion=old, slower=max(before.slower, 1.0))
    q = np.tile(sight.q, (len(motion), 1))
    return replace(way, plan=replace(way.plan, s=motion.s, q=q), motion=replace(motion, q=q))


def _clear(p_WE: FloatArray, ellipsoids: EllipsoidSet, least: float) -> BoolArray:
    """Which points (N, 3) the tool may be at; the obstacles are dilated by it."""
    distance = signed_distance(
        p_WE[:, None], ellipsoids.p_WO, ellipsoids.R_WO, ellipsoids.semi_axes
    )
    return np.asarray(distance.min(axis=1) >= least)


def _same_place(
    aside: Aside,
    p_WE: FloatArray,
    q: FloatArray,
    p_WG: FloatArray,
    seen: EllipsoidSet,
    following: Following,
) -> bool:
    """Whether the arm is stuck where it was, on its way to the same goal."""
    tree = aside.tree
    return (
        len(tree) > 0
        and math.dist(tree.p_WV[0], p_WE) <= following.elsewhere
        and float(np.abs(tree.q[0] - q).max()) <= following.otherwise
        and np.array_equal(tree.p_WG, p_WG)
        and hardly_moved(aside.seen, seen)
    )


def _rests_since(before: Regulation, policy: PolicyState) -> float:
    return min(before.rests_since, policy.stamp) if policy.speed == 0.0 else math.inf


def _is_finite(obstacles: ObstacleClouds) -> bool:
    return bool(
        np.isfinite(obstacles.v_WO).all()
        and all(np.isfinite(cloud).all() for cloud in obstacles.clouds_W)
    )
