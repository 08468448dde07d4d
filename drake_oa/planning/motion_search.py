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
    Route,
)
from drake_oa.geometry.solids import SURROUNDINGS
from drake_oa.planning.arm_world import (
    SELF,
    ArmWorld,
    Asked,
    group_distances,
    kept_along,
    lacking_along,
    self_distance,
)
from drake_oa.planning.imitation import LONGEST, demonstration
from drake_oa.planning.joint_planner import plan_path
from drake_oa.planning.search import ASTRAY, MISSED, SAMPLES, ArmSearch, Earlier, Leading
from drake_oa.planning.sides import Sides, taken
from drake_oa.planning.solid_scene import SolidScene
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, KAPPA, N_COLUMNS, NORMAL, PSI
from drake_oa.policy.demonstration import Demonstration
from drake_oa.policy.dmp import Dmp, local_frame, normalised_time
from drake_oa.policy.orientation_dmp import orientation_along
from drake_oa.policy.rollout import Scene
from drake_oa.regulation.config import Verified
from drake_oa.regulation.proposals import ALPHA as LOG_ALPHA
from drake_oa.regulation.proposals import N_GENES, TAU, avoidance_terms
from drake_oa.robot.arm import (
    FARTHEST,
    Chain,
    Spheres,
    inverse_kinematics,
    nearest_free_place,
    tool_poses,
)

_LED = 201
"""Samples by which the arm is led along a motion."""
_PATHS = 4
"""So many paths to the same postures are tried, where the arm cannot go what imitates one."""
_SELF_CLEARANCE, _LEAST_KEPT = 0.005, 1e-3
"""Requested distance of the arm to itself, and least distance to anything [m]."""
_SEEK_PERIOD = 0.5
"""Time between searches for a path in the joints while no motion will do [s]."""
_SHARES, _GOAL_SEEDS = (0.5, 0.2), 128
"""Shares of the requested clearances that are tried in turn, and random seeds of goal postures."""


@dataclass(frozen=True, eq=False)
class Sight(Frozen):
    """What is known when a motion is chosen.

    Attributes:
        policy: where the motion is.
        p_WG: (3,) its goal [m].
        q: (n,) the arm's joints [rad].
        scene: the solids.
        ellipsoids: what is proposed by; empty: as if nothing were there.
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
        hasty: whether it is the first that would do, and better ones are to be looked for.
        route: the sides that were weighed, with their costs, and which was taken.
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
    hasty: bool = False
    route: Route = field(default_factory=Route)

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
        sides: Sides,
        dmp: Dmp,
        clearance: float,
        chain: Chain,
        spheres: Spheres,
        *,
        parameters: Verified,
        policy: Policy,
        orientation: Callable[[FloatArray], FloatArray],
        posture: Callable[[FloatArray], FloatArray],
        q_goal: FloatArray | None = None,
        overshoot: FloatArray | None = None,
    ) -> None:
        """Keeps what does not change.

        Args:
            sides: what proposes motions of the tool, and on which sides.
            dmp: the movement primitive that the task demonstrates.
            clearance: asked distance Delta of the tool to every solid [m].
            chain, spheres: the arm.
            parameters: how far the search goes.
            policy: time step and fade of the action level.
            orientation: (T, 3, 3) of the tool at normalised times (T,).
            posture: (T, n) that the null space is drawn to at normalised times (T,) [rad].
            q_goal: (n,) joints at the goal, where the task gives them [rad].
            overshoot: (G,) how far the spheres of each group stick out of the robot [m]; None: 0.
        """
        self._sides, self._dmp, self._clearance = sides, dmp, clearance
        self._chain, self._spheres, self._parameters = chain, spheres, parameters
        self._policy = policy
        s = np.linspace(0.0, 1.0, _LED)
        self._task = Leading(s, orientation(s).reshape(_LED, 9), posture(s)[None])
        self._q_goal, self._is_tool = q_goal, spheres.of_tool[spheres.first[:-1]]
        self._overshoot = np.zeros(len(spheres.group_joint)) if overshoot is None else overshoot
        # What spheres that keep less may touch: groups, and the tool's and the links' together.
        self._touch = _LEAST_KEPT - self._overshoot
        moved = spheres.group_joint >= 0
        parts = (self._is_tool & moved, ~self._is_tool & moved)
        self._touch_of_parts = np.array([self._touch[of].min(initial=np.inf) for of in parts])

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
        same = here.scene.same_as(sight.scene)
        if goes_on and not here.note and same and here.tau > 0.0 and not here.hasty:
            return here
        if here.goal_note and not same:
            # What was found when no motion led there says nothing of those that do.
            none = Choice()
            here = replace(here, goal_note="", genes=none.genes, elites=none.elites, tau=0.0)
        here = replace(here, scene=sight.scene, touches=self._touched(sight))
        rests = policy.speed == 0.0 or policy.phase == 1.0
        if goes_on and rests and here.goal_note:
            # No motion leads there, as long as nothing changes.
            return replace(here, note=here.goal_note)
        due = sight.time - here.planned >= _SEEK_PERIOD
        plans = rests and due and not sight.scene.moves
        # Who waits at rest does not wait for the best, and a plan may follow.
        hasty = plans and policy.phase == 1.0 and not here.hasty
        # What was best among what rested may be nowhere near.
        afresh = sight.scene.moves and not before.scene.moves
        found = self._modulated(here, sight, hasty=hasty, afresh=afresh)
        if found.follows and found.short == 0.0:
            return found
        if found.route.blocked:
            return replace(found, note=found.route.note)
        if plans:
            planned, is_free = self._planned(replace(found, planned=sight.time), sight)
            if planned is not None:
                return planned
            found = self._modulated(here, sight) if hasty else found
            found = replace(found, planned=sight.time)
            found = replace(found, goal_note="" if is_free else self._no_goal(sight))
        return replace(found, note=found.goal_note or self._hold(found, sight))

    def still_holds(self, made: Choice, sight: Sight) -> bool:
        """Whether a motion keeps from now on what it was found to keep when it was looked for.

        Since then the one in force has gone on: straight at what a term acts about its side hangs
        on little. Among what moves the next look tells.
        """
        if sight.scene.moves or sight.policy.phase == 1.0 or not made.motion.s.size:
            return True
        found = self._rolled(made, sight, self._world(sight, made.motion.q[-1:]))
        return found.follows and found.short <= made.short + self._parameters.slack

    def _hold(self, found: Choice, sight: Sight) -> str:
        """Why a motion that is short of what is asked must not go on; "": it may."""
        if not found.follows:
            return "no motion that the arm can follow found"
        if not self._clears(found, sight):
            touches = (found.kept[:2] <= self._touch_of_parts).any()
            return f"no motion that clears {found.short_of if touches else 'the arm itself'} found"
        return ""

    def _world(self, sight: Sight, ends: FloatArray, share: float = 1.0) -> ArmWorld:
        """Tool and links among the solids, with what now and the ends (m, n) leave them."""
        solids, now = sight.scene.solids, sight.time
        spheres, p, is_tool = self._spheres, self._parameters, self._is_tool
        asked = np.where(is_tool, self._clearance, min(p.link_clearance, self._clearance))
        table = np.tile(share * asked[:, None], (1, len(solids.ball)))
        around = solids.layout[:, 5] == SURROUNDINGS
        table[:, around] = np.minimum(table[:, around], share * p.link_clearance)
        left = group_distances(self._chain, spheres, solids, sight.q, now)
        if len(ends):
            at_end = [group_distances(self._chain, spheres, solids, q, now) for q in ends]
            left = np.minimum(
                left, np.maximum(np.max(at_end, axis=0), self._touch[:, None] + p.slack)
            )
        table = np.minimum(table, left - p.slack)
        table[spheres.group_joint < 0] = -np.inf
        of_self = min(_SELF_CLEARANCE, self._own(sight.q) - p.slack)
        if len(ends):
            own = max(self._own(q) for q in ends)
            of_self = min(of_self, max(own, _LEAST_KEPT) - p.slack)
        return ArmWorld(self._chain, spheres, solids, Asked(table, of_self, is_tool), now)

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

    def _modulated(
        self, here: Choice, sight: Sight, *, hasty: bool = False, afresh: bool = False
    ) -> Choice:
        """The best of the motions that the coupling terms bend, or in haste the first."""
        leading, dmp = self._leading(here, sight), self._dmp_of(here)
        scene = self._scene(sight, dmp)
        target = np.append(leading.R_WE[-1], sight.p_WG)
        ends = inverse_kinematics(self._chain, target, leading.q[0, -1], seeds=4)[:1]
        world = self._world(sight, ends)
        waits = sight.policy.phase == 1.0 and not sight.scene.moves
        route = self._sides.weighed(scene, sight.ellipsoids, dmp.duration, self._clearance)
        search = ArmSearch(
            scene,
            world,
            sight.q,
            leading,
            dmp=dmp,
            policy=self._policy,
            price=(price := self._sides.price(route)),
            # Of the first that would do nothing is to be kept but what it led to.
            previous=Choice().genes if here.hasty else here.genes,
            parameters=replace(self._parameters, polish=0) if hasty else self._parameters,
            settled=here.tau > 0.0 and not sight.scene.moves and not here.hasty,
            earlier=Earlier(here.elites, here.rounds, afresh),
            most=math.inf if waits else self._parameters.frame,
            samples=_samples_of(here),
        )
        count = self._parameters.candidates
        found = search.run(self._sides.proposer.propose(scene, dmp.duration, count, price))
        genes = np.array(found.genes[0])
        # Nothing is better than the unmodulated one.
        route = taken(route, avoidance_terms(search.scene, genes[None])[0], genes, sight.ellipsoids)
        here = replace(here, hasty=hasty and genes[LOG_ALPHA] > -np.inf, route=route)
        if search.elites.size:
            here = replace(here, elites=search.elites, rounds=search.rounds)
        return self._chosen(here, sight, world, search, genes, float(found.length[0]))

    def _rolled(self, choice: Choice, sight: Sight, world: ArmWorld) -> Choice:
        """A motion as it is, from where it is now on."""
        dmp = self._dmp_of(choice)
        search = ArmSearch(
            self._scene(sight, dmp),
            world,
            sight.q,
            self._leading(choice, sight),
            dmp=dmp,
            policy=self._policy,
            previous=choice.genes,
            parameters=self._parameters,
            samples=_samples_of(choice),
        )
        genes = choice.genes
        if np.isnan(genes).any():
            genes = np.zeros(N_GENES)
            genes[LOG_ALPHA] = -np.inf
        return self._chosen(choice, sight, world, search, genes, 0.0)

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
        seconds = float(search.seconds(genes[None])[0])
        # Every second: they are a few millimetres apart.
        t = world.now + seconds * (s - s[0])
        kept, near = kept_along(world, arm.q[0, :count:2], t[::2])
        of_self = float(arm.excess[0, SELF]) + world.asked.of_self
        if arm.excess[0].argmin() == SELF:
            near = -1
        short = max(-float(arm.least[0]) - self._parameters.slack, 0.0)
        follows = float(arm.error[0]) <= MISSED and float(arm.hurry[0]) <= 1.0
        follows &= float(tool.goal_error[0]) <= ASTRAY * search.scene.baseline
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
            term=avoidance_terms(search.scene, genes[None])[0],
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

    def _scene(self, sight: Sight, dmp: Dmp) -> Scene:
        policy, seen = sight.policy, sight.ellipsoids
        lag = sight.time - seen.stamp if math.isfinite(seen.stamp) else 0.0
        return Scene(
            p_WE=policy.p_WE,
            z_W=policy.z_W,
            p_WG=np.asarray(sight.p_WG, dtype=float),
            R_WL=local_frame(policy.p_WS, sight.p_WG),
            baseline=math.dist(sight.p_WG, policy.p_WS),
            ellipsoids=replace(seen, p_WO=seen.p_WO + lag * seen.v_WO),
            clearance=np.full(len(seen), self._clearance),
            s=max(0.0, normalised_time(policy.phase, dmp.alpha_k)),
        )

    # --- a path in the joints -------------------------------------------------------------

    def _goals(self, sight: Sight, seeds: int) -> FloatArray:
        """(m, n) postures at the goal that touch nothing, the task's own first [rad]."""
        X_WG, first = self._goal(sight)
        found = inverse_kinematics(self._chain, X_WG, first, seeds=seeds)
        free = [q for q in found if self._is_free(sight, q)]
        return np.array(free).reshape(-1, len(first))

    def _goal(self, sight: Sight) -> tuple[FloatArray, FloatArray]:
        """(12,) pose of the tool at the goal [m], and (n,) the joints that are asked for [rad]."""
        first = self._task.q[0, -1] if self._q_goal is None else self._q_goal
        return np.append(self._task.R_WE[-1], sight.p_WG), first

    def _no_goal(self, sight: Sight) -> str:
        """What is in the way at the goal, and where near it there is room."""
        X_WG, first = self._goal(sight)
        at_goal = inverse_kinematics(self._chain, X_WG, first, seeds=4)
        if not len(at_goal):
            return ""
        free = nearest_free_place(self._chain, X_WG, at_goal[0], lambda q: self._is_free(sight, q))
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
        attempts = [(share, p.configurations) for share in (1.0, *_SHARES)]
        attempts.append((min(_SHARES), p.last_configurations))
        # To the task's own posture first: the tool turns no farther than it has to.
        own, others = self._goals(sight, 0), None
        for share, most in attempts:
            choice = self._path_to(own, share, most, here, sight)
            if choice is not None:
                return choice, True
            # They take a while to find.
            others = self._goals(sight, _GOAL_SEEDS)[len(own) :] if others is None else others
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
        world = self._world(sight, ends, share)
        for seed in range(1, 1 + _PATHS):
            found = plan_path(world, sight.q, ends, most=most, seed=seed)
            if not len(found.q):
                return None
            choice = self._along(found.q, here, sight, world)
            if choice is not None:
                return choice
        return None

    def _along(
        self, corners: FloatArray, here: Choice, sight: Sight, world: ArmWorld
    ) -> Choice | None:
        """The motion that imitates a path in the joints; None: the arm cannot go it."""
        duration, alpha_k = self._dmp.duration, self._dmp.alpha_k
        pace = duration / max(math.dist(sight.p_WG, sight.policy.p_WE), 1e-3)
        try:
            shown = demonstration(
                world, corners, pace=pace, longest=LONGEST * duration, alpha_k=alpha_k
            )
        except ValueError:
            # The tool turns too far for one primitive.
            return None
        choice = self._imitated(here, sight, world, shown)
        return None if self._hold(choice, sight) else choice

    def _clears(self, choice: Choice, sight: Sight) -> bool:
        """Whether a motion touches nothing, as far as its spheres tell: they stick out."""
        if choice.kept[SELF] <= min(_LEAST_KEPT, self._own(sight.q) - self._parameters.slack):
            return False
        return bool((choice.kept[:2] > self._touch_of_parts).all())

    def _of_moving(self, sight: Sight, q: FloatArray) -> FloatArray:
        """(G, K) distances of the groups that move to the solids; inf of the others [m]."""
        d = group_distances(self._chain, self._spheres, sight.scene.solids, q, sight.time)
        d[self._spheres.group_joint < 0] = np.inf
        return np.asarray(d)

    def _is_free(self, sight: Sight, q: FloatArray) -> bool:
        """Whether the moving groups touch no solid at a configuration."""
        return bool((self._of_moving(sight, q) > self._touch[:, None]).all())

    def _nearest(self, sight: Sight, q: FloatArray) -> str:
        """Label of the solid that the arm is nearest to at a configuration; "": there is none."""
        d = self._of_moving(sight, q)
        return sight.scene.labels[int(d.min(axis=0).argmin())] if d.size else ""

    def _touched(self, sight: Sight) -> str:
        """Label of what the arm is certain to stand in contact with; "": nothing."""
        d = self._of_moving(sight, sight.q) + self._overshoot[:, None]
        return sight.scene.labels[int(d.min(axis=0).argmin())] if (d < 0.0).any() else ""

    def _own(self, q: FloatArray) -> float:
        """How near the arm is to itself at a configuration, up to `FAR` [m]."""
        return float(self_distance(self._chain, self._spheres, q))

    def _imitated(
        self, here: Choice, sight: Sight, world: ArmWorld, shown: Demonstration
    ) -> Choice:
        """The motion that imitates a demonstration from where the arm rests."""
        policy = sight.policy
        rests = replace(policy, p_WS=policy.p_WE, z_W=np.zeros(3), phase=1.0)
        none = Choice()
        at = replace(
            here,
            demonstration=shown,
            travelled=0.0,
            genes=none.genes,
            elites=none.elites,
            hasty=False,
        )
        sight = replace(sight, policy=rests)
        chosen = self._rolled(at, sight, world)
        # Of all that is asked, not of the share that was.
        whole = self._world(sight, shown.q[-1:])
        q = chosen.motion.q
        short = max(lacking_along(whole, q) - self._parameters.slack, 0.0)
        if short > 0.0:
            _, near = kept_along(whole, q, np.full(len(q), whole.now))
            chosen = replace(chosen, short_of=sight.scene.labels[near])
        # The motion belongs to the one that begins there.
        motion = replace(chosen.motion, p_WS=rests.p_WS)
        return replace(chosen, short=short, tau=1.0, anew=True, motion=motion)


def _samples_of(choice: Choice) -> int:
    """How finely a motion is looked at."""
    return SAMPLES if choice.demonstration.position is None else _LED


def _travelled(before: Choice, policy: PolicyState) -> float:
    """Length of the way that the motion has gone [m]."""
    if not np.isfinite(before.p_WE).all():
        return math.dist(policy.p_WE, policy.p_WS)
    return before.travelled + math.dist(policy.p_WE, before.p_WE)
