"""Faults: a motion that goes on, or is brought to rest and says why; bad input: a clear error.

Observations are switched by small source systems and frames by those of `fault_systems`;
everything behind them is real.
"""

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.multibody.tree import ModelInstanceIndex
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, LeafSystem, State

from drake_oa.common.config import ScenarioError
from drake_oa.common.messages import (
    DECIDING,
    EllipsoidSet,
    FloatArray,
    ObstacleClouds,
    TablePlane,
)
from drake_oa.diagrams.avoidance import Layers, build_avoidance
from drake_oa.diagrams.policy import make_dmp
from drake_oa.robot.inertias import read_inertias
from drake_oa.runs.motion_log import MotionEnd, MotionLog
from drake_oa.runs.report import motion_metrics, motion_report
from drake_oa.runs.simulation import MotionInterruptedError, simulate
from drake_oa.scenario.faults import ModelError
from drake_oa.scenario.loading import load_scenario
from drake_oa.scenario.scenario import Scenario
from drake_oa.scenario.shipped import package_file
from tests.builders import balls
from tests.diagrams.fault_systems import Customize, frame_burst, missing_table, nan_frames

GROUND_TRUTH = "perception=!GroundTruth {}"
QUICK = "regulation=!Paper {}"  # Nothing is searched for.
FRAME = 1.0 / 15.0
AGE, HOLD = 0.5, 0.25
POLICY_STEP = 0.008

# Whole runs of `tabletop_box`, each with one fault.

SAFE = (MotionEnd.STOPPED, MotionEnd.HELD)
UNSEEN = "obstacles not seen"
PLATE = (
    "obstacles=[{name: plate, shapes: [!Box {size: [0.05, 0.006, 0.03]}], stiffness: 1000, "
    "translation: [0.45, -0.4845, 0.37015]}]"
)
"""A thin soft plate that touches the hand, where it starts, from behind by 0.5 mm."""


def blocked_goal(start: float) -> str:
    """A ball that comes from beyond the goal, stays over it for 2 s and leaves again."""
    course = [(-0.4, 1.2), (0.0, 0.0), (2.0, 0.0), (2.4, 1.2)]
    waypoints = [[start + t, 0.0, y, 0.0] for t, y in course]
    return (
        "obstacles=[{name: ball, shapes: [!Sphere {radius: 0.06}], "
        f"translation: [0.45, 0.45, 0.3], waypoints: {waypoints}}}]"
    )


@dataclass(frozen=True)
class Case:
    """A fault by overrides or a system, how its motion ends, and what is told of it."""

    overrides: tuple[str, ...] = ()
    customize: Callable[[Scenario], Customize] | None = None
    ends: tuple[MotionEnd, ...] = (MotionEnd.GOAL,)
    told: str = ""


CASES = {
    "camera stops": Case(("faults=[!CameraDropout {start: 1, duration: 1}]",), told=UNSEEN),
    "camera lost": Case(
        ("faults=[!CameraDropout {start: 1, duration: 1000}]",), ends=SAFE, told=UNSEEN
    ),
    "frames of NaN": Case(customize=lambda _: nan_frames(1.0, 1.0), told=UNSEEN),
    "frames in a burst": Case(customize=lambda s: frame_burst(s.cameras[0], 1.0, 0.4), told=UNSEEN),
    "a frame without table": Case(customize=lambda s: missing_table(s.cameras[0], 1.0, 0.03)),
    "a second without table": Case(
        customize=lambda s: missing_table(s.cameras[0], 1.0, 1.0), told=UNSEEN
    ),
    "goal blocked": Case((blocked_goal(1.0),), told="at its goal the arm would touch"),
    "goal blocked, near it": Case((blocked_goal(3.5),), told="at its goal the arm would touch"),
    "torque saturation": Case(
        ("faults=[!TorqueSaturation {start: 1, duration: 1, scale: 0.4}]",), told="torque"
    ),
    "model error": Case(("faults=[!ModelError {}]",)),
    "start in contact": Case((PLATE,)),
    "start in contact, seen": Case((PLATE, GROUND_TRUTH), told="within 0.000 m of obstacle"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_each_fault_ends_as_it_should_without_a_contact(name: str) -> None:
    case = CASES[name]
    scenario = load_scenario("tabletop_box", list(case.overrides))
    if case.customize is not None:
        # Only of frames that come as they are taken is the time known at which they change.
        scenario.cameras[0].output_delay = 0.0
    customize = case.customize(scenario) if case.customize else None
    log = simulate(scenario, customize=customize)
    report = motion_report(scenario, log)
    assert report["made_contacts"] == []
    assert report["ended"] in case.ends, report["stop_reason"]
    if case.ends == (MotionEnd.GOAL,):
        assert report["goal_error"] <= 1e-3
    if PLATE not in case.overrides:
        assert report["contacts"] == []
    assert case.told in "; ".join((*log.supervision_reason, *log.event))


# Faults of a scenario, shortly.


def run(fault: str, duration: float, *overrides: str) -> tuple[Scenario, MotionLog]:
    scenario = load_scenario("tabletop_box", [fault, *overrides])
    return scenario, simulate(scenario, duration=duration)


def test_only_the_controllers_model_is_wrong() -> None:
    diagram = build_avoidance(
        load_scenario("tabletop_box", [GROUND_TRUTH, "faults=[!ModelError {}]"])
    )
    plant = diagram.GetSubsystemByName("plant")
    controller = diagram.GetSubsystemByName("controller")
    mass = read_inertias(package_file(ModelError().inertias))["panda_link1"].mass
    assert controller._plant.GetBodyByName("panda_link1").default_mass() == mass
    assert plant.GetBodyByName("panda_link1").default_mass() > 1.5 * mass
    assert plant.num_positions(ModelInstanceIndex(2)) == controller._plant.num_positions()


def test_a_camera_that_stops_leaves_the_stamp_where_it_was() -> None:
    scenario, log = run("faults=[!CameraDropout {start: 0.2, duration: 0.3}]", 0.6, QUICK)
    gap = np.diff(log.observation_stamp)
    assert (gap > 0.0).all()
    period = 1.0 / scenario.cameras[0].fps
    (row,) = np.flatnonzero(gap > 1.5 * period)
    assert log.observation_stamp[row] < 0.2 <= log.observation_stamp[row] + period + 1e-9
    assert 0.5 - 1e-9 <= log.observation_stamp[row + 1] < 0.5 + period
    # What is seen again is what was seen before.
    np.testing.assert_array_equal(log.obstacle_id[row + 1], log.obstacle_id[row])


def test_one_of_two_cameras_that_stops_ages_what_is_seen() -> None:
    fault = "faults=[!CameraDropout {start: 0.1, duration: 10, camera: left}]"
    diagram = build_avoidance(load_scenario("two_cameras", [fault, QUICK]))
    assert diagram.HasSubsystemNamed("camera_faults_left")
    assert not diagram.HasSubsystemNamed("camera_faults_right")
    simulator = Simulator(diagram)
    simulator.AdvanceTo(0.25)
    perception = diagram.GetSubsystemByName("perception")
    context = perception.GetMyContextFromRoot(simulator.get_context())
    seen = perception.GetOutputPort("obstacles_W").Eval(context)
    assert seen.note == "left: no new image"
    assert seen.stamp < 0.1


def test_torques_are_cut_off_and_logged_as_applied() -> None:
    fault = "faults=[!TorqueSaturation {start: 0.2, duration: 0.1, scale: 0.3}]"
    _, log = run(fault, 0.4, GROUND_TRUTH, QUICK)
    share = (np.abs(log.torque) / log.effort_limit).max(axis=1)
    weak = (log.t >= 0.2) & (log.t < 0.3 - 1e-9)
    assert share[weak].max() == pytest.approx(0.3)
    assert share[log.t < 0.2].min() > 0.35


def test_a_contact_at_the_start_is_not_one_that_the_motion_made() -> None:
    scenario, log = run(PLATE, 0.3, GROUND_TRUTH, QUICK)
    metrics = motion_metrics(scenario, log)
    assert metrics.initial_contacts == ("panda_hand - obstacle_plate",)
    assert metrics.made_contacts == ()
    assert "tool inside obstacle" in log.event[-1]


# Observations that a source system switches.


class Scripted(LeafSystem):
    """One abstract output `name` that is a function of time, as a source that looks every frame."""

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
        source = Scripted("obstacles_W", script, ObstacleClouds())
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


def test_a_stale_observation_holds_the_motion_on_its_path_and_a_fresh_one_resumes_it(
    free_motion: Callable[..., MotionLog], caplog: pytest.LogCaptureFixture
) -> None:
    def stops_for_two_seconds(time: float) -> EllipsoidSet:
        stamp = 22 * FRAME if 1.5 < time < 3.5 else time
        return balls((0.5, 0.02, 0.0), radius=0.12, stamp=stamp)

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
    assert np.linalg.norm(log.desired_position - [0.5, 0.02, 0.0], axis=1).min() >= 0.12 + 0.148


@pytest.mark.parametrize(
    ("seen", "overrides", "why"),
    [
        (EllipsoidSet(note="no valid pixel"), [], "no observation yet (no valid pixel)"),
        (balls((0.05, 0.0, 0.0), radius=0.12), [], "tool inside obstacle 0"),
        (balls((0.95, 0.0, 0.0), radius=0.12), [], "goal inside obstacle 0"),
        # An obstacle so big that any way past it is far outside the table's height.
        (
            balls((0.5, 0.0, 0.0), radius=0.12, table=TablePlane(offset=5.0)),
            [QUICK],
            "every side of obstacle 0 is forbidden",
        ),
    ],
)
def test_where_no_motion_is_possible_the_start_is_held(
    seen: EllipsoidSet,
    overrides: list[str],
    why: str,
    free_motion: Callable[..., MotionLog],
    caplog: pytest.LogCaptureFixture,
) -> None:
    def script(time: float) -> EllipsoidSet:
        return replace(seen, stamp=time) if len(seen) else seen

    with caplog.at_level(logging.WARNING, "drake_oa"):
        log = free_motion(script, *overrides)
    assert log.stop_reason == f"held for 5 s: {why}"
    assert f"held: {why}" in caplog.text
    assert_sound(log)
    # The desired motion comes to rest at the policy's first step after.
    assert not log.desired_velocity[log.t >= HOLD + POLICY_STEP - 1e-9].any()
    assert np.linalg.norm(log.desired_position[-1]) < 0.01


def test_an_obstacle_that_appears_on_the_tool_stops_it_and_lets_it_go(
    free_motion: Callable[..., MotionLog],
) -> None:
    def appears(time: float) -> EllipsoidSet:
        centers = [(0.3, 0.0, 0.0)] if 1.8 < time < 3.0 else []
        return balls(*centers, radius=0.2, stamp=time)

    log = free_motion(appears)
    assert_sound(log)
    assert log.event == ("tool inside obstacle 0", "")
    still = (log.t > 1.8 + FRAME + HOLD + 0.02) & (log.t < 3.0)
    assert not log.desired_velocity[still].any()
    assert log.stop_reason == "goal"


# Clouds, with the whole robot.

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
    log = robot_motion(lambda time: clouds(time, cloud), duration=0.3)
    assert_sound(log)
    assert log.p_WO.shape[1] == 1
    assert (log.semi_axes > 0.0).all()
    assert log.event == (DECIDING, "")


def test_points_that_are_not_finite_never_reach_the_torques(
    robot_motion: Callable[..., MotionLog],
) -> None:
    spoilt = np.where(np.arange(len(BOX))[:, None] % 3 == 0, np.nan, BOX)
    nothing = np.full((10, 3), np.nan)

    def turns_bad(time: float) -> ObstacleClouds:
        points = (BOX,) if time < 0.2 else (spoilt, nothing)
        return clouds(time, *points)

    log = robot_motion(turns_bad, duration=0.6)
    assert_sound(log)
    assert np.isfinite(log.p_WO).all()


# Errors before anything runs.


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["task.goal=[0.45, -0.45, 0.3]"], ["task.goal", "1 mm apart"]),
        (["task.goal=[2.0, 0.0, 0.3]"], ["task.goal", "out of reach", "comes as near as 1.199 m"]),
        (["task.start=[0.45, -0.45, 1.9]"], ["task.start", "out of reach"]),
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


@pytest.mark.parametrize(
    "content",
    [
        {"path": np.zeros((5, 3))},
        {"path": np.full((5, 3), np.nan)},
        {"points": np.zeros(3)},
        {"path": np.eye(4)[:, :2]},
        {"path": np.arange(5.0)},
        b"",
        b"PK\x03\x04 cut short",
        b"no archive",
    ],
)
def test_a_demonstration_that_cannot_be_imitated_is_refused(
    content: dict[str, FloatArray] | bytes, tmp_path: Path
) -> None:
    file = tmp_path / "demo.npz"
    if isinstance(content, bytes):
        file.write_bytes(content)
    else:
        np.savez(file, **content)
    with pytest.raises(ScenarioError, match=r"task\.demonstration: .*demo\.npz"):
        build_avoidance(load_scenario("free_space", [f"task.demonstration={file}"]))


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


def test_a_recording_lies_where_the_scenario_says_its_camera_was(
    recording_folder: Path, tmp_path: Path
) -> None:
    block = ", X_WC: {translation: [0.05, 0, 0]}"
    log = simulate(recorded(recording_folder, tmp_path, block), duration=0.1)
    np.testing.assert_allclose(log.p_WO[0, 0, :2], [0.5, 0.0], atol=0.03)


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
