"""Wiring of the motion: goal, movement primitives, coupling parameters and selected sides."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from functools import lru_cache

import numpy as np
from pydrake.geometry import Role
from pydrake.systems.framework import LeafSystem
from pydrake.systems.primitives import (
    ConstantVectorSource,
    TrajectorySource,
)

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


def add_policy(
    signals: SignalBuilder, scenario: Scenario, station_model: StationModel | None
) -> None:
    """Adds goal, dmp_integrator and, where the tool's orientation changes, its integrator.

    Reads ellipsoids_W, coupling_parameters, route, speed_scale and evasion_velocity, each if offered.
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
    held = None if station_model is None else tool_orientation(scenario)
    if held is None and station_model is not None and "demonstration" in signals:
        # A path in the joints turns the tool, which stays as at the start until then.
        R_WE = end_rotations(scenario)[0].matrix()
        held = ToolOrientation(minimum_jerk_orientation(alpha_k=policy.alpha_k), R_WE, R_WE)
    if held is not None:
        integrator = OrientationIntegrator(
            held.primitive, held.R_WS, held.R_WG, period=policy.period
        )
        signals.add("orientation_integrator", integrator)
        signals.log("desired_orientation", "orientation_error")


def make_dmp(scenario: Scenario) -> Dmp:
    """Makes the movement primitive of the task: demonstrated, or minimum jerk.

    Raises:
        ScenarioError: naming the file, if a demonstration cannot be read or imitated.
    """
    task = scenario.task
    if task.demonstration:
        return demonstrated_path(scenario)
    path, t = minimum_jerk(task.start, task.goal, duration=task.duration)
    with field_errors("policy", ValueError):
        return imitate(path, t, **primitive_constants(scenario.policy))


_logger = logging.getLogger("drake_oa")


Rings = Mapping[str, Ring] | None
"""User-supplied costs of sides, by name; None: there are none."""


def add_route(
    signals: SignalBuilder,
    scenario: Scenario,
    station_model: StationModel | None,
    rings: Rings = None,
) -> None:
    """Adds cost_ring_selector: ellipsoids_W, policy_state and goal -> route.

    With MotionVerifier it offers proposed_route.
    """
    inference = scenario.inference
    if "ellipsoids_W" not in signals or not (isinstance(inference, Verified) or inference.guided):
        return
    outputs: dict[str, str | None] = {"decision": "route", "route": "shown_route"}
    if isinstance(inference, Verified):
        outputs = {"decision": "proposed_route", "route": None}
    signals.add("cost_ring_selector", make_cost_ring_selector(scenario, rings), outputs=outputs)


def make_cost_ring_selector(scenario: Scenario, rings: Rings = None) -> CostRingSelector:
    """Creates the selection of sides, with user-supplied rings by name.

    Without MotionVerifier, which rolls the arm out, its reach is a ring, too.
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
"""Poses on each leg of a way that the arm must reach."""


def make_joint_margins(scenario: Scenario) -> JointMargins | None:
    """Creates the function that tracks ways of the tool from the start; None without a robot.

    The null space is drawn to the configuration at the start, as the controller draws it. Where a
    way begins out of reach nothing is known of it, and its margins are inf.
    """
    if scenario.robot is None:
        return None
    robot_plant, q_start = make_robot_plant(scenario.robot), start_positions(scenario)
    chain = make_chain(robot_plant.plant, robot_plant.tool_frame, q_start)
    orientation = orientation_of_motion(scenario)

    # What stands still is asked about once.
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
    """Creates the function of (T,) normalized times that computes (T, 3, 3) orientations."""
    held, R_WE = tool_orientation(scenario), end_rotations(scenario)[0].matrix()
    return (lambda s: np.tile(R_WE, (len(s), 1, 1))) if held is None else held.along


def add_verification(
    signals: SignalBuilder, scenario: Scenario, station_model: StationModel | None
) -> None:
    """Adds motion_verifier where the inference is `!Verified`: collision_scene_W, policy_state, goal,
    robot_state, and the rows and sides -> motion, demonstration, coupling_parameters and route.

    Raises:
        ScenarioError: without a robot or collision geometry of the obstacles.
    """
    inference, policy, task = scenario.inference, scenario.policy, scenario.task
    if not isinstance(inference, Verified):
        return
    if station_model is None:
        raise ScenarioError("inference: !Verified needs a robot; this scenario has null")
    if isinstance(scenario.perception, GivenEllipsoids):
        raise ScenarioError(
            "inference: !Verified needs obstacles that are seen; !GivenEllipsoids has the "
            "ellipsoids of obstacles that are dilated by the tool"
        )
    _tell_of_bare_links(station_model)
    chain, q_rest = station_model.chain, station_model.q_start[station_model.chain.q_index]
    q_goal = None if task.q_goal is None else np.asarray(task.q_goal, dtype=float)
    q_end = q_rest if q_goal is None else q_goal
    search = MotionSearch(
        make_dmp(scenario),
        task.clearance,
        chain,
        station_model.spheres.arrays,
        parameters=inference,
        policy=policy,
        orientation=orientation_of_motion(scenario),
        posture=lambda s: posture_guide(s, q_rest, q_end),
        protrusion=station_model.spheres.protrusion,
        q_goal=q_goal,
    )
    verifier = MotionVerifier(
        search,
        tuple(chain.q_index.tolist()),
        station_model.robot_plant.plant.num_multibody_states(),
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
            # During a maneuver the arm is away from the motion that is verified.
            "robot_state": "path_state",
        },
        outputs={
            "decision": "decision_regulation",
            "sides": "shown_route",
            "source": "motion_source",
        },
    )
    signals.set_fallback("path_state", "robot_state")
    signals.log("shortfall", "clearance_reduction", "decision_regulation", "motion_source")


def _tell_of_bare_links(station_model: StationModel) -> None:
    """Warns of links that are visible, but have no collision geometry to keep clear."""
    plant, inspector = (
        station_model.robot_plant.plant,
        station_model.robot_plant.scene_graph.model_inspector(),
    )
    bare = [
        body.name()
        for body in map(plant.get_body, plant.GetBodyIndices(station_model.robot_plant.instance))
        if body.name() not in station_model.spheres.bodies
        and inspector.NumGeometriesForFrameWithRole(
            plant.GetBodyFrameIdOrThrow(body.index()), Role.kPerception
        )
    ]
    if bare:
        _logger.warning(
            "robot.model: %s: no collision geometry, so nothing keeps it clear", ", ".join(bare)
        )


def add_inference(
    signals: SignalBuilder, scenario: Scenario, station_model: StationModel | None
) -> None:
    """Adds regressor_chain: ellipsoids_W, policy_state -> coupling_parameters.

    With MotionVerifier it offers proposed_parameters.

    Raises:
        ScenarioError: naming the file, if weights are missing or do not fit.
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
