"""Regulation by verified motions, from one observation to the next.

What `drake_oa.regulation.search.verify` chooses for a motion under way is kept while nothing
changes, and asked for anew, beginning with what is in use, when the obstacles do. The
avoidance term is put on the row of the obstacle that the motion comes nearest to.

Where the arm cannot follow that motion there are others (`Regulator.others`); one that was
taken is kept while it will do.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from drake_oa.common.config import check_values
from drake_oa.common.messages import (
    PART,
    BoolArray,
    EllipsoidSet,
    FloatArray,
    PlannedMotion,
    PolicyState,
    TablePlane,
)
from drake_oa.geometry.annulus import ANYWHERE, Annulus, annulus_margin
from drake_oa.geometry.ellipsoid import signed_distance
from drake_oa.geometry.ellipsoid_kernels import feasible_clearance
from drake_oa.policy.coupling import N_COLUMNS
from drake_oa.policy.dmp import Dmp, local_frame, normalised_time, trajectory
from drake_oa.regulation.config import SearchParameters
from drake_oa.regulation.proposals import ALPHA as LOG_ALPHA
from drake_oa.regulation.proposals import TAU
from drake_oa.regulation.regressor import ChainWeights
from drake_oa.regulation.regulation import (
    Hold,
    Regulation,
    begun_anew,
    hardly_moved,
    no_genes,
    side_only,
    stays,
    travelled,
)
from drake_oa.regulation.rollout import SpatialRollouts, SpatialScenes
from drake_oa.regulation.search import SearchResult, assessed, roll_out, survey, verify

_APART = 0.028
"""Distance along the path between the samples of a planned motion, at most [m]."""
_BETWEEN = 0.035
"""Normalised time between them, at most."""
_SAMPLES = 100
"""About how many points of a motion are looked at to tell which obstacle it comes near to."""


class Regulator:
    """Verifies motions of one movement primitive in one world."""

    def __init__(
        self,
        weights: ChainWeights,
        dmp: Dmp,
        asked_clearance: float,
        *,
        parameters: SearchParameters,
        table_height: float = 0.05,
        annulus: Annulus | None = None,
        begins_anew: bool = False,
    ) -> None:
        """Keeps what does not change.

        Args:
            weights: the chain that proposes.
            dmp: the movement primitive, of three dimensions.
            asked_clearance: asked clearance Delta of every obstacle [m].
            parameters: how far the search goes, and the coupling's fade.
            table_height: least height of E above the table [m].
            annulus: where E may be; None: anywhere.
            begins_anew: whether a motion that rests, as none that clears the obstacles or that
                the arm can follow goes on from it, is to begin anew where one from there does,
                and may step aside first.
        """
        check_values(parameters, "regulation")
        self.begins_anew = begins_anew
        self._weights = weights
        self._dmp = dmp
        self._asked_clearance = asked_clearance
        self.parameters = parameters
        self._table_height = table_height
        self._annulus = ANYWHERE if annulus is None else annulus
        planned = trajectory(dmp, np.zeros(3), np.array([1.0, 0.0, 0.0])).p
        self._planned_length = _length(planned)

    def update(
        self,
        before: Regulation,
        policy: PolicyState,
        p_WG: FloatArray,
        ellipsoids: EllipsoidSet,
        table: TablePlane | None,
    ) -> Regulation:
        """Looks at a motion under way, and verifies it anew if there is reason to.

        Args:
            before: what was verified last.
            policy: where the motion is.
            p_WG: (3,) its goal [m].
            ellipsoids: the obstacles as they were seen last.
            table: the supporting plane, or None.

        Returns:
            What to go by from now on; without term, and with tau 0, while nothing has been
            seen or start and goal coincide.
        """
        baseline = math.dist(p_WG, policy.p_WS)
        if ellipsoids.stamp == -math.inf or baseline == 0.0:
            return Regulation()
        here = replace(
            before,
            ellipsoids=ellipsoids,
            table=table,
            p_WS=policy.p_WS,
            p_WG=np.array(p_WG, dtype=float),
            p_WE=policy.p_WE,
            travelled=travelled(before, policy),
            anew=False,
        )
        if not np.array_equal(before.p_WS, policy.p_WS):
            # As who looked whether it may begin anew did.
            here = replace(here, genes=no_genes(), for_arm=False, sought=-math.inf)
        # A motion that is late is looked at again: the unmodulated rest may do.
        late = normalised_time(policy.phase, self._dmp.alpha_k) >= 1.0
        if not late and stays(before, here):
            return self._looked_anew(here, policy) if here.held else here
        if not len(ellipsoids):
            # Nothing to go round; the spring leads to the goal.
            remaining = math.dist(p_WG, policy.p_WE)
            free = self._without_term(here, remaining, baseline)
            scene = self._scene(policy, here)
            seconds = self._dmp.duration * free.tau
            motion = self._roll_out(scene, np.zeros((1, N_COLUMNS)), seconds)
            planned = _planned(scene.s, motion, self.parameters.steps, here.p_WS)
            return replace(free, motion=planned)
        scene = self._scene(policy, here)
        if here.for_arm:
            after = self._again(here, scene, baseline, policy.stamp)
            if after is not None:
                return after
            here = replace(here, for_arm=False)
        found = verify(
            scene,
            self._weights,
            duration=self._dmp.duration,
            dmp=self._dmp,
            previous=here.genes[None],
            settled=hardly_moved(before.ellipsoids, ellipsoids),
            parameters=self._search(before, ellipsoids),
        )
        return self._looked_anew(self._kept(here, scene, found, baseline), policy)

    def _again(
        self, here: Regulation, scene: SpatialScenes, baseline: float, time: float
    ) -> Regulation | None:
        """A motion for the arm's sake, while it will do; where something moves, for a while."""
        if here.ellipsoids.v_WO.any() and time - here.sought >= self.parameters.seek_period:
            return None
        found = assessed(
            scene,
            here.genes[None],
            duration=self._dmp.duration,
            dmp=self._dmp,
            previous=here.genes,
            parameters=self.parameters,
        )
        after = self._kept(here, scene, found, baseline)
        will_do = not after.held and after.goal_error <= self._missed(here)
        will_do = will_do and after.shortfall <= here.lacked + self.parameters.may_lose
        return after if will_do else None

    def others(self, after: Regulation, policy: PolicyState) -> Iterator[Regulation]:
        """Motions in place of the one that was verified, the cheapest first.

        They go other ways, are longer, or keep less of the clearance, but 5 cm.

        Args:
            after: what `update` returned.
            policy: where the motion is, as there.
        """
        if not len(after.ellipsoids):
            return
        scene = self._scene(policy, after)
        found = survey(
            scene,
            duration=self._dmp.duration,
            least_clearance=self.parameters.least_clearance,
            dmp=self._dmp,
            previous=after.genes,
            parameters=self.parameters,
        )
        for row in range(len(found.cost)):
            one = self._kept(after, scene, found.rows(np.array([row])), float(scene.baseline[0]))
            if one.held or one.goal_error > self._missed(after):
                continue
            yield replace(one, anew=False, for_arm=True, lacked=one.shortfall, sought=policy.stamp)

    def inside(self, p_WE: FloatArray, table: TablePlane | None) -> BoolArray:
        """Which points of E, (N, 3) in the world [m], are high enough and in the workspace."""
        inside = annulus_margin(p_WE, self._annulus) >= 0.0
        if table is not None:
            inside &= p_WE @ table.normal_W - table.offset >= self._table_height
        return inside

    def _missed(self, before: Regulation) -> float:
        """How far from the goal a motion in the place of another may end [m]."""
        return max(self.parameters.short_of_goal, before.goal_error)

    def others_anew(self, after: Regulation, policy: PolicyState) -> Iterator[Regulation]:
        """`others` that begin where the motion rests; none where it does not, or may not."""
        if self._may_begin_anew(after, policy):
            yield from self.others(*begun_anew(after, policy))

    def others_from(
        self, after: Regulation, policy: PolicyState, p_WV: FloatArray, p_WG: FloatArray
    ) -> Iterator[Regulation]:
        """`others` that begin at a point V, were the tool at rest there.

        Args:
            after, policy: as of `others`.
            p_WV: (3,) the point in the world [m].
            p_WG: (3,) the goal from there in the world [m].
        """
        begun, there = begun_anew(after, replace(policy, p_WE=p_WV))
        return self.others(replace(begun, p_WG=p_WG, p_WE=p_WV), there)

    def _may_begin_anew(self, after: Regulation, policy: PolicyState) -> bool:
        left = math.dist(policy.p_WE, policy.p_WS) > self.parameters.left
        # At the goal there is none to begin.
        left = left and math.dist(policy.p_WE, after.p_WG) > self.parameters.left
        return self.begins_anew and policy.speed == 0.0 and left

    def _looked_anew(self, after: Regulation, policy: PolicyState) -> Regulation:
        """Of a motion that rests, as none goes on from it: whether one begins where it is."""
        if not (after.held and self._may_begin_anew(after, policy)):
            return after
        if policy.stamp - after.tried < self.parameters.retry_period:
            return after
        begun, rests = begun_anew(after, policy)
        scene = self._scene(rests, begun)
        found = verify(
            scene,
            self._weights,
            duration=self._dmp.duration,
            dmp=self._dmp,
            parameters=self.parameters,
        )
        does = not self._kept(begun, scene, found, float(scene.baseline[0])).held
        return replace(after, anew=does, tried=policy.stamp)

    def _search(self, before: Regulation, ellipsoids: EllipsoidSet) -> SearchParameters:
        """A search among the same moving obstacles goes on from frame to frame."""
        under_way = before.tau != 0.0 and np.array_equal(before.ellipsoids.ids, ellipsoids.ids)
        if not (under_way and ellipsoids.v_WO.any()):
            return self.parameters
        most = self.parameters
        return replace(most, rounds=min(most.rounds, self.parameters.rounds_a_frame), retries=0)

    def _without_term(self, here: Regulation, remaining: float, baseline: float) -> Regulation:
        return Regulation(
            ellipsoids=here.ellipsoids,
            table=here.table,
            p_WS=here.p_WS,
            p_WG=here.p_WG,
            p_WE=here.p_WE,
            travelled=here.travelled,
            remaining=remaining,
            tau=self._scaling(here, remaining, baseline),
            genes=side_only(here),
            aside=here.aside,
        )

    def _scaling(self, here: Regulation, remaining: float, baseline: float) -> float:
        """tau = length(avoiding path) / length(planned path), at least 1."""
        return max(1.0, (here.travelled + remaining) / (self._planned_length * baseline))

    def _scene(self, policy: PolicyState, here: Regulation) -> SpatialScenes:
        seen, table = here.ellipsoids, here.table
        # Where the obstacles are at the policy's time, not where they were seen.
        lag = policy.stamp - seen.stamp if math.isfinite(seen.stamp) else 0.0
        plane = np.zeros((0, 4))
        if table is not None:
            plane = np.append(table.normal_W, table.offset + self._table_height)[None]
        return SpatialScenes(
            p_WE=policy.p_WE[None],
            z_W=policy.z_W[None],
            p_WG=here.p_WG[None],
            R_WL=local_frame(policy.p_WS, here.p_WG)[None],
            baseline=np.array([math.dist(here.p_WG, policy.p_WS)]),
            p_WO=(seen.p_WO + lag * seen.v_WO)[None],
            R_WO=seen.R_WO[None],
            semi_axes=seen.semi_axes[None],
            v_WO=seen.v_WO[None],
            asked_clearance=np.full((1, len(seen)), self._asked_clearance),
            s=max(0.0, normalised_time(policy.phase, self._dmp.alpha_k)),
            plane=plane,
            annulus=self._annulus,
        )

    def _kept(
        self, here: Regulation, scene: SpatialScenes, found: SearchResult, baseline: float
    ) -> Regulation:
        seconds = self._dmp.duration * math.exp(found.genes[0, TAU])
        motion = self._roll_out(scene, found.terms, seconds)
        least, start, goal = self._distances(scene, motion, seconds)
        feasible = feasible_clearance(self._asked_clearance, start, goal)
        shortfall = float(found.shortfall[0])
        clear = (start > 0.0) & (goal > 0.0)
        # What holds start or goal is touched by any motion; the policy is held for that.
        kept = float(found.kept_clearance[0]) if clear.all() else least[clear].min(initial=np.inf)
        touched = kept <= 0.0
        outside = not found.kept[0] and float(motion.world_margin[0]) < -self.parameters.outside
        astray = clear.any() and float(found.goal_error[0]) > self.parameters.astray * baseline
        hold, held_by = Hold.NONE, -1
        if touched or outside or astray:
            hold = Hold.NO_MOTION_INSIDE if outside else Hold.NO_MOTION
            held_by = int(here.ellipsoids.ids[np.where(clear, least, np.inf).argmin()] % PART)
        genes = np.array(found.genes[0])
        free = not genes[LOG_ALPHA] > -np.inf
        if free:
            genes = side_only(here)
        moving = here.ellipsoids.v_WO.any()
        remaining = float(found.path_length[0])
        tau = float(found.tau[0]) if moving else self._scaling(here, remaining, baseline)
        shortest = here.ellipsoids.ids[(feasible - least).argmax()] % PART
        lowered = self._asked_clearance - max(float(feasible.min()), 0.0)
        return replace(
            here,
            remaining=remaining,
            row=-1 if free else int(least.argmin()),
            term=np.array(found.terms[0]),
            tau=tau,
            in_range=bool(found.in_range[0]),
            genes=genes,
            shortfall=shortfall,
            short_of=int(shortest) if shortfall else -1,
            lowered=lowered,
            lowered_for=int(here.ellipsoids.ids[feasible.argmin()] % PART) if lowered else -1,
            goal_error=float(found.goal_error[0]),
            hold=hold,
            held_by=held_by,
            motion=_planned(scene.s, motion, self.parameters.steps, here.p_WS),
        )

    def _roll_out(self, scene: SpatialScenes, terms: FloatArray, seconds: float) -> SpatialRollouts:
        return roll_out(
            scene,
            np.zeros(1, dtype=np.int64),
            terms,
            self.parameters,
            seconds=seconds,
            dmp=self._dmp,
            keep_path=True,
        )

    def _distances(
        self, scene: SpatialScenes, motion: SpatialRollouts, seconds: float
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """(M,) least distances of the motion, of where it is now and of the goal at its end [m]."""
        last = int(motion.steps[0])
        at = np.unique(np.linspace(0, last, _SAMPLES).round().astype(int))
        path = np.concatenate([motion.path[0, at], scene.p_WG])
        time = np.append(at, last)[:, None, None] * (seconds / self.parameters.steps)
        p_WO = scene.p_WO + time * scene.v_WO
        distance = signed_distance(path[:, None], p_WO, scene.R_WO[0], scene.semi_axes[0])
        return distance[:-1].min(axis=0), distance[0], distance[-1]


def _planned(s: float, motion: SpatialRollouts, steps: int, p_WS: FloatArray) -> PlannedMotion:
    """Samples of a single roll-out from s on, its first and last point among them."""
    path = motion.path[0, : int(motion.steps[0]) + 1]
    length = np.linalg.norm(np.diff(path, axis=0), axis=1)
    # Grows by 1 at least from one sample to the next.
    measure = np.append(0.0, np.cumsum(np.maximum(length / _APART, 1.0 / (steps * _BETWEEN))))
    count = max(math.ceil(measure[-1]), 1)
    at = np.unique(np.searchsorted(measure, np.linspace(0.0, measure[-1], count + 1)))
    return PlannedMotion(s + at / steps, path[at], p_WS=p_WS)


def _length(path: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
