"""Bad input and faults: a clear error, or a motion that is brought to rest and says why.

Observations are switched by small source systems; everything behind them is real.
"""

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, DiagramBuilder, LeafSystem, State
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import (
    DECIDING,
    EllipsoidSet,
    FloatArray,
    ObstacleClouds,
    TablePlane,
)
from drake_oa.diagrams import policy, route, view
from drake_oa.diagrams.avoidance import Layers, build_avoidance
from drake_oa.diagrams.policy import make_dmp
from drake_oa.diagrams.route import make_cost_ring_selector
from drake_oa.regulation.config import SearchParameters
from drake_oa.runs.motion_log import MotionLog
from drake_oa.runs.report import motion_report
from drake_oa.runs.simulation import MotionInterruptedError, simulate
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import package_file
from drake_oa.world.station import make_station
from tests.builders import balls

GROUND_TRUTH = "perception=!GroundTruth {}"
FRAME = 1.0 / 15.0
AGE, HOLD = 0.5, 0.25
POLICY_STEP = 0.008


class Scripted(LeafSystem):
    """One abstract output `name` that is a function of time."""

    def __init__(self, name: str, script: Callable[[float], object], model: object) -> None:
        super().__init__()
        self._script = script
        self.DeclareAbstractOutputPort(
            name, lambda: Value(model), self._calc, prerequisites_of_calc={self.time_ticket()}
        )

    def _calc(self, context: Context, output: AbstractValue) -> None:
        output.set_value(self._script(context.get_time()))


class ScriptedFrames(LeafSystem):
    """The same for a source that looks 15 times a second."""

    def __init__(self, name: str, script: Callable[[float], object], model: object) -> None:
        super().__init__()
        self._script = script
        self._seen = self.DeclareAbstractState(Value(model))
        self.DeclareStateOutputPort(name, self._seen)
        self.DeclareInitializationUnrestrictedUpdateEvent(self._look)
        self.DeclarePeriodicUnrestrictedUpdateEvent(FRAME, 0.0, self._look)

    def _look(self, context: Context, state: State) -> None:
        seen = self._script(context.get_time())
        state.get_mutable_abstract_state(self._seen).set_value(seen)


def seen_by(source: LeafSystem) -> Layers:
    """The layers, with a perception source of one's own."""
    return replace(Layers(), perception=lambda wires, *_: wires.add("perception", source))


def frame_time(time: float) -> float:
    """Time of the last frame of a 15 Hz source."""
    return FRAME * math.floor(time / FRAME + 1e-9)


def ellipsoids(
    stamp: float, *centers: tuple[float, float, float], radius: float = 0.12
) -> EllipsoidSet:
    return balls(*centers, radius=radius, stamp=stamp)


@pytest.fixture
def free_motion() -> Callable[..., MotionLog]:
    """Runs `free_space` (from x = 0 to x = 1 m in 5 s) on scripted ellipsoids."""

    def run(script: Callable[[float], EllipsoidSet], *overrides: str, **options: object) -> object:
        source = Scripted("ellipsoids_W", script, EllipsoidSet())
        scenario = load_scenario("free_space", list(overrides))
        return simulate(scenario, layers=seen_by(source), **options)

    return run


@pytest.fixture
def robot_motion(recording_folder: Path) -> Callable[..., MotionLog]:
    """Runs `tabletop_box` on scripted clouds, wired as a recording is."""

    def run(script: Callable[[float], ObstacleClouds], **options: object) -> MotionLog:
        source = ScriptedFrames("obstacles_W", script, ObstacleClouds())
        folder = f"perception=!RecordedClouds {{folder: {recording_folder}}}"
        scenario = load_scenario("tabletop_box", [folder])
        return simulate(scenario, layers=seen_by(source), **options)

    return run


def assert_sound(log: MotionLog) -> None:
    """No number that is not finite, and no jump of the desired motion."""
    for name in ("q", "v", "torque", "desired_position", "desired_velocity"):
        assert np.isfinite(getattr(log, name)).all(), name
    step = np.linalg.norm(np.diff(log.desired_position, axis=0), axis=1)
    assert step.max(initial=0.0) < 0.02


def at_rest(log: MotionLog, since: float) -> bool:
    # The desired motion comes to rest at the policy's first step after.
    return not log.desired_velocity[log.t >= since + POLICY_STEP - 1e-9].any()


# Faults while running: observations.


def test_an_observation_that_goes_stale_holds_and_a_fresh_one_resumes(
    free_motion: Callable[..., MotionLog], caplog: pytest.LogCaptureFixture
) -> None:
    def stops_for_two_seconds(time: float) -> EllipsoidSet:
        stamp = frame_time(1.5 if 1.5 < time < 3.5 else time)
        return ellipsoids(stamp, (0.5, 0.02, 0.0))

    with caplog.at_level(logging.WARNING, "drake_oa"):
        log = free_motion(stops_for_two_seconds)
    assert_sound(log)
    held = (log.t > 1.5 + AGE + HOLD + 0.02) & (log.t < 3.5)
    assert not log.desired_velocity[held].any()
    assert np.ptp(log.desired_position[held], axis=0).max() == 0.0
    assert log.event == ("obstacles not seen since t = 1.47 s", "")
    assert "held: obstacles not seen since" in caplog.text
    assert "running again" in caplog.text
    assert log.stop_reason == "goal"
    np.testing.assert_allclose(log.desired_position[-1], [1.0, 0.0, 0.0], atol=1e-3)


def test_a_hold_leaves_the_path_round_the_obstacle_as_it_was(
    free_motion: Callable[..., MotionLog],
) -> None:
    def clearance(script: Callable[[float], EllipsoidSet]) -> float:
        p_WE = free_motion(script).desired_position
        return float((np.linalg.norm(p_WE - [0.5, 0.02, 0.0], axis=1) - 0.12).min())

    def interrupted(time: float) -> EllipsoidSet:
        return ellipsoids(1.2 if 1.2 < time < 2.4 else time, (0.5, 0.02, 0.0))

    freely = clearance(lambda time: ellipsoids(time, (0.5, 0.02, 0.0)))
    assert clearance(interrupted) == pytest.approx(freely, abs=2e-3)
    assert freely >= 0.15


def test_without_any_observation_the_motion_never_begins(
    free_motion: Callable[..., MotionLog],
) -> None:
    log = free_motion(lambda time: EllipsoidSet(note="no valid pixel"))
    assert log.stop_reason == "held for 5 s: no observation yet (no valid pixel)"
    assert at_rest(log, HOLD)
    assert np.linalg.norm(log.desired_position[-1]) < 0.01


def test_an_empty_scene_is_passed_straight(free_motion: Callable[..., MotionLog]) -> None:
    log = free_motion(lambda time: ellipsoids(frame_time(time)))
    assert log.stop_reason == "goal"
    assert log.event == ()
    assert np.abs(log.desired_position[:, 1:]).max() < 1e-9


def test_obstacles_that_come_and_go_do_not_break_the_motion(
    free_motion: Callable[..., MotionLog],
) -> None:
    def blinking(time: float) -> EllipsoidSet:
        centers = [(0.4, 0.03, 0.0), (0.6, -0.02, 0.1), (0.5, 0.0, -0.5)]
        return ellipsoids(frame_time(time), *centers[: round(frame_time(time) / FRAME) % 4])

    log = free_motion(blinking)
    assert_sound(log)
    assert log.stop_reason == "goal"


def test_heading_exactly_at_the_centre_is_passed(free_motion: Callable[..., MotionLog]) -> None:
    log = free_motion(lambda time: ellipsoids(time, (0.5, 0.0, 0.0)))
    assert_sound(log)
    assert log.stop_reason == "goal"
    kept = np.linalg.norm(log.desired_position - [0.5, 0.0, 0.0], axis=1) - 0.12
    assert kept.min() >= 0.15 - SearchParameters().slack


@pytest.mark.parametrize(("x", "place"), [(0.05, "tool"), (0.95, "goal")])
def test_an_obstacle_over_start_or_goal_holds(
    x: float, place: str, free_motion: Callable[..., MotionLog], caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "drake_oa"):
        log = free_motion(lambda time: ellipsoids(time, (x, 0.0, 0.0)))
    assert log.stop_reason == f"held for 5 s: {place} inside obstacle 0"
    assert f"held: {place} inside obstacle 0" in caplog.text
    assert_sound(log)
    assert at_rest(log, HOLD)


def test_an_obstacle_that_appears_on_the_tool_stops_it_and_lets_it_go(
    free_motion: Callable[..., MotionLog],
) -> None:
    def appears(time: float) -> EllipsoidSet:
        return ellipsoids(time, *([(0.3, 0.0, 0.0)] if 1.8 < time < 3.0 else []), radius=0.2)

    log = free_motion(appears)
    assert_sound(log)
    assert log.event == ("tool inside obstacle 0", "")
    still = (log.t > 1.8 + HOLD + 0.02) & (log.t < 3.0)
    assert not log.desired_velocity[still].any()
    assert log.stop_reason == "goal"


def test_where_every_side_is_forbidden_the_motion_holds(
    free_motion: Callable[..., MotionLog],
) -> None:
    # An obstacle so big that any way past it is far outside the table's height.
    def walled(time: float) -> EllipsoidSet:
        return replace(ellipsoids(time, (0.5, 0.0, 0.0)), table=TablePlane(offset=5.0))

    log = free_motion(walled, "regulation=!Paper {}")
    assert log.stop_reason == "held for 5 s: every side of obstacle 0 is forbidden"
    assert at_rest(log, HOLD)


# Faults while running: clouds, with the whole robot.

BOX = np.stack(
    np.meshgrid(np.linspace(0.40, 0.50, 6), np.linspace(-0.05, 0.05, 6), np.linspace(0, 0.25, 6)),
    axis=-1,
).reshape(-1, 3)


def clouds(stamp: float, *points: FloatArray, note: str = "") -> ObstacleClouds:
    return ObstacleClouds(stamp, tuple(points), np.arange(len(points)), TablePlane(), note)


@pytest.mark.parametrize(
    "cloud",
    [BOX[:1], BOX[BOX[:, 0] == BOX[0, 0]], np.repeat(BOX[:1], 5, axis=0)],
    ids=["one point", "planar", "coincident"],
)
def test_clusters_without_volume_are_obstacles_too(
    cloud: FloatArray, robot_motion: Callable[..., MotionLog]
) -> None:
    log = robot_motion(lambda time: clouds(frame_time(time), cloud), duration=0.3)
    assert_sound(log)
    assert log.p_WO.shape[1] == 1
    assert (log.semi_axes > 0.0).all()
    assert log.event == (DECIDING, "")


def test_the_robot_stops_when_its_source_dies_and_goes_on_when_it_is_back(
    robot_motion: Callable[..., MotionLog],
) -> None:
    def dies(time: float) -> ObstacleClouds:
        dead = 2.0 < time < 4.0
        stamp = frame_time(2.0 if dead else time)
        return clouds(stamp, BOX, note="no valid pixel" if dead else "")

    log = robot_motion(dies)
    assert_sound(log)
    assert "not seen since" in log.event[2]
    assert "no valid pixel" in log.event[2]
    stopped = (log.t > 2.0 + AGE + HOLD + 0.5) & (log.t < 4.0)
    assert np.abs(log.v[stopped][:, :7]).max() < 0.02
    report = motion_report(load_scenario("tabletop_box"), log)
    assert report["stop_reason"] == "goal"
    assert report["collisions"] == 0
    assert report["goal_error"] <= 0.005
    assert report["torque_saturation"] == 0.0


def test_points_that_are_not_finite_never_reach_the_torques(
    robot_motion: Callable[..., MotionLog],
) -> None:
    spoilt = np.where(np.arange(len(BOX))[:, None] % 3 == 0, np.nan, BOX)
    nothing = np.full((10, 3), np.nan)

    def turns_bad(time: float) -> ObstacleClouds:
        points = (BOX,) if time < 0.2 else (spoilt, nothing)
        return clouds(frame_time(time), *points)

    log = robot_motion(turns_bad, duration=0.6)
    assert_sound(log)
    assert np.isfinite(log.p_WO).all()


def test_the_robot_holds_its_start_while_an_obstacle_is_over_it(
    robot_motion: Callable[..., MotionLog],
) -> None:
    log = robot_motion(lambda time: clouds(time, BOX + [0.0, -0.45, 0.15]), duration=1.5)
    assert log.event[0] == DECIDING
    assert_sound(log)
    # The elbow may draw away from it in the null space.
    assert np.abs(log.p_WE - log.p_WE[0]).max() < 1e-3
    assert np.abs(log.q - log.q[0]).max() < 0.1


# Errors before anything runs.


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["task.goal=[0.45, -0.45, 0.3]"], ["task.goal", "1 mm apart"]),
        (["task.goal=[2.0, 0.0, 0.3]"], ["task.goal", "out of reach", "comes as near as 1.199 m"]),
        (["task.start=[0.45, -0.45, 1.9]"], ["task.start", "out of reach"]),
        (["regulation.weights=/nowhere/chain.npz"], ["regulation.weights", "/nowhere/chain.npz"]),
        (["perception=!RecordedClouds {folder: /nowhere}"], ["perception.folder", "/nowhere"]),
        (["task.demonstration=/nowhere/path.npz"], ["task.demonstration", "/nowhere/path.npz"]),
        (["perception=!DepthCamera {camera: left}"], ["perception.camera", "'left'", "camera"]),
        (["cameras=[{name: a}, {name: a}]"], ["cameras", "'a'"]),
        (["robot.tool_links=[]"], ["robot.tool_links"]),
    ],
)
def test_a_scenario_that_cannot_run_is_refused_by_its_field(
    overrides: list[str], said: list[str]
) -> None:
    with pytest.raises(ScenarioError) as error:
        build_avoidance(load_scenario("tabletop_box", overrides))
    for words in said:
        assert words in str(error.value)


def test_weights_of_another_shape_are_refused(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.npz"
    np.savez(wrong, alpha=np.zeros((2, 2)))
    for file in (wrong, tmp_path):
        with pytest.raises(ScenarioError, match=r"regulation\.weights: .*"):
            build_avoidance(load_scenario("tabletop_box", [f"regulation.weights={file}"]))


def test_weights_for_the_released_action_level_are_refused() -> None:
    paper = "regulation.weights=package://drake_oa/weights/paper_chain.safetensors"
    with pytest.raises(ScenarioError, match=r"regulation\.weights: .*rad/s.*paper_running"):
        build_avoidance(load_scenario("free_space", [paper]))


def test_weights_with_a_layer_of_another_width_are_refused(tmp_path: Path) -> None:
    file = package_file(load_scenario("free_space").regulation.weights)
    with safe_open(file, "numpy") as whole:
        header = whole.metadata()
    arrays = load_file(file)
    name = next(k for k, v in arrays.items() if v.ndim == 2)
    arrays[name] = arrays[name][:, :-1].copy()
    save_file(arrays, tmp_path / "narrow.safetensors", header)
    with pytest.raises(ScenarioError, match=r"regulation\.weights: .*"):
        build_avoidance(
            load_scenario("free_space", [f"regulation.weights={tmp_path}/narrow.safetensors"])
        )


def test_an_empty_recording_folder_is_refused(tmp_path: Path) -> None:
    block = f"perception=!RecordedClouds {{folder: {tmp_path}}}"
    with pytest.raises(ScenarioError, match=r"perception\.folder"):
        build_avoidance(load_scenario("tabletop_box", [block]))


@pytest.mark.parametrize(
    "content",
    [
        {"path": np.zeros((5, 3))},
        {"path": np.full((5, 3), np.nan)},
        {"points": np.zeros(3)},
        {"path": np.eye(4)[:, :2]},
        {"path": np.arange(5.0)},
    ],
    ids=["does not move", "not finite", "no path", "two dimensions", "one dimension"],
)
def test_a_demonstration_that_cannot_be_imitated_is_refused(
    content: dict[str, FloatArray], tmp_path: Path
) -> None:
    np.savez(tmp_path / "demo.npz", **content)
    with pytest.raises(ScenarioError, match=r"task\.demonstration"):
        build_avoidance(load_scenario("free_space", [f"task.demonstration={tmp_path}/demo.npz"]))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 cut short", b"no archive"])
def test_a_demonstration_that_is_no_archive_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "demo.npz").write_bytes(content)
    with pytest.raises(ScenarioError, match=r"task\.demonstration: .*demo\.npz.*cannot read it"):
        build_avoidance(load_scenario("free_space", [f"task.demonstration={tmp_path}/demo.npz"]))


def test_without_a_demonstration_none_is_blamed(monkeypatch: pytest.MonkeyPatch) -> None:
    def imitate(*_: object, **__: object) -> None:
        raise ValueError("does not fit")

    monkeypatch.setattr(policy, "imitate", imitate)
    with pytest.raises(ScenarioError, match=r"^policy: does not fit"):
        make_dmp(load_scenario("free_space"))


@pytest.mark.parametrize(("stamps", "duration"), [({}, 5.0), ({"t": [0.0, 1.0, 3.0]}, 3.0)])
def test_stamps_of_a_demonstration_are_its_duration(
    stamps: dict[str, list[float]], duration: float, tmp_path: Path
) -> None:
    np.savez(tmp_path / "demo.npz", path=np.eye(3), **stamps)
    override = f"task.demonstration={tmp_path}/demo.npz"
    assert make_dmp(load_scenario("free_space", [override])).duration == duration


def recorded(recording_folder: Path, tmp_path: Path, block: str) -> Scenario:
    """`tabletop_box` on a recording whose camera is given by the scenario alone."""
    with np.load(recording_folder / "cloud_0.000.npz") as archive:
        np.savez(tmp_path / "cloud.npz", points=archive["points"])
    block = f"perception=!RecordedClouds {{folder: {tmp_path}{block}}}"
    return load_scenario("tabletop_box", [block])


@pytest.mark.parametrize(
    ("block", "said"),
    [
        ("", ["perception.X_WC", "cloud.npz", "X_WC: {translation"]),
        (", X_WC: {base_frame: table}", ["perception.X_WC.base_frame", "table"]),
        (", X_WC: {rotation: !Uniform {}}", ["perception.X_WC"]),
    ],
)
def test_a_recording_from_an_unknown_place_is_refused(
    block: str, said: list[str], recording_folder: Path, tmp_path: Path
) -> None:
    with pytest.raises(ScenarioError) as error:
        build_avoidance(recorded(recording_folder, tmp_path, block))
    for words in said:
        assert words in str(error.value)


@pytest.mark.parametrize("shift", [0.0, 0.05])
def test_a_recording_lies_where_the_scenario_says_its_camera_was(
    shift: float, recording_folder: Path, tmp_path: Path
) -> None:
    block = f", X_WC: {{translation: [{shift}, 0, 0]}}"
    log = simulate(recorded(recording_folder, tmp_path, block), duration=0.1)
    np.testing.assert_allclose(log.p_WO[0, 0, :2], [0.45 + shift, 0.0], atol=0.03)


# What is known of the robot, and of its world.


@pytest.mark.parametrize(
    ("overrides", "limited"),
    [
        ([], True),
        (["robot.rpy_WE=[0.0, 1.5708, 0.0]"], True),
        (["robot=null", "perception=!GivenEllipsoids {}"], False),
    ],
)
def test_the_limits_rings_are_those_of_the_robot_as_it_holds_its_tool(
    overrides: list[str], limited: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = {}
    monkeypatch.setattr(route, "CostRingSelector", lambda *_, **options: given.update(options))
    make_cost_ring_selector(load_scenario("tabletop_box", overrides))
    for name in ("workspace", "joint_limits"):
        assert (given[name] is not None) == limited
    if limited:
        at = np.array([[0.45, 0.0, 0.5], [2.0, 0.0, 0.5]])
        inside, outside = given["workspace"](at)
        assert inside > 0.0
        assert outside < -0.5


def test_the_viewer_shows_the_motion_that_was_planned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = {}
    monkeypatch.setattr(view, "dress_scene", lambda *_: None)
    monkeypatch.setattr(view, "MeshcatOverlay", lambda _, **options: given.update(options))
    angle = np.linspace(0.0, np.pi, 50)[:, None]
    np.savez(tmp_path / "arc.npz", path=np.hstack([-np.cos(angle), 0.0 * angle, np.sin(angle)]))
    scenario = load_scenario("tabletop_box", [f"task.demonstration={tmp_path}/arc.npz"])
    scenario.cameras[0].z_near, scenario.cameras[0].z_far = 0.5, 2.5
    station = make_station(DiagramBuilder(), scenario)
    view.make_overlay(scenario, station, None)
    assert given["cameras"]["camera_pose"][1:] == (0.5, 2.5)
    planned_W = given["planned_W"]
    np.testing.assert_allclose(planned_W[0], scenario.task.start)
    np.testing.assert_allclose(planned_W[-1], scenario.task.goal, atol=0.02)
    # Half a circle above a baseline of 0.9 m at a height of 0.3 m.
    assert planned_W[:, 2].max() == pytest.approx(0.75, abs=0.03)


# The end before the end.


@pytest.mark.parametrize(
    ("cause", "name"),
    [
        (KeyboardInterrupt(), "interrupted"),
        (RuntimeError("out of memory"), "RuntimeError: out of memory"),
    ],
)
def test_an_interrupted_run_leaves_its_log(cause: BaseException, name: str) -> None:
    def interrupt(time: float, phase: float) -> None:
        if time > 0.5:
            raise cause

    with pytest.raises(MotionInterruptedError) as caught:
        simulate(load_scenario("tabletop_box", [GROUND_TRUTH]), on_progress=interrupt)
    log = caught.value.log
    assert log.stop_reason == name
    assert log.duration == pytest.approx(0.5, abs=0.02)
    assert len(log.q) == len(log.t) == len(log.torque) > 50
    assert len(log.observation_stamp) > 5
    report = motion_report(load_scenario("tabletop_box"), log)
    assert report["stop_reason"] == name
    assert report["collisions"] == 0
