"""Motions that a hand showed: the arm goes them, and the coupling bends them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

from drake_oa.common.messages import FloatArray
from drake_oa.diagrams.policy import make_dmp
from drake_oa.policy.dmp import trajectory
from drake_oa.policy.orientation_dmp import goal_vector, orientation_along, rotation_matrix
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.tool_orientation import tool_orientation

GROUND_TRUTH = "perception=!GroundTruth {}"
WIPE = (
    "task.demonstration=package://drake_oa/demonstrations/wipe.npz",
    "task.start=[0.40, -0.35, 0.12]",
    "task.goal=[0.56, 0.35, 0.12]",
)


def learnt(scenario: Scenario) -> FloatArray:
    """(N, 3) the path that the demonstrations teach [m]."""
    task = scenario.task
    return trajectory(make_dmp(scenario), task.start, task.goal, steps=5000).p


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("demonstrated_arc", ()),
        ("demonstrated_pour", ()),
        ("tabletop_box", (*WIPE, "directives=[]")),
    ],
    ids=["arc", "pour", "wipe"],
)
def test_the_arm_goes_each_shipped_recording(name: str, overrides: tuple[str, ...]) -> None:
    scenario = load_scenario(name, [GROUND_TRUTH, "obstacles=[]", "cameras=[]", *overrides])
    log = simulate(scenario, modulated=False)
    report = motion_report(scenario, log)
    assert report["stop_reason"] == "goal"
    assert report["collisions"] == 0
    assert report["goal_error"] < 1e-3
    assert report["torque_saturation"] == 0.0
    # It arrives when the hand did.
    assert log.duration == pytest.approx(make_dmp(scenario).duration, abs=0.1)
    path = learnt(scenario)
    assert KDTree(path).query(log.p_WE)[0].max() < 2e-3
    assert KDTree(log.p_WE).query(path)[0].max() < 2e-3
    held = tool_orientation(scenario)
    if held is not None:
        s = np.maximum(log.t - 2.0 * scenario.policy.period, 0.0) / make_dmp(scenario).duration
        shown = orientation_along(held.primitive, held.R_WS, held.R_WG, np.minimum(s, 1.2))
        apart = [
            np.linalg.norm(goal_vector(rotation_matrix(q), R))
            for q, R in zip(log.desired_orientation[::50], shown[::50], strict=True)
        ]
        assert max(apart) < np.radians(0.5)
        assert np.linalg.norm(log.orientation_error, axis=1).max() < np.radians(0.5)


@pytest.mark.slow
def test_the_coupling_bends_what_was_shown_and_no_straight_line() -> None:
    scenario = load_scenario("demonstrated_arc", [GROUND_TRUTH])
    log = simulate(scenario)
    report = motion_report(scenario, log)
    assert report["stop_reason"] == "goal"
    assert report["collisions"] == 0
    assert report["tool_clearance_min"] >= scenario.task.clearance - 1e-3
    away = KDTree(learnt(scenario)).query(log.p_WE)[0]
    y = log.p_WE[:, 1]
    # Bent where the box is, and back where it is not.
    assert away[np.abs(y) < 0.1].min() > 0.03
    assert away[[0, -1]].max() < 1e-3
    # From above it is the arc, 0.2 m beside the line from start to goal.
    arc = learnt(scenario)
    at = np.interp(y, arc[:, 1], arc[:, 0])
    assert np.abs(log.p_WE[:, 0] - at).max() < 0.1
    assert log.p_WE[:, 0].max() > scenario.task.start[0] + 0.13


@pytest.mark.slow
def test_a_bent_motion_turns_the_tool_as_the_hand_did() -> None:
    scenario = load_scenario("demonstrated_pour", [GROUND_TRUTH])
    log = simulate(scenario)
    report = motion_report(scenario, log)
    assert report["stop_reason"] == "goal"
    assert report["collisions"] == 0
    assert report["tool_clearance_min"] >= scenario.task.clearance - 1e-3
    assert report["orientation_error"] < np.radians(0.5)
    held = tool_orientation(scenario)
    assert held is not None
    # At the same phase, whatever the time: compared as ways of turning.
    way = held.along(np.linspace(0.0, 1.5, 301))
    for q in log.desired_orientation[::100]:
        R = rotation_matrix(q)
        assert min(np.linalg.norm(goal_vector(R, other)) for other in way) < np.radians(1.0)
