"""Batches, failures, figures and tables of an evaluation, on a method known by heart."""

from collections.abc import Callable

import numpy as np
import pytest

from drake_oa.policy.coupling import dead_zone_free_rate, original_rate
from drake_oa.studies.scenes.evaluation import (
    compare_terms,
    evaluate,
    evaluation_figures,
    evaluation_tables,
    matched_term,
    method_figures,
    motion_figures,
    term_figures,
    term_table,
)
from drake_oa.studies.scenes.judge import Judgement
from drake_oa.studies.scenes.paper_method import BETA
from drake_oa.studies.scenes.scenes import Motions, Scenes, Setting
from drake_oa.studies.scenes.suites import SUITES, draw_scenes, find_suite

Method = Callable[[Scenes, Setting], Motions]
AGREED = {
    "scenes",
    "collisions",
    "clearance_mean",
    "clearance_min",
    "short_of_feasible",
    "goal_error_mean",
    "goal_error_max",
    "path_ratio_mean",
    "step_us",
    "seconds",
}
NOVEL = SUITES["novel"].cases


class Failing:
    """Runs a few batches, then raises."""

    def __init__(self, straight: Method, batches: int, error: BaseException) -> None:
        self.straight, self.left, self.error = straight, batches, error

    def __call__(self, scenes: Scenes, setting: Setting) -> Motions:
        self.left -= 1
        if self.left < 0:
            raise self.error
        return self.straight(scenes, setting)


def test_batches_do_not_matter(straight: Method) -> None:
    scenes = draw_scenes("novel", 50)
    seen: list[int] = []
    whole = evaluate(scenes, NOVEL, {"straight": straight}).outcomes["straight"]
    parts = evaluate(
        scenes,
        NOVEL,
        {"straight": straight},
        batch=7,
        on_progress=lambda name, count: seen.append(count),
    ).outcomes["straight"]
    assert np.array_equal(whole.of().kept_clearance, parts.of().kept_clearance)
    assert sum(seen) == 50
    assert whole.complete
    figures = method_figures(parts, NOVEL)
    assert set(figures) > AGREED
    assert figures["scenes"] == 50
    assert figures["step_us"] == pytest.approx(1.0)
    assert [row["scenes"] for row in figures["by_baseline"]] == [13, 13, 12, 12]


def test_a_failure_keeps_what_was_judged_and_the_other_methods(straight: Method) -> None:
    scenes, error = draw_scenes("novel", 40), MemoryError("full")
    told: list[list[str]] = []
    evaluation = evaluate(
        scenes,
        NOVEL,
        {"failing": Failing(straight, 2, error), "straight": straight},
        batch=10,
        on_method=lambda outcomes: told.append(list(outcomes)),
    )
    assert not evaluation.interrupted
    assert told == [["failing"], ["failing", "straight"]]
    failed = method_figures(evaluation.outcomes["failing"], NOVEL)
    assert failed["complete"] is False
    assert failed["scenes"] == 20
    assert str(error) in failed["error"]
    assert evaluation.outcomes["straight"].complete


def test_an_interruption_keeps_what_was_judged(straight: Method) -> None:
    evaluation = evaluate(
        draw_scenes("novel", 40),
        NOVEL,
        {"one": Failing(straight, 3, KeyboardInterrupt()), "two": straight},
        batch=10,
    )
    assert evaluation.interrupted
    assert list(evaluation.outcomes) == ["one"]
    assert len(evaluation.outcomes["one"].of()) == 30
    assert not evaluation.outcomes["one"].complete


def test_familiar_has_every_setting_and_counts_those_that_ask(straight: Method) -> None:
    cases = find_suite("familiar").cases
    told: list[tuple[float, bool, bool]] = []

    def method(scenes: Scenes, setting: Setting) -> Motions:
        told.append((float(scenes.clearance[0]), setting.constrained, setting.scale_time))
        return straight(scenes, setting)

    outcome = evaluate(draw_scenes("familiar", 9), cases, {"m": method}).outcomes["m"]
    figures = method_figures(outcome, cases)
    assert len(set(told)) == 12
    assert len(figures["settings"]) == 12
    assert figures["scenes"] == 45
    assert len(figures["covers"]) == 5
    assert {row["scenes"] for row in figures["settings"].values()} == {9}


def judgement(**changes: float) -> Judgement:
    values = {
        "kept_clearance": 0.15,
        "feasible": 0.15,
        "goal_error": 0.0,
        "path_length": 1.0,
        "baseline": 1.0,
        "asked": 0.15,
        "duration": 3.0,
        "out_of_range": 0.0,
    }
    return Judgement(**{name: np.array([value]) for name, value in (values | changes).items()})


def test_figures_count_what_they_say() -> None:
    figures = motion_figures(
        Judgement.joined(
            [
                judgement(),
                judgement(kept_clearance=0.1495),
                judgement(kept_clearance=0.1485),
                judgement(kept_clearance=0.06, feasible=0.06, goal_error=0.002),
                judgement(kept_clearance=0.0, path_length=1.5),
                judgement(kept_clearance=-0.02),
                judgement(kept_clearance=np.inf),
            ]
        )
    )
    assert figures["scenes"] == 7
    assert figures["collisions"] == 2
    assert figures["short_of_feasible"] == 3
    assert figures["clearance_min"] == -0.02
    assert figures["clearance_mean"] == pytest.approx(0.488 / 6)
    assert figures["delta_feasible"] == 5
    assert figures["clearance_mean_feasible"] == pytest.approx(0.428 / 5)
    assert figures["short_worst"] == pytest.approx(0.17)
    assert figures["goal_missed"] == 1
    assert figures["goal_error_max"] == 0.002
    assert figures["path_ratio_mean"] == pytest.approx(7.5 / 7)


def test_the_table_sets_methods_side_by_side_and_baselines_below(straight: Method) -> None:
    scenes = draw_scenes("novel", 8)
    methods = {"one": straight, "two": Failing(straight, 0, ValueError("no"))}
    outcomes = evaluate(scenes, NOVEL, methods).outcomes
    figures = evaluation_figures("novel", 0, ("drake_oa 0.1.0", "date today"), NOVEL, outcomes)
    assert set(figures) == {"suite", "seed", "versions", "methods"}
    assert figures["versions"] == {"drake_oa": "0.1.0", "date": "today"}
    lines = "\n".join(map(str, evaluation_tables(figures))).splitlines()
    assert [line.split()[0] for line in lines[:3]] == ["method", "one", "two"]
    assert "(not complete)" in lines[2]
    assert sum(line.startswith("goal at") for line in lines) == 4


@pytest.mark.parametrize("gamma", [1.0, 1000.0])
def test_matched_terms_have_one_peak_and_one_area(gamma: float) -> None:
    alpha, psi = matched_term(gamma)
    theta = np.linspace(0.0, 6.0, 600_001)
    original = original_rate(theta, gamma, BETA)
    free = dead_zone_free_rate(theta, 0.0, alpha, psi, 0.0)
    assert original.max() == pytest.approx(free.max(), rel=1e-6)
    assert original.sum() == pytest.approx(free.sum(), rel=1e-4)


def test_head_on_only_the_dead_zone_free_term_turns() -> None:
    scenes = draw_scenes("dead-zone", 9)
    comparisons = compare_terms(scenes, (30.0, 1000.0))
    for item in comparisons:
        # Straight through the middle of the sphere of 2.5 cm.
        assert item.original[0] == pytest.approx(-0.025, abs=1e-6)
        assert item.dead_zone_free[0] > item.original[0] + 0.01
    strong = comparisons[1]
    assert (strong.dead_zone_free > 0.03).all()
    rows = term_figures(comparisons)
    assert rows[1]["original_collisions"] == 1
    assert rows[1]["dead_zone_free_collisions"] == 0
    assert len(term_table(rows).rows) == 2
