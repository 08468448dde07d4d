"""Regulation by verified motions, from one observation to the next.

What `drake_oa.verification.verify` chooses for a motion under way is kept while nothing
changes, and asked for anew, beginning with what is in use, when the obstacles do. The
avoidance term is put on the row of the obstacle that the motion comes nearest to.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from drake_oa.coupling_kernels import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.dmp import Dmp, local_frame, normalised_time, trajectory
from drake_oa.ellipsoid import signed_distance
from drake_oa.regressor import ChainWeights, CouplingParameters
from drake_oa.spatial_rollout import SpatialRollouts, SpatialScenes
from drake_oa.values import (
    PART,
    EllipsoidSet,
    FloatArray,
    Frozen,
    PlannedMotion,
    PolicyState,
    Route,
    TablePlane,
)
from drake_oa.verification import ALPHA as LOG_ALPHA
from drake_oa.verification import ANGLE, N_GENES, TAU, SearchParameters, Verified, verify
from drake_oa.verification_search import roll_out
from drake_oa.whole_arm import ArmWay

_OUTSIDE = 0.01
"""How far a motion may leave the world's limits, which hold centimetres in reserve [m]."""
_NOISE = 5e-3
"""By how much an obstacle at rest may seem to move or grow from frame to frame [m]."""
_MISSED = 5e-3
"""How far from the goal a motion may end without a word [m]."""
_ASTRAY = 0.1
"""How far from the goal the end of a motion is no arrival at all, in baselines."""
_APART = 0.028
"""Distance along the path between the samples of a planned motion, at most [m]."""
_BETWEEN = 0.035
"""Normalised time between them, at most."""
_ROUNDS_A_FRAME = 5
"""Rounds of a search that is begun anew with each frame: obstacles move."""
_LEFT = 0.01
"""A motion begins anew where it is farther than this from its start and its goal [m]."""
_RETRY = 0.5
"""How often it is looked whether it may [s]."""
_OFF_PATH = 0.025
"""A motion that is farther than this from the verified one is verified again [m]."""
_SAMPLES = 100
"""About how many points of a motion are looked at to tell which obstacle it comes near to."""


def _no_genes() -> FloatArray:
    return np.full(N_GENES, np.nan)


@dataclass(frozen=True, eq=False)
class Regulation(Frozen):
    """The motion that was verified last, and among what.

    Attributes:
        ellipsoids: the obstacles then.
        table: the supporting plane then, or None.
        p_WS: (3,) start of the motion [m].
        p_WG: (3,) its goal then [m].
        p_WE: (3,) where it was when it was looked at last [m].
        travelled: length of the way until there [m].
        remaining: length of the verified way from where it was verified [m].
        row: row of the obstacle that the term is put on; -1: no term.
        term: (13,) the avoidance term, see `coupling_kernels.turn_step`.
        tau: temporal scaling; 0: nothing was verified.
        in_range: whether the chain was asked within its trained range.
        genes: (7,) of the choice, NaN where there are none.
        shortfall: what is missing of the feasible clearance in the motion [m].
        short_of: name of the obstacle that it is missing of; -1: none.
        goal_error: distance to the goal at the motion's end [m].
        note: empty, or why the motion must not go on.
        anew: whether a motion that begins where this one rests will do in its place.
        tried: when such a one was looked for last [s].
        motion: the motion from then to the goal.
        way: the arm's posture along it, where it is planned.
    """

    ellipsoids: EllipsoidSet = field(default_factory=EllipsoidSet)
    table: TablePlane | None = None
    p_WS: FloatArray = field(default_factory=lambda: np.zeros(3))
    p_WG: FloatArray = field(default_factory=lambda: np.zeros(3))
    p_WE: FloatArray = field(default_factory=lambda: np.zeros(3))
    travelled: float = 0.0
    remaining: float = 0.0
    row: int = -1
    term: FloatArray = field(default_factory=lambda: np.zeros(N_COLUMNS))
    tau: float = 0.0
    in_range: bool = True
    genes: FloatArray = field(default_factory=_no_genes)
    shortfall: float = 0.0
    short_of: int = -1
    goal_error: float = 0.0
    note: str = ""
    anew: bool = False
    tried: float = -math.inf
    motion: PlannedMotion = field(default_factory=PlannedMotion)
    way: ArmWay = field(default_factory=ArmWay)

    def coupling(self, ellipsoids: EllipsoidSet) -> CouplingParameters:
        """The parameters for obstacles now: one row an ellipsoid, at most one with a term."""
        count = len(ellipsoids)
        alpha, psi, kappa = np.zeros(count), np.ones(count), np.zeros(count)
        in_range = np.ones(count, dtype=bool)
        center_W, normal_W = np.array(ellipsoids.p_WO), np.zeros((count, 3))
        if self.row >= 0:
            same = np.flatnonzero(ellipsoids.ids == self.ellipsoids.ids[self.row])[:1]
            alpha[same] = self.term[ALPHA]
            psi[same] = self.term[PSI]
            kappa[same] = self.term[KAPPA]
            in_range[same] = self.in_range
            center_W[same] = self.term[:3]
            normal_W[same] = self.term[NORMAL : NORMAL + 3]
        return CouplingParameters(
            alpha,
            psi,
            kappa,
            in_range,
            center_W,
            normal_W,
            tau=self.tau,
            note=self.note,
            anew=self.anew,
        )


class Regulator:
    """Verifies motions of one movement primitive in one world."""

    def __init__(
        self,
        weights: ChainWeights,
        dmp: Dmp,
        clearance: float,
        *,
        parameters: SearchParameters,
        table_height: float = 0.05,
        annulus: FloatArray | None = None,
        begins_anew: bool = False,
    ) -> None:
        """Keeps what does not change.

        Args:
            weights: the chain that proposes.
            dmp: the movement primitive, of three dimensions.
            clearance: asked clearance Delta of every obstacle [m].
            parameters: how far the search goes, and the coupling's fade.
            table_height: least height of E above the table [m].
            annulus: (3, n) heights, and least and largest distance from the world's z axis
                there [m]; None: anywhere.
            begins_anew: whether a motion that rests, as none that clears the obstacles goes
                on from it, is to begin anew where one from there does.
        """
        self._begins_anew = begins_anew
        self._weights = weights
        self._dmp = dmp
        self._clearance = clearance
        self._parameters = parameters
        self._table_height = table_height
        self._annulus = np.zeros((3, 0)) if annulus is None else np.array(annulus)
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
            travelled=_travelled(before, policy),
        )
        # A motion that is late is looked at again: the unmodulated rest may do.
        late = normalised_time(policy.phase, self._dmp.alpha_k) >= 1.0
        if not late and _stays(before, here):
            return self._looked_anew(here, policy) if here.note else here
        if not len(ellipsoids):
            # Nothing to go round; the spring leads to the goal.
            remaining = math.dist(p_WG, policy.p_WE)
            free = self._without_term(here, remaining, baseline)
            scene = self._scene(policy, here)
            seconds = self._dmp.duration * free.tau
            motion = self._roll_out(scene, np.zeros((1, 0, N_COLUMNS)), seconds)
            return replace(free, motion=_planned(scene.s, motion, self._parameters.steps))
        scene = self._scene(policy, here)
        found = verify(
            scene,
            self._weights,
            duration=self._dmp.duration,
            dmp=self._dmp,
            previous=here.genes[None],
            settled=_hardly_moved(before.ellipsoids, ellipsoids),
            parameters=self._search(before, ellipsoids),
        )
        return self._looked_anew(self._kept(here, scene, found, baseline), policy)

    def _looked_anew(self, after: Regulation, policy: PolicyState) -> Regulation:
        """Of a motion that rests, as none goes on from it: whether one begins where it is."""
        after = replace(after, anew=False)
        left = math.dist(policy.p_WE, policy.p_WS) > _LEFT
        # At the goal there is none to begin.
        left = left and math.dist(policy.p_WE, after.p_WG) > _LEFT
        if not (self._begins_anew and after.note and policy.speed == 0.0 and left):
            return after
        if policy.stamp - after.tried < _RETRY:
            return after
        rests = replace(policy, p_WS=policy.p_WE, z_W=np.zeros(3), phase=1.0)
        begun = replace(after, p_WS=policy.p_WE, travelled=0.0, genes=_no_genes())
        scene = self._scene(rests, begun)
        found = verify(
            scene,
            self._weights,
            duration=self._dmp.duration,
            dmp=self._dmp,
            parameters=self._parameters,
        )
        does = not self._kept(begun, scene, found, float(scene.baseline[0])).note
        return replace(after, anew=does, tried=policy.stamp)

    def _search(self, before: Regulation, ellipsoids: EllipsoidSet) -> SearchParameters:
        """A search among the same moving obstacles goes on from frame to frame."""
        under_way = before.tau != 0.0 and np.array_equal(before.ellipsoids.ids, ellipsoids.ids)
        if not (under_way and ellipsoids.v_WO.any()):
            return self._parameters
        most = self._parameters
        return replace(most, rounds=min(most.rounds, _ROUNDS_A_FRAME), retries=0)

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
            genes=_side(here),
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
            clearance=np.full((1, len(seen)), self._clearance),
            s=max(0.0, normalised_time(policy.phase, self._dmp.alpha_k)),
            plane=plane,
            annulus=self._annulus,
        )

    def _kept(
        self, here: Regulation, scene: SpatialScenes, found: Verified, baseline: float
    ) -> Regulation:
        seconds = self._dmp.duration * math.exp(found.genes[0, TAU])
        motion = self._roll_out(scene, found.terms[:, None], seconds)
        least, start, goal = self._distances(scene, motion, seconds)
        feasible = np.minimum(self._clearance, np.minimum(start, goal))
        shortfall = float(found.shortfall[0])
        clear = (start > 0.0) & (goal > 0.0)
        # What holds start or goal is touched by any motion; the policy is held for that.
        kept = float(found.clearance[0]) if clear.all() else least[clear].min(initial=np.inf)
        touched = kept <= 0.0
        outside = not found.kept[0] and float(motion.world_margin[0]) < -_OUTSIDE
        astray = clear.any() and float(found.goal_error[0]) > _ASTRAY * baseline
        note = ""
        if touched or outside or astray:
            worst = int(np.where(clear, least, np.inf).argmin())
            where = " above the table and in the workspace" if outside else ""
            name = here.ellipsoids.ids[worst] % PART
            note = f"no motion that clears obstacle {name}{where} found"
        genes = np.array(found.genes[0])
        free = not genes[LOG_ALPHA] > -np.inf
        if free:
            genes = _side(here)
        moving = here.ellipsoids.v_WO.any()
        remaining = float(found.path_length[0])
        tau = float(found.tau[0]) if moving else self._scaling(here, remaining, baseline)
        shortest = here.ellipsoids.ids[(feasible - least).argmax()] % PART
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
            goal_error=float(found.goal_error[0]),
            note=note,
            motion=_planned(scene.s, motion, self._parameters.steps),
        )

    def _roll_out(self, scene: SpatialScenes, terms: FloatArray, seconds: float) -> SpatialRollouts:
        return roll_out(
            scene,
            np.zeros(1, dtype=np.int64),
            terms,
            self._parameters,
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
        time = np.append(at, last)[:, None, None] * (seconds / self._parameters.steps)
        p_WO = scene.p_WO + time * scene.v_WO
        distance = signed_distance(path[:, None], p_WO, scene.R_WO[0], scene.semi_axes[0])
        return distance[:-1].min(axis=0), distance[0], distance[-1]


def taken_route(route: Route, coupling: CouplingParameters) -> Route:
    """The route with the side that coupling in given planes takes, see `TakenRoute`.

    Raises:
        ValueError: if the two do not have the same rows.
    """
    if len(route.ids) != len(coupling):
        raise ValueError(
            f"route has {len(route.ids)} rows, coupling_parameters {len(coupling)}: they must be "
            "of the same obstacles"
        )
    bent = coupling.alpha > 0.0
    direction_W, normal_W = np.array(route.direction_W), np.array(route.normal_W)
    normal_W[bent] = coupling.normal_W[bent]
    # The normal is x_L x omega.
    direction_W[bent] = np.cross(coupling.normal_W[bent], route.R_WL[:, 0])
    least = np.finfo(float).tiny
    return replace(
        route,
        direction_W=direction_W,
        normal_W=normal_W,
        clearance=np.where(bent, np.maximum(route.clearance, least), 0.0),
    )


def concern(regulation: Regulation) -> str:
    """What is to be said about a motion that does not do all that was asked, or ""."""
    found = []
    if regulation.shortfall > 0.0:
        found.append(
            f"{1e3 * regulation.shortfall:.1f} mm of the clearance to obstacle "
            f"{regulation.short_of} cannot be kept"
        )
    if regulation.way.concern:
        found.append(regulation.way.concern)
    if regulation.goal_error > _MISSED:
        found.append(f"the goal is missed by {1e3 * regulation.goal_error:.1f} mm")
    return " and ".join(found)


def _planned(s: float, motion: SpatialRollouts, steps: int) -> PlannedMotion:
    """Samples of a single roll-out from s on, its first and last point among them."""
    path = motion.path[0, : int(motion.steps[0]) + 1]
    length = np.linalg.norm(np.diff(path, axis=0), axis=1)
    # Grows by 1 at least from one sample to the next.
    measure = np.append(0.0, np.cumsum(np.maximum(length / _APART, 1.0 / (steps * _BETWEEN))))
    count = max(math.ceil(measure[-1]), 1)
    at = np.unique(np.searchsorted(measure, np.linspace(0.0, measure[-1], count + 1)))
    return PlannedMotion(s + at / steps, path[at])


def _side(regulation: Regulation) -> FloatArray:
    """No genes but the side: who comes back to a term is not to come back on another side."""
    genes = _no_genes()
    genes[ANGLE] = regulation.genes[ANGLE]
    return genes


def _travelled(before: Regulation, policy: PolicyState) -> float:
    if before.tau == 0.0 or not np.array_equal(before.p_WS, policy.p_WS):
        return math.dist(policy.p_WE, policy.p_WS)
    return before.travelled + math.dist(policy.p_WE, before.p_WE)


def _hardly_moved(before: EllipsoidSet, now: EllipsoidSet) -> bool:
    """Whether the same obstacles are where they were expected, and as large, up to noise."""
    if not np.array_equal(before.ids, now.ids):
        return False
    since = now.stamp - before.stamp if len(now) else 0.0
    moved = np.abs(now.p_WO - before.p_WO - since * before.v_WO).max(initial=0.0)
    grown = np.abs(now.semi_axes - before.semi_axes).max(initial=0.0)
    return bool(max(moved, grown) <= _NOISE)


def _stays(before: Regulation, here: Regulation) -> bool:
    """Whether the motion that was verified goes on among the same resting obstacles."""
    one, other = before.ellipsoids, here.ellipsoids
    return (
        before.tau != 0.0
        and np.array_equal(before.p_WS, here.p_WS)
        and np.array_equal(before.p_WG, here.p_WG)
        and not other.v_WO.any()
        and (
            one is other
            or all(
                np.array_equal(getattr(one, name), getattr(other, name))
                for name in ("ids", "p_WO", "R_WO", "semi_axes", "v_WO")
            )
        )
        and _same_plane(before.table, here.table)
        and _on_path(before.motion, here.p_WE)
    )


def _on_path(motion: PlannedMotion, p_WE: FloatArray) -> bool:
    """Whether the policy is where the motion goes: evasion displaces it."""
    if len(motion) < 2:
        return True
    start, way = motion.p_WE[:-1], np.diff(motion.p_WE, axis=0)
    square = np.maximum(np.einsum("ij,ij->i", way, way), 1e-18)
    share = np.clip(np.einsum("ij,ij->i", p_WE - start, way) / square, 0.0, 1.0)
    off = start + share[:, None] * way - p_WE
    return bool(np.einsum("ij,ij->i", off, off).min() <= _OFF_PATH**2)


def _same_plane(one: TablePlane | None, other: TablePlane | None) -> bool:
    if one is None or other is None:
        return one is other
    return one.offset == other.offset and np.array_equal(one.normal_W, other.normal_W)


def _length(path: FloatArray) -> float:
    return float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
