"""Regulation: the coupling terms' parameters."""

from __future__ import annotations

from drake_oa.common.config import ScenarioError
from drake_oa.common.wires import Wires
from drake_oa.diagrams.planning import add_motion_selector
from drake_oa.diagrams.policy import add_orientation, make_kept_orientation
from drake_oa.diagrams.station import Cell
from drake_oa.regulation.config import Verified
from drake_oa.regulation.regressor import ChainWeights, load_chain
from drake_oa.regulation.regressor_chain import RegressorChain
from drake_oa.scenario.loading import package_file
from drake_oa.scenario.scenario import Scenario


def add_regulation(wires: Wires, scenario: Scenario, cell: Cell | None) -> None:
    """Adds motion_selector, or regressor_chain.

    Both offer coupling_parameters: the selector from robot_state, policy_state, goal and solids_W,
    with the motion and demonstration that it has verified; the chain from ellipsoids_W and
    policy_state, or the route.
    """
    weights = load_weights(scenario)
    if isinstance(scenario.regulation, Verified):
        add_motion_selector(wires, scenario, cell, weights)
        if "desired_orientation" not in wires and cell is not None:
            add_orientation(wires, make_kept_orientation(scenario))
        return
    chain = RegressorChain(weights, scenario.task.clearance)
    by_route = "route" in wires and scenario.policy.descriptor == "route"
    wires.add("regressor_chain", chain, reads={"policy_state" if by_route else "route": None})


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
