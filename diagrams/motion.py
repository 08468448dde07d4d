"""Functions that add the layers inference, route, verification and policy to a diagram."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np
from pydrake.geometry import Role
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource

from drake_oa.common.compiled import kernel_arrays
from drake_oa.common.config import ScenarioError, field_errors
from drake_oa.common.files import package_file
from drake_oa.common.messages import FloatArray
from drake_oa.common.signal_builder import SignalBuilder
from drake_oa.diagrams.station import StationModel
from drake_oa.inference.config import Verified
from drake_oa.inference.regressor import check_action_level, load_chain
from drake_oa.inference.regressor_chain import RegressorChain
from drake_oa.planning.motion_search import MotionSearch
from drake_oa.planning.motion_verifier import MotionVerifier
from drake_oa.policy.dmp import Dmp, imitate, minimum_jerk, minimum_jerk_orientation
from drake_oa.policy.dmp_integrator import DmpIntegrator
from drake_oa.policy.orientation_integrator import OrientationIntegrator
from drake_oa.robot.arm import PULL, inverse_kinematics, joint_margins, make_chain
from drake_oa.robot.plant import make_robot_plant
from drake_oa.route.cost_ring_selector import CostRingSelector
from drake_oa.route.cost_rings import JointMargins, Ring
from drake_oa.scenario.demonstration import demonstrated_path, primitive_constants
from drake_oa.scenario.end_poses import (
    ToolOrientation,
    end_rotations,
    posture_guide,
    start_positions,
    tool_orientation,
)
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import perception_period
from drake_oa.scenario.task import goal_trajectory


def add_policy(signals: SignalBuilder, scenario: Scenario, station: StationModel | None) -> None:
    """Adds the systems that generate the desired motion of the tool.

    They are goal, dmp_integrator (movement primitive of the position) and, if the tool rotates,
    orientation_integrator (movement primitive of the orientation). The inputs of dmp_integrator are
    goal and, as far as these signals exist, ellipsoids_W, coupling_parameters, route (sides on
    which obstacles are passed), speed_scale (fraction of full speed), evasion_velocity (velocity
    that moves the desired position to the tool if the arm makes no progress) and demonstration
    (motion that is imitated).
    """
    task, policy = scenario.task, scenario.policy
    goal: LeafSystem = ConstantVectorSource(np.asarray(task.goal))
    if task.goal_moves:
        goal = TrajectorySource(goal_trajectory(task))
    signals.add("goal", goal, outputs={"y0": "goal"})
    start = np.asarray(task.start, dtype=float)
    signals.add("dmp_integrator", DmpIntegrator(make_dmp(scenario), start, config=policy))
    signals.log("goal", "desired_position", "desired_velocity", "desired_acceleration", "phase")
    signals.export("desired_position", "phase", "policy_state")
    held = None if station is None else tool_orientation(scenario)
    if held is None and station is not None and "demonstration" in signals:
        # A motion that imitates a joint path rotates the tool. Before such a motion the orientation
        # is constant.
        R_WE = end_rotations(scenario)[0].matrix()
        held = ToolOrientation(minimum_jerk_orientation(alpha_k=policy.alpha_k), R_WE, R_WE)
    if held is not None:
        integrator = OrientationIntegrator(
            held.primitive, held.R_WS, held.R_WG, period=policy.period
        )
        signals.add("orientation_integrator", integrator)
        signals.log("desired_orientation", "orientation_error")


def make_dmp(scenario: Scenario) -> Dmp:
    """Creates the movement primitive of the tool position for a scenario's task.

    The primitive imitates the demonstrations of the task or, without any, a straight minimum-jerk
    motion.

    Raises:
        ScenarioError: for a demonstration that cannot be read or imitated; names its file.
    """
    task = scenario.task
    if task.demonstration:
        return demonstrated_path(scenario)
    path, t = minimum_jerk(task.start, task.goal, duration=task.duration)
    with field_errors("policy", ValueError):
        return imitate(path, t, **primitive_constants(scenario.policy))


_logger = logging.getLogger("drake_oa")


Rings = Mapping[str, Ring] | None
"""Type of user-supplied cost rings by name, or None for no rings.

A cost ring is a function that computes costs in [0, 1] of the directions in which an obstacle can
be passed; 1 forbids a direction."""


def add_route(signals: SignalBuilder, scenario: Scenario, station: StationModel | None) -> None:
    """Adds the system cost_ring_selector, which selects the side on which each obstacle is passed.

    The inputs are ellipsoids_W, policy_state and goal. The output is route, or with
    `inference: !Verified` (motions are verified by roll-outs) proposed_route. With
    `inference: !Paper`, the system is added only if `inference.guided` is true: guidance then turns
    the motion to the selected side.

    Args:
        signals: builder that receives the system.
        scenario: configuration of the system.
        station: not used.
    """
    inference = scenario.inference
    if "ellipsoids_W" not in signals or not (isinstance(inference, Verified) or inference.guided):
        return
    outputs: dict[str, str | None] = {"decision": "route", "route": "shown_route"}
    if isinstance(inference, Verified):
        outputs = {"decision": "proposed_route", "route": None}
    signals.add("cost_ring_selector", make_cost_ring_selector(scenario), outputs=outputs)


def make_cost_ring_selector(scenario: Scenario, rings: Rings = None) -> CostRingSelector:
    """Creates the cost ring selector of a scenario, with user-supplied cost rings.

    A cost ring rates the sides on which an obstacle can be passed. With `inference: !Paper`, the
    selector also has rings for reach and joint limits of the arm. With `!Verified` these are left
    out, because the system MotionVerifier simulates the whole arm.

    Args:
        scenario: configuration of the selector.
        rings: user-supplied cost rings by name; None: no additional rings.
    """
    inference = scenario.inference
    is_verified = isinstance(inference, Verified)
    return CostRingSelector(
        scenario.task.clearance,
        table_height=scenario.policy.table_height,
        joint_margins=None if is_verified else make_joint_margins(scenario),
        extra_rings=rings,
        ring_weight=inference.ring_weight if isinstance(inference, Verified) else 0.5,
    )


_LEG_SAMPLES = 6
"""Number of tool poses on each straight leg of a path at which joint margins are computed.

A path leads from the start to the goal, on one leg, or on two legs via a point beside an obstacle.
A joint margin is the minimum distance of the joints from their limits, by inverse kinematics [rad].
"""


def make_joint_margins(scenario: Scenario) -> JointMargins | None:
    """Creates the function that computes the joints' distance from their limits along tool paths.

    The argument of this function contains P corners of each of N paths of the tool point, (N, P, 3)
    in the world frame [m]; the first corner is the start, the same for all paths. The result (N, P)
    contains for each corner the minimum distance of the joints from their limits on the leg to this
    corner [rad]. The result is -inf from the first leg on that contains a pose out of reach. If the
    start is out of reach, the result is inf for all paths.

    The arm follows each path by inverse kinematics. The null space tracks the configuration at the
    start of the path, which is computed from the configuration at the start of the task.

    Returns:
        Function of type `JointMargins`; None for a scenario without a robot.
    """
    if scenario.robot is None:
        return None
    robot_plant, q_start = make_robot_plant(scenario.robot), start_positions(scenario)
    chain = make_chain(robot_plant.plant, robot_plant.tool_frame, q_start)
    orientation = orientation_of_motion(scenario)

    # Results are cached, because paths among resting obstacles repeat in successive decisions.
    @lru_cache(maxsize=16)
    def margins(data: bytes, legs: int) -> FloatArray:
        corners = np.frombuffer(data).reshape(-1, legs + 1, 3)
        place = np.linspace(0.0, legs, legs * _LEG_SAMPLES + 1)
        leg = np.minimum(place.astype(int), legs - 1)
        share = (place - leg)[:, None]
        p_WE = corners[:, leg] + share * (corners[:, leg + 1] - corners[:, leg])
        R_WE = orientation(place / legs).reshape(-1, 9)
        X_WE = np.concatenate([np.tile(R_WE, (len(corners), 1, 1)), p_WE], axis=2)
        begin = inverse_kinematics(chain, X_WE[0, 0], q_start[chain.q_index], seeds=0)
        if not len(begin):
            return np.full(corners.shape[:2], np.inf)
        pull = 1.0 - math.exp(-PULL / len(place))
        found = joint_margins(begin[0], *kernel_arrays(X_WE), pull, chain)
        return np.minimum.reduceat(found, [0, *range(1, len(place), _LEG_SAMPLES)], axis=1)

    return lambda corners: margins(corners.tobytes(), corners.shape[1] - 1)


def orientation_of_motion(scenario: Scenario) -> Callable[[FloatArray], FloatArray]:
    """Creates the function that computes the orientation of the tool along a scenario's motion.

    This function maps normalized times (T,), 0 at the start and 1 at the end of the motion, to
    orientations R_WE (T, 3, 3) of the tool frame in the world.
    """
    held, R_WE = tool_orientation(scenario), end_rotations(scenario)[0].matrix()
    return (lambda s: np.tile(R_WE, (len(s), 1, 1))) if held is None else held.along


def add_verification(
    signals: SignalBuilder, scenario: Scenario, station: StationModel | None
) -> None:
    """Adds the system motion_verifier for `inference: !Verified`, which searches for a motion.

    The system verifies motions by simulation of the whole arm. Inputs are collision_scene_W,
    ellipsoids_W, policy_state, goal, proposed_parameters, proposed_route and path_state (state of
    the robot on the verified motion; without the safety layer robot_state). Main outputs are motion
    (joint motion of the arm), demonstration (motion that the movement primitive imitates),
    coupling_parameters and route.

    Raises:
        ScenarioError: if the scenario has no robot, or if perception provides ellipsoids only and
            no collision geometry of the obstacles.
    """
    inference, policy, task = scenario.inference, scenario.policy, scenario.task
    if not isinstance(inference, Verified):
        return
    if station is None:
        raise ScenarioError("robot: must be set for inference: !Verified; the scenario has null")
    if isinstance(scenario.perception, GivenEllipsoids):
        raise ScenarioError(
            "inference: !Verified requires the collision geometry of obstacles; perception: "
            "!GivenEllipsoids has ellipsoids only: use another source, or inference: !Paper"
        )
    _warn_of_bare_links(station)
    chain, q_rest = station.chain, station.q_start[station.chain.q_index]
    q_goal = None if task.q_goal is None else np.asarray(task.q_goal, dtype=float)
    q_end = q_rest if q_goal is None else q_goal
    search = MotionSearch(
        make_dmp(scenario),
        task.clearance,
        chain,
        station.spheres.arrays,
        parameters=inference,
        policy=policy,
        orientation=orientation_of_motion(scenario),
        posture=lambda s: posture_guide(s, q_rest, q_end),
        protrusion=station.spheres.protrusion,
        q_goal=q_goal,
    )
    verifier = MotionVerifier(
        search,
        tuple(chain.q_index.tolist()),
        station.robot_plant.plant.num_multibody_states(),
        period=perception_period(scenario),
        compute_latency=scenario.compute_latency,
        step=policy.period,
    )
    signals.add(
        "motion_verifier",
        verifier,
        inputs={
            "coupling_parameters": "proposed_parameters",
            "route": "proposed_route",
            # During a maneuver of the guard the arm is away from the verified motion.
            "robot_state": "path_state",
        },
        outputs={
            "decision": "decision_verification",
            "sides": "shown_route",
            "source": "motion_source",
        },
    )
    signals.set_fallback("path_state", "robot_state")
    signals.log("shortfall", "clearance_reduction", "decision_verification", "motion_source")


def _warn_of_bare_links(station: StationModel) -> None:
    """Logs a warning about links of the robot that have visual but no collision geometry.

    The distance of such links to obstacles is not checked.
    """
    plant, inspector = (
        station.robot_plant.plant,
        station.robot_plant.scene_graph.model_inspector(),
    )
    bare = [
        body.name()
        for body in map(plant.get_body, plant.GetBodyIndices(station.robot_plant.instance))
        if body.name() not in station.spheres.bodies
        and inspector.NumGeometriesForFrameWithRole(
            plant.GetBodyFrameIdOrThrow(body.index()), Role.kPerception
        )
    ]
    if bare:
        _logger.warning(
            "robot.model: no collision geometry of %s: its clearance is not checked",
            ", ".join(bare),
        )


def add_inference(signals: SignalBuilder, scenario: Scenario, station: StationModel | None) -> None:
    """Adds the system regressor_chain, which computes the parameters of the coupling terms.

    The regressor chain consists of three neural networks, which compute kappa, psi and alpha of the
    avoidance term. The inputs are ellipsoids_W and policy_state. The output is coupling_parameters,
    or with `inference: !Verified` (motions are verified by roll-outs) proposed_parameters. With
    `!Verified` the system is added only if `inference.chain` names a weights file.

    Raises:
        ScenarioError: for a weights file that is missing or of another network; names the file.
    """
    inference = scenario.inference
    outputs: dict[str, str] = {}
    if isinstance(inference, Verified):
        if inference.chain is None or "ellipsoids_W" not in signals:
            return
        name, file = "chain", inference.chain
        outputs = {"coupling_parameters": "proposed_parameters"}
    else:
        name, file = "weights", inference.weights
    with field_errors(f"inference.{name}", OSError, ValueError):
        path = package_file(file)
        weights = load_chain(path)
        check_action_level(weights, path)
    chain = RegressorChain(weights, scenario.task.clearance)
    signals.add("regressor_chain", chain, outputs=outputs)
