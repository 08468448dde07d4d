"""Unseen share of scenarios, and the places that are suggested."""

import math
import re

import numpy as np
import pytest

from drake_oa.runs.camera_placement import (
    AWAY,
    LARGE_SHARE,
    near_space,
    placed_around,
    view_note,
    view_volumes,
)
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text


def unseen(scenario):
    return near_space(scenario).unseen_share(view_volumes(scenario, scenario.perception))


@pytest.mark.parametrize("name", ["moving_obstacle", "sudden_obstacle", "vanishing_obstacle"])
def test_the_cameras_of_moving_scenarios_see_most_of_the_space(name):
    scenario = load_scenario(name)
    assert unseen(scenario) < LARGE_SHARE
    assert re.fullmatch(
        r"cameras: 1\d% of the space within 0.4 m of the arm is unseen", view_note(scenario)
    )


def test_a_suggested_place_leaves_as_much_as_it_says():
    scenario = load_scenario("tabletop_box")
    note = view_note(scenario)
    before, after = (int(share) / 100 for share in re.findall(r"(\d+)%", note))
    assert before == pytest.approx(unseen(scenario), abs=0.005)
    assert after < LARGE_SHARE < before
    pose = re.search(r"X_PB: (\{.*\}) and segmentation", note)
    assert pose is not None
    text = scenario_text(scenario).replace("far: 2.5", "far: 3.5")
    begin, end = text.index("  X_PB:"), text.index("  background:")
    moved = parse_scenario(f"{text[:begin]}  X_PB: {pose[1]}\n{text[end:]}")
    assert unseen(moved) == pytest.approx(after, abs=0.01)


def test_nothing_is_said_without_cameras():
    assert view_note(load_scenario("tabletop_box", ["perception=!GroundTruth {}"])) == ""


def test_a_placed_camera_looks_at_the_middle():
    middle = np.array([0.4, 0.1, 0.3])
    X_WC = placed_around(middle, 0.5, 0.6)
    away = X_WC.translation() - middle
    assert np.linalg.norm(away) == pytest.approx(AWAY)
    assert math.atan2(away[1], away[0]) == pytest.approx(0.5)
    assert math.asin(away[2] / AWAY) == pytest.approx(0.6)
    np.testing.assert_allclose(X_WC.rotation().col(2), -away / AWAY, atol=1e-9)
    assert X_WC.rotation().col(0)[2] == pytest.approx(0.0)
