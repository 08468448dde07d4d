"""Selection of the whole arm's motion, from one observation to the next.

Candidates, in this order: the nominal motion; the rows of the paper's chain together, with heading
guidance; the proposed sides, ranked, with several strengths each; the local search
(`drake_oa.planning.search`); and once the motion rests and none is feasible, a path in the joints
(`drake_oa.planning.joint_planner`) that the primitives imitate (`drake_oa.planning.imitation`) and
that is rolled out like any other. The shortest one that achieves the requested clearance is
selected, with hysteresis for the motion in use. Where none does, the one with the least shortfall
is executed and the shortfall reported, but no motion touches anything: an arm in contact may only
leave it, and one whose goal is in contact holds, and reports the nearest free goal.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from drake_oa.common.messages import CHAIN as CHAIN_ROWS
from drake_oa.common.messages import (
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    Frozen,
    HoldCause,
    IntArray,
    PlannedMotion,
    PolicyState,
    Route,
    zeros,
)
from drake_oa.geometry.solids import SURROUNDINGS, SolidScene
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
from drake_oa.planning.search import (
    ASTRAY,
    CHAIN,
    JOINT_PATH,
    MISSED,
    NOMINAL,
    NONE_IN_USE,
    SAMPLES,
    SOURCES,
    ArmSearch,
    Earlier,
    Leading,
    nominal_genes,
)
from drake_oa.policy.action import Surroundings
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, N_COLUMNS, NORMAL
from drake_oa.policy.dmp import Demonstration, Dmp, normalised_time, orientation_along
from drake_oa.policy.guidance import Obstacles
from drake_oa.policy.rollout import Scene, scene_under_way
from drake_oa.regulation.config import Verified
from drake_oa.regulation.proposals import (
    ANGLE,
    N_GENES,
    avoidance_terms,
    genes_of,
    rows_of,
    terms_of,
)
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
_LEFT, _NEAR_TOOL = 0.015, 2e-3
"""Distance of a joint from the motion in use above which the arm has left it [rad], and distance of
the desired position from the tool below which it has been displaced there [m]."""
_SHARES, _GOAL_SEEDS = (0.5, 0.2), 128
"""Shares of the requested clearances that are tried in turn, and random seeds of goal postures."""


@dataclass(frozen=True, eq=False)
class Sight(Frozen):
    """Input of a decision.

    Attributes:
        policy: the motion under way.
        p_WG: (3,) its goal [m].
        q: (n,) the arm's joints [rad].
        scene: the solids that rest.
        ellipsoids: descriptors of the obstacles.
        proposed: returns the proposed coupling parameters and the route; called only if a search
            is needed.
    """

    policy: PolicyState
    p_WG: FloatArray
    q: FloatArray
    scene: SolidScene
    ellipsoids: EllipsoidSet = field(default_factory=EllipsoidSet)
    proposed: Callable[[], tuple[CouplingParameters, Route]] = lambda: (
        CouplingParameters(),
        Route(),
    )

    @property
    def time(self) -> float:
        """Time of the decision [s]."""
        return self.policy.stamp


class MotionSearch:
    """Chooses motions of one arm and one movement primitive."""

    def __init__(
        self,
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
        self._dmp, self._clearance = dmp, clearance
        self._chain, self._spheres, self._parameters = chain, spheres, parameters
        self._policy = policy
        s = np.linspace(0.0, 1.0, _LED)
        self._task = Leading(s, orientation(s).reshape(_LED, 9), posture(s))
        self._q_goal, self._is_tool = q_goal, spheres.of_tool[spheres.first[:-1]]
        self._overshoot = np.zeros(len(spheres.group_joint)) if overshoot is None else overshoot
        # What spheres that keep less may touch: groups, and the tool's and the links' together.
        self._touch = _LEAST_KEPT - self._overshoot
        # The same pose and seed at every decision.
        self._posture_at = lru_cache(maxsize=4)(
            lambda target, seed: inverse_kinematics(
                chain, np.frombuffer(target), np.frombuffer(seed), seeds=4
            )[:1]
        )
        moved = spheres.group_joint >= 0
        parts = (self._is_tool & moved, ~self._is_tool & moved)
        self._touch_of_parts = np.array([self._touch[of].min(initial=np.inf) for of in parts])

    def decide(self, before: SelectedMotion, sight: Sight) -> SelectedMotion:
        """Checks the motion under way, and selects another one if there is reason to.

        ======== ======= ======= ========= ==================================================
        same     scene   at rest path in   result
        motion   changed         joints
                                 is due
        ======== ======= ======= ========= ==================================================
        yes      no      any     any       unchanged, unless it holds or is provisional
        yes      any     yes     any       hold, while the goal has no feasible posture and
                                           nothing changes
        any      any     no      any       search; without result: hold, if the least
                                           shortfall is a contact
        any      any     yes     no        the same
        any      any     yes     yes       search for the first feasible motion; without
                                           result: path in the joints; without: full search
        ======== ======= ======= ========= ==================================================

        Where the arm rests away from the motion, after a maneuver of `MotionGuard`, a path in the
        joints from there comes first.

        A motion with another start or goal starts from an empty memory, unless it is the restart
        that was commanded.

        Args:
            before: result of the decision before.
            sight: input.
        """
        policy, baseline = sight.policy, math.dist(sight.p_WG, sight.policy.p_WS)
        if sight.scene.stamp == -math.inf or baseline == 0.0:
            return SelectedMotion()
        goes_on = before.key.fits(policy, sight.p_WG)
        if before.command.restart and not goes_on and np.array_equal(before.key.p_WG, sight.p_WG):
            # It has restarted as commanded, where it came to rest.
            motion = replace(before.prediction.motion, p_WS=policy.p_WS)
            before = before.changed(
                command={"restart": False},
                prediction={"motion": motion},
                memory={"travelled": 0.0},
            )
            goes_on = True
        elif not goes_on:
            before = SelectedMotion(memory=SearchMemory(last_plan=before.memory.last_plan))
        here = before.changed(
            key={"p_WS": policy.p_WS, "p_WG": np.array(sight.p_WG, dtype=float)},
            command={"restart": before.command.restart and policy.speed == 0.0},
            memory={"p_WE": policy.p_WE, "travelled": before.memory.travelled_to(policy)},
        )
        same = here.key.scene.same_as(sight.scene)
        settled = here.command.tau > 0.0 and not here.memory.is_provisional
        due = sight.time - here.memory.last_plan >= _SEEK_PERIOD
        left = goes_on and due and self._is_left(here, sight)
        if goes_on and not here.command.note and same and settled and not left:
            return here
        if here.prediction.goal_note and not same:
            # The result of a search without a goal is no beginning for another one.
            none = SearchMemory()
            here = here.changed(
                command={"tau": 0.0, "source": -1},
                prediction={"goal_note": ""},
                memory={"genes": none.genes, "elites": none.elites},
            )
        here = here.changed(
            key={"scene": sight.scene}, prediction={"touches": self._touched(sight)}
        )
        rests = policy.speed == 0.0 or policy.phase == 1.0
        if goes_on and rests and here.prediction.goal_note:
            return here.changed(command={"note": here.prediction.goal_note})
        plans = rests and due
        if left:
            here = here.changed(memory={"last_plan": sight.time})
            planned, _ = self._planned(here, sight)
            if planned is not None:
                return planned
        # At rest the first feasible motion does, and a path in the joints may follow.
        hasty = plans and policy.phase == 1.0 and not here.memory.is_provisional
        found = self._modulated(here, sight, hasty=hasty)
        if found.prediction.can_follow and found.prediction.shortfall == 0.0:
            return found
        sides = found.prediction.sides
        if sides.blocked:
            return found.changed(command={"note": sides.note})
        if plans:
            found = found.changed(memory={"last_plan": sight.time})
            planned, is_free = self._planned(found, sight)
            if planned is not None:
                return planned
            if hasty:
                found = self._modulated(here, sight).changed(memory={"last_plan": sight.time})
            note = "" if is_free else self._no_goal(sight)
            found = found.changed(prediction={"goal_note": note})
        note = found.prediction.goal_note or self._hold(found, sight)
        return found.changed(command={"note": note})

    def _is_left(self, here: SelectedMotion, sight: Sight) -> bool:
        """Returns whether the arm rests away from the motion in use, with its tool where this is.

        After a maneuver of `MotionGuard` the desired position goes to the tool.
        """
        motion, policy = here.prediction.motion, sight.policy
        if policy.speed > 0.0 or not len(motion.q):
            return False
        s = normalised_time(policy.phase, self._dmp.alpha_k)
        p_WE = tool_poses(self._chain, sight.q[None])[0, 9:]
        is_near = math.dist(p_WE, policy.p_WE) < _NEAR_TOOL
        return is_near and bool(np.abs(motion.joints(s) - sight.q).max() > _LEFT)

    def still_holds(self, made: SelectedMotion, sight: Sight) -> bool:
        """Returns whether a motion still achieves its predicted clearance from now on.

        Since then the one in use has continued: straight toward an obstacle, small differences
        decide its side.
        """
        if sight.policy.phase == 1.0 or not made.prediction.motion.s.size:
            return True
        motion = made.prediction.motion
        found = self._rolled(made, sight, self._world(sight, motion.q[-1:])).prediction
        allowed = made.prediction.shortfall + self._parameters.slack
        return found.can_follow and found.shortfall <= allowed

    def _hold(self, found: SelectedMotion, sight: Sight) -> str:
        """Returns why a motion with a shortfall must not continue; "": it may."""
        predicted = found.prediction
        if not predicted.can_follow:
            return "no motion that the arm can follow found"
        if not self._clears(predicted, sight):
            touches = (predicted.min_distances[:2] <= self._touch_of_parts).any()
            label = predicted.limiting_obstacle if touches else "the arm itself"
            return f"no motion that clears {label} found"
        return ""

    def _world(self, sight: Sight, ends: FloatArray, share: float = 1.0) -> ArmWorld:
        """Returns the arm among the solids, with the required clearances.

        Of the pair of the spheres of group g and solid k, with the configurations now and at the
        ends (m, n):

            required_gk = min(share * requested_g, min(d_now_gk, max(d_end_gk, touch_g + slack))
                              - slack)
        """
        solids, now = sight.scene.solids, sight.time
        spheres, p, is_tool = self._spheres, self._parameters, self._is_tool
        asked = np.where(is_tool, self._clearance, min(p.link_clearance, self._clearance))
        table = np.tile(share * asked[:, None], (1, len(solids.ball)))
        around = solids.layout[:, 5] == SURROUNDINGS
        table[:, around] = np.minimum(table[:, around], share * p.link_clearance)
        left = group_distances(self._chain, spheres, solids, sight.q[None], now, math.inf)
        if len(ends):
            at_end = [
                group_distances(self._chain, spheres, solids, q[None], now, math.inf) for q in ends
            ]
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

    def _dmp_of(self, command: MotionCommand) -> Dmp:
        return command.demonstration.position or self._dmp

    def _leading(self, command: MotionCommand) -> Leading:
        """How the arm is led along the motion that is under way."""
        shown = command.demonstration
        if shown.orientation is None:
            return self._task
        R_WE = orientation_along(shown.orientation, shown.R_WS, shown.R_WG, self._task.s)
        return Leading(self._task.s, R_WE.reshape(-1, 9), shown.posture(self._task.s))

    def _modulated(
        self, here: SelectedMotion, sight: Sight, *, hasty: bool = False
    ) -> SelectedMotion:
        """Returns the best motion by coupling terms, or in haste the first feasible one."""
        command, memory = here.command, here.memory
        leading, dmp = self._leading(command), self._dmp_of(command)
        scene = self._scene(sight, dmp)
        target = np.append(leading.R_WE[-1], sight.p_WG)
        world = self._world(sight, self._posture_at(target.tobytes(), leading.q[-1].tobytes()))
        waits = sight.policy.phase == 1.0
        coupling, route = sight.proposed()
        provisional = memory.is_provisional
        search = ArmSearch(
            scene,
            world,
            sight.q,
            leading,
            dmp=dmp,
            policy=self._policy,
            price=route.price,
            # Of a provisional motion only the elites are used.
            previous=NONE_IN_USE if provisional else memory.genes,
            parameters=replace(self._parameters, polish=0) if hasty else self._parameters,
            settled=command.tau > 0.0 and not provisional,
            earlier=Earlier(memory.elites, memory.rounds),
            most=math.inf if waits else self._parameters.frame,
            samples=_samples_of(command),
        )
        proposed = _guided_command(coupling, route, scene)
        in_use = None if provisional or not len(command.ellipsoids) else command
        found = search.run(
            _side_genes(coupling, route, scene),
            guided=_guided(proposed),
            in_use=_guided(in_use),
            source=max(command.source, NOMINAL),
        )
        source, genes = int(found.source[0]), found.genes[0]
        terms = avoidance_terms(scene, found.genes)
        sides = _shown_sides(route, terms[0], genes, sight.ellipsoids)
        if source == NOMINAL and command.demonstration.position is not None:
            source = JOINT_PATH
        if source == CHAIN:
            chosen = in_use if in_use is not None and search.stays else proposed
            assert chosen is not None
            command = replace(
                command, terms=chosen.terms, ellipsoids=chosen.ellipsoids, route=chosen.route
            )
            sides = chosen.route
        else:
            command = replace(
                command,
                terms=terms[terms[:, ALPHA] > 0.0],
                ellipsoids=EllipsoidSet(),
                route=Route(),
            )
        bends = bool(len(command.terms))
        here = here.changed(
            prediction={"sides": sides},
            memory={
                "genes": genes if bends and source != CHAIN else NONE_IN_USE,
                "is_provisional": hasty and bends,
                "counts": search.counts,
            },
        )
        here = replace(here, command=replace(command, source=source))
        if search.elites.size:
            here = here.changed(memory={"elites": search.elites, "rounds": search.rounds})
        return self._predicted(here, sight, search, genes, float(found.length[0]))

    def _rolled(self, selected: SelectedMotion, sight: Sight, world: ArmWorld) -> SelectedMotion:
        """Returns a motion with its prediction from now on."""
        dmp = self._dmp_of(selected.command)
        search = ArmSearch(
            self._scene(sight, dmp),
            world,
            sight.q,
            self._leading(selected.command),
            dmp=dmp,
            policy=self._policy,
            parameters=self._parameters,
            samples=_samples_of(selected.command),
        )
        genes = selected.memory.genes
        genes = nominal_genes()[0] if np.isnan(genes).any() else genes
        return self._predicted(selected, sight, search, genes, 0.0)

    def _predicted(
        self,
        here: SelectedMotion,
        sight: Sight,
        search: ArmSearch,
        genes: FloatArray,
        length: float,
    ) -> SelectedMotion:
        """Returns a motion with its prediction: the command is rolled out.

        Args:
            here: the motion.
            sight: input of the decision.
            search: scene, arm and solids.
            genes: (7,) of the motion; those of the nominal motion if it has none.
            length: of the tool's path from now on [m].
        """
        command, world = here.command, search.world
        tool, arm = search.rollout(genes, _guided(command))
        count = int(arm.samples[0])
        s = search.sample_times(count)
        seconds = float(search.seconds(genes[None])[0])
        # Every second: they are a few millimetres apart.
        t = world.now + seconds * (s - s[0])
        kept, near = kept_along(world, arm.q[0, :count:2], t[::2])
        of_self = float(arm.excess[0, SELF]) + world.asked.of_self
        if arm.excess[0].argmin() == SELF:
            near = -1
        follows = float(arm.error[0]) <= MISSED and float(arm.hurry[0]) <= 1.0
        follows &= float(tool.goal_error[0]) <= ASTRAY * search.scene.baseline
        total = here.memory.travelled + length
        tau = max(1.0, total / max(search.planned_length, 1e-9))
        lowered = self._clearance - float(world.asked.of_solids.max(initial=-np.inf))
        return here.changed(
            command={"tau": tau, "note": ""},
            prediction={
                "motion": PlannedMotion(
                    s,
                    tool.path[0, :count],
                    arm.q[0, :count],
                    here.key.p_WS,
                ),
                "min_distances": np.append(kept, of_self),
                "shortfall": max(-float(arm.least[0]) - self._parameters.slack, 0.0),
                "limiting_obstacle": sight.scene.labels[near] if near >= 0 else "the arm itself",
                "can_follow": follows,
                "lowered": max(lowered, 0.0) if len(sight.scene) else 0.0,
            },
        )

    def _scene(self, sight: Sight, dmp: Dmp) -> Scene:
        return scene_under_way(
            sight.policy,
            sight.p_WG,
            sight.ellipsoids,
            clearance=self._clearance,
            alpha_k=dmp.alpha_k,
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
        first = self._task.q[-1] if self._q_goal is None else self._q_goal
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

    def _planned(self, here: SelectedMotion, sight: Sight) -> tuple[SelectedMotion | None, bool]:
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
        self, ends: FloatArray, share: float, most: int, here: SelectedMotion, sight: Sight
    ) -> SelectedMotion | None:
        """A path to one of some postures, for a share of what is asked, as a motion."""
        if not len(ends):
            return None
        world = self._world(sight, ends, share)
        for seed in range(1, 1 + _PATHS):
            corners = plan_path(world, sight.q, ends, most=most, seed=seed)
            if not len(corners):
                return None
            choice = self._along(corners, here, sight, world)
            if choice is not None:
                return choice
        return None

    def _along(
        self, corners: FloatArray, here: SelectedMotion, sight: Sight, world: ArmWorld
    ) -> SelectedMotion | None:
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

    def _clears(self, predicted: MotionPrediction, sight: Sight) -> bool:
        """Returns whether a motion touches nothing, by its spheres, which stick out."""
        least = predicted.min_distances
        if least[SELF] <= min(_LEAST_KEPT, self._own(sight.q) - self._parameters.slack):
            return False
        return bool((least[:2] > self._touch_of_parts).all())

    def _of_moving(self, sight: Sight, q: FloatArray) -> FloatArray:
        """(G, K) distances of the groups that move to the solids; inf of the others [m]."""
        solids = sight.scene.solids
        d = group_distances(self._chain, self._spheres, solids, q[None], sight.time, math.inf)
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
        self, here: SelectedMotion, sight: Sight, world: ArmWorld, shown: Demonstration
    ) -> SelectedMotion:
        """Returns the motion that imitates a demonstration from where the arm rests."""
        policy = sight.policy
        rests = replace(policy, p_WS=policy.p_WE, z_W=np.zeros(3), phase=1.0)
        memory = replace(here.memory, travelled=0.0, genes=NONE_IN_USE, is_provisional=False)
        command = MotionCommand(JOINT_PATH, demonstration=shown)
        at = replace(here, command=command, memory=replace(memory, elites=np.zeros((0, N_GENES))))
        sight = replace(sight, policy=rests)
        chosen = self._rolled(at, sight, world)
        # Of the whole requested clearance, not of the share that the path was planned for.
        whole = self._world(sight, shown.q[-1:])
        q = chosen.prediction.motion.q
        short = max(lacking_along(whole, q) - self._parameters.slack, 0.0)
        if short > 0.0:
            _, near = kept_along(whole, q, np.full(len(q), whole.now))
            chosen = chosen.changed(prediction={"limiting_obstacle": sight.scene.labels[near]})
        # The motion belongs to the one that starts there.
        motion = replace(chosen.prediction.motion, p_WS=rests.p_WS)
        return chosen.changed(
            command={"tau": 1.0, "restart": True},
            prediction={"shortfall": short, "motion": motion},
        )


def _samples_of(command: MotionCommand) -> int:
    """Returns the number of samples of a motion."""
    return SAMPLES if command.demonstration.position is None else _LED


def _side_genes(coupling: CouplingParameters, route: Route, scene: Scene) -> FloatArray:
    """Returns the genes (S, 7) of the ranked sides."""
    rows = route.ranking
    if not len(rows):
        return np.zeros((0, N_GENES))
    return genes_of(scene, terms_of(coupling)[rows], coupling.scaling[rows])


def _guided_command(
    coupling: CouplingParameters, route: Route, scene: Scene
) -> MotionCommand | None:
    """Returns the rows of the paper's chain together as a command; None: they do not act."""
    chain, seen = coupling.of_kind(CHAIN_ROWS), scene.ellipsoids
    fits = len(chain) > 0 and np.array_equal(route.ids, seen.ids) and len(chain) == len(seen)
    # A forbidden side of an obstacle forbids the chain's motion, not every motion.
    if not fits or route.blocked or route.baseline == 0.0 or not (chain.alpha > 0.0).any():
        return None
    if not route.remaining_clearance.any():
        return None
    rows = replace(chain, center_W=seen.p_WO, normal_W=np.zeros((len(seen), 3)))
    return MotionCommand(CHAIN, terms_of(rows), seen, route, tau=1.0)


def _guided(command: MotionCommand | None) -> Obstacles | None:
    """Returns the guided candidate of a command by the chain; None: it is none."""
    if command is None or not len(command.ellipsoids):
        return None
    return Surroundings.of(command.ellipsoids, command.coupling(), command.route).obstacles


def _shown_sides(route: Route, term: FloatArray, genes: FloatArray, seen: EllipsoidSet) -> Route:
    """Returns the rings of the obstacle nearest to a term's point, with the term's side.

    It is blocked if user-supplied rings forbid every side.
    """
    blocked = bool(len(route.price)) and bool(np.isinf(route.price).all())
    route = replace(route, blocked=blocked, note=route.note if blocked else "")
    if not len(seen) or len(route.ids) != len(seen):
        return route
    row = [int(np.linalg.norm(seen.p_WO - term[:3], axis=1).argmin())]
    count = len(route.angles)
    side = int(np.rint(genes[ANGLE] * count / (2.0 * np.pi))) % count
    y, z = route.R_WL[:, 1], route.R_WL[:, 2]
    direction = math.cos(route.angles[side]) * y + math.sin(route.angles[side]) * z
    return replace(
        route,
        ids=seen.ids[row],
        index=np.array([side]),
        direction_W=direction[None],
        normal_W=term[None, NORMAL : NORMAL + 3],
        costs={name: cost[row] for name, cost in route.costs.items()},
        # The nominal motion passes on none.
        remaining_clearance=np.array([float(term[ALPHA] > 0.0)]),
    )


@dataclass(frozen=True, eq=False)
class MotionKey(Frozen):
    """Motion and scene for which a motion was selected.

    Attributes:
        p_WS, p_WG: (3,) start and goal [m]; NaN: none yet.
        scene: the solids.
    """

    p_WS: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    p_WG: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    scene: SolidScene = field(default_factory=SolidScene)

    def fits(self, policy: PolicyState, p_WG: FloatArray) -> bool:
        """Returns whether it is the motion under way."""
        return np.array_equal(self.p_WS, policy.p_WS) and np.array_equal(self.p_WG, p_WG)


@dataclass(frozen=True, eq=False)
class MotionCommand(Frozen):
    """Selected motion as the action level executes it.

    Attributes:
        source: row of `SOURCES`; -1: nothing was selected.
        terms: (K, 13) coupling terms, see `coupling.turn_step`; (0, 13): the nominal motion.
        ellipsoids: K obstacles that lead the headings of the terms; empty: none does.
        route: sides of these obstacles.
        tau: temporal scaling; 0: nothing was selected.
        demonstration: motion to imitate; empty: the task's.
        restart: whether the motion is to restart with this demonstration where the arm rests.
        note: "" or the reason for which the motion must not continue.
    """

    source: int = -1
    terms: FloatArray = zeros(0, N_COLUMNS)
    ellipsoids: EllipsoidSet = field(default_factory=EllipsoidSet)
    route: Route = field(default_factory=Route)
    tau: float = 0.0
    demonstration: Demonstration = field(default_factory=Demonstration)
    restart: bool = False
    note: str = ""

    def coupling(self) -> CouplingParameters:
        """Returns the command as DmpIntegrator reads it."""
        rows = rows_of(self.terms)
        return replace(
            rows,
            # The planes of guided terms are the route's.
            normal_W=np.zeros((0, 3)) if len(self.ellipsoids) else rows.normal_W,
            tau=self.tau,
            hold=HoldCause.OBSTACLES if self.note else HoldCause.NONE,
            note=self.note,
            anew=self.restart,
            verified=True,
            ellipsoids=self.ellipsoids,
        )


@dataclass(frozen=True, eq=False)
class MotionPrediction(Frozen):
    """Whole-arm motion that is expected from the selected motion.

    Attributes:
        motion: of the arm, from when it was computed.
        min_distances: (3,) of tool and links to the solids, and of the arm to itself [m].
        shortfall: of the requested clearance [m].
        limiting_obstacle: label of the solid with the largest shortfall.
        can_follow: whether the arm can follow the tool's motion to the goal.
        lowered: reduction of the requested clearance, as start or goal leave no more [m].
        goal_note: "" or the reason for which there is no feasible posture at the goal.
        touches: label of the solid that the arm touches; "": none.
        sides: sides of the obstacles with their costs, and the one of the motion; for a viewer.
    """

    motion: PlannedMotion = field(default_factory=PlannedMotion)
    min_distances: FloatArray = field(default_factory=lambda: np.full(3, np.inf))
    shortfall: float = 0.0
    limiting_obstacle: str = ""
    can_follow: bool = True
    lowered: float = 0.0
    goal_note: str = ""
    touches: str = ""
    sides: Route = field(default_factory=Route)


@dataclass(frozen=True, eq=False)
class SearchMemory(Frozen):
    """State of the search, from which the next one continues.

    Attributes:
        genes: (7,) of the motion in use; NaN: it has none.
        elites: (k, 7) genes of the best candidates.
        rounds: number of rounds so far.
        is_provisional: whether the motion is the first feasible one, and better ones are searched.
        last_plan: time of the last search for a path in the joints [s].
        travelled: length of the path that the motion has covered [m].
        p_WE: (3,) its end [m].
        counts: (5,) numbers of candidates that the last search rolled out, by source.
    """

    genes: FloatArray = field(default_factory=lambda: np.full(N_GENES, np.nan))
    elites: FloatArray = zeros(0, N_GENES)
    rounds: int = 0
    is_provisional: bool = False
    last_plan: float = -math.inf
    travelled: float = 0.0
    p_WE: FloatArray = field(default_factory=lambda: np.full(3, np.nan))
    counts: IntArray = zeros(len(SOURCES), kind=np.int64)

    def travelled_to(self, policy: PolicyState) -> float:
        """Returns the length of the path that the motion has covered by now [m]."""
        if not np.isfinite(self.p_WE).all():
            return math.dist(policy.p_WE, policy.p_WS)
        return self.travelled + math.dist(policy.p_WE, self.p_WE)


@dataclass(frozen=True, eq=False)
class SelectedMotion(Frozen):
    """Result of a decision of `MotionSearch`."""

    key: MotionKey = field(default_factory=MotionKey)
    command: MotionCommand = field(default_factory=MotionCommand)
    prediction: MotionPrediction = field(default_factory=MotionPrediction)
    memory: SearchMemory = field(default_factory=SearchMemory)

    def changed(self, **parts: Mapping[str, Any]) -> SelectedMotion:
        """Returns it with changed fields, given by the name of their part."""
        new = {name: replace(getattr(self, name), **fields) for name, fields in parts.items()}
        return replace(self, **new)
