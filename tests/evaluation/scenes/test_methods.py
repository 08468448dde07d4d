"""Methods by name: the project's own, and the package movement_primitives."""

import sys

import numpy as np
import pytest

from drake_oa.evaluation.scenes.ground_truth import evaluate_motions
from drake_oa.evaluation.scenes.methods import (
    LEAST_CLEARANCE,
    PARAMETERS,
    STEP,
    Setting,
    load_methods,
    run_movement_primitives,
    run_verified,
)
from drake_oa.evaluation.scenes.scenes import DURATION, make_scenes
from drake_oa.evaluation.scenes.suites import draw_scenes


@pytest.mark.parametrize("suite", ["novel", "hit"])
def test_it_keeps_the_feasible_clearance_and_arrives(suite: str) -> None:
    scenes = draw_scenes(suite, 12, 5)
    verdict = evaluate_motions(scenes, run_verified(scenes, Setting()))
    assert not verdict.collided.any()
    assert not verdict.is_short.any()
    assert verdict.goal_error.max() <= 1e-3


def test_time_is_scaled_by_the_length_of_the_path_if_asked() -> None:
    scenes = draw_scenes("hit", 4, 0)
    scaled, unscaled = (
        run_verified(scenes, Setting()),
        run_verified(scenes, Setting(scale_time=False)),
    )
    np.testing.assert_allclose(scaled.path, unscaled.path, atol=1e-9)
    ratio = scaled.duration / unscaled.duration
    np.testing.assert_allclose(ratio, evaluate_motions(scenes, scaled).path_ratio, rtol=1e-3)


def test_without_a_clearance_to_keep_it_stays_clear_nevertheless() -> None:
    scenes = make_scenes(1.0, [[0.5, 0.0, 0.0]], [[0.1, 0.1, 0.1]], clearance=0.0)
    verdict = evaluate_motions(scenes, run_verified(scenes, Setting(constrained=False)))
    assert verdict.min_clearance[0] >= LEAST_CLEARANCE - PARAMETERS.slack


def test_the_package_reaches_the_goal_and_turns_aside() -> None:
    pytest.importorskip("movement_primitives.dmp")
    scenes = make_scenes(1.0, [[0.5, 0.02, 0.0], [0.5, 5.0, 0.0]], np.full((2, 3), 0.05))
    motions = run_movement_primitives(scenes, Setting())
    assert motions.path.shape[1] == round(DURATION / STEP) + 1
    assert np.linalg.norm(motions.path[:, -1] - scenes.goal, axis=1).max() < 0.01
    assert motions.path[0, :, 1].min() < -0.05
    assert np.abs(motions.path[1, :, 1]).max() < 0.02


def test_a_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "movement_primitives.dmp", None)
    with pytest.raises(ValueError, match=r"pip install 'drake_oa\[baselines\]'"):
        load_methods(["movement_primitives"])
