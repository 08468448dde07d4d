"""Table III of the paper: trials, their figures, and the print beside them."""

import json
from pathlib import Path
from typing import Any

import pytest

from drake_oa.app.main import main
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.studies.panda.evaluation import with_method
from drake_oa.studies.paper_tables import (
    TABLE_THREE,
    TRIAL_KINDS,
    table_three,
    trial_figures,
    trial_text,
)


def run(clearance: float | None, goal_error: float, *contacts: str) -> dict[str, Any]:
    return {
        "tool_clearance_min": clearance,
        "asked_clearance": 0.15,
        "goal_error": goal_error,
        "duration": 6.0,
        "contacts": list(contacts),
    }


def test_a_row_is_taken_over_its_trials_and_has_the_print_beside_it() -> None:
    runs = {
        0: run(0.16, 1e-3),
        1: run(0.14, 3e-3),
        2: run(-0.01, 0.5, "panda_hand - obstacle_box", "panda_link6 - obstacle_box"),
        3: run(None, 0.9),
    }
    found = trial_figures(runs, TABLE_THREE["box", "paper"])
    assert (found["trials"], found["obstacles_touched"], found["trials_short"]) == (4, 1, 2)
    assert found["clearance_mean"] == pytest.approx(0.29 / 3)
    assert (found["clearance_min"], found["goal_error_max"]) == (-0.01, 0.5)
    assert (found["clearance_printed"], found["goal_error_printed"]) == (0.168, 9.58e-3)
    assert trial_figures({0: run(None, 0.9)}, None)["clearance_mean"] is None


@pytest.mark.parametrize("kind", TRIAL_KINDS)
def test_a_trial_is_the_shipped_scenario_with_the_noise_of_its_seed(kind: str) -> None:
    text = trial_text(f"paper_{kind}", 7)
    assert text == scenario_text(load_scenario(f"paper_{kind}", ["seed=7"]))
    # The method of the suites is what the scenario has.
    assert scenario_text(with_method(parse_scenario(text), "paper")) == text


def test_the_command_prints_the_table_and_writes_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "table3.json"
    given = ["--trials", "1", "--perception", "truth", "--method", "paper", "--duration", "0.02"]
    assert main(["evaluate", "table3", *given, "--json", str(file), "--jobs", "1"]) == 0
    told = capsys.readouterr().out
    whole = json.loads(file.read_text())
    assert list(whole["rows"]) == list(TRIAL_KINDS)
    assert str(table_three(whole)) in told
