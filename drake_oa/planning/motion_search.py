"""Which motion the whole arm goes, from one observation to the next.

The shortest of the candidates that keeps what is asked is taken: the motion in use, the unmodulated
one, those of the coupling terms (`drake_oa.planning.search`), each with postures that its null
space may be drawn to; and where none clears, once the motion rests, a path in the joints
(`drake_oa.planning.joint_planner`) that the primitives imitate (`drake_oa.planning.imitation`) and
that is rolled out like any other. Where nothing keeps what is asked, it is asked for less, and
that is told, but no motion touches anything: an arm that stands in contact may only leave it, and
one whose goal is in contact holds, and says where the tool could be instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    Frozen,
    HoldCause,
    PlannedMotion,
    PolicyState,
)
from drake_oa.geometry.solids import SURROUNDINGS, solids_of
from drake_oa.planning.arm_world import (
    SELF,
    ArmWorld,
    Asked,
    Chain,
    excess_along,
    group_distances,
    kept_along,
    lacking_along,
    tool_poses,
)
from drake_oa.planning.goal_postures import FARTHEST, goal_postures, nearest_free_place
from drake_oa.planning.imitation import demonstration
from drake_oa.planning.joint_planner import plan_path
from drake_oa.planning.search import SAMPLES, ArmSearch, Leading
from drake_oa.planning.solid_scene import SolidScene
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.demonstration import Demonstration
from drake_oa.policy.dmp import Dmp, local_frame, normalised_time
from drake_oa.policy.orientation_dmp import orientation_along
from drake_oa.regulation.config import Verified
from drake_oa.regulation.proposals import ALPHA as LOG_ALPHA
from drake_oa.regulation.proposals import N_GENES, TAU
from drake_oa.regulation.regressor import ChainWeights
from drake_oa.regulation.rollout import SpatialScenes
from drake_oa.robot.sphere_kernels import Spheres

_LED = 201
"""Samples by which the arm is led along a motion."""


@dataclass(frozen=True, eq=False)
class Sight(Frozen):
    """What is known when a motion is chosen.

    Attributes:
        policy: where the motion is.
        p_WG: (3,) its goal [m].
        q: (n,) the arm's joints [rad].
        scene: the solids.
        ellipsoids: what the regressor chain proposes by; empty: it proposes for nothing.
    """

    policy: PolicyState
    p_WG: FloatArray
    q: FloatArray
    scene: SolidScene
    ellipsoids: EllipsoidSet = field(default_factory=EllipsoidSet)

    @property
    def time(self) -> float:
        """Now [s]."""
        return self.policy.stamp


@dataclass(frozen=True, eq=False)
class Choice(Frozen):
    """The motion that was chosen.

    Attributes:
        p_WS, p_WG: (3,) start and goal of the motion that it is for [m]; NaN: none yet.
        genes: (7,) of the coupling term; NaN: none.
        term: (13,) the term; its alpha is 0 for the unmodulated motion.
        tau: temporal scaling; 0: nothing was chosen.
        posture: (n,) that the null space is drawn to at the end; (0,): the task's [rad].
        demonstration: what the motion imitates; empty: what the task demonstrates.
        motion: of the whole arm, from when it was looked at.
        kept: (3,) least distances of tool and links to the solids, and of the arm to itself [m].
        short: by how much it is short of what is asked [m].
        short_of: label of the solid.
        follows: whether the arm can follow it to the goal.
        lowered: by how much less than the asked clearance is asked, as start or goal leave no
            more [m].
        note: "" or why the motion must not go on.
        goal_note: "" or why there is no posture at the goal, as far as was looked.
        touches: label of what the arm stands in contact with; "": nothing.
        anew: whether a motion with this demonstration is to begin where the arm rests.
        scene: what was seen.
        travelled, p_WE: the way until then, and where it was [m].
        planned: when a path in the joints was looked for last [s].
        elites: (k, 7) genes of the best candidates, from which the search goes on.
        rounds: that it has gone through.
    """

    p_WS: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    p_WG: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    genes: FloatArray = field(default_factory=lambda: np.full(N_GENES, np.nan))
    term: FloatArray = field(default_factory=lambda: np.zeros(N_COLUMNS))
    tau: float = 0.0
    posture: FloatArray = field(default_factory=lambda: np.zeros(0))
    demonstration: Demonstration = field(default_factory=Demonstration)
    motion: PlannedMotion = field(default_factory=PlannedMotion)
    kept: FloatArray = field(default_factory=lambda: np.full(3, np.inf))
    short: float = 0.0
    short_of: str = ""
    follows: bool = True
    lowered: float = 0.0
    note: str = ""
    goal_note: str = ""
    touches: str = ""
    anew: bool = False
    scene: SolidScene = field(default_factory=SolidScene)
    travelled: float = 0.0
    p_WE: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    planned: float = -math.inf
    elites: FloatArray = field(default_factory=lambda: np.zeros((0, N_GENES)))
    rounds: int = 0

    def fits(self, policy: PolicyState, p_WG: FloatArray) -> bool:
        """Whether it is for the motion that is under way."""
        return np.array_equal(self.p_WS, policy.p_WS) and np.array_equal(self.p_WG, p_WG)

    def coupling(self) -> CouplingParameters:
        """As the action level takes it: a term of its own, at most one."""
        count = int(self.term[ALPHA] > 0.0)
        rows = self.term[None, :][:count]
        return CouplingParameters(
            rows[:, ALPHA],
            rows[:, PSI],
            rows[:, KAPPA],
            np.ones(count, dtype=bool),
            rows[:, :3],
            rows[:, NORMAL : NORMAL + 3],
            tau=self.tau,
            hold=HoldCause.OBSTACLES if self.note else HoldCause.NONE,
            note=self.note,
            anew=self.anew,
            verified=True,
        )


class MotionSearch:
    """Chooses motions of one arm and one movement primitive."""

    def __init__(
        self,
        weights: ChainWeights,
        dmp: Dmp,
        clearance: float,
        chain: Chain,
        spheres: Spheres,
        *,
        parameters: Verified,
        steps: int,
        fade: float,
        orientation: Callable[[FloatArray], FloatArray],
        posture: Callable[[FloatArray], FloatArray],
        q_goal: FloatArray | None = None,
        overshoot: float = 0.0,
    ) -> None:
        """Keeps what does not change.

        Args:
            weights: the chain that proposes.
            dmp: the movement primitive that the task demonstrates.
            clearance: asked distance Delta of the tool to every solid [m].
            chain, spheres: the arm.
            parameters: how far the search goes.
            steps: of a roll-out a unit of normalised time.
            fade: of the coupling near the goal, in baselines.
            orientation: (T, 3, 3) of the tool at normalised times (T,).
            posture: (T, n) that the null space is drawn to at normalised times (T,) [rad].
            q_goal: (n,) joints at the goal, where the task gives them [rad].
            overshoot: how far the spheres stick out of the robot [m].
        """
        self._weights, self._dmp, self._clearance = weights, dmp, clearance
        self._chain, self._spheres, self._parameters = chain, spheres, parameters
        self._search = parameters.search(steps, fade)
        s = np.linspace(0.0, 1.0, _LED)
        self._task = Leading(s, orientation(s).reshape(_LED, 9), posture(s)[None])
        self._q_goal, self._overshoot = q_goal, overshoot
        self._is_tool = spheres.of_tool[spheres.first[:-1]]
        # What spheres that keep less may touch.
        self._touch = parameters.least_kept - overshoot

    def decide(self, before: Choice, sight: Sight) -> Choice:
        """Looks at a motion under way, and chooses anew if there is reason to."""
        policy, baseline = sight.policy, math.dist(sight.p_WG, sight.policy.p_WS)
        if sight.scene.stamp == -math.inf or baseline == 0.0:
            return Choice()
        goes_on = before.fits(policy, sight.p_WG)
        if before.anew and not goes_on and np.array_equal(before.p_WG, sight.p_WG):
            # The motion has begun anew as it was told to, where it came to rest.
            motion = replace(before.motion, p_WS=policy.p_WS)
            before = replace(before, p_WS=policy.p_WS, anew=False, travelled=0.0, motion=motion)
            goes_on = True
        elif not goes_on:
            before = Choice(planned=before.planned)
        before = replace(before, anew=before.anew and policy.speed == 0.0)
        here = replace(
            before,
            p_WS=policy.p_WS,
            p_WG=np.array(sight.p_WG, dtype=float),
            p_WE=policy.p_WE,
            travelled=_travelled(before, policy),
        )
        if goes_on and not here.note and here.scene.same_as(sight.scene) and here.tau > 0.0:
            return here
        same = here.scene.same_as(sight.scene)
        if here.goal_note and not same:
            # What was found when no motion led there says nothing of those that do.
            none = Choice()
            here = replace(here, goal_note="", genes=none.genes, elites=none.elites, tau=0.0)
        here = replace(here, scene=sight.scene, touches=self._touched(sight))
        rests = policy.speed == 0.0 or policy.phase == 1.0
        if goes_on and rests and here.goal_note:
            # No motion leads there, as long as nothing changes.
            return replace(here, note=here.goal_note)
        found = self._modulated(here, sight)
        if found.follows and found.short == 0.0:
            return found
        due = sight.time - here.planned >= self._parameters.seek_period
        if rests and due and not sight.scene.moves:
            found = replace(found, planned=sight.time)
            planned, is_free = self._planned(found, sight)
            if planned is not None:
                return planned
            found = replace(found, goal_note="" if is_free else self._no_goal(sight))
        return replace(found, note=found.goal_note or self._hold(found, sight))

    def _hold(self, found: Choice, sight: Sight) -> str:
        """Why a motion that is short of what is asked must not go on; "": it may."""
        if not found.follows:
            return "no motion that the arm can follow found"
        if not self._clears(found, sight):
            touches = found.kept[:2].min() <= self._touch
            return f"no motion that clears {found.short_of if touches else 'the arm itself'} found"
        return ""

    # --- what is asked -------------------------------------------------------------------

    def _world(self, sight: Sight, ends: FloatArray, share: float = 1.0) -> ArmWorld:
        """Tool and links among the solids, with what now and the ends (m, n) leave them."""
        solids, now = sight.scene.solids, sight.time
        spheres, p = self._spheres, self._parameters
        is_tool = self._is_tool
        asked = np.where(is_tool, self._clearance, min(p.link_clearance, self._clearance))
        table = np.tile(share * asked[:, None], (1, len(solids.ball)))
        around = solids.layout[:, 5] == SURROUNDINGS
        table[:, around] = np.minimum(table[:, around], share * p.link_clearance)
        left = group_distances(self._chain, spheres, solids, sight.q, now)
        if len(ends):
            at_end = [group_distances(self._chain, spheres, solids, q, now) for q in ends]
            left = np.minimum(left, np.maximum(np.max(at_end, axis=0), self._touch + p.slack))
        table = np.minimum(table, left - p.slack)
        table[spheres.group_joint < 0] = -np.inf
        return ArmWorld(self._chain, spheres, solids, Asked(table, p.self_clearance, is_tool), now)

    # --- candidates ----------------------------------------------------------------------

    def _dmp_of(self, choice: Choice) -> Dmp:
        return choice.demonstration.position or self._dmp

    def _leading(self, choice: Choice, sight: Sight) -> Leading:
        """How the arm is led along the motion that is under way."""
        shown = choice.demonstration
        if shown.orientation is None:
            return self._task
        X_WS = tool_poses(self._chain, shown.q[:1])[0]
        R_WE = orientation_along(
            shown.orientation, X_WS[:9].reshape(3, 3), shown.R_WG, self._task.s
        )
        return Leading(self._task.s, R_WE.reshape(-1, 9), shown.posture(self._task.s)[None])

    def _modulated(self, here: Choice, sight: Sight) -> Choice:
        """The best of the motions that the coupling terms bend."""
        leading, dmp = self._leading(here, sight), self._dmp_of(here)
        scene = self._scene(sight, dmp)
        target = np.append(leading.R_WE[-1], sight.p_WG)
        ends = goal_postures(self._chain, target, leading.q[0, -1], seeds=4)[:1]
        world = self._world(sight, ends)
        under_way = here.tau > 0.0 and (sight.scene.moves or sight.policy.speed > 0.0)
        search = ArmSearch(
            scene,
            world,
            sight.q,
            leading,
            dmp=dmp,
            previous=here.genes,
            parameters=self._search,
            settled=here.tau > 0.0 and not sight.scene.moves,
            seeds=here.elites,
            begun=here.rounds,
            most=self._parameters.configurations_a_frame if under_way else math.inf,
            samples=SAMPLES if here.demonstration.position is None else _LED,
        )
        result = search.run(self._weights)
        genes = np.array(result.genes[0])
        if search.elites.size:
            here = replace(here, elites=np.array(search.elites[0]), rounds=search.rounds)
        return self._chosen(here, sight, world, search, genes, float(result.path_length[0]))

    def _chosen(
        self,
        here: Choice,
        sight: Sight,
        world: ArmWorld,
        search: ArmSearch,
        genes: FloatArray,
        length: float,
    ) -> Choice:
        """What one candidate comes to, as a choice."""
        tool = search.tool_paths(genes[None])
        arm = search.follow(genes[None], tool, np.full(1, -np.inf))
        count = int(arm.samples[0])
        s = search.sample_times(count)
        seconds = search.duration * math.exp(genes[TAU])
        # Every second: they are a few millimetres apart.
        t = world.now + seconds * (s - s[0])
        kept, near = kept_along(world, arm.q[0, :count:2], t[::2])
        of_self = float(arm.excess[0, SELF]) + self._parameters.self_clearance
        if arm.excess[0].argmin() == SELF:
            near = -1
        short = max(-float(arm.least[0]) - self._search.slack, 0.0)
        follows = float(arm.error[0]) <= self._parameters.missed and float(arm.hurry[0]) <= 1.0
        baseline = float(search.scenes.baseline[0])
        follows &= float(tool.goal_error[0]) <= self._search.astray * baseline
        moving = sight.scene.moves
        tau = math.exp(genes[TAU]) if moving else 1.0
        if not moving:
            tau = max(1.0, (here.travelled + length) / max(search.planned_length, 1e-9))
        motion = PlannedMotion(
            s, tool.path[0, :: search.every][:count], arm.q[0, :count], here.p_WS
        )
        return replace(
            here,
            genes=genes if genes[LOG_ALPHA] > -np.inf else np.full(N_GENES, np.nan),
            term=search.terms(genes),
            tau=tau,
            motion=motion,
            kept=np.append(kept, of_self),
            short=short,
            short_of=sight.scene.labels[near] if near >= 0 else "the arm itself",
            follows=follows,
            lowered=max(self._clearance - float(world.asked.of_solids.max(initial=-np.inf)), 0.0)
            if len(sight.scene)
            else 0.0,
            note="",
        )

    def _scene(self, sight: Sight, dmp: Dmp) -> SpatialScenes:
        policy, seen = sight.policy, sight.ellipsoids
        lag = sight.time - seen.stamp if math.isfinite(seen.stamp) else 0.0
        return SpatialScenes(
            p_WE=policy.p_WE[None],
            z_W=policy.z_W[None],
            p_WG=np.asarray(sight.p_WG, dtype=float)[None],
            R_WL=local_frame(policy.p_WS, sight.p_WG)[None],
            baseline=np.array([math.dist(sight.p_WG, policy.p_WS)]),
            p_WO=(seen.p_WO + lag * seen.v_WO)[None],
            R_WO=seen.R_WO[None],
            semi_axes=seen.semi_axes[None],
            v_WO=seen.v_WO[None],
            asked_clearance=np.full((1, len(seen)), self._clearance),
            s=max(0.0, normalised_time(policy.phase, dmp.alpha_k)),
        )

    # --- a path in the joints -------------------------------------------------------------

    def _goals(self, sight: Sight, seeds: int) -> FloatArray:
        """(m, n) postures at the goal that touch nothing, the task's own first [rad]."""
        X_WG, first = self._goal(sight)
        found = goal_postures(self._chain, X_WG, first, seeds=seeds)
        free = [q for q in found if self._least(sight, q) > self._touch]
        return np.array(free).reshape(-1, len(first))

    def _goal(self, sight: Sight) -> tuple[FloatArray, FloatArray]:
        """(12,) pose of the tool at the goal [m], and (n,) the joints that are asked for [rad]."""
        first = self._task.q[0, -1] if self._q_goal is None else self._q_goal
        return np.append(self._task.R_WE[-1], sight.p_WG), first

    def _no_goal(self, sight: Sight) -> str:
        """What is in the way at the goal, and where near it there is room."""
        X_WG, first = self._goal(sight)
        at_goal = goal_postures(self._chain, X_WG, first, seeds=4)
        if not len(at_goal):
            return ""
        free = nearest_free_place(
            self._chain, X_WG, at_goal[0], lambda q: self._least(sight, q) > self._touch
        )
        touched = self._nearest(sight, at_goal[0])
        note = f"at its goal the arm would touch {touched}; "
        if free is None:
            return f"{note}the tool has no free place within {FARTHEST:g} m"
        place = ", ".join(f"{value:.3f}" for value in free)
        return f"{note}the tool's nearest free place is [{place}] m"

    def _planned(self, here: Choice, sight: Sight) -> tuple[Choice | None, bool]:
        """A motion that imitates a path in the joints, and whether a posture at the goal is free.

        None: there is none that is clear.
        """
        p = self._parameters
        attempts = [(share, p.configurations) for share in (1.0, *p.shares)]
        attempts.append((min(p.shares, default=1.0), p.last_configurations))
        # To the task's own posture first: the tool turns no farther than it has to.
        own, others = self._goals(sight, 0), None
        for share, most in attempts:
            choice = self._path_to(own, share, most, here, sight)
            if choice is not None:
                return choice, True
            # They take a while to find.
            others = self._goals(sight, p.goal_seeds)[len(own) :] if others is None else others
            choice = self._path_to(others, share, most, here, sight)
            if choice is not None:
                return choice, True
            if not len(own) + len(others):
                return None, False
        return None, True

    def _path_to(
        self, ends: FloatArray, share: float, most: int, here: Choice, sight: Sight
    ) -> Choice | None:
        """A path to one of some postures, for a share of what is asked, as a motion."""
        if not len(ends):
            return None
        p = self._parameters
        world = self._world(sight, ends, share)
        found = plan_path(world, sight.q, ends, most=most, seed=1)
        if not len(found.q):
            return None
        duration = self._dmp.duration
        try:
            shown = demonstration(
                world,
                found.q,
                pace=duration / max(math.dist(sight.p_WG, sight.policy.p_WE), 1e-3),
                longest=p.longest * duration,
                share=p.speed_share,
                alpha_k=self._dmp.alpha_k,
            )
        except ValueError:
            # The tool turns too far for one primitive.
            return None
        choice = self._imitated(here, sight, world, shown)
        return None if self._hold(choice, sight) else choice

    def _clears(self, choice: Choice, sight: Sight) -> bool:
        """Whether a motion touches nothing, as far as its spheres tell: they stick out."""
        least = self._parameters.least_kept
        if choice.kept[SELF] <= min(least, self._own(sight) - self._parameters.slack):
            return False
        return bool(choice.kept[:2].min() > self._touch)

    def _of_moving(self, sight: Sight, q: FloatArray) -> FloatArray:
        """(G, K) distances of the groups that move to the solids; inf of the others [m]."""
        d = group_distances(self._chain, self._spheres, sight.scene.solids, q, sight.time)
        d[self._spheres.group_joint < 0] = np.inf
        return np.asarray(d)

    def _least(self, sight: Sight, q: FloatArray) -> float:
        """What the moving groups keep of the solids at a configuration at least [m]."""
        return float(self._of_moving(sight, q).min(initial=math.inf))

    def _nearest(self, sight: Sight, q: FloatArray) -> str:
        """Label of the solid that the arm is nearest to at a configuration; "": there is none."""
        d = self._of_moving(sight, q)
        return sight.scene.labels[int(d.min(axis=0).argmin())] if d.size else ""

    def _touched(self, sight: Sight) -> str:
        """Label of what the arm is certain to stand in contact with; "": nothing."""
        return self._nearest(sight, sight.q) * (self._least(sight, sight.q) < -self._overshoot)

    def _own(self, sight: Sight) -> float:
        """How near the arm is to itself now [m], up to `FAR`."""
        asked = Asked(np.zeros((len(self._spheres.group_joint), 0)), 0.0, self._is_tool)
        world = ArmWorld(self._chain, self._spheres, solids_of([]), asked, sight.time)
        return float(excess_along(world, sight.q[None]))

    def _imitated(
        self, here: Choice, sight: Sight, world: ArmWorld, shown: Demonstration
    ) -> Choice:
        """The motion that imitates a demonstration from where the arm rests."""
        policy = sight.policy
        rests = replace(policy, p_WS=policy.p_WE, z_W=np.zeros(3), phase=1.0)
        none = Choice()
        at = replace(here, demonstration=shown, travelled=0.0, genes=none.genes, elites=none.elites)
        sight = replace(sight, policy=rests)
        dmp = self._dmp_of(at)
        search = ArmSearch(
            self._scene(sight, dmp),
            world,
            sight.q,
            self._leading(at, sight),
            dmp=dmp,
            previous=at.genes,
            parameters=self._search,
            samples=_LED,
        )
        genes = np.zeros(N_GENES)
        genes[LOG_ALPHA] = -np.inf
        chosen = self._chosen(at, sight, world, search, genes, 0.0)
        # Of all that is asked, not of the share that was.
        whole = self._world(sight, shown.q[-1:])
        q = chosen.motion.q
        short = max(lacking_along(whole, q) - self._search.slack, 0.0)
        if short > 0.0:
            _, near = kept_along(whole, q, np.full(len(q), whole.now))
            chosen = replace(chosen, short_of=sight.scene.labels[near])
        # The motion belongs to the one that begins there.
        motion = replace(chosen.motion, p_WS=rests.p_WS)
        return replace(chosen, short=short, tau=1.0, anew=True, motion=motion)


def _travelled(before: Choice, policy: PolicyState) -> float:
    """Length of the way that the motion has gone [m]."""
    if not np.isfinite(before.p_WE).all():
        return math.dist(policy.p_WE, policy.p_WS)
    return before.travelled + math.dist(policy.p_WE, before.p_WE)
