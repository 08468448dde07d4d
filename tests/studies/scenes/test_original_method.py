"""Hoffmann's term as a method."""

import math

import numpy as np

from drake_oa.studies.scenes.judge import judge
from drake_oa.studies.scenes.methods import Setting
from drake_oa.studies.scenes.original_method import run
from drake_oa.studies.scenes.paper_method import TABLE_TWO, duration_scale, released_forcing
from drake_oa.studies.scenes.scenes import single_obstacle
from drake_oa.studies.scenes.suites import draw_scenes
from drake_oa.training.released_code import euler_trajectory


def test_it_is_the_original_term_at_the_published_gains():
    scenes = single_obstacle(1.0, [[0.4, 0.03, -0.02]], [[0.05, 0.05, 0.05]])
    motions = run(scenes, Setting())
    force = np.zeros((TABLE_TWO.steps, 3))
    force[:, 0] = released_forcing(TABLE_TWO.steps, TABLE_TWO.step)
    expected = euler_trajectory(
        scenes.center[0, 0],
        scenes.goal[0],
        force,
        (1000.0, 20.0 / math.pi),
        term="original",
        tau=float(duration_scale(scenes)[0]),
        step=TABLE_TWO.step,
    )
    np.testing.assert_allclose(motions.path[0, 1:], expected, atol=1e-10)


def test_neither_clearance_nor_constraint_changes_the_path():
    scenes = draw_scenes("novel", 8, seed=0)
    unscaled = Setting(scale_time=False)
    first = run(scenes, unscaled)
    second = run(scenes, Setting(constrained=False, scale_time=False))
    np.testing.assert_array_equal(first.path, second.path)


def test_straight_at_an_obstacle_it_does_not_turn():
    scenes = single_obstacle(1.0, [[0.5, 0.0, 0.0]], [[0.05, 0.05, 0.05]])
    motions = run(scenes, Setting())
    assert np.abs(motions.path[0, :, 1:]).max() < 1e-9
    assert judge(scenes, motions).collided[0]
