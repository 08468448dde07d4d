"""Table II of the paper: its readings, which cells agree, and the ablation."""

from typing import Any

import numpy as np
import pytest

from drake_oa.studies.paper_tables import (
    ABLATION,
    TABLE_TWO,
    Choice,
    agrees,
    choices,
    judge_choice,
    table_two,
    table_two_figures,
)
from drake_oa.studies.scenes.judge import judge
from drake_oa.studies.scenes.methods import Setting
from drake_oa.studies.scenes.paper_method import run, sections
from drake_oa.studies.scenes.reading import Reading
from drake_oa.studies.scenes.scenes import single_obstacle
from drake_oa.studies.scenes.suites import draw_scenes, random_rotations


def row(**changes: Any) -> dict[str, Any]:
    return {"scenes": 5, **TABLE_TWO[1.0], **changes}


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
    found = agrees(row(**changes), TABLE_TWO[1.0])
    assert {key for key, same in found.items() if not same} == off


def test_the_ablation_has_every_other_value_of_every_option_once() -> None:
    varied = choices(Choice(), True)
    assert list(choices(Choice(), False)) == ["chosen"]
    assert len(set(map(str, varied.values()))) == len(varied)
    for name, choice in varied.items():
        options = choice.options()
        changed = {key for key, value in Choice().options().items() if options[key] != value}
        assert len(changed) == (0 if name == "chosen" else name.count(",") + 1), name
    # Of another choice the default's values are varied back.
    other = Choice().changed({"sampling": "near", "law": "printed"})
    assert {"sampling demo", "law released"} <= set(choices(other, True))
    assert len(ABLATION) == 24


def test_distances_in_the_p_plane_are_those_to_the_section() -> None:
    rng = np.random.default_rng(4)
    center = np.column_stack([np.full(20, 0.5), rng.uniform(-0.2, 0.2, (20, 2))])
    a = rng.uniform(0.05, 0.2, (20, 3))
    scenes = single_obstacle(1.0, center, a, R=random_rotations(rng, 20))
    cut = sections(scenes)
    R = cut.R[:, 0]
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(np.einsum("ni,ni->n", R[:, :, 2], center), 0.0, atol=1e-9)
    # Points of the section's outline are on the ellipsoid; a sphere's distance is the same.
    for k in range(2):
        point = np.einsum("nij,ni->nj", scenes.R[:, 0], cut.semi_axes[:, 0, k, None] * R[:, :, k])
        np.testing.assert_allclose(((point / a) ** 2).sum(axis=1), 1.0)
    balls = single_obstacle(1.0, center, np.full((20, 3), 0.1))
    motions = run(balls, Setting(), Reading(steps="demo", time="fixed"))
    for scene, other in ((balls, sections(balls)), (scenes, cut)):
        kept, in_plane = (judge(of, motions).kept_clearance for of in (scene, other))
        assert (in_plane >= kept - 1e-6).all()
    np.testing.assert_allclose(
        judge(sections(balls), motions).kept_clearance,
        judge(balls, motions).kept_clearance,
        atol=1e-4,
    )


def test_the_default_comes_near_the_print_and_the_print_as_it_stands_does_not() -> None:
    scenes = draw_scenes("demo", 240, seed=1)
    literal = Choice().changed({"law": "printed", "tau": "extreme", "time": "tau"})
    chosen = {"chosen": Choice(), "literal": literal}
    outcomes = {}
    for name, choice in chosen.items():
        outcomes |= judge_choice(name, choice, scenes).outcomes
    whole = table_two_figures(chosen, outcomes, {"demo": scenes}, 1, ("drake_oa 0.1.0",))
    found = whole["readings"]
    for part, printed in zip(found["chosen"]["by_baseline"], TABLE_TWO.values(), strict=True):
        assert part["scenes"] == 60
        assert part["collisions"] == 0
        assert part["clearance_mean"] == pytest.approx(printed["clearance_mean"], abs=0.02)
        assert 0.3 < part["goal_error_mean"] / printed["goal_error_mean"] < 4.0
    assert found["chosen"]["cells"] > found["literal"]["cells"]
    assert min(part["goal_error_mean"] for part in found["literal"]["by_baseline"]) > 5e-3
    assert 0.1 < found["chosen"]["lines_hit"] < 0.35
    assert "goal mean" in table_two(whole)[1].rows[0]["off"]
