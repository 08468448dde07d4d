"""The package movement_primitives as a method."""

import numpy as np
import pytest

from drake_oa.studies.scenes.methods import STEP, run_movement_primitives
from drake_oa.studies.scenes.scenes import DURATION, Setting, single_obstacle

pytest.importorskip("movement_primitives.dmp")


def test_it_reaches_the_goal_and_turns_aside():
    scenes = single_obstacle(1.0, [[0.5, 0.02, 0.0], [0.5, 5.0, 0.0]], np.full((2, 3), 0.05))
    motions = run_movement_primitives(scenes, Setting())
    steps = round(DURATION / STEP)
    assert motions.path.shape == motions.velocity.shape == (2, steps + 1, 3)
    assert (motions.duration == DURATION).all()
    assert np.linalg.norm(motions.path[:, -1] - scenes.goal, axis=1).max() < 0.01
    assert motions.path[0, :, 1].min() < -0.05
    assert np.abs(motions.path[1, :, 1]).max() < 0.02
    speed = np.diff(motions.path, axis=1) / STEP
    middle = 0.5 * (motions.velocity[:, 1:] + motions.velocity[:, :-1])
    np.testing.assert_allclose(speed, middle, atol=0.05)


def test_an_obstacle_that_moves_off_is_left_alone():
    center = [[0.5, 0.02, 0.0]]
    away = single_obstacle(1.0, center, np.full((1, 3), 0.05), velocity=[0.0, 5.0, 0.0])
    still = single_obstacle(1.0, center, np.full((1, 3), 0.05))
    paths = [run_movement_primitives(scenes, Setting()).path for scenes in (away, still)]
    aside = [np.abs(path[0, :, 1]).max() for path in paths]
    assert aside[0] < 0.5 * aside[1]
