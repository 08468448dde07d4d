"""Command line of the regression checks; see the package."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

from drake_oa.common.files import software_versions, source_digest
from drake_oa.evaluation.results import Task, resumed
from tests.regression import comparison, runs

_HERE = Path(__file__).parent
_RESULTS = Path("build/regression")
"""Folder of finished runs: an interrupted check continues from them."""
_JOBS = 2
"""Worker processes."""


def main() -> int:
    """Runs a set of checks; returns 1 if one fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.regression", description=__doc__)
    parser.add_argument("checks", choices=("scenarios", "suites"))
    parser.add_argument("--write", action="store_true", help="replace the stored results")
    parser.add_argument("--jobs", type=int, default=_JOBS, help="worker processes")
    options = parser.parse_args()
    if options.checks == "scenarios":
        found = {"scenarios": _results(runs.scenario_calls(), options.jobs)}
    else:
        found = {
            "suites": _results(runs.suite_calls(), options.jobs),
            "points": _results(runs.point_calls(), options.jobs),
            "tables": _results(runs.table_calls(), options.jobs),
        }
    if options.write:
        for name, results in found.items():
            _write(name, results)
        return 0
    failures = [text for name, results in found.items() for text in _compared(name, results)]
    for text in failures:
        print(f"FAILED {text}")
    print(f"{len(failures)} failed, {sum(map(len, found.values()))} results compared")
    return 1 if failures else 0


def _results(calls: Mapping[str, runs.Call], jobs: int) -> dict[str, Any]:
    """Carries out the calls that have no result of the present source yet."""
    tasks = {
        name: Task(name.replace("/", "-"), partial(runs.carry_out_call, *call))
        for name, call in calls.items()
    }
    results, _ = resumed(tasks, _RESULTS, jobs)
    return dict(sorted(results.items()))


def _compared(name: str, results: dict[str, Any]) -> list[str]:
    """Prints each changed result of a set; returns what fails."""
    stored = json.loads((_HERE / f"{name}.json").read_text())["results"]
    if name == "tables":
        return list(comparison.figure_failures(stored, results, "tables"))
    if name == "points":
        stored, results = _expanded(stored), _expanded(results)
    if name == "suites" and not runs.ARCHIVE.is_file():
        print("skipped: the problems of MotionBenchMaker are not here")
        stored = {key: run for key, run in stored.items() if not key.startswith("mbm-")}
    for text in comparison.changes(stored, results):
        print(f"changed {text}")
    if name == "scenarios":
        # Scenarios of robots whose package is not installed are left out.
        there = {key.partition("/")[0] for key in results}
        stored = {key: run for key, run in stored.items() if key.partition("/")[0] in there}
        return list(comparison.scenario_failures(stored, results))
    return [f"{name}: {text}" for text in comparison.suite_failures(stored, results)]


def _expanded(results: Mapping[str, Mapping[str, list[Any]]]) -> dict[str, dict[str, Any]]:
    """Results by scene in place of lists over scenes."""
    return {
        f"{name}/{number}": {
            **dict(zip(columns, row, strict=True)),
            "contacts": ["ellipsoid"] if row[list(columns).index("collided")] else [],
        }
        for name, columns in results.items()
        for number, row in enumerate(zip(*columns.values(), strict=True))
    }


def _write(name: str, results: Mapping[str, Any]) -> None:
    """Replaces the stored results of a set, one line a result."""
    head = {
        "date": f"{datetime.now(UTC):%Y-%m-%d}",
        "source_digest": source_digest(),
        "versions": software_versions(),
    }
    lines = ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in results.items())
    text = f'{json.dumps(head)[:-1]}, "results": {{\n{lines}\n}}}}\n'
    (_HERE / f"{name}.json").write_text(text)


if __name__ == "__main__":
    sys.exit(main())
