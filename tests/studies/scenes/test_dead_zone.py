"""Both coupling terms of the same peak and area, with a point obstacle in their way."""

import numpy as np
import pytest

from drake_oa.policy.coupling import dead_zone_free_rate, original_rate
from drake_oa.studies.scenes.evaluation import compare_terms, matched_term, term_figures, term_table
from drake_oa.studies.scenes.paper_method import BETA
from drake_oa.studies.scenes.suites import draw_scenes


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
    assert [line.split()[0] for line in str(term_table(rows)).splitlines()] == [
        "terms",
        "gamma",
        "gamma",
    ]
