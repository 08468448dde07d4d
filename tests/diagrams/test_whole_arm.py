"""Motions of the whole arm among true shapes, wired and run."""

import numpy as np
import pytest

from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario

CHANGES = ["regulation=!WholeArm {}", "perception=!GroundTruth {}", "evasion=null"]


def test_a_motion_begins() -> None:
    log = simulate(load_scenario("tabletop_box", CHANGES), duration=0.05)
    assert np.isfinite(log.torque).all()
    assert log.shortfall.max() == 0.0
    assert not log.supervision_action


@pytest.mark.slow
def test_it_keeps_what_is_asked_and_hardly_more() -> None:
    scenario = load_scenario("tabletop_box", CHANGES)
    log = simulate(scenario)
    assert log.stop_reason == "goal"
    found = robot_metrics(scenario, log.q, log.q_world)
    assert 0.150 <= found.tool_clearance.min() <= 0.165
    assert not found.contacts
    assert np.linalg.norm(log.p_WE[-1] - scenario.task.goal) < 5e-3
