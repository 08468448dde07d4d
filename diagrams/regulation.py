"""Regulation: the coupling terms' parameters."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from drake_oa.common.config import ScenarioError
from drake_oa.common.wires import Wires
from drake_oa.diagrams.planning import Rings, add_motion_selector
from drake_oa.diagrams.policy import add_orientation, make_dmp, make_kept_orientation
from drake_oa.diagrams.station import Cell
from drake_oa.regulation.config import Verified
from drake_oa.regulation.proposal_network import load_proposals
from drake_oa.regulation.regressor import ChainWeights, check_action_level, load_chain
from drake_oa.regulation.regressor_chain import RegressorChain, Scaling
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import package_file

Loaded = TypeVar("Loaded")


def add_regulation(
    wires: Wires, scenario: Scenario, cell: Cell | None, rings: Rings = None
) -> None:
    """Adds motion_selector, which counts rings of one's own, or regressor_chain.

    Both offer coupling_parameters: the selector from robot_state, policy_state, goal and solids_W,
    with the motion and demonstration that it has verified; the chain from ellipsoids_W and
    policy_state.
    """
    regulation = scenario.regulation
    if isinstance(regulation, Verified):
        add_motion_selector(wires, scenario, cell, _loaded(scenario, load_proposals), rings)
        if "desired_orientation" not in wires and cell is not None:
            add_orientation(wires, make_kept_orientation(scenario))
        return
    length: Scaling = "route" if "route" in wires else "sections"
    chain = RegressorChain(
        load_weights(scenario),
        scenario.task.clearance,
        original=make_dmp(scenario).duration if regulation.term == "original" else None,
        scaling=length if regulation.scaled else "none",
    )
    wires.add("regressor_chain", chain)


def load_weights(scenario: Scenario) -> ChainWeights:
    """The chain that the scenario names.

    Raises:
        ScenarioError: naming the file, if the weights are missing or do not fit.
    """
    return _loaded(scenario, _load_running)


def _load_running(path: Path) -> ChainWeights:
    weights = load_chain(path)
    check_action_level(weights, path)
    return weights


def _loaded(scenario: Scenario, load: Callable[[Path], Loaded]) -> Loaded:
    try:
        return load(package_file(scenario.regulation.weights))
    except (OSError, ValueError) as error:
        raise ScenarioError(f"regulation.weights: {error}") from None
