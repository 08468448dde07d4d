"""The tables of the shipped scenarios have the figures of `make regression`."""

import json
import re
from pathlib import Path

from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.shipped import shipped_scenarios

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "docs" / "results" / "scenarios.md", ROOT / "docs" / "guides" / "robot.md"]
RESULTS = ROOT / "tests" / "regression" / "scenarios.json"

# Last words of a header, or of a part of it -> key of the result, and the unit.
FIGURES = {
    "planned": ("", 1.0),
    "ours": ("contacts", 1.0),
    "asked": ("requested_clearance", 1.0),
    "kept": ("tool_clearance_min", 1.0),
    "any link": ("robot_clearance_min", 1.0),
    "goal error": ("goal_error", 1e-3),
    "duration": ("duration", 1.0),
}


def gallery() -> dict[str, dict[str, str]]:
    """Scenario -> figure -> its number as its page has it."""
    found = {}
    for page in PAGES:
        tables = re.findall(r"(?:^\|.*\n)+", page.read_text("utf-8"), re.MULTILINE)
        (table,) = (table for table in tables if "| scenario |" in table.splitlines()[0])
        head, _, *rows = (
            [station.strip() for station in line[1:-1].split("|")]
            for line in table.split("\n")[:-1]
        )
        for row in (dict(zip(head, cells, strict=True)) for cells in rows):
            name = re.findall(r"\[`(\w+)`\]", row["scenario"])[0]
            found[name] = {
                key: text for title, station in row.items() for key, text in numbers(title, station)
            }
    return found


def numbers(title: str, station: str) -> list[tuple[str, str]]:
    """Figures of a cell "2 / 0" under a title like "contacts: planned / ours"; of others none."""
    keys = [next(filter(part.endswith, FIGURES), "") for part in title.split(" / ")]
    return list(zip(keys, re.findall(r"-?[\d.]+", station), strict=True)) if all(keys) else []


def differs(written: str, value: float) -> bool:
    """By more than one in the last digit, as another processor may round it; counts: at all."""
    decimals = len(written.partition(".")[2])
    return abs(float(written) - value) > (1.001 * 10.0**-decimals if decimals else 0.0)


def test_every_scenario_of_a_robot_has_a_row_with_its_figures() -> None:
    rows = gallery()
    assert set(rows) == set(shipped_scenarios()) - {"free_space"}
    results = json.loads(RESULTS.read_text())["results"]
    stale = []
    for name, metrics in rows.items():
        assert metrics.keys() >= FIGURES.keys()
        run = results[f"{name}/seed0"]
        requested = load_scenario(name).task.clearance
        run |= {"contacts": len(run["contacts"]), "requested_clearance": requested}
        for figure, (key, unit) in FIGURES.items():
            if key and differs(metrics[figure], run[key] / unit):
                stale.append(f"{name}: {figure} is {run[key] / unit:.6g}, not {metrics[figure]}")
    assert not stale
