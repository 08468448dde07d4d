"""Tests of the whole diagram with a tool that rotates during the motion."""

from __future__ import annotations

import numpy as np
import pytest
from pydrake.math import RollPitchYaw
from scipy.spatial import KDTree

from drake_oa.diagrams.motion import make_dmp
from drake_oa.policy.dmp import goal_vector, rotation_matrix, trajectory
from drake_oa.runs.report import motion_report, report_table, run_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.end_poses import tool_orientation
from drake_oa.scenario.loading import load_scenario

GROUND_TRUTH = "perception=!GroundTruth {}"


def test_tool_reaches_the_goal_orientation_and_the_error_is_reported() -> None:
    scenario = load_scenario("tilted_goal", [GROUND_TRUTH])
    log = simulate(scenario)
    report = run_report("x", scenario, {"avoiding": log})
    assert report["avoiding"]["stop_reason"] == "goal"
    assert report["avoiding"]["orientation_error"] <= np.radians(0.5)
    assert np.linalg.norm(log.orientation_error, axis=1).max() < np.radians(0.5)
    assert "orientation error [deg]" in str(report_table(report))
    down = load_scenario("tabletop_box").robot
    before = RollPitchYaw(down.rpy_WE).ToRotationMatrix().matrix()
    turned = goal_vector(before, rotation_matrix(log.desired_orientation[-1]))
    # 40 degrees about the vertical and 20 of tilt.
    assert np.degrees(np.linalg.norm(turned)) == pytest.approx(44.5, abs=0.5)


def test_arm_follows_a_demonstration() -> None:
    scenario = load_scenario("demonstrated_pour", [GROUND_TRUTH, "obstacles=[]", "cameras=[]"])
    log = simulate(scenario, avoid_obstacles=False)
    report = motion_report(scenario, log)
    assert report["stop_reason"] == "goal"
    assert report["goal_error"] < 1e-3
    assert report["torque_saturation"] == 0.0
    dmp, task, tool = make_dmp(scenario), scenario.task, tool_orientation(scenario)
    # The arm arrives at the time of the demonstration.
    assert log.duration == pytest.approx(dmp.duration, abs=0.1)
    path = trajectory(dmp, task.start, task.goal, steps=5000).p
    assert KDTree(path).query(log.p_WE)[0].max() < 2e-3
    assert KDTree(log.p_WE).query(path)[0].max() < 2e-3
    last = goal_vector(rotation_matrix(log.desired_orientation[-1]), tool.R_WG)
    assert np.linalg.norm(last) < np.radians(0.5)
    assert np.linalg.norm(log.orientation_error, axis=1).max() < np.radians(0.5)
