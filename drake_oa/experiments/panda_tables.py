"""The figures of an evaluation on the Panda, and their table; metres and seconds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from drake_oa.experiments.panda_evaluation import PandaResults
from drake_oa.experiments.tables import text_table

_COLUMNS = (
    ("scenes", "scenes", "{:d}", 1.0),
    ("contacts", "contacts", "{:d}", 1.0),
    ("success", "success", "{:d}", 1.0),
    ("stopped", "stopped", "{:d}", 1.0),
    ("success_rate", "success [%]", "{:.1f}", 1e2),
    ("tool_clearance_min", "tool clearance [m]", "{:.3f}", 1.0),
    ("tool_clearance_median", "median", "{:.3f}", 1.0),
    ("robot_clearance_min", "robot clearance [m]", "{:.3f}", 1.0),
    ("goal_error_max", "goal error [mm]", "{:.2f}", 1e3),
    ("real_time_factor", "real-time factor", "{:.2f}", 1.0),
    ("real_time_factor_min", "least", "{:.2f}", 1.0),
)


def panda_figures(
    results: PandaResults, versions: Sequence[str], jobs: int | None = 1
) -> dict[str, Any]:
    """{"suite", "seed", "kind", "perception", "jobs", "versions", "methods": {name: figures}}.

    Args:
        results: of the runs.
        versions: "name version" each.
        jobs: how many runs shared the machine, which real-time factors tell; None: a
            cluster's.
    """
    suite = results.suite
    return {
        "suite": "panda",
        "seed": suite.seed,
        "kind": suite.kind,
        "perception": suite.perception,
        "duration": suite.duration,
        "jobs": jobs,
        "versions": dict(item.split(" ", 1) for item in versions),
        "methods": {
            name: {
                **run_figures(list(runs.values())),
                "perception": suite.perception_of(name),
                "complete": results.complete(name),
                "runs": [{"scene": scene, **run} for scene, run in runs.items()],
            }
            for name, runs in results.runs.items()
        },
    }


def run_figures(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of a method's runs; None where there is nothing to take them over.

    Keys: `scenes`; `contacts`, `success` and `stopped`, which sum to it (see `panda_run`);
    `success_rate`; `stop_reasons`, what the stopped ones were stopped by, and how often;
    `contact_pairs`, in how many scenes which link met what; `failed`, runs that raised;
    `tool_clearance_min` and `robot_clearance_min` over all scenes, `tool_clearance_median` of
    the scenes' least ones [m]; `goal_error_max` over the scenes that were not stopped short,
    `goal_error_max_all` over all [m]; `real_time_factor`, the median, and
    `real_time_factor_min`, the least; `seconds`, the wall time of all simulations together.
    """
    outcome = Counter(run["outcome"] for run in runs)
    arrived = [run["goal_error"] for run in runs if run["outcome"] != "stopped"]
    speed = [run["real_time_factor"] for run in runs if run["real_time_factor"] is not None]
    return {
        "scenes": len(runs),
        "contacts": outcome["contact"],
        "success": outcome["success"],
        "stopped": outcome["stopped"],
        "success_rate": outcome["success"] / len(runs) if runs else None,
        "stop_reasons": _counted(run["reason"] for run in runs if run["outcome"] == "stopped"),
        "contact_pairs": _counted(pair for run in runs for pair in _pairs(run["contacts"])),
        "failed": sum(bool(run["failed"]) for run in runs),
        "tool_clearance_min": _least(run["tool_clearance_min"] for run in runs),
        "tool_clearance_median": _median(run["tool_clearance_min"] for run in runs),
        "robot_clearance_min": _least(run["robot_clearance_min"] for run in runs),
        "goal_error_max": max(arrived, default=None),
        "goal_error_max_all": max((run["goal_error"] for run in runs), default=None),
        "real_time_factor": float(np.median(speed)) if speed else None,
        "real_time_factor_min": min(speed, default=None),
        "seconds": float(sum(run["wall_time"] for run in runs)),
    }


def _pairs(contacts: Sequence[str]) -> list[str]:
    """Each pair once, an obstacle's number left out."""
    return sorted({contact.rstrip("0123456789") for contact in contacts})


def _counted(values: Iterable[str]) -> dict[str, int]:
    return dict(Counter(values).most_common())


def _least(values: Iterable[float | None]) -> float | None:
    return min((value for value in values if value is not None), default=None)


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


def panda_table(figures: Mapping[str, Any]) -> str:
    """The figures as a text table, and below it why runs were stopped and what was touched.

    Args:
        figures: as `panda_figures` gives them.
    """
    methods = figures["methods"]
    rows = [(f"{name}, {method['perception']}", method) for name, method in methods.items()]
    lines = [text_table("method", rows, _COLUMNS)]
    for name, method in methods.items():
        for key, what in (("stop_reasons", "stopped"), ("contact_pairs", "contact")):
            for reason, count in method[key].items():
                lines.append(f"{name}: {what}, {count} scene{'s' * (count != 1)}: {reason}")
    if figures["jobs"] != 1:
        shared = "on a cluster" if figures["jobs"] is None else f"with {figures['jobs']} at once"
        lines.append(f"real-time factors: of runs {shared}; lower than that of one alone")
    return "\n".join(lines)
