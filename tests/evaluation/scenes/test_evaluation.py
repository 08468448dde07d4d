"""Tests of metrics and tables of an evaluation."""

import numpy as np
import pytest

from drake_oa.evaluation.scenes import evaluation
from drake_oa.evaluation.scenes.ground_truth import GroundTruthResult
from drake_oa.evaluation.scenes.paper_method import BETA, run_original
from drake_oa.evaluation.scenes.suites import SUITES, draw_scenes
from drake_oa.policy.coupling import dead_zone_free_rate, original_rate

NOVEL = SUITES["novel"].settings


def test_metrics_and_tables_are_of_each_baseline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(evaluation, "BATCH", 15)
    outcome = evaluation.evaluate("original", run_original, draw_scenes("novel", 40), NOVEL)
    metrics = evaluation.evaluation_metrics("novel", 0, NOVEL, {"original": outcome})
    statistics = metrics["methods"]["original"]
    assert statistics["scenes"] == 40
    assert [row["scenes"] for row in statistics["by_baseline"]] == [10, 10, 10, 10]
    lines = "\n".join(map(str, evaluation.evaluation_tables(metrics))).splitlines()
    assert sum(line.startswith("goal at") for line in lines) == 4


def test_motion_statistics_of_known_results() -> None:
    results = GroundTruthResult(
        min_clearance=np.array([0.15, 0.1495, 0.1485, 0.06, 0.0, -0.02, np.inf]),
        achievable_clearance=np.array([0.15, 0.15, 0.15, 0.06, 0.15, 0.15, 0.15]),
        goal_error=np.array([0.0, 0.0, 0.0, 0.002, 0.0, 0.0, 0.0]),
        path_ratio=np.array([1.0, 1.0, 1.0, 1.0, 1.5, 1.0, 1.0]),
        baseline=np.ones(7),
        requested=np.full(7, 0.15),
    )
    expected = {
        "scenes": 7,
        "collisions": 2,
        "shortfall_count": 3,
        "clearance_min": -0.02,
        "clearance_mean": 0.488 / 6,
        "clearance_mean_achievable": 0.428 / 5,
        "goal_error_max": 0.002,
        "path_ratio_mean": 7.5 / 7,
    }
    metrics = evaluation.motion_statistics(results)
    assert {key: metrics[key] for key in expected} == pytest.approx(expected)


@pytest.mark.parametrize("gamma", [1.0, 1000.0])
def test_matched_terms_have_equal_peak_and_area(gamma: float) -> None:
    alpha, psi = evaluation.matched_term(gamma)
    theta = np.linspace(0.0, 6.0, 600_001)
    original = original_rate(theta, gamma, BETA)
    free = dead_zone_free_rate(theta, 0.0, alpha, psi, 0.0)
    assert original.max() == pytest.approx(free.max(), rel=1e-6)
    assert original.sum() == pytest.approx(free.sum(), rel=1e-4)


def test_only_the_dead_zone_free_term_avoids_a_head_on_obstacle(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(evaluation, "GAMMAS", (30.0, 1000.0))
    rows = evaluation.compare_terms(draw_scenes("dead-zone", 9))
    for row in rows:
        # Straight through the center of the sphere of 2.5 cm.
        assert row["original_head_on"] == pytest.approx(-0.025, abs=1e-6)
        assert row["dead_zone_free_head_on"] > row["original_head_on"] + 0.01
    assert rows[1]["dead_zone_free_head_on"] > 0.03
    assert rows[1]["original_collisions"] == 1
    assert rows[1]["dead_zone_free_collisions"] == 0
    assert len(evaluation.term_table(rows).rows) == 2
