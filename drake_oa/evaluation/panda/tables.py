"""The figures of an evaluation on the Panda, and their table; meters and seconds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from hashlib import sha256
from typing import Any

import numpy as np

from drake_oa.common.console import Column, TextTable
from drake_oa.common.files import software_versions
from drake_oa.evaluation.panda.evaluation import PLANNER, PandaResults
from drake_oa.evaluation.scenes.evaluation import over
from drake_oa.runs.motion_log import MotionEnd
from drake_oa.runs.report import TOLERANCE, latency_statistics
from drake_oa.scenario.loading import parse_scenario

ALL = "all"
"""Kind of the figures of several kinds together."""

_COLUMNS = (
    Column("name", "method"),
    Column("contacts"),
    Column("avoidable", "avoidable, by view"),
    Column("success_of", "success"),
    Column("claims", "claims A, B"),
    Column("drp", "DRPBench contacts, success"),
    Column("tool_clearance_min", "tool clearance [m]", "{:.3f}"),
    Column("duration_median", "duration [s]", "{:.1f}"),
)


_NOTED = {"stop_reasons": "stopped", "contact_pairs": "contact", "sources": "motion of"}
"""Counts of scenes that are listed below the table -> their heading."""


def panda_metrics(results: PandaResults, workers: int | str = 1) -> dict[str, Any]:
    """Returns the figures of a suite.

    They are {"suite", "seed", "kind", "perception", "jobs", "versions", "scenes_digest", "solved",
    "methods"}; `methods` is {name: figures}, `scenes_digest` the SHA-256
    of the scenes' seeds, tasks and obstacles, whatever perceives them.

    `solved` is how many scenes the planner or another method solves, None where the planner has not
    run; the methods' `success_rate_solved` is their share of successes in those.

    Args:
        results: of the runs.
        workers: processes that shared the machine, as real-time factors show, or a cluster.
    """
    suite, drawn = results.suite, map(parse_scenario, results.scenarios.values())
    scenes = [(scenario.seed, scenario.task, scenario.obstacles) for scenario in drawn]
    metrics = methods_metrics(results.runs)
    for name, runs in results.runs.items():
        metrics["methods"][name] |= {
            "perception": suite.perception_of(name),
            "runs": [{"scene": scene, **run} for scene, run in runs.items()],
        }
    return {
        "suite": suite.name,
        "seed": suite.seed,
        "kind": suite.kind,
        "perception": suite.perception,
        "duration": suite.duration,
        "jobs": workers if isinstance(workers, int) else None,
        "versions": software_versions(),
        "scenes_digest": sha256(repr(scenes).encode()).hexdigest(),
        **metrics,
    }


def methods_metrics(runs: Mapping[str, Mapping[Any, Mapping[str, Any]]]) -> dict[str, Any]:
    """Returns {"solved", "methods": {name: figures}}.

    Args:
        runs: method -> scene -> result.
    """
    methods = {name: run_metrics(list(of.values())) for name, of in runs.items()}
    solved = {
        scene for of in runs.values() for scene, run in of.items() if run["outcome"] == "success"
    }
    for metrics in methods.values():
        is_known = PLANNER in runs and len(solved) > 0
        metrics["success_rate_solved"] = metrics["success"] / len(solved) if is_known else None
    return {"solved": len(solved) if PLANNER in runs else None, "methods": methods}


def kinds_metrics(
    results: Sequence[PandaResults], metrics: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    """Returns the figures of one kind of scenes, or of several {"suite", "kinds": {...}}."""
    if len(metrics) == 1:
        return metrics[0]
    return {"suite": "panda", "kinds": {of["kind"]: of for of in metrics}}


def run_metrics(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Figures of a method's runs; None where there is nothing to take them over.

    Counts of scenes: `scenes`; `contacts`, `success` and `stopped`, which sum to it (see
    `evaluation`); `self_contacts`, the robot touched itself; `time_limits`, ended by the time
    limit; `failed`, raised an exception; `clearance_shortfall`, the tool came more than 1 mm nearer
    to resting obstacles than start and goal leave of the requested clearance;
    `stop_reasons`, `contact_pairs` and `sources` (of the motions that `verified` executed): reason,
    pair or source -> count. Of contacts: `avoidable_by_physics` and `avoidable_by_view` (see
    `contact_events`). Of logged instants: `claim_A` and `claim_B`,
    violations (see `claims`), None where no obstacle moves. For levels of DRPBench
    `drp_contacts` and `drp_success`, by its rules.

    Others: `success_rate`; `duration_median` of the motions [s]; `decision_latency` of all decisions
    (see `latency_statistics`), None where they take no time; `tool_clearance_min`,
    `robot_clearance_min` [m]; `goal_error_max` of the scenes that were not stopped [m];
    `real_time_factor`, the median.
    """
    outcome = Counter(run["outcome"] for run in runs)
    events = [event for run in runs for event in run["contact_events"] or ()]
    claims = [run["claim_violations"] for run in runs if run["claim_violations"]]
    by_drp = Counter(run.get("drp_outcome") for run in runs)
    drp = {"drp_contacts": by_drp["contact"], "drp_success": by_drp["success"]}
    reasons = Counter(run["reason"] for run in runs if run["outcome"] == "stopped")
    # Each pair once in a scene, an obstacle's number left out.
    pairs = Counter(
        pair
        for run in runs
        for pair in {*run["self_contacts"], *(of.rstrip("0123456789") for of in run["contacts"])}
    )
    sources = Counter(source for run in runs for source in run["sources"] or ())

    def of(statistic: Callable[..., Any], key: str) -> float | None:
        return over(statistic, (run[key] for run in runs))

    return {
        "scenes": len(runs),
        "contacts": outcome["contact"],
        "success": outcome["success"],
        "stopped": outcome["stopped"],
        "success_rate": over(np.mean, (run["outcome"] == "success" for run in runs)),
        "stop_reasons": dict(reasons.most_common()),
        "sources": dict(sources.most_common()),
        "contact_pairs": dict(sorted(pairs.items(), key=lambda item: (-item[1], item[0]))),
        "self_contacts": sum(bool(run["self_contacts"]) for run in runs),
        **{
            key: sum(event[key] for event in events)
            for key in ("avoidable_by_physics", "avoidable_by_view")
        },
        "claim_A": over(sum, (found["A"] for found in claims)),
        "claim_B": over(sum, (found["B"] for found in claims)),
        "time_limits": sum(run["ended"] == MotionEnd.TIME_LIMIT for run in runs),
        "clearance_shortfall": sum((run["clearance_shortfall"] or 0.0) > TOLERANCE for run in runs),
        "duration_median": of(np.median, "duration"),
        "decision_latency": latency_statistics(
            [cost for run in runs for cost in run.get("decision_latencies", ())], np.inf
        ),
        "failed": sum(bool(run["failed"]) for run in runs),
        "tool_clearance_min": of(min, "tool_clearance_min"),
        "robot_clearance_min": of(min, "robot_clearance_min"),
        "goal_error_max": over(
            max, (run["goal_error"] for run in runs if run["outcome"] != "stopped")
        ),
        "real_time_factor": of(np.median, "real_time_factor"),
        **(drp if set(by_drp) - {None} else {}),
    }


def panda_table(metrics: Sequence[Mapping[str, Any]]) -> TextTable:
    """Tabulates the figures of one or several kinds of scenes.

    Below: reasons of stops, contacts, and sources of the executed motions.

    Args:
        metrics: as `panda_metrics` gives them, of each kind.
    """
    several = len(metrics) > 1
    rows, lines = [], []
    for of in metrics:
        for name, method in of["methods"].items():
            title = f"{of['kind']}: {name}" if several else name
            row = {**method, "name": f"{title}, {method['perception']}"}
            row["success_of"] = f"{method['success']} of {method['scenes']}"
            if method["claim_A"] is not None:
                row["claims"] = f"{method['claim_A']:g}, {method['claim_B']:g}"
                counts = (method[f"avoidable_by_{reason}"] for reason in ("physics", "view"))
                row["avoidable"] = ", ".join(map(str, counts))
            if "drp_success" in method:
                row["drp"] = f"{method['drp_contacts']}, {method['drp_success']}"
            rows.append(row)
            if of["kind"] == ALL:
                continue
            for key, what in _NOTED.items():
                for reason, count in method[key].items():
                    lines.append(f"{title}: {what}, {count} scene{'s' * (count != 1)}: {reason}")
        if of.get("solved") is not None:
            lines.append(f"{of['kind']}: scenes that a method solves: {of['solved']}")
        if "scenes_digest" in of:
            lines.append(f"{of['kind']}: digest of the scenes: {of['scenes_digest'][:12]}")
    return TextTable(_COLUMNS, rows, lines)
