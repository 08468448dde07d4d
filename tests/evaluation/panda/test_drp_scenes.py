"""Tests of the levels of DRPBench and of its rules."""

import math
from dataclasses import replace

import numpy as np
import pytest

from drake_oa.evaluation.panda.drp_scenes import EPISODE, LEVELS
from drake_oa.evaluation.panda.evaluation import drp_outcome
from drake_oa.evaluation.panda.scenes import draw_panda_scene, suite_kinds
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.end_poses import end_positions


def test_levels_are_kinds_of_scenes():
    assert len(suite_kinds(["drp"], [])) == len(LEVELS) == 11
    assert suite_kinds(["elbow", "drp"], ["sudden1"]) == ["elbow", "drp_sudden1"]
    with pytest.raises(ValueError, match="--level requires --suite drp"):
        suite_kinds(["elbow"], ["sudden1"])


def test_drp_outcome_is_determined_at_the_end_of_the_episode():
    scenario = replace(draw_panda_scene(0, 0, kind="drp_floating1"), obstacles=[])
    log = simulate(scenario, avoid_obstacles=False, duration=0.02)
    q_start, q_goal = end_positions(scenario)

    def outcome(*turns):
        q = np.stack([q_start, q_goal, q_start])
        q[1, : len(turns)] += turns
        known = replace(log, t=np.array([0.0, EPISODE - 0.01, EPISODE + 0.1]), q=q)
        return drp_outcome(scenario, replace(known, q_world=np.zeros((3, 0))), [])

    assert outcome() == "success"
    # The last joint turns the tool about its axis; the first moves it aside.
    assert outcome(0, 0, 0, 0, 0, 0, math.radians(14.0)) == "success"
    assert outcome(0, 0, 0, 0, 0, 0, math.radians(16.0)) == "stopped"
    assert outcome(0.2) == "stopped"
