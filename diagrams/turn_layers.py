"""Makes the systems that turn the tool."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from pydrake.math import RollPitchYaw

from drake_oa.common.schema_check import ScenarioError
from drake_oa.diagrams import layers
from drake_oa.policy.orientation_dmp import minimum_jerk_orientation
from drake_oa.policy.orientation_integrator import OrientationIntegrator
from drake_oa.regulation.regressor import load_chain
from drake_oa.regulation.regulator import Regulator
from drake_oa.regulation.tool_turn import ToolTurner
from drake_oa.regulation.tool_turn_selector import ToolTurnSelector
from drake_oa.regulation.turning_tool import TurningTool, TurnParameters
from drake_oa.robot.plant import RobotPlant, home_positions, tool_link_corners
from drake_oa.robot.reachable_turns import reachable_turns
from drake_oa.scenario.loading import package_file
from drake_oa.scenario.scenario import GivenEllipsoids, Scenario, Verified

_logger = logging.getLogger("drake_oa")

_PLACES = 5
"""Points of the straight way at which the arm has to be able to hold a turn."""
_ROUNDS, _POLISH, _STEPS = 12, 1, 250
"""Rounds of the search for a motion with each turn, and steps of a roll-out a unit of s."""
_MARGIN = 0.03
"""Distance that the tool keeps while it turns, where the task asks for no less [m]."""


def make_tool_turn_selector(
    scenario: Scenario, robot_plant: RobotPlant | None
) -> ToolTurnSelector | None:
    """What chooses the turn of the tool; None: the scenario has it not turned.

    Raises:
        ScenarioError: if nothing sees clouds of obstacles, or motions are not verified.
    """
    turn, robot, regulation = scenario.policy.turn, scenario.robot, scenario.regulation
    if turn is None:
        return None
    if robot is None or robot_plant is None or isinstance(scenario.perception, GivenEllipsoids):
        raise ScenarioError("policy.turn: needs a robot, and perception that sees obstacles")
    if not isinstance(regulation, Verified):
        raise ScenarioError(
            f"policy.turn: needs 'regulation: !Verified {{}}'; it has !{type(regulation).__name__}"
        )
    task, dmp = scenario.task, layers.make_dmp(scenario)
    search = layers.search_parameters(regulation, scenario.policy, dmp)
    search = replace(
        search,
        rounds=min(search.rounds, _ROUNDS),
        polish=min(search.polish, _POLISH),
        steps=min(search.steps, _STEPS),
        retries=0,
    )
    weights = load_chain(package_file(scenario.policy.weights))
    annulus = layers.held_annulus(scenario)
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
        period=layers.perception_period(scenario),
        thinking=scenario.thinking,
        step=scenario.policy.period,
    )


def make_kept_orientation(scenario: Scenario) -> OrientationIntegrator:
    """An orientation that stays as it is at the start, besides its turn.

    Raises:
        ScenarioError: if the scenario has no turn or no robot.
    """
    turn, robot = scenario.policy.turn, scenario.robot
    if turn is None or robot is None:
        raise ScenarioError("policy.turn: this scenario has no turn, or no robot that has a tool")
    R_WE = RollPitchYaw(robot.rpy_WE).ToRotationMatrix().matrix()
    return OrientationIntegrator(
        minimum_jerk_orientation(alpha_k=scenario.policy.alpha_k),
        R_WE,
        R_WE,
        period=scenario.policy.period,
        turn_axis_W=turn.axis,
        turn_rate=turn.speed,
    )
