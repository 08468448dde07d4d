"""Regulation: the coupling terms' parameters, and the turn of the tool."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from pydrake.math import RollPitchYaw

from drake_oa.common.config import ScenarioError
from drake_oa.common.wires import Wires
from drake_oa.control.min_speed_scale import MinSpeedScale
from drake_oa.diagrams.planning import add_motion_selector
from drake_oa.diagrams.policy import add_orientation, make_dmp, make_kept_orientation
from drake_oa.diagrams.route import held_annulus
from drake_oa.diagrams.station import Cell
from drake_oa.policy.config import Policy
from drake_oa.policy.dmp import Dmp
from drake_oa.regulation.config import Regressor, SearchParameters, Verified, WholeArm
from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.regulation.regressor_chain import RegressorChain
from drake_oa.regulation.regulator import Regulator
from drake_oa.regulation.tool_turn import ToolTurner, TurningTool, TurnParameters
from drake_oa.regulation.tool_turn_selector import ToolTurnSelector
from drake_oa.regulation.verified_regressor_chain import RobotArm, VerifiedRegressorChain
from drake_oa.robot.plant import RobotPlant, home_positions, tool_link_corners
from drake_oa.robot.reachable_turns import reachable_turns
from drake_oa.scenario.loading import package_file
from drake_oa.scenario.perception import GivenEllipsoids
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import perception_period
from drake_oa.scenario.tool_orientation import tool_orientation

_logger = logging.getLogger("drake_oa")

_LEAST_STEPS, _MOST_STEPS = 250, 1000
"""Steps of a roll-out a unit of normalised time."""
_PLACES = 5
"""Points of the straight way at which the arm has to be able to hold a turn."""


_ROUNDS, _POLISH, _STEPS = 12, 1, 250
"""Rounds of the search for a motion with each turn, and steps of a roll-out a unit of s."""


_MARGIN = 0.03
"""Distance that the tool keeps while it turns, where the task asks for no less [m]."""


def add_regulation(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds regressor_chain, and tool_turn_selector where the tool is turned to pass.

    Reads ellipsoids_W, policy_state and goal, or the route; offers coupling_parameters and,
    where motions are verified, motion.
    """
    if isinstance(scenario.regulation, WholeArm):
        add_motion_selector(wires, scenario, cell, load_weights(scenario))
        if "desired_orientation" not in wires and cell is not None:
            add_orientation(wires, make_kept_orientation(scenario))
        return
    arm = None if cell is None else cell.arm
    chain = make_regressor_chain(scenario, arm)
    if isinstance(chain, VerifiedRegressorChain):
        of_arm = ("robot_state", "obstacles_W", "camera_pose")
        reads = dict.fromkeys(("table", *(() if arm is not None else of_arm)))
        if arm is not None:
            reads["obstacles_W"] = "solid_obstacles_W"
        wires.add("regressor_chain", chain, reads=reads, offers={"decision": "decision_regulation"})
        wires.log("shortfall", "short_of", "lowered", "decision_regulation")
    else:
        by_route = "route" in wires and scenario.policy.descriptor == "route"
        wires.add("regressor_chain", chain, reads={"policy_state" if by_route else "route": None})
    if cell is not None and scenario.policy.turn is not None:
        _add_turn(wires, scenario, cell)


def _add_turn(wires: Wires, scenario: Scenario, cell: Cell) -> None:
    """What turns the tool to pass, and slows the motion until it has."""
    selector = make_tool_turn_selector(scenario, cell.robot_plant)
    wires.add(
        "tool_turn_selector",
        selector,
        offers={"decision": "decision_turn", "speed_scale": "turn_speed_scale"},
    )
    wires.log("tool_turn", "planned_turn", "decision_turn")
    if "desired_orientation" not in wires:
        # Besides its turn the tool keeps its orientation.
        add_orientation(wires, make_kept_orientation(scenario))
    if scenario.supervisor is None:
        wires.otherwise("speed_scale", "turn_speed_scale")
    else:
        wires.interpose("speed_scale", "slowest", MinSpeedScale(), offers={"least": "speed_scale"})


def make_regressor_chain(
    scenario: Scenario, arm: RobotArm | None = None
) -> RegressorChain | VerifiedRegressorChain:
    """The regulation that the scenario asks for, with its weights.

    Args:
        scenario: which.
        arm: what plans the posture of the robot's arm; None: nothing does.

    Raises:
        ScenarioError: naming the file, if the weights are missing or do not fit.
    """
    policy, asked_clearance, weights = (
        scenario.policy,
        scenario.task.clearance,
        load_weights(scenario),
    )
    if isinstance(scenario.regulation, Regressor):
        return RegressorChain(weights, asked_clearance)
    if not isinstance(scenario.regulation, Verified):
        raise ScenarioError("regulation: !WholeArm has no regressor chain of its own")
    dmp = make_dmp(scenario)
    return VerifiedRegressorChain(
        weights,
        dmp,
        asked_clearance,
        period=perception_period(scenario),
        parameters=search_parameters(scenario.regulation, policy, dmp),
        table_height=policy.table_height,
        annulus=held_annulus(scenario),
        arm=arm,
        thinking=scenario.thinking,
        step=policy.period,
        # What was demonstrated is not to be begun again from its middle.
        begins_anew=not scenario.task.demonstration
        and policy.turn is None
        and (scenario.robot is None or tool_orientation(scenario) is None),
    )


def load_weights(scenario: Scenario) -> ChainWeights:
    """The chain that the scenario names.

    Raises:
        ScenarioError: naming the file, if the weights are missing or do not fit.
    """
    policy = scenario.policy
    try:
        weights = load_chain(package_file(policy.weights))
    except (OSError, ValueError) as error:
        raise ScenarioError(f"policy.weights: {error}") from None
    unit = weights.metadata.get("units", {}).get("alpha", "1/T")
    if unit != "1/T":
        raise ScenarioError(
            f"policy.weights: {policy.weights} counts alpha in {unit}, for the released code's "
            "action level; the policy needs a chain of `drake-oa train --recipe project`"
        )
    return weights


def search_parameters(regulation: Verified, policy: Policy, dmp: Dmp) -> SearchParameters:
    """How far the search of a verified motion goes."""
    # A step of a roll-out is one of the policy, where that is neither coarse nor costly.
    steps = round(dmp.duration / policy.period)
    most = min(max(steps, _LEAST_STEPS), _MOST_STEPS)
    return SearchParameters(**vars(regulation), steps=most, fade=policy.fade)


def make_tool_turn_selector(scenario: Scenario, robot_plant: RobotPlant) -> ToolTurnSelector:
    """What chooses the turn of the tool.

    Raises:
        ScenarioError: if nothing sees clouds of obstacles, or motions are not verified.
    """
    turn, robot, regulation = scenario.policy.turn, scenario.robot, scenario.regulation
    if turn is None or robot is None or isinstance(scenario.perception, GivenEllipsoids):
        raise ScenarioError("policy.turn: needs a robot, and perception that sees obstacles")
    if not isinstance(regulation, Verified):
        raise ScenarioError(
            f"policy.turn: needs 'regulation: !Verified {{}}'; it has !{type(regulation).__name__}"
        )
    task, dmp = scenario.task, make_dmp(scenario)
    search = search_parameters(regulation, scenario.policy, dmp)
    search = replace(
        search,
        rounds=min(search.rounds, _ROUNDS),
        polish=min(search.polish, _POLISH),
        steps=min(search.steps, _STEPS),
        retries=0,
    )
    weights = load_chain(package_file(scenario.policy.weights))
    annulus = held_annulus(scenario)
    regulator, quick = (
        Regulator(
            weights,
            dmp,
            task.clearance,
            parameters=parameters,
            table_height=scenario.policy.table_height,
            annulus=annulus,
        )
        for parameters in (search, replace(search, rounds=0))
    )
    R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix().matrix()
    tool = TurningTool.of(tool_link_corners(robot_plant, robot), np.asarray(turn.axis), R_WE)
    parameters = TurnParameters(
        largest=turn.largest,
        step=turn.step,
        speed=turn.speed,
        margin=min(_MARGIN, task.clearance),
    )
    share = np.linspace(0.0, 1.0, _PLACES)[:, None]
    turns = reachable_turns(
        robot_plant.plant,
        robot_plant.tool_frame.name(),
        R_WE,
        (1.0 - share) * task.start + share * task.goal,
        home_positions(robot_plant, robot),
        np.asarray(turn.axis),
        parameters.turns,
    )
    if len(turns) == 1:
        _logger.warning("policy.turn: the arm can hold no turn of the tool all along the way")
    turner = ToolTurner(
        tool,
        regulator,
        dmp.duration,
        parameters,
        quick=quick,
        turns=turns,
        free_W=np.array([task.start]),
    )
    return ToolTurnSelector(
        turner,
        period=perception_period(scenario),
        thinking=scenario.thinking,
        step=scenario.policy.period,
    )
