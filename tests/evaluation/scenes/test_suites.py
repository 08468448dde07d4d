"""Tests sample the distributions sample scenes in the synthetic suites."""

import numpy as np
import pytest

from drake_oa.evaluation.scenes.scenes import obstacle_distance
from drake_oa.evaluation.scenes.suites import (
    BASELINES,
    FAMILIAR_CLEARANCES,
    SUITES,
    draw_scenes,
    line_distance,
)


@pytest.mark.parametrize("name", SUITES)
def test_scenes_depend_on_the_seed_and_starts_are_free(name: str) -> None:
    one, same, other = (draw_scenes(name, 64, seed=seed) for seed in (5, 5, 6))
    assert len(one) == 64
    assert (obstacle_distance(one, np.zeros((64, 3))) > 0.0).all()
    assert (one.center == same.center).all()
    assert (one.semi_axes == same.semi_axes).all()
    drawn = name not in ("familiar", "dead-zone")
    assert drawn == (one.center != other.center).any()


@pytest.mark.parametrize("name", ["novel", "hit", "demo"])
def test_obstacles_are_in_the_papers_box(name: str) -> None:
    scenes = draw_scenes(name, 200)
    center, a, L = scenes.center, scenes.semi_axes, scenes.baseline
    extent = np.linalg.norm(scenes.R[:, 0] * a, axis=1)
    if name == "demo":
        extent = np.where(L == 0.5, 0.2, 0.25)
    assert (center[:, 0] - extent > 0.05 - 1e-9).all()
    assert (center[:, 0] + extent < L - 0.05 + 1e-9).all()
    assert (np.abs(center[:, 1:]) <= 0.4).all()
    assert a.min() >= 0.025
    assert a.max() <= 0.25
    assert (line_distance(scenes) < (0.0 if name == "hit" else 0.15)).all()
    for baseline in BASELINES:
        assert (baseline == L).sum() == 50


def test_line_distance_equals_that_of_dense_sampling() -> None:
    scenes = draw_scenes("hit", 20)
    points = np.linspace(0.0, 1.0, 2001)[:, None, None] * scenes.goal
    sampled = np.min([obstacle_distance(scenes, sample) for sample in points], axis=0)
    np.testing.assert_allclose(line_distance(scenes), sampled, atol=1e-3)


def test_familiar_has_six_models_with_and_without_scaling() -> None:
    scenes, settings = draw_scenes("familiar", 9), SUITES["familiar"].settings
    assert len({setting.label for setting in settings}) == 12
    requested = {setting.of(scenes).clearance[0] for setting in settings if setting.constrained}
    assert requested == set(FAMILIAR_CLEARANCES)
    assert sum(setting.scale_time for setting in settings) == 6


@pytest.mark.parametrize(
    ("arguments", "message"),
    [(("nowhere",), "unknown suite 'nowhere'; valid: novel, hit"), (("familiar", 10), "square")],
)
def test_invalid_arguments_are_rejected(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        draw_scenes(*arguments)
