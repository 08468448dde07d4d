"""Comparison of results with stored results, run by run."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from scipy.stats import binomtest

CLEARANCE_TOLERANCE = 2e-3
"""Maximum accepted decrease of a minimum clearance [m]."""
DURATION_TOLERANCE = 0.03
"""Maximum accepted increase of a duration, as a fraction."""
SIGNIFICANCE = 0.05
"""Significance level of the test on lost successes."""
MAX_GAINED_CONTACTS = 1
"""Maximum accepted number of scenes of all suites that gain a contact."""
METRIC_TOLERANCE = 1e-6
"""Maximum accepted relative difference of a metric in a table."""
ERROR_TOLERANCE = 0.01
"""Maximum accepted relative difference of a goal error in Table II.

BLAS rounds the chain's outputs depending on the memory alignment of arrays, and motions near an
obstacle's center amplify the difference: means of two runs of one version differ by 0.3 %.
"""

Run = Mapping[str, Any]
"""Result of a run: quantity -> value."""
Runs = Mapping[str, Run]
"""Name of a run -> its result."""


def new_contacts(stored: Run, run: Run) -> list[str]:
    """Returns the pairs in contact that are not in contact in the stored run."""
    return sorted(set(run["contacts"]) - set(stored["contacts"]))


def run_failures(stored: Run, run: Run) -> Iterator[str]:
    """Yields a message for each quantity of a scenario's run that is worse than the stored one."""
    if pairs := new_contacts(stored, run):
        yield f"new contact: {', '.join(pairs)}"
    if run["ended"] != stored["ended"]:
        yield f"termination: {stored['ended']} -> {run['ended']}"
    for key in ("tool_clearance_min", "robot_clearance_min"):
        before, after = stored[key], run[key]
        if before is not None and (after is None or after < before - CLEARANCE_TOLERANCE):
            yield f"{key}: {before} -> {after} m"
    if run["duration"] > stored["duration"] * (1.0 + DURATION_TOLERANCE):
        yield f"duration: {stored['duration']} -> {run['duration']} s"


def missing_runs(stored: Runs, runs: Runs) -> Iterator[str]:
    """Yields a message for each run without a stored result, and each stored one without a run."""
    for name in sorted(stored.keys() ^ runs.keys()):
        yield f"{name}: {'no run' if name in stored else 'no stored result'}"


def scenario_failures(stored: Runs, runs: Runs) -> Iterator[str]:
    """Yields the messages of `run_failures` for all runs, and of `missing_runs`."""
    yield from missing_runs(stored, runs)
    for name in sorted(stored.keys() & runs.keys()):
        yield from (f"{name}: {text}" for text in run_failures(stored[name], runs[name]))


def changes(stored: Runs, runs: Runs) -> Iterator[str]:
    """Yields a line for each run whose result differs from the stored one."""
    for name in sorted(stored.keys() & runs.keys()):
        before, after = stored[name], runs[name]
        keys = [key for key in after if before.get(key) != after[key]]
        if keys:
            yield f"{name}: " + ", ".join(f"{k} {before.get(k)} -> {after[k]}" for k in keys)


def suite_failures(stored: Runs, runs: Runs) -> Iterator[str]:
    """Yields a message for each statistic of a suite that is worse than the stored one.

    A suite is worse if lost successes exceed gained ones in a one-sided exact McNemar test, or if
    more than `MAX_GAINED_CONTACTS` scenes gain a contact.
    """
    yield from missing_runs(stored, runs)
    shared = sorted(stored.keys() & runs.keys())
    lost = [n for n in shared if stored[n]["success"] and not runs[n]["success"]]
    gained = [n for n in shared if runs[n]["success"] and not stored[n]["success"]]
    if lost:
        p = binomtest(len(lost), len(lost) + len(gained), alternative="greater").pvalue
        if p < SIGNIFICANCE:
            yield f"{len(lost)} successes lost, {len(gained)} gained: p = {p:.3g}"
    touched = [n for n in shared if runs[n]["contacts"] and not stored[n]["contacts"]]
    if len(touched) > MAX_GAINED_CONTACTS:
        yield f"{len(touched)} scenes gained a contact: {', '.join(touched)}"


def metric_failures(stored: Any, metrics: Any, path: str = "") -> Iterator[str]:
    """Yields a message for each metric of nested tables that differs by more than its tolerance."""
    if isinstance(stored, dict) and isinstance(metrics, dict):
        for key in sorted(stored.keys() | metrics.keys()):
            yield from metric_failures(stored.get(key), metrics.get(key), f"{path}/{key}")
    elif isinstance(stored, list) and isinstance(metrics, list) and len(stored) == len(metrics):
        for place, (before, after) in enumerate(zip(stored, metrics, strict=True)):
            yield from metric_failures(before, after, f"{path}/{place}")
    elif isinstance(stored, float) and isinstance(metrics, (int, float)):
        is_error = path.endswith(("goal_error_mean", "goal_error_max"))
        tolerance = ERROR_TOLERANCE if is_error else METRIC_TOLERANCE
        if abs(metrics - stored) > tolerance * max(abs(stored), 1e-3):
            yield f"{path}: {stored} -> {metrics}"
    elif stored != metrics:
        yield f"{path}: {stored} -> {metrics}"
