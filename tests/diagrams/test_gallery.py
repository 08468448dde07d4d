"""Tests that the tables of shipped scenarios have the metrics of `make regression`."""

import json
import re
from pathlib import Path

from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.shipped import shipped_scenarios

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "docs" / "results" / "scenarios.md", ROOT / "docs" / "guides" / "robot.md"]
RESULTS = ROOT / "tests" / "regression" / "scenarios.json"

METRICS = {
    "nominal": ("", 1.0),
    "avoiding": ("contacts", 1.0),
    "requested": ("requested_clearance", 1.0),
    "tool min. clearance": ("tool_clearance_min", 1.0),
    "arm min. clearance": ("robot_clearance_min", 1.0),
    "goal error": ("goal_error", 1e-3),
    "duration": ("duration", 1.0),
}
"""Last words of a column's title, or of a part of it -> key of the result, and the table's unit."""


def gallery() -> dict[str, dict[str, str]]:
    """Returns scenario -> metric -> number as written in its table."""
    rows = {}
    for page in PAGES:
        tables = re.findall(r"(?:^\|.*\n)+", page.read_text("utf-8"), re.MULTILINE)
        (table,) = (table for table in tables if "| scenario |" in table.splitlines()[0])
        head, _, *lines = (
            [cell.strip() for cell in line[1:-1].split("|")] for line in table.split("\n")[:-1]
        )
        for row in (dict(zip(head, cells, strict=True)) for cells in lines):
            name = re.findall(r"\[`(\w+)`\]", row["scenario"])[0]
            rows[name] = {
                key: text for title, cell in row.items() for key, text in numbers(title, cell)
            }
    return rows


def numbers(title: str, cell: str) -> list[tuple[str, str]]:
    """Returns the metrics of a cell, for example "2 / 0" of "collisions: nominal / avoiding"."""
    parts = re.sub(r" \[\w+\]$", "", title).split(" / ")
    keys = [next(filter(part.endswith, METRICS), "") for part in parts]
    return list(zip(keys, re.findall(r"-?[\d.]+", cell), strict=True)) if all(keys) else []


def differs(written: str, value: float) -> bool:
    """Checks whether a number differs by more than one in its last digit, a count by any amount.

    Other processors may round the last digit differently.
    """
    decimals = len(written.partition(".")[2])
    return abs(float(written) - value) > (1.001 * 10.0**-decimals if decimals else 0.0)


def test_table_has_the_metrics_of_every_scenario_with_a_robot() -> None:
    rows = gallery()
    assert set(rows) == set(shipped_scenarios()) - {"free_space"}
    results = json.loads(RESULTS.read_text())["results"]
    stale = []
    for name, row in rows.items():
        assert row.keys() >= METRICS.keys()
        run = results[f"{name}/seed0"]
        requested = load_scenario(name).task.clearance
        run |= {"contacts": len(run["contacts"]), "requested_clearance": requested}
        for metric, (key, unit) in METRICS.items():
            if key and differs(row[metric], run[key] / unit):
                stale.append(f"{name}: {metric} is {run[key] / unit:.6g}, not {row[metric]}")
    assert not stale
