"""Selection of the whole arm's motion, from one observation to the next.

Candidates, in this order: the nominal motion; the rows of the paper's chain together, with heading
guidance; the local search (`drake_oa.planning.search`), which each of these rows alone seeds; and
once the motion rests and none is feasible, a path in the joints (`drake_oa.planning.joint_planner`)
that the primitives imitate (`drake_oa.planning.imitation`) and that is rolled out like any other.
The shortest one that achieves the requested clearance is selected; one in use stays while it does.
Where none does, the one with the least shortfall is executed and the shortfall reported, but no
motion touches anything: an arm in contact may only leave it, and one whose goal is in contact
holds, and reports the nearest free goal.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.interpolate import BSpline

from drake_oa.common.messages import (
    DECIDING,
    CouplingParameters,
    EllipsoidSet,
    FloatArray,
    Frozen,
    HoldReason,
    IntArray,
    PlannedMotion,
    PolicyState,
    Route,
    zeros,
)
from drake_oa.geometry.collision_scene import ENVIRONMENT, CollisionScene
from drake_oa.inference.config import Verified
from drake_oa.planning.collision_model import (
    SELF,
    ArmCollisionModel,
    ClearanceRequirements,
    group_distances,
    self_distance,
)
from drake_oa.planning.imitation import LONGEST, demonstration
from drake_oa.planning.joint_planner import plan_path
from drake_oa.planning.search import ALPHA as LN_ALPHA
from drake_oa.planning.search import (
    ANGLE,
    CHAIN,
    JOINT_PATH,
    MAX_GOAL_ERROR,
    MAX_POSE_ERROR,
    NO_ELITES,
    NOMINAL,
    NOMINAL_PARAMS,
    SAMPLES,
    SOURCES,
    ArmSearch,
    avoidance_terms,
    params_of,
    references,
    rows_of,
)
from drake_oa.policy.action import CouplingInputs
from drake_oa.policy.config import Policy
from drake_oa.policy.coupling import ALPHA, NORMAL
from drake_oa.policy.dmp import Demonstration, Dmp, normalized_time, orientation_along
from drake_oa.policy.guidance import Obstacles
from drake_oa.policy.rollout import Scene, scene_under_way
from drake_oa.robot.arm import Chain, Spheres, inverse_kinematics, tool_poses

_LED = 201
"""Samples by which the arm is led along a motion."""
_SELF_CLEARANCE, _LEAST_KEPT = 0.005, 1e-3
"""Requested distance of the arm to itself, and least distance to anything [m]."""
_SEEK_PERIOD = 0.5
"""Time between searches for a path in the joints while no motion will do [s]."""
_LEFT, _NEAR_TOOL = 0.015, 2e-3
"""Distance of a joint from the motion in use above which the arm has left it [rad], and distance of
the desired position from the tool below which it has been displaced there [m]."""
_CLEARANCE_FRACTIONS, _GOAL_SEEDS = (1.0, 0.5, 0.2), 128
"""Shares of the requested clearances that are tried in turn, and random seeds of goal postures."""


@dataclass(frozen=True, eq=False)
class PlanningInputs(Frozen):
    """Input of a decision.

    Attributes:
        policy: the motion under way.
        p_WG: (3,) its goal [m].
        q: (n,) the arm's joints [rad].
        scene: the solids, all of which rest.
        ellipsoids: descriptors of the obstacles.
        coupling: parameters of the regressor chain, of the obstacles.
        route: sides of the obstacles.
    """

    policy: PolicyState
    p_WG: FloatArray
    q: FloatArray
    scene: CollisionScene
    ellipsoids: EllipsoidSet
    coupling: CouplingParameters
    route: Route


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
        protrusion: FloatArray,
        q_goal: FloatArray | None = None,
    ) -> None:
        """Stores the constants.

        Args:
            dmp: the movement primitive that the task demonstrates.
            clearance: asked distance Delta of the tool to every solid [m].
            chain, spheres: the arm.
            parameters: how far the search goes.
            policy: time step and fade of the action level.
            orientation: (T, 3, 3) of the tool at normalized times (T,).
            posture: (T, n) that the null space is drawn to at normalized times (T,) [rad].
            protrusion: (G,) how far the spheres of each group stick out of the robot [m].
            q_goal: (n,) joints at the goal, where the task gives them [rad].
        """
        self._dmp, self._clearance = dmp, clearance
        self._chain, self._spheres, self._parameters = chain, spheres, parameters
        self._policy = policy
        s = np.linspace(0.0, 1.0, _LED)
        self._task = references(s, orientation(s), posture(s))
        self._q_goal, self._is_tool = q_goal, spheres.of_tool[spheres.first[:-1]]
        # Spheres nearer than that may touch something.
        self._touch = _LEAST_KEPT - protrusion

    def decide(self, before: SelectedMotion, inputs: PlanningInputs) -> SelectedMotion:
        """Checks the motion under way, and selects another one if there is reason to.

        ======== ========= ======= =========================================================
        same     tau > 0   at rest result
        scene    no note
        ======== ========= ======= =========================================================
        yes      yes       any     unchanged
        yes      no        any     hold, if the goal has no feasible posture
        any      any       no      search; without result: hold, if the least shortfall is a
                                   contact
        any      any       yes     the same, with a path in the joints after the search
        ======== ========= ======= =========================================================

        Where the arm rests away from the motion, after a maneuver of `MotionGuard`, a path in the
        joints from there comes first. Paths are planned every `_SEEK_PERIOD` at most.

        A motion with another start or goal starts from an empty memory, unless it is the restart
        that was commanded.

        Args:
            before: result of the decision before.
            inputs: input.
        """
        policy = inputs.policy
        if inputs.scene.stamp == -math.inf or np.array_equal(inputs.p_WG, policy.p_WS):
            return SelectedMotion()
        if before.command.restart and np.array_equal(before.p_WG, inputs.p_WG):
            if not before.fits(policy, inputs.p_WG):
                # It has restarted as commanded, where it came to rest.
                motion = replace(before.prediction.motion, p_WS=policy.p_WS)
                before = replace(before, traveled=0.0).changed(
                    command={"restart": False}, prediction={"motion": motion}
                )
        elif not before.fits(policy, inputs.p_WG):
            before = SelectedMotion(last_plan=before.last_plan, p_WE=policy.p_WS)
        here = replace(
            before,
            p_WS=policy.p_WS,
            p_WG=np.array(inputs.p_WG, dtype=float),
            p_WE=policy.p_WE,
            traveled=before.traveled + math.dist(policy.p_WE, before.p_WE),
        ).changed(command={"restart": before.command.restart and policy.speed == 0.0})
        same = here.scene.same_as(inputs.scene)
        rests = policy.speed == 0.0 or policy.phase == 1.0
        plans = rests and inputs.policy.stamp - here.last_plan >= _SEEK_PERIOD
        is_left = plans and self._is_left(here, inputs)
        is_settled = here.command.tau > 0.0 and not here.command.note and not is_left
        if same and (is_settled or here.prediction.goal_note):
            return here
        touches = self._touched(inputs)
        here = replace(here, scene=inputs.scene).changed(
            prediction={"touches": touches, "goal_note": ""}
        )
        if not is_left:
            here = self._avoiding_motion(here, inputs)
            if here.prediction.can_follow and here.prediction.shortfall == 0.0:
                return here.changed(command={"note": ""})
            sides = here.prediction.sides
            if sides.blocked:
                return here.changed(command={"note": sides.note})
        if plans:
            here = replace(here, last_plan=inputs.policy.stamp)
            planned = self._planned(here, inputs)
            if planned is not None:
                return planned
            here = self._avoiding_motion(here, inputs) if is_left else here
            if note := self._no_goal(inputs):
                return here.changed(command={"note": note}, prediction={"goal_note": note})
        return here

    def _is_left(self, here: SelectedMotion, inputs: PlanningInputs) -> bool:
        """Returns whether the arm rests away from the motion in use, with its tool where this is.

        After a maneuver of `MotionGuard` the desired position goes to the tool.
        """
        motion, policy = here.prediction.motion, inputs.policy
        if policy.speed > 0.0 or not len(motion.q):
            return False
        s = normalized_time(policy.phase, self._dmp.alpha_k)
        p_WE = tool_poses(self._chain, inputs.q[None])[0, 9:]
        is_near = math.dist(p_WE, policy.p_WE) < _NEAR_TOOL
        return is_near and bool(np.abs(motion.joints(s) - inputs.q).max() > _LEFT)

    def still_holds(self, made: SelectedMotion, inputs: PlanningInputs) -> bool:
        """Returns whether a motion still achieves its predicted clearance from now on.

        Since then the one in use has continued: straight toward an obstacle, small differences
        decide its side.
        """
        motion, params = made.prediction.motion, made.params if len(made.params) else NOMINAL_PARAMS
        if inputs.policy.phase == 1.0 or not motion.s.size:
            return True
        search = self._search(made, inputs, self._world(inputs, motion.q[-1:]))
        found = self._predicted(made, inputs, search, params, 0.0).prediction
        allowed = made.prediction.shortfall + self._parameters.slack
        return found.can_follow and found.shortfall <= allowed

    def _world(
        self, inputs: PlanningInputs, ends: FloatArray, share: float = 1.0
    ) -> ArmCollisionModel:
        """Returns the arm among the solids, with the required clearances.

        Of the pair of the spheres of group g and solid k, with the configurations now and at the
        ends (m, n):

            required_gk = min(share * requested_g, min(d_now_gk, max(d_end_gk, touch_g + slack))
                              - slack)
        """
        geometries, p, is_tool = inputs.scene.geometries, self._parameters, self._is_tool
        requested = np.where(is_tool, self._clearance, min(p.link_clearance, self._clearance))
        table = np.tile(share * requested[:, None], (1, len(geometries.ball)))
        around = geometries.layout[:, 5] == ENVIRONMENT
        table[:, around] = np.minimum(table[:, around], share * p.link_clearance)
        left = self._distances(inputs, inputs.q[None])
        if len(ends):
            at_end = [self._distances(inputs, q[None]) for q in ends]
            left = np.minimum(
                left, np.maximum(np.max(at_end, axis=0), self._touch[:, None] + p.slack)
            )
        table = np.minimum(table, left - p.slack)
        table[self._spheres.group_joint < 0] = -np.inf
        of_self = min(_SELF_CLEARANCE, self._own(inputs.q) - p.slack)
        if len(ends):
            own = max(self._own(q) for q in ends)
            of_self = min(of_self, max(own, _LEAST_KEPT) - p.slack)
        required = ClearanceRequirements(table, of_self, is_tool)
        return ArmCollisionModel(self._chain, self._spheres, geometries, required, 0.0)

    def _null_space_reference(self, command: MotionCommand) -> BSpline:
        """Returns the references of the arm along the motion that is under way."""
        shown, s = command.demonstration, np.linspace(0.0, 1.0, _LED)
        if shown.orientation is None:
            return self._task
        R_WE = orientation_along(shown.orientation, shown.R_WS, shown.R_WG, s)
        return references(s, R_WE, shown.posture(s))

    def _search(
        self, here: SelectedMotion, inputs: PlanningInputs, world: ArmCollisionModel, **more: Any
    ) -> ArmSearch:
        """Returns the search for a motion with the demonstration of another one."""
        shown = here.command.demonstration
        dmp = shown.position or self._dmp
        scene = scene_under_way(
            inputs.policy,
            inputs.p_WG,
            inputs.ellipsoids,
            clearance=self._clearance,
            alpha_k=dmp.alpha_k,
        )
        return ArmSearch(
            scene,
            world,
            inputs.q,
            self._null_space_reference(here.command),
            samples=SAMPLES if shown.position is None else _LED,
            dmp=dmp,
            policy=self._policy,
            parameters=self._parameters,
            **more,
        )

    def _avoiding_motion(self, here: SelectedMotion, inputs: PlanningInputs) -> SelectedMotion:
        """Returns the best motion by coupling terms."""
        command, end = here.command, self._null_space_reference(here.command)(1.0)
        target = np.append(end[:9], inputs.p_WG)
        at_goal = inverse_kinematics(self._chain, target, end[9:], seeds=4)
        world = self._world(inputs, at_goal[:1])
        route = inputs.route
        search = self._search(
            here,
            inputs,
            world,
            side_cost=route.side_cost,
            previous=here.params,
            elites=here.elites,
            generations=here.generations,
            most=math.inf if inputs.policy.phase == 1.0 else self._parameters.compute_budget,
        )
        scene = search.scene
        chain = _guided_command(inputs.coupling, route, scene)
        found = search.run(
            guided=chain.guides,
            seeds=_seeds(scene, chain),
            source=max(command.source, NOMINAL),
        )
        source = int(found.source[0])
        if source == CHAIN:
            chosen, params, shown = chain, NO_ELITES, chain.route
        else:
            terms = avoidance_terms(scene, found.params)
            shown = _shown_sides(route, terms, found.params[0, ANGLE])
            acts = terms[:, ALPHA] > 0.0
            if source == NOMINAL and command.demonstration.position is not None:
                source = JOINT_PATH
            chosen, params = MotionCommand(source, rows_of(terms[acts])), found.params[acts]
        chosen = replace(chosen, demonstration=command.demonstration, restart=command.restart)
        here = replace(
            here,
            command=chosen,
            params=params,
            counts=search.counts,
            elites=search.elites,
            generations=search.generations,
        ).changed(prediction={"sides": shown})
        return self._predicted(here, inputs, search, found.params, float(found.length[0]))

    def _predicted(
        self,
        here: SelectedMotion,
        inputs: PlanningInputs,
        search: ArmSearch,
        params: FloatArray,
        length: float,
    ) -> SelectedMotion:
        """Returns a motion with its prediction: the command is rolled out.

        Args:
            here: the motion.
            inputs: input of the decision.
            search: scene, arm and solids.
            params: (1, 6) of the motion.
            length: of the tool's path from now on [m].
        """
        required = search.world.required
        tool = search.tool_paths(params, guided=here.command.guides)
        arm = search.follow(params, tool, -math.inf)
        count = int(arm.samples[0])
        s, q = search.sample_times(count), arm.q[0, :count]
        # Every second: they are a few millimeters apart.
        d = self._distances(inputs, q[::2])
        is_self = arm.clearance_margin[0].argmin() == SELF
        limiting = "the arm itself" if is_self else self._nearest(inputs, d)
        follows = (
            float(arm.error[0]) <= MAX_POSE_ERROR and float(arm.max_joint_speed_ratio[0]) <= 1.0
        )
        away = float(tool.goal_error[0])
        arrives = away <= MAX_GOAL_ERROR * search.scene.baseline
        own = float(arm.clearance_margin[0, SELF]) + required.of_self
        note = ""
        if not follows:
            note = "no motion that the arm can follow found"
        elif not arrives:
            near = f", {1e3 * d.min():.0f} mm from {self._nearest(inputs, d)}" if d.size else ""
            goal = np.round(inputs.p_WG, 3).tolist()
            note = f"no motion to the goal {goal} m found: one ends {1e3 * away:.0f} mm away{near}"
        elif self._touches(d):
            note = f"no motion that clears {limiting} found"
        elif own <= min(_LEAST_KEPT, self._own(inputs.q) - self._parameters.slack):
            note = "no motion that clears the arm itself found"
        clearance_reduction = self._clearance - float(required.of_geometries.max(initial=-np.inf))
        return here.changed(
            command={
                "tau": max(1.0, (here.traveled + length) / max(search.planned_length, 1e-9)),
                "note": note,
            },
            prediction={
                "motion": PlannedMotion(s, tool.path[0, :count], q, here.p_WS),
                "shortfall": max(-float(arm.least[0]) - self._parameters.slack, 0.0),
                "limiting_obstacle": limiting,
                "can_follow": follows and arrives,
                "clearance_reduction": max(clearance_reduction, 0.0) if len(inputs.scene) else 0.0,
            },
        )

    # --- a path in the joints -------------------------------------------------------------

    def _goal_configurations(self, inputs: PlanningInputs, seeds: int) -> FloatArray:
        """(m, n) postures at the goal that touch nothing, the task's own first [rad]."""
        X_WG, first = self._goal(inputs)
        found = inverse_kinematics(self._chain, X_WG, first, seeds=seeds)
        free = [q for q in found if not self._touches(self._distances(inputs, q[None]))]
        return np.array(free).reshape(-1, len(first))

    def _goal(self, inputs: PlanningInputs) -> tuple[FloatArray, FloatArray]:
        """(12,) pose of the tool at the goal [m], and (n,) the joints that are asked for [rad]."""
        end = self._task(1.0)
        first = end[9:] if self._q_goal is None else self._q_goal
        return np.append(end[:9], inputs.p_WG), first

    def _no_goal(self, inputs: PlanningInputs) -> str:
        """Returns a note that names the obstacle at the goal.

        "": the arm has a free posture there, or cannot be there at all.
        """
        at_goal = inverse_kinematics(self._chain, *self._goal(inputs), seeds=_GOAL_SEEDS)
        d = [self._distances(inputs, q[None]) for q in at_goal]
        if not all(map(self._touches, d)) or not d:
            return ""
        return f"at its goal the arm would touch {self._nearest(inputs, d[0])}"

    def _planned(self, here: SelectedMotion, inputs: PlanningInputs) -> SelectedMotion | None:
        """Plans a path in the joints, for the whole requested clearance or a share of it."""
        p = self._parameters
        # To the task's own posture first: the tool turns no farther than it has to.
        goals = [self._goal_configurations(inputs, 0)]
        for share, most in (
            *((share, p.configurations) for share in _CLEARANCE_FRACTIONS),
            (min(_CLEARANCE_FRACTIONS), p.last_configurations),
        ):
            for number in range(2):
                if number == len(goals):
                    # Of many seeds, which takes a while: only if no path to the own one is found.
                    goals.append(self._goal_configurations(inputs, _GOAL_SEEDS)[len(goals[0]) :])
                ends = goals[number]
                world = self._world(inputs, ends, share)
                corners = plan_path(world, inputs.q, ends, most=most)
                choice = self._along(corners, here, inputs, world) if len(corners) else None
                if choice is not None:
                    return choice
        return None

    def _along(
        self,
        corners: FloatArray,
        here: SelectedMotion,
        inputs: PlanningInputs,
        world: ArmCollisionModel,
    ) -> SelectedMotion | None:
        """Returns the motion that imitates a path in the joints; None: it cannot be executed."""
        duration, alpha_k = self._dmp.duration, self._dmp.alpha_k
        pace = duration / max(math.dist(inputs.p_WG, inputs.policy.p_WE), 1e-3)
        try:
            shown = demonstration(
                world, corners, pace=pace, longest=LONGEST * duration, alpha_k=alpha_k
            )
        except ValueError:
            # The tool turns too far for one primitive.
            return None
        policy = inputs.policy
        rests = replace(policy, p_WS=policy.p_WE, z_W=np.zeros(3), phase=1.0)
        inputs = replace(inputs, policy=rests)
        start = replace(
            here,
            command=MotionCommand(JOINT_PATH, demonstration=shown),
            traveled=0.0,
            params=NO_ELITES,
            elites=NO_ELITES,
        )
        search = self._search(start, inputs, world)
        found = self._predicted(start, inputs, search, NOMINAL_PARAMS, 0.0)
        # Of the whole requested clearance, not of the share that the path was planned for.
        motion = found.prediction.motion
        d = self._distances(inputs, motion.q)
        lacking = self._world(inputs, shown.q[-1:]).required.of_geometries - d
        short = max(float(lacking.max(initial=-np.inf)) - self._parameters.slack, 0.0)
        limiting = self._nearest(inputs, d) if short > 0.0 else found.prediction.limiting_obstacle
        if found.command.note:
            return None
        # The motion belongs to the one that starts there.
        return found.changed(
            command={"tau": 1.0, "restart": True},
            prediction={
                "shortfall": short,
                "limiting_obstacle": limiting,
                "motion": replace(motion, p_WS=rests.p_WS),
            },
        )

    def _distances(self, inputs: PlanningInputs, q: FloatArray) -> FloatArray:
        """Returns least distances (G, K) of the moving groups to the solids along q (T, n) [m].

        Those of fixed groups are inf.
        """
        d = group_distances(
            self._chain,
            self._spheres,
            inputs.scene.geometries,
            np.ascontiguousarray(q),
            0.0,
            math.inf,
        )
        d[self._spheres.group_joint < 0] = np.inf
        return np.asarray(d)

    def _touches(self, d: FloatArray) -> bool:
        """Returns whether the arm may touch a solid at distances (G, K) of its groups [m]."""
        return bool((d <= self._touch[:, None]).any())

    def _nearest(self, inputs: PlanningInputs, d: FloatArray) -> str:
        """Returns the label of the solid with the least of distances (G, K); "": there is none."""
        return inputs.scene.labels[int(d.min(axis=0).argmin())] if d.size else ""

    def _touched(self, inputs: PlanningInputs) -> str:
        """Returns the label of the solid that the arm is certain to touch; "": none."""
        d = self._distances(inputs, inputs.q[None]) - self._touch[:, None]
        return self._nearest(inputs, d) if (d < -_LEAST_KEPT).any() else ""

    def _own(self, q: FloatArray) -> float:
        """Returns the distance of the arm to itself at a configuration, at most `FAR` [m]."""
        return float(self_distance(self._chain, self._spheres, q))


def _guided_command(coupling: CouplingParameters, route: Route, scene: Scene) -> MotionCommand:
    """Returns the rows of the paper's chain together as a command; without rows: none act."""
    seen = scene.ellipsoids
    fits = len(coupling) == len(seen) and np.array_equal(route.ids, seen.ids)
    acts = (coupling.alpha > 0.0).any() and route.remaining_clearance.any()
    # A forbidden side of an obstacle forbids the chain's motion, not every motion.
    if not (fits and acts) or route.blocked:
        return MotionCommand()
    rows = replace(coupling, center_W=seen.p_WO, normal_W=np.zeros((0, 3)), ellipsoids=seen)
    return MotionCommand(CHAIN, rows, route, tau=1.0)


_WEAKER = np.array([-3.0, -2.0, -1.0, 0.0])
"""Differences in ln alpha between seeds of the search and a row of the chain."""


def _seeds(scene: Scene, chain: MotionCommand) -> FloatArray:
    """Returns seeds (n, 6) of the search: each row of the chain alone, on the route's side."""
    acts = chain.rows.alpha > 0.0
    normal_W, center_W = chain.route.normal_W[acts], chain.rows.center_W[acts]
    params = params_of(scene, center_W, normal_W, chain.rows.as_array()[acts])
    seeds = np.repeat(params, len(_WEAKER), axis=0)
    seeds[:, LN_ALPHA] += np.tile(_WEAKER, len(params))
    return seeds


def _shown_sides(route: Route, terms: FloatArray, angle: float) -> Route:
    """Returns the rings of the obstacles, each with the side of a term (1, 13).

    It is blocked if user-supplied rings forbid every side.
    """
    blocked = bool(np.isinf(route.side_cost).all())
    count, normal_W = len(route.angles), terms[:, NORMAL : NORMAL + 3]
    rows = np.zeros(len(route.ids), dtype=np.int64)
    return replace(
        route,
        blocked=blocked,
        note=route.note if blocked else "",
        index=rows + round(angle * count / (2.0 * np.pi)) % max(count, 1),
        direction_W=np.cross(normal_W, route.R_WL[:, 0])[rows],
        normal_W=normal_W[rows],
        # The nominal motion passes on none.
        remaining_clearance=route.remaining_clearance * (terms[0, ALPHA] > 0.0),
    )


@dataclass(frozen=True, eq=False)
class MotionCommand(Frozen):
    """Selected motion as the action level executes it.

    Attributes:
        source: row of `SOURCES`; -1: nothing was selected.
        rows: coupling parameters of its terms, about their centers; empty: the nominal motion.
        route: sides of the obstacles that lead the headings of the terms.
        tau: temporal scaling; 0: nothing was selected.
        demonstration: motion to imitate; empty: the task's.
        restart: whether the motion is to restart with this demonstration where the arm rests.
        note: "" or the reason for which the motion must not continue.
    """

    source: int = -1
    rows: CouplingParameters = field(default_factory=CouplingParameters)
    route: Route = field(default_factory=Route)
    tau: float = 0.0
    demonstration: Demonstration = field(default_factory=Demonstration)
    restart: bool = False
    note: str = ""

    @property
    def coupling(self) -> CouplingParameters:
        """Command as DmpIntegrator reads it."""
        hold, note = HoldReason.NONE, self.note
        if self.tau == 0.0:
            hold, note = HoldReason.DECIDING, DECIDING
        elif note:
            hold = HoldReason.OBSTACLES
        return replace(
            self.rows, tau=self.tau, hold=hold, note=note, restart=self.restart, verified=True
        )

    @property
    def guides(self) -> Obstacles | None:
        """Obstacles that lead the headings of the terms; None: none does."""
        seen = self.rows.ellipsoids
        return CouplingInputs.of(seen, self.coupling, self.route).obstacles if len(seen) else None


@dataclass(frozen=True, eq=False)
class MotionPrediction(Frozen):
    """Whole-arm motion that is expected from the selected motion.

    Attributes:
        motion: of the arm, from when it was computed.
        shortfall: of the requested clearance [m].
        limiting_obstacle: label of the solid with the largest shortfall.
        can_follow: whether the arm can follow the tool's motion to the goal.
        clearance_reduction: reduction of the requested clearance, as start or goal leave no more [m].
        goal_note: "" or the reason for which there is no feasible posture at the goal.
        touches: label of the solid that the arm touches; "": none.
        sides: sides of the obstacles with their costs, and the one of the motion; for a viewer.
    """

    motion: PlannedMotion = field(default_factory=PlannedMotion)
    shortfall: float = 0.0
    limiting_obstacle: str = ""
    can_follow: bool = True
    clearance_reduction: float = 0.0
    goal_note: str = ""
    touches: str = ""
    sides: Route = field(default_factory=Route)


@dataclass(frozen=True, eq=False)
class SelectedMotion(Frozen):
    """Result of a decision of `MotionSearch`, and the memory of its search.

    Attributes:
        command: motion that the action level executes.
        prediction: whole-arm motion that is expected from it.
        p_WS, p_WG: (3,) start and goal for which it was selected [m]; (0,): none yet.
        scene: the solids for which it was selected.
        params: (1, 6) of the motion in use; (0, 6): it has none.
        elites: (k, 6) genes of the best candidates.
        generations: number of rounds of the search so far.
        last_plan: time of the last search for a path in the joints [s].
        traveled: length of the path that the motion has covered [m].
        p_WE: (3,) its end [m].
        counts: (5,) numbers of candidates that the last search rolled out, by source.
    """

    command: MotionCommand = field(default_factory=MotionCommand)
    prediction: MotionPrediction = field(default_factory=MotionPrediction)
    p_WS: FloatArray = zeros(0)
    p_WG: FloatArray = zeros(0)
    scene: CollisionScene = field(default_factory=CollisionScene)
    params: FloatArray = field(default_factory=lambda: NO_ELITES)
    elites: FloatArray = field(default_factory=lambda: NO_ELITES)
    generations: int = 0
    last_plan: float = -math.inf
    traveled: float = 0.0
    p_WE: FloatArray = zeros(0)
    counts: IntArray = zeros(len(SOURCES), kind=np.int64)

    def fits(self, policy: PolicyState, p_WG: FloatArray) -> bool:
        """Returns whether it is the motion under way."""
        return np.array_equal(self.p_WS, policy.p_WS) and np.array_equal(self.p_WG, p_WG)

    def changed(self, **parts: dict[str, Any]) -> SelectedMotion:
        """Returns it with changed fields of its command or prediction."""
        new = {name: replace(getattr(self, name), **fields) for name, fields in parts.items()}
        return replace(self, **new)
