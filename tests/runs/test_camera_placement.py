"""Unobserved fraction of the space near the arm, and suggested camera poses."""

import re

import numpy as np
import pytest
from pydrake.common.schema import Transform

from drake_oa.runs.camera_placement import (
    MAX_UNOBSERVED_FRACTION,
    camera_pose_around,
    unobserved_near_arm,
    view_note,
)
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text


def test_cameras_of_a_moving_scenario_observe_most_of_the_space():
    scenario = load_scenario("moving_obstacle")
    above = unobserved_near_arm(scenario)
    assert f" {above:.0%} of the space within 0.4 m of the arm " in view_note(scenario)
    assert 0.02 < above < 0.15
    # Behind most of the space that a camera observes from the front, no surface is in its range.
    X_WC = camera_pose_around(np.array([0.4, 0.0, 0.3]), 0.0, 0.6, 2.1)
    scenario.cameras[0].X_PB = Transform(X_WC)
    assert unobserved_near_arm(scenario) > 3.0 * above


def test_view_note_is_empty_without_cameras():
    assert view_note(load_scenario("tabletop_box", ["perception=!GroundTruth {}"])) == ""


def test_suggested_camera_pose_has_the_stated_unobserved_fraction():
    scenario = load_scenario("tabletop_box")
    note = view_note(scenario)
    before, after = (int(share) / 100 for share in re.findall(r"(\d+)%", note))
    assert before == pytest.approx(unobserved_near_arm(scenario), abs=0.005)
    assert after < MAX_UNOBSERVED_FRACTION < before
    pose = re.search(r"X_PB: (\{.*\}) and segmentation", note)
    text = scenario_text(scenario).replace("far: 2.5", "far: 3.5")
    begin, end = text.index("  X_PB:"), text.index("  background:")
    moved = parse_scenario(f"{text[:begin]}  X_PB: {pose[1]}\n{text[end:]}")
    assert unobserved_near_arm(moved) == pytest.approx(after, abs=0.01)
