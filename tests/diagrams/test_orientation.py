"""The whole diagram with a tool that turns on its way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RollPitchYaw
from pydrake.systems.analysis import Simulator

from drake_oa.diagrams.avoidance import build_avoidance
from drake_oa.policy.orientation_dmp import goal_vector, orientation_along, rotation_matrix
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_report, report_table, run_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.tool_orientation import tool_orientation

GROUND_TRUTH = "perception=!GroundTruth {}"


@pytest.fixture(scope="module")
def run() -> MotionLog:
    return simulate(load_scenario("tilted_goal", [GROUND_TRUTH]))


@pytest.mark.slow
def test_the_tool_passes_the_box_and_arrives_turned(run: MotionLog) -> None:
    scenario = load_scenario("tilted_goal", [GROUND_TRUTH])
    report = motion_report(scenario, run)
    assert report["stop_reason"] == "goal"
    assert report["collisions"] == 0
    assert report["tool_clearance_min"] >= 0.15
    assert report["goal_error"] <= 0.005
    assert report["orientation_error"] <= np.radians(0.5)
    assert report["torque_saturation"] == 0.0
    assert np.linalg.norm(run.orientation_error, axis=1).max() < np.radians(0.5)
    down = load_scenario("tabletop_box").robot
    assert down is not None
    before = RollPitchYaw(down.rpy_WE).ToRotationMatrix().matrix()
    turned = goal_vector(before, rotation_matrix(run.desired_orientation[-1]))
    # 40 degrees about the vertical and 20 of tilt.
    assert np.degrees(np.linalg.norm(turned)) == pytest.approx(44.5, abs=0.5)


def test_the_report_tells_the_angle_where_the_tool_turns(run: MotionLog) -> None:
    scenario = load_scenario("tilted_goal", [GROUND_TRUTH])
    assert "turn error [deg]" in str(report_table(run_report("x", scenario, {"modulated": run})))
    plain = load_scenario("tabletop_box", [GROUND_TRUTH, "regulation=!Paper {}"])
    log = simulate(plain, duration=0.02)
    assert log.desired_orientation.shape == (0, 4)
    assert log.orientation_error.shape == (0, 3)
    report = run_report("x", plain, {"modulated": log})
    assert "orientation_error" not in report["modulated"]
    assert "turn error" not in str(report_table(report))


def test_a_scenario_without_it_has_no_such_system() -> None:
    plain = build_avoidance(load_scenario("tabletop_box", ["regulation=!Paper {}"]))
    assert not plain.HasSubsystemNamed("orientation_integrator")


def test_a_demonstrated_orientation_is_followed(tmp_path: Path) -> None:
    s = np.linspace(0.0, 1.0, 41)
    yaw = np.pi / 2.0 + 0.4 * np.sin(np.pi * s) ** 2
    R = [RollPitchYaw(np.pi, 0.0, y).ToRotationMatrix() for y in yaw]
    signs = np.where(np.arange(41) % 2, 1.0, -1.0)
    np.savez(
        tmp_path / "shown.npz",
        path=np.column_stack([s, np.sin(np.pi * s), 0.0 * s]),
        t=1.5 * s,
        quaternion=[sign * r.ToQuaternion().wxyz() for sign, r in zip(signs, R, strict=True)],
    )
    scenario = load_scenario(
        "tabletop_box",
        [
            f"task.demonstration={tmp_path / 'shown.npz'}",
            "task.start=[0.45, -0.3, 0.4]",
            "task.goal=[0.45, -0.1, 0.4]",
            "directives=[]",
            "perception=!GroundTruth {}",
        ],
    )
    log = simulate(scenario, modulated=False, duration=1.5)
    held = tool_orientation(scenario)
    assert held is not None
    late = np.maximum(log.t - 2.0 * scenario.policy.period, 0.0) / 1.5
    planned = orientation_along(held.primitive, held.R_WS, held.R_WG, late)
    off = [
        np.linalg.norm(goal_vector(rotation_matrix(q), m))
        for q, m in zip(log.desired_orientation[::10], planned[::10], strict=True)
    ]
    assert max(off) < 2e-3
    assert np.linalg.norm(log.orientation_error, axis=1).max() < np.radians(0.5)


def test_a_cloned_context_turns_on_in_the_same_way() -> None:
    diagram = build_avoidance(load_scenario("tilted_goal", [GROUND_TRUTH]), modulated=False)
    simulator = Simulator(diagram)
    simulator.AdvanceTo(1.0)
    other = Simulator(diagram, simulator.get_context().Clone())
    for each in (simulator, other):
        each.AdvanceTo(1.5)
    system = diagram.GetSubsystemByName("orientation_integrator")
    one, two = (
        system.GetOutputPort("desired_orientation").Eval(
            system.GetMyContextFromRoot(each.get_context())
        )
        for each in (simulator, other)
    )
    np.testing.assert_allclose(two, one, atol=1e-9)
