"""Tests of the ground-truth metrics against dense sampling of spheres' distances."""

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline

from drake_oa.evaluation.scenes.ground_truth import evaluate_motions
from drake_oa.evaluation.scenes.methods import Motions
from drake_oa.evaluation.scenes.scenes import Scenes, make_scenes
from drake_oa.evaluation.scenes.suites import random_rotations


def test_clearance_and_length_equal_those_of_dense_sampling() -> None:
    rng = np.random.default_rng(0)
    center = rng.uniform((0.0, -0.3, -0.3), (1.0, 0.3, 0.3), (6, 3))
    radius, R = rng.uniform(0.02, 0.2, 6), random_rotations(rng, 6)
    axes = np.repeat(radius[:, None], 3, axis=1)
    scenes = Scenes(np.ones(6), center, axes, R, np.full(6, 0.1))
    path = np.cumsum(rng.uniform(-0.05, 0.1, (6, 26, 3)), axis=1)
    duration = rng.uniform(2.0, 4.0, 6)
    speed = 25.0 / duration[:, None, None] * np.gradient(path, axis=1)
    results = evaluate_motions(scenes, Motions(path, speed, duration))
    for n in range(6):
        t = np.linspace(0.0, duration[n], 100_001)
        p = CubicHermiteSpline(t[::4000], path[n], speed[n])(t)
        distance = np.linalg.norm(p - center[n], axis=1) - radius[n]
        assert results.min_clearance[n] == pytest.approx(distance.min(), abs=1e-6)
        length = np.linalg.norm(np.diff(p, axis=0), axis=1).sum()
        assert results.path_ratio[n] == pytest.approx(length, rel=1e-2)


def test_achievable_clearance_is_limited_by_the_ends() -> None:
    scenes = make_scenes(1.0, np.array([[1.0, 0.15, 0.0]]), np.full((1, 3), 0.1))
    x = np.array([[[1.0, 0.0, 0.0]]])
    straight = Motions(np.linspace(0.0, 1.0, 51)[:, None] * x, np.repeat(0.5 * x, 51, 1), [2.0])
    results = evaluate_motions(scenes, straight)
    assert results.achievable_clearance[0] == pytest.approx(0.05)
    assert results.min_clearance[0] == pytest.approx(0.05)
    assert not results.is_short[0]
