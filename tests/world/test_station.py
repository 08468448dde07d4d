"""The simulated cell and the robot alone."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.config import ScenarioError
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotPlant, home_positions, tool_corners
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.sources import noise_seed
from drake_oa.world.station import make_station


def test_the_camera_is_made_only_where_something_renders() -> None:
    builder = DiagramBuilder()
    station = make_station(builder, load_scenario("tabletop_box"))
    assert list(station.cameras) == ["camera"]
    info = station.cameras["camera"].intrinsics
    assert (info.width(), info.height()) == (640, 480)
    # No publisher that would render each frame anew.
    names = [type(system).__name__ for system in builder.GetSystems()]
    assert not any("Lcm" in name or "ImageToLcm" in name for name in names)


def test_each_camera_that_perception_sees_by_has_noise_of_its_own() -> None:
    scenario = load_scenario("two_cameras")
    seeds = [noise_seed(scenario, name) for name in ("left", "right")]
    assert seeds[0] == scenario.seed
    assert seeds[1] != seeds[0]
    assert noise_seed(load_scenario("tabletop_box"), "camera") == 0


def test_the_tool_frame_is_at_the_fingertips(panda: RobotPlant) -> None:
    plant = panda.plant
    context = plant.CreateDefaultContext()
    X_HE = panda.tool_frame.CalcPose(context, plant.GetFrameByName("panda_hand"))
    np.testing.assert_allclose(X_HE.translation(), [0.0, 0.0, 0.1034], atol=1e-12)
    assert X_HE.rotation().IsNearlyIdentity()


def test_the_tool_is_above_its_point_and_turns_with_its_orientation() -> None:
    corners = tool_corners(Robot())
    low, high = corners.min(axis=0), corners.max(axis=0)
    # It points down: all of it is above E but for the finger tips' rounding.
    assert -0.03 < low[2] <= 0.0
    assert 0.1 < high[2] < 0.25
    # The hand is wide along the world's x.
    assert high[0] - low[0] > 0.18
    assert high[1] - low[1] < 0.12
    turned = np.ptp(tool_corners(Robot(rpy_WE=[np.pi, 0.0, 0.0])), axis=0)
    np.testing.assert_allclose(turned, (high - low)[[1, 0, 2]], atol=1e-9)
    opened = np.ptp(tool_corners(Robot(finger_opening=0.04)), axis=0)
    assert (opened >= high - low - 1e-9).all()


def test_home_positions_hold_seed_and_fingers() -> None:
    robot = Robot(finger_opening=0.03)
    q = home_positions(robot)
    np.testing.assert_array_equal(q, [*robot.q_seed, 0.03, 0.03])


def test_a_camera_on_a_frame_that_is_not_there_is_refused() -> None:
    scenario = load_scenario("tabletop_box")
    scenario.cameras[0].X_PB.base_frame = "nowhere::camera"
    with pytest.raises(ScenarioError, match=r"cameras: camera 'camera': .*nowhere"):
        make_station(DiagramBuilder(), scenario)


def test_a_station_needs_a_robot() -> None:
    with pytest.raises(ScenarioError, match="robot"):
        make_station(DiagramBuilder(), load_scenario("free_space"))
