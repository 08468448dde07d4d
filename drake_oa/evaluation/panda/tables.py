"""Metrics and printed tables of an evaluation of methods on the Panda; lengths are in meters, times
in seconds.
"""

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
"""Name under which an evaluation with several sets of scenes stores the metrics over all sets
together."""

_COLUMNS = (
    Column("name", "method"),
    Column("contacts"),
    Column("avoidable", "avoidable by physics, by view"),
    Column("success_of", "success"),
    Column("claims", "violations of claims A, B"),
    Column("drp", "DRPBench contacts, success"),
    Column("tool_clearance_min", "min. tool clearance [m]", "{:.3f}"),
    Column("duration_median", "median duration [s]", "{:.1f}"),
)
"""Columns of the printed table (key of the values, heading, number format), which has a row for
each kind of scenes and method."""


_LISTED_COUNTS = {
    "stop_reasons": "stopped",
    "contact_pairs": "contact",
    "sources": "executed motion from",
}
"""Key of a metric that counts scenes -> heading of the lines that list the counts below the table.

Scenes are counted for each stop reason, for each pair of bodies in contact, and for each source of
the executed motion (nominal motion, regressor chain, search, or path in joint space)."""


def panda_metrics(results: PandaResults, workers: int | str = 1) -> dict[str, Any]:
    """Returns the metrics of a suite (a set of scenes and methods) as JSON data.

    Keys:

    - suite: name of the evaluation.
    - seed, kind: seed and kind of the scenes, for example "tabletop".
    - perception: source of the obstacles: "depth" (one camera), "depth2" (two cameras) or "truth"
      (exact obstacles).
    - duration: time limit of a run [s], or None.
    - jobs: number of processes.
    - versions: versions of libraries.
    - scenes_digest: SHA-256 of the scenes' seeds, tasks and obstacles, independent of perception.
    - solved: number of scenes in which at least one method succeeds; None if `planner` is not among
      the methods.
    - methods: method -> its metrics by `methods_metrics`, and "perception", the source of the
      obstacles with which the method was run, and "runs", its results scene by scene.

    Args:
        results: results of all runs of the suite.
        workers: number of processes on this machine, which affects real-time factors, or the
            address of a Dask scheduler; "jobs" is then None.
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
    """Returns the metrics of several methods on the same scenes.

    Keys: "solved", the number of scenes in which at least one method succeeds (None if the baseline
    `planner` is not among the methods), and "methods", method -> result of `run_metrics`. Each
    method also has "success_rate_solved", its number of successes divided by "solved" (None if
    "solved" is None or 0).

    Args:
        runs: method -> scene -> result of `run_and_evaluate`.
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
    """Returns the JSON of an evaluation: the metrics of a single kind of scenes, or those of
    several kinds by name.

    Args:
        results: results of each kind's suite.
        metrics: `panda_metrics` of each kind's suite.

    Returns:
        `metrics[0]` for one kind; for several kinds, {"suite": "panda", "kinds": {kind: metrics}}.
    """
    if len(metrics) == 1:
        return metrics[0]
    return {"suite": "panda", "kinds": {of["kind"]: of for of in metrics}}


def run_metrics(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Returns the metrics of the runs of one method; a statistic without values is None.

    Numbers of scenes:

    - scenes: all scenes.
    - contacts, success, stopped: scenes by outcome, which sum to `scenes`. Stopped is any end that
      is neither a contact nor a success.
    - self_contacts: scenes with a contact of the robot with itself.
    - time_limits: runs ended by the time limit.
    - failed: runs that raised an exception.
    - shortfall_count: runs in which the tool's clearance to resting obstacles was more than 1 mm
      below the achievable clearance, the requested one or that at start or goal if less.
    - stop_reasons, contact_pairs, sources: dictionaries from stop reason, pair of bodies in
      contact, or source of a motion that the method `verified` executed ("nominal", "chain",
      "search" or "joint_path"), to number of scenes.
    - drp_contacts, drp_success: outcomes by the rules of the benchmark DRPBench, only in scenes of
      its levels.

    Numbers of contacts:

    - avoidable_by_physics: contacts that a joint motion avoids if it starts 0.2 s before.
    - avoidable_by_view: contacts that a joint motion avoids if it starts 0.05 to 0.5 s before, with
      the obstacle's velocity observed 0.1 to 0.3 s before the latest start of such a motion.

    Numbers of logged instants, None without moving obstacles or observations:

    - claim_A: instants at which the arm violates the claim to rest or recede before a moving
      obstacle can reach it.
    - claim_B: instants at which the arm violates the claim to be slow toward unobserved space.

    Statistics:

    - success_rate: fraction of the scenes with success.
    - duration_median: median duration of the motions [s].
    - decision_latency: "median", "p99" (99th percentile) and "max" of the simulated compute
      latencies of all selections of a motion [s], and "count", the number of latencies.
    - tool_clearance_min, robot_clearance_min: minimum over all scenes of the clearance of the tool
      and of the whole robot to obstacles [m].
    - goal_error_max: maximum goal error in the scenes that were not stopped [m].
    - real_time_factor: median of the simulated time over the wall time.

    Args:
        runs: results of `run_and_evaluate`.
    """
    outcome = Counter(run["outcome"] for run in runs)
    events = [event for run in runs for event in run["contact_events"] or ()]
    claims = [run["claim_violations"] for run in runs if run["claim_violations"]]
    by_drp = Counter(run.get("drp_outcome") for run in runs)
    drp = {"drp_contacts": by_drp["contact"], "drp_success": by_drp["success"]}
    reasons = Counter(run["reason"] for run in runs if run["outcome"] == "stopped")
    # Each pair counts once per scene, without the number of the obstacle.
    pairs = Counter(
        pair
        for run in runs
        for pair in {*run["self_contacts"], *(of.rstrip("0123456789") for of in run["contacts"])}
    )
    latencies = [cost for run in runs for cost in run.get("decision_latencies", ())]
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
        "avoidable_by_physics": sum(event["avoidable_by_physics"] for event in events),
        "avoidable_by_view": sum(event["avoidable_by_view"] for event in events),
        "claim_A": over(sum, (counts["A"] for counts in claims)),
        "claim_B": over(sum, (counts["B"] for counts in claims)),
        "time_limits": sum(run["ended"] == MotionEnd.TIME_LIMIT for run in runs),
        "shortfall_count": sum((run["clearance_shortfall"] or 0.0) > TOLERANCE for run in runs),
        "duration_median": of(np.median, "duration"),
        "decision_latency": latency_statistics(latencies),
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
    """Makes a table of the metrics of one or several kinds of scenes, with a row for each kind and
    method.

    Lines below the table list stop reasons, pairs in contact, sources of the executed motions,
    numbers of solved scenes, and digests of the scenes.

    Args:
        metrics: `panda_metrics` of each kind of scenes.
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
            for key, heading in _LISTED_COUNTS.items():
                for reason, count in method[key].items():
                    unit = f"scene{'s' * (count != 1)}"
                    lines.append(f"{title}: {heading}, {count} {unit}: {reason}")
        if of.get("solved") is not None:
            lines.append(f"{of['kind']}: scenes solved by at least one method: {of['solved']}")
        if "scenes_digest" in of:
            lines.append(f"{of['kind']}: digest of the scenes: {of['scenes_digest'][:12]}")
    return TextTable(_COLUMNS, rows, lines)
