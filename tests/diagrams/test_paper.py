"""Guidance by cost rings on the robot, and what happens without a way."""

import logging

import numpy as np
import pytest

from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario

GROUND_TRUTH = "perception=!GroundTruth {}"


WALL = (
    "obstacles=[{name: wall, shapes: [!Box {size: [1.1, 0.05, 1.6]}], "
    "translation: [0.75, 0.0, 0.8], present: [0.0, 1.5]}]"
)


@pytest.mark.slow
def test_it_holds_while_every_side_is_forbidden_and_goes_on_when_one_is_free(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """A wall as high and as wide as the robot reaches, taken away after 1.5 s."""
    caplog.set_level(logging.INFO, logger="drake_oa")
    scenario = load_scenario("paper_guidance", [GROUND_TRUTH, WALL])
    log = simulate(scenario, duration=12.0)
    told = [record.getMessage() for record in caplog.records]
    assert any("held: every side of obstacle 0 is forbidden" in text for text in told)
    assert any("running again" in text for text in told)
    waiting = log.t < 1.4
    np.testing.assert_allclose(log.p_WE[waiting], log.p_WE[:1].repeat(waiting.sum(), 0), atol=0.01)
    assert log.stop_reason == "goal"
