"""Tests of the whole diagram: perception sources, clearance, and reproducibility."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from pydrake.systems.analysis import InitializeParams, Simulator
from pydrake.systems.framework import Context, Diagram

from drake_oa.common.messages import DECIDING, FloatArray
from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.runs.metrics import robot_metrics
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario

GROUND_TRUTH = "perception=!GroundTruth {}"
QUICK = (GROUND_TRUTH, "inference=!Paper {}")
"""Overrides of a run without the motion search."""
PRESENT = (
    "{name: box, shapes: [!Box {size: [0.12, 0.1, 0.31]}], translation: [0.46, 0.0, 0.155], "
    "present: [0.3, 0.4]}"
)


@pytest.mark.parametrize("kind", ["GroundTruth", "DepthCamera", "RecordedClouds"])
def test_perception_source_is_selected_by_its_block(kind: str, recording_folder: Path) -> None:
    block = {"RecordedClouds": f"{{folder: {recording_folder}}}"}.get(kind, "{}")
    scenario = load_scenario("tabletop_box", [f"perception=!{kind} {block}"])
    log = simulate(scenario, duration=0.2)
    assert log.p_WO.shape[1] == 1
    # The box stands across the middle of the baseline.
    np.testing.assert_allclose(log.p_WO[0, 0, :2], [0.45, 0.0], atol=0.06)
    assert np.isfinite(log.torque).all()
    assert log.event == (DECIDING, "")


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


@pytest.mark.parametrize(
    ("name", "overrides", "duration"), [("tabletop_box", [], 0.5), ("free_space", [], 3.0)]
)
def test_repeated_runs_are_bitwise_equal(name: str, overrides: list[str], duration: float) -> None:
    first, second = (simulate(load_scenario(name, overrides), duration=duration) for _ in range(2))
    for item in fields(MotionLog):
        if item.name != "wall_time":
            one, other = (np.asarray(getattr(log, item.name)) for log in (first, second))
            np.testing.assert_array_equal(other, one, item.name)


def motion(diagram: Diagram, root: Context) -> FloatArray:
    """Returns desired motion, state and torque of a diagram in a context."""
    values = []
    for system, port in (
        ("dmp_integrator", "desired_position"),
        ("dmp_integrator", "desired_velocity"),
        ("orientation_integrator", "desired_orientation"),
        ("plant", "state"),
        ("controller", "actuation"),
    ):
        if diagram.HasSubsystemNamed(system):
            part = diagram.GetSubsystemByName(system)
            values.append(part.GetOutputPort(port).Eval(part.GetMyContextFromRoot(root)))
    return np.concatenate(values)


@pytest.mark.parametrize(
    ("name", "overrides", "when", "until"),
    [
        ("tabletop_box", [GROUND_TRUTH], 0.6, 1.0),
        ("free_space", [], 1.8, 2.6),
        ("moving_goal", [*QUICK, "task.goal_moves=[[0.4, 0.45, 0.45, 0.5]]"], 0.3, 0.6),
        ("vanishing_obstacle", [*QUICK, f"obstacles=[{PRESENT}]"], 0.2, 0.6),
        ("tilted_goal", QUICK, 0.3, 0.6),
        ("pushed_robot", [*QUICK, "faults=[!Push {start: 0.3}]"], 0.2, 0.6),
    ],
)
def test_cloned_context_continues_equally(
    name: str, overrides: list[str], when: float, until: float
) -> None:
    diagram = build_avoidance(load_scenario(name, overrides))
    simulator = Simulator(diagram)
    simulator.AdvanceTo(when)
    other = Simulator(diagram, simulator.get_context().Clone())
    # All state is in the context, hence initialization events are suppressed.
    params = InitializeParams()
    params.suppress_initialization_events = True
    other.Initialize(params)
    for time in np.linspace(when, until, 9)[1:]:
        simulator.AdvanceTo(time)
        other.AdvanceTo(time)
        np.testing.assert_array_equal(
            motion(diagram, other.get_context()), motion(diagram, simulator.get_context())
        )
