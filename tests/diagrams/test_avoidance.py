"""Tests of the whole diagram: clearance and reproducibility."""

from dataclasses import fields

import numpy as np
import pytest
from pydrake.systems.analysis import InitializeParams, Simulator

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from tests.builders import read

GROUND_TRUTH = "perception=!GroundTruth {}"


def test_avoiding_motion_has_the_requested_clearance_without_holds() -> None:
    # With the compute latency the motion would begin later.
    scenario = load_scenario("tabletop_box", [GROUND_TRUTH, "compute_latency=null"])
    log = simulate(scenario)
    report = motion_report(scenario, log)
    assert report["stop_reason"] == "goal"
    assert report["contacts"] == report["supervision"] == []
    assert 0.150 <= report["tool_clearance_min"] <= 0.165
    assert report["predicted_shortfall"] == report["torque_saturation"] == 0.0
    assert (log.speed_scale == 1.0).all()
    p_WE = robot_metrics(scenario, log.q[::20]).p_WE
    np.testing.assert_allclose(p_WE, log.desired_position[::20], atol=0.01)


@pytest.mark.parametrize(("name", "duration"), [("tabletop_box", 0.5), ("free_space", 3.0)])
def test_repeated_runs_are_bitwise_equal(name: str, duration: float) -> None:
    first, second = (simulate(load_scenario(name), duration=duration) for _ in range(2))
    for item in fields(MotionLog):
        if item.name != "wall_time":
            one, other = (np.asarray(getattr(log, item.name)) for log in (first, second))
            np.testing.assert_array_equal(other, one, item.name)


@pytest.mark.parametrize(
    ("name", "override", "when"),
    [
        ("tabletop_box", "seed=0", 0.6),
        ("moving_goal", "task.goal_moves=[[0.4, 0.45, 0.45, 0.5]]", 0.3),
        ("pushed_robot", "faults=[!Push {start: 0.3}]", 0.2),
    ],
)
def test_cloned_context_continues_equally(name: str, override: str, when: float) -> None:
    diagram = build_avoidance(load_scenario(name, [GROUND_TRUTH, override]))
    simulator = Simulator(diagram)
    simulator.AdvanceTo(when)
    other = Simulator(diagram, simulator.get_context().Clone())
    # All state is in the context, hence initialization events are suppressed.
    other.Initialize(InitializeParams(suppress_initialization_events=True))
    plant, states = diagram.GetSubsystemByName("plant"), []
    for one in (simulator, other):
        one.AdvanceTo(when + 0.4)
        states.append(read(plant, plant.GetMyContextFromRoot(one.get_context()), "state"))
    np.testing.assert_array_equal(*states)
