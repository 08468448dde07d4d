"""Tests of the paper's Tables I to III: metrics, and published values beside them."""

import json
from pathlib import Path
from typing import Any

import pytest

from drake_oa.app.main import main
from drake_oa.evaluation.panda.evaluation import with_method
from drake_oa.evaluation.paper_tables import (
    TABLE_THREE,
    TABLE_TWO,
    TRIAL_KINDS,
    agrees,
    evaluate_novel,
    table_one,
    table_one_metrics,
    table_three,
    table_two,
    table_two_metrics,
    trial_metrics,
    trial_text,
)
from drake_oa.evaluation.scenes.suites import draw_scenes
from drake_oa.inference.regressor import TARGETS
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text


def test_shipped_chains_reach_the_published_errors() -> None:
    whole = table_one_metrics()
    chains = whole["chains"]
    assert list(chains) == ["paper_chain", "paper_chain_unconstrained", "paper_chain_running"]
    for file in ("paper_chain", "paper_chain_unconstrained"):
        for target in TARGETS:
            network = chains[file]["networks"][target]
            for part in ("train", "test"):
                published = network[f"{part}_published"]
                # Within 2 % of the published value, or better.
                assert network[part] < 1.02 * published
                assert network[part] == pytest.approx(published, rel=0.02) or target == "alpha"
    assert "train_published" not in chains["paper_chain_running"]["networks"]["kappa"]
    tables = table_one(whole)
    assert [table.columns[0].heading for table in tables] == list(chains)
    kappa = ["kappa", "0.54", "0.539", "0.541", "0.543", "0.54", "1,218,714"]
    assert str(tables[1]).splitlines()[1].split() == kappa
    assert "published" not in str(tables[2])


@pytest.mark.parametrize(
    ("changes", "misses"),
    [
        ({}, set()),
        ({"clearance_mean": 0.195, "clearance_min": 0.02}, {"clearance_mean", "clearance_min"}),
        ({"goal_error_mean": 1e-3, "goal_error_max": 8e-3}, {"goal_error_mean", "goal_error_max"}),
        ({"collisions": 4}, {"collisions"}),
        ({"scenes": 0}, set(TABLE_TWO[1.0])),
    ],
)
def test_metrics_agree_within_their_tolerances(changes: dict[str, Any], misses: set[str]) -> None:
    metrics = agrees({"scenes": 5, **TABLE_TWO[1.0], **changes}, TABLE_TWO[1.0])
    assert {key for key, same in metrics.items() if not same} == misses


def test_paper_method_reproduces_table_two_approximately() -> None:
    scenes = draw_scenes("demo", 240, seed=1)
    whole = table_two_metrics(evaluate_novel(scenes), scenes, 1)
    for part, published in zip(whole["by_baseline"], TABLE_TWO.values(), strict=True):
        assert part["scenes"] == 60
        assert part["collisions"] == 0
        assert part["clearance_mean"] == pytest.approx(published["clearance_mean"], abs=0.02)
        assert 0.3 < part["goal_error_mean"] / published["goal_error_mean"] < 4.0
    assert whole["cells"] >= 8
    assert 0.1 < whole["line_collision_rate"] < 0.35
    assert f"{whole['cells']} of 20" in str(table_two(whole))


def run(clearance: float | None, goal_error: float, *contacts: str) -> dict[str, Any]:
    """Returns the result of a trial, as of `run_and_evaluate`."""
    return {
        "tool_clearance_min": clearance,
        "requested_clearance": 0.15,
        "goal_error": goal_error,
        "duration": 6.0,
        "contacts": list(contacts),
    }


def test_trial_metrics_have_published_values_beside_them() -> None:
    runs = {
        0: run(0.16, 1e-3),
        1: run(0.14, 3e-3),
        2: run(-0.01, 0.5, "panda_hand - obstacle_box", "panda_link6 - obstacle_box"),
        3: run(None, 0.9),
    }
    metrics = trial_metrics(runs, TABLE_THREE["box", "paper"])
    assert (metrics["trials"], metrics["obstacles_touched"]) == (4, 1)
    assert metrics["shortfall_count"] == 2
    assert metrics["clearance_mean"] == pytest.approx(0.29 / 3)
    assert (metrics["clearance_min"], metrics["goal_error_max"]) == (-0.01, 0.5)
    assert (metrics["clearance_published"], metrics["goal_error_published"]) == (0.168, 9.58e-3)
    assert trial_metrics({0: run(None, 0.9)}, None)["clearance_mean"] is None


@pytest.mark.parametrize("kind", TRIAL_KINDS)
def test_trial_is_the_shipped_scenario_with_its_seed(kind: str) -> None:
    text = trial_text(f"paper_{kind}", 7)
    assert text == scenario_text(load_scenario(f"paper_{kind}", ["seed=7"]))
    # The scenario already has the inference of the method `paper`.
    assert scenario_text(with_method(parse_scenario(text), "paper")) == text


def test_command_prints_and_writes_the_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "table3.json"
    options = ["--trials", "1", "--perception", "truth", "--method", "paper", "--duration", "0.02"]
    assert main(["evaluate", "table3", *options, "--json", str(file), "--jobs", "1"]) == 0
    output = capsys.readouterr().out
    whole = json.loads(file.read_text())
    assert list(whole["rows"]) == list(TRIAL_KINDS)
    assert str(table_three(whole)) in output
