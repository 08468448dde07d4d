"""Where cameras stand that are not a shipped scenario's."""

import pytest

from drake_oa.evaluation.cameras import ONE, TWO, seen_from, with_two
from drake_oa.geometry.shapes import Box
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.scenario.obstacles import Obstacle


def places(scenario):
    return {
        camera.name: camera.X_PB.GetDeterministicValue() for camera in with_two(scenario).cameras
    }


def test_a_camera_stands_higher_where_something_is_in_its_way():
    scenario = load_scenario("free_space", ["robot={}", "perception=!GroundTruth {}"])
    free = places(scenario)["left"].translation()
    object = Obstacle(name="board", shapes=[Box(size=[0.2, 0.2, 0.1])], translation=free.tolist())
    scenario.obstacles = [object]
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
