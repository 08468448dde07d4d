"""Tests of the methods `verified` and `movement_primitives` in synthetic scenes."""

import sys

import numpy as np
import pytest

from drake_oa.evaluation.scenes.ground_truth import evaluate_motions
from drake_oa.evaluation.scenes.methods import (
    MIN_CLEARANCE,
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
def test_verified_has_the_achievable_clearance_and_arrives(suite: str) -> None:
    scenes = draw_scenes(suite, 12, 5)
    result = evaluate_motions(scenes, run_verified(scenes, Setting()))
    assert not result.collided.any()
    assert not result.is_short.any()
    assert result.goal_error.max() <= 1e-3


def test_duration_is_scaled_by_the_path_length_if_set() -> None:
    scenes = draw_scenes("hit", 4, 0)
    scaled = run_verified(scenes, Setting())
    unscaled = run_verified(scenes, Setting(scale_time=False))
    np.testing.assert_allclose(scaled.path, unscaled.path, atol=1e-9)
    ratio = scaled.duration / unscaled.duration
    np.testing.assert_allclose(ratio, evaluate_motions(scenes, scaled).path_ratio, rtol=1e-3)


def test_verified_is_collision_free_without_a_requested_clearance() -> None:
    scenes = make_scenes(1.0, [[0.5, 0.0, 0.0]], [[0.1, 0.1, 0.1]], clearance=0.0)
    result = evaluate_motions(scenes, run_verified(scenes, Setting(constrained=False)))
    assert result.min_clearance[0] >= MIN_CLEARANCE - PARAMETERS.slack


def test_movement_primitives_reaches_the_goal_and_avoids() -> None:
    pytest.importorskip("movement_primitives.dmp")
    scenes = make_scenes(1.0, [[0.5, 0.02, 0.0], [0.5, 5.0, 0.0]], np.full((2, 3), 0.05))
    motions = run_movement_primitives(scenes, Setting())
    assert motions.path.shape[1] == round(DURATION / STEP) + 1
    assert np.linalg.norm(motions.path[:, -1] - scenes.goal, axis=1).max() < 0.01
    assert motions.path[0, :, 1].min() < -0.05
    assert np.abs(motions.path[1, :, 1]).max() < 0.02


def test_missing_package_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "movement_primitives.dmp", None)
    with pytest.raises(ValueError, match=r"pip install 'drake_oa\[baselines\]'"):
        load_methods(["movement_primitives"])
