"""The hand's path is free and the elbow's is not: the whole arm passes."""

import numpy as np
import pytest

from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario

GROUND_TRUTH = "perception=!GroundTruth {}"


def test_on_the_planned_motion_the_elbow_hits_the_board() -> None:
    scenario = load_scenario("shelf_elbow", [GROUND_TRUTH])
    log = simulate(scenario, modulated=False, duration=4.0)
    touched = robot_metrics(scenario, log.q[::10]).contacts
    assert any("panda_link" in contact for contact in touched)


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [[], [GROUND_TRUTH]], ids=["depth with noise", "truth"])
def test_the_arm_goes_round(overrides: list[str]) -> None:
    scenario = load_scenario("shelf_elbow", overrides)
    log = simulate(scenario)
    metrics = robot_metrics(scenario, log.q)
    assert log.stop_reason == "goal"
    assert metrics.contacts == ()
    assert metrics.robot_clearance.min() > 0.025
    assert np.linalg.norm(log.p_WE[-1] - scenario.task.goal) < 1e-3
    assert (np.abs(log.v) < log.velocity_limit).all()
