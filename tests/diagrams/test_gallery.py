"""The table of the shipped scenarios tells what a run gives."""

import re
from pathlib import Path
from typing import Any

import pytest

from drake_oa.runs.report import run_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.shipped import shipped_scenarios
from tests.builders import skip_without_model

_DOCS = Path(__file__).parents[2] / "docs"
PAGES = [_DOCS / "results" / "scenarios.md", _DOCS / "guides" / "robot.md"]

# Last words of a header, or of a part of it -> motion, key of its report, and the unit.
FIGURES = {
    "planned": ("preplanned", "collisions", 1.0),
    "ours": ("modulated", "collisions", 1.0),
    "asked": ("modulated", "asked_clearance", 1.0),
    "feasible": ("modulated", "feasible_clearance", 1.0),
    "kept": ("modulated", "tool_clearance_min", 1.0),
    "any link": ("modulated", "robot_clearance_min", 1.0),
    "goal error": ("modulated", "goal_error", 1e-3),
    "duration": ("modulated", "duration", 1.0),
}


def gallery() -> dict[str, dict[str, str]]:
    """Scenario -> figure -> its number as its page has it."""
    found = {}
    for page in PAGES:
        tables = re.findall(r"(?:^\|.*\n)+", page.read_text("utf-8"), re.MULTILINE)
        (table,) = (table for table in tables if "| scenario |" in table.splitlines()[0])
        head, _, *rows = (
            [cell.strip() for cell in line[1:-1].split("|")] for line in table.split("\n")[:-1]
        )
        for row in (dict(zip(head, cells, strict=True)) for cells in rows):
            name = re.findall(r"\[`(\w+)`\]", row["scenario"])[0]
            found[name] = {
                key: text for title, cell in row.items() for key, text in numbers(title, cell)
            }
    return found


def numbers(title: str, cell: str) -> list[tuple[str, str]]:
    """Figures of a cell "2 / 0" under a title like "contacts: planned / ours"; of others none."""
    keys = [next(filter(part.endswith, FIGURES), "") for part in title.split(" / ")]
    return list(zip(keys, re.findall(r"-?[\d.]+", cell), strict=True)) if all(keys) else []


def differs(written: str, value: float) -> bool:
    """By more than one in the last digit, as another processor may round it; counts: at all."""
    decimals = len(written.partition(".")[2])
    return abs(float(written) - value) > (1.001 * 10.0**-decimals if decimals else 0.0)


def test_every_scenario_of_a_robot_has_its_row() -> None:
    rows = gallery()
    assert set(rows) == set(shipped_scenarios()) - {"free_space"}
    for figures in rows.values():
        assert figures.keys() >= {"planned", "ours", "asked", "kept", "goal error"}


@pytest.mark.slow
@pytest.mark.parametrize("name", gallery())
def test_a_run_gives_what_its_row_says(name: str) -> None:
    skip_without_model(name)
    scenario = load_scenario(name)
    logs = {m: simulate(scenario, modulated=m == "modulated") for m in ("preplanned", "modulated")}
    report: dict[str, Any] = run_report(name, scenario, logs)
    stale = []
    for figure, written in gallery()[name].items():
        motion, key, unit = FIGURES[figure]
        value = report[motion][key] / unit
        if differs(written, value):
            stale.append(f"{figure} is {value:.6g}, the page has {written}")
    assert not stale, f"{name}: {'; '.join(stale)}"
