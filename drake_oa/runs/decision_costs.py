"""What decisions cost in simulated time, as it is logged and reported."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_oa.common.messages import FloatArray
from drake_oa.runs.motion_log import MotionLog
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.sources import perception_period

SIGNAL = "decision_"
"""The log of a layer's port `decision` is named so, and by the layer."""
_REPORTED = {"regulation": "decision_cost", "evasion": "evasion_cost", "turn": "turn_cost"}
"""Layer -> key in the report."""


def logged_decisions(signals: Mapping[str, FloatArray]) -> dict[str, Any]:
    """The attributes of a log, out of the logged signals (T, 2) of the ports `decision`."""
    found = []
    for name, rows in signals.items():
        if name.startswith(SIGNAL):
            begun = np.unique(rows[np.isfinite(rows).all(axis=1)], axis=0)
            found += [(*row, name.removeprefix(SIGNAL)) for row in begun.tolist()]
    found.sort()
    return {
        "decision_time": np.array([time for time, _, _ in found]),
        "decision_cost": np.array([cost for _, cost, _ in found]),
        "decision_layer": tuple(layer for _, _, layer in found),
    }


def cost_figures(costs: ArrayLike, period: float) -> dict[str, float] | None:
    """{median, p99, max [s], share_over_period, count} of decisions; None of none."""
    costs = np.asarray(costs, dtype=float)
    if not len(costs):
        return None
    return {
        "median": float(np.median(costs)),
        "p99": float(np.percentile(costs, 99.0)),
        "max": float(costs.max()),
        "share_over_period": float((costs > period).mean()),
        "count": len(costs),
    }


def layer_costs(log: MotionLog, layer: str = "regulation") -> FloatArray:
    """What the decisions of a layer cost that began in the motion [s]."""
    of_layer = np.array(log.decision_layer, dtype=str) == layer
    return log.decision_cost[of_layer & (log.decision_time <= log.duration)]


def decision_figures(scenario: Scenario, log: MotionLog) -> dict[str, Any]:
    """The `cost_figures` of the regulation's decisions, the evasion's and the tool turn's.

    Keys `decision_cost`, `evasion_cost` and `turn_cost`; None where that layer decides nothing, or
    nothing that costs time.
    """
    period = perception_period(scenario)
    return {key: cost_figures(layer_costs(log, layer), period) for layer, key in _REPORTED.items()}


def pooled_figures(runs: Iterable[Mapping[str, Any]]) -> dict[str, float] | None:
    """The `decision_cost` of several runs together, each with its `decision_costs` [s]."""
    decided = [run for run in runs if run["decision_cost"] is not None]
    together = cost_figures(
        list(chain.from_iterable(run["decision_costs"] for run in decided)), np.inf
    )
    if together is None:
        return None
    each = [run["decision_cost"] for run in decided]
    over = sum(one["share_over_period"] * one["count"] for one in each)
    return {**together, "share_over_period": over / together["count"]}
