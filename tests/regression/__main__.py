"""Command line of the regression checks; see the package's docstring."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from drake_oa.common.files import software_versions
from drake_oa.evaluation.results import Task, resumed
from tests.regression import comparison, runs

_HERE = Path(__file__).parent
"""Folder of the stored results."""
_RESULTS = Path("build/regression")
"""Folder of completed runs, from which an interrupted check resumes."""
_JOBS = 2
"""Default number of worker processes."""


def main() -> int:
    """Runs a set of checks; returns 1 if one fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.regression", description=__doc__)
    parser.add_argument("checks", choices=("scenarios", "suites"))
    parser.add_argument("--write", action="store_true", help="replace the stored results")
    parser.add_argument("--jobs", type=int, default=_JOBS, help="worker processes")
    options = parser.parse_args()
    if options.write and options.checks == "suites" and not runs.ARCHIVE.is_file():
        parser.error(f"--write needs the MotionBenchMaker problems in {runs.ARCHIVE}")
    if options.checks == "scenarios":
        result_sets = {"scenarios": _results(runs.scenario_calls(), options.jobs)}
    else:
        result_sets = {
            "suites": _results(runs.suite_calls(), options.jobs),
            "points": _results(runs.point_calls(), options.jobs),
            "tables": _results(runs.table_calls(), options.jobs),
        }
    if options.write:
        for name, results in result_sets.items():
            _write(name, results)
        return 0
    failures = [text for name, results in result_sets.items() for text in _compare(name, results)]
    for text in failures:
        print(f"FAILED {text}")
    print(f"{len(failures)} failed, {sum(map(len, result_sets.values()))} results compared")
    return 1 if failures else 0


def _results(calls: Mapping[str, runs.Call], jobs: int) -> dict[str, Any]:
    """Returns name -> result of calls, and carries out those without a result of this source."""
    tasks = {
        name: Task(name.replace("/", "-"), partial(runs.carry_out_call, *call))
        for name, call in calls.items()
    }
    results, _ = resumed(tasks, _RESULTS, jobs)
    return dict(sorted(results.items()))


def _compare(name: str, results: dict[str, Any]) -> list[str]:
    """Prints each changed result of a set and returns messages of the failures."""
    stored = json.loads((_HERE / f"{name}.json").read_text())["results"]
    if name == "tables":
        return list(comparison.metric_failures(stored, results, "tables"))
    if name == "points":
        stored, results = _expand(stored), _expand(results)
    if name == "suites" and not runs.ARCHIVE.is_file():
        print("skipped: the archive of MotionBenchMaker problems is not available")
        stored = {key: run for key, run in stored.items() if not key.startswith("mbm-")}
    for text in comparison.changes(stored, results):
        print(f"changed {text}")
    if name == "scenarios":
        # Without the package of a robot's model, its scenarios are not compared.
        installed = {key.partition("/")[0] for key in results}
        stored = {key: run for key, run in stored.items() if key.partition("/")[0] in installed}
        return list(comparison.scenario_failures(stored, results))
    return [f"{name}: {text}" for text in comparison.suite_failures(stored, results)]


def _expand(results: Mapping[str, Mapping[str, list[Any]]]) -> dict[str, dict[str, Any]]:
    """Converts lists over scenes to one result per scene."""
    return {
        f"{name}/{number}": {
            **dict(zip(columns, row, strict=True)),
            "contacts": ["ellipsoid"] if row[list(columns).index("collided")] else [],
        }
        for name, columns in results.items()
        for number, row in enumerate(zip(*columns.values(), strict=True))
    }


def _write(name: str, results: Mapping[str, Any]) -> None:
    """Replaces the stored results of a set, one result per line."""
    head = {"versions": software_versions()}
    lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in results.items())
    text = f'{json.dumps(head)[:-1]}, "results": {{\n{lines}\n}}}}\n'
    (_HERE / f"{name}.json").write_text(text)


if __name__ == "__main__":
    sys.exit(main())
