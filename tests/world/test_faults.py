"""Faults: which frames arrive when, what they show, and what scenarios may ask for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydrake.systems.framework import DiagramBuilder

from drake_oa.common.config import ScenarioError
from drake_oa.robot.plant import make_robot_plant
from drake_oa.scenario.faults import (
    CameraDropout,
    Fault,
    FrameBurst,
    GoalBlocked,
    ModelError,
    NanFrames,
    Push,
    TableMissing,
    TorqueSaturation,
    camera_faults,
)
from drake_oa.scenario.loading import load_scenario, parse_scenario, scenario_text
from drake_oa.scenario.obstacles import check_waypoints, offset_at
from drake_oa.scenario.task_joints import start_positions
from drake_oa.world.faults import (
    PARKED_BEYOND,
    damaged_frame,
    delivered_frame,
    frames_to_keep,
    goal_ball,
    push_wrench,
    torque_scale,
    without_table,
)
from drake_oa.world.station import make_station
from drake_oa.world.world_model import all_obstacles

PERIOD = 1.0 / 30.0
K = np.array([50.0, 50.0, 20.0, 15.0])
# Straight down from 1 m above the origin: x right, y down in the image is -y in the world.
X_WC = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0], [0.0, 0.0, 0.0, 1.0]]
)

times = st.floats(0.0, 3.0)
durations = st.floats(0.01, 1.5)
delivery_faults = st.lists(
    st.builds(CameraDropout, times, durations) | st.builds(FrameBurst, times, durations),
    max_size=3,
)


def arrivals(*faults: Fault, count: int = 12, period: float = 0.1) -> list[int]:
    return [delivered_frame(faults, frame, period) for frame in range(count)]


def test_without_faults_every_frame_arrives() -> None:
    assert arrivals(NanFrames(), TableMissing(), ModelError()) == list(range(12))


def test_a_dropout_hands_out_the_frame_before_it() -> None:
    assert arrivals(CameraDropout(0.3, 0.4)) == [0, 1, 2, 2, 2, 2, 2, 7, 8, 9, 10, 11]


def test_a_camera_that_never_started_has_no_frame() -> None:
    assert arrivals(CameraDropout(0.0, 0.3), count=5) == [-1, -1, -1, 3, 4]


def test_a_burst_delivers_late_and_in_order() -> None:
    assert arrivals(FrameBurst(0.3, 0.3)) == [0, 1, 2, 2, 2, 2, 3, 4, 5, 9, 10, 11]


def test_a_fault_between_two_frames_hides_none() -> None:
    assert arrivals(CameraDropout(0.31, 0.05)) == list(range(12))


@given(delivery_faults)
def test_frames_never_go_back_nor_come_before_they_are_taken(faults: list[Fault]) -> None:
    arriving = [delivered_frame(faults, frame, PERIOD) for frame in range(200)]
    assert all(late <= frame for frame, late in enumerate(arriving))
    assert np.all(np.diff(arriving) >= 0)


@given(delivery_faults)
def test_what_arrives_late_was_kept(faults: list[Fault]) -> None:
    kept: set[int] = set()
    for frame in range(250):
        late = delivered_frame(faults, frame, PERIOD)
        assert late in (frame, -1) or late in kept
        wanted = frames_to_keep(faults, frame, PERIOD)
        assert wanted <= kept | {frame}
        kept = wanted
    assert not kept or frame * PERIOD < 6.0


def test_a_camera_lost_for_good_keeps_one_frame() -> None:
    assert frames_to_keep([CameraDropout(1.0, 1e6)], 100_000, PERIOD) == {29}


def test_frames_of_nan_are_those_taken_in_time() -> None:
    depth = np.ones((3, 4), dtype=np.float32)
    shown = [
        damaged_frame([NanFrames(0.2, 0.2)], depth, frame, 0.1, K, X_WC, 0.0) for frame in range(5)
    ]
    assert [bool(np.isnan(image).all()) for image in shown] == [False, False, True, True, False]
    assert shown[0] is depth


def test_the_table_is_missing_and_what_stands_on_it_is_not() -> None:
    depth = np.ones((30, 40), dtype=np.float32)
    depth[10:20, 10:20] = 0.8  # A block of 20 cm.
    depth[0, :] = 1.2  # Below the table.
    depth[1, :] = np.inf
    image = without_table(depth, K, X_WC, 0.0)
    assert np.isfinite(image).sum() == 100
    assert (image[10:20, 10:20] == depth[10:20, 10:20]).all()
    damaged = [
        damaged_frame([TableMissing(0.3, 2)], depth, frame, 0.1, K, X_WC, 0.0) is not depth
        for frame in range(7)
    ]
    assert damaged == [False] * 3 + [True] * 2 + [False] * 2


def test_a_tilted_camera_loses_the_same_table() -> None:
    # 45 degrees down, along +y: the table's depth grows towards the image's top.
    s = np.sqrt(0.5)
    tilted = np.eye(4)
    tilted[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, -s, s], [0.0, -s, -s]])
    tilted[2, 3] = 1.0
    v = (np.arange(30) - K[3]) / K[1]
    depth = np.tile((1.0 / (s * v + s))[:, None], (1, 40)).astype(np.float32)
    assert np.isnan(without_table(depth, K, tilted, 0.0)).all()
    assert np.isfinite(without_table(0.9 * depth, K, tilted, 0.0)).all()


def test_torque_limits_shrink_while_the_fault_lasts() -> None:
    faults: list[Fault] = [TorqueSaturation(1.0, 1.0, 0.5), TorqueSaturation(1.5, 1.0, 0.3)]
    scales = [torque_scale(faults, t) for t in (0.99, 1.0, 1.5, 2.0, 2.49, 2.5)]
    assert scales == [1.0, 0.5, 0.3, 0.3, 0.3, 1.0]


def test_a_camera_has_the_camera_faults() -> None:
    faults: list[Fault] = [GoalBlocked(), NanFrames(), ModelError(), FrameBurst()]
    assert camera_faults(faults) == (NanFrames(), FrameBurst())


@given(times, durations, times)
def test_a_push_is_all_or_nothing(start: float, duration: float, time: float) -> None:
    push = Push(start=start, duration=duration, torque=[1.0, 2.0, 3.0], force=[4.0, 5.0, 6.0])
    wrench = push_wrench(push, time)
    acts = start - 1e-6 <= time < start + duration + 1e-6
    if not acts:
        assert not wrench.any()
    if start <= time < start + duration - 1e-6:
        np.testing.assert_array_equal(wrench, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0])


# Scenario blocks.


def test_faults_are_read_and_written() -> None:
    text = "[!CameraDropout {start: 2.0}, !ModelError {}, !TorqueSaturation {scale: 0.6}]"
    scenario = load_scenario("tabletop_box", [f"faults={text}"])
    assert scenario.faults == [CameraDropout(2.0, 0.5), ModelError(), TorqueSaturation(scale=0.6)]
    assert parse_scenario(scenario_text(scenario)).faults == scenario.faults


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["faults=[!Fire {}]"], r"faults\[0\]: tag !Fire is not one of !CameraDropout, .*Contact"),
        (["faults=[!NanFrames {start: -1}]"], r"faults\[0\]\.start: -1 is outside \[0, .*\[s\]"),
        (["faults=[!TorqueSaturation {scale: 2}]"], r"scale: 2 is outside \[0, 1\]"),
        (["faults=[!ModelError {}, !FrameBurst {duration: 9}]"], r"faults\[1\]\.duration: 9"),
        (["faults=[!Push {force: [1, 2]}]"], r"faults\[0\]\.force: expected 3 numbers, not 2"),
        (["faults=[!Push {duration: 0}]"], r"duration: 0 is outside \(0, .*\[s\]"),
        (
            ["perception=!GroundTruth {}", "faults=[!NanFrames {}]"],
            r"faults\[0\]: !NanFrames needs 'perception: !DepthCamera'; it has !GroundTruth",
        ),
    ],
)
def test_bad_faults_are_refused(overrides: list[str], message: str) -> None:
    with pytest.raises(ScenarioError, match=message):
        load_scenario("tabletop_box", overrides)


def test_a_free_point_has_no_actuators_to_fail() -> None:
    with pytest.raises(ScenarioError, match="!TorqueSaturation needs a robot"):
        load_scenario("free_space", ["faults=[!TorqueSaturation {}]"])


GROUND_TRUTH = "perception=!GroundTruth {}"


@pytest.mark.parametrize("start", [0.0, 0.2, 2.0])
def test_the_ball_is_over_the_goal_for_the_time_asked(start: float) -> None:
    goal, away = np.array([0.4, 0.3, 0.2]), [0.0, PARKED_BEYOND, 0.0]
    fault = GoalBlocked(start=start, duration=1.5, radius=0.07)
    ball = goal_ball(fault, np.array([0.4, -0.2, 0.5]), goal, "ball")
    course = np.array(ball.waypoints)
    check_waypoints(ball.waypoints, "waypoints")
    assert ball.translation == goal.tolist()
    for t in (start, start + 0.7, start + 1.5):
        np.testing.assert_array_equal(offset_at(course, t), 0.0)
    np.testing.assert_array_equal(offset_at(course, start + 10.0), away)
    if start >= 0.4:
        np.testing.assert_array_equal(offset_at(course, 0.0), away)


def test_fault_obstacles_follow_those_of_the_scenario() -> None:
    scenario = load_scenario(
        "tabletop_box",
        [
            GROUND_TRUTH,
            "obstacles=[{name: mine, shapes: [!Sphere {}]}]",
            "faults=[!ModelError {}, !GoalBlocked {}, !StartInContact {}]",
        ],
    )
    assert [item.name for item in all_obstacles(scenario)] == ["mine", "fault1", "fault2"]


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["task.start=[0.3, 0.3, 0.4]", "task.goal=[0.5, -0.3, 0.3]"],
        ["task.goal=[0.45, -0.45, 0.5]"],
    ],
)
def test_the_plate_touches_the_tool_at_the_start_and_nothing_else(overrides: list[str]) -> None:
    scenario = load_scenario(
        "tabletop_box", [GROUND_TRUTH, "faults=[!StartInContact {depth: 0.001}]", *overrides]
    )
    assert scenario.robot is not None
    builder = DiagramBuilder()
    station = make_station(builder, scenario, render=False)
    diagram = builder.Build()
    root = diagram.CreateDefaultContext()
    plant_context = station.plant.GetMyMutableContextFromRoot(root)
    q = start_positions(make_robot_plant(scenario.robot), scenario)
    station.plant.SetPositions(plant_context, station.robot, q)
    query = station.scene_graph.get_query_output_port().Eval(
        station.scene_graph.GetMyContextFromRoot(root)
    )
    hits = query.ComputePointPairPenetration()
    touched = {
        frozenset(
            station.plant.GetBodyFromFrameId(
                station.scene_graph.model_inspector().GetFrameId(geometry)
            ).name()
            for geometry in (hit.id_A, hit.id_B)
        )
        for hit in hits
    }
    assert touched == {frozenset({"panda_hand", "body"})}
    assert max(hit.depth for hit in hits) == pytest.approx(0.001, abs=2e-5)
