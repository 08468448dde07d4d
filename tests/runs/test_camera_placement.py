"""Unobserved fraction of the space near the arm, and suggested camera poses."""

import re

import pytest

from drake_oa.runs.camera_placement import MAX_UNOBSERVED_FRACTION, view_note
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from tests.builders import unseen_near


def test_cameras_of_a_moving_scenario_observe_most_of_the_space():
    note = view_note(load_scenario("moving_obstacle"))
    assert re.fullmatch(r"cameras: 1\d% of the space within 0.4 m of the arm is unobserved", note)


def test_view_note_is_empty_without_cameras():
    assert view_note(load_scenario("tabletop_box", ["perception=!GroundTruth {}"])) == ""


def test_suggested_camera_pose_has_the_stated_unobserved_fraction():
    scenario = load_scenario("tabletop_box")
    note = view_note(scenario)
    before, after = (int(share) / 100 for share in re.findall(r"(\d+)%", note))
    assert before == pytest.approx(unseen_near(scenario), abs=0.005)
    assert after < MAX_UNOBSERVED_FRACTION < before
    pose = re.search(r"X_PB: (\{.*\}) and segmentation", note)
    assert pose is not None
    text = scenario_text(scenario).replace("far: 2.5", "far: 3.5")
    begin, end = text.index("  X_PB:"), text.index("  background:")
    moved = parse_scenario(f"{text[:begin]}  X_PB: {pose[1]}\n{text[end:]}")
    assert unseen_near(moved) == pytest.approx(after, abs=0.01)
