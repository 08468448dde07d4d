"""The simulated cell and the robot alone."""

import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.config import ScenarioError
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.sources import noise_seed
from drake_oa.world.station import make_station


def test_each_camera_that_perception_sees_by_has_noise_of_its_own() -> None:
    scenario = load_scenario("two_cameras")
    seeds = [noise_seed(scenario, name) for name in ("left", "right")]
    assert seeds[0] == scenario.seed
    assert seeds[1] != seeds[0]
    assert noise_seed(load_scenario("tabletop_box"), "camera") == 0


def test_a_camera_on_a_frame_that_is_not_there_is_refused() -> None:
    scenario = load_scenario("tabletop_box")
    scenario.cameras[0].X_PB.base_frame = "nowhere::camera"
    with pytest.raises(ScenarioError, match=r"cameras: camera 'camera': .*nowhere"):
        make_station(DiagramBuilder(), scenario)


def test_a_station_needs_a_robot() -> None:
    with pytest.raises(ScenarioError, match="robot"):
        make_station(DiagramBuilder(), load_scenario("free_space"))
