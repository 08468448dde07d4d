"""Table II of the paper: cells that agree with the print."""

from typing import Any

import pytest

from drake_oa.studies.paper_tables import (
    TABLE_TWO,
    agrees,
    judge_novel,
    table_two,
    table_two_figures,
)
from drake_oa.studies.scenes.suites import draw_scenes


@pytest.mark.parametrize(
    ("changes", "off"),
    [
        ({}, set()),
        ({"clearance_mean": 0.195, "clearance_min": 0.02}, {"clearance_mean", "clearance_min"}),
        ({"goal_error_mean": 1e-3, "goal_error_max": 8e-3}, {"goal_error_mean", "goal_error_max"}),
        ({"collisions": 4}, {"collisions"}),
        ({"scenes": 0}, set(TABLE_TWO[1.0])),
    ],
)
def test_a_cell_agrees_or_not(changes: dict[str, Any], off: set[str]) -> None:
    found = agrees({"scenes": 5, **TABLE_TWO[1.0], **changes}, TABLE_TWO[1.0])
    assert {key for key, same in found.items() if not same} == off


def test_the_method_comes_near_the_print() -> None:
    scenes = draw_scenes("demo", 240, seed=1)
    whole = table_two_figures(judge_novel(scenes), scenes, 1)
    for part, printed in zip(whole["by_baseline"], TABLE_TWO.values(), strict=True):
        assert part["scenes"] == 60
        assert part["collisions"] == 0
        assert part["clearance_mean"] == pytest.approx(printed["clearance_mean"], abs=0.02)
        assert 0.3 < part["goal_error_mean"] / printed["goal_error_mean"] < 4.0
    assert whole["cells"] >= 8
    assert 0.1 < whole["lines_hit"] < 0.35
    assert f"{whole['cells']} of 20" in str(table_two(whole))
