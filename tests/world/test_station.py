"""The simulated cell and the robot alone."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.config import ScenarioError
from drake_oa.robot.config import Robot
from drake_oa.robot.plant import RobotPlant, home_positions, tool_corners
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.sources import noise_seed
from drake_oa.world.station import Station, make_station


def station_of(name: str, *overrides: str, render: bool = False) -> Station:
    builder = DiagramBuilder()
    station = make_station(builder, load_scenario(name, list(overrides)), render=render)
    builder.Build()
    return station


@pytest.mark.parametrize(
    ("name", "count"), [("tabletop_box", 1), ("tabletop_irregular", None), ("tabletop_clutter", 6)]
)
def test_each_shipped_scene_has_its_obstacles(name: str, count: int | None) -> None:
    builder = DiagramBuilder()
    station = make_station(builder, load_scenario(name), render=False)
    assert count is None or len(station.obstacles) == count
    assert len(station.obstacles) >= 1
    assert station.robot not in station.obstacles
    assert station.cameras == {}


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


def test_the_tool_is_above_its_point_and_narrow_along_the_motion(panda: RobotPlant) -> None:
    corners = tool_corners(Robot())
    assert corners.shape[1] == 3
    low, high = corners.min(axis=0), corners.max(axis=0)
    # It points down: all of it is above E but for the finger tips' rounding.
    assert -0.03 < low[2] <= 0.0
    assert 0.1 < high[2] < 0.25
    # The hand is wide along the world's x.
    assert high[0] - low[0] > 0.18
    assert high[1] - low[1] < 0.12


def test_the_tool_turns_with_its_asked_orientation(panda: RobotPlant) -> None:
    turned = tool_corners(Robot(rpy_WE=[np.pi, 0.0, 0.0]))
    extent = np.ptp(turned, axis=0)
    straight = np.ptp(tool_corners(Robot()), axis=0)
    np.testing.assert_allclose(extent, straight[[1, 0, 2]], atol=1e-9)


def test_opened_fingers_do_not_shrink_the_tool(panda: RobotPlant) -> None:
    closed = tool_corners(Robot())
    opened = tool_corners(Robot(finger_opening=0.04))
    assert (np.ptp(opened, axis=0) >= np.ptp(closed, axis=0) - 1e-9).all()


def test_home_positions_hold_seed_and_fingers(panda: RobotPlant) -> None:
    robot = Robot(finger_opening=0.03)
    q = home_positions(robot)
    np.testing.assert_array_equal(q, [*robot.q_seed, 0.03, 0.03])


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("robot.model=package://drake_oa/panda/nothing.urdf", ["robot.model", "nothing.urdf"]),
        ("robot.model=package://nowhere/robot.urdf", ["robot.model", "nowhere"]),
        ("robot.base_link=base", ["robot.base_link", "'base'", "panda_link0"]),
        ("robot.hand_link=palm", ["robot.hand_link", "'palm'", "panda_hand"]),
        (
            "directives=[{add_model: {name: a, file: package://drake_oa/no.sdf}}]",
            ["directives", "no.sdf"],
        ),
    ],
)
def test_what_cannot_be_built_is_refused_by_its_field(override: str, said: list[str]) -> None:
    with pytest.raises(ScenarioError) as error:
        station_of("tabletop_box", override)
    for words in said:
        assert words in str(error.value)


def test_a_camera_on_a_frame_that_is_not_there_is_refused() -> None:
    scenario = load_scenario("tabletop_box")
    scenario.cameras[0].X_PB.base_frame = "nowhere::camera"
    with pytest.raises(ScenarioError, match=r"cameras: camera 'camera': .*nowhere"):
        make_station(DiagramBuilder(), scenario)


def test_an_obstacle_that_can_move_is_refused() -> None:
    box = "package://drake_oa/obstacles/cardboard_box.sdf"
    override = f"directives=[{{add_model: {{name: obstacle_loose, file: '{box}'}}}}]"
    with pytest.raises(ScenarioError, match=r"directives: .*'obstacle_loose' can move.*add_weld"):
        station_of("tabletop_box", override)


def test_a_station_needs_a_robot() -> None:
    with pytest.raises(ScenarioError, match="robot"):
        make_station(DiagramBuilder(), load_scenario("free_space"))


@pytest.mark.parametrize(
    ("links", "said"), [(["panda_thumb"], "panda_thumb"), (["panda_link8"], "panda_link8")]
)
def test_tool_links_without_an_outline_are_refused(
    panda: RobotPlant, links: list[str], said: str
) -> None:
    with pytest.raises(ScenarioError, match=rf"robot.tool_links: .*{said}"):
        tool_corners(Robot(tool_links=links))
