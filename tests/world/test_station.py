"""Simulated station of a scenario: seeds of camera noise, and errors."""

import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.config import ScenarioError
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.sources import noise_seed
from drake_oa.world.station import make_station


def test_cameras_have_different_noise_seeds() -> None:
    scenario = load_scenario("two_cameras")
    seeds = [noise_seed(scenario, name) for name in ("left", "right")]
    assert seeds[0] == scenario.seed
    assert seeds[1] != seeds[0]
    assert noise_seed(load_scenario("tabletop_box"), "camera") == 0


def test_camera_on_an_unknown_frame_is_rejected() -> None:
    scenario = load_scenario("tabletop_box")
    scenario.cameras[0].X_PB.base_frame = "nowhere::camera"
    with pytest.raises(ScenarioError, match=r"cameras: camera 'camera': .*nowhere"):
        make_station(DiagramBuilder(), scenario)


def test_station_requires_a_robot() -> None:
    with pytest.raises(ScenarioError, match="robot"):
        make_station(DiagramBuilder(), load_scenario("free_space"))
