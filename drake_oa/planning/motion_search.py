"""Selection of the whole-arm motion from candidates, re-evaluated at every observation.

Coupling terms are turning rates that steer the motion away from obstacles. The candidates are, in
this order:

1. the nominal (demonstrated) motion, without coupling terms;
2. the coupling terms of the regressor chain of Pairet et al., RA-L 2019, for all obstacles
   together; heading guidance also turns this motion to the sides that the cost rings selected;
3. motions with one coupling term from the evolution strategy of `drake_oa.planning.search`, which
   starts from each of these terms alone, and from a moderate term in each of 16 directions around
   the line from start to goal;
4. if the arm is at rest and no other candidate is feasible, a joint-space path
   (`drake_oa.planning.joint_planner`). The movement primitives imitate this path
   (`drake_oa.planning.imitation`), and it is rolled out like every other candidate.

The nominal motion is selected if it achieves the requested clearance, otherwise the shortest
candidate that does; this candidate remains selected while it achieves the clearance and the nominal
motion does not. If no candidate achieves it, the one with the least clearance shortfall is executed
and the shortfall is reported. A motion is held (stopped on its path) if it is predicted to be in
contact or to miss the goal, or if the arm cannot follow it. An arm in contact may only retreat from
the obstacle.
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
from drake_oa.planning.imitation import MAX_DURATION_RATIO, demonstration
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

_REFERENCE_SAMPLES = 201
"""Number of samples of the desired tool orientation and nominal posture along a motion."""
_SELF_CLEARANCE = 0.005
"""Requested clearance between bodies of the arm that can collide with each other [m]."""
_MIN_ACCEPTABLE_DISTANCE = 1e-3
"""Distance of the arm to obstacles or itself, at or below which a motion counts as contact [m]."""
_REPLAN_PERIOD = 0.5
"""Minimum time between two joint-space plans while no candidate motion is feasible [s]."""
_MAX_DEVIATION = 0.015
"""Joint angle by which a resting arm must differ from the selected motion to count as off it [rad].

The angle is that of the joint with the largest difference. The motion is evaluated at the current
phase of the movement primitive."""
_TOOL_TOLERANCE = 2e-3
"""Maximum distance of the tool from its desired position at which `_MAX_DEVIATION` is checked [m].

The desired position is that of the movement primitive. At larger distances, a resting arm does not
count as off the selected motion, however large the differences of its joints are."""
_CLEARANCE_FRACTIONS = (1.0, 0.5, 0.2)
"""Fractions of the requested clearance for which a joint-space path is planned [-].

They are tried in this order until a path is found that the arm can execute."""
_GOAL_SEEDS = 128
"""Number of random initial configurations of the inverse kinematics at the goal."""
_SAME_ANGLE = 1e-6
"""Maximum difference of each joint at which two results of the inverse kinematics at the goal count
as the same configuration [rad]."""


@dataclass(frozen=True, eq=False)
class PlanningInputs(Frozen):
    """Inputs of one decision of `MotionSearch`, which selects the motion of the arm.

    Attributes:
        policy: state of the movement primitive that generates the motion of the tool.
        p_WG: (3,) goal of the tool point in the world frame [m].
        q: (n,) current configuration of the arm [rad].
        scene: collision geometry of the obstacles at rest and of the environment.
        ellipsoids: ellipsoids of the obstacles, dilated by the tool, so that the tool is a point.
        coupling: parameters of one coupling term (turning rate) per obstacle, which the regressor
            chain predicts from its ellipsoid and the requested clearance.
        route: side on which each obstacle shall be passed, selected by cost rings (costs of all
            directions around it), and these costs.
    """

    policy: PolicyState
    p_WG: FloatArray
    q: FloatArray
    scene: CollisionScene
    ellipsoids: EllipsoidSet
    coupling: CouplingParameters
    route: Route


class MotionSearch:
    """Planner that selects the motion of an arm among candidates with coupling terms.

    Coupling terms are turning rates that steer the movement primitive away from obstacles. The
    candidates are the nominal (demonstrated) motion, the coupling terms of the regressor chain
    together, motions of an evolution strategy, and the imitation of a joint-space path.

    A motion must achieve a required clearance between each body of the robot and each collision
    geometry. It is the requested clearance, or less if the body is nearer to this geometry at the
    current configuration q_now or at the goal configuration q_goal. For body g and geometry k,

        required_gk = min( fraction * requested_g,
                           min( d_gk(q_now), max( d_gk(q_goal), touch_g + slack ) ) - slack )

    requested_g is the requested clearance of the body (tool or link); from geometry of the
    environment it is at most that of the links. fraction is 1 or, for joint-space plans, less.
    d_gk(q) is the distance of the body's covering spheres from the geometry at configuration q,
    touch_g the distance at or below which the body counts as in contact, and slack a tolerance. The
    current and the goal configuration thus reduce the requirement of single pairs (g, k) only.
    """

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
        """Stores arm, movement primitive and parameters, which are constant for all decisions.

        Normalized time is time over tau T, from 0 to 1, with the demonstrated duration T and the
        temporal scaling tau.

        Args:
            dmp: movement primitive of the task's demonstration.
            clearance: requested clearance Delta of the tool from every obstacle [m].
            chain: kinematic chain of the arm.
            spheres: spheres that cover the arm, in G groups (one group per body).
            parameters: numbers of candidates, tolerances and limits of the search.
            policy: configuration of the movement primitive, of which the time step and the distance
                from the goal at which coupling terms fade are used.
            orientation: function from normalized times (T,) to desired tool orientations R_WE
                (T, 3, 3).
            posture: function from normalized times (T,) to nominal postures (T, n) of the null
                space [rad].
            protrusion: (G,) maximum distance by which the spheres of each group extend beyond the
                exact shapes of their body [m].
            q_goal: (n,) preferred configuration at the goal [rad]; None: the nominal posture at
                the end of the motion.
        """
        self._dmp, self._clearance = dmp, clearance
        self._chain, self._spheres, self._parameters = chain, spheres, parameters
        self._policy = policy
        s = np.linspace(0.0, 1.0, _REFERENCE_SAMPLES)
        self._task_references = references(s, orientation(s), posture(s))
        self._q_goal, self._is_tool = q_goal, spheres.of_tool[spheres.first[:-1]]
        # Spheres protrude from their body: a body is in contact only below this distance.
        self._contact_distance = _MIN_ACCEPTABLE_DISTANCE - protrusion

    def decide(self, previous: SelectedMotion, inputs: PlanningInputs) -> SelectedMotion:
        """Re-evaluates the current motion of the arm, and selects another motion if necessary.

        The first row that applies determines the result:

        ========= ========== ======= ===========================================================
        scene     motion     at rest result
        unchanged executable
        ========= ========== ======= ===========================================================
        yes       yes        any     keep the motion
        yes       no         any     remain held, if no goal configuration is collision-free
        any       any        no      search for a motion; hold if the arm cannot execute it
        any       any        yes     search for a motion; if none is feasible, plan in joint space
        ========= ========== ======= ===========================================================

        A held motion is stopped on its path. A motion is executable if it is selected and not held,
        and if the arm is still on it. An evasive maneuver of `MotionGuard` can move the arm off its
        motion; once the arm rests, a joint-space path is then planned first, and the search follows
        only if no path is found. The time between two plans is at least 0.5 s (`_REPLAN_PERIOD`).

        The search usually starts from the best candidates of the previous search. It starts without
        them for a new motion: the goal has moved, or the movement primitive has restarted from
        another position without a command of the previous decision.

        Args:
            previous: result of the previous decision.
            inputs: inputs of this decision.

        Returns:
            The selected motion; an empty `SelectedMotion` before the first observation, or if start
            and goal coincide.
        """
        policy = inputs.policy
        if inputs.scene.stamp == -math.inf or np.array_equal(inputs.p_WG, policy.p_WS):
            return SelectedMotion()
        if previous.command.restart and np.array_equal(previous.p_WG, inputs.p_WG):
            if not previous.matches(policy, inputs.p_WG):
                # The policy has restarted as commanded; the start is where the arm came to rest.
                motion = replace(previous.prediction.motion, p_WS=policy.p_WS)
                previous = replace(previous, traveled=0.0).with_changes(
                    command={"restart": False}, prediction={"motion": motion}
                )
        elif not previous.matches(policy, inputs.p_WG):
            previous = SelectedMotion(last_plan=previous.last_plan, p_WE=policy.p_WS)
        current = replace(
            previous,
            p_WS=policy.p_WS,
            p_WG=np.array(inputs.p_WG, dtype=float),
            p_WE=policy.p_WE,
            traveled=previous.traveled + math.dist(policy.p_WE, previous.p_WE),
        ).with_changes(command={"restart": previous.command.restart and policy.speed == 0.0})
        is_scene_unchanged = current.scene.same_as(inputs.scene)
        is_at_rest = policy.speed == 0.0 or policy.phase == 1.0
        is_plan_due = is_at_rest and inputs.policy.stamp - current.last_plan >= _REPLAN_PERIOD
        has_left = is_plan_due and self._has_left_motion(current, inputs)
        is_settled = current.command.tau > 0.0 and not current.command.note and not has_left
        if is_scene_unchanged and (is_settled or current.prediction.goal_note):
            return current
        contact = self._contact_label(inputs)
        current = replace(current, scene=inputs.scene).with_changes(
            prediction={"contact": contact, "goal_note": ""}
        )
        if not has_left:
            current = self._search_motion(current, inputs)
            if current.prediction.can_follow and current.prediction.shortfall == 0.0:
                return current.with_changes(command={"note": ""})
            sides = current.prediction.sides
            if sides.blocked:
                return current.with_changes(command={"note": sides.note})
        if is_plan_due:
            current = replace(current, last_plan=inputs.policy.stamp)
            candidate = self._plan_motion(current, inputs)
            if candidate is not None:
                return candidate
            current = self._search_motion(current, inputs) if has_left else current
            if note := self._goal_note(inputs):
                return current.with_changes(command={"note": note}, prediction={"goal_note": note})
        return current

    def _has_left_motion(self, current: SelectedMotion, inputs: PlanningInputs) -> bool:
        """Checks whether the resting arm is off the current motion, by more than 0.015 rad.

        The largest difference of a joint from the motion at the current phase is compared with this
        limit (`_MAX_DEVIATION`). Evasive maneuvers of `MotionGuard` cause such differences. The
        result is False as long as the movement primitive is moving, and also if the tool is 2 mm
        (`_TOOL_TOLERANCE`) or more from the position of the movement primitive.

        Args:
            current: motion that is executed.
            inputs: configuration and goal of the arm, scene, and proposed coupling terms and route.
        """
        motion, policy = current.prediction.motion, inputs.policy
        if policy.speed > 0.0 or not len(motion.q):
            return False
        s = normalized_time(policy.phase, self._dmp.alpha_k)
        p_WE = tool_poses(self._chain, np.array([inputs.q]))[0, 9:]
        is_tool_near = math.dist(p_WE, policy.p_WE) < _TOOL_TOLERANCE
        return is_tool_near and bool(np.abs(motion.joints(s) - inputs.q).max() > _MAX_DEVIATION)

    def is_still_valid(self, candidate: SelectedMotion, inputs: PlanningInputs) -> bool:
        """Checks whether a motion still achieves its predicted clearance from the current state.

        The motion is rolled out again, because the arm has moved since the decision started.
        Directly in front of an obstacle, a small displacement can change the side on which the
        motion passes. The result is False if the new clearance shortfall exceeds the one predicted
        by the decision by more than the tolerance `slack`, or if the arm cannot follow the motion
        to the goal. The result is True without a roll-out if the movement primitive is still at its
        start, or if the decision contains no predicted motion.

        Args:
            candidate: selected motion with its prediction.
            inputs: current inputs.
        """
        motion, params = (
            candidate.prediction.motion,
            candidate.params if len(candidate.params) else NOMINAL_PARAMS,
        )
        if inputs.policy.phase == 1.0 or not motion.s.size:
            return True
        search = self._search(candidate, inputs, self._collision_model(inputs, motion.q[-1:]))
        prediction = self._predict(candidate, inputs, search, params, 0.0).prediction
        max_shortfall = candidate.prediction.shortfall + self._parameters.slack
        return prediction.can_follow and prediction.shortfall <= max_shortfall

    def _collision_model(
        self, inputs: PlanningInputs, ends: FloatArray, fraction: float = 1.0
    ) -> ArmCollisionModel:
        """Builds the arm's collision model, with the required clearances of each body.

        The required clearance of a body from a geometry is `fraction` times the requested one. If
        the body is nearer to the geometry at the current configuration or at the goal, the smaller
        of these two distances, minus a tolerance, replaces it. The docstring of `MotionSearch` has
        the equation.

        Args:
            inputs: configuration and goal of the arm, scene, and proposed coupling terms and route.
            ends: (m, n) possible goal configurations [rad], of which the one with the largest
                distance counts for each body and geometry; (0, n): the goal has no effect.
            fraction: fraction of the requested clearance that is required [-].
        """
        geometries, p, is_tool = inputs.scene.geometries, self._parameters, self._is_tool
        requested = np.where(is_tool, self._clearance, min(p.link_clearance, self._clearance))
        required_clearance = np.tile(fraction * requested[:, None], (1, len(geometries.ball)))
        is_environment = geometries.layout[:, 5] == ENVIRONMENT
        required_clearance[:, is_environment] = np.minimum(
            required_clearance[:, is_environment], fraction * p.link_clearance
        )
        distance = self._distances(inputs, inputs.q[None])
        if len(ends):
            at_end = [self._distances(inputs, q[None]) for q in ends]
            distance = np.minimum(
                distance,
                np.maximum(np.max(at_end, axis=0), self._contact_distance[:, None] + p.slack),
            )
        required_clearance = np.minimum(required_clearance, distance - p.slack)
        required_clearance[self._spheres.group_joint < 0] = -np.inf
        of_self = min(_SELF_CLEARANCE, self._self_distance(inputs.q) - p.slack)
        if len(ends):
            self_distance_at_end = max(self._self_distance(q) for q in ends)
            of_self = min(of_self, max(self_distance_at_end, _MIN_ACCEPTABLE_DISTANCE) - p.slack)
        requirements = ClearanceRequirements(required_clearance, of_self, is_tool)
        return ArmCollisionModel(self._chain, self._spheres, geometries, requirements, 0.0)

    def _null_space_reference(self, command: MotionCommand) -> BSpline:
        """Returns desired tool orientation and nominal posture over normalized time, for a motion.

        Args:
            command: motion, whose demonstration defines both.

        Returns:
            Linear spline over normalized times from 0 to 1 with 9 + n columns: rotation matrix R_WE
            of the tool, row by row, and nominal posture of the null space [rad].
        """
        demo, s = command.demonstration, np.linspace(0.0, 1.0, _REFERENCE_SAMPLES)
        if demo.orientation is None:
            return self._task_references
        R_WE = orientation_along(demo.orientation, demo.R_WS, demo.R_WG, s)
        return references(s, R_WE, demo.posture(s))

    def _search(
        self, current: SelectedMotion, inputs: PlanningInputs, model: ArmCollisionModel, **more: Any
    ) -> ArmSearch:
        """Builds the search for motions that imitate the demonstration of the current motion.

        Args:
            current: current motion.
            inputs: configuration and goal of the arm, scene, and proposed coupling terms and route;
                motions start at its configuration `q` and state `policy` of the primitive.
            model: collision model of the arm, with the required clearances.
            more: further arguments of `ArmSearch`: costs of passing an obstacle in each direction,
                warm start, maximum latency.
        """
        demo = current.command.demonstration
        dmp = demo.position or self._dmp
        scene = scene_under_way(
            inputs.policy,
            inputs.p_WG,
            inputs.ellipsoids,
            clearance=self._clearance,
            alpha_k=dmp.alpha_k,
        )
        return ArmSearch(
            scene,
            model,
            inputs.q,
            self._null_space_reference(current.command),
            samples=SAMPLES if demo.position is None else _REFERENCE_SAMPLES,
            dmp=dmp,
            policy=self._policy,
            parameters=self._parameters,
            **more,
        )

    def _search_motion(self, current: SelectedMotion, inputs: PlanningInputs) -> SelectedMotion:
        """Searches for the best motion without a joint-space plan, and predicts it by a roll-out.

        The nominal (demonstrated) motion, or else the current one, is kept if it is feasible.
        Otherwise the motion with the regressor chain's coupling terms and those of the evolution
        strategy are candidates as well.

        Args:
            current: current motion, with the best candidates of the previous search.
            inputs: configuration and goal of the arm, scene, and proposed coupling terms and route.

        Returns:
            Best motion with its prediction, and the data with which the next search starts.
        """
        command, end = current.command, self._null_space_reference(current.command)(1.0)
        target = np.append(end[:9], inputs.p_WG)
        at_goal = inverse_kinematics(self._chain, target, end[9:], seeds=4)
        model = self._collision_model(inputs, at_goal[:1])
        route = inputs.route
        search = self._search(
            current,
            inputs,
            model,
            side_cost=route.side_cost,
            previous=current.params,
            elites=current.elites,
            generations=current.generations,
            max_latency=math.inf if inputs.policy.phase == 1.0 else self._parameters.compute_budget,
        )
        scene = search.scene
        chain = _chain_command(inputs.coupling, route, scene)
        best = search.run(
            guides=chain.guides, seeds=_seeds(scene, chain), source=max(command.source, NOMINAL)
        )
        source = int(best.source[0])
        if source == CHAIN:
            motion, params, sides = chain, NO_ELITES, chain.route
        else:
            terms = avoidance_terms(scene, best.params)
            sides = _sides_of_term(route, terms, best.params[0, ANGLE])
            is_active = terms[:, ALPHA] > 0.0
            if source == NOMINAL and command.demonstration.position is not None:
                source = JOINT_PATH
            motion, params = (
                MotionCommand(source, rows_of(terms[is_active])),
                best.params[is_active],
            )
        motion = replace(motion, demonstration=command.demonstration, restart=command.restart)
        current = replace(
            current,
            command=motion,
            params=params,
            counts=search.counts,
            elites=search.elites,
            generations=search.generations,
        ).with_changes(prediction={"sides": sides})
        return self._predict(current, inputs, search, best.params, float(best.length[0]))

    def _predict(
        self,
        current: SelectedMotion,
        inputs: PlanningInputs,
        search: ArmSearch,
        params: FloatArray,
        length: float,
    ) -> SelectedMotion:
        """Returns a motion with its prediction, temporal scaling and note, from a roll-out.

        The whole arm is rolled out. The note gives the reason why the motion must be held (stopped
        on its path); it is empty if the motion can be executed.

        Args:
            current: motion to roll out.
            inputs: configuration and goal of the arm, scene, and proposed coupling terms and route.
            search: search that rolls out candidates.
            params: (1, 6) parameters of the motion's single coupling term: angle of the side on
                which the motion passes [rad]; position of the term's center along the line of
                length L from start to goal, and offset of the center toward this side, both over L;
                logarithms of the decay kappa L^2, the angular width psi [rad] and the strength
                alpha. They have no effect on a motion with the regressor chain's terms.
            length: length of the tool's path from its current position to the goal, which
                determines the temporal scaling [m].
        """
        requirements = search.world.required
        tool = search.tool_paths(params, guides=current.command.guides)
        arm = search.follow(params, tool, -math.inf)
        count = int(arm.samples[0])
        s, q = search.sample_times(count), arm.q[0, :count]
        # Every second sample suffices: samples are a few millimeters apart.
        d = self._distances(inputs, q[::2])
        is_self = arm.clearance_margin[0].argmin() == SELF
        limiting = "the arm itself" if is_self else self._nearest_label(inputs, d)
        can_follow = (
            float(arm.error[0]) <= MAX_POSE_ERROR and float(arm.max_joint_speed_ratio[0]) <= 1.0
        )
        goal_error = float(tool.goal_error[0])
        reaches_goal = goal_error <= MAX_GOAL_ERROR * search.scene.baseline
        self_clearance = float(arm.clearance_margin[0, SELF]) + requirements.of_self
        note = ""
        if not can_follow:
            note = "no motion that the arm can follow found"
        elif not reaches_goal:
            goal = np.round(inputs.p_WG, 3).tolist()
            note = f"no motion to the goal {goal} m found: one ends {1e3 * goal_error:.0f} mm away"
            if d.size:
                note += f", {1e3 * d.min():.0f} mm from {self._nearest_label(inputs, d)}"
        elif self._is_contact(d):
            note = f"no motion that clears {limiting} found"
        elif self_clearance <= min(
            _MIN_ACCEPTABLE_DISTANCE, self._self_distance(inputs.q) - self._parameters.slack
        ):
            note = "no motion that clears the arm itself found"
        is_obstacle = inputs.scene.geometries.layout[:, 5] != ENVIRONMENT
        required = requirements.of_geometries[:, is_obstacle].max(initial=-np.inf)
        return current.with_changes(
            command={
                "tau": max(1.0, (current.traveled + length) / max(search.planned_length, 1e-9)),
                "note": note,
            },
            prediction={
                "motion": PlannedMotion(s, tool.path[0, :count], q, current.p_WS),
                "shortfall": max(-float(arm.min_margin[0]) - self._parameters.slack, 0.0),
                "limiting_obstacle": limiting,
                "can_follow": can_follow and reaches_goal,
                "clearance_reduction": max(self._clearance - float(required), 0.0)
                if is_obstacle.any()
                else 0.0,
            },
        )

    # --- joint-space paths ----------------------------------------------------------------

    def _goal_configurations(self, inputs: PlanningInputs, seeds: int) -> FloatArray:
        """Computes collision-free configurations of the arm at the goal.

        Args:
            inputs: configuration and goal of the arm, scene, and proposed coupling terms and route.
            seeds: number of random initial configurations of the inverse kinematics, in addition to
                the preferred configuration at the goal.

        Returns:
            (m, n) configurations, in order of distance from the preferred one [rad].
        """
        X_WG, preferred = self._goal(inputs)
        solutions = inverse_kinematics(self._chain, X_WG, preferred, seeds=seeds)
        free = [q for q in solutions if not self._is_contact(self._distances(inputs, q[None]))]
        return np.array(free).reshape(-1, len(preferred))

    def _goal(self, inputs: PlanningInputs) -> tuple[FloatArray, FloatArray]:
        """Returns the pose of the tool and the preferred configuration of the arm at the goal.

        The pose (12,) in the world frame is a rotation matrix, row by row, and a position [m]. The
        configuration (n,) is the one given to the constructor, or else the nominal posture at the
        end of the task's motion [rad].
        """
        end = self._task_references(1.0)
        preferred = end[9:] if self._q_goal is None else self._q_goal
        return np.append(end[:9], inputs.p_WG), preferred

    def _goal_note(self, inputs: PlanningInputs) -> str:
        """Returns a note that names the obstacle which the arm would touch at the goal.

        The note is the reason for holding the motion (stopping it on its path). It is empty if at
        least one configuration at the goal is collision-free, or if the arm cannot reach the goal.
        """
        at_goal = inverse_kinematics(self._chain, *self._goal(inputs), seeds=_GOAL_SEEDS)
        d = [self._distances(inputs, q[None]) for q in at_goal]
        if not all(map(self._is_contact, d)) or not d:
            return ""
        return f"at its goal the arm would touch {self._nearest_label(inputs, d[0])}"

    def _plan_motion(
        self, current: SelectedMotion, inputs: PlanningInputs
    ) -> SelectedMotion | None:
        """Plans a joint-space path to the goal, at decreasing fractions of the requested clearance.

        Args:
            current: current motion.
            inputs: configuration and goal of the arm, scene, and proposed coupling terms and route.

        Returns:
            Motion that imitates the first path whose imitation the arm can follow to the goal
            without contact; None: no such path was found.
        """
        p = self._parameters
        # The preferred configuration comes first: with it the tool turns least.
        goals = [self._goal_configurations(inputs, 0)]
        for fraction, max_count in (
            *((fraction, p.configurations) for fraction in _CLEARANCE_FRACTIONS),
            (min(_CLEARANCE_FRACTIONS), p.last_configurations),
        ):
            for number in range(2):
                if number == len(goals):
                    # Many seeds are slow: only if no path to the preferred configuration exists.
                    q = self._goal_configurations(inputs, _GOAL_SEEDS)
                    is_known = np.all(np.abs(q[:, None] - goals[0]) < _SAME_ANGLE, axis=2)
                    goals.append(q[~np.any(is_known, axis=1)])
                ends = goals[number]
                model = self._collision_model(inputs, ends, fraction)
                corners = plan_path(model, inputs.q, ends, max_configurations=max_count)
                candidate = (
                    self._imitate_path(corners, current, inputs, model) if len(corners) else None
                )
                if candidate is not None:
                    return candidate
        return None

    def _imitate_path(
        self,
        corners: FloatArray,
        current: SelectedMotion,
        inputs: PlanningInputs,
        model: ArmCollisionModel,
    ) -> SelectedMotion | None:
        """Creates the motion that imitates a joint-space path, and predicts it by a roll-out.

        Args:
            corners: (C, n) corners of the path, from the current configuration to the goal [rad].
            current: current motion.
            inputs: configuration and goal of the arm, scene, and proposed coupling terms and route.
            model: collision model for which the path was planned.

        Returns:
            Motion that starts from the resting arm; None: `demonstration` cannot convert the path,
            or the arm cannot follow the motion to the goal without contact.
        """
        duration, alpha_k = self._dmp.duration, self._dmp.alpha_k
        seconds_per_meter = duration / max(math.dist(inputs.p_WG, inputs.policy.p_WE), 1e-3)
        try:
            demo = demonstration(
                model,
                corners,
                seconds_per_meter=seconds_per_meter,
                max_duration=MAX_DURATION_RATIO * duration,
                alpha_k=alpha_k,
            )
        except ValueError:
            # The tool turns too far for one orientation primitive.
            return None
        policy = inputs.policy
        at_rest = replace(policy, p_WS=policy.p_WE, z_W=np.zeros(3), phase=1.0)
        inputs = replace(inputs, policy=at_rest)
        start = replace(
            current,
            command=MotionCommand(JOINT_PATH, demonstration=demo),
            traveled=0.0,
            params=NO_ELITES,
            elites=NO_ELITES,
        )
        search = self._search(start, inputs, model)
        candidate = self._predict(start, inputs, search, NOMINAL_PARAMS, 0.0)
        # The shortfall refers to the full requested clearance, not to the planned fraction.
        motion = candidate.prediction.motion
        d = self._distances(inputs, motion.q)
        shortfalls = self._collision_model(inputs, demo.q[-1:]).required.of_geometries - d
        shortfall = max(float(shortfalls.max(initial=-np.inf)) - self._parameters.slack, 0.0)
        limiting = (
            self._nearest_label(inputs, d)
            if shortfall > 0.0
            else candidate.prediction.limiting_obstacle
        )
        if candidate.command.note:
            return None
        # The prediction belongs to the motion that restarts at the current tool position.
        return candidate.with_changes(
            command={"tau": 1.0, "restart": True},
            prediction={
                "shortfall": shortfall,
                "limiting_obstacle": limiting,
                "motion": replace(motion, p_WS=at_rest.p_WS),
            },
        )

    def _distances(self, inputs: PlanningInputs, q: FloatArray) -> FloatArray:
        """Computes the minimum distance of each body of the arm to each geometry along a motion.

        Args:
            inputs: configuration and goal of the arm, proposed coupling terms and route, and scene
                with K collision geometries.
            q: (T, n) configurations of the motion [rad].

        Returns:
            (G, K) distances of G groups of covering spheres, one group per body [m]; inf for groups
            fixed to the world.
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

    def _is_contact(self, d: FloatArray) -> bool:
        """Checks whether any distance of a body of the arm to a collision geometry means contact.

        The distances are those of the spheres that cover a body. The limit for contact is 1 mm,
        lowered by the distance by which these spheres extend beyond the body's exact shapes.

        Args:
            d: (G, K) distances of G groups of covering spheres (one per body) to K geometries [m].
        """
        return bool((d <= self._contact_distance[:, None]).any())

    def _nearest_label(self, inputs: PlanningInputs, d: FloatArray) -> str:
        """Returns the label of the collision geometry nearest to the arm; "" without geometries.

        Args:
            inputs: configuration and goal of the arm, proposed coupling terms and route, and scene
                with K collision geometries.
            d: (G, K) distances of the arm's G groups of covering spheres to these geometries [m].
        """
        return inputs.scene.labels[int(d.min(axis=0).argmin())] if d.size else ""

    def _contact_label(self, inputs: PlanningInputs) -> str:
        """Returns the label of the geometry that the arm certainly touches now; "" without contact.

        Contact is certain if the spheres that cover a body overlap the geometry by more than they
        extend beyond the exact shapes of the body.
        """
        d = self._distances(inputs, inputs.q[None]) - self._contact_distance[:, None]
        return self._nearest_label(inputs, d) if (d < -_MIN_ACCEPTABLE_DISTANCE).any() else ""

    def _self_distance(self, q: FloatArray) -> float:
        """Computes the minimum distance between bodies of the arm at a configuration [m].

        Args:
            q: (n,) configuration [rad].
        """
        return float(self_distance(self._chain, self._spheres, q))


def _chain_command(coupling: CouplingParameters, route: Route, scene: Scene) -> MotionCommand:
    """Returns the motion with the regressor chain's coupling terms for all obstacles together.

    A coupling term is a turning rate that steers the motion away from an obstacle. The result has
    no terms if no obstacle is in the way, if every side of an obstacle is forbidden, or if the
    inputs belong to different sets of obstacles.

    Args:
        coupling: parameters of one coupling term per obstacle, from the regressor chain.
        route: side selected by cost rings for passing each obstacle.
        scene: initial state of the motion, and ellipsoids of the obstacles.
    """
    ellipsoids = scene.ellipsoids
    is_consistent = len(coupling) == len(ellipsoids) and np.array_equal(route.ids, ellipsoids.ids)
    has_terms = (coupling.alpha > 0.0).any() and route.remaining_clearance.any()
    # A forbidden side of an obstacle excludes this candidate only.
    if not (is_consistent and has_terms) or route.blocked:
        return MotionCommand()
    rows = replace(
        coupling, center_W=ellipsoids.p_WO, normal_W=np.zeros((0, 3)), ellipsoids=ellipsoids
    )
    return MotionCommand(CHAIN, rows, route, tau=1.0)


_LN_ALPHA_OFFSETS = np.array([-3.0, -2.0, -1.0, 0.0])
"""Offsets of ln alpha with which the search varies a coupling term of the regressor chain [-].

alpha is the strength of the term. Each offset gives, for the term of each obstacle, one seed of the
search: a candidate motion with this term alone."""


def _seeds(scene: Scene, chain: MotionCommand) -> FloatArray:
    """Returns seeds of the search: each coupling term of the chain alone, with several strengths.

    A coupling term is a turning rate that steers the motion away from an obstacle.

    Args:
        scene: initial state of the motion.
        chain: motion with the regressor chain's coupling terms for all obstacles together.

    Returns:
        (n, 6) parameters of the seeds: angle of the side on which the motion passes [rad]; position
        of the term's center along the line of length L from start to goal, and offset of the center
        toward this side, both over L; logarithms of the decay kappa L^2, the angular width psi
        [rad] and the strength alpha.
    """
    is_active = chain.rows.alpha > 0.0
    normal_W, center_W = chain.route.normal_W[is_active], chain.rows.center_W[is_active]
    params = params_of(scene, center_W, normal_W, chain.rows.as_array()[is_active])
    seeds = np.repeat(params, len(_LN_ALPHA_OFFSETS), axis=0)
    seeds[:, LN_ALPHA] += np.tile(_LN_ALPHA_OFFSETS, len(params))
    return seeds


def _sides_of_term(route: Route, terms: FloatArray, angle: float) -> Route:
    """Returns a copy of a route in which all obstacles are passed on the side of one coupling term.

    The copy is marked as blocked if user-supplied cost rings forbid every side.

    Args:
        route: sides selected by cost rings, and their costs.
        terms: (1, 12) coupling term of the selected motion in the world frame: center (3) [m],
            strength alpha in units of 1/T with the demonstrated duration T, angular width psi
            [rad], decay kappa [1/m^2], guidance heading (3), and normal of the plane of rotation
            (3). With alpha = 0, the obstacles are passed without guidance.
        angle: direction of the side as an angle around the line from start to goal, 0 along the y
            axis and pi/2 along the z axis of the local frame (x along the line, z up) [rad].
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
        # The nominal motion has no term, hence no side.
        remaining_clearance=route.remaining_clearance * (terms[0, ALPHA] > 0.0),
    )


@dataclass(frozen=True, eq=False)
class MotionCommand(Frozen):
    """Selected motion in the form in which the movement primitive executes it.

    Attributes:
        source: kind of the motion; -1: no motion was selected; 0: nominal (demonstrated) motion; 1:
            all coupling terms of the regressor chain; 2: motion of the evolution strategy; 3:
            imitation of a joint-space path.
        rows: parameters and centers of the coupling terms, one row per term; empty: none.
        route: sides on which the obstacles are passed, to which guidance turns the heading.
        tau: temporal scaling of the demonstrated duration [-]; 0: no motion was selected.
        demonstration: motion to imitate; empty: demonstration of the task.
        restart: whether the motion restarts with this demonstration from the resting arm.
        note: reason why the motion is held (stopped on its path); "": the motion is not held.
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
        """Selected motion as the message `CouplingParameters`, an input of `DmpIntegrator`."""
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
        """Obstacles past which guidance turns the heading of the motion; None: no guidance.

        They contain the coupling terms of the regressor chain.
        """
        ellipsoids = self.rows.ellipsoids
        return (
            CouplingInputs.of(ellipsoids, self.coupling, self.route).obstacles
            if len(ellipsoids)
            else None
        )


@dataclass(frozen=True, eq=False)
class MotionPrediction(Frozen):
    """Prediction of a selected motion by a roll-out (simulation) of the whole arm.

    Attributes:
        motion: motion of tool and joints from the time of the decision on.
        shortfall: distance by which the motion falls below the required clearance, beyond the
            tolerance `slack` [m]; 0: the motion achieves it. The required clearance is the
            requested one, or less where the current or the goal configuration is nearer to an
            obstacle.
        limiting_obstacle: label of the collision geometry that comes nearest to the arm, or "the
            arm itself" if the clearance margin (distance minus required clearance) between its
            bodies is smaller than those of tool and links.
        can_follow: whether the motion ends at the goal (up to `MAX_GOAL_ERROR`), and the arm
            follows it with at most `MAX_POSE_ERROR`, within its joint speed limits.
        clearance_reduction: amount by which the required clearance is below the requested one [m]:
            requested clearance of the tool minus the largest required clearance of any pair of body
            and obstacle; 0 without obstacles.
        goal_note: reason for holding the motion (stopping it on its path), if every configuration
            at the goal is in contact with collision geometry; otherwise "". Checked only after a
            joint-space plan has failed.
        contact: label of the collision geometry that the arm touches now; "": none.
        sides: costs of the sides on which each obstacle can be passed, and the side on which the
            motion passes; for a viewer.
    """

    motion: PlannedMotion = field(default_factory=PlannedMotion)
    shortfall: float = 0.0
    limiting_obstacle: str = ""
    can_follow: bool = True
    clearance_reduction: float = 0.0
    goal_note: str = ""
    contact: str = ""
    sides: Route = field(default_factory=Route)


@dataclass(frozen=True, eq=False)
class SelectedMotion(Frozen):
    """Result of a decision of `MotionSearch`: the selected motion, and data for the next search.

    Attributes:
        command: selected motion for the movement primitive.
        prediction: predicted whole-arm motion and clearance.
        p_WS, p_WG: (3,) start and goal of the motion in the world frame [m]; (0,): no motion was
            selected.
        scene: collision scene of the decision.
        params: (1, 6) parameters of the motion's coupling term from the search: angle of the side
            on which the motion passes [rad]; position of the term's center along the line of length
            L from start to goal, and offset of the center toward this side, both over L; logarithms
            of the decay kappa L^2, the angular width psi [rad] and the strength alpha. (0, 6): the
            motion has no such term.
        elites: (k, 6) parameters, as in `params`, of the best candidates of the last search; the
            next search starts from them.
        generations: number of generations (iterations) of the search so far.
        last_plan: time of the last joint-space plan [s].
        traveled: length of the executed part of the tool's path [m].
        p_WE: (3,) position of the tool at the end of the executed part in the world frame [m].
        counts: (4,) numbers of candidates of each kind in the last search, by the index `source` of
            `MotionCommand`.
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

    def matches(self, policy: PolicyState, p_WG: FloatArray) -> bool:
        """Checks whether start and goal of this motion equal those of the current task exactly.

        Args:
            policy: state of the movement primitive, which contains its start.
            p_WG: (3,) current goal in the world frame [m].
        """
        return np.array_equal(self.p_WS, policy.p_WS) and np.array_equal(self.p_WG, p_WG)

    def with_changes(self, **parts: dict[str, Any]) -> SelectedMotion:
        """Returns a copy in which some fields of the command or the prediction are replaced.

        Args:
            parts: for the keywords `command` and `prediction`, dictionaries of new values by the
                name of the field, for example `command={"note": ""}`.
        """
        new = {name: replace(getattr(self, name), **fields) for name, fields in parts.items()}
        return replace(self, **new)
