"""The supervisor in the whole diagram, on the simulated robot."""

import numpy as np
import pytest

from drake_oa.common.config import ScenarioError
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text

# The tool passes a thin pole at a good distance, the forearm does not.
POLE = """
task:
  start: [0.45, -0.45, 0.3]
  goal: [0.45, 0.45, 0.3]
  clearance: 0.1
obstacles:
- {name: pole, shapes: [!Box {size: [0.04, 0.04, 0.7]}], translation: [0.26, 0.06, 0.35]}
perception: !GroundTruth {}
regulation: !Paper {}
"""


def test_the_forearm_stops_before_a_pole() -> None:
    scenario = parse_scenario(POLE)
    log = simulate(scenario)
    assert log.stop_reason.startswith("stopped: panda_link")
    assert log.stop_reason.endswith("m of obstacle 0")
    assert log.event[-1] == "supervisor: " + log.stop_reason.removeprefix("stopped: ")
    assert not log.desired_velocity[-1].any()
    found = robot_metrics(scenario, log.q[::10])
    assert found.contacts == ()
    assert found.robot_clearance.min() > scenario.supervisor.stop_distance


@pytest.mark.slow
def test_without_a_supervisor_it_hits_the_pole() -> None:
    scenario = parse_scenario(POLE, ["supervisor=null"])
    log = simulate(scenario)
    contacts = robot_metrics(scenario, log.q[::10]).contacts
    assert [pair for pair in contacts if pair.endswith(" - obstacle_pole")]


@pytest.mark.slow
def test_a_motion_that_keeps_its_clearance_is_not_slowed() -> None:
    logs = [
        simulate(load_scenario("tabletop_box", ["perception=!GroundTruth {}", *more]))
        for more in ([], ["supervisor=null"])
    ]
    assert [log.stop_reason for log in logs] == ["goal", "goal"]
    assert (logs[0].speed_scale == 1.0).all()
    np.testing.assert_array_equal(logs[0].q, logs[1].q)


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("supervisor.tracking_slow=0.1", "supervisor.tracking_hold: 0.05 must be more"),
        ("supervisor.leave_scale=0.0", r"supervisor.leave_scale: 0.0 is outside \(0, 1\]"),
        ("supervisor.wrong=1", "supervisor.wrong is not a field"),
    ],
)
def test_bad_fields_are_refused_by_name(override: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        parse_scenario(POLE, [override])


def test_null_is_kept_in_the_logged_scenario() -> None:
    text = scenario_text(parse_scenario(POLE, ["supervisor=null"]))
    assert parse_scenario(text).supervisor is None
    assert parse_scenario(POLE).supervisor is not None
