"""The package movement_primitives as a method."""

import importlib
import sys

import numpy as np
import pytest

from drake_oa.studies.scenes.methods import Setting, load_method
from drake_oa.studies.scenes.scenes import DURATION, single_obstacle


@pytest.fixture(scope="module")
def peers():
    pytest.importorskip("movement_primitives.dmp")
    return importlib.import_module("drake_oa.studies.scenes.peers")


def test_without_the_package_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "movement_primitives.dmp", None)
    monkeypatch.setitem(sys.modules, "movement_primitives", None)
    monkeypatch.delitem(sys.modules, "drake_oa.studies.scenes.peers", raising=False)
    with pytest.raises(ValueError, match=r"pip install 'drake_oa\[peers\]'"):
        load_method("movement_primitives")


def test_it_reaches_the_goal_and_turns_aside(peers):
    scenes = single_obstacle(1.0, [[0.5, 0.02, 0.0], [0.5, 5.0, 0.0]], np.full((2, 3), 0.05))
    motions = peers.run(scenes, Setting())
    steps = round(DURATION / peers.STEP)
    assert motions.path.shape == motions.velocity.shape == (2, steps + 1, 3)
    assert (motions.duration == DURATION).all()
    assert np.linalg.norm(motions.path[:, -1] - scenes.goal, axis=1).max() < 0.01
    assert motions.path[0, :, 1].min() < -0.05
    assert np.abs(motions.path[1, :, 1]).max() < 0.02
    speed = np.diff(motions.path, axis=1) / peers.STEP
    middle = 0.5 * (motions.velocity[:, 1:] + motions.velocity[:, :-1])
    np.testing.assert_allclose(speed, middle, atol=0.05)


def test_an_obstacle_that_moves_off_is_left_alone(peers):
    center = [[0.5, 0.02, 0.0]]
    away = single_obstacle(1.0, center, np.full((1, 3), 0.05), velocity=[0.0, 5.0, 0.0])
    still = single_obstacle(1.0, center, np.full((1, 3), 0.05))
    aside = [np.abs(peers.run(s, Setting()).path[0, :, 1]).max() for s in (away, still)]
    assert aside[0] < 0.5 * aside[1]
