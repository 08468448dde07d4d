"""Where cameras stand that are not a shipped scenario's."""

import math

import numpy as np
import pytest

from drake_oa.geometry.shapes import Box
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.scenario.obstacles import Obstacle
from drake_oa.studies.cameras import ASIDE, AWAY, ELEVATIONS, ONE, TWO, seen_from, with_two


def places(scenario):
    return {
        camera.name: camera.X_PB.GetDeterministicValue() for camera in with_two(scenario).cameras
    }


def test_two_cameras_look_past_the_robot_at_the_middle():
    scenario = load_scenario("free_space", ["robot={}", "perception=!GroundTruth {}"])
    seen = with_two(scenario)
    assert scenario.cameras == []
    assert seen.perception.names == ("left", "right")
    text = scenario_text(seen)
    assert scenario_text(parse_scenario(text)) == text
    middle = 0.5 * (np.array(scenario.task.start) + np.array(scenario.task.goal))
    toward = math.atan2(-middle[1], -middle[0])
    for (name, X_WC), side in zip(places(scenario).items(), (-1.0, 1.0), strict=True):
        away = X_WC.translation() - middle
        assert np.linalg.norm(away) == pytest.approx(AWAY), name
        assert math.asin(away[2] / AWAY) == pytest.approx(ELEVATIONS[0])
        heading = math.atan2(away[1], away[0]) - toward
        assert math.remainder(heading - side * ASIDE, 2.0 * math.pi) == pytest.approx(0.0)
        # It looks at the middle, its x axis level.
        np.testing.assert_allclose(X_WC.rotation().col(2), -away / AWAY, atol=1e-9)
        assert X_WC.rotation().col(0)[2] == pytest.approx(0.0)


def test_a_camera_stands_higher_where_something_is_in_its_way():
    scenario = load_scenario("free_space", ["robot={}", "perception=!GroundTruth {}"])
    free = places(scenario)["left"].translation()
    thing = Obstacle(name="board", shapes=[Box(size=[0.2, 0.2, 0.1])], translation=free.tolist())
    scenario.obstacles = [thing]
    found = places(scenario)
    assert found["left"].translation()[2] > free[2]
    assert found["right"].translation()[2] == pytest.approx(free[2])


def test_other_places_change_the_view_alone():
    scenario = load_scenario("tabletop_clutter")
    for places in (ONE, TWO):
        seen = seen_from(scenario, places)
        assert seen.perception.names == tuple(places)
        assert seen.obstacles == scenario.obstacles
        text = scenario_text(seen)
        assert scenario_text(parse_scenario(text)) == text
    with pytest.raises(ValueError, match="seen by a depth camera"):
        seen_from(load_scenario("free_space"), ONE)
